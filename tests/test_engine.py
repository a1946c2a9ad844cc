"""An engine that keeps rows on the host, one chunk at a time: training and conclusions are those of rows in memory."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from orthaug import (
    MLP,
    AdamLBFGS,
    Additive,
    Baseline,
    BaselinePenalty,
    Function,
    InputError,
    Lags,
    LevenbergMarquardt,
    Orthogonal,
    OrthogonalPenalty,
    Record,
    Simulation,
    Stream,
    Term,
    estimate,
)
from orthaug.data.sources import RecordSource
from orthaug.fitting.estimation import fit
from orthaug.models.learners import Bound
from orthaug.models.rows import Engine, InMemory, MixedGram, Overlaps
from orthaug.models.streaming import read_ahead
from orthaug.physics.problem import pose
from orthaug.physics.streamed import stream_problem

# 159 rows after the first: three chunks of one size, which share their compiled programs
SIZE, ROWS = (53, 160)


@dataclass(frozen=True)
class Streaming(Stream):
    """It keeps what it was asked to sum."""

    limit: int = SIZE
    asked: list = field(default_factory=list, compare=False)

    def sum(self, function, rows, *arguments):
        self.asked.append(function)
        return super().sum(function, rows, *arguments)


@cache
def posed(ny, lower=None):
    """A nonlinear system whose physics is linear; of two outputs that share a parameter."""
    rng = np.random.default_rng(ny)
    u, y = rng.uniform(-1, 1, ROWS), np.zeros((ROWS, ny))
    for k in range(1, ROWS):
        y[k, 0] = (
            0.5 * y[k - 1, 0]
            + u[k - 1]
            + 0.3 * np.tanh(2 * u[k - 1] * y[k - 1, 0])
            + 0.4 * u[k] ** 2
        )
        if ny == 2:
            y[k, 1] = 3 * y[k - 1, 0] + 0.5 * y[k - 1, 1] - 2 * u[k - 1] ** 2
    y = y + rng.normal(size=y.shape) * ([0.05, 0.2][:ny])
    terms = [
        Term("a", "y1[k-1]", lower or 0.4, output="y1", min=lower),
        Term("g", "u[k-1]", 0.8, output="y1"),
    ]
    terms += (
        [Term("h", "y1[k-1]", 2.0, output="y2"), Term("a", "y2[k-1]", output="y2")]
        if ny == 2
        else []
    )
    record = Record.from_arrays(u, y, outputs=["y1", "y2"][:ny])
    return pose(record, Baseline.from_terms(terms), Lags(na=1, nb=2, nk=0))


EXACT = LevenbergMarquardt(iterations=400, tolerance=1e-13)
# Without a ridge, before rounding has grown
EARLY = LevenbergMarquardt(iterations=20, tolerance=1e-13)
STRUCTURES = (Orthogonal(), Additive(), OrthogonalPenalty(1.0), BaselinePenalty(1.0))
REGULARIZATIONS = ("none", 0.1, "evidence")
CASES = [  # each structure with one and two outputs, each regularisation with each number of outputs
    (Orthogonal(), "none", 1), (Orthogonal(), "evidence", 2),
    (Additive(), 0.1, 1), (Additive(), "none", 2),
    (OrthogonalPenalty(1.0), "evidence", 1), (OrthogonalPenalty(1.0), 0.1, 2),
    (BaselinePenalty(1.0), 0.1, 1), (BaselinePenalty(1.0), "evidence", 2),
]  # fmt: skip


def named(value):
    return getattr(value, "name", str(value))


@cache
def both(structure, regularization, ny, lower=None):
    """The same fit with rows in memory, and streamed."""
    solver = EARLY if regularization == "none" else EXACT
    options = {
        "learner": MLP(hidden=(3,)),
        "solver": solver,
        "structure": structure,
        "regularization": regularization,
    }
    return fit(posed(ny, lower), **options), fit(posed(ny, lower), engine=Streaming(), **options)


def apart(found, expected):
    """Largest difference against the largest entry."""
    return np.max(np.abs(np.asarray(found) - expected)) / np.max(np.abs(expected))


def prediction(found):
    return np.concatenate(
        [t.model[t.start :] for t in found.model.predict(found.problem.record).trajectories]
    )


def test_it_is_an_engine():
    assert isinstance(Streaming(), Engine) and isinstance(InMemory(), Engine)
    assert InMemory().resident and not Streaming().resident


@pytest.mark.parametrize(("structure", "regularization", "ny"), CASES, ids=named)
def test_streamed_rows_train_to_the_same_model(structure, regularization, ny):
    memory, streamed = both(structure, regularization, ny)
    assert memory.status.ok and streamed.status.ok
    assert apart(streamed.theta, memory.theta) <= (1e-10 if structure.projects else 2e-9)
    # A prior that is iterated ends where the weights settle; the loss alone is not at its minimum there
    evidence = regularization == "evidence"
    assert apart(prediction(streamed), prediction(memory)) <= (1e-7 if evidence else 2e-9)
    expected = pytest.approx(memory.status.loss, rel=1e-7 if evidence else 1e-9)
    assert streamed.status.loss == expected
    assert abs(streamed.status.iterations - memory.status.iterations) <= evidence


@pytest.mark.parametrize(("structure", "regularization", "ny"), CASES, ids=named)
def test_streamed_rows_end_in_the_same_conclusions(structure, regularization, ny):
    memory, streamed = both(structure, regularization, ny)
    assert streamed.warnings == memory.warnings
    assert streamed.effective_weights == pytest.approx(memory.effective_weights, rel=1e-4)
    assert streamed.freedom == pytest.approx(memory.freedom, rel=1e-5)
    assert apart(streamed.model.statistics.noise, memory.model.statistics.noise) <= 1e-5
    assert streamed.model.statistics.ridge == pytest.approx(memory.model.statistics.ridge, rel=1e-4)
    if structure.projects:
        assert max(streamed.defect, memory.defect) <= 1e-12
        np.testing.assert_allclose(streamed.std, memory.std, rtol=1e-5)
    else:
        assert (
            streamed.defect == pytest.approx(memory.defect, rel=1e-4)
            and streamed.std is memory.std is None
        )


@pytest.mark.parametrize(
    ("structure", "ny"), [*zip(STRUCTURES, (2, 1, 2, 1), strict=True)], ids=named
)
def test_conclusions_of_the_same_weights_are_the_same(structure, ny):
    """Nothing trained: what differs is the order of sums alone."""
    options = {"learner": MLP(hidden=(3,)), "solver": LevenbergMarquardt(0), "structure": structure,
               "regularization": 0.1}  # fmt: skip
    memory, streamed = (
        fit(posed(ny), engine=engine, **options) for engine in (InMemory(), Streaming())
    )
    np.testing.assert_array_equal(streamed.model.numbers.weights, memory.model.numbers.weights)
    assert apart(streamed.theta, memory.theta) <= 1e-11
    for name in ("gram", "middle", "noise"):
        assert (
            apart(getattr(streamed.model.statistics, name), getattr(memory.model.statistics, name))
            <= 1e-11
        )
    assert streamed.status.loss == pytest.approx(memory.status.loss, rel=1e-12)
    assert streamed.effective_weights == pytest.approx(memory.effective_weights, rel=1e-9)
    assert streamed.model.statistics.ridge == memory.model.statistics.ridge
    if structure.projects:
        np.testing.assert_allclose(streamed.covariance, memory.covariance, rtol=1e-10)


@pytest.mark.parametrize("structure", STRUCTURES, ids=lambda s: s.name)
def test_the_path_of_the_host_s_loop_is_that_of_the_compiled_one(structure):
    """Few steps from the same start, so that rounding has not grown: the same trials accepted, the same weights."""
    options = {"learner": MLP(hidden=(3,)), "structure": structure, "regularization": 0.1}
    for steps in (1, 5):
        solver = LevenbergMarquardt(steps, tolerance=1e-13)
        memory, streamed = (
            fit(posed(1), solver=solver, engine=e, **options) for e in (InMemory(), Streaming())
        )
        assert memory.status.iterations == streamed.status.iterations == steps
        assert apart(streamed.model.numbers.weights, memory.model.numbers.weights) <= 1e-10


LINEAR = Function(lambda w, z: w @ (z**2 - z**3), lambda key: 0.1 * jax.random.normal(key, (2, 4)))


@pytest.mark.parametrize("structure", STRUCTURES, ids=named)
def test_a_learner_that_is_linear_in_its_weights_ends_at_the_same_place(structure):
    """Without a ridge: the minimum is one point, whatever the way there."""
    options = {"learner": LINEAR, "solver": EXACT, "structure": structure}
    memory, streamed = (
        fit(posed(2), engine=engine, **options) for engine in (InMemory(), Streaming())
    )
    assert memory.status.code == streamed.status.code == "converged"
    assert apart(streamed.theta, memory.theta) <= 1e-10
    assert apart(prediction(streamed), prediction(memory)) <= 1e-10
    assert streamed.status.loss == pytest.approx(memory.status.loss, rel=1e-12)
    assert apart(streamed.model.statistics.gram, memory.model.statistics.gram) <= 1e-11
    if structure.projects:
        np.testing.assert_allclose(streamed.std, memory.std, rtol=1e-10)


def test_physics_alone():
    memory, streamed = (
        fit(posed(2), learner=None, engine=engine) for engine in (InMemory(), Streaming())
    )
    np.testing.assert_array_equal(streamed.theta, memory.theta)
    np.testing.assert_allclose(streamed.covariance, memory.covariance, rtol=1e-12)
    np.testing.assert_allclose(
        streamed.model.statistics.noise, memory.model.statistics.noise, rtol=1e-12
    )


def test_bounds_that_reach_into_training():
    memory, streamed = both(Additive(), 0.1, 1, 0.9)
    assert dict(streamed.at_bound) == dict(memory.at_bound) == {"a": 0.9}
    assert apart(streamed.theta, memory.theta) <= 1e-6
    assert streamed.status.loss == pytest.approx(memory.status.loss, rel=1e-6)


def test_an_ensemble_and_a_validation():
    options = {"learner": MLP(hidden=(3,)), "solver": LevenbergMarquardt(15), "restarts": 3,
               "regularization": [0.1, 1.0], "validation": posed(1).record, "ensemble": True}  # fmt: skip
    memory, streamed = (
        fit(posed(1), engine=engine, **options) for engine in (InMemory(), Streaming())
    )
    assert [r.chosen for r in streamed.restarts] == [r.chosen for r in memory.restarts]
    np.testing.assert_allclose(streamed.theta, memory.theta, rtol=1e-10)
    assert apart(prediction(streamed), prediction(memory)) <= 1e-6
    assert streamed.defect <= 1e-12


IN_THE_SPAN = Function(lambda w, z: (w @ z[:2])[None], lambda key: jax.random.normal(key, (2,)))


@pytest.mark.parametrize("regularization", REGULARIZATIONS)
def test_a_learner_in_the_span_of_the_physics_has_converged(regularization):
    """P⊥J = 0, the paper's Example 1."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, (53, 2))
    u = np.concatenate([u, -u])  # scaling to [-1, 1] then adds no constant
    record = Record.from_arrays(u, u @ [1.0, -2.0] + 0.1 * rng.normal(size=106))
    problem = pose(record, Baseline.from_terms([Term("a", "u1[k]"), Term("b", "u2[k]")]))
    options = {"learner": IN_THE_SPAN, "regularization": regularization}
    memory, streamed = (
        fit(problem, engine=engine, **options) for engine in (InMemory(), Streaming())
    )
    for found in (memory, streamed):
        assert found.status.code == "converged"
        assert found.status.iterations == 0
        assert sum(w.code == "learner_spanned" for w in found.warnings) == 1
    np.testing.assert_allclose(streamed.theta, memory.theta, rtol=1e-12)
    assert streamed.effective_weights == pytest.approx(memory.effective_weights, abs=1e-6)


