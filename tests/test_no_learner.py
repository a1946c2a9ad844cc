"""Physics alone: a fit without a learner says so, and its answers are those of the same physics beside nothing."""

from __future__ import annotations

import numpy as np
import pytest

import orthaug as oa


def lagged() -> tuple[oa.Record, oa.Baseline]:
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=300), np.zeros((300, 2))
    for k in range(1, 300):
        y[k, 0] = 0.6 * y[k - 1, 0] + u[k - 1]
        y[k, 1] = 0.3 * y[k - 1, 1] - 0.5 * y[k - 1, 0]
    record = oa.Record.from_arrays(
        u[:, None], y + 0.01 * rng.normal(size=y.shape), inputs=["u"], outputs=["p", "q"]
    )
    terms = [
        oa.Term("a", "p[k-1]", output="p"),
        oa.Term("b", "u[k-1]", output="p"),
        oa.Term("c", "q[k-1]", output="q"),
        oa.Term("d", "p[k-1]", output="q"),
    ]
    return record, oa.Baseline.from_terms(terms)


def moving(learned: bool) -> tuple[oa.Record, oa.Motion]:
    rng = np.random.default_rng(1)
    u, x, v, y = np.repeat(rng.uniform(-1, 1, 30), 10), 0.0, 0.0, []
    for force in u:
        y.append(x)
        for _ in range(5):
            v += 0.01 * (force - 4.0 * x - 0.5 * v - 0.3 * np.tanh(v / 0.1))
            x += 0.01 * v
    motion = oa.Motion.from_equations(
        states=[
            oa.State("x", "v", start="y"),
            oa.State("v", "u - k*x - c*v", learned=learned, start="derivative of y"),
        ],
        outputs=[oa.Output("y", "x", learned=learned)],
        inputs=["u"],
        parameters=[oa.PhysicalParameter("k", 3.0, min=0), oa.PhysicalParameter("c", 1.0, min=0)],
        substeps=2,
    )
    return oa.Record.from_arrays(u=u, y=np.array(y), sampling_time=0.05), motion


@pytest.mark.parametrize("focus", [oa.Prediction(), oa.Simulation()], ids=["one step", "free run"])
def test_what_is_said_of_a_learner_that_is_not_there_changes_nothing(focus) -> None:
    record, physics = lagged()
    plain = oa.estimate(record, physics, learner=None, criterion=focus)
    options = {"restarts": 3, "regularization": "evidence", "seed": 4}
    said = oa.estimate(record, physics, learner=None, criterion=focus, **options)
    assert not plain.learns and not plain.model.learns
    assert len(said.restarts) == len(plain.restarts)
    np.testing.assert_array_equal(said.theta, plain.theta)
    np.testing.assert_array_equal(said.std, plain.std)
    assert "learner     none\n" in plain.summary() and repr(plain.model).endswith("learner: none)")


def test_parts_of_physics_alone_are_all_physics() -> None:
    record, physics = lagged()
    fit = oa.estimate(record, physics, learner=None)
    (run,) = fit.model.predict(record).trajectories
    np.testing.assert_array_equal(run.baseline, run.model)
    np.testing.assert_array_equal(fit.model.learner_at(np.ones((3, 3))), np.zeros((3, 2)))
    least = np.linalg.lstsq(
        np.column_stack([record.experiments[0].outputs[:-1, 0], record.experiments[0].inputs[:-1]]),
        record.experiments[0].outputs[1:, 0],
        rcond=None,
    )[0]
    np.testing.assert_allclose(fit.theta[:2], least, rtol=1e-10)


def test_a_motion_may_have_learned_equations_and_no_learner(tmp_path) -> None:
    record, motion = moving(learned=True)
    fit = oa.estimate(record, motion, learner=None)
    plain = oa.estimate(record, moving(learned=False)[1], learner=None)
    assert not fit.learns and not plain.learns
    np.testing.assert_allclose(fit.theta, plain.theta, rtol=1e-12)
    np.testing.assert_allclose(fit.std, plain.std, rtol=1e-9)
    oa.save(fit.model, tmp_path / "model")
    again = oa.load(tmp_path / "model")
    assert not again.learns
    state, force = np.array([0.1, -0.2]), np.ones(1)
    for ours, saved in zip(fit.model.step(state, force), again.step(state, force), strict=True):
        np.testing.assert_array_equal(ours, saved)


def test_a_model_whose_learner_is_taken_away_is_saved_and_read(tmp_path) -> None:
    record, motion = moving(learned=True)
    options = {"regularization": "none", "blocks": 0, "solver": oa.LevenbergMarquardt(3)}
    fit = oa.estimate(record, motion, learner=oa.MLP((2,), inputs=("v",)), **options)
    assert fit.learns and fit.model.learns
    alone = fit.model.physics_only
    oa.save(alone, tmp_path / "alone")
    read = oa.load(tmp_path / "alone")
    assert not alone.learns and not read.learns
    for ours, saved in zip(
        alone.simulate(record).trajectories, read.simulate(record).trajectories, strict=True
    ):
        np.testing.assert_array_equal(ours.model, saved.model)


def test_physics_alone_is_not_reported_to_be_no_better_than_a_learner() -> None:
    record, motion = moving(learned=False)
    options = {"learner": None, "criterion": oa.Simulation(), "validation": record}
    fit = oa.estimate(record, motion, **options)
    assert fit.status.ok and fit.held_out is None
    assert "physics_alone" not in [warning.code for warning in fit.warnings]
