"""Timing of a motion's inputs: physics fitted under each hold, and with inputs delayed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError, Warning
from orthaug._base.lines import plural
from orthaug.analysis.filtered_rows import filter_rows
from orthaug.analysis.memory import MemoryTerm
from orthaug.analysis.predictability import from_lags
from orthaug.data.record import Record
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.motion_task import MotionTask
from orthaug.fitting.segmented_motion import SegmentedMotion
from orthaug.fitting.segmented_problem import FreeRunFit
from orthaug.fitting.structures import Structure
from orthaug.fitting.whiteness import whitening_filter
from orthaug.models.learners import Learner, nothing_learned
from orthaug.physics.motion import HOLDS, Motion
from orthaug.physics.problem import MotionProblem

if TYPE_CHECKING:
    from orthaug.fitting.kinds import Solver


Measure = Callable[[SegmentedMotion, FreeRunFit | None], float]
"""Size of the errors of a fit; inf without one."""
ROWS = 4000  # at most
_STEPS, _FEWEST_ROWS = 40_000, 500  # substeps of integration at most, and rows all the same
_STEPPED = 0.5  # of the rows, over which a held input does not move
_CLEARLY = 0.02  # lower, of the residual: another hold
_LATE = 0.2  # lower: a delay; missing friction or a small lag gains less by one
_EXPLAINED = 0.7  # of the output's deviation: what is left above it is not explained by a delay
_ALIKE = 0.25  # of the better one's error: by less a lag and a delay are not distinguished
_ALIKE_AHEAD = 0.05  # of errors ahead, which are those of all rows alike
_FINER = 0.1  # lower than by a delay of whole samples: by a part of one more or less
_PART = 0.1  # of a sample, to which a delay is refined
_REFINED = 8  # fits for that, at most
_EARLIEST = 2  # samples by which rows may be logged late
_SEEN_EARLY = 4  # rows of such an input that may still predict what is left
_FOLLOWED = 0.02  # of what is left, that they predict: the input acts at once instead
_LONGEST = 20  # rows of the record to one of delay
_REFITTED = 30  # iterations from where the declared hold ended


@dataclass(frozen=True)
class HoldTrial:
    """The residual of physics alone under a hold, RMS in deviations of the outputs.

    None where it has no run.
    """

    hold: str
    residual: float | None
    declared: bool
    parameters: dict[str, float] | None = None
    """What physics alone is fitted with under it."""


@dataclass(frozen=True)
class Trial:
    """Physics on the first rows of the longest experiment: substeps, and every hold's residual."""

    rows: int
    substeps: int | None
    holds: tuple[HoldTrial, ...]
    task: MotionTask = field(repr=False, compare=False)
    """With physics alone trained."""

    @property
    def best(self) -> str | None:
        """The hold that explains the data clearly better than the declared one."""
        own = next((h.residual for h in self.holds if h.declared), None)
        known = [h for h in self.holds if h.residual is not None]
        if own is None or len(known) < 2:
            return None
        least = min(known, key=lambda h: h.residual or 0.0)
        return (
            least.hold
            if least.residual is not None and least.residual < (1 - _CLEARLY) * own
            else None
        )


def try_holds(
    problem: MotionProblem,
    criterion: Criterion,
    solver: Any,
    structure: Structure,
    learner: Learner | None = None,
) -> Trial:
    """Fit physics alone with the declared hold, and go on from there with every other.

    One hold alone is tried where the motion is discrete or has no inputs, or where an input is
    declared and recorded in steps: physics that lack something else may gain by another hold.

    Args:
        learner: what the trial's task has beside the physics; it is not trained.
    """
    task = on_longest(problem, criterion, solver, structure, learner)
    motion, free_fit = problem.motion, task.physics
    found = [_declared_trial(task.plan, free_fit, declared=True)]
    several = not motion.scheme.discrete and bool(motion.driving) and free_fit is not None
    if motion.hold == "zero-order" and is_stepped(task.problem.record):
        several = False
    for hold in HOLDS if several else ():
        if hold != motion.hold:
            found.append(_try_hold(hold, task, solver))
    substeps = None if free_fit is None else task.plan.dynamics.substeps
    return Trial(len(task.problem.record), substeps, tuple(found), task)