def test_a_start_that_is_not_finite():
    learner = Function(lambda w, z: w * jnp.log(z[:1] - 5), lambda key: jnp.ones(1))
    found = fit(posed(1), learner=learner, engine=Streaming())
    assert (found.status.code, found.status.iterations) == ("non_finite", 0)
    assert np.isfinite(found.theta).all() and found.std is None


def test_adam_needs_rows_in_memory():
    options = {"learner": MLP(hidden=(3,)), "solver": AdamLBFGS(2, 2)}
    with pytest.raises(
        InputError, match="training on rows that are not in memory needs .*levenberg-marquardt"
    ):
        fit(posed(1), engine=Streaming(), **options)


def test_progress_is_reported_as_a_mean_square():
    entries = []
    options = {
        "learner": MLP(hidden=(3,)),
        "solver": LevenbergMarquardt(6),
        "regularization": "none",
    }
    found = fit(posed(1), engine=Streaming(), progress=lambda *at: entries.append(at), **options)
    assert [(run, n) for run, n, _ in entries] == [
        (0, n + 1) for n in range(found.status.iterations)
    ]
    assert entries[-1][2] == pytest.approx(found.status.loss, rel=1e-9)


def test_a_trial_is_one_pass_over_the_rows():
    """Beside those of the start; nothing but sums is asked of the rows."""
    engines = [Streaming(), Streaming()]
    options = {"learner": MLP(hidden=(3,)), "regularization": "none"}
    fits = [
        fit(posed(1), solver=LevenbergMarquardt(n, tolerance=0.0), engine=engine, **options)
        for n, engine in zip((8, 15), engines, strict=True)  # both end below physics alone
    ]
    assert [found.status.iterations for found in fits] == [8, 15]
    assert len(engines[1].asked) - len(engines[0].asked) == 7


