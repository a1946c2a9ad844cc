"""Training of a motion on its free run: parameters, weights and initial states together.

Physics alone is where every learner starts, and what it has to beat. Where whole segments follow
the outputs from the initial parameters, it is trained over them. Otherwise over segments that
lengthen: first the starts of short ones are found, then the parameters over them, then over longer
ones, which begin at the states that the shorter ones went through. Every length may also begin anew
from the initial parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.errors import InputError, Warning
from orthaug._base.progress import RunProgress, quiet
from orthaug.data.record import Record
from orthaug.fitting.conclusion import conclude_motion
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.field_points import sizes_learned
from orthaug.fitting.initial_states import Start
from orthaug.fitting.learned import ErrorStatistics, TrainedLearner
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.fitting.objective import FreeRunObjective, TrialPoint
from orthaug.fitting.segment_sums import SegmentSums
from orthaug.fitting.segmented_motion import MotionObjective, SegmentedMotion
from orthaug.fitting.segmented_problem import FreeRunFit
from orthaug.fitting.segments import respond
from orthaug.fitting.simulation_task import NOTICEABLE, SimulationTask, StartPoint
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.status import Ending
from orthaug.fitting.structures import Structure
from orthaug.models.learners import Bound, Learner, declared, learns
from orthaug.models.model import Model
from orthaug.models.moving import MotionDynamics
from orthaug.models.rows import Engine
from orthaug.models.settling import LOOSE
from orthaug.models.terms import scaling_of
from orthaug.physics.motion import MOST_SUBSTEPS, Motion
from orthaug.physics.parameters import Coordinates
from orthaug.physics.problem import MotionProblem

_WARM_SETTLING = 200  # iterations of the starts, which no step of the descent damps

_SHORTEST = 15  # steps of a segment
# Times, from one length of the segments to the next; every length compiles its own programs
_LONGER = 8
_POOR = 0.5  # of the output's deviation: what is left above it may not be the best minimum
_SHORT_ITERATIONS = 15  # over segments that are not the last
# Steps at most by which starts follow the outputs: a descent damps no step of theirs
_SETTLING = 25
_LOWER = 0.98  # of the misfit: what other starts of the segments must leave
# Of a logarithm, from its initial value: a parameter that far off may move no output any more
_STARTS = 8  # drawn, where the declared initial values lead nowhere
_WIDE = np.log(5.0)  # deviation of a start: of a logarithm, else twice the value
_CHEAP = 1_000_000  # operations of a pass over the record's equations
_FEWEST = 50  # operations of equations, whose bookkeeping takes as much
RESTART_ITERATIONS = 30  # from each
_SEED = 20_261_127
_FINE = 0.01  # of the residual: how much the outputs may move when the substeps are doubled
_HARMLESS = 0.5  # standard errors of a parameter
_REFINED = 8  # substeps at most beside a learner, or twice those of physics alone
_LOOSER = 1e-4  # times the weight of the guesses, to see what the outputs determine


def train_motion_physics(
    segmented: SegmentedMotion,
    solver: LevenbergMarquardt,
    progress: RunProgress = quiet,
    known: Vector | None = None,
) -> tuple[SegmentedMotion, FreeRunFit | None]:
    """Return parameters of physics alone, and segments that start at its states.

    Where it does not follow the outputs from the declared initial values, others are drawn, and
    the best end is taken if it halves the error. None where no run is finite.

    Args:
        known: where a descent on more rows ended; this one begins there.
    """
    own, coordinates = segmented.physics_only, segmented.problem.motion.coordinates
    best = None if known is None else descend_from(own, solver, [known], None, progress)
    if best is None:
        best = descend_by_lengths(own, solver, coordinates.initial, progress)
        if is_cheap(own) and (best is None or not _follows(own, best)):
            best = _descend_from_others(own, solver, best)
    if best is None:
        return segmented, None
    best = _from_settled_states(own, solver, best)
    best = _from_lost_parameters(own, solver, best)
    spent = {"iterations": best.iterations, "seconds": best.seconds}
    own, best = _fine_enough(segmented.physics_only, best, partial(_descend_on, solver))
    if own.dynamics.substeps != segmented.dynamics.substeps:
        segmented = segmented.with_substeps(own.dynamics.substeps)
    point = best.end.point
    states = np.asarray(point.states)
    x, _ = segmented.physics_only.trajectory(point.theta, (), states)
    size = np.abs(x).max(axis=0, initial=0.0)
    segmented = replace(segmented.from_states(states), loose=LOOSE * np.where(size > 0, size, 1.0))
    mean_square = segmented.physics_only.mean_square(point.theta, np.zeros(0))
    return segmented, best._replace(mean_square=mean_square, **spent)


def _from_settled_states(
    own: SegmentedMotion, solver: LevenbergMarquardt, best: FreeRunFit
) -> FreeRunFit:
    """Return the end of a further descent where starts that follow the data anew are better.

    Starts that followed the parameters all the way down may have ended in a minimum of their own.
    """
    theta = best.end.point.theta
    states = own.settle(theta, iterations=_SETTLING)
    with np.errstate(all="ignore"):
        settled = own.objective().evaluate(theta, Start(states))
    if not settled.misfit < _LOWER * best.end.point.misfit:
        return best
    return _lower_end(best, descend_from(own, solver, [theta], None, settled=states))


def _lower_end(best: FreeRunFit, other: FreeRunFit | None) -> FreeRunFit:
    """Return the lower of two ends, the second with what both descents spent."""
    if other is None or not other.end.point.misfit < best.end.point.misfit:
        return best
    spent = {"iterations": best.iterations + other.iterations}
    return other._replace(seconds=best.seconds + other.seconds, restarted=best.restarted, **spent)


def _from_lost_parameters(
    own: SegmentedMotion, solver: LevenbergMarquardt, best: FreeRunFit
) -> FreeRunFit:
    """Return the end of a further descent where parameters that were lost are better again.

    An early step may throw a positive parameter so far towards zero, or beyond, that no output
    depends on its logarithm any more: no descent brings it back by itself.
    """
    coordinates, point = own.problem.motion.coordinates, best.end.point
    lost = coordinates.lost(point.theta)
    if not lost.any():
        return best
    theta = np.where(lost, coordinates.initial, point.theta)
    return _lower_end(best, descend_from(own, solver, [theta], None))  # starts went with them


def is_cheap(segmented: SegmentedMotion) -> bool:
    """Return whether a training takes so little that several from other starts do not matter."""
    motion = segmented.problem.motion
    if motion.source is not None:  # each evaluation takes as long as those of many expressions
        return False
    evaluations = len(segmented.record) * segmented.dynamics.substeps
    return evaluations * max(motion.size, _FEWEST) <= _CHEAP


def draw_starts(coordinates: Coordinates, middles: Sequence[Vector]) -> Iterator[Vector]:
    """Return the starts (np,) of further descents, around each of `middles` in turn."""
    random = np.random.default_rng(_SEED)
    low, high = coordinates.bounds
    for number in range(_STARTS):
        middle = middles[number % len(middles)]
        size = np.where(coordinates.positive, _WIDE, np.where(middle, 2 * np.abs(middle), 1.0))
        yield np.clip(middle + size * random.normal(size=len(middle)), low, high)


def _descend_from_others(
    own: SegmentedMotion, solver: LevenbergMarquardt, declared: FreeRunFit | None
) -> FreeRunFit | None:
    """Return the best end from drawn starts if it halves the declared one's error, else that."""
    coordinates, best = own.problem.motion.coordinates, declared
    middles = [coordinates.initial]
    if declared is not None:
        middles.append(declared.end.point.theta)
    with np.errstate(all="ignore"):
        for start in draw_starts(coordinates, middles):
            other = descend_by_lengths(own, solver.at_most(RESTART_ITERATIONS), start)
            if other is None or not np.isfinite(coordinates.physical(other.end.point.theta)).all():
                continue
            if best is None or other.end.point.misfit < best.end.point.misfit:
                best = other
    if best is None:
        return None
    if best is not declared:  # the few iterations of a start may end before the descent does
        point = best.end.point
        ended = descend_from(own, solver, [point.theta], None, settled=np.asarray(point.states))
        if ended is not None and ended.end.point.misfit <= point.misfit:
            spent = {"iterations": best.iterations + ended.iterations}
            best = ended._replace(seconds=best.seconds + ended.seconds, **spent)
    after = float(np.sqrt(_squares_at_end(own, best) / own.residuals))
    if declared is None:
        return best._replace(restarted=(None, after))
    before = float(np.sqrt(_squares_at_end(own, declared) / own.residuals))
    return best._replace(restarted=(before, after)) if after < before / 2 else declared


