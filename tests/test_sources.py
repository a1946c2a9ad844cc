"""Physics from elsewhere: FMUs, packages that add a source, and what a saved model keeps of them."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from fmus import PARTS, SPRING, THERMAL, VAN_DER_POL
from test_cli import run

import orthaug as oa
from orthaug import FMU, InputError, Motion, Output, PhysicalParameter, Record, State
from orthaug._base import plugins
from orthaug.physics import consent
from orthaug.physics.fmu_points import Evaluation
from orthaug.physics.source_kinds import SOURCES
from orthaug.physics.sources import PhysicsSource

pytestmark = pytest.mark.usefixtures("without_figures")

NAMES = ("m", "c", "k")
MOST_POINTS = 100_000  # 314,916 where windows are padded to 1024 rows, and 71,076 where not


def equations(learned: bool = False) -> Motion:
    """Return the equations that `SPRING` has in C."""
    return Motion.from_equations(
        [State("x", "v", "position"), State("v", "(force - c*v - k*x)/m", 0.0, learned)],
        [Output("position", "x")],
        [
            PhysicalParameter("m", 1.2, "kg", min=0),
            PhysicalParameter("c", 1.2, "N s/m", min=0),
            PhysicalParameter("k", 120.0, "N/m", min=0),
        ],
        ["force"],
        substeps=1,
    )


def record(friction: float = 0.0, rows: int = 100) -> Record:
    rng, x, y = np.random.default_rng(0), np.zeros(2), []
    force = np.repeat(20 * rng.normal(size=rows // 10), 10)
    for u in force:
        y.append(x[0])
        for _ in range(10):
            rub = friction * np.tanh(x[1] / 0.05)
            x = x + 0.001 * np.array([x[1], u - 2 * x[1] - 100 * x[0] - rub])
    measured = np.array(y) + 1e-3 * rng.normal(size=rows)
    return Record.from_arrays(
        force, measured, sampling_time=0.01, inputs=["force"], outputs=["position"]
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("fmus")
    SPRING.build(place / "spring.fmu")
    return place


def spring(folder: Path, **keys: Any) -> FMU:
    own = {"parameters": NAMES, "outputs": {"position": "x"}, "substeps": 1}
    return FMU(file=str(folder / "spring.fmu"), **{**own, **keys})


def test_names_units_limits_and_starts_are_those_of_the_description(folder: Path) -> None:
    changed = {"m": {"initial": 2.0, "max": 9.0}, "k": {"unit": "kN/m"}}
    motion = spring(folder, parameters=changed).build(["force"], ["position"])
    m, k = motion.parameters
    assert (m.name, m.initial, m.unit, m.min, m.max) == ("m", 2.0, "kg", 0.0, 9.0)
    assert (k.initial, k.unit, k.max) == (120.0, "kN/m", np.inf)
    assert [(s.name, s.start) for s in motion.states] == [("x", "position"), ("v", 0.0)]


@pytest.mark.parametrize("version", ["2.0", "3.0"])
@pytest.mark.parametrize("directional", [True, False])
def test_values_and_slopes_are_those_of_the_equations(
    tmp_path: Path, directional: bool, version: str
) -> None:
    import jax

    file = SPRING.build(tmp_path / "spring.fmu", directional=directional, version=version)
    motion = FMU(file=str(file), parameters=NAMES).build(["force"], ["position"])
    rng, own = np.random.default_rng(1), equations()
    x, u, p = rng.normal(size=(2, 7)), rng.normal(size=(1, 7)), np.array([0.7, 3.0, 50.0])
    np.testing.assert_allclose(motion.rates(x, u, p, np), own.rates(x, u, p, np), rtol=1e-14)
    np.testing.assert_allclose(motion.observed(x, u, p, np), x[:1], rtol=0)

    def slopes(given: Motion) -> Any:
        def at(x: Any, u: Any) -> Any:
            return jax.jacfwd(lambda *z: given.rates(*z, jax.numpy), (0, 1, 2))(x, u, p)

        return jax.jit(jax.vmap(at, -1))(x, u)

    for found, known in zip(slopes(motion), slopes(own), strict=True):
        np.testing.assert_allclose(found, known, rtol=1e-8, atol=1e-8)

    def curvature(given: Motion) -> Any:
        return jax.jit(jax.hessian(lambda p: given.rates(x[:, 0], u[:, 0], p, jax.numpy)))(p)

    np.testing.assert_allclose(curvature(motion), curvature(own), rtol=1e-5, atol=1e-6)


def test_a_fit_is_that_of_the_same_equations(folder: Path) -> None:
    mine = oa.estimate(record(), spring(folder), learner=None, blocks=0)
    theirs = oa.estimate(record(), equations(), learner=None)
    np.testing.assert_allclose(mine.values, theirs.values, rtol=1e-9)
    np.testing.assert_allclose(mine.parameters["std"], theirs.parameters["std"], rtol=1e-5)


def test_a_fit_asks_the_fmu_for_few_points(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, values = [], Evaluation.values

    def counted(self: Evaluation, z: Any) -> Any:
        asked.append(len(z))
        return values(self, z)

    monkeypatch.setattr(Evaluation, "values", counted)
    oa.estimate(record(rows=60), spring(folder), learner=None, blocks=0)
    assert sum(asked) < MOST_POINTS


@pytest.mark.proof
def test_friction_that_is_left_to_a_learner(folder: Path) -> None:
    options: dict[str, Any] = {"learner": oa.MLP((3,), inputs=("v",)), "regularization": 0.01}
    options |= {"solver": oa.LevenbergMarquardt(iterations=40), "blocks": 0}
    data = record(friction=1.5)
    mine = oa.estimate(data, spring(folder, learned=("v",)), **options)
    theirs = oa.estimate(data, equations(learned=True), **options)
    np.testing.assert_allclose(mine.values, theirs.values, rtol=1e-5)
    assert mine.learns and not np.allclose(mine.values[1], 2.0, rtol=1e-3)


@pytest.mark.proof
def test_a_thermal_network_of_names_with_dots(tmp_path: Path) -> None:
    file = THERMAL.build(tmp_path / "room.fmu", directional=False)
    rng = np.random.default_rng(2)
    heat = np.repeat(rng.uniform(0, 20, 20), 10)
    u = np.stack([heat, 5 + np.sin(np.arange(200) / 30)], axis=1)
    source = FMU(
        file=str(file),
        parameters=("wall.C", "room.C", "loss.G", "contact.G"),
        outputs={"wall": "wall.T", "room": "room.T"},
    )
    truth, names = np.array([4.0, 2.5, 0.7, 1.4]), (["heat", "outside"], ["room", "wall"])
    motion, x, rows = source.build(names[0], names[1]), np.array([20.0, 21.0]), []
    assert motion.names == ("wall_C", "room_C", "loss_G", "contact_G")
    for row in u:
        rows.append(x[::-1] + 0.01 * rng.normal(size=2))
        for _ in range(20):
            x = x + 0.005 * motion.rates(x, row, truth, np)
    data = Record.from_arrays(
        u, np.array(rows), sampling_time=0.1, inputs=names[0], outputs=names[1]
    )
    fit = oa.estimate(data, source, learner=None)
    assert (np.abs(fit.values - truth) < 4 * fit.parameters["std"]).all()
    np.testing.assert_allclose(fit.values, truth, rtol=0.05)


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_relations_are_evaluated_anew_at_every_point(tmp_path: Path, version: str) -> None:
    rubbing = type(SPRING)(
        SPRING.states,
        SPRING.parameters,
        SPRING.inputs,
        SPRING.outputs,
        "dx[0] = x[1]; dx[1] = (u[0] - p[1]*relation - p[2]*x[0])/p[0]; y[0] = x[0];",
    )
    file = rubbing.build(tmp_path / "rubbing.fmu", events=1, version=version)
    motion = FMU(file=str(file), parameters=("c",)).build(["force"], ["position"])
    x = np.array([[0.0, 0.0, 0.0], [1.0, -1.0, 1.0]])
    np.testing.assert_allclose(
        motion.rates(x, np.zeros((1, 3)), np.array([2.4]), np)[1], [-2.0, 2.0, -2.0]
    )


def test_a_model_keeps_the_file_and_says_where_it_is_missing(folder: Path, tmp_path: Path) -> None:
    own = tmp_path / "moved.fmu"
    shutil.copy(folder / "spring.fmu", own)
    source = FMU(file=str(own), parameters=NAMES, outputs={"position": "x"}, substeps=1)
    model = oa.estimate(record(), source, learner=None).model
    oa.save(model, tmp_path / "model")
    own.unlink()
    again = oa.load(tmp_path / "model")
    np.testing.assert_array_equal(again.simulate(record()).model, model.simulate(record()).model)
    kept = tmp_path / "model" / "physics.fmu"
    kept.write_bytes(SPRING.build(tmp_path / "other.fmu", directional=False).read_bytes())
    with pytest.raises(InputError, match="not the file that the model was fitted with"):
        oa.load(tmp_path / "model")
    kept.unlink()
    with pytest.raises(InputError, match="physics.fmu is missing, a copy of the file"):
        oa.load(tmp_path / "model")


SPEC = """
[data]
inputs = ["force"]
outputs = ["position"]
time = "time"
[data.train]
files = ["steps.csv"]
[motion]
substeps = 1
[physics.source]
kind = "fmu"
file = "spring.fmu"
parameters = ["m", "c", "k"]
outputs = { position = "x" }
"""


def test_a_model_of_others_runs_its_code_after_consent(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = oa.estimate(record(), spring(folder), learner=None).model
    oa.save(model, tmp_path / "model")
    monkeypatch.setattr(consent.CONSENTS, "_given", set())
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    with pytest.raises(InputError, match=r"load\(…, run_fmu=True\)"):
        oa.load(tmp_path / "model")
    opened = oa.load(tmp_path / "model", run_fmu=True)
    assert opened.parameters == model.parameters
    with pytest.raises(InputError, match="runs with your rights"):  # not asked for any more
        oa.load(tmp_path / "model")


def test_the_command_line_keeps_consents(posed: Path, tmp_path: Path) -> None:
    def simulated(*options: str, home: Path) -> Any:
        command = [sys.executable, "-m", "orthaug", *options, "simulate", str(tmp_path / "model")]
        command += [str(posed / "steps.csv"), "--out", str(tmp_path / "out.csv"), "--force"]
        own = os.environ | {"XDG_STATE_HOME": str(home)}
        return subprocess.run(command, env=own, capture_output=True, text=True, check=False)

    source = FMU(file=str(posed / "spring.fmu"), parameters=NAMES, outputs={"position": "x"})
    oa.save(oa.estimate(record(), source, learner=None, blocks=0).model, tmp_path / "model")
    refused = simulated(home=tmp_path / "other")
    assert refused.returncode == 2 and "orthaug --run-fmu COMMAND" in refused.stderr
    assert simulated("--run-fmu", home=tmp_path / "other").returncode == 0
    assert not (tmp_path / "other" / "orthaug" / "fmus").exists()
    (tmp_path / "own" / "orthaug").mkdir(parents=True)
    (tmp_path / "own" / "orthaug" / "fmus").write_text(f"{source.sha256}\n")
    assert simulated(home=tmp_path / "own").returncode == 0


@pytest.fixture(scope="module")
def posed(folder: Path) -> Path:
    one = record().experiments[0]
    columns = {"time": 0.01 * np.arange(len(one)), "force": one.inputs[:, 0]}
    pd.DataFrame({**columns, "position": one.outputs[:, 0]}).to_csv(
        folder / "steps.csv", index=False
    )
    (folder / "spec.toml").write_text(SPEC)
    return folder


def test_a_spec_is_fitted_simulated_and_written_back(
    posed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr(consent.CONSENTS, "_given", set())
    done = run("fit", posed / "spec.toml", "--out", posed / "result", "--json")
    assert done.code == 0, done.err
    result = json.loads((posed / "result" / "result.json").read_text())
    found = {row["name"]: row["value"] for row in result["parameters"]}
    same = oa.estimate(record(), equations(), learner=None).values
    np.testing.assert_allclose([found[name] for name in NAMES], same, rtol=1e-6)
    assert (posed / "result" / "model" / "physics.fmu").is_file()
    assert consent.CONSENTS.file.read_text().count("\n") == 1
    done = run("simulate", posed / "result", posed / "steps.csv", "--out", posed / "simulated.csv")
    assert done.code == 0, done.err
    done = run("export", posed / "result", "--to", "fmu-parameters", "--out", posed / "written")
    assert done.code == 0, done.err
    written = json.loads((posed / "written" / "parameters.json").read_text())
    assert written["k"] == {"value": found["k"], "unit": "N/m"}
    assert 'name="m"' in (posed / "written" / "parameters.ssv").read_text()
    done = run("export", posed / "result", "--to", "c", "--out", posed / "code")
    assert done.code != 0 and "read from physics.fmu" in done.err
    done = run("export", posed / "result", "--to", "mjcf", "--out", posed / "code")
    assert done.code != 0 and "fmu-parameters" in done.err


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"spring.fmu"', '"none.fmu"', "none.fmu: no such file"),
        ('"spring.fmu"', '"steps.csv"', "not a zip archive, so it is no FMU"),
        ('"m", "c"', '"mm", "c"', "no parameter 'mm', did you mean 'm'"),
        ('"m", "c"', '"zeta", "c"', "no parameter 'zeta'; it has m, c, k."),
        ('"x" }', '"y" }', "no output 'y'; it has x, v, der(x), der(v), position."),
        ("outputs = { position", "starts = { speed = 1.0 }\n#", "no state 'speed'; it has x, v."),
        ("outputs = { position", 'learned = ["w"]\n#', "no state 'w'; it has x, v."),
        ("outputs = { position", 'inputs = { f = "x" }\n#', "no input channel 'f'"),
        ('kind = "fmu"', 'kind = "fmi"', "'physics.source.kind': found \"fmi\""),
        ('parameters = ["m", "c", "k"]\n', "", "no parameter is named"),
        (
            "[motion]\n",
            "[motion]\nstates = { x = { derivative = 'x' } }\n",
            "found beside [physics.source]",
        ),
        ("[physics.source]", '[physics]\ntheta = { a = "m" }\n[physics.source]', "physics.theta"),
    ],
)
def test_bad_specs_are_refused_in_words(posed: Path, old: str, new: str, words: str) -> None:
    assert old in SPEC
    bad = posed / "bad.toml"
    bad.write_text(SPEC.replace(old, new))
    done = run("check", bad)
    assert done.code == 2 and words in " ".join(done.err.split()), done.err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"version": "1.0"}, "FMI 1.0; expected 2.0 or 3.0"),
        ({"kind": "CoSimulation", "listed": False}, "lists no states; name in `states`"),
        ({"platform": "other"}, "it has other. Export it for this computer"),
    ],
)
def test_fmus_that_cannot_be_used(tmp_path: Path, options: Any, words: str) -> None:
    file = VAN_DER_POL.build(tmp_path / "bad.fmu", **options)
    with pytest.raises(InputError, match=words):
        FMU(file=str(file), parameters=("osc.mu",)).build([], ["y"])


def in_ten_parts(x: Any, u: Any, p: Any) -> Any:
    """Return what `SPRING` for co-simulation makes of states in 0.01 s."""
    m, c, k = p
    for _ in range(PARTS):
        x = x + 0.01 / PARTS * np.array([x[1], (u[0] - c * x[1] - k * x[0]) / m])
    return x


@pytest.fixture(scope="module")
def stepping(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("steps")
    SPRING.build(place / "spring.fmu", kind="CoSimulation")
    return place


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_a_step_of_co_simulation_is_a_sample_of_a_discrete_motion(
    tmp_path: Path, version: str
) -> None:
    import jax

    file = SPRING.build(tmp_path / "spring.fmu", kind="CoSimulation", version=version)
    motion = FMU(file=str(file), parameters=NAMES).build(["force"], ["position"]).sampled(0.01)
    assert motion.scheme.discrete
    rng = np.random.default_rng(1)
    x, u, p = rng.normal(size=(2, 7)), rng.normal(size=(1, 7)), np.array([0.7, 3.0, 50.0])
    np.testing.assert_allclose(motion.rates(x, u, p, np), in_ten_parts(x, u, p), rtol=1e-14)
    np.testing.assert_allclose(motion.observed(x, u, p, np), x[:1], rtol=0)
    point = x[:, 0], u[:, 0], p
    found = jax.jit(jax.jacfwd(lambda *z: motion.rates(*z, jax.numpy), (0, 1, 2)))(*point)
    for i, slopes in enumerate(found):
        for j, column in enumerate(np.asarray(slopes).T):
            ends = []
            for sign in (1, -1):
                moved = [np.array(part) for part in point]
                moved[i][j] += sign * 1e-5
                ends.append(in_ten_parts(*moved))
            np.testing.assert_allclose(column, (ends[0] - ends[1]) / 2e-5, rtol=1e-5, atol=1e-7)


def test_an_fmu_for_co_simulation_is_fitted_and_saved(stepping: Path, tmp_path: Path) -> None:
    fit = oa.estimate(record(), spring(stepping, substeps=None), learner=None, blocks=0)
    assert (np.abs(fit.values - [1, 2, 100]) < 3 * fit.parameters["std"]).all()
    oa.save(fit.model, tmp_path / "model")
    again = oa.load(tmp_path / "model", run_fmu=True)
    run = fit.model.simulate(record(rows=50)).trajectories[0].model
    np.testing.assert_array_equal(again.simulate(record(rows=50)).trajectories[0].model, run)


def test_states_that_are_not_all_that_it_remembers_are_refused(
    stepping: Path, tmp_path: Path
) -> None:
    """Of a description without states they are named; the speed alone does not say the rest."""
    for states, words in (
        (("v",), "remembers more than v"),
        (("x", "w"), "no variable 'w'"),
        (("position", "v"), "state position cannot be set where it begins"),
    ):
        source = spring(stepping, states=states, outputs={}, substeps=None)
        with pytest.raises(oa.InputError, match=words):
            source.motion(record()).sampled(0.01)
    SPRING.build(tmp_path / "spring.fmu", kind="CoSimulation", listed=False)
    named = spring(tmp_path, states=("x", "v"), outputs={}, substeps=None).motion(record())
    assert named.names_of_states == ("x", "v")


def test_a_co_simulation_has_its_own_integrator(stepping: Path, folder: Path) -> None:
    with pytest.raises(oa.InputError, match="integrates by itself; leave `integrator` out"):
        spring(stepping, integrator="rk4").motion(record())
    with pytest.raises(oa.InputError, match="those of its description; leave `states` out"):
        spring(folder, states=("x", "v")).motion(record())


def test_equations_that_depend_on_time_are_refused(tmp_path: Path) -> None:
    own = (VAN_DER_POL.states, VAN_DER_POL.parameters, (), ("y",))
    driven = type(SPRING)(*own, "dx[0] = x[1]; dx[1] = t - p[0]*x[0]; y[0] = x[0];")
    file = driven.build(tmp_path / "driven.fmu")
    with pytest.raises(InputError, match="its equations depend on the time"):
        FMU(file=str(file), parameters=("osc.mu",)).build([], ["y"])


def test_fmpy_is_asked_for_in_words(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "fmpy", None)
    monkeypatch.setattr("orthaug.physics.fmu_units._UNITS", {})
    with pytest.raises(InputError, match=r"pip install 'orthaug\[fmu\]'"):
        spring(folder).describe()


@dataclass(frozen=True, kw_only=True)
class Decay(PhysicsSource):
    """A source of another package: states that fall by themselves."""

    rate: float = 1.0

    def motion_of(self, inputs: Any, outputs: Any) -> Motion:
        return Motion.from_functions(
            lambda x, u, p: -p * x,
            lambda x, u, p: x,
            [State("level", start=outputs[0])],
            outputs,
            [PhysicalParameter("rate", self.rate, "1/s", min=0)],
            inputs,
            **self.options,
        )


def test_a_package_adds_a_source_by_an_entry_point(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = EntryPoint("decay", "test_sources:Decay", "orthaug.systems")
    monkeypatch.setattr(
        plugins, "entry_points", lambda group: (entry,) if group == plugins.SOURCES else ()
    )
    time = 0.1 * np.arange(60)
    level = 3 * np.exp(-0.8 * time) + 1e-3 * np.random.default_rng(3).normal(size=60)
    pd.DataFrame({"time": time, "h": level}).to_csv(tmp_path / "fall.csv", index=False)
    (tmp_path / "spec.toml").write_text(
        '[data]\ninputs = []\noutputs = ["h"]\ntime = "time"\n'
        '[data.train]\nfiles = ["fall.csv"]\n'
        '[physics.source]\nkind = "decay"\nrate = 0.5\n'
    )
    try:
        done = run("fit", tmp_path / "spec.toml", "--out", tmp_path / "result")
        assert done.code == 0, done.err
        model = oa.load(tmp_path / "result")
        assert abs(model.parameters["rate"] - 0.8) < 0.01
    finally:
        if "decay" in SOURCES:
            SOURCES.remove("decay")
    monkeypatch.setattr(plugins, "entry_points", lambda group: ())
    with pytest.raises(InputError, match="of the kind 'decay', which is not known here"):
        oa.load(tmp_path / "result")
    broken = EntryPoint("decay", "no_such_package:Decay", "orthaug.systems")
    monkeypatch.setattr(plugins, "entry_points", lambda group: (broken,))
    with pytest.raises(InputError, match="the source 'decay' of no_such_package:Decay cannot be"):
        SOURCES.discover()
