"""Outputs that are missing on some rows: a motion runs through them, and scores what was measured."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from scipy.optimize import least_squares
from test_cli import finite_json, one_line, run

import orthaug as oa
from orthaug.data.gaps import complete_record, held_rows, regular_rows
from orthaug.data.wild import data_warnings

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

STEP = 0.05
TRUE = {"tau": 0.8, "gain": 2.0}


def lag(tau, gain, u, start=0.0):
    """The exact response of a first-order lag to a held input."""
    a = np.exp(-STEP / tau)
    x = np.empty(len(u))
    x[0] = start
    for k in range(len(u) - 1):
        x[k + 1] = a * x[k] + (1 - a) * gain * u[k]
    return x


def signals(rows=400, seed=2, noise=0.02):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=rows // 8 + 1), 8)[:rows]
    return u, lag(**TRUE, u=u) + noise * rng.normal(size=rows), rng


def motion(outputs=("y",)):
    return oa.Motion.from_equations(
        states=[oa.State("x", "(gain*u - x)/tau", start="y")],
        outputs=[oa.Output(name, "x") for name in outputs],
        inputs=["u"],
        parameters=[
            oa.PhysicalParameter("tau", initial=1.5, min=0),
            oa.PhysicalParameter("gain", initial=1.0),
        ],
        integrator="exact",
    )


def fitted(record, **options):
    fit = oa.estimate(
        record, motion(tuple(c.name for c in record.outputs)), learner=None, **options
    )
    assert fit.status.ok
    return fit, fit.problem.values_at(fit.theta)


def by_scipy(u, columns):
    """The fit of tau, gain and the start to every measured sample."""

    def errors(p):
        x = lag(p[0], p[1], u, p[2])
        return np.concatenate([(x - y)[~np.isnan(y)] for y in columns])

    return least_squares(errors, [1.0, 1.5, 0.0], xtol=1e-14, ftol=1e-14).x


@pytest.mark.parametrize("every", [5, "random", "begin"])
def test_the_estimate_is_that_of_the_measured_samples(every):
    u, y, rng = signals()
    lost = {
        5: np.arange(400) % 5 != 0,
        "random": rng.uniform(size=400) < 0.6,
        "begin": np.arange(400) < 30,
    }[every]
    y = np.where(lost, np.nan, y)
    record = oa.Record.from_arrays(u, y, sampling_time=STEP, missing="keep")
    assert f"outputs: y ({lost.sum()} missing)" in repr(record)
    fit, values = fitted(record)
    np.testing.assert_allclose(values, by_scipy(u, [y])[:2], rtol=1e-6)
    measured = ~lost
    run = fit.model.simulate(record)
    errors = y[measured] - run.model[measured, 0]
    assert run.scores().samples == measured.sum()
    np.testing.assert_allclose(run.scores().rmse, np.sqrt(np.mean(errors**2)), rtol=1e-12)


def test_two_sensors_of_unequal_rates():
    u, y, rng = signals()
    slow = lag(**TRUE, u=u) + 0.02 * rng.normal(size=400)
    columns = [np.where(rng.uniform(size=400) < 0.1, np.nan, y), slow.copy()]
    columns[1][np.arange(400) % 4 != 1] = np.nan
    record = oa.Record.from_arrays(
        u, np.stack(columns, axis=1), sampling_time=STEP, outputs=["y", "slow"], missing="keep"
    )
    _, values = fitted(record, output_weights=(1.0, 1.0))
    np.testing.assert_allclose(values, by_scipy(u, columns)[:2], rtol=1e-6)


def test_standard_errors_count_what_was_measured():
    u, y, _ = signals(rows=2000, seed=3)
    whole, _ = fitted(oa.Record.from_arrays(u, y, sampling_time=STEP))
    thin = np.where(np.arange(2000) % 4 == 0, y, np.nan)
    part, _ = fitted(oa.Record.from_arrays(u, thin, sampling_time=STEP, missing="keep"))
    np.testing.assert_allclose(part.std / whole.std, 2.0, rtol=0.15)


@pytest.mark.proof
def test_intervals_hold_between_gaps():
    held = 0
    for seed in range(60):
        u, y, rng = signals(rows=300, seed=seed)
        y = np.where(rng.uniform(size=300) < 0.7, np.nan, y)
        fit, values = fitted(oa.Record.from_arrays(u, y, sampling_time=STEP, missing="keep"))
        held += int(np.all(np.abs(values - [*TRUE.values()]) < 2.5 * fit.std))
    assert held >= 54


def test_the_diagnosis_reads_the_measured_rows():
    u, y, _ = signals(rows=1500, seed=1)
    y = np.where(np.arange(1500) % 3 == 0, y, np.nan)
    fit, _ = fitted(oa.Record.from_arrays(u, y, sampling_time=STEP, missing="keep"))
    assert fit.diagnose().residuals.verdict == "white"
    bent = y + 0.3 * y**2
    fit, _ = fitted(oa.Record.from_arrays(u, bent, sampling_time=STEP, missing="keep"))
    assert fit.diagnose().residuals.verdict == "unmodelled"


def test_the_diagnosis_has_the_errors_of_the_scores():
    """Of two sensors that miss each other's rows it had those of the rows with both."""
    u, y, rng = signals(rows=600)
    both = np.column_stack([y, y + 0.05 * rng.normal(size=600)])
    both[np.arange(600) % 3 == 1, 0], both[400:, 1] = np.nan, np.nan
    record = oa.Record.from_arrays(u, both, sampling_time=STEP, missing="keep", outputs=["y", "z"])
    found = fitted(record)[0].diagnose()
    scores = found.scores["train"].simulation.rmse
    assert [test.rms for test in found.residuals.free_run] == pytest.approx(scores)
    text = found.residuals.text
    assert f"{scores[0]:.3g} of y" in text and f"{scores[1]:.3g} of z" in text


