"""Training on the free run (criterion `Simulation`): θ and the weights together.

Here θ is an unknown beside the weights (F1 does not hold). The split at the end is over the
*measured* regressors (F2), which keeps the orthogonal structure exact.

Physics alone is what every learner has to beat, and where it starts: from random weights a learner
often ends above it, since its start runs away. From physics alone, with a silent learner, a descent
cannot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.progress import RunProgress, Watch, quiet
from orthaug.data.record import Record
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.elimination import Fixed, settle
from orthaug.fitting.initial_states import Start
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.learned import TrainedLearner
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.segmented_lagged import SegmentedLagged, StructuredObjective
from orthaug.fitting.segmented_problem import FreeRunFit
from orthaug.fitting.segmented_streamed import SegmentedStreamed
from orthaug.fitting.simulation_task import SimulationTask, StartPoint
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Structure
from orthaug.physics.streamed import StreamedProblem

_SHORTEST = 4  # steps of a segment
# Times, from one length of the segments to the next: the first with a finite run
_LONGER = (4.0, 2.0, 1.4, 1.15)
_SHRUNK = (0.99, 0.9, 0.5, 0.0)  # of the one-step θ: less feedback diverges later


def train_physics_only(
    plan: SegmentedLagged,
    solver: LevenbergMarquardt,
    structure: Structure,
    progress: RunProgress = quiet,
) -> FreeRunFit | None:
    """Return θ of physics alone under the criterion and the structure's rows and bounds.

    None where no run is finite.

    Training starts at the one-step solution, or at the initial values where these run better. Where
    neither run is finite, or the end diverges over whole experiments, it goes over segments that
    lengthen. Of all ends the best over whole experiments is kept; where a start was better than
    them, whole experiments are trained on too.
    """
    plan = plan.physics_only
    objective = plan.objective(structure)
    least_squares, initial = objective.begin(np.zeros(0)), plan.problem.baseline.initial
    starts = [
        least_squares,
        *([initial] if initial.any() else []),
        *(share * least_squares for share in _SHRUNK),
    ]
    losses = [objective.evaluate(p, Start(objective.initial.measured)).loss for p in starts]
    ends: list[FreeRunFit] = []
    if np.isfinite(losses).any():
        ends.append(plan.descend(objective, starts[int(np.argmin(losses))], solver, progress))
    if not np.isfinite(losses[0]) or not ends or not np.isfinite(ends[0].mean_square):
        ends += _lengthen(plan, solver, structure, starts)
    if plan.lengthens:
        better = _better_start(plan, structure, starts, ends)
        if better is not None and plan.whole is not plan.segments:
            ends += _over_whole(plan, solver, structure, better)
        elif better is not None:
            ends += _from_measured(plan, solver, structure, better)
    best = _lowest_end(ends)
    spent = {"iterations": sum(e.iterations for e in ends), "seconds": sum(e.seconds for e in ends)}
    return None if best is None else best._replace(**spent)


def _lengthen(
    plan: SegmentedLagged,
    solver: LevenbergMarquardt,
    structure: Structure,
    starts: Sequence[Vector],
) -> list[FreeRunFit]:
    """Return the end over the plan's own segments, by way of shorter ones.

    It begins at the first start whose run over them is finite.
    """
    p, segment, shortest = None, _SHORTEST, plan.over(_SHORTEST)
    for start in starts:
        end = shortest.descend(shortest.objective(structure), start, solver.within_limit)
        if end.ending.usable:
            p = end.end.point.p
            break
    while p is not None:
        for longer in _LONGER:
            steps = min(int(np.ceil(longer * segment)), plan.segments.steps)
            segmented = plan if steps == plan.segments.steps else plan.over(steps)
            end = segmented.descend(
                segmented.objective(structure),
                p,
                solver if segmented is plan else solver.within_limit,
            )
            if end.ending.usable:
                break
        else:
            return []
        p, segment = end.end.point.p, steps
        if segmented is plan:
            return [end]
    return []


def _better_start(
    plan: SegmentedLagged,
    structure: Structure,
    starts: Sequence[Vector],
    ends: Sequence[FreeRunFit],
) -> Vector | None:
    """Return the start whose run over whole experiments is better than those of all ends.

    None where an end is as good as every start.
    """
    places = [(end.mean_square, end.end.point.p) for end in ends]
    objective = plan.objective(structure)
    begun = [(plan.mean_square(objective.place(p)[1], np.zeros(0)), p) for p in starts]
    known = [place for place in (*places, *begun) if np.isfinite(place[0])]
    if not known:
        return None
    best = min(known, key=lambda place: place[0])
    return None if any(np.array_equal(best[1], p) for _, p in places) else best[1]


def _over_whole(
    plan: SegmentedLagged, solver: LevenbergMarquardt, structure: Structure, start: Vector
) -> list[FreeRunFit]:
    """Return the end over whole experiments, where ends over segments are worse there."""
    whole = replace(plan.over(0), segments=plan.whole)
    end = whole.descend(whole.objective(structure), start, solver)
    if not end.ending.usable:
        return []
    # Its statistics are those of the plan's segments
    own = plan.descend(plan.objective(structure), end.end.point.p, solver.at_most(0))
    if not own.ending.usable:
        return []
    own = own._replace(end=own.end._replace(ending=end.ending, tail=end.end.tail))
    return [own._replace(iterations=end.iterations, seconds=end.seconds)]


def _from_measured(
    plan: SegmentedLagged, solver: LevenbergMarquardt, structure: Structure, start: Vector
) -> list[FreeRunFit]:
    """Return the end that is reached by way of runs from exactly the measured lags.

    With estimated lags a mode that no input excites costs nothing, although the noise of measured
    ones excites it and their run drifts. Runs from the measured ones lead past such an end.
    """
    exact = replace(plan, free_run=replace(plan.free_run, exact_start=True))
    end = exact.descend(exact.objective(structure), start, solver.within_limit)
    if not end.ending.usable:
        return []
    own = plan.descend(plan.objective(structure), end.end.point.p, solver)
    return [own._replace(iterations=own.iterations + end.iterations)]


def _lowest_end(ends: Sequence[FreeRunFit]) -> FreeRunFit | None:
    """Return the lowest end over whole experiments, or over segments where all diverge."""
    usable = [end for end in ends if end.ending.usable]
    flying = [end for end in usable if np.isfinite(end.mean_square)]
    if flying:
        return min(flying, key=lambda end: end.mean_square)
    return min(usable, key=lambda end: end.end.point.loss, default=None)


@dataclass(frozen=True, eq=False)
class FreeRunTask(SimulationTask):
    """Training on the free run: segments, physics alone on them, an earlier model."""

    plan: SegmentedLagged
    warm: Vector | None = None
    """c of an earlier model, with whose weights training starts."""

    @classmethod
    def of(cls, task: OneStepTask, criterion: Criterion, warm: Vector | None = None) -> FreeRunTask:
        """Lay out the problem's record as a criterion of several steps declares.

        Raises:
            InputError: nothing would be scored; whole experiments of rows that are not in memory.
        """
        plan = SegmentedStreamed if isinstance(task.problem, StreamedProblem) else SegmentedLagged
        begun = cls(plan.of(task, criterion), warm=warm)
        return begun.with_checkpoints(task.checkpoints)

    @property
    def rows_task(self) -> OneStepTask:
        return self.plan.task

    def physics_alone(self) -> tuple[OneStepTask, TrainedLearner]:
        """Return the task without a learner, and the residual of physics alone.

        Least squares where no run of it is finite.
        """
        if self.physics is None:
            return self.rows_task.physics_alone()
        plan = self.plan.physics_only
        return plan.task, replace(self, plan=plan).learned(self.physics)

    def on(self, record: Record) -> FreeRunTask:
        """Return the task on another record."""
        like = None if isinstance(self.plan, SegmentedStreamed) else self.plan
        segmented = SegmentedLagged.of(self.rows_task.on(record), self.criterion, like)
        return FreeRunTask(segmented, doubts_evidence=self.doubts_evidence)

    def train_physics_only(
        self, solver: LevenbergMarquardt, structure: Structure, progress: RunProgress
    ) -> tuple[SegmentedLagged, FreeRunFit | None]:
        return self.plan, train_physics_only(self.plan, solver, structure, progress)

    def run(
        self,
        solver: LevenbergMarquardt,
        w: Any,
        structure: Structure,
        regularization: str | float = "none",
        progress: RunProgress = quiet,
        watched: Watch | None = None,
    ) -> FreeRunFit:
        """Run, with an orthogonal θ at a bound as a known term beside the learner.

        Entries at a bound where physics alone ends are fixed there from the start. The run is
        made again, from there too, where other entries are at one at its end; what was fixed once
        before is not released again.
        """
        alone: Any = self.physics
        first: Fixed = {}
        if alone is not None and self.plan.objective(structure).apart:
            first = alone.objective.held(alone.end)
        free_fits: list[FreeRunFit] = []

        def evaluate(fixed: Fixed, solver: LevenbergMarquardt = solver) -> Fixed | None:
            own = replace(self, plan=replace(self.plan, fixed=fixed))
            free_fits.append(
                super(FreeRunTask, own).run(solver, w, structure, regularization, progress, watched)
            )
            end, objective = free_fits[-1].end, free_fits[-1].objective
            assert isinstance(objective, StructuredObjective)
            return objective.held(end) if end.ending.usable and objective.apart else None

        if (
            settle(first, evaluate) != first and alone is not None
        ):  # other bounds than those of its start
            point = free_fits[-1].end.point
            if alone.mean_square < self.plan.mean_square(point.c, point.w):
                evaluate(first, solver.at_most(0))
        return free_fits[-1]._replace(seconds=sum(free_fit.seconds for free_fit in free_fits))

    def places(
        self,
        objective: StructuredObjective,
        solver: LevenbergMarquardt,
        w: Vector,
        structure: Structure,
        regularization: str | float,
    ) -> list[StartPoint]:
        """Return possible starts: physics alone, an earlier model, the one-step solution.

        The last one only where its free run is good.
        """
        plan, measured = self.plan, objective.initial.measured
        places: list[StartPoint] = []

        def add(p: Vector, states: np.ndarray = measured, silent: bool = False) -> None:
            places.append(StartPoint.of(objective, p, states, silent=silent))

        silenced = None if self.warm is not None else self.bound.silent(w)
        if self.physics is not None and silenced is not None:
            point = self.physics.end.point
            add(np.concatenate([point.theta, silenced]), point.states, silent=True)
        if self.warm is not None and not objective.follows:
            add(np.concatenate([self.warm, w]))
        elif not places:
            add(objective.begin(w))
        if plan.free_run.start_iterations and self.warm is None:
            steps = plan.free_run.start_iterations
            short = LevenbergMarquardt(steps, solver.tolerance, longest=steps)
            begun = objective.begin(
                np.asarray(plan.task.run(short, w, structure, regularization).w)
            )
            if self._simulates_better(objective, begun):
                add(begun)
        return places

    def _simulates_better(self, objective: StructuredObjective, p: Vector) -> bool:
        """Return whether the loss at p over whole experiments is at most that of physics."""
        square = self.plan.mean_square(*objective.place(p)[1:])
        return bool(np.isfinite(square)) and (
            self.physics is None or square <= self.physics.mean_square
        )

    def conclude(
        self, structure: Structure, learned: TrainedLearner, *, briefly: bool = False
    ) -> LaggedEstimate:
        """Return the estimate of what a run learned, on the rows of its problem."""
        return replace(self.rows_task.conclude(structure, learned), criterion=self.criterion)

    def median(self, members: list[TrainedLearner], best: int) -> TrainedLearner:
        """Return the median of several runs, with the error of its own free run."""
        learned = self.rows_task.median(members, best)
        assert learned.errors is not None and learned.coefficients is not None
        own = self.plan.mean_square(learned.coefficients, learned.weights, learned.tilt)
        return replace(learned, errors=learned.errors._replace(mean_square=own))
