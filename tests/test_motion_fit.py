"""Motions fitted to records: what is estimated, what is only shared, what is never worse than physics alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.integrate

import orthaug as oa
from orthaug.analysis.evidence import Evidence
from orthaug.analysis.learned_part import learned_reach
from orthaug.analysis.missing_terms import MissingTest, doubted_equations
from orthaug.analysis.physics_findings import imitable
from orthaug.analysis.predictability import Predictable
from orthaug.analysis.residuals import analyse
from orthaug.analysis.robustness import robust_free_run
from orthaug.analysis.term_sensitivities import sensitivities
from orthaug.analysis.verdict_text import describe_colour, small_effects
from orthaug.data.expressions import parse_named
from orthaug.fitting.conclusion import reopen_estimate
from orthaug.fitting.field_points import field_under
from orthaug.fitting.motion_estimate import shared_in_words
from orthaug.inference.splitting import nearest, shared_of_motion
from orthaug.models.learners import Bound
from orthaug.models.motion_field import parts_at
from orthaug.models.moving import MotionDynamics
from orthaug.selection.learned_linearization import linearization_of

TS = 0.05
WHOLE = oa.Simulation(0, 0)


def positive(**values: float) -> list[oa.PhysicalParameter]:
    return [oa.PhysicalParameter(name, value, min=0) for name, value in values.items()]


def spring(learned: bool = False, extra: str = "", more=(), substeps: int = 1) -> oa.Motion:
    return oa.Motion.from_equations(
        states=[
            oa.State("x", "v", start="y"),
            oa.State("v", f"(u - c*v - k*x{extra})/m", start="derivative of y", learned=learned),
        ],
        outputs=[oa.Output("y", "x")],
        inputs=["u"],
        parameters=[*positive(m=1.2, c=1.2, k=30.0), *more],
        substeps=substeps,
    )


def data(
    rows: int = 300,
    friction: float = 0.6,
    noise: float = 0.002,
    seed: int = 0,
    hardening: float = 0.0,
) -> oa.Record:
    """m = 1, c = 0.8, k = 25 with friction tanh(v / 0.1) and a spring x³ under steps; finely integrated."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-8, 8, rows // 10 + 1), 10)[:rows]
    state, y = np.zeros(2), []

    def rates(x, u):
        return np.array(
            [
                x[1],
                u - 0.8 * x[1] - 25 * x[0] - friction * np.tanh(x[1] / 0.1) - hardening * x[0] ** 3,
            ]
        )

    for value in u:
        y.append(state[0])
        for _ in range(8):
            h = TS / 8
            k1 = rates(state, value)
            k2 = rates(state + h / 2 * k1, value)
            k3 = rates(state + h / 2 * k2, value)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(state + h * k3, value))
    return oa.Record.from_arrays(
        u=u, y=np.array(y) + noise * rng.normal(size=rows), sampling_time=TS
    )


@pytest.fixture(scope="module")
def fitted() -> oa.MotionEstimate:
    learner = oa.MLP((4,), inputs=("v",))
    return oa.estimate(data(), spring(learned=True), learner=learner, criterion=WHOLE, blocks=0)


@pytest.mark.proof
def test_a_linear_motion_is_the_output_error_fit_of_the_lagged_form(record_property) -> None:
    """Held inputs and an exact integrator: the same family of functions of four parameters."""
    rng = np.random.default_rng(5)
    u, x, y = rng.normal(size=120), np.zeros(2), []
    for value in u:  # any stable system will do, with sensor noise
        y.append(x[0])
        x = np.array(
            [0.9 * x[0] + 0.05 * x[1] + 0.02 * value, -0.4 * x[0] + 0.85 * x[1] + 0.1 * value]
        )
    record = oa.Record.from_arrays(
        u=u, y=np.array(y) + 0.01 * rng.normal(size=120), sampling_time=TS
    )
    states = [oa.State("x", "z + b1*u", start="y"), oa.State("z", "-k*x - c*z + b2*u")]
    parameters = [
        oa.PhysicalParameter(n, v) for n, v in (("k", 10.0), ("c", 2.0), ("b1", 0.5), ("b2", 0.5))
    ]
    motion = oa.Motion.from_equations(
        states, [oa.Output("y", "x")], parameters, ["u"], integrator="exact", hold="zero-order"
    )
    solver = oa.LevenbergMarquardt(200, tolerance=1e-14)
    ours = oa.estimate(record, motion, learner=None, criterion=WHOLE, solver=solver)
    terms = [
        oa.Term(f"{n}{i}", f"{signal}[k-{i}]")
        for n, signal in (("a", "y"), ("b", "u"))
        for i in (1, 2)
    ]
    theirs = oa.estimate(
        record, oa.Baseline.from_terms(terms), learner=None, criterion=WHOLE, solver=solver
    )
    # the motion's loss counts the first rows, which the lagged form takes as its starts
    a = ours.segmented.objective().errors(
        ours.theta, np.zeros(0), ours.states, ours.segmented.segments
    )[0, 2:, 0, 0]
    root = np.sqrt(np.mean(a**2))
    noise = float(np.sqrt(theirs.model.statistics.noise[0, 0] * theirs.freedom / len(a)))
    assert root == pytest.approx(noise, rel=1e-6)
    record_property("error over that of the lagged form", f"1 + {root / noise - 1:.1e}")
    k, c = ours.values[:2]
    poles = np.exp(TS * np.roots([1, c, k]))
    assert np.poly(poles) == pytest.approx([1, *-theirs.theta[:2]], rel=1e-6)