def test_estimate_is_fit_of_the_problem_it_poses():
    problem = posed(1)
    options = {"learner": MLP(hidden=(3,)), "solver": LevenbergMarquardt(5)}
    direct = estimate(problem.record, problem.baseline, lags=Lags(na=1, nb=2, nk=0), **options)
    again = fit(problem, **options)
    np.testing.assert_array_equal(direct.theta, again.theta)
    np.testing.assert_array_equal(direct.model.numbers.weights, again.model.numbers.weights)


def test_sums_over_lists_are_sums_over_chunks():
    """Also over chunks of uneven size."""
    ny, rng = 2, np.random.default_rng(0)
    rows = (rng.normal(size=(100, 3)), rng.normal(size=(100, ny, 2)), rng.normal(size=(100, ny)))
    rows = (*rows, rng.uniform(0.5, 2, (100, ny, ny)))
    bound = Bound(MLP(hidden=(3,)), 3, ny)
    w, mix = jnp.asarray(bound.init(jax.random.key(0))), jnp.asarray(rng.normal(size=(ny, ny)))
    found = []
    for engine in (InMemory(limit=16), InMemory(), Streaming()):
        laid = engine.build_rows(*rows)
        found.append(
            (engine.sum(Overlaps(bound), laid, w), engine.sum(MixedGram(bound), laid, w, mix))
        )
    for other in found[1:]:
        for one, two in zip(jax.tree.leaves(found[0]), jax.tree.leaves(other), strict=True):
            assert apart(two, one) <= 1e-13


