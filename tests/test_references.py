"""What the scripts gave: the file that is shipped, and how a number stands beside it.

`python tests/test_references.py FOLDER` writes src/orthaug/studies/references.json anew from measurements in a folder,
static_example.json and mass_spring_damper.json with one entry per run.

These are the authors' published scripts (Python, JAX, jax-sysid 1.0.1, jaxopt), unchanged in method, their printing
silenced, run with jax 0.10.2 in double precision on one CPU core, once per initialisation. Per configuration: mean,
smallest and largest value over the runs. test_rmse is a true root mean square, test_sse the sum of squares over the
static example's 1024 test samples, which is what the scripts print; theta_error is the norm of the error of theta in
the static example and of its relative error in the mass-spring-damper, test_rmse there one step ahead [m]; seconds
include compilation.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orthaug.studies import references
from orthaug.studies.references import Spread

SHIPPED = files("orthaug.studies").joinpath("references.json")
MEASURED = Path(__file__).resolve().parents[2] / "shared" / "reference"
AXES = {
    "static": ("data_set", "noise_30dB", "structure"),
    "mass_spring_damper": ("structure", "weight"),
}
TEST_SAMPLES = 1024  # of the static example
MADE = "by the authors' published scripts; tests/test_references.py says how"


def summary(runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """The content of the shipped file from one entry per run, by example."""
    content: dict[str, Any] = {"made": MADE}
    for name, axes in AXES.items():
        groups: dict[tuple[Any, ...], list[dict[str, float]]] = {}
        for run in runs[name]:
            groups.setdefault(tuple(run[axis] for axis in axes), []).append(quantities(name, run))
        content[name] = [
            dict(zip(axes, values, strict=True))
            | {"runs": len(rows)}
            | {q: parts(rows, q) for q in rows[0]}
            for values, rows in groups.items()
        ]
    return content


def quantities(name: str, run: Mapping[str, Any]) -> dict[str, float]:
    values = {"test_rmse": run["test_rmse"], "seconds": run["seconds"]}
    if name == "static":
        return values | {
            "test_sse": TEST_SAMPLES * run["test_rmse"] ** 2,
            "theta_error": run["theta_error"],
        }
    return values | {"theta_error": run["theta_relative_error"]}


def parts(rows: Sequence[Mapping[str, float]], quantity: str) -> dict[str, float]:
    values = np.array([row[quantity] for row in rows])
    parts = {"mean": values.mean(), "min": values.min(), "max": values.max()}
    return {name: float(f"{value:.9g}") for name, value in parts.items()}


def measured(folder: Path) -> dict[str, Any]:
    """One entry per run, by example."""
    names = {"static": "static_example", "mass_spring_damper": "mass_spring_damper"}
    return {
        name: json.loads((folder / f"{file}.json").read_text(encoding="utf-8"))
        for name, file in names.items()
    }


def test_the_shipped_file_is_the_summary_of_the_measurements():
    if not MEASURED.is_dir():
        pytest.skip("the measurements are not here")
    assert json.loads(SHIPPED.read_text(encoding="utf-8")) == summary(measured(MEASURED))


def test_a_summary_of_known_runs():
    static = {"data_set": 1, "noise_30dB": False, "structure": "additive"}
    runs = [
        static | {"test_rmse": rmse, "theta_error": error, "seconds": seconds}
        for rmse, error, seconds in ((0.5, 1.0, 2.0), (1.5, 4.0, 3.0))
    ]
    damper = {
        "structure": "orthogonal",
        "weight": 0.0,
        "test_rmse": 3.0,
        "theta_relative_error": 0.1,
        "seconds": 1.0,
    }
    content = summary({"static": runs, "mass_spring_damper": [damper]})
    (row,) = content["static"]
    assert row["runs"] == 2 and row["theta_error"] == {"mean": 2.5, "min": 1.0, "max": 4.0}
    assert row["test_sse"] == {"mean": 1280.0, "min": 256.0, "max": 2304.0}
    assert content["mass_spring_damper"][0]["theta_error"]["max"] == 0.1


def test_every_configuration_of_the_shipped_file_can_be_read():
    content = json.loads(SHIPPED.read_text(encoding="utf-8"))
    assert "scripts" in content["made"]
    for row in content["static"]:
        spread = references.static(
            row["data_set"], row["structure"], "test_sse", noise=row["noise_30dB"]
        )
        assert spread.low <= spread.mean <= spread.high and spread.runs == row["runs"] == 10
        # the mean of squares is no less than the square of the mean
        rmse = references.static(
            row["data_set"], row["structure"], "test_rmse", noise=row["noise_30dB"]
        )
        assert spread.mean >= TEST_SAMPLES * rmse.mean**2
        np.testing.assert_allclose(
            [spread.low, spread.high], TEST_SAMPLES * np.array([rmse.low, rmse.high]) ** 2
        )
    for row in content["mass_spring_damper"]:
        spread = references.mass_spring_damper(row["structure"], row["weight"], "theta_error")
        assert spread is not None and spread.low <= spread.mean <= spread.high
    assert references.mass_spring_damper("orthogonal-penalty", 1e-8, "theta_error") is None
    low, high = references.seconds("static")
    assert 1 < low < high < 10


@pytest.mark.parametrize(
    ("ours", "smaller", "met", "words"),
    [
        ([1.0, 3.0], False, True, "mean within the scripts' smallest and largest of 4 runs"),
        ([3.0], False, True, "within"),
        ([3.004], False, True, "mean, in three digits, equal to the scripts' largest of 4 runs"),
        ([3.006], False, False, "mean above the scripts' largest of 4 runs (by 0.2 %)"),
        ([0.5], False, False, "mean below the scripts' smallest of 4 runs (0.5 times it)"),
        ([0.5], True, True, "below the scripts' smallest"),
        ([9.0], True, False, "(3 times it)"),
        ([0.0], True, True, "(0 times it)"),
    ],
)
def test_a_number_beside_a_spread(ours, smaller, met, words):
    given, text = Spread(2.0, 1.0, 3.0, 4).beside(ours, smaller_is_better=smaller)
    assert given is met and words in text


def test_a_spread_in_words_and_in_other_units():
    spread = Spread(2e-4, 1e-4, 3e-4, 5)
    assert str(spread) == "0.0002 (0.0001 … 0.0003)"
    assert str(spread.scaled(1000.0)) == "0.2 (0.1 … 0.3)"
    assert str(Spread(0.0132546, 0.0132534, 0.0132569, 5)) == "0.0132546 (0.0132534 … 0.0132569)"


if __name__ == "__main__":
    target = Path(__file__).resolve().parents[1] / "src" / "orthaug" / "studies" / "references.json"
    target.write_text(
        json.dumps(summary(measured(Path(sys.argv[1]))), indent=1) + "\n", encoding="utf-8"
    )