def test_mass_and_stiffness_are_distinguished_from_a_learner_of_the_velocity(
    fitted: oa.MotionEstimate,
) -> None:
    table = fitted.parameters
    assert table["shared"].to_dict() == {"m": False, "c": True, "k": False}
    for name, truth in (("m", 1.0), ("k", 25.0)):
        assert abs(table["value"][name] - truth) < 3 * table["std"][name]
        assert table["std"][name] < 0.02 * truth
    alone = oa.estimate(data(), spring(), learner=None, criterion=WHOLE)
    assert (
        fitted.status.loss < 0.1 * alone.status.loss
        and fitted.status.start_loss == alone.status.loss
    )
    assert fitted.defect is not None and fitted.defect < 1e-8


def test_on_its_training_data_a_motion_does_not_extrapolate(
    fitted: oa.MotionEstimate, tmp_path
) -> None:
    """What training reached is that of the fitted run; the learner is scaled over that of physics alone."""
    oa.save(fitted.model, tmp_path / "model")
    for model in (fitted.model, oa.load(tmp_path / "model")):
        assert isinstance(model, oa.Model) and not model.form.separates
        (run,) = model.simulate(data()).trajectories
        assert run.outside is not None and not run.outside.any()
        assert linearization_of(model, data()).outside == 0
        (wider,) = model.simulate(
            oa.Record.from_arrays(u=100 * np.ones(40), sampling_time=TS), "zero"
        ).trajectories
        assert wider.outside is not None and wider.outside.any()
    before = replace(fitted.model, seen=None)  # as a file of an earlier version gives it
    oa.save(before, tmp_path / "before")
    (run,) = oa.load(tmp_path / "before").simulate(data()).trajectories
    assert run.outside is not None and run.outside.any()


def test_the_damping_is_that_of_the_nearest_physics(fitted: oa.MotionEstimate) -> None:
    """Linear along the shared direction: c − c_fit is the least-squares slope of −m g on v over the runs."""
    model = fitted.model
    x, u = fitted.segmented.trajectory(
        model.theta - model.numbers.theta_aux, model.numbers.weights, fitted.states
    )
    learned = np.array(
        [model.form.learned(model.numbers, a, b)[0] for a, b in zip(x, u, strict=True)]
    )
    c = model.form.motion.coordinates.physical(model.theta - model.numbers.theta_aux)
    v = x[:, 1]
    assert fitted.values[1] == pytest.approx(c[1] - c[0] * (v @ learned) / (v @ v), rel=1e-8)
    assert fitted.values[1] == pytest.approx(0.8 + 0.6 * (v @ np.tanh(v / 0.1)) / (v @ v), rel=0.02)


def test_a_split_under_another_measure_moves_only_what_is_shared(fitted: oa.MotionEstimate) -> None:
    wide = fitted.split(oa.Uniform({"v": (-0.5, 0.5)}))
    np.testing.assert_array_equal(wide.values[[0, 2]], fitted.values[[0, 2]])
    assert wide.values[1] > 1.05 * fitted.values[1] and wide.model.measure == "uniform"
    again = wide.split(oa.Training())
    np.testing.assert_allclose(again.values, fitted.values, rtol=1e-9)
    np.testing.assert_allclose(again.std, fitted.std, rtol=1e-6)
    record = data()
    for one, other in zip(
        wide.model.simulate(record).trajectories,
        fitted.model.simulate(record).trajectories,
        strict=True,
    ):
        np.testing.assert_allclose(one.model, other.model, rtol=0, atol=1e-12)


def test_standard_errors_of_a_split_are_those_of_its_slope(fitted: oa.MotionEstimate) -> None:
    """∂q̂/∂(c, w) against differences of the whole split, the trajectories moved with the unknowns."""
    segmented, numbers = fitted.segmented, fitted.model.numbers.unsplit
    unknowns = np.concatenate([numbers.theta, numbers.weights])
    bounds = fitted.problem.motion.coordinates.bounds
    size = fitted.split_by.field.size

    def q_at(unknowns: np.ndarray, moved: np.ndarray) -> np.ndarray:
        own = numbers._replace(theta=unknowns[:3], weights=unknowns[3:])
        states = fitted.states - np.moveaxis(fitted.slope @ moved, 1, -1)
        field = field_under(oa.Training(), segmented, own, states)[0]._replace(size=size)
        return nearest(segmented.dynamics, own, fitted.alone, field, bounds)[0]

    rng = np.random.default_rng(0)
    for _ in range(3):
        moved = 1e-5 * rng.normal(size=len(unknowns)) * np.maximum(np.abs(unknowns), 0.1)
        change = (q_at(unknowns + moved, moved) - q_at(unknowns - moved, -moved)) / 2
        np.testing.assert_allclose(fitted.split_by.slope @ moved, change, rtol=2e-3, atol=1e-9)


@pytest.mark.parametrize(
    ("seen", "shared"),
    [(("v",), 1), (("x", "v"), 2), (("x", "v", "u"), 3), (("v**2",), 0), (("v + 0*x", "x"), 2)],
)
def test_shared_directions_of_the_spring(seen: tuple[str, ...], shared: int) -> None:
    motion = spring(learned=True)
    features = tuple(parse_named(text, motion.known, "feature") for text in seen)
    form = MotionDynamics(motion, features, Bound(oa.MLP((2,)), len(seen), 1), TS, 1)
    rng = np.random.default_rng(0)
    found = shared_of_motion(
        form, motion.coordinates.initial, rng.normal(size=(200, 2)), rng.normal(size=(200, 1))
    )
    assert found.basis.shape[1] == shared


