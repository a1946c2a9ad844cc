"""Specs fitted and compared, verdicts and figures from Python."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from test_cli import make_project, run, signals, write_csv
from test_compare import STARTED

import orthaug as oa
from orthaug import InputError

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    return oa.load_spec(
        make_project(tmp_path_factory.mktemp("library"), STARTED + "[validation]\nblocks = 0\n")
    )


@pytest.fixture(scope="module")
def fitted(job):
    return oa.fit_spec(job, out=job.path.parent / "out")


def test_a_spec_is_fitted_as_the_command_does(job, fitted):
    assert (
        repr(job)
        == "Job(plant.toml: train 120 rows, tests.steps 60 rows; Baseline(a*y[k-1] + b*y[k-2] "
        "+ c*u[k-1]))"
    )
    assert repr(fitted).startswith("Fitted(plant.toml: Estimate(orthogonal, ")
    written = json.loads((job.path.parent / "out" / "result.json").read_text(encoding="utf-8"))
    assert written == json.loads(fitted.result.to_json())
    assert run("fit", job.path, "--out", job.path.parent / "again").out.startswith(
        fitted.summary()[:60]
    )
    assert (oa.load(job.path.parent / "out").theta == fitted.fit.theta).all()


def test_structures_are_compared(job, fitted):
    found = oa.compare(job, models=[job.path.parent / "out"])
    assert found.fitted.keys() == {
        "physics alone",
        "additive",
        "orthogonal",
        "orthogonal-penalty",
        "baseline-penalty",
    }
    assert found.result.comparison[-1].name.endswith("out")
    np.testing.assert_array_equal(found.fitted["orthogonal"].fit.theta, fitted.fit.theta)
    assert f"orthogonal: {found.verdicts['orthogonal'].code}" in repr(found)
    assert "free-run NRMSE" in found.summary() and oa.plot(found.result).axes

    alone = oa.estimate(job.train.record, job.problem.baseline, learner=None)
    theirs = found.verdicts["orthogonal"]
    for record in (job.tests[0].record, reordered(job)):
        verdict = oa.verdict(fitted.fit, alone, {"tests.steps": record}, skip=job.tests[0].skip)
        assert verdict.code == theirs.code
        (own,), (other,) = verdict.trials, theirs.trials
        assert (own.alone, own.model) == pytest.approx((other.alone, other.model), rel=1e-9)
    for arguments, message in (
        ((1, alone, job.tests[0].record), "`fit` must be an Estimate; got 1"),
        ((fitted.fit, alone, {}), "`tests` is empty; give a record that was not fitted"),
        ((fitted.fit, alone, {"x": 3}), r"`tests\['x'\]` must be a Record; got 3"),
    ):
        with pytest.raises(InputError, match=message):
            oa.verdict(*arguments)


def reordered(job) -> oa.Record:
    """The test record with an input more, before the model's own."""
    u, y = signals(60, 2)
    return oa.Record.from_arrays(
        np.stack([0 * u, u], 1),
        y,
        sampling_time=job.train.record.sampling_time,
        inputs=["other", "u"],
    )


def test_figures(fitted, tmp_path):
    record = fitted.job.train.record
    response = fitted.fit.model.simulate(record)
    for kind in ("output", "residual", "components"):
        assert oa.plot(response, kind, path=tmp_path / f"{kind}.png").axes
        assert (tmp_path / f"{kind}.png").read_bytes().startswith(b"\x89PNG")
    unmeasured = oa.Record.from_arrays(u=np.ones(9), sampling_time=record.sampling_time)
    for arguments, options, message in (
        ((record,), {}, "`what` must be a Response, such as model.simulate"),
        (
            (response, "outputs"),
            {},
            "`kind` must be one of output, residual, components; got 'outputs'",
        ),
        ((response,), {"path": "x.xyz"}, "x.xyz: figures are written as PNG"),
        ((response,), {"path": tmp_path / "absent" / "x.png"}, "cannot be written"),
        (
            (fitted.fit.model.simulate(unmeasured, initial="zero"), "residual"),
            {},
            "were not measured; it has no residual",
        ),
    ):
        with pytest.raises(InputError, match=message):
            oa.plot(*arguments, **options)


def test_what_cannot_be_opened_or_written(job, tmp_path):
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "notes.txt").write_text("mine")
    for call, message in (
        (lambda: oa.load_spec(3), "`path` must be the name of a spec file; got 3"),  # type: ignore[arg-type]
        (lambda: oa.load_spec(os.fspath(tmp_path / "absent.toml")), "absent.toml: no such file"),
        (lambda: oa.fit_spec(job, out=3), "`out` must be the name of a folder, or None; got 3"),  # type: ignore[arg-type]
        (
            lambda: oa.fit_spec(job, out=tmp_path / "notes"),
            "notes: holds notes.txt and no manifest.json",
        ),
        (lambda: oa.compare(job, models="x"), "`models` must be a list of folders"),
        (lambda: oa.compare(job, models=[Path("absent")]), "absent: no saved model there"),
    ):
        with pytest.raises(InputError, match=message):
            call()


@pytest.mark.parametrize(
    ("wave", "noise", "verdict", "told"),
    [
        (
            0.06,
            0.5,
            "no_help",
            "without improving the free run",
        ),  # noise hides on the test part what was learned
        (0.0, 0.5, "no_help", None),
        (0.3, 0.0, "helps", "no suspect explains half of what the learner found"),
    ],
)
def test_what_a_learner_may_have_taken_is_reported_where_no_cause_is_known(
    tmp_path, wave, noise, verdict, told
):
    u = np.random.default_rng(0).uniform(-1, 1, 900)
    y = 2 * u + wave * np.sin(12 * u) + 0.02 * np.random.default_rng(1).normal(size=900)
    y[600:] += noise * np.random.default_rng(2).normal(size=300)
    write_csv(tmp_path / "run.csv", u=u, y=y)
    (tmp_path / "static.toml").write_text(
        '[data]\ninputs = ["u"]\noutputs = ["y"]\nsampling_time = 1\n'
        'train = { files = ["run.csv"], rows = [0, 600] }\ntests.rest = { files = ["run.csv"], rows = [600, 900] }\n'
        '[[baseline.terms]]\nparameter = "gain"\nregressor = "u[k]"\n[learner]\nhidden = [8]\n'
    )
    result = oa.fit_spec(tmp_path / "static.toml").result
    assert result.validation and result.residuals
    assert (result.validation.verdict, result.residuals.verdict) == (verdict, "white")
    assert "the intervals hold" not in result.residuals.text
    texts = [warning.text for warning in result.warnings if warning.code == "unexplained"]
    assert len(texts) == bool(told) and all(
        told in text and "belong to gain" in text for text in texts
    )
