"""Motions with process noise and sensor noise: training of their predictor, and its gain K.

The criterion is the squared innovations of the predictor (`physics/innovations.py`). All that a
free run is trained by serves: K is among the parameters, the states that segments start from are
eliminated. The search begins at the free run's parameters, with K = 0 or that of a Kalman filter
(`scipy.linalg.solve_discrete_are`) for the best of several sizes of process noise.

A predictor whose errors grow, and the one that is its mirror image about the unit circle, predict
alike but for the size of the innovations, which is smaller where errors grow: under starts that are
free, least squares would prefer it. The search goes on from the mirror image; where that ends at an
unstable predictor too, white noise on the outputs is taken.

K is a nuisance. With a = (c, w) and the information G of (c, K, w), `dK = −G_kk⁻¹ G_ka da` where K
follows a, so that E = d(c, K, w)/da gives the information `EᵀGE` of a alone, its middle `EᵀΩE`, and
its scores `Eᵀs`. What follows, the split above all, is as for a free run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.linalg
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError, Warning
from orthaug._base.jax import jnp
from orthaug._base.lines import plain_number
from orthaug._base.progress import LOG, RunProgress
from orthaug.data.record import Record
from orthaug.fitting.block_scores import FreeRunScores
from orthaug.fitting.conclusion import conclude_motion
from orthaug.fitting.learned import TrainedLearner
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.fitting.motion_task import (
    MotionTask,
    descend_from,
    restart_warnings,
    train_motion_physics,
)
from orthaug.fitting.segmented_motion import SegmentedMotion
from orthaug.fitting.segmented_problem import FreeRunFit
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Structure
from orthaug.models.dynamics import Local
from orthaug.models.predictor import predictor_of
from orthaug.models.rows import Engine, InMemory
from orthaug.models.settling import LOOSE
from orthaug.models.statistics import Statistics
from orthaug.physics.innovations import InnovationsForm, InnovationsModel, innovations_form
from orthaug.physics.problem import MotionProblem

_PROCESS = (1e-6, 1e-4, 1e-2, 1.0)  # variance of a state in a sample, of its own, to begin with
_POINTS = 64  # at which the motion is linearised
_LONG = 30  # time constants, from which on a record shows whether process noise is white
_INTEGRATES = 1 - 1e-6  # magnitude of a pole that has no time constant


def predicted_problem(problem: MotionProblem, engine: Engine, *, warm: bool) -> MotionProblem:
    """Return the problem of a motion's predictor.

    Raises:
        InputError: what innovations are not for.
    """
    if type(engine) is not InMemory:
        raise InputError(
            "noise of innovations needs the rows in the memory of this process; take the engine "
            "memory, or white noise."
        )
    problem.record.check_measured()
    if warm:
        raise InputError(
            "noise of innovations has no warm start; leave out `initial`, or take white noise."
        )
    if problem.motion.source is not None:
        raise InputError(
            "noise of innovations needs the motion's equations, and these come from a file; write "
            "them as [motion], or take white noise."
        )
    return replace(problem, motion=innovations_form(problem.motion))


@dataclass(frozen=True, eq=False)
class MarginalScores(FreeRunScores):
    """Scores of a predictor's run, with the gain K eliminated."""

    moved: Matrix = field(kw_only=True)
    """E, the derivative of (c, K, w) by (c, w)."""

    @property
    def followed(self) -> Float[np.ndarray, "k m n0 a"] | None:
        """Derivative of the best states by (c, w) under the gain of the fit, less its sign."""
        kept = np.flatnonzero((self.moved == 1.0).any(axis=1))
        return None if self.slope is None else self.slope[..., kept]

    def blocks(self, steps: int) -> Float[np.ndarray, "b n"]:
        return super().blocks(steps) @ self.moved

    def slopes(self) -> Float[np.ndarray, "N ny n"]:
        return super().slopes() @ self.moved


