"""`orthaug benchmark`: public data sets in their protocols, beside published figures."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from orthaug._base.errors import InputError
from orthaug._base.folders import check_replaceable, whole_folder
from orthaug._base.progress import Progress
from orthaug.commands.fit import FitReport, fit_variant
from orthaug.commands.folder import check_kept
from orthaug.commands.job import AS_DECLARED, PHYSICS_ONLY, Job, Variant, surroundings
from orthaug.commands.opening import open_spec
from orthaug.commands.spec import spec_model
from orthaug.reports.benchmark import BenchmarkModelResult, BenchmarkResult, FitKind, SetResult
from orthaug.studies.other_packages import measure_beside
from orthaug.studies.public_sets import DECLARED, DEFAULT, PHYSICS, PublicSet, public_sets

VARIABLE = "ORTHAUG_DATA"
"""Environment variable: the folder of the data where `--data` is not given."""
Bar = Callable[[int, int], AbstractContextManager[Progress]]
"""Gives the progress of a fit: called with its runs, and its iterations at most."""


def data_folder(given: Path | None) -> Path:
    """Return the folder of the data: as given, or that of the environment.

    Raises:
        InputError: neither is given, or there is no such folder.
    """
    named = given or (Path(os.environ[VARIABLE]) if os.environ.get(VARIABLE) else None)
    if named is None:
        raise InputError(
            f"the folder of the data is missing: give --data DIR, or set {VARIABLE}. It holds "
            f"the files of the sets, which are {', '.join(public_sets())}; `orthaug benchmark "
            "--list` has their sources."
        )
    if not named.is_dir():
        raise InputError(f"{named}: there is no such folder; --data is the folder of the data.")
    return named


def check_output(folder: Path, data: Path, *, force: bool = False) -> None:
    """Raise InputError where the result could not be written, or would replace the data."""
    check_replaceable(folder, force=force)
    check_kept(folder, data)


def benchmark(
    sets: Sequence[PublicSet],
    folder: Path,
    packages: Sequence[str],
    bar: Bar,
    say: Callable[[str], None],
    *,
    defaults: bool = False,
) -> BenchmarkResult:
    """Measure sets one after another; a set without its files is left out in words.

    Args:
        folder: of the data.
        packages: others that are trained on the same rows.
        say: called with the set and the model before each fit.
        defaults: fit the first model of each set also with nothing chosen beyond its physics.

    Raises:
        InputError: the folder has the files of none of the sets.
    """
    missing = {one.name: one.missing(folder) for one in sets}
    if all(missing.values()):
        raise InputError(
            f"{folder}: holds the files of none of the sets {', '.join(missing)}; "
            f"{next(iter(missing.values()))} was not found. `orthaug benchmark --list` has the "
            "sources."
        )
    results = []
    for one in sets:
        if missing[one.name]:
            text = f"no data: {missing[one.name]} not found in {folder}"
            say(f"{one.name}: {text}")
            results.append(one.result(text))
        else:
            results.append(_measure(one, folder, packages, bar, say, defaults))
    date, machine, versions = surroundings()
    content = {"date": date, "machine": machine, "versions": versions, "sets": results}
    return BenchmarkResult.model_validate(content)


def _measure(
    one: PublicSet,
    folder: Path,
    packages: Sequence[str],
    bar: Bar,
    say: Callable[[str], None],
    defaults: bool,
) -> SetResult:
    """Fit every model of a set as declared and without a learner, the first by defaults, too."""
    models, job = [], None
    for name in one.models:
        for kind, opened, variant in _fits(one, name, folder, defaults and name == one.models[0]):
            say(f"{one.name}: {name}, {kind}, {len(opened.train.record)} rows")
            job = job or opened
            with bar(opened.run_count, opened.iterations) as progress:
                began = time.monotonic()
                fitted = fit_variant(opened, variant, progress)
                seconds = time.monotonic() - began
            models.append(_model(one, name, kind, fitted, seconds))
            say(f"{one.name}: {name}, {kind}, done: {models[-1].in_words}")
    assert job is not None  # every set declares a model
    beside = []
    tests = {_name(part.name): (part.record, part.skip) for part in job.tests}
    for package in packages:
        say(f"{one.name}: {package}")
        beside.append(measure_beside(package, one, job.train.record, tests))
    return one.result(data=job.data, models=models, beside=beside)


def _fits(
    one: PublicSet, name: str, folder: Path, default: bool
) -> Iterator[tuple[FitKind, Job, Variant]]:
    declared = _open(one, name, folder)
    if declared.spec.declared_learner() is not None:  # otherwise as declared is physics alone
        yield PHYSICS, declared, Variant(PHYSICS_ONLY)
    if default:
        yield DEFAULT, _open(one, name, folder, default=True), AS_DECLARED
    yield DECLARED, declared, AS_DECLARED


def _open(one: PublicSet, name: str, folder: Path, *, default: bool = False) -> Job:
    """Return the job of a model; the spec is a file of the folder in messages only."""
    path = folder / f"{one.name}-{name}.toml"
    content = one.spec(name, default=default)
    return open_spec(path, spec_model().model_validate(content, context={"folder": folder}))


def _model(
    one: PublicSet, name: str, kind: FitKind, fitted: FitReport, seconds: float
) -> BenchmarkModelResult:
    fit, result, job = fitted.fit, fitted.result, fitted.job
    errors = [
        error
        for part in (job.tests if fit.status.ok else ())
        for error in one.errors_of(
            _name(part.name),
            job.train.record.outputs,
            _scored(result, part.name, len(job.train.record.outputs)),
        )
    ]
    named = result.physical_parameters if job.problem.linear else result.parameters
    return BenchmarkModelResult(
        model=name,
        fit=kind,
        status=result.status.code,
        errors=errors,
        unknowns=len(fit.model.theta) + fit.model.form.bound.size,
        seconds=seconds,
        parameters=named or [],
        warnings=[warning.code for warning in result.warnings],
        error=None if fit.status.ok else result.status.message,
    )


def _scored(result: Any, part: str, outputs: int) -> Sequence[float | None]:
    """Return the RMSE of the free run, None for every output where it diverged."""
    return result.scores[part].simulation.rmse or [None] * outputs


def _name(part: str) -> str:
    return part.removeprefix("tests.")


def write(result: BenchmarkResult, folder: Path, data: Path, *, force: bool = False) -> None:
    """Write benchmark.json, figures/benchmark.png and the specs, whole or not at all."""
    import tomlkit

    from orthaug.reports.drawing import save
    from orthaug.studies.benchmark_figure import benchmark_figure

    with whole_folder(folder, force=force) as partial:
        (partial / "benchmark.json").write_text(result.to_json() + "\n", encoding="utf-8")
        (partial / "figures").mkdir()
        (partial / "specs").mkdir()
        measured = [one for one in result.sets if one.models]
        save(benchmark_figure(measured), partial / "figures" / "benchmark.png")
        for found in measured:
            one = public_sets()[found.name]
            for name in one.models:
                spec = one.spec(name, folder=data.resolve())
                place = partial / "specs" / f"{one.name}-{name}.toml"
                place.write_text(tomlkit.dumps(spec), encoding="utf-8")