@pytest.mark.parametrize(("seen", "shared"), [(("x",), 2), (("x", "v"), 3)])
def test_shared_directions_of_a_duffing_equation(seen: tuple[str, ...], shared: int) -> None:
    motion = spring(learned=True, extra=" - k3*x**3", more=[oa.PhysicalParameter("k3", 2.0)])
    features = tuple(parse_named(text, motion.known, "feature") for text in seen)
    form = MotionDynamics(motion, features, Bound(oa.MLP((2,)), len(seen), 1), TS, 1)
    rng = np.random.default_rng(0)
    found = shared_of_motion(
        form, motion.coordinates.initial, rng.normal(size=(200, 2)), rng.normal(size=(200, 1))
    )
    assert found.basis.shape[1] == shared


@pytest.mark.parametrize(
    "seed",
    [
        seed if seed in (0, 1, 5) else pytest.param(seed, marks=pytest.mark.proof)
        for seed in range(12)
    ],
)
def test_no_learner_ends_above_physics_alone(seed: int) -> None:
    """Random springs, frictions, noise, regularizations and learners; one shape, so one compilation."""
    rng = np.random.default_rng(seed)
    record = data(
        160, friction=float(rng.uniform(0, 1)), noise=float(10 ** rng.uniform(-4, -1)), seed=seed
    )
    regularization = ["none", "evidence", 1e-3][seed % 3]
    fit = oa.estimate(
        record,
        spring(learned=True),
        learner=oa.MLP((3,), inputs=("x", "v")),
        criterion=oa.Simulation(80, 0),
        solver=oa.LevenbergMarquardt(40),
        regularization=regularization,
        seed=seed,
        blocks=0,
        fallback=False,
    )
    assert fit.status.loss <= fit.status.start_loss * (1 + 1e-12)


def test_where_the_learner_does_not_help_the_result_is_physics_alone() -> None:
    fit = oa.estimate(
        data(160, friction=0.0, noise=0.2, seed=2),
        spring(learned=True),
        learner=oa.MLP((12,), inputs=("x", "v")),
        criterion=oa.Simulation(80, 0),
        solver=oa.LevenbergMarquardt(40),
        regularization="none",
        blocks=2,
    )
    assert not fit.learns and fit.held_out is not None
    assert "physics_alone" in [warning.code for warning in fit.warnings]


def test_what_no_output_says_has_no_interval() -> None:
    """Only the product b·g enters: a gain before a hidden state and one after it."""
    rng = np.random.default_rng(0)
    u, x, y = rng.normal(size=150), 0.0, []
    for value in u:
        y.append(x)
        x += TS * (-2 * x + 3 * value)
    record = oa.Record.from_arrays(
        u=u, y=np.array(y) + 0.01 * rng.normal(size=150), sampling_time=TS
    )
    motion = oa.Motion.from_equations(
        [oa.State("z", "-a*z + b*u")], [oa.Output("y", "g*z")], positive(a=1.0, b=1.0, g=1.0), ["u"]
    )
    fit = oa.estimate(record, motion, learner=None, criterion=WHOLE)
    assert (
        fit.unidentified == ("b", "g") and np.isnan(fit.std[1:]).all() and np.isfinite(fit.std[0])
    )
    decay = 1 - 2 * TS  # of the record's own step; the motion runs between samples
    assert fit.values[1] * fit.values[2] == pytest.approx(
        3 * -np.log(decay) / (1 - decay), rel=0.02
    )
    assert "not identified: b, g" in fit.summary()


def test_what_the_prior_of_the_weights_holds_has_no_interval() -> None:
    """A learned sensor may read a hidden state in any unit: of its scale b the weights' prior is all that is known."""
    rng = np.random.default_rng(0)
    u, x, y = rng.normal(size=150), 0.0, []
    for value in u:
        y.append(x + 0.3 * np.tanh(x / 0.1))
        x += TS * (-2 * x + 3 * value)
    record = oa.Record.from_arrays(
        u=u, y=np.array(y) + 0.01 * rng.normal(size=150), sampling_time=TS
    )
    outputs = [oa.Output("y", "z", learned=True)]
    motion = oa.Motion.from_equations(
        [oa.State("z", "-a*z + b*u")], outputs, positive(a=1.0, b=1.0), ["u"]
    )
    fit = oa.estimate(
        record, motion, learner=oa.MLP((4,), inputs=("z",)), criterion=WHOLE, blocks=0
    )
    assert fit.unidentified == ("b",) and np.isnan(fit.std[1])
    decay = 1 - 2 * TS  # of the record's own step; the motion runs between samples
    assert fit.values[0] == pytest.approx(-np.log(decay) / TS, abs=3 * fit.std[0])
    (found,) = [warning.text for warning in fit.warnings if warning.code == "not_identified"]
    assert found.startswith("not identified: b. ") and "the prior of the weights" in found
    assert "the data determine all parameters but b" in fit.summary()
    given = Evidence(
        parts=(), problem=fit.problem, learner=oa.MLP(), structure=oa.Orthogonal(), criterion=WHOLE
    )
    imitated, _ = imitable(fit, given)
    assert imitated is not None and imitated.determined == ("a",)
    assert "the data determine all of them but b" in imitated.text
    none = imitated.beside_collinear([("a",), ("b",)])
    assert "no change of a parameter, but the data determine none of the parameters" in none.text
    assert shared_in_words(fit.shared, ("a", "b")) == "nothing, but the data determine no parameter"