@dataclass(frozen=True, eq=False)
class InnovationsTask(MotionTask):
    """A motion in innovations form, in segments, and its predictor without a learner."""

    def on(self, record: Record) -> InnovationsTask:
        own = super().on(record)
        return replace(self, plan=own.plan, physics=None, known=own.known)

    def refined(
        self, run: FreeRunFit, solver: LevenbergMarquardt, structure: Structure
    ) -> tuple[MotionTask, FreeRunFit]:
        """Return the task and its run as they are: a predictor's errors are those of one step."""
        return self, run

    def train_physics_only(
        self, solver: LevenbergMarquardt, structure: Structure, progress: RunProgress
    ) -> tuple[SegmentedMotion, FreeRunFit | None]:
        problem, plan = self.problem, self.plan
        plant = replace(problem, motion=problem.motion.plant)
        count = len(plant.motion.coordinates.initial)  # the gains come after these
        free, begun = train_motion_physics(
            SegmentedMotion.of(plant, plan.bound, plan.criterion, like=plan),
            solver,
            known=None if self.known is None else self.known[:count],
        )
        plan = replace(plan.with_substeps(free.dynamics.substeps), loose=free.loose)
        own = plan.physics_only
        q = plant.motion.coordinates.initial if begun is None else begun.end.point.theta
        states = free.segments.start if begun is None else begun.end.point.states
        starts = [np.concatenate([q, gain.ravel()]) for gain in first_gains(free, q, states)]
        found = descend_from(own.from_states(np.asarray(states)), solver, starts, None, progress)
        if found is None:
            return plan, None
        mirrored = mirrored_gain(own, found)
        if mirrored is not None:
            again = np.concatenate([found.end.point.theta[: len(q)], mirrored.ravel()])
            stable = descend_from(
                own.from_states(np.asarray(found.end.point.states)), solver, [again], None, progress
            )
            found = found if stable is None else stable
        point = found.end.point
        states = np.asarray(point.states)
        x, _ = own.trajectory(point.theta, (), states)
        size = np.abs(x).max(axis=0, initial=0.0)
        plan = replace(plan.from_states(states), loose=LOOSE * np.where(size > 0, size, 1.0))
        if begun is not None:
            found = found._replace(
                iterations=begun.iterations + found.iterations,
                seconds=begun.seconds + found.seconds,
                restarted=begun.restarted,
            )
        return plan, found

    def conclude(
        self, structure: Structure, learned: TrainedLearner, *, briefly: bool = False
    ) -> MotionEstimate:
        """Return the estimate of the plant under its predictor, with K given."""
        alone = None if self.physics is None else np.asarray(self.physics.end.point.theta)
        plan, learned = self._with_gain(learned)
        own = None if alone is None else alone[: len(plan.problem.names)]
        fit = conclude_motion(plan, structure, learned, own, briefly=briefly)
        fit = replace(fit, warnings=(*fit.warnings, *restart_warnings(self.physics)))
        if briefly or not learned.ending.usable or learned.coefficients is None:
            return fit
        doubts = check_length(plan, learned.coefficients, learned.weights, fit.states)
        return replace(fit, warnings=(*fit.warnings, *doubts))

    def _with_gain(self, learned: TrainedLearner) -> tuple[SegmentedMotion, TrainedLearner]:
        """Return the segments of the plant under its predictor, and what it learned."""
        plan, problem = self.plan, self.problem
        form: InnovationsForm = problem.motion
        own, count = form.own, form.own + form.gains
        assert learned.coefficients is not None
        gain = learned.coefficients[own:].reshape(len(form.states), len(form.outputs))
        noise = InnovationsModel(gain)
        kept = {"coefficients": learned.coefficients[:own]}
        if learned.gram is not None:
            moved = follow_gain(learned.gram, own, count)
            noise = replace(noise, covariance=_of_gain(plan, learned, own, count))
            kept |= {
                "gram": moved.T @ learned.gram @ moved,
                "middle": _Reduced(learned.middle, moved),
                "scores": _marginal(learned.scores, moved),
            }
        plan = replace(
            plan,
            problem=replace(problem, motion=form.plant),
            dynamics=predictor_of(plan.dynamics),
            predictor=noise,
        )
        return plan, replace(learned, **kept)


def first_gains(free: SegmentedMotion, q: Vector, states: Any) -> list[Matrix]:
    """Return gains to begin with: 0, and those of Kalman filters at the parameters q."""
    own = free.physics_only
    nx, ny = own.dynamics.states, len(own.dynamics.outputs)
    found = [np.zeros((nx, ny))]
    local, size = linearise(own, q, (), states)
    if local is None:
        return found
    a, c = (np.mean(np.asarray(local.to_state), axis=-1)[rows] for rows in (np.s_[:nx], np.s_[nx:]))
    sensor = np.diag(free.deviation**2) * 1e-3
    for share in _PROCESS:
        try:
            p = scipy.linalg.solve_discrete_are(a.T, c.T, share * np.diag(size**2), sensor)
        except (np.linalg.LinAlgError, ValueError):  # a mode that no output shows
            continue
        found.append(a @ p @ c.T @ np.linalg.inv(c @ p @ c.T + sensor))
    return [gain for gain in found if np.isfinite(gain).all()]


