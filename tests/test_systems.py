"""Systems that write their own equations: Hammerstein-Wiener, and one from outside."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_cli import run

import orthaug as oa
from orthaug import HammersteinWiener, Record
from orthaug.physics.systems import SYSTEMS

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

A, B = np.array([-1.2, 0.5]), np.array([1.0, 2 / 3])


def response(u: np.ndarray, noise: float, curve: Any, bend: float, seed: int = 0) -> np.ndarray:
    """Return 1 + w + bend w² of a curve of the input and a system of order 2, gain 0.3."""
    rng, x, y = np.random.default_rng(seed), np.zeros(2), []
    for v in u:
        w = 0.3 * (B @ x)
        y.append(1.0 + w + bend * w**2 + noise * rng.standard_normal())
        x = np.array([-(A @ x) + curve(v), x[0]])
    return np.array(y)


def steps(rows: int, seed: int) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).uniform(-1.5, 1.5, rows // 2), 2)


def cubic(v: float) -> float:
    return v + 0.3 * v**2 - 0.2 * v**3


@pytest.fixture(scope="module")
def bent() -> Any:
    u = steps(1000, 1)
    record = Record.from_arrays(u=u, y=response(u, 0.02, cubic, 0.05))
    return oa.estimate(record, HammersteinWiener(order=2, output_degree=2), learner=None)


def test_both_curves_are_found(bent: Any) -> None:
    found = bent.parameters
    truth = {
        "a1": -1.2, "a2": 0.5, "b2": 2 / 3, "h1": 0.3, "h2": 0.09, "h3": -0.06, "g2": 0.05, "y0": 1.0
    }  # fmt: skip
    assert set(truth) == set(found.index)
    for name, value in truth.items():
        own = found.loc[name]
        assert abs(own["value"] - value) < 4 * own["std"], name
        assert own["std"] < 0.05 * max(abs(value), 0.1), name


def test_it_predicts_what_it_has_not_seen(bent: Any) -> None:
    u = steps(400, 2)
    test = Record.from_arrays(u=u, y=response(u, 0.0, cubic, 0.05))
    assert bent.model.simulate(test).scores().nrmse[0] < 0.02


def test_a_learned_curve_keeps_its_straight_part_as_h1() -> None:
    """The physics gets the straight line nearest to the true curve over the data (F2)."""
    u = steps(1000, 3)
    record = Record.from_arrays(u=u, y=response(u, 0.02, np.tanh, 0.0))
    system = HammersteinWiener(order=2, input_degree=1, learned="input")
    fit = oa.estimate(record, system, learner=oa.MLP(hidden=(6,), inputs=("u",)))
    assert fit.shared.untouched == ("a1", "a2", "b2")
    line = np.linalg.lstsq(np.column_stack([np.ones(len(u)), u]), np.tanh(u), rcond=None)[0]
    h0, h1 = (fit.parameters.loc[name] for name in ("h0", "h1"))
    assert abs(h1["value"] - 0.3 * line[1]) < 4 * h1["std"] < 0.01
    gain = (1 + A.sum()) / B.sum()  # a constant of the output is one of the curve
    assert abs(h0["value"] - 0.3 * line[0] - gain) < 0.02


def test_several_inputs_and_a_delay() -> None:
    rng = np.random.default_rng(4)
    u = rng.uniform(-1, 1, (600, 2))
    first = response(np.concatenate([np.zeros(2), u[:-2, 0]]), 0.0, cubic, 0.0)
    second = response(np.concatenate([np.zeros(2), u[:-2, 1]]), 0.0, lambda v: 2 * v, 0.0) - 1.0
    y = first + second + 0.02 * rng.standard_normal(600)
    record = Record.from_arrays(u=u, y=y, inputs=["hot", "cold"], outputs=["level"])
    fit = oa.estimate(record, HammersteinWiener(order=2, delay=3), learner=None)
    values = fit.parameters["value"]
    for name, truth in {"h1_hot": 0.3, "h2_hot": 0.09, "h1_cold": 0.6, "h2_cold": 0.0}.items():
        assert abs(values[name] - truth) < 0.02, name


def test_what_it_refuses() -> None:
    record = Record.from_arrays(u=np.zeros((9, 1)), y=np.zeros((9, 2)))
    with pytest.raises(oa.InputError, match="one output and at least one input"):
        HammersteinWiener().motion(record)
    with pytest.raises(oa.InputError, match="too few for a system of order 4"):
        HammersteinWiener(order=4).motion(Record.from_arrays(u=np.arange(9.0), y=np.arange(9.0)))
    for options in (
        {"order": 0},
        {"order": 11},
        {"learned": "both"},
        {"delay": 0.5},
        {"offset": 1},
    ):
        with pytest.raises(oa.InputError):
            HammersteinWiener(**options)  # type: ignore[arg-type]


def write(folder: Path) -> None:
    u = steps(700, 5)
    table = np.column_stack([u, response(u, 0.02, np.tanh, 0.0)])
    np.savetxt(folder / "run.csv", table, delimiter=",", header="valve,flow", comments="")


@pytest.mark.parametrize("learned", ["none", "input"])
def test_init_writes_its_equations_into_a_spec(tmp_path: Path, learned: str) -> None:
    write(tmp_path)
    options = ["--inputs", "valve", "--outputs", "flow", "--out", tmp_path / "spec.toml"]
    system = f"hammerstein_wiener,order=2,input_degree=3,learned={learned}"
    done = run("init", tmp_path / "run.csv", *options, "--system", system)
    assert done.code == 0, done.err
    assert run("check", tmp_path / "spec.toml").code == 0
    text = (tmp_path / "spec.toml").read_text().replace("restarts = 3", "restarts = 1")
    (tmp_path / "spec.toml").write_text(text)
    done = run("fit", tmp_path / "spec.toml", "--out", tmp_path / "out")
    assert done.code == 0, done.err
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["scores"]["tests.last"]["simulation"]["nrmse"][0] < 0.06
    assert (tmp_path / "out" / "report.html").exists()
    names = [row["name"] for row in result["parameters"]]
    assert names == ["a1", "a2", *(["h0"] if learned == "input" else []), "h1", "h2", "h3", "b2",
                     *(["y0"] if learned == "none" else [])]  # fmt: skip
    done = run("export", tmp_path / "out", "--to", "c", "--out", tmp_path / "c")
    assert done.code == 0, done.err


@pytest.mark.parametrize(
    ("system", "words"),
    [
        ("hammer", "did you mean 'hammerstein_wiener'?"),
        ("volterra", "known are hammerstein_wiener"),
        ("hammerstein_wiener,degree=3", "unknown key 'degree'"),
        ("hammerstein_wiener,order", "no key and value"),
        ("hammerstein_wiener,order=0", "1 or more"),
        ("hammerstein_wiener,learned=both", "none, input, output"),
    ],
)
def test_a_system_that_is_none(tmp_path: Path, system: str, words: str) -> None:
    write(tmp_path)
    options = ["--inputs", "valve", "--outputs", "flow", "--out", tmp_path / "spec.toml"]
    done = run("init", tmp_path / "run.csv", *options, "--system", system)
    assert done.code == 2 and words in done.err and "Traceback" not in done.err
    assert not (tmp_path / "spec.toml").exists()


@dataclass(frozen=True)
class Tank:
    """A tank that empties through a hole: a system from outside, in these lines."""

    def motion(self, record: Record) -> oa.Motion:
        level = float(np.mean([one.outputs.mean() for one in record.experiments]))
        return oa.Motion.from_equations(
            states=[oa.State("h", "gain*pump - hole*sqrt(max(h, 0))", start="level", learned=True)],
            outputs=[oa.Output("level", "h")],
            inputs=["pump"],
            parameters=[
                oa.PhysicalParameter("gain", 1.0, min=0),
                oa.PhysicalParameter("hole", 1.0 / np.sqrt(level), min=0),
            ],
        )


def tank_record(seed: int) -> Record:
    """Return the level of a tank whose pump gives the less the fuller it is."""
    rng, h, levels = np.random.default_rng(seed), 1.0, []
    pump = np.repeat(rng.uniform(0.5, 1.5, 20), 15)
    for p in pump:
        levels.append(h)
        for _ in range(20):
            h += 0.005 * (0.8 * p - 0.5 * np.sqrt(h) - 0.02 * h**2)
    y = np.array(levels) + 0.005 * rng.standard_normal(len(levels))
    return Record.from_arrays(u=pump, y=y, sampling_time=0.1, inputs=["pump"], outputs=["level"])


def test_a_system_from_outside_is_one_class(tmp_path: Path) -> None:
    """Fit, split, intervals, analysis, report, saved models and export, without a line elsewhere."""
    with SYSTEMS.with_kind("tank", Tank):
        assert isinstance(SYSTEMS.declare("tank", {}), oa.System)
        fit = oa.estimate(tank_record(1), Tank(), learner=oa.MLP(hidden=(4,), inputs=("h",)))
    assert fit.status.ok and fit.interval is not None and np.isfinite(fit.interval).any()
    assert fit.split(oa.Uniform({"h": (0.8, 1.6), "pump": (0.5, 1.5)})).model.measure == "uniform"
    assert oa.suspected_bias(fit, [oa.MotionSuspect("drag", "h**2", "h")])
    assert oa.diagnose(fit).verdict
    test = tank_record(2)
    assert fit.model.simulate(test).scores().nrmse[0] < 0.1
    oa.save(fit.model, tmp_path / "model")
    again = oa.load(tmp_path / "model").simulate(test).trajectories[0].model
    np.testing.assert_array_equal(again, fit.model.simulate(test).trajectories[0].model)
    fit.report(tmp_path / "report.html")
    assert "hole" in (tmp_path / "report.html").read_text()
    oa.export(fit.model, tmp_path / "c", "c")
    assert list((tmp_path / "c").glob("*.c"))
