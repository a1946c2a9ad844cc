"""Training on the free run: θ and the weights together, from a one-step solution (the criterion `Simulation`).

Here θ is an unknown beside the weights (F1 does not hold). The split at the end is over the *measured* regressors (F2),
which keeps the orthogonal structure exact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.progress import RunTell, quiet
from orthaug.fitting.criteria import Criterion, Simulation
from orthaug.fitting.elimination import eliminate
from orthaug.fitting.initial_states import InitialStates, Start
from orthaug.fitting.learned import ErrorStatistics, Learned
from orthaug.fitting.objective import RUNAWAY, FreeRunObjective, errors_of
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.rules import check_scored, ridge_of
from orthaug.fitting.segments import Segments, lay_segments
from orthaug.fitting.solvers.descent import MARQUARDT, Descent
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.status import Ending
from orthaug.fitting.structures import Structure
from orthaug.inference.covariance import noise_covariance, theta_block, whitening
from orthaug.models.dynamics import Numbers
from orthaug.models.lagged import Lagged
from orthaug.models.learners import Bound
from orthaug.physics.problem import Problem

_COLOURED_STEPS = 256  # shorter segments do not show how long the errors remember
_COLOUR_ROWS = 4096  # of each experiment: they show it instead
_SHORTEST = 4  # steps of a segment


class Flight(NamedTuple):
    """A finished run on the free-run criterion."""

    objective: FreeRunObjective
    end: Descent
    mean_square: float
    iterations: int
    seconds: float

    @property
    def ending(self) -> Ending:
        return self.end.ending


@dataclass(frozen=True, eq=False)
class FreeRunTask:
    """A problem laid out in segments, beside its rows laid out for one step."""

    task: OneStepTask
    dynamics: Lagged
    segments: Segments
    whole: Segments
    """Segments over which runs are compared: whole experiments; for a prediction h steps ahead its own segments."""
    colour: Segments | None
    """Segments that show the colour of the errors, where the others are too short for that."""
    criterion: Criterion
    flown: Simulation
    warm: Vector | None = None
    """c of an earlier model, with whose weights training starts."""

    @classmethod
    def of(cls, task: OneStepTask, criterion: Criterion, warm: Vector | None = None) -> FreeRunTask:
        """Lay the problem's record out as a criterion of several steps declares.

        Raises:
            InputError: nothing would be scored, or the rows are not in memory.
        """
        if not task.engine.resident:
            raise InputError("a free run needs its rows in memory; train one step ahead, or take the default engine.")
        problem, flown = task.problem, criterion.flown
        assert flown is not None, "one step ahead is `OneStepTask`'s"
        longest = max(len(e) for e in problem.record.experiments) - problem.rows.start
        check_scored(criterion, longest)
        record = problem.record
        dynamics = Lagged(problem.baseline, problem.features, problem.layout, problem.outputs, task.bound)
        segments = lay_segments(record, dynamics, flown.segment, flown.washout)
        whole, colour = segments, None
        if criterion.simulates and flown.segment:
            whole = lay_segments(record, dynamics, 0, flown.washout)
            if segments.steps < _COLOURED_STEPS <= longest:
                first = tuple(e.rows(0, _COLOUR_ROWS) for e in record.experiments)
                colour = lay_segments(replace(record, experiments=first), dynamics, 0, flown.washout)
        return cls(task, dynamics, segments, whole, colour, criterion, flown, warm)

    @property
    def problem(self) -> Problem:
        return self.task.problem

    @property
    def bound(self) -> Bound | None:
        return self.task.bound

    def numbers(self, c: Vector, w: Any, tilt: Any = None) -> Numbers:
        """The model's numbers before the split."""
        scaling = self.task.scaling
        return Numbers(c, np.zeros_like(c), np.asarray(w), scaling.centre, scaling.halfwidth, self.task.unit, tilt)

    def run(
        self,
        solver: LevenbergMarquardt,
        w: Any,
        structure: Structure,
        regularization: str | float = "none",
        progress: RunTell = quiet,
    ) -> Flight:
        """One run from the weights `w`: a short one-step training, then the free run; the arguments as in `estimate`.

        Training goes on from whichever flies better, the weights after the one-step training or those before it:
        a good one-step predictor may run away.
        """
        objective = self.objective(structure)
        nowhere = Start(objective.initial.measured)
        places, begun, seconds = [objective.begin(np.asarray(w))], 0, 0.0
        ridge, evidence = ridge_of(regularization)
        if self.bound is not None and self.flown.start_iterations:
            short = LevenbergMarquardt(self.flown.start_iterations, solver.tolerance)
            first = self.task.run(short, w, structure, regularization, progress)
            begun, seconds, ridge = first.iterations, first.seconds, first.ridge
            places.append(objective.begin(np.asarray(first.w)))
        if self.warm is not None and not objective.follows:
            places.append(np.concatenate([self.warm, np.asarray(w)]))
        losses = [objective.fly(p, nowhere).loss for p in places]
        if not np.isfinite(losses).any() and self.segments.steps > _SHORTEST:
            shorter = self._shorter().run(solver, w, structure, regularization, progress)
            places, losses = [shorter.end.flown.p], [0.0]
            begun, seconds = begun + shorter.iterations, seconds + shorter.seconds

        def tell(iteration: int, loss: float) -> None:
            progress(begun + iteration, loss * self.task.rms**2 / self._residuals)

        begin = places[int(np.argmin(losses))]
        objective, end = self._descend(objective, begin, solver, ridge, evidence, tell)
        flown = end.flown
        spent = (begun + end.iterations, seconds + end.seconds)
        return Flight(objective, end, self.mean_square(flown.c, flown.w), *spent)

    def objective(self, structure: Structure) -> FreeRunObjective:
        """The criterion as a function of θ and the weights."""
        start = np.asarray(self.segments.start)
        return FreeRunObjective(
            dynamics=self.dynamics,
            task=self.task,
            numbers=self.numbers,
            segments=self.segments,
            initial=InitialStates(start, start.size > 0 and self.flown.estimates_pasts),
            elimination=eliminate(structure, self.problem),
            weight=self.problem.weight.matrix / self.task.rms,
            colour=self.colour,
        )

    def _descend(
        self,
        objective: FreeRunObjective,
        p: Vector,
        solver: LevenbergMarquardt,
        ridge: float,
        evidence: bool,
        tell: RunTell,
    ) -> tuple[FreeRunObjective, Descent]:
        """From p to the end; several outputs are weighted by their errors' covariance in a second leg."""
        ny = len(self.problem.outputs)
        options: dict[str, Any] = {"evidence": evidence, "bounds": objective.bounds, "damping": MARQUARDT}
        two_legs = ny > 1 and self.problem.weight.choice in ("auto", "covariance")
        first = solver.at_most(solver.iterations // 2) if two_legs else solver
        start = Start(objective.initial.measured)
        end = first.descend(objective, p, start, ridge=ridge, progress=tell, **options)
        noise = self._noise(objective, end) if two_legs and end.ending.usable else None
        white = None if noise is None else whitening(noise)
        if noise is None or white is None:
            return objective, end
        size = np.trace(objective.weight @ noise @ objective.weight.T) / ny  # so that the ridge keeps its place
        objective = replace(objective, weight=np.sqrt(size) * white)
        done = end.iterations
        again = solver.at_most(solver.iterations - done).descend(
            objective,
            end.flown.p,
            Start(end.flown.states),
            ridge=end.ridge,
            progress=lambda i, loss: tell(done + i, loss),
            **options,
        )
        return objective, again._replace(iterations=done + again.iterations, seconds=end.seconds + again.seconds)

    def _shorter(self) -> FreeRunTask:
        """The same over segments of a quarter of the length: they train where longer ones run away."""
        segment = max(_SHORTEST, self.segments.steps // 4)
        shorter = replace(self.flown, segment=segment, washout=min(self.flown.washout, segment // 2))
        return FreeRunTask.of(self.task, shorter)

    @property
    def _residuals(self) -> int:
        """How many errors are scored."""
        return self.segments.count * len(self.problem.outputs)

    def loss(self, run: Flight) -> float:
        """The run's `mean_square`."""
        return run.mean_square

    def mean_square(self, c: Vector, w: Any, tilt: Any = None) -> float:
        """Mean of squared errors over whole experiments, in deviations of the outputs; NaN where it diverges."""
        with np.errstate(all="ignore"):
            errors = errors_of(self.dynamics, self.numbers(c, w, tilt), self.whole.start, self.whole)
            scaled = errors / self.problem.deviation[:, None]
            mean = float(np.sum(scaled**2)) / (self.whole.count * len(self.problem.outputs))
        return mean if mean < RUNAWAY else np.nan

    def learned(self, run: Flight) -> Learned:
        """The learner as a run left it, with the statistics of its errors."""
        end, objective = run.end, run.objective
        linear = end.linear
        gram = None if linear is None else linear.information * self.task.rms**2

        def middle(noise: Matrix) -> Matrix:
            """ΣψᵀΣ_eψ of the rows of `gram`. They are white where `weight` made them so."""
            assert gram is not None
            change = objective.weight @ np.linalg.inv(self.problem.weight.matrix)  # of errors in whitened outputs
            white = change @ noise @ change.T * self.task.rms**2
            return gram * float(np.trace(white)) / len(white)

        return Learned(
            bound=self.bound,
            weights=end.flown.w,
            scaling=self.task.scaling,
            unit=self.task.unit,
            ending=end.ending,
            iterations=run.iterations,
            seconds=run.seconds,
            effective=end.effective,
            gram=gram,
            ridge=end.ridge * self.task.rms**2,
            middle=middle,
            coefficients=end.flown.c,
            errors=self._errors(run),
        )

    def median(self, members: list[Learned], best: int) -> Learned:
        """The median of several, with the error of its own free run."""
        learned = self.task.median(members, best)
        assert learned.errors is not None and learned.coefficients is not None
        own = self.mean_square(learned.coefficients, learned.weights, learned.tilt)
        return replace(learned, errors=learned.errors._replace(mean_square=own))

    def _errors(self, run: Flight) -> ErrorStatistics:
        """Noise covariance of the free run and Cov θ̂ from its sensitivities."""
        end, objective = run.end, run.objective
        theta, nt = end.flown.theta, objective.physics
        freedom = self.segments.count - (nt + end.effective) / len(objective.weight)
        noise = self._noise(objective, end)
        sides = (objective.elimination.lower, objective.elimination.upper)
        at_bound = {i: float(value) for i, value in enumerate(theta) if value in (sides[0][i], sides[1][i])}
        covariance = None
        if noise is not None and end.linear is not None:
            information = end.linear.information
            if objective.elimination.projects and self.bound is not None:
                change = objective.change(end.flown.w)
                information = change.T @ information @ change
            white = objective.weight @ noise @ objective.weight.T
            scale = float(np.trace(white)) / len(white)
            covariance = theta_block(information, end.ridge, nt, tuple(at_bound)) * scale
        return ErrorStatistics(noise, covariance, freedom, run.mean_square, at_bound)

    def _noise(self, objective: FreeRunObjective, end: Descent) -> Matrix | None:
        """Covariance (ny, ny) of the errors, in the outputs' units."""
        squares, ny = objective.squares(end.flown), len(objective.weight)
        used = (objective.physics + end.effective) / ny
        return None if squares is None else noise_covariance(squares, np.full(ny, self.segments.count - used))
