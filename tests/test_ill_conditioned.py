"""The warning `ill_conditioned`: inputs that are nearly one, in `check` and `fit`, lagged and motion."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
from test_cli import run, write_csv

import orthaug as oa

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

LAGGED = """
[data]
sampling_time = 0.1
inputs = ["u", "w"]
outputs = ["y"]
train = { files = ["run.csv"] }
[learner]
kind = "none"
[baseline]
terms = [
    { parameter = "a", regressor = "y[k-1]" },
    { parameter = "b", regressor = "u[k-1]" },
    { parameter = "c", regressor = "w[k-1]" },
]
"""
MOTION = (
    LAGGED.partition("[baseline]")[0]
    + """
[motion.states]
x = { derivative = "b*u + c*w - a*x", start = "y" }
[motion.outputs]
y = "x"
[motion.parameters]
a = { initial = 4.0, min = 0 }
b = { initial = 5.0 }
c = { initial = 5.0 }
"""
)


def driven(apart, rows=400, noise=0.02, scale=1.0, seed=0):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=rows)
    y = np.zeros(rows)
    for k in range(1, rows):
        y[k] = 0.6 * y[k - 1] + u[k - 1] + noise * rng.normal()
    return {"u": u, "w": u + apart * rng.normal(size=rows), "y": scale * y}


def told(tmp_path, command, text, apart, **options):
    """The warnings `ill_conditioned` of a command."""
    write_csv(tmp_path / "run.csv", **driven(apart, **options))
    (tmp_path / "spec.toml").write_text(text)
    out = [] if command == "check" else ["--out", tmp_path / "out"]
    done = run(command, tmp_path / "spec.toml", "--json", *out)
    assert done.code == 0, done.err
    return [w["text"] for w in json.loads(done.out)["warnings"] if w["code"] == "ill_conditioned"]


@pytest.mark.parametrize("command", ["check", "fit"])
@pytest.mark.parametrize(
    ("text", "apart"), [(LAGGED, 1e-6), (MOTION, 1e-4)], ids=["lagged", "motion"]
)
def test_inputs_that_are_nearly_one(tmp_path, command, text, apart):
    (warning,) = told(tmp_path, command, text, apart)
    assert "the data hardly distinguish b, c" in warning and "Fix one of them" in warning
    condition = float(warning.partition("(condition ")[2].partition(" ")[0])
    part = float(warning.partition("to 1 part in ")[2].partition(". Its")[0])
    assert 0.5 < part * apart < 2 and 1 < condition * apart < 4  # √2 each, and a third column


@pytest.mark.parametrize("scale", [1e-3, 1e6])
@pytest.mark.parametrize("text", [LAGGED, MOTION], ids=["lagged", "motion"])
def test_the_rule_does_not_depend_on_the_unit_of_the_output(tmp_path, text, scale):
    assert len(told(tmp_path, "check", text, 1e-4, scale=scale)) == 1
    assert told(tmp_path, "check", text, 0.1, scale=scale) == []


@pytest.mark.parametrize("command", ["check", "fit"])
@pytest.mark.parametrize("text", [LAGGED, MOTION], ids=["lagged", "motion"])
def test_inputs_that_noise_distinguishes_are_no_finding(tmp_path, command, text):
    assert told(tmp_path, command, text, 0.03) == []


def test_motion_at_the_limit_of_its_digits(tmp_path):
    """`check` refuses, and a fit says how little tells the parameters apart: no more than the digits show."""
    write_csv(tmp_path / "run.csv", **driven(1e-6))
    (tmp_path / "spec.toml").write_text(MOTION)
    done = run("check", tmp_path / "spec.toml")
    assert done.code == 2 and "b, c cannot be distinguished" in done.err
    (warning,) = told(tmp_path, "fit", MOTION, 1e-6)
    assert "at least 1 part in" in warning


def fitted(u, y, texts):
    baseline = oa.Baseline.from_terms([oa.Term(f"t{i}", text) for i, text in enumerate(texts)])
    fit = oa.estimate(oa.Record.from_arrays(u, y, sampling_time=1.0), baseline, learner=None)
    return [w.text for w in fit.warnings if w.code == "ill_conditioned"]


def test_a_column_that_is_nearly_a_sum_of_two():
    rng = np.random.default_rng(3)
    u = rng.normal(size=(500, 3))
    u[:, 2] = u[:, 0] + u[:, 1] + 1e-6 * rng.normal(size=500)
    y = u[:, 0] + 0.1 * rng.normal(size=500)
    (warning,) = fitted(u, y, ["u1[k]", "u2[k]", "u3[k]", "1"])
    assert "hardly distinguish t0, t1, t2." in warning


def test_two_pairs_are_two_findings():
    rng = np.random.default_rng(4)
    u = np.repeat(rng.normal(size=(500, 2)), 2, axis=1)
    u[:, 1::2] += 1e-6 * rng.normal(size=(500, 2))
    y = u[:, 0] + u[:, 2] + 0.1 * rng.normal(size=500)
    first, second = fitted(u, y, ["u1[k]", "u2[k]", "u3[k]", "u4[k]"])
    assert "hardly distinguish t0, t1." in first and "hardly distinguish t2, t3." in second


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.3])
@pytest.mark.parametrize("degree", [3, 5, 9])
def test_polynomials_are_no_finding(degree, noise):
    """Powers are nearly dependent by themselves; here the condition is up to 1e7."""
    rng = np.random.default_rng(5)
    u = rng.uniform(1, 4, 300)
    y = np.sin(u) + noise * rng.normal(size=300)
    assert fitted(u, y, ["1", *(f"u[k]**{i}" for i in range(1, degree + 1))]) == []


@pytest.mark.parametrize("noise", [1e-4, 1e-2])
def test_a_signal_sampled_fast_is_no_finding(noise):
    rng = np.random.default_rng(6)
    u, y = np.repeat(rng.normal(size=100), 20), np.zeros(2000)
    for k in range(2, 2000):
        y[k] = 1.98 * y[k - 1] - 0.981 * y[k - 2] + 1e-3 * u[k - 1]
    y = y + noise * y.std() * rng.normal(size=2000)
    products = itertools.combinations_with_replacement(["y[k-1]", "y[k-2]"], 2)
    assert fitted(u, y, ["y[k-1]", "y[k-2]", "u[k-1]"]) == []
    assert (
        fitted(u, y, ["y[k-1]", "y[k-2]", "u[k-1]", *("*".join(pair) for pair in products)]) == []
    )
