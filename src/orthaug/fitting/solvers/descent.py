"""The Levenberg-Marquardt loop driven by the host, for any objective with a linearisation.

The step solves `(H + αE + μ D) d = g − αE p` with Nielsen's update of μ (Madsen, Nielsen and
Tingleff 2004, algorithm 3.16). The ridge α acts on the weights alone (E). One step ahead D is the
identity, which converges from Xavier starts on normalised data; on the free run D is diag H
(Marquardt's scaling). A trial costs one evaluation. Only an accepted trial is linearised. A trial
that is not finite is rejected like one that does not descend.

Where the rows of a one-step criterion are in memory, the loop is compiled whole instead
(`compiled`).
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import scipy.linalg
from jaxtyping import Bool

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import training_clock
from orthaug._base.progress import RunProgress, StopTraining, quiet
from orthaug.fitting.solvers.limit import Limit, Tail
from orthaug.fitting.status import Ending

_SETTLED = 0.1  # of the objective: a step that lowers it by less belongs to the end of a run
LEARNED = 0.9  # of the first loss: what is lower has learned something
_FIRST_STEPS = 5  # accepted ones, before evidence may find that the weights are too many
_SMALLEST_CURVATURE = 1e-14  # of the largest: it damps a direction that does nothing


class Damping(NamedTuple):
    """The first μ and the largest, in units of the largest curvature.

    With Marquardt's scaling in units of 1.
    """

    first: float
    largest: float
    diagonal: bool


# Docs/design.md has the comparison of first dampings
IDENTITY = Damping(1e-5, 1e12, diagonal=False)
MARQUARDT = Damping(1e-3, 1e16, diagonal=True)


@runtime_checkable
class Trial(Protocol):
    """A trial: an objective at p."""

    @property
    def p(self) -> Vector: ...

    @property
    def loss(self) -> float:
        """‖r‖²; not finite where there is none."""
        ...


@runtime_checkable
class LinearModel(Protocol):
    """An objective and its derivative about an accepted trial."""

    @property
    def hessian(self) -> Matrix:
        """JᵀJ."""
        ...

    @property
    def gradient(self) -> Vector:
        """Jᵀr, downhill."""
        ...

    @property
    def start(self) -> Any:
        """The start of the next trial beside p, in a form that only the objective reads."""
        ...


@runtime_checkable
class SquaredResiduals(Protocol):
    """The objective `‖r(p)‖²` of p = (θ, w), θ in front.

    Its functions are pure: a rejected trial leaves no trace.
    """

    @property
    def physics(self) -> int:
        """Number of leading entries of p that are θ: they have bounds and no ridge."""
        ...

    def evaluate(self, p: Vector, start: Any) -> Any:
        """Return a trial (`Trial`) at p, from the `start` that the last accepted one left."""
        ...

    def linearise(self, point: Any) -> Any:
        """Return the derivative (`LinearModel`) about a trial."""
        ...

    def samples(self, point: Any) -> tuple[float, float]:
        """Return the number of residuals of a trial, and the share that is independent."""
        ...


class Descent(NamedTuple):
    """The end of a run: the last accepted trial and its derivative.

    The derivative is None where the start has none.
    """

    point: Any
    linear: Any | None
    ridge: float
    effective: float
    iterations: int
    ending: Ending
    seconds: float
    path: tuple[Vector, ...] = ()
    """p of every accepted trial, the start first."""
    tail: Tail | None = None
    """The last steps; None where the start has no derivative."""


class Pause(NamedTuple):
    """A descent between two steps, in arrays, from which it resumes at the same bits."""

    point: Any
    """What the objective needs to make the last accepted trial again."""
    ridge: Any
    damping: Any
    growth: Any
    small: Any
    path: Any
    coloured: Any
    counts: Any
    ending: Any


class _Counts(NamedTuple):
    """Counts of tried and accepted steps, whether evidence has begun, and two losses.

    Accepted steps are counted before the last.

    These are the loss of the start, and where the last window of the limit began.
    """

    done: int
    taken: int
    begun: bool
    first_loss: float
    mark: float


class _Iterate(NamedTuple):
    """An accepted trial, and the state of the rest of the run."""

    point: Any
    linear: Any
    ridge: float
    damping: float
    growth: float = 2.0
    small: int = 0
    path: tuple[Vector, ...] = ()
    coloured: bool = False
    """Whether the colour of the errors counts. It does once they no longer fall fast; before,
    misfit colours them.
    """

    @property
    def settled(self) -> bool:
        """True once the objective falls slowly, after a few steps."""
        return self.coloured and len(self.path) > _FIRST_STEPS


def descend(
    objective: SquaredResiduals,
    p: Vector,
    start: Any,
    *,
    limit: Limit,
    tolerance: float,
    damping: Damping,
    ridge: float = 0.0,
    evidence: bool = False,
    evidence_settled: bool = False,
    ceiling: float = np.inf,
    bounds: tuple[Vector, Vector] | None = None,
    progress: RunProgress = quiet,
    kept: Any = None,
) -> Descent:
    """Minimise `‖r‖² + α‖w‖²` from p.

    Args:
        start: handed to the first trial.
        ridge: α; with `evidence` where it starts.
        evidence_settled: whether α waits until the weights have lowered the loss and the objective
            falls slowly, or no longer; otherwise until the first accepted step. From weights that
            do nothing yet, evidence would find that none are needed (w = 0 is its fixed point).
        ceiling: a trial with a larger `‖r‖²` is rejected.
        bounds: of θ, each (physics,); the start is moved inside.
        kept: where pauses are kept; a descent goes on from the last one.
    """
    began = training_clock()
    limits = tuple(np.full(len(p), side) for side in (-np.inf, np.inf))
    if bounds is not None:
        for whole, side in zip(limits, bounds, strict=True):
            whole[: objective.physics] = side
    paused = None if kept is None else kept.state(np.shape(p))
    if paused is not None:
        iterate, (done, taken, begun, first_loss, mark), ending = _resume(objective, paused)
    else:
        point = objective.evaluate(np.clip(p, *limits), start)
        linear = objective.linearise(point) if np.isfinite(point.loss) else None
        if linear is None or not np.isfinite(linear.hessian).all():
            return Descent(point, None, ridge, 0.0, 0, Ending.NON_FINITE, training_clock() - began)
        largest = 1.0 if damping.diagonal else float(np.diag(linear.hessian).max(initial=1e-300))
        iterate, first_loss = (
            _Iterate(point, linear, ridge, damping.first * largest, path=(point.p,)),
            point.loss,
        )
        ending, done, taken, begun, mark = Ending.RUNNING, 0, 1, not evidence_settled, first_loss
    while ending is Ending.RUNNING and not limit.is_past(done, mark, iterate.point.loss):
        iterate, ending = _trial(objective, iterate, limits, tolerance, damping, ceiling)
        if evidence and not begun:
            lower = iterate.point.loss < LEARNED * first_loss or iterate.small > 0
            begun = iterate.settled and lower or ending is Ending.CONVERGED
            if (
                begun and ending is Ending.CONVERGED
            ):  # under the first ridge; not yet under the one that follows
                iterate, ending, taken = iterate._replace(small=0), Ending.RUNNING, 0
        if evidence and begun and len(iterate.path) > taken:
            iterate = iterate._replace(ridge=_next_ridge(objective, iterate))
        taken = len(iterate.path)
        done += 1
        mark = iterate.point.loss if limit.begins_window(done) else mark
        try:
            progress(done, iterate.point.loss)
        except StopTraining:
            ending = Ending.STOPPED if ending is Ending.RUNNING else ending
            break
        if kept is not None:
            counts = _Counts(done, taken, begun, first_loss, mark)
            kept.keep(
                partial(_pause, objective, iterate, counts, ending),
                ended=ending is not Ending.RUNNING,
            )
    effective = effective_weights(iterate.linear.hessian, iterate.ridge, objective.physics)
    converged = ending not in (Ending.RUNNING, Ending.STOPPED)
    tail, seconds = (
        Tail.of(limit, done, mark, iterate.point.loss, converged=converged),
        training_clock() - began,
    )
    return Descent(
        iterate.point,
        iterate.linear,
        iterate.ridge,
        effective,
        done,
        ending,
        seconds,
        iterate.path,
        tail,
    )


def _pause(objective: Any, iterate: _Iterate, counts: _Counts, ending: Ending) -> Pause:
    own = (iterate.ridge, iterate.damping, iterate.growth, iterate.small)
    held = (objective.values_of(iterate.point), *own, np.stack(iterate.path), iterate.coloured)
    return Pause(*held, np.array(counts, dtype=float), int(ending))


def _resume(objective: Any, paused: Pause) -> tuple[_Iterate, _Counts, Ending]:
    point = objective.trial_of(paused.point)
    ridge, damping, growth = (float(paused[i]) for i in (1, 2, 3))
    path, done = tuple(paused.path), paused.counts.tolist()
    iterate = _Iterate(
        point, objective.linearise(point), ridge, damping, growth, int(paused.small), path
    )
    counts = _Counts(int(done[0]), int(done[1]), bool(done[2]), done[3], done[4])
    return iterate._replace(coloured=bool(paused.coloured)), counts, Ending(int(paused.ending))


def _trial(
    objective: SquaredResiduals,
    iterate: _Iterate,
    limits: Any,
    tolerance: float,
    damping: Damping,
    ceiling: float,
) -> tuple[_Iterate, Ending]:
    """Return one damped step: accept it, or damp more."""
    point, linear, ridge = iterate.point, iterate.linear, iterate.ridge
    p = point.p
    penalty = np.concatenate([np.zeros(objective.physics), np.ones(len(p) - objective.physics)])
    downhill = linear.gradient - ridge * penalty * p
    step, expected = _step(
        linear.hessian + ridge * np.diag(penalty), downhill, iterate.damping, p, limits, damping
    )
    moves = bool(np.isfinite(step).all() and step.any())
    tried = objective.evaluate(p + step, linear.start) if moves else None
    before = point.loss + ridge * float(penalty @ p**2)
    after = np.nan if tried is None else tried.loss + ridge * float(penalty @ (p + step) ** 2)
    lower = tried is not None and tried.loss <= ceiling and np.isfinite(after) and after < before
    followed = objective.linearise(tried) if lower else None
    if tried is not None and followed is not None and np.isfinite(followed.hessian).all():
        gain = (before - after) / expected if expected > 0 else 1.0
        iterate = _Iterate(
            point=tried,
            linear=followed,
            ridge=ridge,
            damping=iterate.damping * max(1 / 3, 1 - (2 * gain - 1) ** 3),
            small=iterate.small + 1 if before - after < tolerance * before else 0,
            path=(*iterate.path, tried.p),
            coloured=iterate.coloured or before - after < _SETTLED * before,
        )
        return iterate, Ending.CONVERGED if iterate.small >= 2 else Ending.RUNNING
    iterate = iterate._replace(damping=iterate.damping * iterate.growth, growth=2 * iterate.growth)
    largest = 1.0 if damping.diagonal else float(np.diag(linear.hessian).max(initial=1e-300))
    if iterate.damping > damping.largest * largest or not step.any():
        level = _level(linear.hessian, downhill, before, _bound_mask(p, downhill, *limits))
        return iterate, Ending.CONVERGED if len(iterate.path) > 1 or level else Ending.NO_DESCENT
    return iterate, Ending.RUNNING


def _next_ridge(objective: SquaredResiduals, iterate: _Iterate) -> float:
    effective = effective_weights(iterate.linear.hessian, iterate.ridge, objective.physics)
    return evidence_ridge(objective, iterate.point, effective, coloured=iterate.coloured)


def evidence_ridge(
    objective: SquaredResiduals, point: Any, effective: float, *, coloured: bool = True
) -> float:
    """Return MacKay's fixed point `α = γσ²/(κ‖w‖²)`.

    κ is the share of the residuals that is independent.

    Residuals of a free run are coloured: N of them say as much as κN independent ones. So the data
    weigh less against the prior.

    Args:
        objective: that the weights minimise.
        point: the trial at the weights.
        effective: number γ of effective weights there.
        coloured: whether the colour of the residuals counts.
    """
    count, share = objective.samples(point)
    share = share if coloured else 1.0
    variance = point.loss / max(count - effective / share, 1.0)
    size = float(np.sum(point.p[objective.physics :] ** 2))
    return float(np.clip(effective * variance / (share * max(size, 1e-300)), 1e-12, 1e12))


def _step(
    hessian: Matrix,
    downhill: Vector,
    damping: float,
    p: Vector,
    bounds: tuple[Vector, Vector],
    kind: Damping,
) -> tuple[Vector, float]:
    """Return the damped step inside the bounds, and its predicted decrease.

    The quadratic model predicts it.
    """
    free = np.flatnonzero(~_bound_mask(p, downhill, *bounds))
    curvature = np.diag(hessian)[free] if kind.diagonal else np.ones(len(free))
    scale = np.maximum(curvature, _SMALLEST_CURVATURE * curvature.max(initial=0.0))
    scale = np.where(scale > 0, scale, 1.0)
    # Solved with a unit diagonal: columns of very different size keep their digits
    unit = 1 / np.sqrt(scale)
    matrix = hessian[np.ix_(free, free)] * np.outer(unit, unit) + damping * np.eye(len(free))
    step = np.zeros(len(p))
    if not len(free):
        return step, 0.0
    try:
        factor = scipy.linalg.cho_factor(matrix, check_finite=False)
        step[free] = unit * scipy.linalg.cho_solve(
            factor, unit * downhill[free], check_finite=False
        )
    except np.linalg.LinAlgError:  # curvature lost to rounding: more damping mends it
        return np.full(len(p), np.nan), 0.0
    step = np.clip(p + step, *bounds) - p
    return step, float(2 * step @ downhill - step @ hessian @ step)


def _bound_mask(p: Vector, downhill: Vector, lower: Vector, upper: Vector) -> Bool[np.ndarray, "n"]:
    """Return a mask of the entries at a bound that the descent would leave."""
    return ((p <= lower) & (downhill < 0)) | ((p >= upper) & (downhill > 0))


def _level(
    hessian: Matrix, downhill: Vector, objective: float, held: Bool[np.ndarray, "n"]
) -> bool:
    """Return whether the start is a minimum.

    There, residual and Jacobian are orthogonal to rounding in every free entry.
    """
    flat = np.abs(downhill) <= 1e-7 * np.sqrt(np.maximum(np.diag(hessian), 0.0) * objective)
    return bool(np.all(flat | held))


def weights_hessian(hessian: Matrix, physics: int) -> Matrix:
    """Return the Hessian of the weights with θ eliminated, (nw, nw)."""
    h_tt, h_tw, h_ww = (
        hessian[:physics, :physics],
        hessian[:physics, physics:],
        hessian[physics:, physics:],
    )
    size = np.diag(h_tt)
    unit = np.sqrt(np.where(size > 1e-300 * size.max(initial=0.0), size, 1.0))
    inner = np.linalg.lstsq(h_tt / np.outer(unit, unit), h_tw / unit[:, None], rcond=1e-14)[0]
    eliminated = h_ww - (h_tw / unit[:, None]).T @ inner
    return (eliminated + eliminated.T) / 2


def effective_weights(hessian: Matrix, ridge: float, physics: int) -> float:
    """Return tr(H (H + αI)⁻¹) of the weights. Directions that are rounding count as absent."""
    if len(hessian) == physics:
        return 0.0
    values = np.linalg.eigvalsh(weights_hessian(hessian, physics))
    floor = len(hessian) * np.finfo(float).eps * np.max(np.diag(hessian)[physics:])
    seen = values[values > floor]
    return float(np.sum(seen / (seen + ridge)))
