"""The examples that run what was exported, run themselves."""

from __future__ import annotations

import importlib
import re
import shutil
import sys
from pathlib import Path

import matplotlib.image
import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")


@pytest.fixture(autouse=True)
def _beside(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    yield
    for name in ("mpc", "c_loop", "fmu"):
        sys.modules.pop(name, None)


def test_predictive_control_by_the_learned_model_tracks_better(tmp_path):
    """By 30 % at least; on a picture that is not blank."""
    pytest.importorskip("casadi")
    errors = importlib.import_module("mpc").main(str(tmp_path / "mpc.png"))
    alone, learned = errors.values()
    assert learned < 0.7 * alone and 1e-3 < alone < 1e-2
    assert matplotlib.image.imread(tmp_path / "mpc.png").std() > 0.05


@needs_gcc
def test_the_c_loop_is_the_model(tmp_path, capsys):
    found = importlib.import_module("c_loop").main(str(tmp_path))
    assert found["double"] < 1e-12 and 1e-12 < found["float"] < 1e-5
    output = capsys.readouterr().out
    assert re.search(
        r"1 kHz for a second: a step takes \d+\.\d+ µs|needs the clock of Linux", output
    )
    built = re.search(r"Cortex-M4, single precision: \d+ bytes.*; ([\d,]+) instructions", output)
    assert built is None or 100 < int(built[1].replace(",", "")) < 10_000
    assert built or "not compiled for a microcontroller" in output or "not counted" in output
    assert (tmp_path / "c" / "plant.c").exists()


@needs_gcc
def test_the_fmu_is_the_model(tmp_path):
    pytest.importorskip("fmpy")
    assert importlib.import_module("fmu").main(str(tmp_path)) < 1e-12
    assert (tmp_path / "fmu" / "plant.fmu").exists()
