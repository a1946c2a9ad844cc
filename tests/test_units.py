"""Units in headers against those that a spec gives its channels."""

from __future__ import annotations

import math

import numpy as np
import pytest

from orthaug import Channel, Record, load_spec
from orthaug.data.units import conversion, unit_faults
from orthaug.data.wild import data_warnings

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
