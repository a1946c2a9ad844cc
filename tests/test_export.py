"""Exports run for real: every target computes what the model computes, for every kind of model."""

from __future__ import annotations

import csv
import ctypes
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_cli import run

import orthaug as oa
from orthaug import Baseline, Model, Terms, numpy_step
from orthaug.data.expressions import FUNCTIONS, parse, parse_named
from orthaug.data.regressors import Features
from orthaug.export import fmu, nodes
from orthaug.export.kinds import TARGETS
from orthaug.export.lowering import program_of
from orthaug.export.nodes import Number, apply
from orthaug.export.numpy_step import FUNCTIONS as NUMPY_FUNCTIONS
from orthaug.export.numpy_step import NumpyStep
from orthaug.models.beyond import pull_of
from orthaug.models.dynamics import Numbers
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.learners import ACTIVATIONS, Bound
from orthaug.models.moving import MotionDynamics
from orthaug.models.starts import EstimatedStates

POINTS, STEPS = 1000, 2000
STRICT = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion", "-Wshadow")


@dataclass(frozen=True)
class Deep:
    """A network with every activation, as a learner from outside: what an export needs is `layers`."""

    inputs: tuple[str, ...] | None = None

    def init(self, key, nz, ny):
        rng, sizes = np.random.default_rng(5), (nz, *(3,) * len(ACTIVATIONS), ny)
        shapes = zip(sizes[1:], sizes, strict=False)
        return [(rng.normal(size=shape), 0.5 * rng.normal(size=shape[0])) for shape in shapes]

    def layers(self, tree):
        names = [*ACTIVATIONS, "identity"]
        return [(weight, bias, name) for (weight, bias), name in zip(tree, names, strict=True)]

    def apply(self, tree, z):
        for weight, bias, name in self.layers(tree):
            z = ACTIVATIONS[name](weight @ z + bias)
        return z


def lagged(terms, features, learner, outputs, inputs, constants=None) -> Model:
    """A lagged model with arbitrary numbers."""
    rng = np.random.default_rng(len(terms))
    baseline = Baseline.from_terms(terms, constants)
    entries = tuple(parse(text, constants) for text in features)
    lags = {*baseline.lags, *(lag for entry in entries for lag in entry.lags)}
    order = {name: i for i, name in enumerate((*outputs, *inputs))}
    layout = tuple(sorted(lags, key=lambda lag: (order[lag.channel], lag.lag)))
    ny, nt = len(outputs), len(baseline.names)
    bound = Bound.of(learner, len(entries), ny)
    nz = bound.nz
    weights = np.asarray(bound.init(jax.random.key(2)))
    if bound.learns and not weights.any():
        weights = rng.normal(size=weights.shape)
    scaling = (0.2 * rng.normal(size=nz), 1 + rng.random(nz), 0.2 * (1 + rng.random(ny)))
    numbers = Numbers(0.3 * rng.normal(size=nt), 0.1 * rng.normal(size=nt), weights, *scaling)
    return Model(
        form=LaggedDynamics(baseline, Features(entries), layout, outputs, bound),
        numbers=numbers,
        outputs=tuple(oa.Channel(name, "m") for name in outputs),
        inputs=tuple(oa.Channel(name, "N") for name in inputs),
        sampling_time=0.1,
        structure="orthogonal",
        largest_output=np.ones(ny),
        deviation=np.ones(ny),
        weight=np.eye(ny),
    )


def moving(motion: oa.Motion, features=(), learner=None, substeps=2) -> Model:
    """A motion with arbitrary weights."""
    motion = motion.sampled(0.1)
    entries = tuple(parse_named(text, motion.known, "feature") for text in features)
    values = sum(map(len, motion.learned))
    bound = Bound.of(learner, len(entries), values)
    weights = np.asarray(bound.init(jax.random.key(4)))
    q, nz = motion.coordinates.initial, len(entries)
    numbers = Numbers(
        q,
        0.02 * np.ones_like(q),
        weights,
        0.1 * np.ones(nz),
        1.5 * np.ones(nz),
        0.3 * np.ones(values),
    )
    ny = len(motion.outputs)
    return Model(
        form=MotionDynamics(motion, entries, bound, 0.1, substeps),
        numbers=numbers,
        outputs=tuple(oa.Channel(output.name, "m") for output in motion.outputs),
        inputs=tuple(oa.Channel(name, "N") for name in motion.inputs),
        sampling_time=0.1,
        structure="orthogonal",
        largest_output=np.ones(ny),
        deviation=np.ones(ny),
        weight=np.eye(ny),
        starts=EstimatedStates(5, np.ones(len(motion.states))),
    )


