"""Motions in the loop of a controller, through the library and the command line.

The plant is a pendulum that stands on its end, so that a free run from the measured input diverges. `naive_loop` is the
loop written by hand.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from test_cli import run

import orthaug as oa
from orthaug.physics.closed_loop import in_loop

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

TS, ROWS = 0.02, 500
TRUE = {"a": 9.0, "c": 0.3, "b": 2.0}
GAINS = {"Kp": 30.0, "Ki": 10.0, "Kd": 6.0, "filter": 0.02}


def references(seed: int = 1, rows: int = ROWS) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).uniform(-0.4, 0.4, rows // 50), 50)


def naive_loop(r: np.ndarray, noise: float = 0.0, friction: bool = True) -> np.ndarray:
    """Return the measured angle and the torque (N, 2) of a pendulum held by a PID."""
    rng, (a, c, b) = np.random.default_rng(3), TRUE.values()
    x, integral, filtered, found = np.array([0.05, 0.0]), 0.0, 0.0, []

    def field(x: np.ndarray, u: float) -> np.ndarray:
        return np.array([x[1], a * np.sin(x[0]) - c * friction * x[1] + b * u])

    for k in range(len(r)):
        y = x[0] + noise * rng.normal()
        e = r[k] - y
        integral += TS * e
        rate = (e - filtered) / (GAINS["filter"] + TS)
        filtered += TS * rate
        u = GAINS["Kp"] * e + GAINS["Ki"] * integral + GAINS["Kd"] * rate
        found.append((y, u))
        k1 = field(x, u)
        k2 = field(x + TS / 2 * k1, u)
        k3 = field(x + TS / 2 * k2, u)
        x = x + TS / 6 * (k1 + 2 * k2 + 2 * k3 + field(x + TS * k3, u))
    return np.array(found)


def motion(*, learned: bool = False, start: bool = False, **options: Any) -> oa.Motion:
    first = TRUE if start else {"a": 7.0, "c": 0.1, "b": 1.5}
    names = [name for name in first if name != "c" or not learned]
    drag = "" if learned else "- c*rate "
    return oa.Motion.from_equations(
        states=[
            oa.State("angle", "rate", start="angle"),
            oa.State("rate", f"a*sin(angle) {drag}+ b*torque", "derivative of angle", learned),
        ],
        outputs=[oa.Output("angle", "angle")],
        inputs=["torque"],
        parameters=[oa.PhysicalParameter(name, first[name]) for name in names],
        **{"substeps": 1} | options,
    )


def pid(**changed: Any) -> oa.Controller:
    return oa.Controller.pid("torque", "reference", "angle", **GAINS | changed)


def record(measured: np.ndarray, r: np.ndarray, **named: Any) -> oa.Record:
    return oa.Record.from_arrays(
        r, measured, **{"sampling_time": TS, "inputs": ["reference"], "outputs": ["angle"]} | named
    )


def of_loop(noise: float = 0.0, friction: bool = True, **named: Any) -> oa.Record:
    r = references()
    found = naive_loop(r, noise, friction)
    return record(found if "outputs" in named else found[:, 0], r, **named)


WHOLE = oa.Simulation(segment=0, washout=0)


# ---------------------------------------------------------------- the loop


def equations() -> oa.Controller:
    """Return the same PID, by equations."""
    return oa.Controller.from_equations(
        {"torque": "Kp*error + Ki*integral_now + Kd*error_rate"},
        [
            oa.State("integral", "integral_now", 0.0),
            oa.State("filtered", "filtered + Ts*error_rate", 0.0),
        ],
        constants={name: value for name, value in GAINS.items() if name != "filter"} | {"Tf": 0.02},
        define={
            "error": "reference - angle",
            "integral_now": "integral + Ts*error",
            "error_rate": "(error - filtered)/(Tf + Ts)",
        },
    )


def transfer_function() -> oa.Controller:
    """Return the same PID, over the common denominator (z − 1)(z − p)."""
    Kp, Ki, Kd, Tf = GAINS.values()
    pole, gain = Tf / (Tf + TS), Kd / (Tf + TS)
    numerator = (
        Kp * np.polymul([1, -1], [1, -pole])
        + Ki * TS * np.polymul([1, 0], [1, -pole])
        + gain * np.polymul([1, -1], [1, -1])
    )
    return oa.Controller.from_transfer_function(
        "torque",
        "reference",
        "angle",
        list(numerator),
        list(np.polymul([1, -1], [1, -pole])),
    )


@pytest.mark.parametrize("controller", [pid(), equations(), transfer_function()])
def test_the_loop_is_the_one_written_by_hand(controller: oa.Controller) -> None:
    data = of_loop()
    fit = oa.estimate(data, motion(start=True), learner=None, controller=controller)
    start = np.array([0.05, *np.zeros(len(fit.model.state_names) - 1)])
    true = fit.model.numbers._replace(theta=np.array(list(TRUE.values())))
    step = replace(fit.model, numbers=true).step
    outputs = jax.lax.scan(step, start, data.experiments[0].inputs)[1]
    assert np.abs(outputs - data.experiments[0].outputs).max() < 1e-9
    (ran,) = fit.model.simulate(data).trajectories  # from an estimated start
    assert np.abs(ran.model - data.experiments[0].outputs).max() < 1e-8


def test_the_input_at_a_sample_is_the_controllers_and_held() -> None:
    data = of_loop(outputs=["angle", "torque"])
    fit = oa.estimate(data, motion(start=True), learner=None, controller=pid())
    (ran,) = fit.model.simulate(data).trajectories
    assert np.abs(ran.model - data.experiments[0].outputs).max() < 1e-7  # torques of 200
    assert [c.name for c in fit.model.outputs] == ["angle", "torque"]


def test_parameters_of_an_unstable_plant_are_found_from_far() -> None:
    fit = oa.estimate(of_loop(), motion(), learner=None, controller=pid())
    assert fit.status.code == "converged"
    assert fit.values == pytest.approx(list(TRUE.values()), abs=1e-6)


def test_the_measured_input_alone_does_not_train_it() -> None:
    r = references()
    measured = naive_loop(r, 0.002)
    direct = oa.Record.from_arrays(
        measured[:, 1], measured[:, 0], sampling_time=TS, inputs=["torque"], outputs=["angle"]
    )
    alone = oa.estimate(direct, motion(), learner=None, criterion=WHOLE)
    loop = oa.estimate(
        record(measured[:, 0], r), motion(), learner=None, criterion=WHOLE, controller=pid()
    )
    true = np.array(list(TRUE.values()))
    assert np.abs(loop.values / true - 1).max() < 0.05
    assert not alone.status.ok or alone.status.loss > 1e3 * loop.status.loss
    assert not alone.status.ok or np.abs(alone.values / true - 1).max() > 0.2


def test_gains_are_estimated_where_they_are_parameters() -> None:
    gains = [oa.PhysicalParameter("gain", 20.0, min=0), oa.PhysicalParameter("reset", 5.0, "1/s")]
    unknown = pid(Kp="gain", Ki="reset", parameters=gains)
    data = of_loop(outputs=["angle", "torque"])
    fit = oa.estimate(data, motion(), learner=None, controller=unknown)
    assert fit.parameters.loc["gain", "value"] == pytest.approx(30.0, abs=1e-6)
    assert fit.parameters.loc["reset", "value"] == pytest.approx(10.0, abs=1e-6)
    assert fit.parameters.loc["a", "value"] == pytest.approx(9.0, abs=1e-6)


def test_segments_of_a_discrete_plant_begin_at_estimated_states_of_its_controller() -> None:
    rng, r = np.random.default_rng(2), references(4, 400)
    x, w, y = 0.0, 0.0, np.zeros(400)
    for k in range(400):
        y[k] = x
        u = 0.5 * (r[k] - x) + w
        w += 0.1 * (r[k] - x)
        x = 1.1 * x + 0.8 * u
    plant = oa.Motion.from_equations(
        [oa.State("x", "p*x + g*u", "y")],
        [oa.Output("y", "x")],
        [oa.PhysicalParameter("p", 0.9), oa.PhysicalParameter("g", 1.0)],
        ["u"],
        integrator="discrete",
    )
    pi = oa.Controller.from_transfer_function("u", "r", "y", [0.5, -0.4], [1.0, -1.0])
    data = oa.Record.from_arrays(r, y, inputs=["r"], outputs=["y"])
    cut = oa.Simulation(segment=60, washout=0)
    fit = oa.estimate(data, plant, learner=None, controller=pi, criterion=cut)
    assert fit.values == pytest.approx([1.1, 0.8], abs=1e-6)
    assert rng is not None and fit.model.state_names == ("x", "controller_1")


def floating_ball(noise: float, rows: int = 600) -> tuple[np.ndarray, np.ndarray]:
    """Return reference gaps, and measured gaps and currents (N, 2), of a ball under a magnet."""
    rng, step = np.random.default_rng(5), 0.002
    r = 0.010 + np.repeat(rng.uniform(-0.0015, 0.0015, rows // 60), 60)
    x, integral, before, found = np.array([0.010, 0.0]), 0.0, 0.0, []

    def field(x: np.ndarray, u: float) -> np.ndarray:
        return np.array([x[1], 9.81 - 0.002 * (u / x[0]) ** 2])

    for k in range(rows):
        y = x[0] + noise * rng.normal()
        e = r[k] - y
        u = 0.7003 - (400 * e + 9 * (e - before) / step + 1500 * integral)
        u = min(max(u, 0.05), 3.0)
        found.append((y, u))
        integral, before = integral + step * e, e
        for _ in range(4):
            k1 = field(x, u)
            k2 = field(x + step / 8 * k1, u)
            k3 = field(x + step / 8 * k2, u)
            x = x + step / 24 * (k1 + 2 * k2 + 2 * k3 + field(x + step / 4 * k3, u))
    return r, np.array(found)


@pytest.mark.parametrize("outputs", [["gap"], ["gap", "current"]])
def test_predictions_start_from_what_the_controller_has_read(outputs: list[str]) -> None:
    noise, (r, measured) = 1e-5, floating_ball(1e-5)
    plant = oa.Motion.from_equations(
        [
            oa.State("x", "v", "gap"),
            oa.State("v", "9.81 - C*(current/x)**2", "derivative of gap"),
        ],
        [oa.Output("gap", "x")],
        [oa.PhysicalParameter("C", 0.0019)],
        ["current"],
        substeps=4,
    )
    controller = oa.Controller.from_equations(
        {"current": "min(max(0.7003 - (400*e + 9*(e - before)/Ts + 1500*sum), 0.05), 3)"},
        [oa.State("sum", "sum + e*Ts", 0.0), oa.State("before", "e", 0.0)],
        define={"e": "reference - gap"},
    )
    data = oa.Record.from_arrays(
        r,
        measured[:, : len(outputs)],
        sampling_time=0.002,
        inputs=["reference"],
        outputs=outputs,
    )
    fit = oa.estimate(data, plant, learner=None, controller=controller, criterion=WHOLE)
    for horizon in (1, 10):
        error = fit.model.predict(data, horizon=horizon).errors[:, 0]
        error = error[np.isfinite(error)]
        assert len(error) > 400
        assert np.abs(error).max() < 30 * noise  # the plant follows the noise that the law reads
        assert error.std() < 5 * noise


# ---------------------------------------------------------------- learner, saved models, code


@pytest.fixture(scope="module")
def beside_a_learner() -> Any:
    learner = oa.MLP((4,), inputs=("rate",))
    return oa.estimate(
        of_loop(0.001), motion(learned=True), learner=learner, controller=pid(), blocks=0
    )


def test_a_learner_beside_an_unstable_plant(beside_a_learner: Any) -> None:
    fit = beside_a_learner
    assert fit.learns
    for name in ("a", "b"):
        row = fit.parameters.loc[name]
        assert abs(row["value"] - TRUE[name]) < 4 * row["std"]
    assert fit.status.loss < 0.2 * fit.physics_alone.status.loss


def test_a_learner_sees_the_simulated_input_and_no_reference() -> None:
    learner = oa.MLP((3,))
    fit = oa.estimate(of_loop(), motion(learned=True), learner=learner, controller=pid(), blocks=0)
    assert [str(entry) for entry in fit.model.form.features] == ["angle", "rate", "torque"]
    with pytest.raises(oa.InputError, match="unknown name 'reference'"):
        oa.estimate(
            of_loop(),
            motion(learned=True),
            learner=oa.MLP((3,), inputs=("reference",)),
            controller=pid(),
        )


def test_a_saved_loop_simulates_the_same(beside_a_learner: Any, tmp_path: Path) -> None:
    model, other = beside_a_learner.model, record(naive_loop(references(9))[:, 0], references(9))
    oa.save(model, tmp_path / "model")
    again = oa.load(tmp_path / "model")
    for ran, before in zip(
        again.simulate(other).trajectories, model.simulate(other).trajectories, strict=True
    ):
        np.testing.assert_array_equal(ran.model, before.model)
    ahead = again.predict(other, horizon=5).trajectories[0]
    assert np.nanmax(np.abs(ahead.errors)) < 0.02


def test_the_plant_of_a_loop(beside_a_learner: Any, tmp_path: Path) -> None:
    plant, r = beside_a_learner.model.plant, references()[:30]
    measured = naive_loop(r)
    given = oa.Record.from_arrays(
        measured[:, 1], measured[:, 0], sampling_time=TS, inputs=["torque"], outputs=["angle"]
    )
    assert plant.state_names == ("angle", "rate") and plant.step_inputs == ("torque",)
    ran = plant.simulate(given).trajectories[0]
    # 0.6 s without the controller, whose integrator hid a constant torque: five seeds end 0.015 to
    # 0.017 rad off
    assert np.nanmax(np.abs(ran.errors)) < 0.02
    assert oa.numpy_step(beside_a_learner.model).step_inputs == ("torque",)
    program = oa.export(beside_a_learner.model, tmp_path / "code", "c")
    assert [signal.label for signal in program.inputs] == ["torque"]
    assert "no part of it" in (tmp_path / "code" / "README.md").read_text(encoding="utf-8")


def test_a_motion_without_a_controller_is_its_own_plant(beside_a_learner: Any) -> None:
    plant = beside_a_learner.model.plant
    assert plant.plant is plant


# ---------------------------------------------------------------- errors


def refused(match: str, plant: oa.Motion | None = None, **named: Any) -> None:
    controller = named.pop("controller", None) or pid()
    with pytest.raises(oa.InputError, match=match):
        oa.estimate(of_loop(**named), plant or motion(), learner=None, controller=controller)


def by_equations(torque: str, *states: oa.State, **named: Any) -> oa.Controller:
    return oa.Controller.from_equations({"torque": torque}, states, **named)


def test_unknown_names_of_a_controller_are_refused() -> None:
    refused("unknown name 'referense', did you mean 'reference'", controller=pid_of("referense"))
    refused("unknown name 'angel', did you mean 'angle'", controller=by_equations("3*angel"))
    refused("unknown name 'rate'", controller=by_equations("3*angle + rate"))
    other = oa.Controller.pid("torqe", "reference", "angle", Kp=1.0)
    refused("'torqe' is no input of the motion, did you mean 'torque'", controller=other)


def pid_of(reference: str) -> oa.Controller:
    return oa.Controller.pid("torque", reference, "angle", Kp=1.0)


def test_a_loop_without_a_delay_is_refused() -> None:
    plant = oa.Motion.from_equations(
        [oa.State("x", "-p*x + torque", "angle")],
        [oa.Output("angle", "x + 0.1*torque")],
        [oa.PhysicalParameter("p", 1.0)],
        ["torque"],
    )
    refused("algebraic loop: the output 'angle' contains the input 'torque'", plant)
    refused("algebraic loop, ", controller=by_equations("e", define={"e": "angle - torque"}))
    late = by_equations("held", oa.State("held", "3*(reference - angle)", 0.0))
    in_loop(plant, late, of_loop())  # acts a sample later


def test_improper_and_empty_controllers_are_refused() -> None:
    signals = ("torque", "reference", "angle")
    with pytest.raises(oa.InputError, match="improper: its numerator has degree 2"):
        oa.Controller.from_transfer_function(*signals, [1.0, 0.0, 0.0], [1.0, -1.0])
    with pytest.raises(oa.InputError, match="`denominator` is zero"):
        oa.Controller.from_transfer_function(*signals, [1.0], [0.0, 0.0])
    with pytest.raises(oa.InputError, match="list of coefficients"):
        oa.Controller.from_transfer_function(*signals, "1", [1.0])
    with pytest.raises(oa.InputError, match="no gain"):
        oa.Controller.pid(*signals)
    with pytest.raises(oa.InputError, match="0 or more"):
        oa.Controller.pid(*signals, Kp=1.0, filter=-0.1)
    with pytest.raises(oa.InputError, match="must be a number, or an expression"):
        oa.Controller.pid(*signals, Kp=None)  # type: ignore[arg-type]
    with pytest.raises(oa.InputError, match="no outputs"):
        oa.Controller.from_equations({})
    with pytest.raises(oa.InputError, match="has no `next`"):
        oa.Controller.from_equations({"torque": "z"}, [oa.State("z")])
    with pytest.raises(oa.InputError, match="leave `learned` out"):
        oa.Controller.from_equations({"torque": "z"}, [oa.State("z", "z", learned=True)])
    with pytest.raises(oa.InputError, match="must be a finite number"):
        by_equations("K*angle", constants={"K": np.inf})


def test_names_that_are_two_things_are_refused() -> None:
    refused(
        "'rate' is a state of the motion and a state of the controller",
        controller=by_equations("-rate", oa.State("rate", "angle", 0.0)),
    )
    again = oa.PhysicalParameter("a", 1.0)
    refused(
        "'a' is a parameter of the motion and a parameter of the controller",
        controller=by_equations("-a*angle", parameters=[again]),
    )
    refused(
        "'gain' is in no equation",
        controller=by_equations("-angle", parameters=[oa.PhysicalParameter("gain", 1.0)]),
    )


def test_channels_that_do_not_fit_are_refused() -> None:
    refused("reads no measured output", controller=by_equations("3*reference"))
    both = {"inputs": ["torque"], "controller": pid_of("torque")}
    refused("its output and an input of the data", **both)
    plant = oa.Motion.from_equations(
        [oa.State("x", "torque + wind - p*x", "angle")],
        [oa.Output("angle", "x")],
        [oa.PhysicalParameter("p", 1.0)],
        ["torque", "wind"],
    )
    refused("input 'wind' is set neither by it nor by the data", plant)


def test_physics_that_cannot_have_a_controller_are_refused() -> None:
    lagged = oa.Baseline.from_terms([oa.Term("p", "angle[k-1]")])
    with pytest.raises(oa.InputError, match='integrator="discrete"'):
        oa.estimate(of_loop(), lagged, learner=None, controller=pid())  # type: ignore[call-overload]
    functions = oa.Motion.from_functions(
        lambda x, u, p: -p[0] * x + u,
        lambda x, u, p: x,
        ["x"],
        ["angle"],
        [oa.PhysicalParameter("p", 1.0)],
        ["torque"],
    )
    refused("consists of Python functions", functions)
    with pytest.raises(oa.InputError, match=r"Controller\.pid"):
        oa.estimate(of_loop(), motion(), learner=None, controller="pid")  # type: ignore[arg-type]


# ---------------------------------------------------------------- the command line

SPEC = """
[data]
sampling_time = 0.02
inputs = ["reference"]
outputs = ["angle"]
train = { files = ["run.csv"] }
[motion]
substeps = 1
[motion.states]
angle = { derivative = "rate", start = "angle" }
rate = { derivative = "a*sin(angle) - c*rate + b*torque", start = "derivative of angle" }
[motion.outputs]
angle = "angle"
[motion.parameters]
a = { initial = 7.0 }
c = { initial = 0.1 }
b = { initial = 1.5 }
"""
PID = """
[controller]
output = "torque"
Kp = 30.0
Ki = 10.0
Kd = 6.0
filter = 0.02
"""
EQUATIONS = """
[controller.outputs]
torque = "30*e + gain*(i + Ts*e) + Kd*(e - f)/(Tf + Ts)"
[controller.define]
e = "reference - angle"
[controller.states]
i = { next = "i + Ts*e" }
f = { next = "f + Ts*(e - f)/(Tf + Ts)", start = 0.0 }
[controller.parameters]
gain = { initial = 8.0, unit = "N m/s" }
[controller.constants]
Kd = 6.0
Tf = 0.02
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    r = references()
    table = np.column_stack([r, naive_loop(r, 1e-3)])
    np.savetxt("run.csv", table, delimiter=",", header="reference,angle,torque", comments="")
    return tmp_path


