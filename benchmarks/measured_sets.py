"""Fits of the measured sets by the specs in examples/, and what evidence does with coloured errors.

The sets are read from ORTHAUG_DATA (default ../shared/data beside the project); what is absent is left out.
Run: python benchmarks/measured_sets.py
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
from machine import ROOT, data_folder, describe

from orthaug.commands.fit import fit_variant
from orthaug.commands.job import AS_DECLARED, PHYSICS_ONLY, Job, Variant
from orthaug.commands.opening import open_job
from orthaug.fitting import objective
from orthaug.fitting.estimation import fit


@cache
def job(name: str) -> Job | None:
    """The example with its data; None where these are absent."""
    with tempfile.TemporaryDirectory() as folder:
        spec = written(name, Path(folder))
        return None if spec is None else open_job(spec)


def written(name: str, folder: Path) -> Path | None:
    """The example's spec in a folder, with the data where they are; None where they are absent."""
    text = (ROOT / "examples" / f"{name}.toml").read_text(encoding="utf-8")
    if not (data_folder() / name.removesuffix("_motion").removesuffix("_terms")).is_dir():
        return None
    spec = folder / f"{name}.toml"
    spec.write_text(text.replace("../../shared/data", data_folder().as_posix()), encoding="utf-8")
    return spec


@cache
def scores(name: str, score: str, variant: Variant = AS_DECLARED) -> list[float] | None:
    """A score of the free run on each test part, in the spec's order."""
    opened = job(name)
    if opened is None:
        return None
    found = fit_variant(opened, variant).result.scores
    return [getattr(found[part.name].simulation, score)[0] for part in opened.tests]


def silverbox() -> list[float | None]:
    """Test RMSE in mV: multisine, arrow, inner arrow."""
    return [1e3 * rmse for rmse in scores("silverbox", "rmse") or ()] or 3 * [None]


def mr_damper() -> list[float | None]:
    """FIT of the free run on the test part: with the learner, and by physics alone."""
    found = [
        scores("mr_damper", "fit", variant) for variant in (AS_DECLARED, Variant(PHYSICS_ONLY))
    ]
    return [None if one is None else one[0] for one in found]


def cascaded_tanks() -> float | None:
    """FIT of the free run on the official test: 78.4, 79.2 or 83.5 by the kernels that BLAS takes on a machine."""
    found = scores("cascaded_tanks", "fit", AS_DECLARED)
    return None if found is None else found[0]


def cascaded_tanks_alone() -> float | None:
    """The same of physics alone."""
    found = scores("cascaded_tanks", "fit", Variant(PHYSICS_ONLY))
    return None if found is None else found[0]


@contextmanager
def every_error_counts() -> Iterator[None]:
    """Evidence as if errors were not coloured."""
    usual = objective.independent_share
    objective.independent_share = lambda residuals: 1.0
    try:
        yield
    finally:
        objective.independent_share = usual


def colour() -> list[float | None]:
    """Median FIT over six starts of the MR damper: all rows counted, and the independent share of them."""
    opened = job("mr_damper")
    if opened is None:
        return [None, None]
    (test,), spec = opened.tests, opened.spec
    options = {"learner": spec.declared_learner(), "criterion": spec.declared_criterion()}
    options |= {"solver": spec.declared_solver(), "regularization": "evidence"}

    def median() -> float:
        fits = [fit(opened.problem, seed=seed, **options) for seed in range(6)]
        return float(
            np.median([one.model.simulate(test.record).scores(test.skip).fit[0] for one in fits])
        )

    with every_error_counts():
        all_rows = median()
    return [all_rows, median()]


def main() -> None:
    print(describe())
    for what, found in (
        ("Silverbox, mV", silverbox()),
        ("MR damper, FIT", mr_damper()),
        ("Tanks, FIT", [cascaded_tanks(), cascaded_tanks_alone()]),
        ("its colour", colour()),
    ):
        print(what, " / ".join("absent" if one is None else f"{one:.4g}" for one in found))


if __name__ == "__main__":
    main()