TWO_OUTPUTS = [
    oa.Term("a", "tanh(y1[k-1]) + 0.5*y1[k-3]", output="y1"),
    oa.Term("a", "sin(gain*y2[k-2])", output="y2"),  # θ shared
    oa.Term("known", "cos(y2[k-1]) - floor(2*u1[k])/3", 0.25, output="y1", fixed=True),
    oa.Term("b", "max(min(3*u1[k-4], limit, 1), -limit)*atan2(u2[k], 2)", output="y2"),
    oa.Term("c", "sqrt(abs(u2[k-2]))*sign(u1[k]) - (-u2[k])**3/(1 + u1[k]**2)**2", output="y1"),
    oa.Term("d", "exp(-abs(y1[k-1]))**1.5 - (u1[k] - (u2[k] - 1)) + 2**-2", output="y2"),
    oa.Term(
        "e",
        "log(2 + atan(u2[k-1]))/(tan(0.3) + y2[k-1]**gain) + (1 + abs(u1[k]))**-0.5",
        output="y2",
    ),
    oa.Term("f", "-(2 + abs(u1[k-1]))**-2 + u2[k]/(gain*limit)", output="y1"),
]
POSITIVE = [oa.PhysicalParameter(n, v, min=0) for n, v in (("m", 1.3), ("c", 2.7), ("k", 9.0))]


def spring(**options) -> oa.Motion:
    return oa.Motion.from_equations(
        states=[
            oa.State("x", "v", unit="m"),
            oa.State("v", "(total - drag*v)/m", learned=True, unit="m/s"),
        ],
        outputs=[oa.Output("y", "x + 0.1*v**2", learned=True), oa.Output("rate", "v + 0.01*u")],
        inputs=["u", "w"],
        parameters=[*POSITIVE, oa.PhysicalParameter("offset", -0.2)],
        constants={"limit": 0.8},
        define={
            "drag": "c + abs(v)",
            "total": "max(min(u, limit), -limit) + w - k*x - k*offset*x**3",
        },
        **options,
    )


DISCRETE = oa.Motion.from_equations(
    states=[oa.State("a", "0.6*a + 0.3*sin(θ*b)"), oa.State("b", "0.5*b - g*a/(1 + a**2) + Ts")],
    outputs=[oa.Output("y", "a*b")],
    parameters=[oa.PhysicalParameter("θ", 1.2), oa.PhysicalParameter("g", 0.7, "m/s²", min=0)],
    integrator="discrete",
)


def two_masses_rates(x, u, p):
    """A cart with a pole, by a solution of its equations of forces; d slows down large speeds."""
    forces = jnp.array([u[0] - p[1] * x[2] * jnp.abs(x[2]), -p[0] * jnp.sin(x[1])])
    drag = jnp.where(p[1] > 0.1, 0.2, 5.0) * x[2:]
    return jnp.concatenate([x[2:], jnp.linalg.solve(two_masses_inertia(x, p), forces - drag)])


def two_masses_inertia(x, p):
    side = 0.4 * jnp.cos(x[1])
    return jnp.array([[1 + p[0], side], [side, 0.5]])


def two_masses(forces: bool) -> oa.Motion:
    states = [oa.State(s) for s in ("s", "a", "v")] + [oa.State("w", learned=True)]
    names = (("force", "N"), ("torque", "N m"))
    return oa.Motion.from_functions(
        two_masses_rates,
        lambda x, u, p: x[:2] + p[1] * u,
        states,
        ["y", oa.Output("angle", learned=True)],
        [oa.PhysicalParameter("m", 0.8, min=0), oa.PhysicalParameter("d", 0.3)],
        ["u"],
        **({"mass": oa.MassMatrix(two_masses_inertia, (2, 3), names)} if forces else {}),
    )


LINEAR = [oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]", unit="m/N"), oa.Term("c", "u[k-2]")]
MODELS: dict[str, Callable[[], Model]] = {
    "several outputs, every activation": lambda: lagged(
        TWO_OUTPUTS,
        ("y1[k-1]", "gain*u1[k-1]", "u2[k]*y2[k-2]"),
        Deep(),
        ("y1", "y2"),
        ("u1", "u2"),
        {"gain": 2.0, "limit": 0.7},
    ),  # fmt: skip
    "terms": lambda: lagged(
        LINEAR, ("tanh(y[k-1])", "u[k-1]**2"), Terms(("tanh(y[k-1])", "u[k-1]**2")), ("y",), ("u",)
    ),
    "network": lambda: lagged(LINEAR, ("y[k-1]", "u[k-1]"), oa.MLP((16,)), ("y",), ("u",)),
    "network that is held": lambda: limited(
        lagged(LINEAR, ("y[k-1]", "u[k-1] - 2*u[k-2]"), oa.MLP((16,)), ("y",), ("u",))
    ),
    "network of one input, fading": lambda: limited(
        lagged(LINEAR, ("y[k-1]",), oa.MLP((16, 1, 4), beyond="fade"), ("y",), ("u",))
    ),
    "physics alone, no feedback": lambda: lagged(
        [oa.Term("a", "double[k]")], (), None, ("flag",), ("double",)
    ),
    "motion without inputs": lambda: moving(
        oa.Motion.from_equations(
            states=[
                oa.State("x", "v", start=0),
                oa.State("v", "9 - k*sin(x) - 0.3*v", start=0, learned=True),
            ],
            outputs=[oa.Output("y", "x")],
            parameters=[oa.PhysicalParameter("k", 12.0)],
        ),
        ("v", "sin(x)"),
        oa.MLP((3,)),
    ),
    "motion, first-order hold": lambda: moving(
        spring(hold="first-order"), ("v", "x*u"), oa.MLP((5, 4), "silu"), substeps=2
    ),
    "motion that fades": lambda: limited(
        moving(spring(), ("v", "x - w"), oa.MLP((5,)), substeps=2)
    ),
    "motion, exact, held": lambda: limited(
        moving(spring(integrator="exact"), ("v", "w"), oa.MLP((5,), beyond="hold"), substeps=1)
    ),
    "motion, one scaled input": lambda: moving(spring(), ("v/3",), oa.MLP((5,)), substeps=1),
    "motion, functions": lambda: moving(two_masses(forces=False), ("v", "w"), oa.MLP((5,))),
    "motion, functions and forces": lambda: moving(two_masses(forces=True), ("w",), oa.MLP((5,))),
    "motion, functions and forces that fade": lambda: limited(
        moving(two_masses(forces=True), ("v", "u"), oa.MLP((5,)))
    ),
    "motion, discrete, no inputs": lambda: moving(DISCRETE, substeps=1),
}


