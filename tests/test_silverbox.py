"""Linear physics alone on a measured record: the published split and the numbers it is known by."""

from __future__ import annotations

import json

import pytest
from test_cli import run

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

SPEC = """
[data]
sampling_time = 0.001638400
inputs = ["V1"]
outputs = ["V2"]
train = {{ files = ["{file}"], rows = [40650, 105712] }}
[data.tests.multisine]
files = ["{file}"]
rows = [105712, 127400]
skip = 50
[data.tests.arrow]
files = ["{file}"]
rows = [100, 40575]
skip = 50
[data.tests.arrow_without_extrapolation]
files = ["{file}"]
rows = [100, 32100]
skip = 50
[learner]
kind = "none"
[training]
focus = "prediction"
"""
REGRESSORS = ("V2[k-1]", "V2[k-2]", "V1[k]", "V1[k-1]", "V1[k-2]", "1")
PUBLISHED_MILLIVOLT = {"multisine": 6.973, "arrow": 14.389, "arrow_without_extrapolation": 6.630}


@pytest.fixture(scope="module")
def result(data_folder, tmp_path_factory):
    """result.json of `orthaug fit`."""
    file = data_folder / "silverbox" / "SNLS80mV.csv"
    if not file.is_file():
        pytest.skip(f"no {file}; set ORTHAUG_DATA to the folder of the data sets")
    folder = tmp_path_factory.mktemp("silverbox")
    terms = (
        f'[[baseline.terms]]\nparameter = "t{i}"\nregressor = "{r}"\n'
        for i, r in enumerate(REGRESSORS)
    )
    (folder / "silverbox.toml").write_text(SPEC.format(file=file) + "".join(terms))
    assert run("fit", folder / "silverbox.toml", "--out", folder / "out").code == 0
    return json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize(("part", "expected"), PUBLISHED_MILLIVOLT.items())
def test_free_run_of_the_linear_physics(result, part, expected):
    (rmse,) = result["scores"][f"tests.{part}"]["simulation"]["rmse"]
    assert 1000 * rmse == pytest.approx(expected, abs=0.01)


def test_the_physics_is_determined_by_the_data(result):
    assert result["status"]["code"] == "exact"
    assert result["excitation"]["rank"] == len(REGRESSORS)
    warnings = {warning["code"]: warning["text"] for warning in result["warnings"]}
    assert (
        "biases the one-step θ" in warnings["coloured_residual"]
    )  # the cubic spring that the physics lacks
    assert set(warnings) <= {"coloured_residual", "unexplained"}