def is_stepped(record: Record) -> bool:
    """Return whether an input keeps its value from most rows to the next, as a held one does."""
    inputs = record.experiments[0].inputs
    return bool(
        len(inputs) > 1 and (np.mean(np.diff(inputs, axis=0) == 0, axis=0) > _STEPPED).any()
    )


def sort_holds(record: Record, holds: tuple[str, ...]) -> tuple[str, ...]:
    """Return the holds, first the one that best predicts each row of the inputs from those around.

    A step predicts it as the row before, straight lines as the mean of its neighbours, a spline as
    the cubic through the two nearest on each side: (4 (u₋₁ + u₁) - (u₋₂ + u₂))/6. Medians are
    compared, as steps and corners are few. The longest experiment decides; one of fewer than 8
    rows, or with a missing input, leaves the order.
    """
    inputs = max(record.experiments, key=len).inputs
    if len(inputs) < 8 or not np.isfinite(inputs).all():
        return holds
    spread = np.std(inputs, axis=0)
    before, near, here, after, far = (
        inputs[i : len(inputs) - 4 + i] / np.where(spread > 0, spread, 1.0) for i in range(5)
    )
    predicted = {
        "zero-order": near,
        "first-order": (near + after) / 2,
        "spline": (4 * (near + after) - (before + far)) / 6,
    }

    def error(hold: str) -> float:
        return round(float(np.sum(np.median(np.abs(predicted[hold] - here), axis=0))), 9)

    return tuple(sorted(holds, key=error))