def limited(model):
    """The same with a correction that is held, or fades, beyond half of what the tests reach."""
    form, nz = model.form, len(model.numbers.centre)
    n = (
        len(form.layout)
        if isinstance(form, LaggedDynamics)
        else form.states + len(form.motion.inputs)
    )

    def features(points):
        if isinstance(form, LaggedDynamics):
            return np.asarray(form.features.evaluate(points, form.layout, np))
        return np.asarray(form.seen(points[:, : form.states].T, points[:, form.states :].T, np)).T

    points = np.random.default_rng(3).uniform(-1, 1, (50, n))
    limits = np.stack([np.full(nz, -0.4), np.full(nz, 0.6)])
    return replace(
        model, numbers=model.numbers._replace(limits=limits, pull=pull_of(features, points))
    )


@dataclass(frozen=True)
class Case:
    model: Model
    state: np.ndarray
    inputs: np.ndarray
    stepped: tuple[np.ndarray, np.ndarray]
    """Next states and outputs of single steps."""
    free: np.ndarray
    """The outputs of a free run."""


@cache
def case(name: str, steps: int = STEPS) -> Case:
    """A model with what it says itself, with a free run of so many steps."""
    model, rng = MODELS[name](), np.random.default_rng(0)
    state = rng.normal(size=(POINTS, len(model.state_names)))
    inputs = rng.normal(size=(steps, len(model.step_inputs)))
    stepped = jax.jit(jax.vmap(model.step))(state, inputs[:POINTS])
    free = jax.jit(lambda s, u: jax.lax.scan(model.step, s, u)[1])(np.zeros(state.shape[1]), inputs)
    assert np.isfinite(free).all() and np.ptp(free) > 0.01
    return Case(model, state, inputs, tuple(map(np.asarray, stepped)), np.asarray(free))


def near(found: np.ndarray, expected: np.ndarray, relative: float) -> None:
    largest = np.abs(expected).max(axis=0)
    assert found.shape == expected.shape
    assert (np.abs(found - expected).max(axis=0, initial=0.0) <= relative * largest).all()


