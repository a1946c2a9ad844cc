"""The minimizer: damped Gauss-Newton on any objective with a linearisation, driven by the host.

The steps are those of `damped_step`. The ridge α acts on the weights alone, and bounds on the
leading entries. A trial costs one evaluation. Only an accepted trial is linearised. A trial that is
not finite is rejected like one that does not descend.

Where the rows of a one-step criterion are in memory, the loop is compiled whole instead
(`compiled`), from the same steps, driver and settings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import training_clock
from orthaug._base.progress import RunProgress, StopTraining, Watch, quiet
from orthaug.fitting.solvers import damped_step
from orthaug.fitting.solvers.damped_step import MARQUARDT, Damping, StepControl
from orthaug.fitting.solvers.limit import Limit, Tail
from orthaug.fitting.status import Ending

if TYPE_CHECKING:
    from orthaug.fitting.initial_states import Start


_SETTLED = 0.1  # of the objective: a step that lowers it by less belongs to the end of a run
LEARNED = 0.9  # of the first loss: what is lower has learned something
_FIRST_STEPS = 5  # accepted ones, before evidence may find that the weights are too many
_SECONDS_PER_BURST = 0.5  # how often progress is reported and Ctrl-C noticed


@runtime_checkable
class CheckpointWriter(Protocol):
    """Storage of the states of a run."""

    def state(self, *shapes: tuple[int, ...]) -> Any:
        """Return the last one whose first arrays have these shapes; None for none."""
        ...

    def keep(self, state: Any, *, ended: bool = False) -> None:
        """Store a state, or what a call makes, if it is due or if the run `ended`."""
        ...


@runtime_checkable
class RunState(Protocol):
    """Fields of a run's state that the driver reads."""

    @property
    def control(self) -> StepControl: ...

    @property
    def iteration(self) -> Any: ...

    @property
    def loss(self) -> Any: ...

    @property
    def mark(self) -> Any:
        """The loss where the last window of the limit began."""
        ...


_State = TypeVar("_State", bound=RunState)


@dataclass(frozen=True, eq=False, kw_only=True)
class Settings:
    """The settings of a run.

    Args:
        limit: of the iterations.
        tolerance: as of `LevenbergMarquardt`.
        damping: which scaling, the first μ and the largest.
        ridge: α in normalised units; with `evidence` where it starts.
        evidence: choose α by MacKay's re-estimation after accepted steps.
        progress: called after the steps.
        kept: where states are kept; a run goes on from the last one.
        watched: called after the steps with the state.
    """

    limit: Limit
    tolerance: float
    damping: Damping
    ridge: float = 0.0
    evidence: bool = False
    progress: RunProgress = quiet
    kept: CheckpointWriter | None = None
    watched: Callable[[Any], None] | None = None

    def runs(self, state: RunState) -> bool:
        """Return whether there is a step to take."""
        if int(state.control.code) != Ending.RUNNING:
            return False
        return not self.limit.is_past(int(state.iteration), float(state.mark), float(state.loss))

    def report(self, state: RunState, packed: object) -> bool:
        """Report the state to a listener and to checkpoints; return whether to end the run."""
        try:
            self.progress(int(state.iteration), float(state.loss))
        except StopTraining:
            return True
        if self.kept is not None:
            self.kept.keep(packed, ended=int(state.control.code) != Ending.RUNNING)
        if self.watched is not None:
            self.watched(state)
        return False

    def drive(
        self,
        state: _State,
        advance: Callable[[_State, int], _State],
        pack: Callable[[_State], object] | None = None,
    ) -> tuple[_State, Ending]:
        """Take steps to the end of the run: the loop around every step.

        Args:
            advance: (state, stop) to a later state, at most that of iteration `stop`.
            pack: makes of a state what is kept; None for the state itself.
        """
        burst, enough = 1, False
        while self.runs(state) and not enough:
            tick, done = training_clock(), int(state.iteration)
            state = advance(state, min(done + burst, self.limit.next_look(done)))
            if self.limit.begins_window(int(state.iteration)):
                state = state._replace(mark=np.asarray(state.loss))  # pyright: ignore[reportAttributeAccessIssue]
            burst = burst_length(int(state.iteration) - done, training_clock() - tick)
            enough = self.report(state, state if pack is None else partial(pack, state))
        ending = Ending(int(state.control.code))
        return state, Ending.STOPPED if enough and ending is Ending.RUNNING else ending

    def tail(self, state: RunState) -> Tail:
        """Return the last steps of a run."""
        converged = int(state.control.code) != Ending.RUNNING
        losses = float(state.mark), float(state.loss)
        return Tail.of(self.limit, int(state.iteration), *losses, converged=converged)


def burst_length(burst: int, spent: float) -> int:
    """Return the number of steps to take at a time, when `burst` of them took `spent` seconds."""
    return int(np.clip(burst * _SECONDS_PER_BURST / max(spent, 1e-6), 1, 4 * burst))


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

    def evaluate(self, p: Vector, start: Any) -> Trial:
        """Return a trial at p, from the `start` that the last accepted one left."""
        ...

    def linearise(self, point: Any) -> LinearModel:
        """Return the derivative about a trial."""
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
    """A run between two steps, in arrays, from which it resumes at the same bits."""

    point: Any
    """What the objective needs to make the last accepted trial again."""
    ridge: Any
    control: Any
    path: Any
    coloured: Any
    counts: Any
    """Steps tried, whether evidence has begun, and the losses of start and mark."""


