"""Records with uneven instants: motions step from each to the next, all else says that it cannot."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lsim
from test_cli import run

import orthaug as oa

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

TRUE = {"m": 1.0, "c": 0.6, "k": 12.0}
SPEC = """
[data]
time = "t"
inputs = ["u"]
outputs = ["y"]
train = {{ files = ["run.csv"], rows = [0, 600] }}
[data.tests.rest]
files = ["run.csv"]
rows = [600, 900]
{physics}
[learner]
kind = "none"
[training]
segment = 0
"""
MOTION = """
[motion.states]
x = { derivative = "v", start = "y" }
v = { derivative = "(u - c*v - k*x)/m", start = "derivative of y" }
[motion.outputs]
y = "x"
[motion.parameters]
m = { initial = 1.3, min = 0 }
c = { initial = 0.3, min = 0 }
k = { initial = 9.0, min = 0 }
"""
LAGGED = '[baseline]\nterms = [{ parameter = "a", regressor = "y[k-1]" }, { parameter = "b", regressor = "u[k-1]" }]'


def drawn(rows=900, seed=0, noise=0.002):
    """Instants, held inputs and measured positions; the truth by matrix exponentials."""
    rng = np.random.default_rng(seed)
    steps = rng.choice([0.02, 0.03, 0.05, 0.08], size=rows)
    t, u = np.cumsum(steps) - steps[0] + 7.0, np.repeat(rng.normal(size=rows // 6 + 1), 6)[:rows]
    m, c, k = TRUE.values()
    block = np.array([[0, 1, 0], [-k / m, -c / m, 1 / m], [0, 0, 0]])
    through = {h: expm(block * h) for h in (0.02, 0.03, 0.05, 0.08)}
    x, y = np.zeros(2), np.zeros(rows)
    for i in range(rows):
        y[i] = x[0]
        following = through[float(steps[i + 1])] if i + 1 < rows else np.eye(3)
        x = (following @ [*x, u[i]])[:2]
    return t, u, y + noise * rng.normal(size=rows)


def motion(**options):
    return oa.Motion.from_equations(
        states=[
            oa.State("x", "v", start="y"),
            oa.State("v", "(u - c*v - k*x)/m", start="derivative of y"),
        ],
        outputs=[oa.Output("y", "x")],
        parameters=[oa.PhysicalParameter(n, v) for n, v in (("m", 1.3), ("c", 0.3), ("k", 9.0))],
        inputs=["u"],
        **options,
    )


def record(**options):
    t, u, y = drawn(**options)
    return oa.Record.from_arrays(u, y, time=t)


@pytest.fixture(scope="module")
def fit():
    return oa.estimate(record(), motion(), learner=None, criterion=oa.Simulation(0, 0))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    t, u, y = drawn()
    rows = "".join(f"{a:.6g},{b:.9g},{c:.9g}\n" for a, b, c in zip(t, u, y, strict=True))
    Path("run.csv").write_text("t,u,y\n" + rows)
    return tmp_path


def test_a_record_keeps_its_instants():
    t, u, y = drawn()
    whole = oa.Record.from_arrays(u, y, time=t)
    assert not whole.even and "on average, uneven" in repr(whole)
    assert whole.sampling_time == pytest.approx(np.diff(t).mean())
    (part,) = whole[100:200].experiments
    np.testing.assert_allclose(part.instants(whole.sampling_time), t[100:200])
    both = oa.Record.join([whole, oa.Record.from_arrays(u, y, sampling_time=0.02)])
    assert [e.steps is None for e in both.experiments] == [False, False]
    np.testing.assert_allclose(np.diff(both.experiments[1].instants(1.0)), 0.02)
    resampled = oa.prepare(whole, oa.Resample())
    assert resampled.even


def test_the_truth_is_within_four_standard_errors(fit):
    np.testing.assert_array_less(np.abs(fit.values - [*TRUE.values()]), 4 * fit.std)
    assert fit.model.simulate(record(seed=5)).scores().rmse[0] < 1.1 * 0.002


def test_without_noise_a_run_is_that_of_the_matrix_exponentials(fit):
    """As even samples of the mean step the same rows are far from it."""
    t, u, y = drawn(seed=1, noise=0.0)
    sure = oa.estimate(
        oa.Record.from_arrays(u, y, time=t),
        motion(substeps=4),
        learner=None,
        criterion=oa.Simulation(0, 0),
    )
    np.testing.assert_allclose(sure.values, [*TRUE.values()], rtol=1e-6)
    run = sure.model.simulate(oa.Record.from_arrays(u, y, time=t))
    assert run.scores().nrmse[0] < 1e-6
    np.testing.assert_allclose(run.to_frame()["time"], t)
    even = sure.model.simulate(oa.Record.from_arrays(u, y, sampling_time=float(np.diff(t).mean())))
    assert even.scores().nrmse[0] > 0.1


@pytest.mark.parametrize(("hold", "fastest"), [("first-order", 1.0), ("spline", 3.0)])
def test_rows_left_out_at_random_change_nothing(hold, fastest):
    """Half of the rows of an even record, whose input is slow enough to be known between them."""
    rng, fine = np.random.default_rng(3), np.arange(12000) * 0.002
    phases = rng.uniform(0, 6, 8)
    u = sum(np.cos(w * fine + p) for w, p in zip(np.linspace(0.3, fastest, 8), phases, strict=True))
    m, c, k = TRUE.values()
    y = lsim(([1], [m, c, k]), u, fine)[1][::10] + 0.002 * rng.normal(size=1200)
    t, u, kept = fine[::10], u[::10], np.sort(rng.choice(1200, 600, replace=False))
    options = {"learner": None, "criterion": oa.Simulation(0, 0)}
    whole = oa.estimate(
        oa.Record.from_arrays(u, y, sampling_time=0.02), motion(hold=hold), **options
    )
    half = oa.estimate(
        oa.Record.from_arrays(u[kept], y[kept], time=t[kept]), motion(hold=hold), **options
    )
    np.testing.assert_array_less(np.abs(half.values - whole.values), 4 * half.std)


def test_from_the_shell(folder):
    Path("spec.toml").write_text(SPEC.format(physics=MOTION))
    done = run("fit", "spec.toml", "--out", "out")
    assert (done.code, "uneven, 0.02 to 0.08 s" in " ".join(done.out.split())) == (0, True)
    found = json.loads(Path("out/result.json").read_text())
    assert "uneven_steps" in [entry["code"] for entry in found["warnings"]]
    assert found["scores"]["tests.rest"]["simulation"]["rmse"][0] < 0.0025
    assert run("simulate", "out", "run.csv", "--out", "sim.csv").code == 0
    table = np.genfromtxt("sim.csv", delimiter=",", names=True)
    np.testing.assert_allclose(table["time"], drawn()[0], atol=1e-4)


@pytest.mark.parametrize(
    ("physics", "words"),
    [
        (LAGGED, "Resample"),
        ('[motion]\nintegrator = "exact"' + MOTION, 'integrator = "exact"'),
        (MOTION.replace("c*v", "c*v*Ts"), "the sampling time Ts"),
    ],
)
def test_what_needs_even_instants_says_so(folder, physics, words):
    Path("spec.toml").write_text(SPEC.format(physics=physics))
    done = run("check", "spec.toml")
    assert done.code == 2 and words in done.err and "esample" in done.err
    assert "Traceback" not in done.err


@pytest.mark.parametrize(
    ("row", "instant", "words"), [(40, 99.0, "a step of"), (40, 1.0, "rising")]
)
def test_a_gap_or_a_fall_is_refused(folder, row, instant, words):
    lines = Path("run.csv").read_text().splitlines()
    lines[row] = f"{instant}," + lines[row].split(",", 1)[1]
    Path("run.csv").write_text("\n".join(lines) + "\n")
    Path("spec.toml").write_text(SPEC.format(physics=MOTION))
    done = run("check", "spec.toml")
    assert done.code == 2 and words in done.err and "run.csv: line" in done.err


def test_an_observer_steps_from_instant_to_instant(fit):
    uneven = record()
    still = oa.Noise(np.zeros((2, 2)), np.array(fit.model.statistics.noise))
    (ahead,) = oa.Observer(fit, still).predict(uneven, horizon=50).trajectories
    (free,) = fit.model.simulate(uneven).trajectories
    later = slice(len(uneven) // 2, None)
    apart = np.abs(ahead.model - free.model)[later].max()
    assert apart < 0.5 * np.std(free.errors)


def test_models_in_lags_refuse():
    uneven = record()
    with pytest.raises(oa.InputError, match="even instants"):
        oa.estimate(uneven, oa.Baseline.from_terms([oa.Term("a", "y[k-1]")]), learner=None)
    with pytest.raises(oa.InputError, match="not both"):
        oa.Record.from_arrays([1.0, 2.0], time=[0.0, 1.0], sampling_time=2.0)
    with pytest.raises(oa.InputError, match="rising"):
        oa.Record.from_arrays([1.0, 2.0], time=[0.0, 0.0])


@pytest.mark.parametrize("adds_up", [True, False])
def test_steps_that_vary_by_themselves_are_uneven_and_late_stamps_are_not(tmp_path, adds_up):
    """Both deviate from the usual step by less than a lost sample would."""
    rng, rows = np.random.default_rng(4), 400
    t, jitter = np.arange(rows) * 0.05, 0.2 * 0.05 * rng.uniform(-1, 1, rows)
    t = np.cumsum(0.05 + jitter) if adds_up else t + jitter
    path = tmp_path / "run.csv"
    u = np.repeat(rng.normal(size=rows // 8), 8)
    signals = np.c_[t, u, lsim(([1], [1, 1]), u, np.arange(rows) * 0.05)[1]]
    np.savetxt(path, signals, delimiter=",", header="t [s],u,y", comments="", fmt="%.6f")
    whole = oa.read_record(path, inputs=["u"], outputs=["y"], time="t [s]", uneven=True)
    assert whole.even != adds_up
    spec = tmp_path / "spec.toml"
    done = run("init", path, "--inputs", "u", "--outputs", "y", "--out", spec)
    assert ("but the steps are uneven" in done.out) == adds_up, done.err
    assert ('"resample" # difference equations need it' in spec.read_text()) == adds_up
