"""Parameters of a motion that the outputs can distinguish, before training.

The record's inputs, or inputs that excite everything, distinguish them by the rank of the free
run's sensitivities to the parameters' coordinates, the starts of all segments eliminated, at
the initial parameters and some near them. A direction that only rounding or one particular value
hides has full rank there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug.data.record import Record
from orthaug.fitting.initial_states import Start
from orthaug.fitting.motion_task import MotionTask
from orthaug.fitting.segmented_motion import SegmentedMotion
from orthaug.models.learners import nothing_learned
from orthaug.physics import ill_conditioned
from orthaug.physics.excitation import Excitation, of_gram

_DRAWS = 3  # parameters near the initial ones
_NEAR = 0.1  # of a logarithm, or of the value
_SHORTER = (512, 128, 32, 8)  # steps of segments, where physics runs away over longer ones
_LOOSER = 1e3  # times as free as in training: a start that costs something separates parameters
_WIDTHS = (2.0, 1.0, 0.5)  # times the range of the data, until a run is finite
_LONGEST_LEVEL = 60  # steps for which a random input stays
_SEED = 20_250_117


@dataclass(frozen=True, eq=False)
class RankReport:
    """Parameters that the record's own inputs can distinguish, and those that rich inputs can.

    Points of a run at the initial parameters come with them.

    `by_any` is None where no run with rich inputs is finite. `states` (M, nx) and `inputs` (M, nu)
    are where physics alone goes on the record.
    """

    on_data: Excitation
    by_any: Excitation | None
    states: Matrix
    inputs: Matrix


def identify_ranks(segmented: SegmentedMotion) -> RankReport | None:
    """Return the ranks of the physics without a learner, over shorter segments where runs diverge.

    None where no run is finite.
    """
    segmented = segmented.physics_only
    steps = segmented.segments.steps
    for shorter_runs in (
        segmented,
        *(segmented.over(shorter) for shorter in _SHORTER if shorter < steps),
    ):
        on_data = _rank(shorter_runs)
        if on_data is not None:
            break
    else:
        return None
    tried = (_rank(_richly_excited(shorter_runs, wide)) for wide in _WIDTHS)
    by_any = next((found for found in tried if found is not None), None)
    if by_any is not None and by_any.rank < on_data.rank:
        by_any = on_data
    initial = segmented.problem.motion.coordinates.initial
    x, u = shorter_runs.trajectory(initial, (), np.asarray(shorter_runs.segments.start))
    finite = np.isfinite(x).all(axis=1)
    return RankReport(on_data, by_any, x[finite], u[finite])


def _rank(segmented: SegmentedMotion) -> Excitation | None:
    """Return the highest rank of some points near the initial parameters.

    None where no run is finite.

    Of several with that rank it is the one that ties most parameters: of `a*b` with a = 0 it looks
    as if b alone were idle.
    """
    best: Excitation | None = None
    for q in _nearby_values(segmented):
        gram = information(segmented, q)
        if gram is not None:
            found = of_gram(gram, segmented.problem.motion.names)
            best = found if best is None else max(best, found, key=_ranks)
        if best is not None and best.full_rank:
            break
    return best


def _ranks(found: Excitation) -> tuple[int, int]:
    return found.rank, sum(map(len, found.collinear))


def information(segmented: SegmentedMotion, q: Vector) -> Matrix | None:
    """Return the Gram matrix (np, np) of the outputs' sensitivities to the parameters' coordinates.

    None where a run diverges.
    """
    objective = segmented.objective()
    objective = replace(objective, loose=_LOOSER * objective.loose)
    with np.errstate(all="ignore"):
        point = objective.evaluate(q, Start(np.asarray(segmented.segments.start)))
        if not np.isfinite(point.loss):
            return None
        gram = objective.linearise(point).information
    return gram if np.isfinite(gram).all() else None


def ill_conditioned_alone(task: MotionTask) -> list[Warning]:
    """Return the warning `ill_conditioned` of physics alone as a task trained it.

    None where it has no run.
    """
    free_fit, segmented = task.physics, task.plan.physics_only
    if free_fit is None or not free_fit.ending.usable:
        return []
    q = free_fit.end.point.theta
    gram = information(segmented.from_states(free_fit.end.point.states), q)
    noise = segmented.noise(free_fit.objective, free_fit.end)
    if gram is None or noise is None:
        return []
    return ill_conditioned.of_motion(
        segmented.problem, segmented.rms**2 * gram, np.asarray(q), noise
    )


def _nearby_values(segmented: SegmentedMotion) -> Iterator[Vector]:
    coordinates, random = segmented.problem.motion.coordinates, np.random.default_rng(_SEED)
    low, high = coordinates.bounds
    first = coordinates.initial
    size = np.where(coordinates.positive, 1.0, np.where(first != 0, np.abs(first), 1.0))
    yield first
    for _ in range(_DRAWS):
        yield np.clip(first + _NEAR * size * random.normal(size=len(first)), low, high)


def _richly_excited(segmented: SegmentedMotion, wide: float) -> SegmentedMotion:
    """Return the same rows with random inputs, and starts a little off their guesses.

    Inputs have random levels, each for a random time.
    """
    record, random = segmented.record, np.random.default_rng(_SEED)
    every = np.concatenate([e.inputs for e in record.experiments])
    low, high = every.min(axis=0), every.max(axis=0)
    half = wide * np.where(high > low, (high - low) / 2, 1.0)
    experiments = []
    for experiment in record.experiments:
        inputs = np.empty_like(np.asarray(experiment.inputs, dtype=float))
        for column in inputs.T:
            column[:] = _levels(len(column), random)
        experiments.append(replace(experiment, inputs=(low + high) / 2 + half * inputs))
    excited = _with_record(segmented, replace(record, experiments=tuple(experiments)))
    start = np.asarray(excited.segments.start)
    size = np.abs(start).max(axis=(0, 2), keepdims=True)
    return excited.from_states(start + _NEAR * size * random.normal(size=start.shape))


def _with_record(segmented: SegmentedMotion, record: Record) -> SegmentedMotion:
    """Return the same segments on another record."""
    whole = SegmentedMotion.of(segmented.problem.on(record), nothing_learned(), segmented.criterion)
    return (
        whole
        if segmented.free_run == segmented.criterion.free_run
        else whole.over(segmented.free_run.steps)
    )


def _levels(count: int, random: np.random.Generator) -> Vector:
    """Return levels in [-1, 1] with durations from 1 to a few steps, log-uniform."""
    lengths = np.exp(random.uniform(0, np.log(_LONGEST_LEVEL), count)).astype(int)
    return np.repeat(random.uniform(-1, 1, count), lengths)[:count]