def test_a_free_run_of_two_outputs_with_a_bound():
    """θ's bound makes c follow the learner's share; the outputs' covariance is taken in a second leg."""
    options = {
        "learner": MLP(hidden=(2,)),
        "criterion": Simulation(20, 2, start_iterations=0),
        "blocks": 0,
    }
    options |= {"structure": Orthogonal(), "solver": LevenbergMarquardt(12), "fallback": False}
    memory, streamed = (
        fit(posed(2, 0.55), engine=engine, **options) for engine in (InMemory(), Streaming())
    )
    np.testing.assert_allclose(streamed.theta, memory.theta, rtol=1e-10)
    assert streamed.status.loss == pytest.approx(memory.status.loss, rel=1e-8)
    assert streamed.at_bound == memory.at_bound


def test_chunks_of_another_size():
    options = {"learner": MLP(hidden=(3,)), "solver": LevenbergMarquardt(20), "regularization": 0.1}
    memory, streamed = (
        fit(posed(1), engine=engine, **options) for engine in (InMemory(), Streaming(37))
    )
    np.testing.assert_allclose(streamed.theta, memory.theta, rtol=1e-10)
    assert streamed.status.loss == pytest.approx(memory.status.loss, rel=1e-9)


def source(problem, size):
    return RecordSource(problem.record, problem.rows.start, size)