def test_a_parameter_whose_effect_the_data_do_not_want_is_named():
    """The spring softens, and the physics lets it only harden: K of x³/K grows for ever."""
    rng = np.random.default_rng(5)
    u, x = np.repeat(rng.uniform(-1, 1, 40), 10), [0.0]
    for value in u[:-1]:
        x.append(x[-1] + TS * (-x[-1] + 0.1 * x[-1] ** 3 + value))
    record = oa.Record.from_arrays(
        u=u, y=np.array(x) + 0.01 * rng.normal(size=400), sampling_time=TS
    )
    motion = oa.Motion.from_equations(
        [oa.State("x", "-a*x - x**3/K + u")], [oa.Output("y", "x")], positive(a=0.5, K=15.0), ["u"]
    )
    fit = oa.estimate(record, motion, learner=None, criterion=WHOLE)
    assert fit.unidentified == ("K",)
    (found,) = [warning.text for warning in fit.warnings if warning.code == "not_identified"]
    assert "K went from 15 to " in found and "where no output depends on it" in found


def test_the_band_of_what_is_learned_follows_all_that_was_estimated(
    fitted: oa.MotionEstimate,
) -> None:
    """Its variance is that of the learner's part when (c, w), and p̂ with them, move by columns of a root of Cov."""
    x, u = np.stack([np.zeros(5), np.linspace(-1, 1, 5)], axis=1), np.zeros((5, 1))
    numbers, slope, tiny = fitted.model.numbers, fitted.split_by.slope, 1e-4
    joint = fitted.model.statistics.joint(3)
    q, c = numbers.theta, numbers.theta - numbers.theta_aux
    moved = []
    for column in tiny * joint.root().T:
        sides = []
        for step in (column, -column):
            at = q + slope @ step
            changed = {
                "theta": at,
                "theta_aux": at - c - step[:3],
                "weights": numbers.weights + step[3:],
            }
            sides.append(parts_at(fitted.model.form, numbers._replace(**changed), x, u)[1])
        moved.append((sides[0] - sides[1]) / (2 * tiny))
    half = learned_reach(fitted, x, u)
    assert half is not None and half.shape == (5, 1)
    ratio = half / np.linalg.norm(moved, axis=0)
    np.testing.assert_allclose(ratio, ratio[0, 0], rtol=1e-3)
    assert 1.96 < ratio[0, 0] < 2.0


def test_too_few_substeps_move_the_parameters_as_a_finer_fit_says() -> None:
    """What one linearisation predicts is what a fit with twice as many gives, where little noise shows it."""
    record = data(friction=0.0, noise=5e-4)
    fits = [oa.estimate(record, spring(substeps=n), learner=None, criterion=WHOLE) for n in (1, 2)]
    found, finer = (oa.substep_bias(fit) for fit in fits)
    assert found is not None and finer is not None and (found.substeps, finer.substeps) == (1, 2)
    moved = fits[0].values - fits[1].values
    assert (np.abs(found.value - moved) < 0.02 * np.abs(fits[0].std)).all()
    assert found.errors.max() > 0.1 and "substeps = 2 or more" in found.warnings[0].text
    assert finer.errors.max() < 0.1 and not finer.warnings


def test_substeps_are_chosen_again_by_what_the_learner_leaves() -> None:
    """A cubic spring that the learner has to find: physics alone leaves 89 % of the output."""
    draw, step = np.random.default_rng(3), 0.002
    force = np.repeat(draw.uniform(-5, 5, 67), 6)[:400]

    def slope(t: float, state: np.ndarray) -> list[float]:
        x, v = state
        return [v, 20 * force[min(int(t / step), 399)] - 9000 * x - 8 * v - 3e7 * x**3]

    instants = step * np.arange(400)
    position = scipy.integrate.solve_ivp(
        slope, (0, instants[-1]), [0, 0], t_eval=instants, max_step=step / 4
    ).y[0]
    noise = 0.01 * position.std() * draw.normal(size=400)
    record = oa.Record.from_arrays(
        force, position + noise, sampling_time=step, inputs=["force"], outputs=["x"]
    )
    motion = oa.Motion.from_equations(
        [
            oa.State("x", "v", start="x"),
            oa.State("v", "b*force - k*x - c*v", start="derivative of x", learned=True),
        ],
        [oa.Output("x", "x")],
        [
            oa.PhysicalParameter(name, value)
            for name, value in {"b": 15, "k": 12000, "c": 12}.items()
        ],
        ["force"],
    )
    fit = oa.estimate(
        record, motion, learner=oa.MLP((5,), inputs=("x",)), criterion=WHOLE, blocks=0
    )
    alone = oa.estimate(record, motion, learner=None, criterion=WHOLE)
    assert (alone.model.form.substeps, fit.model.form.substeps) == (1, 2)
    c, error = fit.parameters.loc["c", ["value", "std"]]
    assert abs(c - 8) < 3 * error
    moved = oa.substep_bias(fit)
    assert moved is not None and moved.errors.max() < 0.1 and not moved.warnings