def rows_of_trials(problem: MotionProblem) -> int:
    """Return how many rows are tried at most: fewer where each takes many substeps."""
    most = min(ROWS, max(_STEPS // max(problem.substeps, 1), _FEWEST_ROWS))
    return min(most, max(map(len, problem.record.experiments)))


def on_longest(
    problem: MotionProblem,
    criterion: Criterion,
    solver: Any,
    structure: Structure,
    learner: Learner | None = None,
    known: Vector | None = None,
) -> MotionTask:
    """Return the physics trained on the first rows of the longest experiment.

    Other arguments as in `try_holds`.

    Args:
        known: where physics alone ended on all rows; training begins there.
    """
    longest = max(problem.record.experiments, key=len)
    first = longest.rows(0, rows_of_trials(problem))
    record = replace(problem.record, experiments=(first,))
    criterion = criterion.on(record, most=problem.steps_to_leave())  # as training does
    task = MotionTask.of(problem.on(record), learner, criterion)
    return replace(task, known=known).prepare(solver, structure)


def _try_hold(hold: str, task: MotionTask, solver: Any) -> HoldTrial:
    assert task.physics is not None
    try:
        motion = replace(task.problem.motion, hold=hold)
        return _declared_trial(
            *refit_physics(task, task.physics, motion, task.problem.record, solver), declared=False
        )
    except InputError:
        return HoldTrial(hold, None, False)


def refit_physics(
    task: MotionTask,
    free_fit: FreeRunFit,
    motion: Motion,
    record: Record,
    solver: Any,
    start: Vector | None = None,
    iterations: int = _REFITTED,
) -> tuple[SegmentedMotion, FreeRunFit | None]:
    """Return the physics trained on from the end of a fit, with another motion or record.

    None without a usable end.

    Args:
        start: where it begins, beside the states of that end; None for there, too.

    Raises:
        InputError: the motion does not take the record.
    """
    plan = task.plan
    segmented = SegmentedMotion.of(
        replace(plan.problem, motion=motion, record=record), nothing_learned(), plan.criterion
    )
    segmented = segmented.physics_only.with_substeps(plan.dynamics.substeps).from_states(
        free_fit.end.point.states
    )
    p = free_fit.end.point.theta if start is None else start
    again = segmented.descend(segmented.objective(), p, solver.at_most(iterations))
    return segmented, again if again.ending.usable else None


def residual_of(segmented: SegmentedMotion, free_fit: FreeRunFit | None) -> float:
    """Return the RMS of a free run's error, in deviations of the outputs; inf without a run."""
    if free_fit is None:
        return float("inf")
    value = float(
        np.sqrt(
            np.sum((free_fit.end.point.errors / segmented.deviation[:, None]) ** 2)
            / segmented.residuals
        )
    )
    return value if np.isfinite(value) else float("inf")


def _declared_trial(
    segmented: SegmentedMotion, free_fit: FreeRunFit | None, *, declared: bool
) -> HoldTrial:
    motion, value = segmented.problem.motion, residual_of(segmented, free_fit)
    if free_fit is None or value == float("inf"):
        return HoldTrial(motion.hold, None, declared)
    p = motion.coordinates.physical(free_fit.end.point.theta)
    return HoldTrial(
        motion.hold, value, declared, dict(zip(motion.names, map(float, p), strict=True))
    )


@dataclass(frozen=True)
class LateInput:
    """An input that acts later than in the equations: by a delay, or through a first-order lag.

    The residuals of the physics with the best of each, and as declared, are in deviations of the
    outputs. A lag's time constant is in samples. A negative delay is an input that acts earlier
    than recorded; no lag is set beside it.
    """

    input: str
    sampling_time: float
    delay: float
    delayed: float
    lag: int
    lagged: float
    declared: float
    ahead: bool = False
    """True if the errors are those that the errors' own past does not predict."""

    @property
    def by_lag(self) -> bool:
        """True if a lag explains the data better than a delay."""
        return self.lagged < self.delayed

    @property
    def early(self) -> str:
        """By how much the input acts earlier than recorded, in words; empty if it does not."""
        if self.delay >= 0:
            return ""
        return f"{'a sample' if self.delay == -1 else plural(-self.delay, 'sample')} earlier"

    @property
    def gain(self) -> str:
        """Gain by the better one, beside the other, in words."""
        late = f"a delay of {plural(self.delay, 'sample')}"
        slow = f"a first-order lag of {self.time_constant:.3g} s"
        pairs = [(slow, self.lagged), (late, self.delayed)]
        (better, least), (other, more) = pairs if self.by_lag else pairs[::-1]
        error = "the error of physics alone"
        if self.ahead:
            error = "what the past does not predict of the error of physics alone"
        if self.early:
            return (
                f"with its values {self.early} {error} is {self.delayed:.3g} standard deviations "
                f"of the output instead of {self.declared:.3g}"
            )
        beside = f" ({more:.3g} with {other})" if self.lag else ""
        return (
            f"with {better} {error} is {least:.3g} standard deviations of the output instead of "
            f"{self.declared:.3g}{beside}"
        )

    @property
    def time_constant(self) -> float:
        """Time constant of the lag in s."""
        return self.lag * self.sampling_time

    @property
    def alike(self) -> bool:
        """True if the data hardly distinguish a lag from a delay."""
        if self.early:
            return False
        alike = _ALIKE_AHEAD if self.ahead else _ALIKE
        return abs(self.lagged - self.delayed) < alike * min(self.lagged, self.delayed)

    @property
    def manner(self) -> str:
        """Manner in which the input acts, in words."""
        if self.early:
            return f"{self.early} than recorded"
        by_lag = self.by_lag and not self.alike
        return "through a lag" if by_lag else "later than in the equations"

    @property
    def warning(self) -> Warning:
        """With what to write into the spec."""
        slow = (
            "give it a state of its own: its derivative is (what goes in − the state)/T, with T as "
            "a parameter."
        )
        late = (
            'delay the input by [[data.prepare]] with step = "shift", channel = '
            f'"{self.input}", samples = {self.delay}.'
        )
        found = f"{self.input} seems to act {self.manner}: {self.gain}, with other parameters."
        if self.early:
            remedy = (
                f"Its rows may be logged late: {late.replace('delay', 'advance', 1)} If it acts on "
                "an output at once, write that into the equation of the output instead."
            )
            return Warning("late_rows", f"{found} {remedy}")
        code = "slow_input" if self.by_lag else "dead_time"
        if self.alike:
            remedy = (
                "The data hardly distinguish a lag from a delay. If a drive, a filter or a "
                f"sensor is slow, {slow} If there is a dead time, {late}"
            )
        elif self.by_lag:
            remedy = f"A drive, a filter or a sensor may be slow: {slow}"
        else:
            remedy = (
                f"If there is a dead time, {late} If a drive or a sensor is slow, model it in the "
                "equations."
            )
        return Warning(code, f"{found} {remedy}")


def find_late_inputs(task: MotionTask, solver: Solver) -> tuple[LateInput, ...]:
    """Return the inputs that act clearly later than in the equations, or earlier, and by how much.

    Each input is delayed in turn, by 1, 2, 4, … samples while that explains the data better, then
    by what lies between, and by a part of a sample where that lowers the error further; where a
    delay helps, a lag's time constant is sought in the same way.
    Physics alone is refitted each time from where the nearest one ended. A lag of the input acts
    on linear physics as one of every sensor. Where no delay helps, the input is advanced by a
    sample or two: rows that a logger writes late act so. Where the whole error shows nothing, what
    its own past does not predict of it decides, among changes that do not raise the whole.

    Args:
        task: with physics alone trained; what it leaves is set against.
    """
    if task.physics is None:
        return ()
    names, sampling_time = task.problem.motion.external, task.problem.record.sampling_time
    most = len(task.problem.record) // _LONGEST
    declared = (task.plan, task.physics)
    found: dict[str, LateInput] = {}
    fits = {
        (number, change): _LateFits(task, solver, number, change, {0: declared})
        for number in range(len(names))
        for change in (_delay, _lag)
    }
    whole_error = residual_of(*declared)

    def unpredicted(segmented: SegmentedMotion, free_fit: FreeRunFit | None) -> float:
        # A run in the wrong phase errs by an oscillation, which its own past predicts
        if residual_of(segmented, free_fit) > whole_error:
            return float("inf")
        return _unpredicted(segmented, free_fit)

    for measure in (residual_of, unpredicted):
        for number, name in enumerate(names):
            if name in found:
                continue
            delayed, lagged = (
                partial(fits[number, change].leaves, measure) for change in (_delay, _lag)
            )
            whole, before = _lowest_argument(delayed, most), measure(*declared)
            best = _refine(fits[number, _delay], delayed, whole, before)
            if delayed(best) < min((1 - _LATE) * before, _EXPLAINED):
                slow = _lowest_argument(lagged, most)
                late = LateInput(
                    name, sampling_time, best, delayed(best), slow, lagged(slow), before
                )
                found[name] = replace(late, ahead=measure is not residual_of)
            elif measure is residual_of and not whole:
                early = _advance(fits[number, _delay])
                if early:
                    left = delayed(-early)
                    found[name] = LateInput(name, sampling_time, -early, left, 0, before, before)
    return tuple(found[name] for name in names if name in found)


def _refine(fits: _LateFits, leaves: Callable[[float], float], whole: int, before: float) -> float:
    """Return a delay in whole samples, or with a part of one where that surely leaves less.

    A part of a sample resembles missing physics, so that what it leaves must not follow the input,
    and, below one, another hold.
    """
    from scipy.optimize import minimize_scalar

    motion = fits.task.problem.motion
    if motion.scheme.discrete or (not whole and motion.hold != "zero-order"):
        return whole
    near = [whole + 0.5, *([whole - 0.5] if whole else [])]
    if min(map(leaves, [whole, *near])) >= min((1 - _LATE) * before, _EXPLAINED):
        return whole
    around = (max(whole - 1, 0), whole + 1)
    options = {"xatol": _PART / 2, "maxiter": _REFINED}
    found = minimize_scalar(leaves, bounds=around, method="bounded", options=options)
    best = round(round(float(found.x) / _PART) * _PART, 10)
    if leaves(best) >= (1 - _FINER) * leaves(whole):
        return whole
    return best if _followed(fits, best) < _FOLLOWED else whole


def _advance(fits: _LateFits) -> int:
    """Return the samples by which an input surely acts earlier than recorded; 0 of none.

    A plant on which the input acts at once resembles that, but then what an advance leaves still
    follows the input; and a discrete plant may well have no delay. So does an input that goes on
    between samples, on average half a sample early: then another hold explains as much.
    """
    if fits.task.problem.motion.scheme.discrete:
        return 0
    left, early = partial(fits.leaves, residual_of), 0
    while early < _EARLIEST and left(-early - 1) < left(-early):
        early += 1
    clearly = left(-early) < min((1 - _LATE) * left(0), _EXPLAINED)
    if not early or not clearly or _followed(fits, -early) >= _FOLLOWED:
        return 0
    return 0 if _moves_between(fits.task, fits.solver, left(-early)) else early


def _moves_between(task: MotionTask, solver: Any, left: float) -> bool:
    """Return whether under another hold than a step no more than so much is left."""
    motion, record = task.problem.motion, task.problem.record
    if motion.hold != "zero-order" or is_stepped(record):
        return False
    others = (_try_hold(hold, task, solver).residual for hold in HOLDS if hold != motion.hold)
    return any(other is not None and other <= left for other in others)


def _followed(fits: _LateFits, samples: float) -> float:
    """Return the share of an output's error that an input so changed still predicts."""
    segmented, free_fit = fits.tried[samples]
    if free_fit is None:
        return 1.0
    errors = _errors(segmented, free_fit)
    inputs = _by_segment(segmented, np.asarray(segmented.segments.inputs))
    one = [piece[:, fits.number] for piece in inputs]
    lags = range(_SEEN_EARLY)
    outputs = range(errors[0].shape[1])
    return max(from_lags([e[:, j] for e in errors], [one], lags).sure for j in outputs)


def _unpredicted(segmented: SegmentedMotion, free_fit: FreeRunFit | None) -> float:
    """Return the RMS of what errors' own past does not predict, in deviations of the outputs.

    Slow disturbances leave errors beside which an input's delay is small, but sudden. inf without
    a run, or where an output is missing on a row.
    """
    if free_fit is None or not segmented.record.complete:
        return float("inf")
    pieces = _errors(segmented, free_fit)
    outputs = range(pieces[0].shape[1])
    found = [whitening_filter([piece[:, o] for piece in pieces]) for o in outputs]
    colours = [np.ones(1) if colour is None else colour for colour in found]
    rows = [filter_rows(piece[..., None], colours) for piece in pieces]
    value = float(np.sqrt(np.mean(np.concatenate(rows) ** 2)))
    return value if np.isfinite(value) else float("inf")


def _errors(segmented: SegmentedMotion, free_fit: FreeRunFit) -> list[Matrix]:
    """Return a free run's errors (T, ny) in every segment, in deviations of the outputs."""
    errors = np.asarray(free_fit.end.point.errors) / segmented.deviation[:, None]
    return _by_segment(segmented, errors)


def _by_segment(segmented: SegmentedMotion, values: np.ndarray) -> list[Matrix]:
    """Return values (k, T, n, m) at the scored steps of every segment, each (T, n)."""
    scored = np.moveaxis(np.asarray(segmented.segments.scored), 1, -1).reshape(-1, values.shape[1])
    pieces = np.moveaxis(values, 3, 1).reshape(-1, *values.shape[1:3])
    return [piece[kept] for piece, kept in zip(pieces, scored, strict=True) if kept.any()]


@dataclass(frozen=True, eq=False)
class _LateFits:
    """Physics alone with one input changed, refitted from the nearest size that was tried."""

    task: MotionTask
    solver: Any
    number: int
    change: Callable[[Vector, float], Vector]
    """Of an input's values, by so many samples."""
    tried: dict[float, tuple[SegmentedMotion, FreeRunFit | None]]
    """Where each size ended; none is there from the start."""

    def leaves(self, measure: Measure, samples: float) -> float:
        """Return what the physics leaves with the input changed by so many samples."""
        if samples not in self.tried:
            ended = [known for known, (_, free_fit) in self.tried.items() if free_fit is not None]
            near = min(ended, key=lambda known: (abs(known - samples), measure(*self.tried[known])))
            problem, begin = self.task.problem, self.tried[near][1]
            assert begin is not None
            late = self._late(problem.record, samples)
            self.tried[samples] = refit_physics(self.task, begin, problem.motion, late, self.solver)
        return measure(*self.tried[samples])

    def _late(self, record: Record, samples: float) -> Record:
        """Return the record with the input changed in every experiment."""

        def late(inputs: np.ndarray) -> np.ndarray:
            column = self.change(inputs[:, self.number], samples)
            return np.where(np.arange(inputs.shape[1]) == self.number, column[:, None], inputs)

        return replace(
            record, experiments=tuple(replace(e, inputs=late(e.inputs)) for e in record.experiments)
        )


def _lowest_argument(leaves: Callable[[float], float], most: int) -> int:
    """Return the argument from 0 on at which a function that falls and then rises is least."""
    best, step = 0, 1
    while step <= most and leaves(step) < leaves(best):
        best, step = step, 2 * step
    step = best // 2
    while step:
        best = min((best - step, best, best + step), key=leaves)
        step //= 2
    return best


def _delay(values: Vector, samples: float) -> Vector:
    """Return an input later by so many samples; beyond the record it has the value at its end."""
    rows = np.arange(len(values))
    return np.interp(rows - samples, rows, values)


def _lag(values: Vector, samples: float) -> Vector:
    """Return an input behind a first-order lag whose time constant is so many samples."""
    return MemoryTerm("lag", "input", float(samples)).along(values, 1.0)
