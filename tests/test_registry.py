"""Kinds from outside: a declaration and an entry, and spec, command line, storage and `compare` know it."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
import pytest
from annotated_types import Ge, Gt
from test_cli import SPEC, finite_json, make_project, one_line, run

from orthaug import (
    AdamLBFGS,
    InputError,
    LevenbergMarquardt,
    Prediction,
    Simulation,
    Training,
    load,
    load_spec,
    read_record,
)
from orthaug._base.registry import LIBRARY_ONLY, OneOf, Registry, SpecLimit, check_fields, keys_of
from orthaug.fitting.kinds import CRITERIA, SOLVERS, STRUCTURES
from orthaug.fitting.structures import PenaltyRows
from orthaug.inference.kinds import MEASURES
from orthaug.inference.measures import Measure, Points
from orthaug.models.kinds import LEARNERS

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")


@dataclass(frozen=True)
class Powers:
    """A learner: the powers 2 … highest of each feature, each with a coefficient."""

    highest: Annotated[int, Ge(2)] = 3
    centre: tuple[float, ...] = ()
    inputs: tuple[str, ...] | None = None

    def init(self, key: Any, nz: int, ny: int) -> Any:
        return jnp.zeros((ny, nz, self.highest - 1))

    def apply(self, tree: Any, z: Any) -> Any:
        powers = jnp.stack([z**p for p in range(2, self.highest + 1)], axis=-1)
        return jnp.einsum("ijp,jp->i", tree, powers)


@dataclass(frozen=True)
class Nearness:
    """A structure: additive with `stiffness‖θ − θ⁰‖²` in the criterion."""

    projects = False
    identifies = False
    from_initial = False
    shared = "auto"
    measure = Training()

    stiffness: Annotated[float, Ge(0)] = 1.0
    name: str = field(default="nearness", metadata=LIBRARY_ONLY)

    def penalty(self, names: Any, initial: Any, unit: float) -> PenaltyRows:
        nt, root = len(names), np.sqrt(self.stiffness) * unit
        return PenaltyRows(root * np.eye(nt), np.zeros((nt, nt)), root * initial)


@dataclass(frozen=True)
class Enlarged:
    """A measure: the training rows, `factor` times as far from zero."""

    factor: Annotated[float, Gt(0)] = 2.0
    name: str = field(default="enlarged", metadata=LIBRARY_ONLY)

    def points(self, support: Any) -> Points:
        x = self.factor * support.x
        return Points(x, np.full(len(x), 1 / len(x)))


TRAINED = "[learner]\nhidden = [2]\n[training]\niterations = 5\n[validation]\nblocks = 0\n"


@pytest.fixture(scope="module")
def project(tmp_path_factory) -> Path:
    """A spec with its data; each test adds the sections after it."""
    return make_project(tmp_path_factory.mktemp("registry"), SPEC)


def with_sections(project: Path, name: str, text: str) -> Path:
    place = project.with_name(f"{name}.toml")
    place.write_text(SPEC.replace('[learner]\nkind = "none"\n', "") + text)
    return place


def test_a_learner_from_outside(project, tmp_path):
    spec = with_sections(
        project,
        "powers",
        '[learner]\nkind = "powers"\nhighest = 2\ncentre = [1, 2.5]\nhidden = [9]\ninputs = ["u[k-1]", "y[k-1]"]\n',
    )
    assert run("fit", spec).code == 2
    with LEARNERS.with_kind("powers", Powers):
        assert load_spec(spec).spec.declared_learner() == Powers(
            2, (1.0, 2.5), ("u[k-1]", "y[k-1]")
        )
        done = run("fit", spec, "--out", tmp_path / "out", "--json")
        assert done.code == 0, done.err
        model = load(tmp_path / "out")
        assert model.form.bound.learner == Powers(2, (1.0, 2.5), ("u[k-1]", "y[k-1]"))
        assert model.form.bound.size == 2
    with pytest.raises(
        InputError, match="learner is of the kind 'powers', which is not registered here"
    ):
        load(tmp_path / "out")
    given = Powers(2, inputs=("u[k-1]", "y[k-1]"))
    record = read_record(
        project.with_name("run.csv"), inputs=["u"], outputs=["y"], sampling_time=model.sampling_time
    )
    again = load(tmp_path / "out", learner=given).predict(record)
    np.testing.assert_array_equal(
        again.trajectories[0].model, model.predict(record).trajectories[0].model
    )


def test_the_keys_of_a_learner_from_outside_are_checked(project):
    with LEARNERS.with_kind("powers", Powers):
        for key, words in (
            ("highest = 1", "'learner.highest': found 1; expected greater than or equal to 2"),
            ("highest = 2.5", "'learner.highest': found 2.5; expected an integer"),
            ("centre = 3", "'learner.centre': found 3; expected a list, such as centre = [3]"),
            ("centre = [nan]", "'learner.centre[0]': found nan; expected a finite number"),
            ("highes = 3", "unknown key 'learner.highes', did you mean 'highest'?"),
        ):
            done = run("fit", with_sections(project, "bad", f'[learner]\nkind = "powers"\n{key}\n'))
            assert done.code == 2 and one_line(done.err, words)
        done = run("fit", with_sections(project, "bad", '[learner]\nkind = "power"\n'))
        assert one_line(
            done.err, "'learner.kind': found \"power\"; expected 'mlp', 'terms', 'none' or 'powers'"
        )
    done = run("fit", with_sections(project, "bad", "[learner]\nhighest = 3\n"))
    assert done.code == 2 and one_line(done.err, "unknown key 'learner.highest'")


def test_a_structure_from_outside(project, tmp_path):
    spec = with_sections(
        project, "nearness", '[structure]\nkind = "nearness"\nstiffness = 1e9\n' + TRAINED
    )
    with STRUCTURES.with_kind("nearness", Nearness):
        assert load_spec(spec).spec.declared_structure() == Nearness(1e9)
        done = run("fit", spec, "--out", tmp_path / "out", "--json")
        assert done.code == 0, done.err
        result = finite_json(done.out)
        assert result["structure"] == load(tmp_path / "out").structure == "nearness"
        for row in result["parameters"]:
            np.testing.assert_allclose(row["value"], row["initial"], atol=1e-3)
            assert row["std"] is None  # the data alone do not determine θ
        done = run("compare", spec, "--out", tmp_path / "compared", "--json")
        assert done.code == 0, done.err
        names = [row["name"] for row in finite_json(done.out)["comparison"]]
        assert names == [
            "physics alone",
            "additive",
            "orthogonal",
            "orthogonal-penalty",
            "nearness",
        ]
    assert one_line(run("fit", spec).err, "'structure.kind': found \"nearness\"")
    spec = with_sections(project, "stiff", "[structure]\nstiffness = 1e9\n")
    assert one_line(run("fit", spec).err, "unknown key 'structure.stiffness'")


def test_a_measure_from_outside(project, tmp_path):
    sections = '[structure.measure]\nkind = "enlarged"\nfactor = 3\n' + TRAINED
    spec = with_sections(project, "enlarged", sections)
    with MEASURES.with_kind("enlarged", Enlarged):
        assert isinstance(Enlarged(), Measure)
        done = run("fit", spec, "--out", tmp_path / "out", "--json")
        assert done.code == 0, done.err
        assert finite_json(done.out)["measure"] == load(tmp_path / "out").measure == "enlarged"
        data = project.with_name("run.csv")
        done = run("split", tmp_path / "out", data, "--measure", "enlarged", "--json")
        assert done.code == 0, done.err
        assert finite_json(done.out)["measure"] == "enlarged"
        done = run("split", tmp_path / "out", data, "--measure", "enlarged", "--box", "u[k-1]=-1:1")
        assert one_line(done.err, "--box: belongs to --measure uniform; found --measure enlarged")
    done = run("split", tmp_path / "out", data, "--measure", "enlarged")
    assert done.code == 2 and one_line(
        done.err, "--measure must be one of training,", "got 'enlarged'"
    )


def test_the_kinds_of_a_file_are_the_classes_of_the_library():
    assert LEARNERS.kind_of(Powers()) is None
    assert STRUCTURES.kind_of(Nearness()) is None
    assert CRITERIA.declare("prediction", {"horizon": 3, "washout": 2}) == Prediction(3)
    assert CRITERIA.declare("simulation", {"horizon": 3, "washout": 2}) == Simulation(washout=2)
    assert SOLVERS.declare("adam-lbfgs", {"iterations": 3}) == AdamLBFGS()
    assert SOLVERS.declare("levenberg-marquardt", {"iterations": 3}) == LevenbergMarquardt(3)
    assert [SOLVERS.kind_of(one) for one in (AdamLBFGS(), LevenbergMarquardt())] == [
        "adam-lbfgs",
        "levenberg-marquardt",
    ]


def test_reading_a_spec_loads_no_jax():
    """Declarations are there, and with them every key of the spec, before anything is compiled."""
    program = (
        "import sys, orthaug.commands.opening, orthaug.commands.spec as spec\n"
        "spec.spec_model()\n"
        "print([name for name in ('jax', 'optax') if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


# --- what is refused


@dataclass(frozen=True)
class Segmented:
    segment: Annotated[float, Gt(0)] = 1.0


@dataclass(frozen=True)
class Seeded:
    seed: int = 0


@dataclass(frozen=True)
class Deep:
    hidden: int = 3


@dataclass(frozen=True)
class Sized:
    nz: int = 3


@dataclass
class Soft:
    pass


REFUSED = [
    (
        LEARNERS,
        "deep",
        Deep,
        "the learner 'deep' and the learner 'mlp' declare the key 'hidden' differently",
    ),
    (LEARNERS, "sized", Sized, "the learner 'sized' has a key 'nz', which its section has already"),
    (
        SOLVERS,
        "segmented",
        Segmented,
        "the solver 'segmented' and the criterion 'auto' declare the key 'segment'",
    ),
    (
        CRITERIA,
        "seeded",
        Seeded,
        "the criterion 'seeded' has a key 'seed', which its section has already",
    ),
    (MEASURES, "uniform", Enlarged, "the measure 'uniform' is registered already"),
    (STRUCTURES, "soft", Soft, "the structure 'soft' must be a frozen dataclass"),
    (STRUCTURES, "number", int, "the structure 'number' must be a frozen dataclass"),
]


@pytest.mark.parametrize(
    ("registry", "kind", "declaration", "message"), REFUSED, ids=[r[1] for r in REFUSED]
)
def test_entries_that_are_refused(registry, kind, declaration, message):
    before = dict(registry)
    with pytest.raises(InputError, match=message), registry.with_kind(kind, declaration):
        pass
    assert dict(registry) == before


@dataclass(frozen=True)
class Whole:
    path: str
    count: Annotated[int, Ge(0), SpecLimit(Ge(1))] = 3
    size: Annotated[float, Gt(0)] = 1.0
    shape: Annotated[str, OneOf(("round", "square"))] = "round"
    hidden: int = field(default=0, metadata=LIBRARY_ONLY)

    def __post_init__(self) -> None:
        check_fields(self)


def test_keys_and_limits_of_a_declaration():
    assert list(keys_of(Whole)) == ["path", "count", "size", "shape"]
    registry = Registry("thing", {"whole": Whole})
    assert registry.declare("whole", {"path": "a", "count": 0, "unknown": 1}) == Whole("a", 0)
    with pytest.raises(InputError, match="the thing 'whole' needs `path`"):
        registry.declare("whole", {})
    with pytest.raises(InputError, match="unknown thing 'whol', did you mean 'whole'?"):
        registry.declare("whol", {})
    for values, message in (
        ({"count": -1}, "`count` must be a whole number, 0 or more; got -1"),
        ({"size": 0.0}, "`size` must be a positive number; got 0.0"),
        ({"shape": "oval"}, "`shape` must be one of round, square; got 'oval'"),
    ):
        with pytest.raises(InputError, match=message):
            Whole("a", **values)