def restart_warnings(physics: FreeRunFit | None) -> tuple[Warning, ...]:
    """Return a warning where the declared initial values of physics alone were given up."""
    if physics is None or physics.restarted is None:
        return ()
    before, after = physics.restarted
    error = "no run of it is finite" if before is None else f"its error is {before:.3g}"
    text = (
        f"from the declared initial values physics alone does not follow the data: {error}. From "
        f"others its error is {after:.3g} standard deviations of the output: the fit begins there. "
        "If its values are impossible, give bounds."
    )
    return (Warning("other_start", text),)


def descend_by_lengths(
    own: SegmentedMotion,
    solver: LevenbergMarquardt,
    initial: Vector,
    progress: RunProgress = quiet,
) -> FreeRunFit | None:
    """Return the end of descents over ever longer segments, with what all of them spent.

    Over whole segments at once where they follow the outputs from `initial`. Where the end of the
    longer ones follows badly, a descent over whole segments from `initial` may end lower. None
    where no run is finite.
    """
    ends: list[FreeRunFit] = []
    iterations, seconds = 0, 0.0
    q, rows = initial, None
    begun = own.settle(initial, iterations=_SETTLING)
    for length in _lengths(own, initial, begun):
        short = own.over(length)
        end = descend_from(short, solver.at_most(_SHORT_ITERATIONS), [q, initial], rows)
        if end is None:
            q, rows = initial, None
            continue
        iterations, seconds = iterations + end.iterations, seconds + end.seconds
        q = end.end.point.theta
        rows = short.states_by_row(q, (), end.end.point.states)
    for start, known in ((q, rows), (initial, None)):
        if start is initial and ends and (q is initial or _follows(own, ends[0])):
            continue
        states = begun if start is initial and known is None else None
        end = descend_from(own, solver, [start], known, progress, states)
        if end is not None:
            ends.append(end)
            iterations, seconds = iterations + end.iterations, seconds + end.seconds
    if not ends:
        return None
    best = min(ends, key=lambda end: end.end.point.misfit)
    return best._replace(iterations=iterations, seconds=seconds)


