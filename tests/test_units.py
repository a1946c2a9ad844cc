"""Units in headers against those that a spec gives its channels."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from orthaug import (
    Channel,
    InputError,
    Motion,
    Output,
    PhysicalParameter,
    Record,
    State,
    estimate,
    linearize,
    load_spec,
)
from orthaug.analysis.evidence import sample_warnings
from orthaug.data.units import conversion, unit_faults
from orthaug.data.wild import data_warnings
from orthaug.physics.problem import pose_motion
from orthaug.reports.linear import LinearizeResult
from orthaug.reports.linear_text import linear_text

SPEC = """
[data]
sampling_time = 0.1
inputs = ["u"]
outputs = ["w"]
train = { files = ["run.csv"], rows = [0, 30] }
tests.last = { files = ["run.csv"], rows = [30, 40] }
channels.w = CHANNEL
[[baseline.terms]]
parameter = "a"
regressor = "w[k-1]"
"""


@pytest.mark.parametrize(
    ("given", "wanted", "scale", "offset"),
    [
        ("rpm", "rad/s", math.pi / 30, 0),
        ("U/min", "rad/s", math.pi / 30, 0),
        ("km/h", "m/s", 1 / 3.6, 0),
        ("deg", "rad", math.pi / 180, 0),
        ("°", "rad", math.pi / 180, 0),
        ("mm", "m", 1e-3, 0),
        ("kNm", "N*m", 1e3, 0),
        ("bar", "Pa", 1e5, 0),
        ("degC", "K", 1, 273.15),
        ("degF", "°C", 5 / 9, -160 / 9),
        ("C", "degC", 1, 0),
        ("l/min", "m³/h", 0.06, 0),
    ],
)
def test_units_that_engineers_write(given, wanted, scale, offset):
    assert conversion(given, wanted) == pytest.approx((scale, offset), rel=1e-9)


@pytest.mark.parametrize("unit", ["raw", "filtered", "-", "", "counts!", "9", "a.u."])
def test_text_that_is_no_unit_is_no_fault(tmp_path, unit):
    (tmp_path / "run.csv").write_text(f"u,w [{unit}]\n1,2\n")
    assert not unit_faults(tmp_path / "run.csv", {"w": Channel("w", "rad/s")})


@pytest.mark.parametrize(
    ("header", "channel", "said"),
    [
        ("w [rpm]", '{ column = "w [rpm]", unit = "rad/s" }', "scale = 0.10472"),
        ("w (rpm)", '{ column = "w (rpm)", unit = "rad/s", scale = 9.5493 }', "the inverse"),
        ("w [degC]", '{ column = "w [degC]", unit = "K" }', "offset = 273.15"),
        ("w [mm]", '{ column = "w [mm]", unit = "rad/s" }', "of another kind"),
        ("w [rpm]", '{ column = "w [rpm]", unit = "rad/s", scale = 0.10472 }', ""),
        ("w [rpm]", '{ column = "w [rpm]", unit = "rad/s", scale = -0.10472 }', ""),
        ("w [V]", '{ column = "w [V]", unit = "mm", scale = 5.2 }', ""),  # a calibration
        ("w [m/s^2]", '{ column = "w [m/s^2]", unit = "m/s²" }', ""),
        ("w [rpm]", '{ column = "w [rpm]" }', ""),
    ],
)
def test_a_spec_that_gives_a_column_another_unit(tmp_path, header, channel, said):
    rows = "\n".join(f"{math.sin(k)},{math.cos(k)}" for k in range(40))
    (tmp_path / "run.csv").write_text(f"u,{header}\n{rows}\n")
    (tmp_path / "spec.toml").write_text(SPEC.replace("CHANNEL", channel))
    found = [w for w in load_spec(tmp_path / "spec.toml").warnings if w.code == "unit_mismatch"]
    assert len(found) == bool(said)  # not once more for the test in the same file
    if said:
        assert said in found[0].text and f"'{header}'" in found[0].text


def test_units_in_a_row_under_the_header(tmp_path):
    rows = "\n".join(f"{k},{k * k}" for k in range(9))
    (tmp_path / "run.csv").write_text(f"u,w\nV,km/h\n{rows}\n")
    found = unit_faults(tmp_path / "run.csv", {"w": Channel("w", "m/s")})
    assert len(found) == 1 and "scale = 0.277778" in found[0].warning.text


@pytest.mark.parametrize(("noise", "said"), [(0.0, True), (1e-3, True), (0.05, False)])
def test_one_signal_in_two_columns(noise, said):
    rng = np.random.default_rng(1)
    speed = np.cumsum(rng.normal(size=400))
    other = 30 / np.pi * (speed + noise * speed.std() * rng.normal(size=400))
    outputs = np.stack([speed, rng.normal(size=400), np.round(other, 2)], axis=1)
    record = Record.from_arrays(np.zeros(400), outputs, outputs=["rad_s", "x", "rpm"])
    found = [w.text for w in data_warnings(record) if w.code == "same_signal"]
    assert len(found) == said
    if said:
        assert "rpm is 9.5" in found[0] and "*rad_s" in found[0]


def cooled(**given) -> Motion:
    """A body that cools by a rate, in 1/min."""
    given = {"unit": "1/min", "equation": "b*u - a*x", **given}
    return Motion.from_equations(
        states=[State("x", given["equation"], start="T")],
        outputs=[Output("T", "x")],
        inputs=["u"],
        parameters=[
            PhysicalParameter("a", 0.1, given["unit"], min=0),
            PhysicalParameter("b", 2.0, given.get("other", "K/s"), min=0),
        ],
    )


def minutes(**given) -> Record:
    """Half-minute samples of a rate of 0.2 1/min."""
    rng = np.random.default_rng(0)
    u, x, found = np.repeat(rng.uniform(0, 2, 20), 10), 0.0, []
    for value in u:
        found.append(x)
        x = 15 * value + (x - 15 * value) * math.exp(-0.1)
    y = np.array(found) + 0.1 * rng.normal(size=200)
    record = Record.from_arrays(u, y, outputs=["T"], sampling_time=given["step"])
    return replace(record, time_column=given.get("column"))


def test_a_rate_per_minute_is_refused_where_time_was_converted_to_seconds():
    record = minutes(step=30.0, column="time [min]")
    with pytest.raises(InputError, match=r"'a' has the unit 1/min.*\(0.001667\).* in 1/s"):
        estimate(record, cooled(), learner=None)
    with pytest.raises(InputError, match=r"'a' has the unit min.*\(6\).* in s"):
        estimate(record, cooled(unit="min"), learner=None)
    assert estimate(record, cooled(unit="H"), learner=None).status.ok  # the henry is no hour
    fit = estimate(record, cooled(equation="b*u/60 - a/60*x"), learner=None)
    assert fit.parameters.loc["a", "value"] == pytest.approx(0.2, rel=0.02)


def test_a_unit_with_minutes_in_it_is_named_as_not_converted():
    record = minutes(step=30.0, column="time [min]")
    fit = estimate(record, cooled(unit="1/s", other="K/min"), learner=None)
    (found,) = [w for w in fit.diagnose().warnings if w.code == "time_unit"]
    assert "the units of b have another time" in found.text


@pytest.mark.parametrize(
    ("unit", "equation", "column", "said"),
    [
        ("mg/h", "b*u - a*x", "time [h]", True),
        ("l/min", "b*u - a*x", "time [h]", True),
        ("mg/h", "b*u/3600 - a*x", "time [h]", False),  # converted
        ("mg/h", "b*u - a*x", "time", False),  # hours, for all that is known
        ("1/min", "b*u - a*x", "time [h]", False),  # a speed in turns
        ("mg/s", "b*u - a*x", "time [h]", False),
    ],
)
def test_an_input_per_hour_is_named_where_time_was_converted_to_seconds(
    unit, equation, column, said
):
    record = minutes(step=30.0, column=column)
    record = replace(record, inputs=(Channel("u", unit),))
    motion = cooled(unit="1/s", equation=equation)
    found = [w.text for w in sample_warnings(pose_motion(record, motion)) if w.code == "time_unit"]
    assert len(found) == said
    if unit == "mg/h" and said:
        assert "'u' is in mg/h" in found[0] and "`scale = 0.000277778`" in found[0]
        record = replace(record, inputs=(Channel("u", unit, scale=1 / 3600),))
        warnings = sample_warnings(pose_motion(record, motion))
        assert all(one.code != "time_unit" for one in warnings)


def test_equations_in_minutes_have_linear_views_in_minutes():
    fit = estimate(minutes(step=0.5), cooled(other="K/min"), learner=None)
    assert fit.parameters.loc["a", "value"] == pytest.approx(0.2, rel=0.02)
    found = linearize(fit)
    text = linear_text(found)
    assert "Ts = 0.5 min" in text and re.search(r"0\.(19|20)\d* 1/min", text)
    assert re.search(r"time constant [\d.]+ min", text) and "Hz" not in text
    assert json.loads(LinearizeResult.of(found).to_json())["points"][0]["time_unit"] == "min"