def imported(path: Path):
    spec = importlib.util.spec_from_file_location(f"exported_{path.parent.name}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run_numpy(folder: Path, given: Case):
    module = imported(folder / "plant.py")
    steps = [module.step(s, u) for s, u in zip(given.state, given.inputs, strict=False)]
    yield (
        "float64",
        (*map(np.array, zip(*steps, strict=True)), module.run(module.start(), given.inputs)),
    )


def run_casadi(folder: Path, given: Case):
    step = imported(folder / "plant.py").step()
    following, y = (
        np.array(part).T for part in step.map(POINTS)(given.state.T, given.inputs[:POINTS].T)
    )
    free = step.mapaccum(len(given.inputs))(np.zeros(given.state.shape[1]), given.inputs.T)[1]
    yield "float64", (following, y, np.array(free).T)


def run_control(folder: Path, given: Case):
    import control

    plant = imported(folder / "plant.py").system()
    rows = list(zip(given.state, given.inputs, strict=False))
    single = [np.array([ask(0.0, s, u) for s, u in rows]) for ask in (plant.dynamics, plant.output)]
    time = 0.1 * np.arange(len(given.inputs))
    free = control.input_output_response(
        plant, time, given.inputs.T, np.zeros(given.state.shape[1]), squeeze=False
    )
    yield "float64", (*single, free.outputs.T)


def run_fmu(folder: Path, given: Case):
    import fmpy
    from fmpy.fmi2 import FMU2Slave
    from fmpy.validation import validate_fmu

    assert validate_fmu(str(folder / "plant.fmu")) == []
    described = fmpy.read_model_description(str(folder / "plant.fmu"))
    place = fmpy.extract(str(folder / "plant.fmu"), folder.parent / "unpacked")
    stated = [v for v in described.modelVariables if v.unit]
    assert all(v.description.endswith(f" [{v.unit}]") for v in stated)
    assert {v.unit for v in stated} == {unit.name for unit in described.unitDefinitions}
    by = {kind: [v.valueReference for v in described.modelVariables if v.causality == kind] for kind in
          ("input", "output", "local")}  # fmt: skip
    fmu = FMU2Slave(
        guid=described.guid, unzipDirectory=place, modelIdentifier="plant", instanceName="one"
    )
    fmu.instantiate()
    fmu.setupExperiment(startTime=0.0)
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()

    def step(k: int) -> list[float]:
        fmu.setReal(by["input"], given.inputs[k].tolist())
        y = fmu.getReal(by["output"])
        fmu.doStep(currentCommunicationPoint=0.1 * k, communicationStepSize=0.1)
        return y

    free = np.array([step(k) for k in range(len(given.inputs))])
    following, y = [], []
    for k, state in enumerate(given.state):
        fmu.setReal(by["local"], state.tolist())
        y.append(step(k))
        following.append(fmu.getReal(by["local"]))
    fmu.terminate()
    fmu.freeInstance()
    yield "float64", (np.array(following), np.array(y), free)


def run_onnx(folder: Path, given: Case):
    import onnxruntime

    session = onnxruntime.InferenceSession(
        str(folder / "plant.onnx"), providers=["CPUExecutionProvider"]
    )
    wanted = {value.name for value in session.get_inputs()}
    n = given.state.shape[1]

    def step(state, row):
        fed = {name: value for name, value in (("state", state), ("inputs", row)) if name in wanted}
        names = [value.name for value in session.get_outputs()]
        found = dict(zip(names, session.run(names, fed), strict=True))
        return found.get("next_state", np.zeros(0)), found["outputs"]

    state, free = np.zeros(n), []
    for row in given.inputs:
        state, y = step(state, row)
        free.append(y)
    single = [step(s, u) for s, u in zip(given.state, given.inputs, strict=False)]
    yield "float64", (*map(np.array, zip(*single, strict=True)), np.array(free))


def run_c(folder: Path, given: Case):
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    for precision, options in (("float64", ()), ("float32", ("-DPLANT_FLOAT",))):
        shared = folder.parent / f"{folder.name}_{precision}.so"
        made = [
            compiler,
            *STRICT,
            *options,
            "-shared",
            "-fPIC",
            "plant.c",
            "-lm",
            "-o",
            str(shared),
        ]
        subprocess.run(made, cwd=folder, check=True)
        yield precision, run_library(ctypes.CDLL(str(shared)), given, np.dtype(precision))
    checking = [
        compiler,
        *STRICT,
        "-fsanitize=address,undefined",
        "-fno-sanitize-recover=all",
        "plant.c",
        "check.c",
    ]
    subprocess.run([*checking, "-lm", "-o", "../check"], cwd=folder, check=True)
    done = subprocess.run(["../check"], cwd=folder, check=True, capture_output=True, text=True)
    assert done.stdout.startswith("64 steps: ") and done.stderr == ""


def run_library(library, given: Case, dtype: np.dtype):
    """Steps and the free run by a shared library; a state is its numbers, then the flag."""
    n, ny = given.state.shape[1], given.free.shape[1]
    state = np.zeros(1, np.dtype([("x", dtype, n), ("flag", np.intc)], align=True))
    inputs, y = (
        np.ascontiguousarray(given.inputs, dtype=dtype),
        np.zeros((len(given.inputs), ny), dtype=dtype),
    )

    def at(array: np.ndarray) -> ctypes.c_void_p:
        return ctypes.c_void_p(array.ctypes.data)

    following = []
    for k in range(POINTS):
        state["x"] = given.state[k]
        library.plant_step(at(state), at(inputs[k:]), at(y[k:]))
        following.append(state["x"][0].copy())
    single = np.array(following), y[:POINTS].copy()
    library.plant_start(at(state))
    library.plant_run.restype = ctypes.c_size_t
    assert library.plant_run(at(state), at(inputs), at(y), ctypes.c_size_t(len(inputs))) == 0
    run = y.copy()
    flagged_steps(library.plant_step, state, inputs[:1].copy(), y, at)
    return *single, run


def flagged_steps(step, state, row, y, at) -> None:
    """NaN and infinity in the inputs or the state are flagged, and the state stays; then it goes on."""
    good = state.copy()
    for bad in (np.nan, np.inf, -np.inf):
        for where in ("inputs", "state"):
            given, held = row.copy(), good.copy()
            if where == "inputs":
                given[:] = bad
            else:
                held["x"] = bad
            if not (given if where == "inputs" else held["x"]).size:
                continue
            state[:] = held
            step(at(state), at(given), at(y))
            if where == "inputs" or not np.isfinite(y[0]).all():
                assert state["flag"][0] == 1
                np.testing.assert_array_equal(state["x"], held["x"])
    state[:] = good
    step(at(state), at(row), at(y))
    assert state["flag"][0] == 0


NEEDED = {
    "casadi": ["casadi"],
    "control": ["control"],
    "fmu": ["fmpy"],
    "onnx": ["onnx", "onnxruntime"],
}
RUNS = {
    "numpy": run_numpy,
    "c": run_c,
    "casadi": run_casadi,
    "control": run_control,
    "fmu": run_fmu,
    "onnx": run_onnx,
}


@pytest.mark.parametrize("target", RUNS)
@pytest.mark.parametrize("name", MODELS)
def test_an_export_computes_what_the_model_computes(tmp_path, name, target):
    for package in NEEDED.get(target, []):
        pytest.importorskip(package)
    given = case(name)
    oa.export(given.model, tmp_path / target, target, name="plant")
    for precision, (following, y, free) in RUNS[target](tmp_path / target, given):
        relative = {"float64": 1e-12, "float32": 1e-5}[precision]
        near(following, given.stepped[0], relative)
        near(y, given.stepped[1], relative)
        near(free, given.free, relative)


@pytest.mark.proof
@pytest.mark.parametrize("target", ["casadi", "fmu"])
@pytest.mark.parametrize("name", [name for name in MODELS if name.startswith("motion")])
def test_a_motion_runs_for_ten_thousand_steps_elsewhere(tmp_path, name, target):
    pytest.importorskip(*NEEDED[target])
    given = case(name, 10_000)
    oa.export(given.model, tmp_path / target, target, name="plant")
    ((_, (_, _, free)),) = RUNS[target](tmp_path / target, given)
    near(free, given.free, 1e-9)


ARM = ("arm-none-eabi-gcc", "arm-none-eabi-size", "qemu-system-arm")
CORTEX_M4 = (
    *("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror"),
    *("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-DPLANT_FLOAT"),
)
NS_PER_TICK = 40  # of the board's timer; the emulated processor takes 1 ns for an instruction


@pytest.mark.proof
@pytest.mark.skipif(not all(map(shutil.which, ARM)), reason=f"needs {', '.join(ARM)}")
@pytest.mark.parametrize("name", ["network", "motion, first-order hold"])
def test_single_precision_runs_on_a_cortex_m4(tmp_path, name, record_property):
    """The emulator counts instructions; most of a Cortex-M4 take one cycle, memory and branches more."""
    oa.export(MODELS[name](), tmp_path / "plant", "c", name="plant")
    board = Path(__file__).parent / "fixtures" / "cortex_m4"

    def run_of(*sources: object) -> str:
        arm, _, emulator = ARM
        made = [arm, *CORTEX_M4, "-I.", board / "startup.c", "plant.c", *sources]
        linked = ["-T", board / "board.ld", "--specs=rdimon.specs", "-lm", "-o", "plant.elf"]
        subprocess.run([*made, *linked], cwd=tmp_path / "plant", check=True)
        machine = ["-M", "mps2-an386", "-nographic", "-icount", "shift=0"]
        output = ["-semihosting-config", "enable=on,target=native", "-kernel", "plant.elf"]
        done = subprocess.run(
            [emulator, *machine, *output],
            **{"cwd": tmp_path / "plant", "check": True, "timeout": 60},
            **{"capture_output": True, "text": True},
        )
        return done.stdout

    checked = re.fullmatch(
        r"64 steps: largest difference (\S+), largest output (\S+), 0 flagged\s*",
        run_of("check.c"),
    )
    assert checked and float(checked[1]) < 1e-5 * float(checked[2])
    timed = re.fullmatch(r"(\d+) ticks for 1000 steps, flag 0\s*", run_of(board / "timed.c"))
    assert timed
    compiled = [ARM[0], *CORTEX_M4, "-c", "plant.c"]
    subprocess.run(compiled, cwd=tmp_path / "plant", check=True)
    sizes = subprocess.run(
        [ARM[1], "plant.o"], cwd=tmp_path / "plant", check=True, capture_output=True, text=True
    )
    text, data, bss = map(int, sizes.stdout.splitlines()[1].split()[:3])
    assert text < 4096 and data == bss == 0
    record_property("bytes of code and constants", text)
    record_property("instructions of a step", int(timed[1]) * NS_PER_TICK // 1000)


def test_code_computes_nothing_that_it_does_not_read(tmp_path):
    model = limited(lagged(LINEAR[:1], ("y[k-1]", "w[k-1]"), oa.MLP((2,)), ("y",), ("w",)))
    oa.export(model, tmp_path / "c", "c", name="plant")
    text = (tmp_path / "c/plant.c").read_text()
    named = re.findall(r"const real (h_\w+) =", text)
    assert named and all(len(re.findall(rf"\b{name}\b", text)) > 1 for name in named)


@pytest.mark.proof
def test_python_control_linearizes_the_model_as_it_does_itself(tmp_path):
    control = pytest.importorskip("control")
    given = case("network")
    oa.export(given.model, tmp_path, "control", name="plant", force=True)
    x, u = 0.1 * given.state[0], 0.1 * given.inputs[0]
    found = control.linearize(imported(tmp_path / "plant.py").system(), x, u, eps=1e-6)
    (a, b), (c, d) = jax.jacobian(given.model.step, argnums=(0, 1))(x, u)
    for by_control, own in zip((found.A, found.B, found.C, found.D), (a, b, c, d), strict=True):
        np.testing.assert_allclose(by_control, own, atol=1e-5 * (1 + np.abs(own).max()))


@pytest.mark.parametrize("name", MODELS)
def test_a_step_in_numpy_alone(name):
    given, step = case(name), numpy_step(case(name).model)
    assert (step.state_names, step.step_inputs) == (
        given.model.state_names,
        given.model.step_inputs,
    )
    following, y = map(
        np.array,
        zip(*(step(s, u) for s, u in zip(given.state, given.inputs, strict=False)), strict=True),
    )
    near(following, given.stepped[0], 1e-12)
    near(y, given.stepped[1], 1e-12)
    with pytest.raises(oa.InputError, match="a step takes a state of"):
        step(np.zeros(99), given.inputs[0])


def record_for(model: Model, rows: int = 40) -> oa.Record:
    rng = np.random.default_rng(1)
    u, y = (rng.normal(size=(rows, len(channels))) for channels in (model.inputs, model.outputs))
    return oa.Record.from_arrays(
        u, y, inputs=model.inputs, outputs=model.outputs, sampling_time=0.1
    )


@pytest.mark.parametrize("name", ["several outputs, every activation", "motion, first-order hold"])
def test_steps_from_a_start_are_the_free_run(name):
    model = case(name).model
    record = record_for(model)
    first, u = model.form.first_row, record.experiments[0].inputs
    rows = (
        u
        if len(model.step_inputs) == u.shape[1]
        else np.concatenate([u, np.vstack([u[1:], u[-1:]])], axis=1)
    )
    start = model.start(record)
    last, y = jax.jit(lambda s, u: jax.lax.scan(model.step, s, u))(start, rows[first:-1])
    np.testing.assert_allclose(y, model.simulate(record).model[first:-1], rtol=1e-9, atol=1e-12)
    if first:  # the state says what it holds
        named = dict(zip(model.state_names, start, strict=True))
        assert (
            named["u1[k-4]"] == u[first - 4, 0]
            and named["y1[k-3]"] == record.experiments[0].outputs[first - 3, 0]
        )
        assert model.start(record, row=40)[0] == record.experiments[0].outputs[39, 0]
    else:
        np.testing.assert_allclose(model.start(record, row=39), last, rtol=1e-9)
    assert jax.jacobian(lambda s: model.step(s, rows[0])[1])(start).shape == (
        len(model.outputs),
        len(start),
    )


@pytest.mark.parametrize("name", ["network", "motion, first-order hold"])
def test_arguments_of_a_step_are_checked(name):
    model = case(name).model
    n, nu = len(model.state_names), len(model.step_inputs)
    for state, inputs in (
        (np.zeros(n + 1), np.zeros(nu)),
        (np.zeros(n), 0.0),
        (np.zeros((1, n)), np.zeros(nu)),
    ):
        with pytest.raises(
            oa.InputError, match=f"a step takes a state of {n} and inputs of {nu} numbers"
        ):
            model.step(state, inputs)
    with pytest.raises(oa.InputError, match="a step takes two vectors of numbers"):
        model.step("x", np.zeros(nu))


def test_starts_that_are_refused_in_words():
    model = case("network").model
    record = record_for(model)
    for given, row, words in (
        (oa.Record.join([record, record]), None, "the record has 2 experiments"),
        (replace(record, outputs=(), experiments=(replace(record.experiments[0], outputs=np.zeros((40, 0))),)), None,
         "no measured outputs to start from"),
        (record, 1, "`row` must be a whole number from 2 to 40"),
        (record, "x", "`row` must be a whole number"),
    ):  # fmt: skip
        with pytest.raises(oa.InputError, match=words):
            model.start(given, row=row)


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_activations_are_those_of_the_learners(name):
    a = np.array([-800.0, -30.0, -2.5, -1e-9, 0.0, 1e-9, 0.7, 3.0, 40.0, 800.0])
    with np.errstate(all="ignore"):
        found = NumpyStep(program_of(case("terms").model))._evaluation(nodes.ACTIVATIONS[name])(
            {"a": a}
        )
    np.testing.assert_allclose(found, ACTIVATIONS[name](jnp.asarray(a)), rtol=1e-14, atol=1e-15)


def test_arithmetic_on_numbers_follows_floating_point():
    assert apply("div", Number(1.0), Number(0.0)) == Number(np.inf)
    assert apply("whole_power", Number(-2.0), Number(3.0)) == Number(-8.0)
    assert set(FUNCTIONS) <= set(NUMPY_FUNCTIONS)


def test_what_is_written_beside_the_code(tmp_path):
    model = case("network").model
    oa.save(model, tmp_path / "model")
    for target in ("c", "casadi", "control", "numpy", "latex"):
        program = oa.export(model, tmp_path / target, target, name="plant")
        text = (tmp_path / target / "README.md").read_text()
        assert f'"checksum": "{program.digest}"' in (tmp_path / "model" / "model.json").read_text()
        assert program.digest in text and "`u` [N]" in text and "0.1 s" in text
        assert ("`-ffast-math`, which takes NaN for impossible." in text) == (target == "c")
        assert any(
            program.digest in path.read_text() for path in (tmp_path / target).glob("plant.*")
        )
        assert (tmp_path / target / "vectors.csv").read_text() == (
            tmp_path / "c" / "vectors.csv"
        ).read_text()
    with open(tmp_path / "c" / "vectors.csv", newline="") as file:
        head, *rows = csv.reader(file)
    assert head == ["input:u", "state:y[k-1]", "state:u[k-1]", "state:u[k-2]", "output:y"]
    numbers = np.array(rows, dtype=float)
    y = np.asarray(jax.vmap(model.step)(numbers[:, 1:4], numbers[:, :1])[1])
    np.testing.assert_allclose(numbers[:, 4:], y, rtol=1e-13, atol=1e-15)
    source = (tmp_path / "c" / "plant.c").read_text()
    assert "/* b [m/N], theta - theta_aux */" in source and "malloc" not in source


def test_what_an_export_needs_is_named_where_it_is_missing(tmp_path, monkeypatch):
    model = case("network").model
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(
        oa.InputError, match="the package onnx, which is not installed; pip install onnx"
    ):
        oa.export(model, tmp_path / "out", "onnx")
    monkeypatch.setattr(fmu, "_target", lambda: ("linux64", ".so"))
    # A script is no program
    failing = [(str(tmp_path / "bin"), "cc failed: no licence")] if os.name == "posix" else []
    for path, words in [("", "no C compiler was found"), *failing]:
        monkeypatch.setenv("PATH", path)
        (tmp_path / "bin").mkdir(exist_ok=True)
        (tmp_path / "bin" / "cc").write_text("#!/bin/sh\necho no licence >&2\nexit 1\n")
        (tmp_path / "bin" / "cc").chmod(0o755)
        with pytest.raises(oa.InputError, match=words):
            oa.export(model, tmp_path / "out", "fmu")
    monkeypatch.undo()
    monkeypatch.setattr(sys, "platform", "plan9")
    with pytest.raises(oa.InputError, match="compiled for 64-bit x86 under Linux or macOS"):
        oa.export(model, tmp_path / "out", "fmu")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("term", "rows"), [("log(y[k-1])", 1), ("log(-1 - y[k-1]**2)", 0)])
def test_vectors_of_a_model_without_values_at_zero(tmp_path, term, rows):
    """A free run that cannot start at zero starts at one; where it cannot start at all, there is nothing to compare."""
    model = lagged([oa.Term("a", term)], (), None, ("y",), ("u",))
    oa.export(model, tmp_path / "c", "c")
    lines = (tmp_path / "c" / "vectors.csv").read_text().splitlines()
    assert (len(lines) > 1) == bool(rows)
    compiler = shutil.which("gcc") or pytest.skip("no C compiler")
    subprocess.run(
        [compiler, *STRICT, "model.c", "check.c", "-lm", "-o", "check"],
        cwd=tmp_path / "c",
        check=True,
    )
    done = subprocess.run(
        ["./check"], cwd=tmp_path / "c", check=True, capture_output=True, text=True
    )
    assert done.stdout.startswith(f"{len(lines) - 1} steps")


def test_vectors_start_where_the_outputs_stay_finite_for_longest(tmp_path):
    """From zero the second step has no value, from one the third."""
    model = lagged([oa.Term("a", "log(y[k-1] + 1e-9)")], (), None, ("y",), ("u",))
    oa.export(model, tmp_path / "c", "c")
    head, first, *_ = csv.reader((tmp_path / "c" / "vectors.csv").read_text().splitlines())
    assert float(first[next(i for i, name in enumerate(head) if "y" in name)]) == 1.0


def test_equations_in_latex(tmp_path):
    for name in MODELS:
        oa.export(case(name).model, tmp_path, "latex")
        text = (tmp_path / "model.tex").read_text(encoding="utf-8")
        assert all(
            text.count(f"\\begin{{{what}}}") == text.count(f"\\end{{{what}}}")
            for what in ("align*", "pmatrix")
        )
        assert text.count("{") == text.count("}") and text.count(r"\left") == text.count(r"\right")
    assert r"a_{k+1} &= 0.6 \, a + 0.3 \, \sin\left(θ \, b\right)" in text
    assert r"\DeclareUnicodeCharacter{03B8}{\ensuremath{\theta}}" in text
    oa.export(case("terms").model, tmp_path, "latex")
    text = (tmp_path / "model.tex").read_text(encoding="utf-8")
    assert r"y_{k} &= a \, y_{k-1} + b \, u_{k-1} + c \, u_{k-2} + g^{y}_{1}" in text
    assert r"\frac{\tanh\left(y_{k-1}\right)" in text


HOSTILE = (
    *(
        r"\input{/etc/passwd}",
        r"\write18{id}",
        "}{",
        "a~b",
        "a^b",
        "^^5cinput",
        "100 %",
        "m_2",
        "$x$",
        "&",
        "#1",
        "{",
    ),
    *("\\\\", r"\end{document}", r"\catcode`\@=0", "a|b", "<m>", '"', "`", r"\\[1em]\hline"),
)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_unit_is_text_in_latex(tmp_path, name):
    """Read as TeX does: what is left after the commands of the escape is the unit, letter for letter."""
    letters = {
        "textbackslash": "\\",
        "textasciicircum": "^",
        "textasciitilde": "~",
        "textless": "<",
    }
    letters |= {"textgreater": ">", "textbar": "|", "textquotedbl": '"', "textasciigrave": "`"}
    model = case("terms").model
    first = model.form.baseline.terms[0]
    terms = (replace(first, unit=name), *model.form.baseline.terms[1:])
    parameters = (
        replace(model.form.baseline.parameters[0], unit=name),
        *model.form.baseline.parameters[1:],
    )
    form = replace(
        model.form, baseline=replace(model.form.baseline, terms=terms, parameters=parameters)
    )
    oa.export(replace(model, form=form), tmp_path, "latex")
    row = next(
        r
        for r in (tmp_path / "model.tex").read_text(encoding="utf-8").splitlines()
        if r.startswith("$a$ &")
    )
    cell = row.rsplit(" & ", 1)[1].removesuffix(r" \\")
    read = re.sub(r"\\(?:([a-z]+)\{\}|([_%&#${}]))|([\\{}_%&#$^~])", _plainly(letters), cell)
    assert f"[{name}]" in read or name in read


def _plainly(letters):
    def letter(found):
        assert not found[3], f"{found[3]} begins something"
        return letters[found[1]] if found[1] else found[2]

    return letter


def opaque(model: Model, **changed) -> Model:
    return replace(model, form=replace(model.form, **changed))


def refusals():
    network = case("network").model
    function = oa.Function(lambda w, z: w * z[:1], lambda key: jnp.ones(1))
    own = oa.Baseline.from_function(lambda x: jnp.ones((1, 3)), ["a", "b", "c"])
    members = network.numbers._replace(weights=np.ones((3, 5)), tilt=np.zeros((3, 3)))
    yield (
        opaque(network, bound=Bound(function, 2, 1)),
        "the learner Function is a function that no target can write; fit",
    )
    yield opaque(network, baseline=own), "the physics is a Python function"
    yield replace(network, numbers=members), "the model is an ensemble"
    broken = network.numbers._replace(gain=np.array([np.nan]))
    yield replace(network, numbers=broken), "the model holds numbers that are not finite"
    yield 5, "`model` must be a fitted model"
    yield (
        moving(spring(hold="spline"), ("v", "w"), oa.MLP((2,))),
        "a step cannot interpolate by a spline over the whole record",
    )
    for f, words in (
        (
            lambda x, u, p: jax.lax.fori_loop(0, 3, lambda i, x: jnp.sin(x), x),
            "the motion is a function with 'scan'",
        ),
        (
            lambda x, u, p: jnp.where(x > 0, x, p),
            "the motion is a function with 'gt' of a state or an input",
        ),
    ):
        made = oa.Motion.from_functions(
            f, lambda x, u, p: x, ["x"], ["y"], [oa.PhysicalParameter("a", 1.0)]
        )
        yield moving(made), words


def test_models_without_code_are_refused_in_words(tmp_path):
    for model, words in refusals():
        for target in TARGETS:
            with pytest.raises(oa.InputError) as error:
                oa.export(model, tmp_path / "out", target)
            assert str(error.value).startswith(words)
        with pytest.raises(oa.InputError):
            numpy_step(model)
    assert list(tmp_path.iterdir()) == []


def test_an_exchanged_folder_and_target_are_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(oa.InputError, match=r"write `export\(model, 'plant', 'c'\)`"):
        oa.export(case("network").model, "c", "plant")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def saved(tmp_path, monkeypatch) -> Path:
    oa.save(case("network").model, tmp_path / "out" / "model")
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "notes.txt").write_text("mine")
    (tmp_path / "file").write_text("")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ("out", "--to", "cassadi", "--out", "new"),
            "no export to 'cassadi', did you mean 'casadi'? Known are c, ",
        ),
        (("out", "--to", "c", "--out", "theirs"), "theirs: holds notes.txt"),
        (("out", "--to", "c", "--out", "file/new"), "file/new: cannot be written"),
        (("out", "--to", "c", "--out", "out"), "out: holds"),
        (("absent", "--to", "c", "--out", "new"), "absent: no saved model there"),
        (
            ("out", "--to", "c", "--out", "new", "--name", "2nd"),
            "'2nd' cannot name the exported code",
        ),
        (
            ("out", "--to", "c", "--out", "new", "--name", "while"),
            "'while' cannot name the exported code",
        ),
        (("out", "--out", "new"), "Missing option '--to'"),
    ],
)
def test_bad_input_of_the_command_writes_nothing(saved, arguments, words):
    before = sorted(path.name for path in saved.rglob("*"))
    done = run("export", *arguments)
    assert done.code == 2 and words in done.err
    assert sorted(path.name for path in saved.rglob("*")) == before


def test_the_command_writes_a_folder_and_replaces_its_own(saved):
    for _ in range(2):
        done = run("export", "out", "--to", "numpy", "--out", "new", "--name", "plant")
        assert (done.code or 0, done.out) == (0, "written to new\n")
    assert {path.name for path in (saved / "new").iterdir()} >= {
        "plant.py",
        "README.md",
        "vectors.csv",
    }
    newer = (
        (saved / "out" / "model" / "model.json").read_text().replace('"format": 2', '"format": 99')
    )
    (saved / "out" / "model" / "model.json").write_text(newer)
    done = run("export", "out", "--to", "c", "--out", "other")
    assert done.code == 2 and "in format 99" in done.err and not (saved / "other").exists()