class _Iterate(NamedTuple):
    """An accepted trial, and the state of the rest of the run."""

    point: Trial
    linear: LinearModel
    ridge: float
    control: StepControl
    iteration: int
    mark: Any
    path: tuple[Vector, ...]
    first_loss: float
    begun: bool
    """True if evidence chooses the ridge by now."""
    coloured: bool = False
    """True if the colour of the errors counts. It does once they no longer fall fast; before,
    misfit colours them.
    """

    @property
    def loss(self) -> float:
        return self.point.loss

    @property
    def settled(self) -> bool:
        """True once the objective falls slowly, after a few steps."""
        return self.coloured and len(self.path) > _FIRST_STEPS


@dataclass(frozen=True, eq=False)
class _Rules:
    """The rules of a run beside its settings; see `minimize`."""

    objective: SquaredResiduals
    settings: Settings
    lower: Vector
    upper: Vector
    ceiling: float

    def begin(self, p: Vector, start: Start, *, evidence_begun: bool) -> _Iterate | Trial:
        """Return the first iterate, or the trial at the start where that is not finite."""
        point = self.objective.evaluate(np.clip(p, self.lower, self.upper), start)
        linear = self.objective.linearise(point) if np.isfinite(point.loss) else None
        if linear is None or not np.isfinite(linear.hessian).all():
            return point
        running = np.asarray(int(Ending.RUNNING))
        control = StepControl.begin(self.settings.damping, linear.hessian, running, np)
        return _Iterate(
            point,
            linear,
            self.settings.ridge,
            control,
            iteration=0,
            mark=point.loss,
            path=(point.p,),
            first_loss=point.loss,
            begun=evidence_begun,
        )

    def advance(self, iterate: _Iterate, stop: int) -> _Iterate:
        """Return the iterate after one tried step, and the ridge that evidence then chooses."""
        tried = self._try_step(iterate)
        moved = len(tried.path) > len(iterate.path)
        if not self.settings.evidence:
            return tried
        if not tried.begun:
            control, ended = tried.control, int(tried.control.code) == Ending.CONVERGED
            lower = tried.loss < LEARNED * tried.first_loss or control.small > 0
            begun = bool(tried.settled and lower or ended)
            if ended:  # under the first ridge; not yet under the one that follows
                control = control._replace(small=0, code=np.asarray(int(Ending.RUNNING)))
                moved = True
            tried = tried._replace(begun=begun, control=control)
        if not tried.begun or not moved:
            return tried
        objective = self.objective
        effective = effective_weights(tried.linear.hessian, tried.ridge, objective.physics)
        ridge = evidence_ridge(objective, tried.point, effective, coloured=tried.coloured)
        return tried._replace(ridge=ridge)

    def _try_step(self, iterate: _Iterate) -> _Iterate:
        """Return one damped step: accept it, or damp more."""
        objective, settings = self.objective, self.settings
        point, linear, ridge = iterate.point, iterate.linear, iterate.ridge
        p, weights = point.p, np.arange(len(point.p)) >= objective.physics
        downhill = linear.gradient - ridge * weights * p
        held = self._held(p, downhill)
        step = self._bounded_step(iterate, ridge * weights, downhill, ~held)
        moves = bool(np.isfinite(step).all() and step.any())
        tried = objective.evaluate(p + step, linear.start) if moves else None
        before = point.loss + ridge * float(weights @ p**2)
        after = np.nan if tried is None else tried.loss + ridge * float(weights @ (p + step) ** 2)
        lower = (
            tried is not None
            and tried.loss <= self.ceiling
            and np.isfinite(after)
            and after < before
        )
        followed = objective.linearise(tried) if lower else None
        accepted = followed is not None and bool(np.isfinite(followed.hessian).all())
        hessian = linear.hessian + ridge * np.diag(weights)
        with np.errstate(all="ignore"):
            level = damped_step.level_entries(linear.hessian, downhill, before, np)
            control = damped_step.judge(
                iterate.control,
                settings.damping,
                decrease=before - after,
                predicted=damped_step.predicted_decrease(step, downhill, hessian=hessian),
                before=before,
                accepted=np.asarray(accepted),
                stuck=not step.any(),
                level=bool(np.all(level | held)),
                unit=settings.damping.unit(linear.hessian, np),
                tolerance=settings.tolerance,
                xp=np,
            )
        iterate = iterate._replace(control=control, iteration=iterate.iteration + 1)
        if tried is None or not accepted:
            return iterate
        return iterate._replace(
            point=tried,
            linear=followed,
            path=(*iterate.path, tried.p),
            coloured=iterate.coloured or before - after < _SETTLED * before,
        )

    def _bounded_step(
        self, iterate: _Iterate, ridge: Vector, downhill: Vector, free: Bool[np.ndarray, "n"]
    ) -> Vector:
        """Return the damped step of the free entries, cut at the bounds."""
        p, rows = iterate.point.p, np.flatnonzero(free)
        step = np.zeros(len(p))
        if len(rows):
            inner = iterate.linear.hessian[np.ix_(rows, rows)]
            mu, damping = iterate.control.damping, self.settings.damping
            step[rows] = damped_step.propose(inner, ridge[rows], downhill[rows], mu, damping, np)
        return np.clip(p + step, self.lower, self.upper) - p

    def _held(self, p: Vector, downhill: Vector) -> Bool[np.ndarray, "n"]:
        """Return a mask of the entries at a bound that the descent would leave."""
        return ((p <= self.lower) & (downhill < 0)) | ((p >= self.upper) & (downhill > 0))