def linearise(plan: SegmentedMotion, c: Vector, w: Any, states: Any) -> tuple[Local | None, Vector]:
    """Return the slopes of steps at some points of the fitted runs, and the sizes of the states.

    None where no point is finite.
    """
    x, rows = plan.steps(c, w, states)
    kept = np.isfinite(x).all(axis=1)
    x, rows = x[kept], rows[kept]
    if not len(x):
        return None, np.ones(plan.dynamics.states)
    some = np.linspace(0, len(x) - 1, _POINTS).astype(int)
    size = np.sqrt(np.mean(x**2, axis=0))
    form, numbers = plan.dynamics, plan.numbers(c, np.asarray(w))
    local = form.local(form.prepare(numbers), jnp.asarray(x[some].T), jnp.asarray(rows[some].T))
    return local, np.where(size > 0, size, 1.0)


def follow_gain(gram: Matrix, own: int, count: int) -> Float[np.ndarray, "n a"]:
    """Return E, the derivative of (c, K, w) by (c, w) where K is at its best.

    Args:
        gram: information of (c, K, w).
        own: number of c.
        count: number of c and K.
    """
    gains = np.arange(own, count)
    kept = np.setdiff1d(np.arange(len(gram)), gains)
    moved = np.zeros((len(gram), len(kept)))
    moved[kept, np.arange(len(kept))] = 1.0
    size = np.sqrt(np.maximum(np.diag(gram)[gains], 0.0))
    unit = 1 / np.where(size > 0, size, 1.0)
    inner = unit[:, None] * gram[np.ix_(gains, gains)] * unit
    across = unit[:, None] * gram[np.ix_(gains, kept)]
    moved[gains] = -unit[:, None] * np.linalg.lstsq(inner, across, rcond=1e-12)[0]
    return moved


@dataclass(frozen=True)
class _Reduced:
    """ΣψᵀΣ_eψ of (c, w), from that of (c, K, w)."""

    whole: Any
    moved: Matrix

    def __call__(self, noise: Matrix) -> Matrix:
        return self.moved.T @ self.whole(noise) @ self.moved


def _marginal(scores: FreeRunScores | None, moved: Matrix) -> MarginalScores | None:
    if scores is None:
        return None
    given = {name: getattr(scores, name) for name in FreeRunScores.__dataclass_fields__}
    return MarginalScores(**given, moved=moved)


def _of_gain(plan: SegmentedMotion, learned: TrainedLearner, own: int, count: int) -> Matrix | None:
    """Return Cov K, row by row."""
    errors = learned.errors
    if learned.gram is None or learned.middle is None or errors is None or errors.noise is None:
        return None
    middle = learned.middle(plan.problem.weight.whitened(errors.noise))
    joint = Statistics(learned.gram, middle, errors.noise, learned.ridge).joint(count)
    assert joint is not None
    return joint.of(np.eye(len(learned.gram))[own:count])


def choose_noise(white: MotionEstimate, coloured: MotionEstimate) -> MotionEstimate:
    """Return the fit of the lower BIC, of white noise on the outputs and of innovations.

    White noise is the case K = 0, which the result then says. It is taken, too, where the predictor
    is unstable.
    """
    gains = coloured.model.form.states * len(coloured.model.outputs)
    scores = [_bic(white, 0), _bic(coloured, gains)]
    seconds = white.status.seconds + coloured.status.seconds
    LOG.info("noise: BIC %.6g of white noise, %.6g of innovations", *scores)
    best = coloured
    if is_unstable(coloured) or not scores[1] < scores[0]:
        best = _without_gain(white, coloured)
    return replace(best, status=replace(best.status, seconds=seconds))


def _bic(fit: MotionEstimate, gains: int) -> float:
    """Return `N log det Σ + (entries of K and effective weights) log N`; infinite without Σ."""
    noise, rows = fit.model.statistics.noise, fit.segmented.segments.count
    if noise is None or not fit.status.ok:
        return np.inf
    return rows * np.linalg.slogdet(noise)[1] + (gains + fit.effective_weights) * np.log(rows)


def mirrored_gain(plan: SegmentedMotion, found: FreeRunFit) -> Matrix | None:
    """Return the gain of the stable predictor that explains the outputs as an unstable one does.

    With K and Σ of the unstable one, state and outputs are disturbed by Ke and e of covariance Σ;
    the stabilising solution of that Riccati equation gives the other K (Anderson and Moore 1979,
    ch. 9). None where the predictor is stable, or nothing follows.
    """
    point = found.end.point
    c, states = np.asarray(point.theta), np.asarray(point.states)
    slopes = _slopes(plan, c, (), states)
    if not _growth(slopes) >= 1:
        return None
    squares = found.objective.squares(point)
    if slopes is None or squares is None:
        return None
    nx, ny = plan.dynamics.states, len(plan.dynamics.outputs)
    error, out = (np.mean(slopes, axis=0)[rows] for rows in (np.s_[:nx], np.s_[nx:]))
    gain = c[-nx * ny :].reshape(nx, ny)
    noise = np.asarray(squares) / max(plan.segments.count, 1)
    try:
        own = error + gain @ out
        p = scipy.linalg.solve_discrete_are(
            own.T, out.T, gain @ noise @ gain.T, noise, s=gain @ noise
        )
        stable = (own @ p @ out.T + gain @ noise) @ np.linalg.inv(out @ p @ out.T + noise)
    except (np.linalg.LinAlgError, ValueError):
        return None
    return stable if np.isfinite(stable).all() else None