@pytest.mark.parametrize("section", [PID, EQUATIONS])
def test_a_spec_with_a_controller(section: str, folder: Path) -> None:
    Path("spec.toml").write_text(SPEC + section, encoding="utf-8")
    checked = json.loads(run("check", "spec.toml", "--json").out)
    assert checked["excitation"]["rank"] == 3 + (section is EQUATIONS)
    assert "closed_loop" not in [warning["code"] for warning in checked["warnings"]]
    assert run("fit", "spec.toml", "--out", "out").code == 0
    result = json.loads(Path("out/result.json").read_text(encoding="utf-8"))
    found = {row["name"]: row["value"] for row in result["parameters"]}
    assert [found[name] for name in TRUE] == pytest.approx(list(TRUE.values()), rel=0.05)
    assert run("simulate", "out", "run.csv", "--out", "ran.csv").code == 0
    assert run("export", "out", "--to", "c", "--out", "code").code == 0
    assert "torque" in Path("code/model.h").read_text(encoding="utf-8")


def test_check_says_what_feedback_biases_and_what_is_consistent(folder: Path) -> None:
    direct = SPEC.replace('inputs = ["reference"]', 'inputs = ["torque"]')
    Path("spec.toml").write_text(direct, encoding="utf-8")
    checked = json.loads(run("check", "spec.toml", "--json").out)
    (text,) = [w["text"] for w in checked["warnings"] if w["code"] == "closed_loop"]
    assert "white noise on the sensor" in text and "`controller` and the reference" in text
    assert "two stages" in text


