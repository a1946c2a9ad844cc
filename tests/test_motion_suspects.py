"""Terms that a motion's equations lack: what they do to its parameters, and what tells of them."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from test_motion_fit import WHOLE, data, positive, spring

import orthaug as oa
from orthaug import InputError
from orthaug.analysis.bias import bias_table, table_beside
from orthaug.analysis.budget import budget_by, budget_on
from orthaug.analysis.catalogue import Catalogue
from orthaug.analysis.causes import (
    AS_CLOSE,
    CLOSE,
    Considered,
    explain_learner,
    one_of_each,
    rivals_of,
)
from orthaug.analysis.free_run_bias import linearize_fit

FRICTION = oa.MotionSuspect.of(
    "expression", "tanh(v/0.1)", factor="-1/m", unit="N", name="friction"
)
HARDENING = oa.MotionSuspect.of(
    "cubic", "x", factor="-1/m", equation="v", coefficient=0.2, name="hardening"
)
SUSPECTS = (FRICTION, HARDENING)
TRUTH = np.array([1.0, 0.8, 25.0])


def motion_budget(fit, table, smooth=()):
    """The budget by given terms alone."""
    terms, declared = linearize_fit(fit), [entry.suspect for entry in table]
    if terms.learned is None:
        return budget_on(terms, declared, table)
    close = (AS_CLOSE, CLOSE)
    considered = Considered(table, smooth, close=close, joint=True, seen_only=True)
    causes = explain_learner(terms, considered, declared)
    return None if causes is None else budget_by(terms, [causes], declared=declared)


def declared_budget(fit, declared, table=None):
    """The budget by declared terms, and by usual ones where these are not sure."""
    return budget_on(linearize_fit(fit), declared, table)


def softened_bias(fit, suspects):
    return linearize_fit(fit).softened(suspects)


def usual_biases(fit):
    return linearize_fit(fit).usual_biases()


@pytest.fixture(scope="module")
def alone() -> oa.MotionEstimate:
    return oa.estimate(
        data(friction=0.1), spring(), learner=None, criterion=WHOLE, standard_errors="plain"
    )


@pytest.fixture(scope="module")
def clean() -> oa.MotionEstimate:
    return oa.estimate(
        data(friction=0.0), spring(), learner=None, criterion=WHOLE, standard_errors="plain"
    )


@pytest.fixture(scope="module")
def learned() -> oa.MotionEstimate:
    learner = oa.MLP((4,), inputs=("v",))
    return oa.estimate(
        data(),
        spring(learned=True),
        learner=learner,
        criterion=WHOLE,
        blocks=0,
        standard_errors="plain",
    )


def test_physics_alone_is_biased_as_the_term_says_and_the_residual_says_its_size(
    alone: oa.MotionEstimate,
) -> None:
    friction, hardening = oa.suspected_bias(alone, SUSPECTS)
    moved = friction.per_unit * 0.1
    assert moved[1] == pytest.approx(alone.values[1] - TRUTH[1], rel=0.03)
    assert moved[1] > 50 * 0.0004  # of many standard errors of a fit without friction
    assert (
        np.abs(alone.values - moved - TRUTH) < [9e-4, 1.2e-3, 0.025]
    ).all()  # three such standard errors
    assert friction.removed_by == "nothing" and friction.seen is None and friction.explained is None
    found = friction.residual
    assert found.coefficient == pytest.approx(
        0.1, abs=3 * found.std
    ) and found.coefficient == pytest.approx(0.1, rel=0.05)
    assert found.t > 5 and found.share > 5 * hardening.residual.share
    assert 0.9 < friction.cosine < 1.0


def usual_of(fit: oa.MotionEstimate) -> list[str]:
    """Names of the usual terms over the guessed states."""
    x, u = fit.problem.guessed_points
    motion = fit.problem.motion
    usual = Catalogue.of_motion(motion, motion.initial, x.T, u.T).usual()
    return [suspect.name for suspect in usual]


def refitted(fit: oa.MotionEstimate, friction: float, size: float) -> np.ndarray:
    """By how much a unit of a spring that hardens moves the estimates, of data with one and with a softening one."""
    learner = oa.MLP((4,), inputs=("v",)) if fit.learns else None
    options = {"learner": learner, "criterion": WHOLE, "blocks": 0}
    records = [data(friction=friction, hardening=sign * size) for sign in (1, -1)]
    ends = [
        oa.estimate(record, spring(learned=learner is not None), **options).values
        for record in records
    ]
    return (ends[0] - ends[1]) / (2 * size)


def test_the_bias_is_that_of_data_with_the_term(clean: oa.MotionEstimate) -> None:
    _, hardening = oa.suspected_bias(clean, SUSPECTS)
    assert refitted(clean, 0.0, 0.2) == pytest.approx(hardening.per_unit, rel=0.01)
    assert hardening.expected == pytest.approx(0.2 * hardening.per_unit)


def test_a_fit_of_difference_equations_is_refused() -> None:
    rng = np.random.default_rng(0)
    record = oa.Record.from_arrays(rng.normal(size=40), rng.normal(size=40), sampling_time=0.1)
    fit = oa.estimate(record, oa.Baseline.from_terms([oa.Term("a", "y[k-1]")]), learner=None)
    with pytest.raises(oa.InputError, match="must be a fit of equations of motion .*`bias_budget`"):
        oa.suspected_bias(fit, SUSPECTS)  # type: ignore[arg-type]


def test_a_term_that_the_learner_sees_moves_what_it_could_imitate_alone(
    learned: oa.MotionEstimate,
) -> None:
    friction, hardening = oa.suspected_bias(learned, SUSPECTS)
    assert friction.seen and friction.per_unit[[0, 2]] == pytest.approx([0, 0], abs=1e-12)
    assert friction.coefficient_found == pytest.approx(0.6, rel=0.03) and friction.explained > 0.98
    assert learned.values[1] - 0.6 * friction.per_unit[1] == pytest.approx(TRUTH[1], rel=0.02)
    assert (
        friction.removed_by == "learner in part" and friction.residual is None
    )  # v tanh(v) is never negative
    assert hardening.seen is False and hardening.removed_by == "nothing"
    assert abs(hardening.residual.t) < 3  # nothing of it is there
    assert hardening.explained < 0.1


def test_explain_says_the_parameters_with_the_term_in_the_physics(
    learned: oa.MotionEstimate,
) -> None:
    """c is fitted as a logarithm: a step of that as long as the bias would end at 0.83."""
    found = oa.explain(learned, suspects=[FRICTION])
    assert [term.expression for term in found.terms] == [FRICTION.expression]
    assert [moved.value_with for moved in found.parameters] == pytest.approx(TRUTH, rel=0.005)
    assert found.physics.initial[1] == pytest.approx(TRUTH[1], rel=0.005)


def test_what_the_learner_does_not_see_biases_as_data_with_it(learned: oa.MotionEstimate) -> None:
    _, hardening = oa.suspected_bias(learned, SUSPECTS)
    assert refitted(learned, 0.6, 0.05) == pytest.approx(hardening.per_unit, rel=0.05)


def test_the_budget_covers_the_truth_where_the_interval_does_not(
    alone: oa.MotionEstimate, learned: oa.MotionEstimate, clean: oa.MotionEstimate
) -> None:
    for fit in (alone, learned):
        budget = motion_budget(fit, oa.suspected_bias(fit, SUSPECTS))
        c = budget.of("c")
        assert budget.cause.suspect is FRICTION
        assert fit.interval[1, 0] > TRUTH[1] and c.ci95[0] < TRUTH[1] < c.ci95[1]
        assert c.ci95[1] - c.ci95[0] < 0.35 * c.value  # the bias is told, not only admitted
        (warning,) = budget.warnings
        assert (
            warning.code == "biased"
            and "friction of size" in warning.text
            and "c by +" in warning.text
        )
    assert motion_budget(clean, oa.suspected_bias(clean, SUSPECTS)) is None
    friction = oa.suspected_bias(alone, SUSPECTS)[0]
    among_more = replace(
        friction, residual=replace(friction.residual, left=1.5 * friction.residual.share)
    )
    assert (
        motion_budget(alone, [among_more]) is None
    )  # something else is missing: no one knows what


def test_a_function_has_suspects_too(alone: oa.MotionEstimate) -> None:
    given = spring()

    def f(x, u, p):
        return jnp.stack([x[1], (u[0] - p[1] * x[1] - p[2] * x[0]) / p[0]])

    outputs = (lambda x, u, p: x[:1], given.states, ["y"])
    motion = oa.Motion.from_functions(f, *outputs, given.parameters, given.inputs, substeps=1)
    fit = oa.estimate(data(friction=0.1), motion, learner=None, criterion=WHOLE)
    suspect = oa.MotionSuspect.of("expression", "tanh(v/0.1)", factor="-1/m", equation="v")
    (theirs,), ours = oa.suspected_bias(fit, [suspect]), oa.suspected_bias(alone, SUSPECTS)[0]
    assert theirs.per_unit == pytest.approx(ours.per_unit, rel=1e-6)


def test_a_sensor_may_lack_a_term() -> None:
    """An offset of the sensor moves nothing that the start does not; it is found, within its standard error."""
    record = data(friction=0.0)
    shifted = oa.Record.from_arrays(
        u=record.experiments[0].inputs[:, 0],
        y=record.experiments[0].outputs[:, 0] + 0.05,
        sampling_time=0.05,
    )
    fit = oa.estimate(shifted, spring(), learner=None, criterion=WHOLE)
    (offset,) = oa.suspected_bias(fit, [oa.MotionSuspect.of("offset", equation="y")])
    assert offset.residual.coefficient == pytest.approx(0.05, rel=0.02) and offset.residual.t > 10


def test_suspects_that_the_motion_cannot_have_are_refused(alone: oa.MotionEstimate) -> None:
    def refused(match: str, *arguments: str, **options: str) -> None:
        with pytest.raises(InputError, match=match):
            oa.suspected_bias(alone, [oa.MotionSuspect.of(*arguments, **options)])

    refused("unknown kind of suspect 'culomb', did you mean 'coulomb'", "culomb", "v")
    refused("needs `on`, an expression such as v", "coulomb")
    refused("unknown name 'w'", "coulomb", "w")
    refused("its parentheses do not match", "coulomb", "v) + (v")
    refused("no equation is that of 'w'; known are x, v, y", "coulomb", "v", equation="w")
    refused("is not finite at", "expression", "1/(x - x)")
    refused("a signal such as y", "cubic", "y[k-1]")
    two = oa.Motion.from_equations(
        [oa.State("a", "-k*a"), oa.State("b", "k*a - b*c")],
        [oa.Output("y", "b")],
        positive(k=1.0, c=1.0),
    )
    with pytest.raises(InputError, match="`equation` is missing; one of a, b, y"):
        oa.MotionSuspect.of("offset").place(two)
    assert usual_of(alone) == [
        *(f"{kind} of {name}" for name in "xv" for kind in ("coulomb", "quadratic_drag", "cubic")),
        *(f"{kind} of u" for kind in ("cubic", "dead_zone", "saturation")),
        "offset",
    ]


@pytest.mark.parametrize("bend", [0.0, 0.25])
def test_a_sensor_that_bends_what_it_measures_is_named(bend: float) -> None:
    """The missing cube is in the output; without it the friction in the equation is found."""
    rng, h = np.random.default_rng(3), 0.01
    force = np.repeat(rng.uniform(-20, 20, 60), 25)
    x, v, xs = 0.0, 0.0, []
    for u in force:
        xs.append(x)
        for _ in range(5):
            friction = 0.0 if bend else 1.5 * np.tanh(v / 0.02)
            v += h / 5 * (u - 1.5 * v - 30 * x - friction)
            x += h / 5 * v
    measured = np.array(xs)
    measured = measured + bend * measured**3 + 0.002 * rng.normal(size=len(xs))
    record = oa.Record.from_arrays(u=force, y=measured, sampling_time=h)
    spring = oa.Motion.from_equations(
        [
            oa.State("x", "v", start="y"),
            oa.State("v", "(u - c*v - k*x)/m", start="derivative of y"),
        ],
        [oa.Output("y", "x")],
        positive(m=1.2, c=1.0, k=25.0),
        inputs=["u"],
    )
    found = oa.diagnose(oa.estimate(record, spring, learner=None, criterion=WHOLE))
    best = found.missing.terms[0]
    assert found.verdict == "unmodelled" and best.share > 0.6
    if bend:
        assert (best.equation, best.output, best.variable, best.shape) == (None, "y", "x", "cube")
        assert best.coefficient == pytest.approx(bend, rel=0.3)
        assert "the equation of the output y lacks something odd in x" in found.text
    else:
        assert (best.equation, best.output, best.variable) == ("v", None, "v")


def test_what_keeps_its_sign_has_no_jump_at_zero() -> None:
    """A level and a pump that are always positive: a dead zone of the pump is a constant there, and no friction."""
    rng, level, rows = np.random.default_rng(5), 1.0, []
    for u in np.repeat(rng.uniform(1, 4, 30), 10):
        rows.append((u, level))
        for _ in range(20):
            level += 0.005 * (0.8 * (u - 0.6) - 0.5 * level)
    u, y = np.array(rows).T
    record = oa.Record.from_arrays(u=u, y=y + 0.002 * rng.normal(size=300), sampling_time=0.1)
    tank = oa.Motion.from_equations(
        [oa.State("h", "g*u - k*h", start="y")],
        [oa.Output("y", "h")],
        positive(g=1.0, k=1.0),
        inputs=["u"],
    )
    fit = oa.estimate(record, tank, learner=None, criterion=WHOLE)
    found = oa.diagnose(fit)
    assert found.verdict == "unmodelled"
    best = found.missing.terms[0]
    assert best.shape == "constant" and best.coefficient == pytest.approx(-0.48, rel=0.2)
    assert "jump" not in found.text and "the equation of h lacks something constant" in found.text
    assert not {"jump", "absolute"} & {term.shape for term in found.missing.terms}
    assert [name for name in usual_of(fit) if "of h" in name] == [
        "quadratic_drag of h",
        "cubic of h",
    ]
    assert "curved in h" in replace(best, variable="h", shape="square", side=1).meaning
    level = replace(best, variable="h", shape="linear", width=2.0)
    assert level.term == "(max(h - 2, 0) + min(h + 2, 0))"
    assert replace(level, side=1).term == "max(h - 2, 0)"
    assert replace(level, side=-1).term == "min(h + 2, 0)"


def test_friction_that_turns_round_smoothly_is_no_drag() -> None:
    """6 tanh(v / 0.1) at speeds of 0.1: the jump explains less of what was learned than a drag of the wrong sign."""
    options = {
        "learner": oa.MLP((4,), inputs=("v",)),
        "criterion": WHOLE,
        "blocks": 0,
        "standard_errors": "plain",
    }
    fit = oa.estimate(data(friction=6.0, noise=0.0005), spring(learned=True), **options)
    kinds = ("coulomb", "quadratic_drag", "cubic")
    suspects = [oa.MotionSuspect.of(kind, "v", factor="-1/m", name=kind) for kind in kinds]
    table, smooth = oa.suspected_bias(fit, suspects), softened_bias(fit, suspects)
    alone, beside = motion_budget(fit, table), motion_budget(fit, table, smooth)
    assert (
        alone.cause.suspect.name == "quadratic_drag"
        and alone.coefficient < 0
        and alone.of("c").value < 0
    )
    assert beside.cause.suspect.name.startswith("coulomb as tanh(v/0.") and beside.share > 0.97
    assert beside.coefficient == pytest.approx(6.0, rel=0.3)
    low, high = beside.of("c").ci95
    assert low < TRUTH[1] < high
    rivals = rivals_of(beside.cause, (*table, *smooth))
    assert [rival.suspect.name[:15] for rival in rivals] == ["coulomb as tanh"] and rivals[
        0
    ] is not beside.cause
    # A rival that is elsewhere
    twice = motion_budget(fit, [beside.cause, replace(table[1], explained=beside.share)])
    assert not twice.of("c").determined or twice.of("c").ci95[1] > alone.of("c").ci95[0]
    assert "(close to it: quadratic_drag, " in twice.warnings[0].text


def test_usual_terms_that_the_learner_sees_are_weighed_too(
    learned: oa.MotionEstimate, alone: oa.MotionEstimate
) -> None:
    """With widths by the states that the fit has found: guessed ones may stand still."""
    table, smooth = usual_biases(learned)
    kinds = ("coulomb", "quadratic_drag", "cubic")
    assert [entry.suspect.name for entry in table] == [
        *(f"{kind} of v" for kind in kinds),
        "offset",
    ]
    assert len(smooth) == 6
    found = motion_budget(learned, table, smooth)
    assert found.cause.suspect.name.startswith(("coulomb of v", "tanh(v")) and found.share > 0.9
    low, high = found.of("c").ci95
    assert low < TRUTH[1] < high < learned.values[1]
    assert usual_biases(alone) == ([], [])


def test_a_learner_that_found_nothing_is_no_term() -> None:
    options = {"learner": oa.MLP((4,), inputs=("v",)), "criterion": WHOLE, "blocks": 0}
    fit = oa.estimate(data(friction=0.0), spring(learned=True), **options)
    table, smooth = usual_biases(fit)
    assert max(entry.explained or 0.0 for entry in table) > 0.5  # of next to nothing
    assert motion_budget(fit, table, smooth) is None and declared_budget(fit, (), []) is None


def test_a_declared_term_that_explains_half_hides_no_usual_one(learned: oa.MotionEstimate) -> None:
    drag = oa.MotionSuspect.of("quadratic_drag", "v", factor="-1/m", name="drag")
    table = oa.suspected_bias(learned, [drag])
    half = motion_budget(learned, table)
    assert half.cause.suspect is drag and half.share < 0.9 and half.of("c").value < 0
    assert "what the learner found looks most like drag of size" in half.warnings[0].text
    found = declared_budget(learned, [drag], table)
    assert (
        found.cause.suspect.name.startswith(("coulomb of v", "tanh(v"))
        and found.share > 0.9
        and found.of("c").value > 0
    )
    sure = [replace(table[0], explained=0.99)]
    assert declared_budget(learned, [drag], sure).cause is sure[0]


def test_the_interval_counts_what_the_next_term_makes_of_the_rest(
    learned: oa.MotionEstimate,
) -> None:
    kinds = ("coulomb", "quadratic_drag")
    both = oa.suspected_bias(
        learned, [oa.MotionSuspect.of(kind, "v", factor="-1/m", name=kind) for kind in kinds]
    )
    assert rivals_of(both[0], both) == []
    one, two = (motion_budget(learned, table).of("c").ci95 for table in (both[:1], both))
    assert two[0] < one[0] and two[1] > one[1]


def test_states_that_nobody_guessed_have_suspects_where_the_run_goes() -> None:
    still = oa.Motion.from_equations(
        [oa.State("x", "v"), oa.State("v", "(u - c*v - k*x)/m")], [oa.Output("y", "x")], positive(m=1.2, c=1.2, k=30.0),
        inputs=["u"],
    )  # fmt: skip
    fit = oa.estimate(data(), still, learner=None, criterion=WHOLE)
    assert "coulomb of v" not in usual_of(fit)
    assert "coulomb of v" in [suspect.name for suspect in linearize_fit(fit).usual()]


def test_a_rival_leaves_about_as_little_of_the_learner(learned: oa.MotionEstimate) -> None:
    (cause,) = oa.suspected_bias(
        learned, [oa.MotionSuspect.of("quadratic_drag", "v", factor="-1/m", name="drag")]
    )
    for share, least in ((0.9999, 0.995), (0.95, 0.9), (0.6, 0.5)):
        table = [replace(cause, explained=least + step) for step in (0.001, -0.001)]
        assert rivals_of(replace(cause, explained=share), table) == table[:1]


def test_what_a_cause_leaves_of_the_learner_may_be_another_s(learned: oa.MotionEstimate) -> None:
    """A cause that explains all but a drag of half its size: the interval counts what that would do."""
    ground = linearize_fit(learned)
    kinds = ("coulomb", "quadratic_drag")
    dry, drag = (oa.MotionSuspect.of(kind, "v", factor="-1/m", name=kind) for kind in kinds)
    rows = [
        suspect.values(ground.motion, learned.values, ground.field.x, ground.field.u)
        for suspect in (dry, drag)
    ]
    both = replace(ground, learned=(rows[0] + 0.5 * rows[1])[:, None])
    first, second = bias_table(both, [dry, drag])
    (after,) = table_beside(both, [replace(first, coefficient_found=1.0)], [first, second])
    assert after.suspect is drag and after.explained == pytest.approx(1.0)
    assert after.coefficient_found == pytest.approx(0.5)


def test_a_jump_that_is_there_stays_one(learned: oa.MotionEstimate) -> None:
    assert softened_bias(learned, SUSPECTS) == []  # none of the kind coulomb
    jump = oa.MotionSuspect.of("coulomb", "v - 0.1", factor="-1/m", name="dry", coefficient=0.5)
    smooth = [entry.suspect for entry in softened_bias(learned, [jump])]
    assert len(smooth) == 6 and all(
        s.expression.startswith("(-1/m)*(tanh((v - 0.1)/") for s in smooth
    )
    assert {(s.equation, s.coefficient, s.jump) for s in smooth} == {(None, 0.5, None)}
    drag = oa.MotionSuspect.of("quadratic_drag", "v", factor="-1/m", name="drag")
    (entry,) = oa.suspected_bias(learned, [drag])
    little = replace(entry, explained=0.97)
    assert motion_budget(learned, [replace(entry, explained=0.985)], [little]).cause.suspect is drag


@pytest.fixture(scope="module")
def masses() -> oa.MotionEstimate:
    """Two masses whose coupling hardens: the force stands in both equations, and the learner sees the distance."""
    rng, step = np.random.default_rng(0), 0.005
    force, x = np.repeat(rng.uniform(-6, 6, 60), 10), np.zeros((600, 4))

    def slope(s: np.ndarray, u: float) -> np.ndarray:
        between = 20 * (s[0] - s[2]) + 0.5 * (s[1] - s[3]) + 60 * (s[0] - s[2]) ** 3
        return np.array([s[1], u - between - 4 * s[0], s[3], 2 * (between - 0.4 * s[3])])

    for k, u in enumerate(force[:-1]):
        x[k + 1] = x[k]
        for _ in range(10):
            middle = x[k + 1] + step / 2 * slope(x[k + 1], u)
            x[k + 1] = x[k + 1] + step * slope(middle, u)
    y = x[:, ::2] + 1e-3 * rng.normal(size=(600, 2))
    record = oa.Record.from_arrays(
        force, y, sampling_time=10 * step, inputs=["u"], outputs=["a", "b"]
    )
    motion = oa.Motion.from_equations(
        states=[
            oa.State("x1", "v1", start="a"),
            oa.State("v1", "(u - f - 4*x1)/m", start="derivative of a", learned=True),
            oa.State("x2", "v2", start="b"),
            oa.State("v2", "2*(f - d*v2)", start="derivative of b", learned=True),
        ],
        outputs=[oa.Output("a", "x1"), oa.Output("b", "x2")],
        inputs=["u"],
        parameters=positive(m=0.8, k=15.0, c=0.3, d=0.3),
        define={"f": "k*(x1 - x2) + c*(v1 - v2)"},
        substeps=1,
    )
    learner = oa.MLP((4,), inputs=("x1-x2",))
    return oa.estimate(record, motion, learner=learner, criterion=WHOLE, blocks=0, restarts=1)


@pytest.mark.proof
def test_a_force_between_two_masses_is_named_in_both_equations(
    masses: oa.MotionEstimate, record_property
) -> None:
    found = declared_budget(masses, (), [])
    assert [str(cause.suspect.name) for cause in found.causes] == [
        "cubic of x1-x2 in v1",
        "cubic of x1-x2 in v2",
    ]
    one, two = (cause.coefficient_found for cause in found.causes)
    record_property("coefficients, -60 and 120 in truth", f"{one:.1f}, {two:.1f}")
    assert (
        one == pytest.approx(-60, rel=0.2)
        and two == pytest.approx(120, rel=0.2)
        and found.share > 0.9
    )
    (low, high), stiffness = found.of("k").ci95, masses.values[1]
    assert low < 20 < high and stiffness - 20 > high - low
    (warning,) = found.warnings
    assert "and cubic of x1-x2 in v2 of size" in warning.text and "explain 100 % of" in warning.text
    assert (
        "in the equation of v1 and" in warning.text
        and "in the equation of v2 explain" in warning.text
    )


def unweighted(terms, suspect) -> np.ndarray:
    """A term in the learned equations over the points of the measure."""
    return terms.values(suspect) / terms.weigh(np.ones((1, len(terms.field.size))))


@pytest.mark.proof
@pytest.mark.parametrize("points", [50, 20_000])
def test_terms_of_each_equation_are_chosen_beside_those_of_the_others(
    masses, points, monkeypatch
) -> None:
    """What two terms make together is found though another one explains more alone; their order tells nothing."""
    monkeypatch.setattr("orthaug.analysis.causes.MOST_POINTS", points)
    ground, table = linearize_fit(masses), usual_biases(masses)[0]
    names = [entry.suspect.name for entry in table]
    one, two = (
        table[names.index(f"{kind} of x1-x2 in {v}")]
        for kind, v in (("dead_zone", "v1"), ("cubic", "v2"))
    )
    values = 3.0 * unweighted(ground, one.suspect) - 40.0 * unweighted(ground, two.suspect)
    for entries in (table, table[::-1]):
        each = {
            found[0].equation: found[0]
            for found in one_of_each(replace(ground, learned=values), entries)
        }
        assert each["v1"].suspect == one.suspect and each["v2"].suspect == two.suspect
        assert each["v1"].coefficient_found == pytest.approx(3.0) and each[
            "v1"
        ].explained == pytest.approx(1.0)
        assert each["v2"].coefficient_found == pytest.approx(-40.0)
    alone = [entry for entry in table if entry.equation == "v1"]
    assert one_of_each(ground, alone) == []


def test_the_size_of_a_cause_is_that_of_its_trace(
    alone: oa.MotionEstimate, learned: oa.MotionEstimate
) -> None:
    """Of a learner by what it found, also where the residual tells of the term; without a learner by the residual."""
    found = oa.suspected_bias(alone, SUSPECTS)[0].residual
    (entry,) = oa.suspected_bias(learned, [FRICTION])
    budget = motion_budget(learned, [replace(entry, residual=found)])
    assert budget.coefficient == entry.coefficient_found != found.coefficient
    assert (
        motion_budget(alone, oa.suspected_bias(alone, [FRICTION])).coefficient == found.coefficient
    )


def test_terms_of_a_difference_in_an_equation_are_usual_suspects():
    """Of heat that leaves by (T - outside)**1.5 a constant was the cause that came nearest."""
    states = [oa.State("T", "(heat - h*(T - outside))/C", start="y")]
    motion = oa.Motion.from_equations(
        states,
        [oa.Output("y", "T")],
        [oa.PhysicalParameter(n, 1.0) for n in "hC"],
        ["heat", "outside"],
    )
    rng = np.random.default_rng(0)
    temperature, rows = 20 + rng.normal(size=(1, 50)), rng.normal(size=(2, 50))
    usual = Catalogue.of_motion(motion, motion.initial, temperature.T, rows.T).usual()
    assert "quadratic_drag of T - outside" in {suspect.name for suspect in usual}


def test_a_difference_that_two_equations_have_either_way_round_is_one_argument():
    """Every term of w - q was listed twice, once with its sign turned."""
    motion = oa.Motion.from_equations(
        [
            oa.State("w", "(force - d*(w - q))/m", start="y"),
            oa.State("q", "-d*(q - w)/m", start=0.0),
        ],
        [oa.Output("y", "w")],
        [oa.PhysicalParameter(n, 1.0) for n in "dm"],
        ["force"],
    )
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(50, 2)), rng.normal(size=(50, 1))
    names = {suspect.name for suspect in Catalogue.of_motion(motion, motion.initial, x, u).usual()}
    assert any("w - q" in name for name in names) and not any("q - w" in name for name in names)
