"""What a reader of the documents has already: data files of his own, a record, a fit; small, and keyed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

import orthaug as oa


def measured(rows: int = 300, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Force and position of a mass-spring-damper that hardens; noise in the equation."""
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=rows), np.zeros(rows)
    for k in range(2, rows):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + 0.1 * u[k - 1] - 0.1 * y[k - 1] ** 3 + 0.001 * rng.normal()
    return u, y


def file(name: str, seed: int) -> None:
    table = np.column_stack(measured(seed=seed))
    np.savetxt(name, table, delimiter=",", header="force,position", comments="", fmt="%.9g")


def record() -> oa.Record:
    u, y = measured()
    return oa.Record.from_arrays(u, y, sampling_time=0.01, inputs=["force"], outputs=["position"])


def baseline() -> oa.Baseline:
    terms = {"theta1": "position[k-1]", "theta2": "position[k-2]", "theta3": "force[k-1]"}
    return oa.Baseline.from_terms([oa.Term(*term) for term in terms.items()])


def fit() -> oa.Estimate:
    return oa.estimate(record(), baseline(), learner=oa.MLP(hidden=(4,)))


def elsewhere(x: np.ndarray) -> np.ndarray:
    """A model that was trained with another tool."""
    return (1.5 * x[:, 0] - 0.7 * x[:, 1] + 0.1 * x[:, 2] - 0.1 * x[:, 0] ** 3)[:, None]


FILES = ("run1.csv", "run2.csv", "steps.csv", "new.csv")
NAMES: dict[str, Callable[[], object]] = {
    "oa": lambda: oa,
    "np": lambda: np,
    "record": record,
    "baseline": baseline,
    "fit": fit,
    "g": lambda: elsewhere,
}


def give(wanted: Sequence[str], names: dict) -> None:
    """Puts files into the working folder and the rest among the names of a page."""
    for one in wanted:
        if one in FILES:
            file(one, FILES.index(one))
        elif one == "spec.toml":
            Path(one).write_text(SPEC, encoding="utf-8")
        else:
            names[one] = NAMES[one]()


SPEC = """\
[data]
sampling_time = 0.01
inputs = ["force"]
outputs = ["position"]
train = { files = ["run1.csv"] }
[[baseline.terms]]
parameter = "theta1"
regressor = "position[k-1]"
[[baseline.terms]]
parameter = "theta2"
regressor = "position[k-2]"
[[baseline.terms]]
parameter = "theta3"
regressor = "force[k-1]"
[learner]
hidden = [4]
"""