def test_a_model_runs_on_other_records(fitted: oa.MotionEstimate) -> None:
    record, model = data(seed=7), fitted.model
    free = model.simulate(record)
    assert free.scores().fit[0] > 90
    assert model.predict(record).scores().rmse[0] < 1.5 * 0.002 + 0.002
    (trajectory,) = free.trajectories
    np.testing.assert_allclose(trajectory.baseline + trajectory.learner, trajectory.model)
    alone = model.physics_only.simulate(record, initial=record.experiments[0].outputs).trajectories[
        0
    ]
    assert np.abs(trajectory.learner).max() > 0.01 and alone.learner.any() == False  # noqa: E712  (an array)
    zero = model.simulate(
        oa.Record.from_arrays(u=record.experiments[0].inputs[:, 0], sampling_time=TS), "zero"
    )
    assert zero.trajectories[0].model[0, 0] == 0.0
    with pytest.raises(oa.InputError, match="no measured outputs to start from"):
        model.simulate(oa.Record.from_arrays(u=np.ones(5), sampling_time=TS))
    frame = model.states(record)
    assert list(frame) == ["time", "x", "v", "v_physics", "v_learner"] and len(frame) == len(record)


def test_white_errors_are_distinguished_from_coloured_ones_and_make_robust_errors(
    fitted: oa.MotionEstimate,
) -> None:
    found = oa.diagnose(fitted)
    assert found is not None and found.verdict == "white" and "noise on the outputs" in found.text
    assert robust_free_run(fitted) is fitted
    assert found.missing is not None and not found.missing.found(0.01, 0.05)
    alone = oa.estimate(data(), spring(), learner=None, criterion=WHOLE, standard_errors="plain")
    found = oa.diagnose(alone, free_run=alone.model.simulate(data()))
    assert (
        found is not None and found.verdict == "unmodelled" and found.predictable[0].own_past > 0.5
    )
    assert "Intervals cover noise only" in dict(found.warnings)["coloured_residual"]
    assert found.missing is not None and found.missing.p < 1e-4
    term = found.missing.terms[0]
    assert (term.equation, term.variable, term.shape) == ("v", "v", "jump") and term.share > 0.5
    assert term.coefficient == pytest.approx(-0.6, rel=0.15)
    assert (
        "the equation of v lacks something odd in v" in found.text
        and "*sign(v) would explain" in found.text
    )
    helps = oa.verdict(fitted, alone, {"other": data(seed=9)})
    assert helps.code == "helps" and helps.trials[0].model < 0.5 * helps.trials[0].alone
    assert {e.lag for e in helps.extrapolation} <= {"x", "v", "u"}
    assert oa.stability(fitted.model, data()).diverges_at is None
    robust = alone.robust(10)
    np.testing.assert_array_equal(robust.values, alone.values)
    np.testing.assert_array_equal(robust.plain_std, alone.std)
    assert (robust.std > 1.2 * alone.std).all() and robust.freedom < 31
    assert "batch means" in "\n".join(robust.lines()) and "batch means" not in "\n".join(
        alone.lines()
    )


@pytest.mark.parametrize("samples", [0, 5])
def test_an_input_that_acts_late_is_named_with_its_delay(samples: int) -> None:
    """Friction is missing in both; it is not taken for a dead time."""
    record = data()
    (e,) = record.experiments
    early = np.concatenate([e.inputs[samples:, 0], np.zeros(samples)])
    record = oa.Record.from_arrays(u=early, y=e.outputs[:, 0], sampling_time=TS)
    found = oa.diagnose(oa.estimate(record, spring(), learner=None, criterion=WHOLE))
    assert found is not None and found.verdict == "unmodelled"
    texts = [warning.text for warning in found.warnings if warning.code == "dead_time"]
    assert len(texts) == (samples > 0) and ("Most likely u acts later" in found.text) == bool(
        samples
    )
    assert all('channel = "u", samples = 5.' in text for text in texts)


def test_an_input_that_acts_through_a_lag_is_named_with_its_time_constant() -> None:
    """A delay explains much of it too, and would be the wrong remedy."""
    record = data()
    (e,) = record.experiments
    x, y = 0.0, []
    for value in e.outputs[:, 0]:  # a sensor with a time constant of ten samples
        x += (value - x) * (1 - np.exp(-0.1))
        y.append(x)
    record = oa.Record.from_arrays(u=e.inputs[:, 0], y=y, sampling_time=TS)
    found = oa.diagnose(oa.estimate(record, spring(), learner=None, criterion=WHOLE))
    assert found is not None
    warnings = dict((warning.code, warning.text) for warning in found.warnings)
    assert "dead_time" not in warnings and "u seems to act through a lag" in warnings["slow_input"]
    assert "Most likely u acts through a lag: with a first-order lag of" in found.text
    time_constant = float(found.text.split("first-order lag of ")[1].split(" s")[0])
    assert 0.5 * 10 * TS < time_constant < 2 * 10 * TS


@pytest.mark.parametrize(
    ("own", "words"), [(0.0, "too little to predict it from its"), (0.2, "and 20 % of it follows")]
)
def test_what_is_called_coloured_is_reported_with_its_correlation(own: float, words: str) -> None:
    """A slight colour is surely there in many rows, and yet the past predicts nothing."""
    e = np.random.default_rng(2).normal(size=(4000, 2))
    e[1:, 0] += 0.2 * e[:-1, 0]
    tests = analyse([e], [np.zeros((4000, 0))], [np.zeros((4000, 0))], ["y", "z"], [], [])
    found = describe_colour(tests, tuple(Predictable(name, 1.0, own, 0.0, 0.0) for name in "yz"))
    assert (
        found.startswith("y has autocorrelations of up to 0.2")
        and words in found
        and "z has" not in found
    )