def test_what_needs_every_row_says_so():
    u, y, _ = signals()
    y[7] = np.nan
    record = oa.Record.from_arrays(u, y, sampling_time=STEP, missing="keep")
    gain = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
    with pytest.raises(oa.InputError, match=r"row 7: an output is missing.*missing = \"skip\""):
        oa.estimate(record, gain)
    with pytest.raises(oa.InputError, match="row 7: an output is missing"):
        oa.estimate(record, motion(), learner=None, noise="innovations")
    with pytest.raises(oa.InputError, match="'y' has no measured sample"):
        oa.estimate(
            oa.Record.from_arrays(u, np.full(400, np.nan), sampling_time=STEP, missing="keep"),
            motion(),
        )


def test_rows_with_all_outputs():
    there = np.arange(100) % 5 == 2
    assert regular_rows(there) == slice(2, None, 5)
    assert regular_rows(np.random.default_rng(0).uniform(size=100) < 0.3) is None
    y = np.where(there, 1.0 * np.arange(100), np.nan)
    record = oa.Record.from_arrays(np.arange(100.0), y, sampling_time=0.1, missing="keep")
    thin = complete_record(record)
    assert thin is not None and thin.complete and thin.sampling_time == 0.5
    assert thin.experiments[0].where(1) == "row 7"


def test_a_held_output_is_named_and_marked():
    u, y, _ = signals()
    y = np.repeat(y[3::5], 5)[: len(u) - 3]
    y = np.concatenate([y[:1], y[:1], y[:1], y])
    record = oa.Record.from_arrays(u, y, sampling_time=STEP)
    assert held_rows(y) == slice(3, None, 5)
    (warning,) = [w for w in data_warnings(record) if w.code == "held_output"]
    assert "every 5th row only (row 3 and so on)" in warning.text and "0.1 s old" in warning.text
    marked = oa.prepare(record, oa.Repeats(), missing="keep")
    left = np.flatnonzero(~np.isnan(marked.experiments[0].outputs[:, 0]))
    np.testing.assert_array_equal(left[1:], np.arange(8, 400, 5))
    assert held_rows(np.round(np.sin(np.arange(400) / 30), 1)) is None  # coarse, and not held


SPEC = """
[data]
sampling_time = 0.05
missing = "{missing}"
inputs = ["u"]
outputs = ["y"]
train = {{ files = ["run.csv"], rows = [0, 400] }}
tests.last = {{ files = ["run.csv"], rows = [400, 600] }}
[motion]
integrator = "exact"
[motion.states]
x = {{ derivative = "(gain*u - x)/tau", start = "y" }}
[motion.outputs]
y = "x"
[motion.parameters]
tau = {{ initial = 1.5, min = 0 }}
gain = {{ initial = 1.0 }}
[learner]
kind = "none"
"""


@pytest.fixture
def project(tmp_path):
    u, y, _ = signals(rows=600)
    cells = [f"{v:.5f}" if k % 4 == 1 else "" for k, v in enumerate(y)]
    lines = ["u,y", *(f"{a:.5f},{b}" for a, b in zip(u, cells, strict=True))]
    (tmp_path / "run.csv").write_text("\n".join(lines), encoding="utf-8")
    (tmp_path / "spec.toml").write_text(SPEC.format(missing="keep"), encoding="utf-8")
    return tmp_path


def test_the_command_fits_and_reads_further_data(project):
    done = run("fit", project / "spec.toml", "--out", project / "out", "--json")
    assert done.code == 0, done.err
    result = finite_json(done.out)
    values = {row["name"]: row for row in result["parameters"]}
    for name, true in TRUE.items():
        low, high = values[name]["ci95"]
        assert low < true < high
    assert result["residuals"]["verdict"] == "white"
    more = (project / "run.csv", "--missing", "keep", "--out", project / "sim.csv")
    done = run("simulate", project / "out", *more)
    assert done.code == 0 and "free run, 150 rows" in done.out, done
    done = run("explain", project / "out", project / "run.csv")
    assert "Traceback" not in done.err