@pytest.mark.parametrize(
    ("section", "message"),
    [
        (PID + "numerator = [1.0]\n", "`numerator` (a transfer function) and `Kp`"),
        (PID + "[controller.outputs]\ntorque = '3*angle'\n", "expected one of them"),
        (PID.replace("Kp", "Kpp"), "unknown key 'controller.Kpp', did you mean 'Kp'"),
        (
            PID.replace('"torque"', '"torqe"'),
            "'torqe' is in no equation of the motion, did you mean",
        ),
        (PID.replace('output = "torque"\n', ""), "the key `output` is missing"),
        (PID + 'reference = "referense"\n', "did you mean 'reference'"),
        (PID + 'measured = "angel"\n', "did you mean 'angle'"),
        ("[controller]\n", "no controller is given"),
        ('[controller]\noutput = "torque"\nnumerator = [1.0]\n', "`denominator` is missing"),
        (
            '[controller]\noutput = "torque"\nnumerator = [1.0, 0.0]\ndenominator = [1.0]\n',
            "improper",
        ),
        (EQUATIONS.replace('"reference - angle"', '"referense - angle"'), "did you mean"),
        (PID + '[controller.states]\ni = { next = "i" }\n', "expected one of them"),
    ],
)
def test_a_bad_section_is_one_line(section: str, message: str, folder: Path) -> None:
    Path("spec.toml").write_text(SPEC + section, encoding="utf-8")
    answer = run("check", "spec.toml")
    assert answer.code == 2
    assert message in answer.err and len(answer.err.strip().splitlines()) == 1


def test_lagged_physics_have_no_controller(folder: Path) -> None:
    lagged = SPEC.split("[motion]")[0] + (
        '[[baseline.terms]]\nparameter = "p"\nregressor = "angle[k-1]"\n'
    )
    Path("spec.toml").write_text(lagged + PID, encoding="utf-8")
    answer = run("check", "spec.toml")
    assert answer.code == 2
    assert '`integrator` = "discrete"' in answer.err and "arma" in answer.err


def test_a_wrong_gain_is_named_beside_the_friction_that_looks_like_it() -> None:
    """The physics is right: the gain of the rate that is declared is a third too low."""
    r = references(rows=800)
    measured = naive_loop(r, 1e-3, friction=False)[:, :1]
    plant = motion(learned=True)  # without a friction that could imitate the gain
    fit = oa.estimate(record(measured, r), plant, learner=None, controller=pid(Kd=4.0))
    text = fit.diagnose().residuals.text
    assert "the equation of rate lacks something linear in rate" in text
    assert (
        "A wrong constant of the controller may look the same: compare its output with measured "
        "torque." in text
    )