def test_several_experiments_are_diagnosed_as_one_is() -> None:
    record = oa.Record.join([data(160, friction=0.0), data(120, friction=0.0, seed=1)])
    fit = oa.estimate(record, spring(), learner=None, criterion=WHOLE)
    found = oa.diagnose(fit)
    assert found is not None and found.verdict == "white" and found.predictable[0].inputs == 0
    friction = oa.Record.join([data(160), data(120, seed=1)])
    fit = oa.estimate(friction, spring(), learner=None, criterion=WHOLE)
    found = oa.diagnose(fit)
    assert found is not None and found.verdict == "unmodelled"


def test_traces_that_tests_see_beside_the_noise_are_reported() -> None:
    random = np.random.default_rng(3)
    e, u, x = (
        random.normal(size=(4000, 2)),
        random.normal(size=(4000, 1)),
        random.normal(size=(4000, 1)),
    )
    shares = tuple(Predictable(name, 1.0, 0.5, 0.0, 0.02) for name in "yz")
    names = (["y", "z"], ["u"], ["v"])
    assert small_effects(analyse([e], [u], [x], *names), shares) == ""
    e[:, 0] += 0.1 * u[:, 0]
    e[:, 1] += 0.1 * (x[:, 0] ** 2 - 1)
    found = small_effects(analyse([e], [u], [x], *names), shares)
    assert (
        found
        == " Tests still detect small effects (y follows u; z varies with v): 2 % of its mean square at most."
    )


def test_a_term_that_is_there_already_moves_the_run_as_its_parameter_does() -> None:
    """Linear in x, added to the equation of v: the spring's own column, −k/m of it by the logarithm of k."""
    fit = oa.estimate(data(), spring(), learner=None, criterion=WHOLE)
    assert doubted_equations(fit) == ((1,), (2,))  # ẋ = v only says what v is; y = x is bare
    found = sensitivities(fit, (1,), lambda points: lambda rows: rows[:1], 1)
    assert found is not None and (found.starts, found.nuisance) == (2, 5)
    own, added = found.columns[..., 4], found.columns[..., 5]
    m, _, k = fit.values
    np.testing.assert_allclose(-k / m * added, own, rtol=0, atol=0.02 * np.abs(own).max())
    errors = fit.segmented.objective().errors(
        fit.theta, np.zeros(0), fit.states, fit.segmented.segments
    )
    np.testing.assert_allclose(np.ravel(errors[..., 0]), np.ravel(found.errors), rtol=1e-9)


def test_what_stands_at_a_bound_is_a_constant_to_the_others() -> None:
    """The spring's own stiffness held down by a bound: mass and damping have the intervals of a fit with it fixed."""
    low = [oa.PhysicalParameter("m", 1.2, min=0), oa.PhysicalParameter("c", 1.2, min=0)]
    states = [
        oa.State("x", "v", start="y"),
        oa.State("v", "(u - c*v - k*x)/m", start="derivative of y"),
    ]
    given = {"states": states, "outputs": [oa.Output("y", "x")], "inputs": ["u"], "substeps": 1}
    bounded = oa.Motion.from_equations(
        **given, parameters=[*low, oa.PhysicalParameter("k", 20.0, max=20.0)]
    )
    fixed = oa.Motion.from_equations(**given, parameters=low, constants={"k": 20.0})
    one, other = (
        oa.estimate(data(), made, learner=None, criterion=WHOLE) for made in (bounded, fixed)
    )
    assert set(one.at_bound) == {"k"} and one.unidentified == () and np.isnan(one.std[2])
    np.testing.assert_allclose(one.values[:2], other.values, rtol=1e-4)
    np.testing.assert_allclose(one.std[:2], other.std, rtol=1e-2)


# training to its end, and learners that evidence silenced


def axis(rows: int = 300, friction: float = 20.4) -> oa.Record:
    """A positioning axis like the EMPS benchmark: M = 95.1 kg, dry and viscous friction, an offset, a noisy encoder."""
    rng, steps, state, drive, position = np.random.default_rng(0), 20, np.zeros(2), [], []
    target = 0.4 * np.cos(2 * np.pi * 0.25 * 0.02 * np.arange(rows))
    reference = np.cumsum(target) * 0.02
    for goal, speed in zip(reference, target, strict=True):
        position.append(state[0] + 1e-3 * rng.normal())
        drive.append(float(np.clip(160 * (goal - state[0]) + 24 * (speed - state[1]), -10, 10)))

        def rates(x, force=35.15 * drive[-1]):
            return np.array(
                [x[1], (force - 203.5 * x[1] - friction * np.tanh(x[1] / 1e-3) + 3.2) / 95.1]
            )

        for _ in range(steps):
            half = state + 0.01 / steps * rates(state)
            state = state + 0.02 / steps * rates(half)
    names = {"inputs": ["drive"], "outputs": ["q"]}
    return oa.Record.from_arrays(
        u=np.array(drive), y=np.array(position), sampling_time=0.02, **names
    )


AXIS = oa.Motion.from_equations(
    states=[
        oa.State("x", "v", start="q"),
        oa.State("v", "(35.15*drive - Fv*v)/M", start="derivative of q", learned=True),
    ],
    outputs=[oa.Output("q", "x")],
    inputs=["drive"],
    parameters=positive(M=100.0, Fv=200.0),
)
SPEED = oa.MLP(hidden=(8,), inputs=("v",))