def test_rows_left_out_around_a_slow_sensor_name_the_way_to_keep_them(project):
    given = SPEC.format(missing="skip")
    (project / "spec.toml").write_text(given, encoding="utf-8")
    wanted = ("the longest stretch between missing samples has 1 row", '`missing = "keep"`')
    one_line(run("check", project / "spec.toml").err, *wanted)
    lagged = given.split("[motion]")[0] + (
        '[[baseline.terms]]\nparameter = "a"\nregressor = "y[k-1]"\n'
    )
    (project / "spec.toml").write_text(lagged, encoding="utf-8")
    err = run("check", project / "spec.toml").err
    assert one_line(err, wanted[0]) and "keep" not in err


def test_lagged_physics_refuses_to_keep(project):
    lagged = SPEC.format(missing="keep").split("[motion]")[0] + (
        '[[baseline.terms]]\nparameter = "a"\nregressor = "y[k-1]"\n'
    )
    (project / "spec.toml").write_text(lagged, encoding="utf-8")
    done = run("check", project / "spec.toml")
    one_line(
        done.err, '`data.missing`: found "keep"; lagged physics needs the outputs of every row'
    )


def test_init_uses_the_rows_of_a_slow_sensor(project):
    made = project / "i.toml"
    done = run("init", project / "run.csv", "--inputs", "u", "--outputs", "y", "--out", made)
    assert done.code == 0 and "one row in 4 has a value of every output" in done.out.replace(
        "\n  ", " "
    )
    data = tomllib.loads(made.read_text(encoding="utf-8"))["data"]
    assert data["train"]["every"] == 4 and data["train"]["rows"][0] == 1
    assert run("fit", made, "--out", project / "o").code == 0


def test_a_limit_that_the_physics_has_is_no_end_of_a_range():
    """A controller's limit in the equations was called that of the sensor, and "wrong parameters"."""
    rng = np.random.default_rng(2)
    u, x, y = np.repeat(rng.uniform(-2, 2, 40), 15), 0.0, []
    for value in u:
        y.append((x, min(max(3 * (value - x), -1.5), 1.5)))
        x += 0.05 * y[-1][1]
    y = np.array(y) + [0.002, 0.0] * rng.normal(size=(600, 2))
    motion = oa.Motion.from_equations(
        states=[oa.State("x", "a*min(max(k*(u - x), -1.5), 1.5)", start="p")],
        outputs=[oa.Output("p", "x"), oa.Output("s", "min(max(k*(u - x), -1.5), 1.5)")],
        inputs=["u"],
        parameters=[oa.PhysicalParameter(n, v, min=0) for n, v in dict(a=0.8, k=2.5).items()],
        substeps=1,
    )
    record = oa.Record.from_arrays(u, y, sampling_time=0.05, outputs=["p", "s"], inputs=["u"])
    assert "saturated_output" in {w.code for w in data_warnings(record)}
    assert "saturated_output" not in {w.code for w in data_warnings(record, limited=["s"])}
    found = oa.estimate(record, motion, learner=None).diagnose()
    assert found.scores["train"].simulation.nrmse[1] < 0.2
    assert "saturated_output" not in {w.code for w in found.warnings}


def test_a_sensor_whose_range_ends_is_named_and_its_samples_are_marked():
    u, y, _ = signals(rows=1000)
    high = float(np.quantile(y, 0.85))
    record = oa.Record.from_arrays(u, np.minimum(y, high), sampling_time=STEP)
    (warning,) = [w for w in data_warnings(record) if w.code == "saturated_output"]
    assert "on 15 % of the rows" in warning.text and f"`high` = {high:.6g}" in warning.text
    assert not [
        w
        for w in data_warnings(oa.Record.from_arrays(u, np.round(y, 1), sampling_time=STEP))
        if w.code == "saturated_output"
    ]
    sensor, cut = fitted(record)
    assert "saturated_output" in {w.code for w in sensor.diagnose().warnings}
    marked = oa.prepare(record, oa.Limits(high=high), missing="keep")
    assert marked.prepared[0].samples == 150
    _, values = fitted(marked)
    true = np.array([*TRUE.values()])
    assert np.all(np.abs(values / true - 1) < 0.05) and np.abs(cut / true - 1).max() > 0.05
    with pytest.raises(oa.InputError, match="neither `low` nor `high`"):
        oa.Limits()
    with pytest.raises(oa.InputError, match="`high`|high"):
        oa.Limits(high=float("nan"))
    assert oa.Limits(low=-5.0).low == -5
