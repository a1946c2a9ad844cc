"""Usual suspects of a physics: none that it has itself, and what a bias is shown as."""

import json

import numpy as np
import pytest
from test_cli import run, write_csv

pytestmark = pytest.mark.usefixtures("without_figures")

DATA = """
[data]
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv"] }
"""
LAGGED = """
[baseline]
terms = [
    { parameter = "a", regressor = "y[k-1]" },
    { parameter = "b", regressor = "u[k-1]" },
    { parameter = "root", regressor = "sqrt(y[k-1])" },
    { parameter = "level", regressor = "1" },
]
"""
MOTION = """
[motion.states]
x = { derivative = "b*u - c*x - d*x**3 + level", start = "y", learned = true }
[motion.outputs]
y = "x"
[motion.parameters]
b = { initial = 0.5 }
c = { initial = 0.2 }
d = { initial = 0.001 }
level = { initial = 1.0 }
"""


def suspects(folder, physics, learner, *, noise=0.01, least=3.0):
    rng = np.random.default_rng(0)
    u, y = np.repeat(rng.uniform(0, 2, 30), 6), np.zeros(180)
    y[0] = least + 2
    for k in range(1, 180):
        y[k] = 0.8 * y[k - 1] + 0.5 * u[k - 1] + 0.2 * least + noise * rng.normal()
    write_csv(folder / "run.csv", u=u, y=y)
    (folder / "spec.toml").write_text(f'{DATA}{physics}[learner]\nkind = "{learner}"\n')
    done = run("check", folder / "spec.toml", "--json")
    return json.loads(done.out)["bias"]


@pytest.mark.parametrize("learner", ["mlp", "none"])
@pytest.mark.parametrize(
    ("physics", "known"),
    [(LAGGED, {"offset", "square_root of y[k-1]"}), (MOTION, {"offset", "cubic of x"})],
)
def test_what_the_physics_has_is_no_suspect(tmp_path, physics, known, learner):
    names = {one["name"] for one in suspects(tmp_path, physics, learner)}
    assert names and not names & known
    other = "cubic of y[k-1]" if physics == LAGGED else "quadratic_drag of x"
    assert other in names


UNREAD = """
[motion.states]
x = { derivative = "b*u - c*x", start = "y", learned = true }
z = { derivative = "u - b*z", start = 0 , learned = true }
[motion.outputs]
y = "x + z"
[motion.parameters]
b = { initial = 0.5 }
c = { initial = 0.2 }
"""
LAGGED_UNREAD = """
[lags]
na = 1
nb = 1
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
"""


@pytest.mark.parametrize(
    ("physics", "multiples"),
    [
        (LAGGED_UNREAD, ["multiple of u[k-1]"]),
        (UNREAD, ["multiple of z in x", "multiple of x in z"]),
        (LAGGED, []),
        (MOTION, []),
    ],
)
def test_a_multiple_of_what_an_equation_does_not_read_may_be_missing(tmp_path, physics, multiples):
    names = [one["name"] for one in suspects(tmp_path, physics, "mlp")]
    assert [name for name in names if name.startswith("multiple")] == multiples


def test_a_bias_of_a_parameter_next_to_zero_is_not_in_per_cent_of_it(tmp_path):
    """A record without noise gives a parameter that is not there the size of rounding."""
    extra = LAGGED.replace("sqrt(y[k-1])", "u[k-2]")
    suspects(tmp_path, extra, "mlp", noise=0.0)
    shown = run("check", tmp_path / "spec.toml").out
    (line,) = [line for line in shown.splitlines() if line.startswith("cubic of y[k-1]")]
    assert "e+" not in line and " – " in line
