"""A record in segments for a criterion of several steps, and a descent over them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import AnyArray, padded_length
from orthaug._base.progress import RunProgress, Watch, quiet
from orthaug.data.record import Record
from orthaug.fitting.checkpoints import OF_DESCENT, Checkpoints, RunCheckpoint
from orthaug.fitting.criteria import Criterion, Simulation
from orthaug.fitting.initial_states import Start
from orthaug.fitting.objective import RUNAWAY, FreeRunObjective, TrialPoint, errors_of
from orthaug.fitting.rules import check_scored
from orthaug.fitting.segment_sums import SegmentSums
from orthaug.fitting.segments import SHORT, Segments, build_segments
from orthaug.fitting.solvers.damped_step import MARQUARDT
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.solvers.limit import noticeable_in
from orthaug.fitting.solvers.minimize import Descent
from orthaug.fitting.status import Ending
from orthaug.inference.covariance import noise_covariance, whitening_matrix
from orthaug.models.dynamics import Dynamics, Numbers
from orthaug.models.learners import Scaling

COLOURED_STEPS = 256  # shorter segments do not show how long the errors remember
COLOUR_ROWS = 4096  # of each experiment: they show it instead


class FreeRunFit(NamedTuple):
    """A finished run on the free-run criterion."""

    objective: FreeRunObjective
    end: Descent
    mean_square: float
    iterations: int
    seconds: float
    restarted: tuple[float | None, float] | None = None
    """Errors in deviations of the outputs, from the declared initial values (None without a run)
    and from those drawn instead; None where the declared ones were kept."""
    begun_anew: bool = False
    """True where evidence had settled early, and began again from a run without a prior."""

    @property
    def ending(self) -> Ending:
        return self.end.ending

    @property
    def effective(self) -> float:
        """Effective number of weights."""
        return self.end.effective


class TrialInMemory(NamedTuple):
    """A trial with segments in memory, and the derivative of its states by (c, w)."""

    objective: FreeRunObjective
    point: TrialPoint
    slope: Float[np.ndarray, "k m n0 n"] | None


class Layout(NamedTuple):
    """Segments of a record: for training, for comparing runs, for the colour of errors."""

    segments: Segments
    whole: Segments
    colour: Segments | None

    @classmethod
    def of(
        cls,
        record: Record,
        dynamics: Dynamics,
        criterion: Criterion,
        like: SegmentedProblem | None = None,
        shares: int = 1,
    ) -> Layout:
        """Return the layout that a criterion of several steps declares.

        Padded to the shapes of another layout where that is larger.

        Raises:
            InputError: nothing would be scored.
        """
        free_run = criterion.free_run
        assert free_run is not None, "one step ahead is `OneStepTask`'s"
        longest = max(len(e) for e in record.experiments) - dynamics.first_row
        check_scored(criterion, longest)
        shapes = (None, None) if like is None else (like.segments, like.whole)
        segments = build_segments(
            record, dynamics, free_run.steps, free_run.washout, shapes[0], shares
        )
        if not (criterion.simulates and free_run.steps):
            return cls(segments, segments, None)
        # Many records share the program of their whole runs
        rounded = padded_length(longest) if segments.steps < longest <= SHORT else 0
        made = (record, dynamics, 0, free_run.washout, shapes[1])
        whole, colour = build_segments(*made, longest=rounded), None
        if segments.steps < COLOURED_STEPS <= longest:
            first = tuple(e.rows(0, COLOUR_ROWS) for e in record.experiments)
            colour = build_segments(
                replace(record, experiments=first), dynamics, 0, free_run.washout
            )
        return cls(segments, whole, colour)


@dataclass(frozen=True, eq=False, kw_only=True)
class SegmentedProblem:
    """A record in segments for a criterion.

    `rms` is the unit of the errors. `deviation` (ny,) is that of the outputs, `output_weights` how
    they are weighed against each other; `scaling` and `unit` are the learner's.
    """

    record: Record
    dynamics: Dynamics
    segments: Segments
    whole: Segments
    """Segments over which runs are compared: whole experiments; for a prediction h steps ahead its
    own segments.
    """
    colour: Segments | None
    """Segments that show the colour of the errors, where the others are too short for that."""
    criterion: Criterion
    free_run: Simulation
    rms: float
    deviation: Vector
    output_weights: str | tuple[float, ...]
    scaling: Scaling
    unit: Vector
    sums: SegmentSums | None = None
    """Who sums over the segments, where an engine keeps them."""
    checkpoints: Checkpoints | None = None
    """Where the states of its descents are kept."""

    @property
    def shares(self) -> int:
        """Number of parts that sum over segments at a time."""
        return 1 if self.sums is None else self.sums.engine.shares

    @property
    def residuals(self) -> int:
        """Number of scored errors."""
        return int(self.observations.sum())

    @property
    def observations(self) -> Int[np.ndarray, "ny"]:
        """Number of scored errors of each output."""
        return self.segments.observations

    def numbers(self, c: AnyArray, w: Vector, tilt: Any = None) -> Numbers:
        """Return the model's numbers before the split."""
        scaling = self.scaling
        return Numbers(
            c, np.zeros_like(c), np.asarray(w), scaling.centre, scaling.halfwidth, self.unit, tilt
        )

    def reporting(self, progress: RunProgress) -> RunProgress:
        """Return the progress of a run whose losses are sums of squares in this unit."""
        return lambda iteration, loss: progress(iteration, loss * self.rms**2 / self.residuals)

    def descend(
        self,
        objective: FreeRunObjective,
        p: Vector,
        solver: LevenbergMarquardt,
        progress: RunProgress = quiet,
        states: np.ndarray | None = None,
        watched: Watch | None = None,
        **options: Any,
    ) -> FreeRunFit:
        """Descend from p to the end of the run.

        Several outputs are weighted by their errors' covariance in a second leg.

        Args:
            states: of the segments' starts at p; None for the measured ones.
            watched: follows the run, as a `FreeRunFit` that has not ended.
            options: of `minimize.minimize`.
        """

        def ended(end: Any) -> FreeRunFit:
            mean_square = self.mean_square(end.point.c, end.point.w)
            return FreeRunFit(objective, end, mean_square, end.iterations, end.seconds)

        ny = len(self.dynamics.outputs)
        options |= {
            "bounds": objective.bounds,
            "damping": MARQUARDT,
            "noticeable": noticeable_in(self.residuals),
            "watched": watched and (lambda make: watched(lambda: ended(make()))),
        }
        two_legs = ny > 1 and self.output_weights in ("auto", "covariance")
        first = solver.at_most(solver.iterations // 2) if two_legs else solver
        start = Start(objective.initial.measured if states is None else states)
        kept = self._checkpoint(objective, p, start, options)
        end = first.descend(objective, p, start, progress=progress, kept=kept, **options)
        noise = self.noise(objective, end) if two_legs and end.ending.usable else None
        white = None if noise is None else whitening_matrix(noise, self.deviation)
        if noise is not None and white is not None:
            # So that the ridge keeps its place
            size = np.trace(objective.weight @ noise @ objective.weight.T) / ny
            objective = replace(objective, weight=np.sqrt(size) * white)
        if white is not None or (two_legs and end.ending is Ending.RUNNING):
            done = end.iterations
            begun, options = (
                Start(end.point.states),
                options | {"ridge": end.ridge, "ceiling": np.inf},
            )
            again = solver.after(done).descend(
                objective,
                end.point.p,
                begun,
                progress=lambda i, loss: progress(done + i, loss),
                kept=self._checkpoint(objective, end.point.p, begun, options),
                **options,
            )
            path = (*end.path, *again.path)
            spent = {"iterations": done + again.iterations, "seconds": end.seconds + again.seconds}
            tail = again.tail and again.tail._replace(
                done=spent["iterations"], limit=solver.iterations
            )
            end = again._replace(path=path, tail=tail, **spent)
        return ended(end)

    def _checkpoint(
        self, objective: FreeRunObjective, p: Vector, start: Start, options: dict[str, object]
    ) -> RunCheckpoint | None:
        """Return the checkpoint of a descent from this start."""
        if self.checkpoints is None:
            return None
        chosen = [
            options.get(name) for name in ("ridge", "evidence", "evidence_settled", "ceiling")
        ]
        size = (
            self.segments.steps,
            self.segments.count,
            objective.weight,
            objective.dynamics.unknowns,
        )
        return self.checkpoints.of_run(
            "flight", p, np.asarray(start.values), *size, *chosen, form=OF_DESCENT
        )

    def end_in_memory(self, objective: FreeRunObjective, end: Descent) -> TrialInMemory:
        """Return the end of a run with segments in memory; it has a derivative."""
        assert end.linear is not None
        return TrialInMemory(objective, end.point, objective.slope(end.linear.start))

    def noise(self, objective: FreeRunObjective, end: Descent) -> Matrix | None:
        """Return the covariance (ny, ny) of the errors, in the outputs' units."""
        squares, ny = objective.squares(end.point), len(objective.weight)
        if squares is None:
            return None
        if not self.record.complete:  # whitened errors of one row need all its outputs
            squares = np.diag(np.diag(squares))
        used = (objective.physics + end.effective) / ny
        return noise_covariance(squares, self.observations - used)

    def mean_square(self, c: Vector, w: Vector, tilt: object = None) -> float:
        """Return the mean of squared errors over whole experiments.

        Outputs in their deviations.

        NaN where it diverges.
        """
        with np.errstate(all="ignore"):
            mean = self._mean_square(c, w, tilt)
        return mean if mean < RUNAWAY else np.nan

    def _mean_square(self, c: Vector, w: Vector, tilt: object) -> float:
        """Return `mean_square` of runs that may be without bounds."""
        numbers = self.numbers(c, w, tilt)
        if self.sums is not None and self.whole is self.segments:
            squares = self.sums.squares(self.dynamics, numbers, self.segments)
            total = float(np.sum(np.diag(squares) / self.deviation**2))
        else:
            errors = errors_of(self.dynamics, numbers, self.whole.start, self.whole)
            total = float(np.sum((errors / self.deviation[:, None]) ** 2))
        return total / int(self.whole.observations.sum())
