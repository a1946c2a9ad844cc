"""Suspects with memory: what they would do to θ, beside least squares and fits that are made again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from test_cli import finite_json, run

from orthaug.analysis.memory import MemoryTerm, derivative_of
from orthaug.data.expressions import parse_named

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

STEP, LAG = 0.05, 0.4  # s
POLE = float(np.exp(-STEP / LAG))

LAGGED = """
[data]
sampling_time = 0.05
inputs = ["u"]
outputs = ["y"]
train = {{ files = ["a.csv", "b.csv"] }}
[lags]
na = 2
nb = 1
[baseline]
terms = [
    {{ parameter = "a1", regressor = "y[k-1]" }},
    {{ parameter = "a2", regressor = "y[k-2]" }},
    {{ parameter = "b", regressor = "u[k-1]" }},
]
[[suspects]]
kind = "{kind}"
on = "y[k-1]"
{more}
coefficient = 0.1
"""

MOTION = """
[data]
sampling_time = 0.05
inputs = ["force"]
outputs = ["x"]
train = {{ files = ["a.csv", "b.csv"] }}
[motion.states]
x = {{ derivative = "v", start = "x" }}
v = {{ derivative = "(force - c*v - k*x)/m", start = 0 }}
[motion.outputs]
x = "x"
[motion.parameters]
m = {{ initial = 1.0 }}
c = {{ initial = 1.0 }}
k = {{ initial = 9.0 }}
[training]
segment = 0
[[suspects]]
kind = "{kind}"
on = "{on}"
factor = "-1/m"
{more}
coefficient = {size}
"""


def steps(seed: int, rows: int) -> np.ndarray:
    """Return an input that steps every 15 rows."""
    return np.repeat(np.random.default_rng(seed).uniform(-1, 1, -(-rows // 15)), 15)[:rows]


def state(kind: str, scale: float, x: np.ndarray) -> np.ndarray:
    """Return the internal state along a signal, row by row, as the documents define it."""
    z = np.zeros(len(x))
    z[0] = x[0] if kind in ("lag", "backlash") else 0.0
    for k in range(1, len(x)):
        d = x[k] - x[k - 1]
        if kind == "lag":
            z[k] = POLE * z[k - 1] + (1 - POLE) * x[k - 1]
        elif kind == "backlash":
            z[k] = min(max(z[k - 1], x[k] - scale), x[k] + scale)
        elif kind == "lugre":
            z[k] = np.clip(z[k - 1] + d - abs(d) * z[k - 1] / scale, -scale, scale)
        else:
            turned = abs(d) * abs(z[k - 1]) * z[k - 1] + d * z[k - 1] ** 2
            z[k] = np.clip(z[k - 1] + d - turned / (2 * scale**2), -scale, scale)
    return z


def lagged_runs(folder: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Write two experiments of a second-order system, and return them."""
    found = []
    for name, seed in (("a", 1), ("b", 2)):
        u, y = steps(seed, 150), np.zeros(150)
        noise = 1e-3 * np.random.default_rng(seed + 10).normal(size=150)
        y[:2] = 0.3
        for k in range(2, 150):
            y[k] = 1.3 * y[k - 1] - 0.5 * y[k - 2] + 0.4 * u[k - 1] + noise[k]
        pd.DataFrame({"u": u, "y": y}).to_csv(folder / f"{name}.csv", index=False)
        found.append((u, y))
    return found


@pytest.mark.parametrize(
    ("kind", "more", "scale"),
    [
        ("lag", "time_constant = 0.4", LAG),
        ("backlash", "width = 0.1", 0.1),
        ("lugre", "width = 0.2", 0.2),
        ("bouc_wen", "width = 0.2", 0.2),
    ],
)
def test_lagged_physics_is_biased_as_least_squares_says(tmp_path, monkeypatch, kind, more, scale):
    """Each experiment begins at rest: the bias is Φ⁺ of the internal states, computed here by hand."""
    monkeypatch.chdir(tmp_path)
    runs = lagged_runs(tmp_path)
    Path("spec.toml").write_text(LAGGED.format(kind=kind, more=more))
    phi = [np.column_stack([y[1:-1], y[:-2], u[1:-1]]) for u, y in runs]
    driven = [state(kind, scale, y[1:-1]) for _, y in runs]
    expected = np.linalg.lstsq(np.concatenate(phi), np.concatenate(driven), rcond=None)[0]
    (entry,) = finite_json(run("check", "spec.toml", "--json").out)["bias"]
    np.testing.assert_allclose(list(entry["bias"].values()), expected, rtol=1e-9)
    np.testing.assert_allclose(list(entry["expected_bias"].values()), 0.1 * expected, rtol=1e-9)
    assert kind[:3] in entry["memory"].lower().replace("first-order ", "").replace("-", "_")
    assert entry["expression"] == "y[k-1]"


