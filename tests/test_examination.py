"""`Estimate.diagnose`: from Python it says what `orthaug fit` says, code for code and number for number."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compare_results import RELATIVE, differences
from test_cli import run
from test_golden import FOLDER, asked, lasting

import orthaug as oa
from orthaug.reports.result import FitResult

GOLDEN = (
    "lagged_bounds",
    "lagged_default",
    "lagged_experiments",
    "lagged_noise_auto",
    "lagged_physical",
    "lagged_physics",
    "lagged_suspects",
    "lagged_terms",
    "motion_discrete",
    "motion_physics",
)
SLOW = (
    "lagged_additive",
    "lagged_free_run",
    "lagged_two_outputs",
    "lagged_uniform",
    "motion_default",
    "motion_suspects",
    "motion_two_outputs",
)
OF_SPECS = {"spec", "data", "advice", "advice_trials"}
"""What a result has of its spec alone."""


def estimated(job: Any) -> Any:
    """Return the fit of a spec's data and declarations, by `estimate`."""
    spec, training, physics = job.spec, job.spec.training, job.problem.physics
    moves = spec.motion is not None
    options: dict[str, Any] = {} if moves else {"ensemble": training.ensemble}
    options |= {} if spec.noise.model == "white" else {"noise": spec.noise.declared}
    learner = spec.declared_learner()
    if not moves and learner is not None:
        options["lags"] = spec.lag_orders()
    blocks = spec.validation.blocks
    return oa.estimate(
        job.train.record,
        job.physics.motion if moves else physics,
        learner=learner,
        structure=job.structure,
        criterion=spec.declared_criterion(),
        solver=spec.declared_solver(),
        regularization=training.regularization,
        restarts=training.restarts,
        seed=training.seed,
        blocks=4 if blocks is None else blocks,
        fallback=training.fallback,
        validation=None if job.validation is None else job.validation.record,
        output_weights=training.output_weights,
        **options,
    )


def diagnosed(job: Any) -> Any:
    """Return what is found on that fit, by the same tests and suspects."""
    section = job.spec.physics
    return estimated(job).diagnose(
        tests={part.name.removeprefix("tests."): part.record for part in job.tests},
        suspects=job.physics.suspects,
        physics=job.physics.map,
        profiles=section is not None and section.profile,
        blocks=job.spec.validation.blocks,
        skip=max((part.skip for part in job.tests), default=0),
    )


@pytest.mark.parametrize(
    "name", [*GOLDEN, *(pytest.param(name, marks=pytest.mark.proof) for name in SLOW)]
)
@pytest.mark.usefixtures("golden_folder")
def test_a_fit_in_python_is_judged_as_the_command_judges_it(name: str) -> None:
    spec = FOLDER / f"{name}.toml"
    Path(spec.name).write_bytes(spec.read_bytes())
    stored = json.loads(spec.with_suffix(".json").read_text(encoding="utf-8"))["fit"]
    kept = lasting({key: value for key, value in stored.items() if key not in OF_SPECS})
    found = lasting(diagnosed(oa.load_spec(spec.name)).content())
    within = [float(line.split()[1]) for line in asked(spec) if line.startswith("within")]
    relative = within[0] if within else RELATIVE
    differing = list(differences(kept, found, relative=relative, floor=relative))
    assert not differing, "\n".join(map(str, differing[:10]))


@pytest.mark.usefixtures("without_figures")
def test_the_fit_of_the_demo_in_python_says_what_the_command_says(tmp_path: Path) -> None:
    assert run("demo", "--out", str(tmp_path / "demo")).code == 0
    written = json.loads((tmp_path / "demo" / "result.json").read_text(encoding="utf-8"))
    found = diagnosed(oa.load_spec(tmp_path / "demo" / "spec.toml"))
    shown = found.content()
    assert set(written) - set(shown) == OF_SPECS | {"schema", "orthaug"}
    assert shown["warnings"] == written["warnings"]
    assert shown["validation"] == written["validation"]
    assert shown["residuals"]["text"] == written["residuals"]["text"]
    kept = lasting({key: value for key, value in written.items() if key not in OF_SPECS})
    assert not list(differences(kept, lasting(shown), relative=RELATIVE, floor=RELATIVE))
    printed = str(found)
    assert max(map(len, printed.splitlines())) <= 80
    assert found.verdict == FitResult.model_validate(written).verdict
    assert " ".join(printed.split()).endswith(f"Verdict: {found.verdict}")
    for row in found.parameters:
        assert f"\n{row.name} " in printed
    for warning in found.warnings:
        assert warning.text.split(":")[0][:40] in printed.replace("\n  ", " ")
    html = found._repr_html_()
    assert html is not None and all(row.name in html for row in found.parameters)