@pytest.mark.parametrize(("structure", "regularization", "ny"), CASES, ids=named)
def test_a_problem_of_a_source_is_that_of_its_record(structure, regularization, ny):
    """Posed by passes over partitions, and trained on what they give."""
    problem, engine = posed(ny), Streaming()
    there = stream_problem(problem, source(problem, 47), engine.passes)
    assert there.count == problem.count
    np.testing.assert_allclose(there.least_squares, problem.least_squares, rtol=1e-13)
    np.testing.assert_allclose(there.freedom_used, problem.freedom_used, rtol=1e-13)
    assert there.unexplained_moments.square == pytest.approx(
        problem.unexplained_moments.square, rel=1e-13
    )
    solver = LevenbergMarquardt(20, tolerance=1e-13)
    options = {
        "learner": MLP(hidden=(3,)),
        "solver": solver,
        "structure": structure,
        "regularization": regularization,
    }
    memory, streamed_fit = fit(problem, **options), fit(there, engine=engine, **options)
    assert apart(streamed_fit.theta, memory.theta) <= 1e-9
    assert streamed_fit.status.loss == pytest.approx(memory.status.loss, rel=1e-9)
    assert streamed_fit.status.iterations == memory.status.iterations == 20
    assert streamed_fit.defect == pytest.approx(memory.defect, rel=1e-6, abs=1e-12)
    assert (streamed_fit.std is None) == (memory.std is None)
    if memory.std is not None:
        np.testing.assert_allclose(streamed_fit.robust().std, memory.robust().std, rtol=1e-8)


def test_ill_conditioned_physics_keeps_its_digits():
    """Q is made twice: columns that are almost parallel leave it orthonormal, and θ with the digits of a QR."""
    rng = np.random.default_rng(1)
    u = rng.normal(size=(400, 2)) @ [[1.0, 1.0], [0.0, 1e-7]]
    record = Record.from_arrays(u, u @ [1.0, 2.0] + 1e-3 * rng.normal(size=400))
    problem = pose(record, Baseline.from_terms([Term("a", "u1[k]"), Term("b", "u2[k]")]))
    there = stream_problem(problem, source(problem, 90), Stream().passes)
    assert there.excitation.condition == pytest.approx(problem.excitation.condition, rel=1e-6)
    assert problem.excitation.condition > 1e6
    gram = np.einsum("koi,koj->ij", there.projection.q, there.projection.q)
    np.testing.assert_allclose(gram, np.eye(2), atol=1e-13)
    np.testing.assert_allclose(there.least_squares, problem.least_squares, rtol=1e-8)


def test_what_is_wrong_with_a_row_is_found_where_it_is():
    rng = np.random.default_rng(0)
    u = rng.uniform(0.1, 1, 200)
    record = Record.from_arrays(u, 2 * u + rng.normal(size=200), source="run.csv")
    baseline = Baseline.from_terms([Term("a", "u[k]"), Term("b", "log(u[k])")])
    problem = pose(record, baseline)
    problem.record.experiments[0].inputs[137] = -1.0  # behind the problem's back
    with pytest.raises(
        InputError,
        match=r"run.csv: row 137: the regressor of b \(log\(u\[k\]\)\) is not finite there",
    ):
        stream_problem(problem, source(problem, 50), Stream().passes)


def test_a_reader_s_error_reaches_the_caller():
    def broken():
        yield 1
        raise InputError("the file is gone.")

    seen = []
    with pytest.raises(InputError, match="the file is gone"):
        seen += list(read_ahead(broken()))


def test_reading_ahead_stops_when_nobody_asks():
    made = []

    def endless():
        while True:
            made.append(len(made))
            yield made[-1]

    for item in read_ahead(endless()):
        if item == 5:
            break
    count = len(made)
    assert count <= 12
    assert len(made) == count and not any(
        t.name == "orthaug-read-ahead" for t in threading.enumerate()
    )
