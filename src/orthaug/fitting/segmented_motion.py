"""A motion's record in segments whose initial states are unknowns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import AnyArray, Array, jax, quick_jit
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.initial_states import InitialStates
from orthaug.fitting.objective import FreeRunObjective, errors_of
from orthaug.fitting.segment_sums import SegmentSums
from orthaug.fitting.segmented_problem import Layout, SegmentedProblem
from orthaug.fitting.segments import Segments, begins_of, build_segments, few_lanes
from orthaug.fitting.structures import Structure
from orthaug.models.dynamics import Numbers
from orthaug.models.learners import Bound, Scaling
from orthaug.models.moving import MotionDynamics
from orthaug.models.predictor import dynamics_of, predictor_of
from orthaug.models.settling import LOOSE, Windows, settle
from orthaug.models.starts import FIRST_ROWS
from orthaug.physics.innovations import InnovationsModel
from orthaug.physics.motion import Motion
from orthaug.physics.problem import MotionProblem


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionObjective(FreeRunObjective):
    """`‖r‖²` of the free run, with initial states that have almost no prior."""

    loose: Vector

    @property
    def start_rows(self) -> Matrix:
        return np.diag(1 / self.loose)


@dataclass(frozen=True, eq=False, kw_only=True)
class SegmentedMotion(SegmentedProblem):
    """A motion's record in segments.

    `loose` (nx,) is how far a start may be from its guess.
    """

    dynamics: MotionDynamics
    problem: MotionProblem
    loose: Vector
    predictor: InnovationsModel | None = None
    """The noise model whose gain is given to a predictor; None for other dynamics."""
    like: SegmentedMotion | None = None
    """The layout whose shapes this one has, so that the same programs run over both."""

    @classmethod
    def of(
        cls,
        problem: MotionProblem,
        bound: Bound,
        criterion: Criterion,
        like: SegmentedMotion | None = None,
        sums: SegmentSums | None = None,
        predictor: InnovationsModel | None = None,
    ) -> SegmentedMotion:
        """Lay out a record as a criterion declares, for a motion and a learner of unit scaling.

        With `like` in the shapes of another layout, and with its substeps.

        Raises:
            InputError: nothing would be scored.
        """
        record, free_run = problem.record, criterion.free_run
        assert free_run is not None, "a motion has no criterion one step ahead"
        features = problem.features[: bound.nz]  # none without a learner
        substeps = problem.substeps if like is None else like.dynamics.substeps
        dynamics = dynamics_of(problem.motion, features, bound, record.sampling_time, substeps)
        if predictor is not None or sums is not None:
            record.check_measured()
        dynamics = dynamics if predictor is None else predictor_of(dynamics)
        shares = 1 if sums is None else sums.engine.shares
        return cls(
            record=record,
            dynamics=dynamics,
            **Layout.of(record, dynamics, criterion, like, shares)._asdict(),
            criterion=criterion,
            free_run=free_run,
            rms=1.0,
            deviation=problem.deviation,
            output_weights=problem.weight.choice,
            scaling=Scaling(np.zeros(bound.nz), np.ones(bound.nz)),
            unit=np.ones(bound.ny),
            sums=sums,
            problem=problem,
            loose=LOOSE * sizes(problem),
            predictor=predictor,
            like=like,
        )

    def numbers(self, c: AnyArray, w: Any, tilt: Any = None) -> Numbers:
        numbers = super().numbers(c, w, tilt)
        return (
            numbers if self.predictor is None else numbers._replace(correction=self.predictor.gain)
        )

    @property
    def bound(self) -> Bound:
        return self.dynamics.bound

    @property
    def physics_only(self) -> SegmentedMotion:
        """The problem without a learner."""
        nothing = Scaling(np.zeros(0), np.ones(0))
        return replace(self, dynamics=self.dynamics.physics_only, scaling=nothing, unit=np.ones(0))

    def with_motion(self, motion: Motion) -> SegmentedMotion:
        """Return the problem of physics alone with another motion, from its guessed starts."""
        problem = replace(self.problem, motion=motion, features=())
        dynamics = replace(self.dynamics, motion=motion)
        other = replace(
            self, problem=problem, dynamics=dynamics, loose=self.loose[: len(motion.states)]
        )
        layout = Layout.of(self.record, dynamics, self.criterion, self, self.shares)
        return replace(other, **layout._asdict())

    def over(self, segment: int) -> SegmentedMotion:
        """Return the problem in segments of another length, without washout.

        0 for whole experiments.
        """
        shape = None if self.like is None else self.like.over(segment).segments
        made = (self.record, self.dynamics, segment, 0, shape, self.shares)
        segments = build_segments(*made, lanes=few_lanes(segment))
        return replace(
            self, segments=segments, free_run=replace(self.free_run, segment=segment, washout=0)
        )

    def with_substeps(self, substeps: int) -> SegmentedMotion:
        """Return the problem with other substeps of the integrator."""
        dynamics = replace(self.dynamics, substeps=substeps)
        finer = replace(self, dynamics=dynamics)
        if (
            dynamics.motion.hold != "spline"
        ):  # otherwise steps read the input at the points of the substeps
            return finer
        return finer._built_anew()

    def with_signals(self, signals: Sequence[Matrix]) -> SegmentedMotion:
        """Return the problem with signals (N, ns) of every experiment as further inputs."""
        if not signals:
            return self
        longest = max(len(channel.name) for channel in (*self.record.inputs, *self.record.outputs))
        names = tuple(f"s{'_' * longest}{i}" for i in range(signals[0].shape[1]))  # no channel's
        pairs = zip(self.record.experiments, signals, strict=True)
        record = replace(
            self.record,
            inputs=(*self.record.inputs, *names),
            experiments=tuple(
                replace(part, inputs=np.concatenate([part.inputs, own], axis=1))
                for part, own in pairs
            ),
        )
        return replace(self, record=record)._built_anew()

    def _built_anew(self) -> SegmentedMotion:
        """Return the problem with its segments cut anew, from the same starts."""
        layout = Layout.of(self.record, self.dynamics, self.criterion, self, self.shares)
        segments = (
            layout.segments
            if self.free_run == self.criterion.free_run
            else self.over(self.free_run.steps).segments
        )
        start = np.asarray(self.segments.start)
        return replace(
            self, segments=segments._replace(start=start), whole=layout.whole, colour=layout.colour
        )

    def from_states(self, states: Float[np.ndarray, "k n0 m"]) -> SegmentedMotion:
        """Return the problem with segments that start at these states."""
        return replace(self, segments=self.segments._replace(start=np.asarray(states)))

    def objective(self, structure: Structure | None = None) -> MotionObjective:
        """Return the criterion as a function of the parameters' coordinates and the weights."""
        return MotionObjective(
            dynamics=self.dynamics,
            numbers=self.numbers,
            segments=self.segments,
            initial=InitialStates(np.asarray(self.segments.start), free=True),
            weight=self.weight,
            rms=self.rms,
            deviation=self.deviation,
            physics=len(self.problem.motion.parameters),
            bounds=self.problem.motion.coordinates.bounds,
            colour=None,
            sums=self.sums,
            loose=self.loose,
        )

    @property
    def weight(self) -> Matrix:
        """The matrix (ny, ny) that gives errors in the unit of the residual of physics alone."""
        return self.problem.weight.matrix / self.rms

    def settle(
        self, c: Vector, w: Any = (), segments: Segments | None = None, iterations: int = 12
    ) -> np.ndarray:
        """Return the initial states (k, n0, m) by which segments follow the outputs best."""
        segments = self.segments if segments is None else segments
        numbers, states = self.numbers(c, np.asarray(w)), []
        for start, inputs, target, scored in zip(*map(np.asarray, segments), strict=True):
            windows = Windows(inputs, target, scored)
            made = (self.dynamics, numbers, start, windows, self.weight, self.loose, iterations)
            states.append(settle(*made)[0])
        return np.stack(states)

    def _mean_square(self, c: Vector, w: Any, tilt: object) -> float:
        """Return the mean of squares; a whole experiment starts where its first rows say best."""
        longest = min(FIRST_ROWS, self.whole.steps)
        inputs, target, scored = (np.asarray(part)[:, :longest] for part in self.whole[1:])
        first = Segments(self.whole.start, inputs, target, scored)
        start = self.settle(c, w, first, 30)
        errors = errors_of(self.dynamics, self.numbers(c, w), start, self.whole)
        scaled = errors / self.deviation[:, None]
        return float(np.sum(scaled**2)) / int(self.whole.observations.sum())

    def runs(self, c: AnyArray, w: Any, states: np.ndarray) -> Float[np.ndarray, "k T n0 m"]:
        """Return the states along every segment from these starts."""
        return np.asarray(_states(self.dynamics, self.numbers(c, w), self.segments, states))

    def trajectory(self, c: Vector, w: Any, states: np.ndarray) -> tuple[Matrix, Matrix]:
        """Return states (N, nx) and inputs (N, nu) of the segments' runs, on scored rows."""
        x, inputs = self.steps(c, w, states)
        return x, self.dynamics.at_samples(self.numbers(c, w), x, inputs)

    def steps(self, c: Vector, w: Any, states: np.ndarray) -> tuple[Matrix, Matrix]:
        """Return states (N, nx) of the segments' runs and inputs of their steps, on scored rows."""
        scored = np.moveaxis(np.asarray(self.segments.scored), -1, 1)
        inputs = np.moveaxis(np.asarray(self.segments.inputs), -1, 1)[scored]
        return np.moveaxis(self.runs(c, w, states), -1, 1)[scored], inputs

    @property
    def _washout(self) -> int:
        """Leading steps of a segment that are not scored."""
        return min(self.free_run.washout, self.segments.steps - 1)

    @property
    def begins(self) -> list[list[int]]:
        """The first rows of the segments of every experiment."""
        steps, washout = self.segments.steps, self._washout
        return [begins_of(len(one), steps, washout) for one in self.record.experiments]

    def recording_of_points(self) -> Int[np.ndarray, "N"]:
        """Return the number of the recording of each point of `trajectory`."""
        scored = np.moveaxis(np.asarray(self.segments.scored), -1, 1)
        counts = scored.reshape(-1, self.segments.steps).sum(axis=1)
        segments = np.repeat(self.record.recordings, [len(begins) for begins in self.begins])
        return np.repeat(segments, counts[: len(segments)])

    def states_by_row(self, c: Vector, w: Any, states: np.ndarray) -> list[Matrix]:
        """Return the states (N, nx) of every experiment, joined from the segments' runs."""
        runs = np.moveaxis(self.runs(c, w, states), -1, 1)
        rows, place, found = runs.reshape(-1, *runs.shape[2:]), 0, []
        for experiment, begins in zip(self.record.experiments, self.begins, strict=True):
            own = np.zeros((len(experiment), self.dynamics.states))
            for begin in begins:
                first = begin + (self._washout if begin else 0)
                last = min(begin + self.segments.steps, len(experiment))
                own[first:last] = rows[place][first - begin : last - begin]
                place += 1
            found.append(own)
        return found

    def with_starts(self, rows: list[Matrix]) -> SegmentedMotion:
        """Return the problem with segments that start at given states (N, nx) of all rows."""
        flat = np.concatenate([own[b] for own, b in zip(rows, self.begins, strict=True)])
        k, n0, m = np.asarray(self.segments.start).shape
        padded = np.concatenate([flat, np.zeros((k * m - len(flat), n0))])
        padded = np.where(np.isfinite(padded), padded, 0.0)
        return self.from_states(np.moveaxis(padded.reshape(k, m, n0), 1, -1))


def sizes(problem: MotionProblem) -> Vector:
    """Return the size of each state (nx,), from its guesses; 1 where none is known."""
    size = np.abs(problem.guessed_points[0]).max(axis=1)
    return np.where(size > 0, size, 1.0)


@partial(quick_jit, static_argnames="form")
def _states(
    form: MotionDynamics, numbers: Numbers, segments: Segments, states: Float[Array, "k n0 m"]
) -> Array:
    """Return the states (k, T, n0, m) of every segment's run."""
    numbers = form.prepare(numbers)
    side_by_side = jax.vmap(lambda state, row: form.step(numbers, state, row)[0], -1, -1)

    def one_chunk(chunk: tuple[Array, Array]) -> Array:
        return jax.lax.scan(lambda state, row: (side_by_side(state, row), state), *chunk)[1]

    return jax.lax.map(one_chunk, (states, segments.inputs))
