"""Structure that a model leaves, a hidden state among it: what `orthaug fit` says of it, with a learner and without."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import scipy.signal
from test_cli import run, write_csv

import orthaug as oa
from orthaug.analysis.family_tests import Family, _test_families
from orthaug.analysis.hidden_state import structure_test
from orthaug.analysis.parameter_changes import _turn_of

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

TS = 0.05
DATA = '[data]\ninputs = ["u"]\noutputs = ["y"]\nsampling_time = 0.05\ntrain = { files = ["run.csv"] }\n'
MOTION = """[motion]
substeps = 1
[motion.states]
x = { derivative = "v", start = "y" }
v = { derivative = "(u - c*v - k*x)/m", start = "derivative of y", learned = LEARNED }
[motion.outputs]
y = "x"
[motion.parameters]
m = { initial = 1.2, min = 0 }
c = { initial = 0.8, min = 0 }
k = { initial = 5.0, min = 0 }
"""
LAGGED = "".join(
    f'[[baseline.terms]]\nparameter = "{name}"\nregressor = "{text}"\n'
    for name, text in (("a1", "y[k-1]"), ("a2", "y[k-2]"), ("b", "u[k-1]"))
)


def spring(
    rows: int = 700, hidden: float = 1.0, seed: int = 0, equation: float = 0.2
) -> dict[str, np.ndarray]:
    """x'' = u − 0.6 x' − 4 x − z with a hidden z' = (x − z)/0.5, noise in the equation."""
    random = np.random.default_rng(seed)
    u = np.repeat(random.uniform(-3, 3, rows // 12 + 1), 12)[:rows]
    state, y, h = np.zeros(3), [], TS / 4

    def rates(s: np.ndarray, f: float) -> np.ndarray:
        return np.array([s[1], f - 0.6 * s[1] - 4 * s[0] - hidden * s[2], (s[0] - s[2]) / 0.5])

    for f in u + equation * random.normal(size=rows):
        y.append(state[0])
        for _ in range(4):
            middle = state + h / 2 * rates(state, f)
            state = state + h * rates(middle, f)
    return {"u": u, "y": np.array(y) + 1e-4 * random.normal(size=rows)}


def lags(
    rows: int = 700, hidden: float = 0.1, seed: int = 0, sensor: float = 0.0
) -> dict[str, np.ndarray]:
    """y = 1.35 y₁ − 0.48 y₂ + 0.5 u₁ − 0.1 z + e with a hidden first-order lag z of y."""
    random = np.random.default_rng(seed)
    u, y, z = np.repeat(random.uniform(-3, 3, rows // 10 + 1), 10)[:rows], np.zeros(rows), 0.0
    e = 0.05 * random.normal(size=rows) * (sensor == 0)
    for k in range(2, rows):
        z += 0.1 * (y[k - 2] - z)
        y[k] = 1.35 * y[k - 1] - 0.48 * y[k - 2] + 0.5 * u[k - 1] - hidden * z + e[k]
    return {"u": u, "y": y + sensor * random.normal(size=rows)}


def codes(result: oa.FitResult | dict) -> set[str]:
    warnings = (
        result["warnings"] if isinstance(result, dict) else [vars(one) for one in result.warnings]
    )
    return {warning["code"] for warning in warnings}


def fitted(
    folder: Path, physics: str, data: dict[str, np.ndarray], learner: str = ""
) -> tuple[dict, str, str]:
    """result.json, the text, and the page of `orthaug fit`."""
    write_csv(folder / "run.csv", **data)
    physics = physics.replace("LEARNED", "true" if learner else "false")
    (folder / "spec.toml").write_text(DATA + physics + learner)
    done = run("fit", folder / "spec.toml", "--out", folder / "out")
    assert done.code == 0, done.err
    result = json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))
    return result, done.out, (folder / "out" / "report.html").read_text(encoding="utf-8")


def test_a_fall_back_says_that_a_state_is_missing(tmp_path):
    """k comes out at about 4.7 for 4; the intervals say that they count noise only, and the cause has a name."""
    learner = '[learner]\nhidden = [3]\ninputs = ["v"]\n'
    result, text, page = fitted(tmp_path, MOTION, spring(), learner)
    k = next(row for row in result["parameters"] if row["name"] == "k")
    # What a missing state leaves may remember itself for too long to have an interval
    said = k["ci95"] is not None
    assert (k["ci95_counts"] == "noise only") if said else ("too_long_memory" in codes(result))
    assert {"unexplained", "hidden_state"} <= codes(result)
    assert result["unexplained"]["hidden_state"]
    best = result["unexplained"]["memory"][0]
    assert best["kind"] == "lag" and abs(best["parameters"]["k"] - 4) < 0.7 * abs(k["value"] - 4)
    assert not said or (
        "95 %, noise only" in text and "95 % interval  " not in text.split("part ")[0]
    )
    assert not said or ("95 %, noise only" in page and "count noise only" in page)
    assert "write the state out as a state of the motion" in " ".join(text.split())
    assert "states of its own (learner.states). Or let the learner see" in " ".join(text.split())
    assert result["shared"] is None or result["shared"]["withdrawn"] == [
        "m",
        "k",
    ]  # nothing counts as determined
    assert not re.search(r"[Tt]he fit determines", text)


def test_a_learner_that_was_dropped_is_no_remedy():
    data = lags(rows=300, hidden=0.2, seed=1)
    record = oa.Record.from_arrays(data["u"], data["y"], sampling_time=TS)
    texts = {"a1": "y[k-1]", "a2": "y[k-2]", "b": "u[k-1]"}
    baseline = oa.Baseline.from_terms([oa.Term(name, text) for name, text in texts.items()])
    fit = oa.estimate(
        record, baseline, learner=oa.MLP((8,), inputs=("u[k-1]",)), criterion=oa.Auto()
    )
    text = {one.code: one.text for one in fit.diagnose(blocks=0).warnings}
    assert "physics_alone" in text
    assert (
        "The learner that was tried does not lower the error on held-out rows"
        in text["unexplained"]
    )
    assert "Fit with a learner" not in text["unexplained"]


def test_lagged_physics_without_a_learner_says_so(tmp_path):
    result, text, _ = fitted(tmp_path, LAGGED, lags())
    assert {"unexplained", "hidden_state"} <= codes(result)
    assert all(row["ci95_counts"] == "noise only" for row in result["parameters"])
    assert "add lags of outputs and inputs to the physics" in " ".join(text.split())


@pytest.mark.parametrize(
    ("physics", "data"),
    [
        (MOTION, spring(hidden=0.0)),
        (MOTION, spring(hidden=0.0, equation=0.0, seed=1)),
        (LAGGED, lags(hidden=0.0)),
        (LAGGED, lags(hidden=0.0, sensor=0.03)),
    ],
    ids=["motion", "motion, sensor", "lagged", "lagged, sensor"],
)
def test_noise_alone_is_no_hidden_state(tmp_path, physics, data):
    """Noise on the sensor colours the one-step residual: that has a warning of its own."""
    result, text, _ = fitted(tmp_path, physics, data)
    assert not {"unexplained", "hidden_state"} & codes(result)
    assert (
        all("ci95_counts" not in row for row in result["parameters"])
        and "unexplained" not in result
    )
    assert "noise only" not in text


@pytest.mark.parametrize("seed", [3, 16])
def test_noise_in_equations_with_products_is_no_hidden_state(seed):
    """A boost converter: current and voltage have noise whose colour changes with the duty."""
    random, rows = np.random.default_rng(seed), 400
    duty = np.repeat(random.uniform(0.3, 0.6, rows // 25 + 1), 25)[:rows]
    i, v = np.zeros(rows), np.full(rows, 20.0)
    for k in range(1, rows):
        off = 1 - duty[k - 1]
        i[k] = 0.97 * i[k - 1] + 0.2 * (12 - off * v[k - 1]) + 0.02 * random.normal()
        v[k] = v[k - 1] + 0.04 * (off * i[k - 1] - 0.1 * v[k - 1]) + 0.005 * random.normal()
    record = oa.Record.from_arrays(
        duty, np.c_[i, v], sampling_time=1.0, inputs=["d"], outputs=["i", "v"]
    )
    terms = [
        oa.Term("a", "i[k-1]", output="i"),
        oa.Term("b", "12 - (1 - d[k-1])*v[k-1]", output="i"),
        oa.Term("e", "v[k-1]", output="v"),
        oa.Term("c", "(1 - d[k-1])*i[k-1]", output="v"),
    ]
    baseline = oa.Baseline.from_terms(terms)
    found = oa.estimate(record, baseline, learner=None, criterion=oa.Prediction()).diagnose()
    assert found.unexplained is None
    assert not {"unexplained", "hidden_state"} & {warning.code for warning in found.warnings}


def test_a_base_that_blocks_do_not_determine_makes_no_family_look_good():
    """Seven of eight blocks leave the base to chance, so any column seems to help in the eighth."""
    rng = np.random.default_rng(0)
    base = rng.normal(size=800)
    base[:700] *= 0.01
    term = np.where(np.arange(800) < 700, base, 0.0)
    whole = np.column_stack([base, term, rng.normal(size=800)])
    size = np.linalg.norm(whole, axis=0)
    families = [Family("", "u", "lag", (None,))]
    (found,) = _test_families(*np.linalg.qr(whole / size), [0], 1, families, size, None)
    assert 0 < found.share < 0.02 and not found.sure


def test_a_curve_that_turns_far_beyond_its_ends_has_a_value_there():
    t = np.linspace(-1, 1, 2001)
    for linear, square in ((0.1, 1.0), (-0.1, -1.0)):
        curve = 2.0 + linear * t + square * t**2
        extreme = curve.min() if square > 0 else curve.max()
        assert _turn_of(2.0, linear, square) == pytest.approx(extreme)
    assert _turn_of(2.0, 1.0, 0.6) is None and _turn_of(2.0, 1.0, 0.1) is None
    assert _turn_of(2.0, 0.0, 0.0) is None


def tank(fall: float, noise: np.ndarray):
    """The test of a tank whose outlet narrows by `fall`, with what is added to its level."""
    rows, h, level = len(noise), 1.0, []
    q = np.repeat(np.random.default_rng(3).uniform(0.5, 1.5, rows // 40), 40)
    for k, flow in enumerate(q):
        level.append(h)
        h += 0.02 * (flow - (1 - fall * k / rows) * np.sqrt(max(h, 1e-3)))
    motion = oa.Motion.from_equations(
        [oa.State("h", "h + (q - a*sqrt(max(h, 0.001)))/A", start="level")],
        [oa.Output("level", "h")],
        [oa.PhysicalParameter("a", 0.5, min=0), oa.PhysicalParameter("A", 20.0, min=0)],
        ["q"],
        integrator="discrete",
    )
    record = oa.Record.from_arrays(
        q, np.array(level) + noise, sampling_time=1.0, inputs=["q"], outputs=["level"]
    )
    fit = oa.estimate(record, motion, learner=None)
    test = structure_test(fit.model, record)
    assert test is not None
    return fit, test.drift


def test_a_drift_is_seen_whose_own_colour_hides_it():
    """The errors of an outlet that narrows are slow: filtered by that colour 1 % of them is left."""
    fit, drift = tank(0.3, 0.02 * np.random.default_rng(1).normal(size=1600))
    assert drift is not None and drift.place == 0 and drift.follows is None
    begin, end = np.exp(fit.theta[0] + [drift.begin, drift.end])
    assert begin == pytest.approx(1.0, abs=0.05) and end == pytest.approx(0.7, abs=0.03)
    assert drift.share > 0.5


@pytest.mark.parametrize("seed", [1, 2])
def test_slow_disturbances_are_no_drift(seed):
    """AR(0.98) on the level, as slow as the change would be."""
    white = 0.01 * np.random.default_rng(seed).normal(size=1600)
    assert tank(0.0, np.asarray(scipy.signal.lfilter([1.0], [1, -0.98], white)))[1] is None