def test_evidence_that_silences_dry_friction_is_tried_again():
    record = axis(friction=10.0)
    by_hand = oa.estimate(record, AXIS, learner=SPEED, regularization="evidence", blocks=0)
    result = {warning.code: warning.text for warning in by_hand.warnings}
    assert (
        by_hand.effective_weights < 1.5
        and "contributes only a constant" in result["learner_silent"]
    )
    assert abs(by_hand.values[1] - 203.5) > 20 * by_hand.std[1]
    found = oa.estimate(record, AXIS, learner=SPEED)
    result = {warning.code: warning.text for warning in found.warnings}
    assert found.effective_weights > 4 and "learner_silent" not in result
    assert (
        "Training was therefore repeated with no regularization and a ridge of"
        in result["evidence_retried"]
    )
    assert [r.regularization for r in found.restarts][:2] == ["evidence", "none"]
    (low, high), _ = found.interval
    assert low < 95.1 < high


def test_a_learner_that_rightly_does_nothing_is_not_trained_again():
    """Without regularization it lowers the loss by no more than its weights take from noise."""
    record = axis(friction=0.0)
    found = oa.estimate(record, AXIS, learner=SPEED)
    assert {r.regularization for r in found.restarts} == {"evidence"}
    assert "evidence_retried" not in {warning.code for warning in found.warnings}