def minimize(
    objective: SquaredResiduals,
    p: Vector,
    start: Any,
    *,
    limit: Limit,
    tolerance: float,
    damping: Damping = MARQUARDT,
    ridge: float = 0.0,
    evidence: bool = False,
    evidence_settled: bool = False,
    ceiling: float = np.inf,
    bounds: tuple[Vector, Vector] | None = None,
    progress: RunProgress = quiet,
    kept: CheckpointWriter | None = None,
    watched: Watch | None = None,
) -> Descent:
    """Minimize `‖r‖² + α‖w‖²` from p.

    Args:
        start: handed to the first trial.
        ridge: α; with `evidence` where it starts.
        evidence_settled: whether α waits until the weights have lowered the loss and the objective
            falls slowly, or no longer; otherwise until the first accepted step. From weights that
            do nothing yet, evidence would find that none are needed (w = 0 is its fixed point).
        ceiling: a trial with a larger `‖r‖²` is rejected.
        bounds: of θ, each (physics,); the start is moved inside.
        kept: where pauses are kept; a run goes on from the last one.
        watched: follows the run, as a `Descent` that has not ended.

    The rest is that of `Settings`.
    """
    began = training_clock()

    def descent(iterate: _Iterate, ending: Ending) -> Descent:
        return Descent(
            iterate.point,
            iterate.linear,
            iterate.ridge,
            effective_weights(iterate.linear.hessian, iterate.ridge, objective.physics),
            iterate.iteration,
            ending,
            training_clock() - began,
            iterate.path,
            settings.tail(iterate),
        )

    settings = Settings(
        limit=limit,
        tolerance=tolerance,
        damping=damping,
        ridge=ridge,
        evidence=evidence,
        progress=progress,
        kept=kept,
        watched=watched and (lambda iterate: watched(partial(descent, iterate, Ending.RUNNING))),
    )
    lower, upper = (np.full(len(p), side) for side in (-np.inf, np.inf))
    if bounds is not None:
        lower[: objective.physics], upper[: objective.physics] = bounds
    rules = _Rules(objective, settings, lower, upper, ceiling)
    paused = None if kept is None else kept.state(np.shape(p))
    if paused is not None:
        first = _resume(objective, paused)
    else:
        first = rules.begin(p, start, evidence_begun=not evidence_settled)
    if not isinstance(first, _Iterate):
        return Descent(first, None, ridge, 0.0, 0, Ending.NON_FINITE, training_clock() - began)
    return descent(*settings.drive(first, rules.advance, partial(_pause, objective)))


def _pause(objective: Any, iterate: _Iterate) -> Pause:
    counts = (iterate.iteration, iterate.begun, iterate.first_loss, iterate.mark)
    return Pause(
        objective.values_of(iterate.point),
        iterate.ridge,
        iterate.control,
        np.stack(iterate.path),
        iterate.coloured,
        np.array(counts, dtype=float),
    )


def _resume(objective: Any, paused: Pause) -> _Iterate:
    point = objective.trial_of(paused.point)
    done, begun, first_loss, mark = paused.counts.tolist()
    return _Iterate(
        point,
        objective.linearise(point),
        float(paused.ridge),
        paused.control,
        int(done),
        mark,
        tuple(paused.path),
        first_loss,
        bool(begun),
        bool(paused.coloured),
    )


def evidence_ridge(
    objective: SquaredResiduals, point: Any, effective: float, *, coloured: bool = True
) -> float:
    """Return the ridge that the evidence of a trial asks for; see `damped_step.evidence_ridge`.

    Residuals of a free run are coloured: N of them say as much as κN independent ones. So the data
    weigh less against the prior.

    Args:
        objective: that the weights minimize.
        point: the trial at the weights.
        effective: number γ of effective weights there.
        coloured: whether the colour of the residuals counts.
    """
    count, share = objective.samples(point)
    size, share = float(np.sum(point.p[objective.physics :] ** 2)), share if coloured else 1.0
    return float(damped_step.evidence_ridge(point.loss, effective, size, count, np, share=share))


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
    """Return the effective number of weights. Directions that are rounding count as absent."""
    if len(hessian) == physics:
        return 0.0
    floor = len(hessian) * np.finfo(float).eps * np.max(np.diag(hessian)[physics:])
    return float(damped_step.effective_weights(weights_hessian(hessian, physics), ridge, floor, np))