def mass(seed: int, rows: int, kind: str, on: str, size: float) -> pd.DataFrame:
    """Return a mass on a spring and a damper, and a force with memory of its speed or place."""
    fine = 200
    force, (x, v), scale = 5 * steps(seed, rows), (0.0, 0.0), {"lag": LAG, "lugre": 0.05}[kind]
    h, z, last = STEP / fine, 0.0, None
    found = np.zeros(rows)
    for k in range(rows):
        found[k] = x
        for _ in range(fine):
            signal = v if on == "v" else x
            last = signal if last is None else last
            d, last = signal - last, signal
            z += h * (signal - z) / LAG if kind == "lag" else d - abs(d) * z / scale
            v += h * (force[k] - 1.0 * v - 9.0 * x - size * z)
            x += h * v
    return pd.DataFrame({"force": force, "x": found})


@pytest.mark.parametrize(
    ("kind", "on", "more", "size"),
    [
        ("lag", "v", "time_constant = 0.4", 0.05),
        ("lugre", "x", "width = 0.05", 1.0),
    ],
)
def test_a_motion_is_biased_as_a_fit_to_such_data_is(tmp_path, monkeypatch, kind, on, more, size):
    """To first order: fits of data with the force and without it differ by the bias that is predicted."""
    monkeypatch.chdir(tmp_path)
    values = []
    for amount in (0.0, size):
        for name, seed in (("a", 3), ("b", 4)):
            mass(seed, 200, kind, on, amount).to_csv(f"{name}.csv", index=False)
        Path("spec.toml").write_text(MOTION.format(kind=kind, on=on, more=more, size=size))
        assert run("fit", "spec.toml", "--out", "out", "--force", "--json").code == 0
        result = json.loads(Path("out/result.json").read_text())
        values.append(np.array([entry["value"] for entry in result["parameters"]]))
    (entry,) = result["bias"]
    moved, predicted = values[1] - values[0], np.array(list(entry["expected_bias"].values()))
    size = np.abs(moved).max()
    np.testing.assert_allclose(predicted, moved, atol=0.1 * size)
    assert entry["equation"] == "v" and entry["seen"] is not True
    # the free run shows the term itself: its coefficient, beside the fit
    assert entry["residual"]["coefficient"] == pytest.approx(size_of(result), rel=0.2)


def size_of(result: dict) -> float:
    """Return the coefficient that the spec guessed, which made the data."""
    return result["bias"][0]["coefficient"]


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (LAGGED.format(kind="lag", more=""), "needs `time_constant`, in s"),
        (LAGGED.format(kind="lag", more="time_constant = 1\nwidth = 2"), "takes no `width`"),
        (LAGGED.format(kind="cubic", more="time_constant = 1"), "takes no `time_constant`"),
        (LAGGED.format(kind="lag", more="time_constant = 0"), "time_constant"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(tmp_path, monkeypatch, spec, message):
    monkeypatch.chdir(tmp_path)
    lagged_runs(tmp_path)
    Path("spec.toml").write_text(spec)
    done = run("check", "spec.toml")
    assert done.code == 2 and message in done.err and "Traceback" not in done.err


def test_a_design_and_another_measure_say_that_they_cannot(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lagged_runs(tmp_path)
    spec = LAGGED.format(kind="lag", more="time_constant = 0.4")
    Path("spec.toml").write_text(spec + "[design]\nsamples = 100\namplitude = 1\n")
    done = run("design", "spec.toml", "--out", "u.csv")
    assert done.code == 2 and "has memory, which a design does not count" in done.err
    Path("spec.toml").write_text(spec + '[structure.measure]\nkind = "uniform"\n[learner]\n')
    for command in ("check", "fit"):
        done = run(command, "spec.toml")
        assert done.code == 2 and "has memory: it has values along a record only" in done.err


@pytest.mark.parametrize("kind", ["lag", "lugre", "bouc_wen"])
def test_the_derivative_of_a_term_s_state_is_the_limit_of_its_steps(kind):
    """Of x = sin t: Euler steps of the equation that is proposed, beside the recursion."""
    step, scale = 1e-3, 0.4
    text = derivative_of(kind, "x", "v", "z", "w")
    assert text is not None and derivative_of("backlash", "x", "v", "z", "w") is None
    derivative = parse_named(text, {"x": 0.0, "v": 0.0, "z": 0.0, "w": scale}, "the state")
    time, z, found = step * np.arange(3001), 0.0, []
    for x, v in zip(np.sin(time), np.cos(time), strict=True):
        found.append(z)
        z += step * float(derivative.value({"x": x, "v": v, "z": z, "w": scale}, np))
    expected = MemoryTerm(kind, "x", scale).along(np.sin(time), step)
    np.testing.assert_allclose(found, expected, atol=2e-3)