def tanks(rows: int = 300) -> oa.Record:
    """Two tanks of which the upper one runs over; K = 0.05, a1 = 0.05, a2 = 0.04, and both levels are measured."""
    rng, state, levels = np.random.default_rng(5), np.array([3.0, 3.0]), []
    pump = np.interp(
        np.arange(rows), np.arange(0, rows + 1, 15), rng.uniform(0.3, 6.5, rows // 15 + 1)
    )

    def rates(x, u):
        down, over = 0.05 * np.sqrt(max(x[0], 0.0)), 3 * max(x[0] - 10, 0.0)
        return np.array(
            [0.05 * u - down - over, down - 0.04 * np.sqrt(max(x[1], 0.0)) + 0.6 * over]
        )

    for u in pump:
        levels.append(state)
        for _ in range(20):
            half = state + 0.1 * rates(state, u)
            state = state + 0.2 * rates(half, u)
    y = np.array(levels) + 0.01 * rng.normal(size=(rows, 2))
    return oa.Record.from_arrays(
        u=pump, y=y, sampling_time=4.0, inputs=["pump"], outputs=["upper", "lower"]
    )


@pytest.mark.proof
def test_a_motion_whose_training_has_not_ended_has_no_intervals():
    motion = oa.Motion.from_equations(
        states=[
            oa.State("x1", "K*pump - a1*sqrt(max(x1, 0.01))", start="upper", learned=True),
            oa.State(
                "x2", "a1*sqrt(max(x1, 0.01)) - a2*sqrt(max(x2, 0.01))", start="lower", learned=True
            ),
        ],
        outputs=[oa.Output("upper", "x1"), oa.Output("lower", "x2")],
        inputs=["pump"],
        parameters=positive(K=0.04, a1=0.04, a2=0.05),
    )
    options = {"learner": oa.MLP(hidden=(6,), inputs=("x1",)), "blocks": 0, "fallback": False}
    short = oa.estimate(tanks(), motion, solver=oa.LevenbergMarquardt(60), **options)
    found = {warning.code: warning.text for warning in short.warnings}
    assert short.status.code == "iteration_limit" and short.std is None and short.interval is None
    assert short.parameters["std"].isna().all() and short.split(oa.Uniform()).std is None
    assert (
        "while the loss was still falling" in found["not_converged"]
        and "`iterations`" in found["not_converged"]
    )
    whole = oa.estimate(tanks(), motion, **options)
    assert whole.status.iterations > 300
    continued = "continued past its limit of 300 iterations" in whole.status.message
    assert whole.status.ok and continued == (whole.status.code != "converged")
    assert (whole.std is None) == ("not_converged" in {warning.code for warning in whole.warnings})
    assert whole.status.loss < short.status.loss


def test_a_warm_start_goes_on_from_an_earlier_model(fitted: oa.MotionEstimate, tmp_path) -> None:
    """A stopped training goes on to at least the end of a long one; a saved model does as a fit does."""
    solver = oa.LevenbergMarquardt(3)
    learner = oa.MLP((4,), inputs=("v",))
    motion, options = spring(learned=True), {"criterion": WHOLE, "blocks": 0, "fallback": False}
    short = oa.estimate(data(), motion, learner=learner, solver=solver, **options)
    longer = oa.estimate(data(), motion, learner=None, initial=short, **options)
    assert longer.learns and longer.model.form.bound == short.model.form.bound
    np.testing.assert_array_equal(longer.model.numbers.centre, short.model.numbers.centre)
    assert longer.status.loss < 1.02 * fitted.status.loss < short.status.loss
    oa.save(fitted.model, tmp_path / "model")
    for initial in (fitted, oa.load(tmp_path / "model")):
        again = oa.estimate(data(), motion, initial=initial, solver=solver, **options)
        assert again.status.loss <= fitted.status.loss * (1 + 1e-6)
        assert again.values == pytest.approx(fitted.values, rel=0.02)


def test_a_warm_start_keeps_what_the_learner_remembers_by() -> None:
    options = {"criterion": WHOLE, "blocks": 0, "fallback": False}
    options |= {"solver": oa.LevenbergMarquardt(5)}
    learner = oa.MLP((3,), inputs=("v",), states=1)
    first = oa.estimate(data(), spring(learned=True), learner=learner, **options)
    again = oa.estimate(data(250), spring(learned=True), initial=first, **options)
    assert again.model.form.motion.states == first.model.form.motion.states
    assert again.model.form.entries == first.model.form.entries


def test_warm_starts_that_fit_no_motion_are_refused(fitted: oa.MotionEstimate) -> None:
    alone = oa.estimate(data(), spring(), learner=None, criterion=WHOLE)
    lagged = oa.estimate(data(), oa.Baseline.from_terms([oa.Term("a", "y[k-1]")]), learner=None)
    other = spring(learned=True, extra=" - d*x**3", more=[oa.PhysicalParameter("d", 1.0)])
    for motion, initial, message in (
        (spring(learned=True), alone, "`initial` is physics alone"),
        (spring(learned=True), lagged, "`initial` is a lagged model"),
        (other, fitted, "`initial` has the states x, v and the parameters m, c, k, the motion"),
        (spring(), fitted, "`initial` has its learner in other equations"),
        (lagged.problem.baseline, fitted, "`initial` is a motion"),
    ):
        with pytest.raises(oa.InputError, match=message):
            oa.estimate(data(), motion, initial=initial)
    with pytest.raises(oa.InputError, match="a motion has no `ensemble`: medians"):
        oa.estimate(data(), spring(), ensemble=True, restarts=2)


def test_a_motion_that_would_take_too_much_is_refused_from_python() -> None:
    with pytest.raises(oa.InputError, match="training a learner of 10000600001 weights would take"):
        oa.estimate(data(), spring(learned=True), learner=oa.MLP((100_000, 100_000)))


def test_a_model_of_segments_that_were_not_padded_is_split_as_ever() -> None:
    """Earlier versions kept a single segment alone; it is beside empty ones now."""
    fit = oa.estimate(data(), spring(), learner=None, criterion=WHOLE)
    kept = fit.model.trained
    assert kept is not None and np.shape(kept.states)[-1] == 4
    slope = None if kept.slope is None else np.asarray(kept.slope)[..., :1]
    alone = kept._replace(states=np.asarray(kept.states)[..., :1], slope=slope)
    again = reopen_estimate(replace(fit.model, trained=alone), data()).split(oa.Training())
    np.testing.assert_allclose(again.theta, fit.theta, rtol=1e-12)
    with pytest.raises(oa.InputError, match="trained on other rows"):
        reopen_estimate(replace(fit.model, trained=alone._replace(rows=7)), data())


def test_the_unit_of_an_output_moves_no_parameter():
    """A position in m beside a pressure in Pa: errors that differ by eight orders of magnitude."""
    rng, rows = np.random.default_rng(3), 200
    u, x, p = np.repeat(rng.normal(size=40), 5), np.zeros(rows), np.zeros(rows)
    for k in range(1, rows):
        x[k], p[k] = 0.9 * x[k - 1] + 0.1 * p[k - 1], 0.7 * p[k - 1] + 0.3 * u[k - 1]
    e = 0.02 * rng.normal(size=(rows, 2)) @ [[1.0, 0.8], [0.0, 0.3]]
    found = []
    for unit in (1.0, 1e8):
        motion = oa.Motion.from_equations(
            states=[
                oa.State("a", f"0.1*(c*b/{unit} - a)", start="x"),
                oa.State("b", f"d*({unit}*u - b)", start="p"),
            ],
            outputs=[oa.Output("x", "a"), oa.Output("p", "b")],
            inputs=["u"],
            parameters=[oa.PhysicalParameter("c", 0.8), oa.PhysicalParameter("d", 0.2)],
        )
        y = np.c_[x + e[:, 0], unit * (p + e[:, 1])]
        record = oa.Record.from_arrays(u, y, inputs=["u"], outputs=["x", "p"])
        fit = oa.estimate(record, motion, learner=None, criterion=oa.Simulation(0, 0))
        found.append([fit.values, fit.std])
    np.testing.assert_allclose(found[1], found[0], rtol=1e-4)


def test_terms_that_may_be_missing_are_not_denied(monkeypatch):
    """The verdict keeps parameters from being read by them, so the text has them, too."""
    rng, rows = np.random.default_rng(2), 200
    u, y, d = np.repeat(rng.normal(size=40), 5), np.zeros(rows), 0.0
    for k in range(1, rows):
        d = 0.7 * d + 0.05 * rng.normal()
        y[k] = 0.9 * y[k - 1] + 0.1 * u[k - 1] + d
    motion = oa.Motion.from_equations(
        states=[oa.State("a", "c*(u - a)", start="y")],
        outputs=[oa.Output("y", "a")],
        inputs=["u"],
        parameters=[oa.PhysicalParameter("c", 0.1)],
    )
    record = oa.Record.from_arrays(u, y, inputs=["u"], outputs=["y"])
    fit = oa.estimate(record, motion, learner=None, criterion=oa.Simulation(0, 0))
    texts = []
    for p in (0.3, 0.03):
        test = MissingTest(p, (2, 100), 0.9, ())
        monkeypatch.setattr("orthaug.analysis.diagnosis.missing_terms", lambda fit, test=test: test)
        found = oa.diagnose(fit)
        assert found.verdict == "equation_noise"
        texts.append(found.text)
    assert "no simple missing term behind it" in texts[0]
    assert "no simple missing term" not in texts[1]
    assert "may lack explain 90 % of it together, though not surely (p = 0.03)" in texts[1]