def _lengths(own: SegmentedMotion, initial: Vector, states: np.ndarray) -> list[int]:
    """Return the lengths of segments before whole ones.

    None where those follow the outputs from `initial` and these starts: each length compiles its
    own programs.
    """
    steps = own.segments.steps
    lengths = [steps // _LONGER**i for i in range(20, 0, -1) if steps // _LONGER**i >= _SHORTEST]
    if not lengths:
        return []
    objective = own.objective()
    whole = objective.evaluate(initial, Start(states))
    return [] if _follows_most(own, _squared_errors(own, objective, whole)) else lengths


def descend_from(
    segmented: SegmentedMotion,
    solver: LevenbergMarquardt,
    starts: list[Vector],
    rows: list[np.ndarray] | None,
    progress: RunProgress = quiet,
    settled: np.ndarray | None = None,
) -> FreeRunFit | None:
    """Return the end of a descent from the best of the starts.

    Its segments begin at states that follow the outputs: `settled` where they are known.

    None where no run is finite.
    """
    if rows is not None:
        segmented = segmented.with_starts(rows)
    objective = segmented.objective()
    places = []
    for q in starts:
        states = segmented.settle(q, iterations=_SETTLING) if settled is None else settled
        places.append((objective.evaluate(q, Start(states)).loss, q, states))
    loss, q, states = min(places, key=lambda place: place[0])
    if not np.isfinite(loss):
        return None
    free_fit = segmented.descend(objective, q, solver, progress, states)
    return free_fit if free_fit.ending.usable else None


def _follows(segmented: SegmentedMotion, free_fit: FreeRunFit) -> bool:
    """Return whether the runs at the end of a fit follow most of the outputs' variation."""
    return _follows_most(segmented, _squares_at_end(segmented, free_fit))


def _follows_most(segmented: SegmentedMotion, squares: float) -> bool:
    """Return whether runs with these squared errors follow most of the outputs' variation."""
    return squares < _POOR**2 * segmented.residuals


def _squares_at_end(segmented: SegmentedMotion, free_fit: FreeRunFit) -> float:
    return _squared_errors(segmented, free_fit.objective, free_fit.end.point)


def _squared_errors(
    segmented: SegmentedMotion, objective: FreeRunObjective, point: TrialPoint
) -> float:
    """Return the sum of squared errors at a point, each output in its deviation.

    Infinite where they are too large to square.
    """
    squares = objective.squares(point)
    return np.inf if squares is None else float(np.sum(np.diag(squares) / segmented.deviation**2))


def _fine_enough(
    segmented: SegmentedMotion,
    free_fit: FreeRunFit,
    descend: Callable[[SegmentedMotion, FreeRunFit], FreeRunFit | None],
    enough: float = _FINE,
    most: int = MOST_SUBSTEPS,
) -> tuple[SegmentedMotion, FreeRunFit]:
    """Return segments with substeps fine enough for the outputs, and the run that they lead to.

    Doubling them moves the outputs by less than the share `enough` of what the run leaves, or
    would make them more than `most`.
    """
    motion = segmented.problem.motion
    while (
        motion.substeps is None
        and not motion.scheme.discrete
        and 2 * segmented.dynamics.substeps <= most
    ):
        finer = segmented.with_substeps(2 * segmented.dynamics.substeps)
        if substep_shift(segmented, finer, free_fit) <= enough:
            break
        again = descend(finer, free_fit)
        if again is None:
            break
        segmented, free_fit = finer, again
    return segmented, free_fit


def substep_shift(
    segmented: SegmentedMotion, finer: SegmentedMotion, free_fit: FreeRunFit
) -> float:
    """Return by what share of the residual finer integrator steps move the outputs."""
    point = free_fit.end.point
    runs = []
    for one in (segmented, finer):
        runs.append(
            np.asarray(
                respond(one.dynamics, one.numbers(point.c, point.w), one.segments, point.states)
            )
        )
    scored = segmented.segments.measured
    with np.errstate(all="ignore"):
        moved = np.where(scored, runs[1] - runs[0], 0.0) / segmented.deviation[:, None]
        ratio = np.sqrt(np.sum(moved**2) / max(_squares_at_end(segmented, free_fit), 1e-300))
    return float(ratio) if np.isfinite(ratio) else 0.0


def _descend_on(
    solver: LevenbergMarquardt,
    segmented: SegmentedMotion,
    free_fit: FreeRunFit,
    structure: Structure | None = None,
    **options: Any,
) -> FreeRunFit | None:
    """Return the end of a descent that goes on from that of a run; None where it fails."""
    point, objective = free_fit.end.point, segmented.objective(structure)
    again = segmented.descend(objective, point.p, solver, states=point.states, **options)
    return again if again.ending.usable else None


@dataclass(frozen=True, eq=False)
class MotionTask(SimulationTask):
    """A motion in segments, and the run of its physics alone."""

    plan: SegmentedMotion
    known: Vector | None = None
    """Where physics alone ended on the record that this one is a part of."""

    @classmethod
    def of(
        cls,
        problem: MotionProblem,
        learner: Learner | None,
        criterion: Criterion,
        engine: Engine | None = None,
    ) -> MotionTask:
        """Bind a learner to its equations and outputs, and cut the record into segments.

        Raises:
            InputError: nothing would be scored.
        """
        learner = declared(learner)
        learned = sum(map(len, problem.motion.learned)) if learns(learner) else 0
        bound = Bound.of(learner, len(problem.features), learned)
        return cls(
            SegmentedMotion.of(
                problem, bound, criterion, sums=None if engine is None else SegmentSums.of(engine)
            )
        )

    @property
    def rows_task(self) -> MotionTask:
        return self

    def on(self, record: Record) -> MotionTask:
        """Return the task on another record."""
        sums = None if self.plan.sums is None else SegmentSums.of(self.plan.sums.engine)
        segmented = SegmentedMotion.of(
            self.problem.on(record), self.bound, self.criterion, self.plan, sums
        )
        known = None if self.physics is None else np.asarray(self.physics.end.point.theta)
        return MotionTask(segmented, doubts_evidence=self.doubts_evidence, known=known)

    def physics_alone(self) -> tuple[MotionTask, TrainedLearner]:
        """Return the task without a learner, and the residual of physics alone.

        Without an end where no run of it is finite.
        """
        alone = replace(self, plan=self.plan.physics_only)._without_memory()
        if alone.physics is not None:
            return alone, alone.learned(alone.physics)
        unknown = ErrorStatistics(None, None, 0.0, np.nan, {})
        initial = self.problem.motion.coordinates.initial
        nothing: dict[str, Any] = {
            "bound": alone.bound,
            "weights": np.zeros(0),
            "errors": unknown,
            "coefficients": initial,
        }
        return alone, TrainedLearner(
            scaling=alone.plan.scaling, unit=alone.plan.unit, ending=Ending.NON_FINITE, **nothing
        )

    def _without_memory(self) -> MotionTask:
        """Return the task of physics alone without a learner's states, on which no output depends.

        The parameters stay, and so do the starts of the other states.
        """
        motion = self.problem.motion
        if not motion.memory:
            return self
        kept = len(motion.states) - len(motion.memory)
        plan = self.plan.with_motion(motion.without_memory)
        if self.physics is None:
            return replace(self, plan=plan)
        end = self.physics.end
        states = np.asarray(end.point.states)[:, :kept]
        plan = plan.from_states(np.asarray(self.plan.segments.start)[:, :kept])
        objective = plan.objective()
        objective = replace(objective, weight=self.physics.objective.weight)
        point = objective.evaluate(end.point.theta, Start(states))
        own = end._replace(point=point, linear=objective.linearise(point))
        physics = self.physics._replace(objective=objective, end=own)
        return replace(self, plan=plan, physics=physics)

    def median(self, members: list[TrainedLearner], best: int) -> TrainedLearner:
        """Return the best member: medians of outputs follow no equations of motion."""
        return members[best]

    def learned(self, run: FreeRunFit) -> TrainedLearner:
        """Return the learner as a run left it.

        The information counts the outputs, and hardly the guesses.
        """
        end, objective = run.end, run.objective
        if end.linear is None:
            return super().learned(run)
        information = objective.eliminate(end.point, _LOOSER * objective.start_rows)[0]
        return super().learned(
            run._replace(end=end._replace(linear=end.linear._replace(information=information)))
        )

    def conclude(
        self, structure: Structure, learned: TrainedLearner, *, briefly: bool = False
    ) -> MotionEstimate:
        """Return the estimate of what a run learned."""
        alone = None if self.physics is None else np.asarray(self.physics.end.point.theta)
        fit = conclude_motion(self.plan, structure, learned, alone, briefly=briefly)
        return replace(fit, warnings=(*fit.warnings, *restart_warnings(self.physics)))

    def refined(
        self, run: FreeRunFit, solver: LevenbergMarquardt, structure: Structure
    ) -> tuple[MotionTask, FreeRunFit]:
        """Return the task with substeps fine enough for what a run leaves, and the run gone on.

        What is fine enough for physics alone is too coarse where a learner leaves far less. Steps
        that cannot move a parameter by half its standard error stay: `|Δθ̂ᵢ| / σᵢ ≤ ‖Δŷ‖ / σ`.
        """
        if not self.bound.learns or run.ending is Ending.STOPPED or run.end.linear is None:
            return self, run

        looking = solver.until(NOTICEABLE / self.plan.residuals)

        def go_on(finer: SegmentedMotion, before: FreeRunFit) -> FreeRunFit | None:
            again = _descend_on(looking, finer, before, structure, ridge=run.end.ridge)
            return again and again._replace(
                iterations=before.iterations + again.iterations,
                seconds=before.seconds + again.seconds,
            )

        harmless = _HARMLESS / float(np.sqrt(self.plan.observations.sum()))
        most = min(MOST_SUBSTEPS, max(_REFINED, 2 * self.plan.dynamics.substeps))
        plan, ended = _fine_enough(self.plan, run, go_on, max(_FINE, harmless), most)
        return (self, run) if ended is run else (replace(self, plan=plan), ended)

    def train_physics_only(
        self, solver: LevenbergMarquardt, structure: Structure, progress: RunProgress
    ) -> tuple[SegmentedMotion, FreeRunFit | None]:
        return train_motion_physics(self.plan, solver, progress, self.known)

    def scaled(self, plan: SegmentedMotion, physics: FreeRunFit) -> SegmentedMotion:
        """Return the size of the learner's features and of the quantities it is added to.

        Over the runs of physics alone.
        """
        if not plan.bound.learns:
            return plan
        point = physics.end.point
        x, u = plan.physics_only.trajectory(point.c, (), point.states)
        with np.errstate(all="ignore"):
            features = plan.dynamics.features_at(x, u)
        finite = features[np.isfinite(features).all(axis=1)]
        scaling = scaling_of(
            plan.bound.learner, finite if len(finite) else np.zeros((1, features.shape[1]))
        )
        return replace(plan, scaling=scaling, unit=sizes_learned(plan, point.c, x, u))

    def places(
        self,
        objective: MotionObjective,
        solver: LevenbergMarquardt,
        w: Vector,
        structure: Structure,
        regularization: str | float,
    ) -> list[StartPoint]:
        """Return the start at physics alone with a silent learner.

        A learner that cannot be silenced starts as it is.
        """
        silenced = self.bound.silent(w)
        q = (
            self.problem.motion.coordinates.initial
            if self.physics is None
            else self.physics.end.point.theta
        )
        p = np.concatenate([q, w if silenced is None else silenced])
        silent = silenced is not None
        return [StartPoint.of(objective, p, objective.initial.measured, silent=silent)]


def with_its_memory(model: Model[Any], motion: Motion) -> Motion:
    """Return the motion with the states that the learner of a model remembers by."""
    states = () if model.form.separates else model.form.motion.states
    return replace(motion, states=(*motion.states, *(s for s in states if s.memory)))


def check_initial_motion(model: Model[Any], motion: Motion) -> None:
    """Raise InputError for a model that the training of a motion cannot go on from."""
    if model.form.separates:
        raise InputError("`initial` is a lagged model, which has no states; fit anew.")
    if not model.learns:
        raise InputError(
            "`initial` is physics alone and has no weights to start from; give its values as "
            "the `initial` of the parameters instead."
        )
    theirs = model.form.motion
    if theirs.names != motion.names or theirs.names_of_states != motion.names_of_states:
        raise InputError(
            f"`initial` has the states {', '.join(theirs.names_of_states)} and the parameters "
            f"{', '.join(theirs.names) or 'none'}, the motion "
            f"{', '.join(motion.names_of_states)} and {', '.join(motion.names) or 'none'}; fit "
            "anew."
        )
    if theirs.learned != motion.learned:
        raise InputError(
            "`initial` has its learner in other equations than the motion; set `learned` alike, "
            "or fit anew."
        )


@dataclass(frozen=True, eq=False)
class WarmMotionTask(MotionTask):
    """A motion in segments, whose runs may begin at an earlier model."""

    begun: Vector = field(kw_only=True)
    """The parameters' coordinates of that model, beside its learner."""

    @classmethod
    def from_model(
        cls,
        problem: MotionProblem,
        model: Model[MotionDynamics],
        criterion: Criterion,
        engine: Engine,
    ) -> WarmMotionTask:
        """Return the task with the learner of a model, in its scaling.

        Raises:
            InputError: nothing would be scored.
        """
        form, numbers = model.form, model.numbers
        plan = SegmentedMotion.of(problem, form.bound, criterion, sums=SegmentSums.of(engine))
        plan = replace(plan, scaling=model.scaling, unit=np.asarray(numbers.gain))
        coordinates = problem.motion.coordinates
        beside = form.coordinates.physical(model.theta - model.theta_aux)
        return cls(plan, begun=np.clip(coordinates.of(beside), *coordinates.bounds))

    def scaled(self, plan: SegmentedMotion, physics: FreeRunFit) -> SegmentedMotion:
        """Return the problem as it is: the weights hold in the scaling of their own training."""
        return plan

    def places(
        self,
        objective: Any,
        solver: LevenbergMarquardt,
        w: Vector,
        structure: Structure,
        regularization: str | float,
    ) -> list[StartPoint]:
        """Return the start at physics alone with a silent learner, and that at the model."""
        places = super().places(objective, solver, w, structure, regularization)
        states = self.plan.settle(self.begun, w, iterations=_WARM_SETTLING)
        return [*places, StartPoint.of(objective, np.concatenate([self.begun, w]), states)]
