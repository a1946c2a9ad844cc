"""A wrong sample that gets into training is named."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import scipy.signal
from test_cli import run

import orthaug as oa
from orthaug.analysis.wild_rows import _marking
from orthaug.data import Outliers, prepare

pytestmark = pytest.mark.usefixtures("without_figures")


def warned(wrong: float, at: int = 150) -> list[str]:
    rng = np.random.default_rng(1)
    u = rng.normal(size=400)
    y = scipy.signal.lfilter([0, 0.2], [1, -0.8], u) + scipy.signal.lfilter(
        [1], [1, -0.8], 0.01 * rng.standard_t(5, 400)
    )
    y[at] += wrong
    record = oa.Record.from_arrays(u, y, sampling_time=0.1)
    baseline = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
    found = oa.diagnose(oa.estimate(record, baseline, learner=None))
    assert found is not None
    return [warning.text for warning in found.warnings if warning.code == "wild_rows"]


@pytest.mark.parametrize("at", [150, 399])
def test_a_wrong_sample_in_training_is_named(at):
    (text,) = warned(5.0, at)
    assert f"row {at}" in text and 'step = "outliers"' in text


def test_spikes_of_a_sensor_are_named_by_the_free_run():
    """Each is in three rows of the one-step residual, and those are too many to be few."""
    rng = np.random.default_rng(2)
    u = rng.normal(size=1500)
    y = scipy.signal.lfilter([0, 0.2], [1, -1.4, 0.6], u) + 0.02 * rng.normal(size=1500)
    at = np.sort(rng.choice(1500, 15, replace=False))
    y[at] += rng.choice([-1, 1], 15)
    baseline = oa.Baseline.from_terms(
        [oa.Term("a1", "y[k-1]"), oa.Term("a2", "y[k-2]"), oa.Term("b", "u[k-1]")]
    )
    record = oa.Record.from_arrays(u, y, sampling_time=0.1)
    fit = oa.estimate(record, baseline, learner=None, criterion=oa.Simulation())
    (text,) = (w.text for w in oa.diagnose(fit).warnings if w.code == "wild_rows")
    assert text.startswith("15 rows of 1498 make up") and f": row {at[0]};" in text


def test_the_advice_names_a_threshold_where_the_default_marks_few():
    """Beside a steep signal wrong samples are only a few deviations of their window off."""
    random, t = np.random.default_rng(5), np.arange(1000)
    y, at = np.sin(t / 8) + 1e-3 * random.normal(size=1000), np.arange(20, 980, 40)
    y[at] += np.where(np.arange(len(at)) % 6, 0.9, 40.0)
    record = oa.Record.from_arrays(u=np.zeros(1000), y=y, sampling_time=0.1)
    rows = [(0, int(row)) for row in at]
    first, step = _marking(record, 0, rows)
    found = re.search(r"threshold = ([\d.]+), which marks (\d+) of these rows", first)
    assert found and float(found[1]) < 4 and int(found[2]) > 15
    assert "; the default of 4 marks 11. Or" in first
    assert step == {
        "step": "outliers",
        "channels": ["y"],
        "window": 5,
        "threshold": float(found[1]),
    }
    marked = prepare(record, Outliers(), missing="keep")
    (experiment,) = marked.experiments
    left = [row for row in rows if np.isfinite(experiment.outputs[row[1], 0])]
    again = _marking(marked, 0, left)[0]
    assert again.startswith('give the step "outliers" threshold = ') and "instead of 4" in again
    hidden = [(0, row) for row in (100, 200, 300)]  # samples as all others
    assert "does not separate them from the signal" in _marking(marked, 0, hidden)[0]


def test_heavy_tails_alone_are_none():
    assert warned(0.0) == []


SPEC = """
[data]
sampling_time = 0.1
inputs = ["u"]
outputs = ["y"]
{missing}
[data.train]
files = ["run.csv"]
{prepare}
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
[[baseline.terms]]
parameter = "b"
regressor = "u[k-1]"
[learner]
kind = "none"
"""
MOTION = """
[data]
sampling_time = 0.1
inputs = ["u"]
outputs = ["y"]
{missing}
[data.train]
files = ["run.csv"]
{prepare}
[motion.states]
x = {{ derivative = "(g*u - x)/tau", start = "y" }}
[motion.outputs]
y = "x"
[motion.parameters]
tau = {{ initial = 0.2, min = 0 }}
g = {{ initial = 0.8 }}
"""


def measured(folder, wrong: str = "", shape: str = "noise") -> None:
    """A first-order system of 400 rows, `wrong` with the channel of a cell of 1e6 in row 200."""
    rng = np.random.default_rng(3)
    u = {
        "noise": rng.normal(size=400),
        "steps": np.repeat(rng.normal(size=20), 20),
        "hammer": np.zeros(400),
    }[shape]
    if shape == "hammer":
        u[[60, 170, 290]] = [40.0, 55.0, 30.0]
    heavy = 0.02 * rng.standard_t(4, 400)
    y = scipy.signal.lfilter([0, 0.3], [1, -0.7], u) + heavy
    cells = {"u": u, "y": y}
    if wrong == "twice":
        cells = {name: np.repeat(column, 2) for name, column in cells.items()}
    elif wrong == "again":
        cells = {
            name: np.insert(column, [101, 251], column[[100, 250]])
            for name, column in cells.items()
        }
    elif wrong == "coarse":  # many rows repeat the one before by chance
        cells["y"] = np.round(y, 1)
        cells["u"] = np.repeat(u[::8], 8)
    elif wrong == "frozen":
        y[100:160] = y[100]
    elif wrong:
        cells[wrong][200] = 1e6
    np.savetxt(
        folder / "run.csv",
        np.column_stack(list(cells.values())),
        delimiter=",",
        header="u,y",
        comments="",
    )


def told(
    folder, spec: str, *, command: str = "check", prepare: str = "", missing: str = ""
) -> dict:
    """The result of a command on the spec."""
    (folder / "spec.toml").write_text(spec.format(prepare=prepare, missing=missing))
    options = ["--out", str(folder / "out"), "--force"] if command == "fit" else []
    done = run(command, folder / "spec.toml", "--json", *options)
    assert done.code == 0, done.err
    return json.loads(done.out)


def text_of(result: dict, code: str) -> str:
    return " ".join(warning["text"] for warning in result["warnings"] if warning["code"] == code)


@pytest.mark.parametrize("spec", [SPEC, MOTION], ids=["lagged", "motion"])
@pytest.mark.parametrize("channel", ["u", "y"])
def test_a_wild_cell_is_named_before_the_fit_and_its_remedy_works(tmp_path, spec, channel):
    measured(tmp_path, channel)
    (tmp_path / "spec.toml").write_text(spec.format(prepare="", missing=""))
    # Of a motion it is refused where its run goes beyond numbers
    done = run("check", tmp_path / "spec.toml", "--json")
    text = text_of(json.loads(done.out), "wild_samples") if done.code == 0 else done.err
    assert (
        "run.csv" in text
        and "row 200" in text
        and f"{channel} = 1e+06" in text
        and "[[data.prepare]]" in text
    )
    threshold = re.search(r"threshold = ([\d.e+]*\d)", text)
    assert threshold is not None
    step = f'[[data.prepare]]\nstep = "outliers"\nchannels = ["{channel}"]\nthreshold = {threshold[1]}\n'
    if spec == SPEC:
        assert "Without it physics alone gives" in text
    mended = told(tmp_path, spec, command="fit", prepare=step, missing='missing = "skip"')
    assert not text_of(mended, "wild_samples")
    values = {row["name"]: row["value"] for row in mended["parameters"]}
    expected = {"a": 0.7, "b": 0.3} if spec == SPEC else {"tau": 0.1 / np.log(1 / 0.7), "g": 1.0}
    for name, value in expected.items():
        assert values[name] == pytest.approx(value, rel=0.05)


def test_a_fit_names_a_wild_cell_too(tmp_path):
    measured(tmp_path, "u")
    assert "u = 1e+06" in text_of(told(tmp_path, SPEC, command="fit"), "wild_samples")


def test_init_names_a_wild_input(tmp_path):
    measured(tmp_path, "u")
    done = run("init", tmp_path / "run.csv", "--sampling-time", "0.1", "--out", tmp_path / "s.toml")
    assert done.code == 0 and "u = 1e+06" in " ".join((done.out + done.err).split())


@pytest.mark.parametrize("shape", ["noise", "steps", "hammer"])
def test_heavy_tails_steps_and_impulses_are_no_wild_samples(tmp_path, shape):
    measured(tmp_path, shape=shape)
    codes = {warning["code"] for warning in told(tmp_path, SPEC)["warnings"]}
    assert not codes & {"wild_samples", "rows_twice", "frozen_output", "repeated_rows"}


def test_rows_of_a_coarse_output_repeat_by_chance(tmp_path):
    measured(tmp_path, "coarse")
    assert not text_of(told(tmp_path, SPEC), "repeated_rows")


def test_rows_of_a_long_record_in_fine_steps_repeat_by_chance(tmp_path):
    rng = np.random.default_rng(4)
    u = np.repeat(100 * rng.normal(size=100), 300)
    y = scipy.signal.lfilter([0, 0.01], [1, -0.99], u) + 0.01 * rng.normal(size=len(u))
    cells = np.round(np.column_stack([u, y]), 3)
    assert np.ptp(cells[:, 1]) > 1e5 * 0.001
    assert (np.diff(cells, axis=0) == 0).all(axis=1).sum() > 20
    np.savetxt(tmp_path / "run.csv", cells, delimiter=",", header="u,y", comments="")
    assert not text_of(told(tmp_path, SPEC), "repeated_rows")


def test_single_rows_that_were_written_twice_are_named(tmp_path):
    measured(tmp_path, "again")
    text = text_of(told(tmp_path, SPEC), "repeated_rows")
    assert "row 101" in text and "row 252" in text and "too late" in text


@pytest.mark.parametrize(("wrong", "code"), [("twice", "rows_twice"), ("frozen", "frozen_output")])
def test_rows_written_twice_and_a_frozen_sensor_are_named(tmp_path, wrong, code):
    measured(tmp_path, wrong)
    text = text_of(told(tmp_path, SPEC), code)
    assert "run.csv" in text and ("every = 2" in text or "row 100" in text)


def test_a_sensor_at_its_limit_is_not_frozen(tmp_path):
    """It comes to the limit and leaves it gradually; a value that jumps at the end was frozen."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=10), 40)
    y = scipy.signal.lfilter([0, 0.1], [1, -0.9], u) + 0.002 * rng.normal(size=400)
    limited = np.minimum(y, np.percentile(y, 94))
    frozen = np.where(np.abs(np.arange(400) - 115) < 15, y.max() + 0.5, y)
    steep = np.minimum(np.exp(4 * y), np.exp(4 * np.percentile(y, 94)))
    for cells, is_frozen in ((limited, False), (steep, False), (frozen, True)):
        table = np.column_stack([u, cells])
        np.savetxt(tmp_path / "run.csv", table, delimiter=",", header="u,y", comments="")
        found = {warning["code"] for warning in told(tmp_path, SPEC)["warnings"]}
        assert ("frozen_output" in found) == is_frozen
        assert is_frozen or "saturated_output" in found