def gain_fit(learner: Any = None, **options: Any) -> Any:
    """Return a fit of a gain to a cubic curve."""
    u = np.random.default_rng(0).uniform(-1, 1, 300)
    noise = 0.05 * np.random.default_rng(1).normal(size=300)
    record = oa.Record.from_arrays(u, 2 * u + u**3 + noise)
    gain = oa.Baseline.from_terms([oa.Term("gain", "u[k]")])
    return oa.estimate(record, gain, learner=learner, **options)


def test_suspects_and_tests_are_those_of_the_call() -> None:
    fit = gain_fit(oa.Terms(("u[k]**3",)))
    test = fit.problem.record
    found = fit.diagnose(tests={"again": test}, suspects=[oa.Suspect("cubic", "u[k]**3")])
    assert list(found.scores) == ["train", "tests.again"]
    assert [entry.name for entry in found.bias] == ["cubic"]
    assert [trial.where for trial in found.validation.trials] == ["tests.again"]
    assert fit.diagnose(blocks=0).validation is None
    blocks = fit.diagnose(blocks=3).validation.trials
    assert [trial.where for trial in blocks] == [f"block {i} of 3" for i in (1, 2, 3)]


def test_the_record_that_chose_is_scored_too() -> None:
    record = gain_fit().problem.record
    found = gain_fit(oa.MLP(hidden=(2,)), validation=record, restarts=2).diagnose()
    assert list(found.scores) == ["train", "validation"]
    assert [trial.where for trial in found.validation.trials] == ["validation"]


def test_a_model_that_was_trained_elsewhere_is_judged_by_its_tests_only() -> None:
    record = gain_fit().problem.record
    gain = oa.Baseline.from_terms([oa.Term("gain", "u[k]")])
    fit = oa.orthogonalize(record, gain, lambda x: 2 * x + x**3)
    assert "not_judged" in [warning.code for warning in fit.diagnose().warnings]
    found = fit.diagnose(tests={"again": record}).validation
    assert found.verdict == "helps" and [t.where for t in found.trials] == ["tests.again"]


def test_a_split_under_another_measure_is_judged_under_it() -> None:
    fit = gain_fit(oa.Terms(("u[k]**3",)), structure=oa.Orthogonal(shared="all"))
    under = fit.split(oa.Uniform({"u[k]": (-0.5, 0.5)})).diagnose(blocks=0)
    plain = fit.diagnose(blocks=0)
    assert under.measure == "uniform" and under.measure_detail is not None
    assert under.parameters[0].value != pytest.approx(plain.parameters[0].value, rel=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tests": [1]}, "`tests` must be records by their names"),
        ({"suspects": ["cubic"]}, "`suspects` must be a list of Suspects"),
        ({"physics": "m"}, "`physics` must be a PhysicsMap, or None"),
        ({"validation": 3}, "`validation` must be a Record, or None"),
        ({"skip": -1}, "`skip` must be"),
        ({"blocks": 1}, "`blocks` must be"),
    ],
)
def test_what_a_fit_cannot_be_judged_by(options: dict[str, Any], message: str) -> None:
    with pytest.raises(oa.InputError, match=message):
        gain_fit().diagnose(**options)


def test_findings_read_from_a_file_have_no_fit() -> None:
    found = gain_fit().diagnose()
    assert found.fit.std_kind == "hc3" or found.fit.std is not None
    read = type(found).from_json(found.to_json())
    assert read.fit is None and read._repr_html_() is None
    assert str(read) == repr(found) == repr(read)
    assert "residual unmodelled" in repr(found) and "unexplained" in repr(found)