def _slopes(
    plan: SegmentedMotion, c: Vector, w: Any, states: Any
) -> Float[np.ndarray, "r n x"] | None:
    """Return the slopes of steps of the predictor by its states, at some points that are finite."""
    local, _ = linearise(plan, c, w, states)
    if local is None:
        return None
    slopes = np.moveaxis(np.asarray(local.to_state), -1, 0)
    slopes = slopes[np.isfinite(slopes).all(axis=(1, 2))]
    return slopes if len(slopes) else None


def _growth(slopes: Float[np.ndarray, "r n x"] | None) -> float:
    """Return the factor by which errors of the states grow in a sample; NaN of no slopes."""
    if slopes is None:
        return np.nan
    errors = slopes[:, : slopes.shape[2]]
    return float(np.median(np.abs(np.linalg.eigvals(errors)).max(axis=1)))


def is_unstable(fit: MotionEstimate) -> bool:
    """Return whether errors of the states of a fit's predictor grow from sample to sample."""
    numbers = fit.model.numbers
    return _growth(_slopes(fit.segmented, np.asarray(numbers.c), numbers.weights, fit.states)) >= 1


def stable_or_white(
    coloured: MotionEstimate, white: Callable[[], MotionEstimate]
) -> MotionEstimate:
    """Return a fit with innovations, or that of white noise where its predictor is unstable.

    White noise is then said to be K = 0, with a warning.
    """
    if not is_unstable(coloured):
        return coloured
    fit = _without_gain(white(), coloured)
    text = (
        "with `noise.model` = innovations no stable predictor was found: errors of its states "
        "would grow from sample to sample. This fit has white noise on the outputs instead, which "
        "is K = 0. If its errors are coloured, physics is missing, or the noise is of a kind that "
        "K does not describe."
    )
    return replace(fit, warnings=(*fit.warnings, Warning("white_noise_taken", text)))


def _without_gain(white: MotionEstimate, coloured: MotionEstimate) -> MotionEstimate:
    """Return a fit of white noise that says that K is 0."""
    gain = np.zeros((coloured.model.form.states, len(coloured.model.outputs)))
    return replace(white, model=replace(white.model, noise=InnovationsModel(gain)))


def check_length(plan: SegmentedMotion, c: Vector, w: Any, states: Any) -> list[Warning]:
    """Return a warning where the record is too short to show what kind the process noise is.

    K describes process noise that is independent from sample to sample. Of a disturbance that lasts
    (ambient temperature, a supply, wind) the innovations look as white in a short record, and θ is
    further off than its intervals say: in 14 records of 9 time constants by 1.9 standard errors,
    root mean square, in 10 of 30 time constants by 1.5 but for one.
    """
    noise, slopes = plan.predictor, _slopes(plan, c, w, states)
    if noise is None or noise.covariance is None or slopes is None:
        return []
    std = np.sqrt(np.maximum(np.diag(noise.covariance), 0.0))
    if not (np.abs(noise.gain.ravel()) > 2 * std).any():
        return []
    nx = plan.dynamics.states
    own = slopes[:, :nx] + noise.gain @ slopes[:, nx:]
    decay = np.abs(np.linalg.eigvals(own))
    slowest = float(np.median(np.where(decay < _INTEGRATES, decay, 0.0).max(axis=1)))
    samples = -1 / np.log(slowest) if slowest > 0 else 0.0
    rows = plan.segments.count
    if rows >= _LONG * samples:
        return []
    seconds = plain_number(samples * plan.problem.record.sampling_time)
    text = (
        f"the record is {plain_number(rows / samples)} time constants long (the slowest is "
        f"{seconds} s): too short to distinguish process noise from a disturbance that lasts. "
        "The 95 % intervals count process noise that is independent from sample to sample. Where a "
        "disturbance lasts (ambient temperature, a supply, wind), parameters may be off by "
        "several standard errors more. Measure it as an input, or fit a second record and compare."
    )
    return [Warning("short_for_noise", text)]
