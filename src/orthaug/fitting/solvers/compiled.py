"""The Levenberg-Marquardt loop compiled whole, for a criterion with rows in memory.

The step solves `(H + (α + μ) I) d = g − α w`. Damping with the identity and Nielsen's update
(Madsen, Nielsen and Tingleff 2004, algorithm 3.16) converges from Xavier starts on normalised data.
A trial costs one pass over the rows, and this pass is also the linearisation for the next step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from orthaug._base.checks import Vector
from orthaug._base.jax import Array, jax, jnp, training_clock
from orthaug._base.progress import RunProgress, StopTraining, quiet
from orthaug.fitting.normal_equations import Normal, linearise, one_pass
from orthaug.fitting.solvers.descent import IDENTITY
from orthaug.fitting.solvers.limit import Limit, Tail
from orthaug.fitting.status import Ending
from orthaug.models.rows import Overlap

_NOTHING_LEFT = 1e-22  # of ‖J‖²: what rounding leaves of a Jacobian in the span of the physics
_UNUSED = 1e-12  # effective weights of a group at least, so that one that does nothing stays so
_SECONDS_PER_BURST = 0.5  # how often progress is reported and Ctrl-C noticed


class State(NamedTuple):
    """The iterate with its linearisation. These are plain arrays, so a run can pause and go on."""

    w: Float[Array, "nw"]
    normal: Normal
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    ridge: Float[Array, "*nw"]
    iteration: Int[Array, ""]
    accepted: Int[Array, ""]
    small: Int[Array, ""]
    code: Int[Array, ""]
    mark: Float[Array | np.ndarray, ""]
    """The loss where the last window of the limit began."""


@runtime_checkable
class CheckpointWriter(Protocol):
    """Storage of the states of a run."""

    def state(self, *shapes: tuple[int, ...]) -> State | None:
        """Return the last one whose first arrays have these shapes; None for none."""
        ...

    def keep(self, state: State, *, ended: bool = False) -> None:
        """Store a state, if it is due or if the run `ended`."""
        ...


class Options(NamedTuple):
    """Numbers of a run that the compiled program takes as arguments."""

    tolerance: Float[Array | np.ndarray, ""]
    evidence: Any
    samples: Float[Array | np.ndarray, ""]
    groups: Int[Array | np.ndarray, "nw"] | None = None
    """Which weights share a ridge; None where all share one number."""


class TrainingRun(NamedTuple):
    """The end of one run from one start."""

    w: Float[Array | np.ndarray, "nw"]
    normal: Normal
    ridge: float | Vector
    effective: float
    """Effective number of weights, `tr(H (H + αI)⁻¹)`."""
    iterations: int
    ending: Ending
    seconds: float
    coefficients: np.ndarray | None = None
    """θ (nθ,) where the solver iterated on it too; None where it is eliminated."""
    held: bool = False
    """Whether a penalty or a bound held the learner, so that `normal` has its rows too."""
    fixed: dict[int, float] | None = None
    """Entries of θ that stood at a bound, with its value."""
    tail: Tail | None = None
    """The last steps; None where nobody looked at them."""


@dataclass(frozen=True, eq=False)
class Settings:
    """The settings of a run.

    Args:
        limit: of the iterations.
        tolerance: as of `LevenbergMarquardt`.
        samples: residuals less the physics' own parameters, for the noise variance.
        ridge: α in normalised units; with `evidence` where it starts.
        evidence: choose α by MacKay's re-estimation after every accepted step.
        groups: which weights share an α, by number; None where all do.
        progress: called after the steps.
        kept: where states are kept; a run goes on from the last one.
    """

    limit: Limit
    tolerance: float
    samples: int
    ridge: float = 0.0
    evidence: bool = False
    groups: Int[np.ndarray, "nw"] | None = None
    progress: RunProgress = quiet
    kept: CheckpointWriter | None = None

    def prepare(self, w: Any) -> tuple[Options, Any, State | None]:
        """Return the numbers of the compiled program, the initial ridge, and the first state."""
        groups = self.groups
        if (
            groups is None and not self.evidence
        ):  # the program of groups serves a fixed ridge as well
            groups = np.zeros(len(w), dtype=int)
        numbers = (
            np.asarray(self.tolerance),
            np.asarray(self.evidence),
            np.asarray(float(self.samples)),
        )
        options = Options(numbers[0], numbers[1], numbers[2], groups)
        start = (
            np.float64(self.ridge) if groups is None else np.full(len(groups), float(self.ridge))
        )
        return options, start, self.kept.state(np.shape(w)) if self.kept else None

    def runs(self, state: State) -> bool:
        """Return whether there is a step to take."""
        if int(state.code) != Ending.RUNNING:
            return False
        return not self.limit.is_past(
            int(state.iteration), float(state.mark), float(state.normal.loss)
        )

    def mark(self, state: State) -> State:
        """Return the state, with its loss noted where a window of the limit begins."""
        begins = self.limit.begins_window(int(state.iteration))
        return state._replace(mark=np.asarray(state.normal.loss)) if begins else state

    def report(self, state: State) -> bool:
        """Report the state to a listener and to checkpoints; return whether to end the run."""
        try:
            self.progress(int(state.iteration), float(state.normal.loss))
        except StopTraining:
            return True
        if self.kept is not None:
            self.kept.keep(state, ended=int(state.code) != Ending.RUNNING)
        return False

    def end_run(self, state: State, seconds: float, *, enough: bool = False) -> TrainingRun:
        """Return the run from its last state; with `enough`, a listener ended it."""
        held: Any = (
            np.asarray(state.ridge)
            if self.groups is not None
            else np.float64(state.ridge if self.evidence else self.ridge)
        )
        ridge = held if self.groups is not None else float(held)
        effective = float(effective_weights(state.normal, held))
        ending, done = Ending(int(state.code)), int(state.iteration)
        ending = Ending.STOPPED if enough and ending is Ending.RUNNING else ending
        losses, converged = (
            (float(state.mark), float(state.normal.loss)),
            int(state.code) != Ending.RUNNING,
        )
        tail = Tail.of(self.limit, done, *losses, converged=converged)
        return TrainingRun(
            state.w, state.normal, ridge, effective, done, ending, seconds, tail=tail
        )


def minimise(
    criterion: Callable[..., Normal],
    w: Float[Array, "nw"],
    arguments: tuple[Any, ...],
    overlap: Overlap,
    settings: Settings,
) -> TrainingRun:
    """Minimise `‖r(w)‖² + α‖w‖²` from `w`.

    Args:
        criterion: hashable; `(w, *arguments, overlap) -> Normal`.
        overlap: a first guess of the learner's share in the physics; zeros do.
    """
    options, start, state = settings.prepare(w)
    state = (
        _first_state(w, linearise(criterion, w, arguments, overlap), start)
        if state is None
        else state
    )
    if settings.runs(state):  # a run beside this one may be compiling: no time of this one
        jax.block_until_ready(_advance(criterion, state, arguments, options, np.int64(0)))
    began = training_clock()
    burst, enough = 1, False
    while settings.runs(state) and not enough:
        tick = training_clock()
        stop = min(int(state.iteration) + burst, settings.limit.next_look(int(state.iteration)))
        state = jax.block_until_ready(
            _advance(criterion, state, arguments, options, np.int64(stop))
        )
        state = settings.mark(state)
        burst = burst_length(burst, training_clock() - tick)
        enough = settings.report(state)
    return settings.end_run(state, training_clock() - began, enough=enough)


def minimise_by_engine(
    normal_at: Callable[[Any, Overlap], Normal],
    w: Float[Array, "nw"],
    overlap: Overlap,
    settings: Settings,
) -> TrainingRun:
    """Minimise as `minimise` does, with every pass over the rows made by the caller's engine.

    The steps are the same wherever the sums are computed.

    Args:
        normal_at: the criterion at weights, with the overlap of the pass before.
    """
    options, start, state = settings.prepare(w)
    first = normal_at(w, overlap) if state is None else None  # compiles: no time of the run
    began = training_clock()
    if first is not None:
        # Less what rounding left of J in the physics
        state = _first_state(w, normal_at(w, first.overlap), start)
    assert state is not None
    enough = False
    while settings.runs(state) and not enough:
        step = _propose(state)
        state = _judge(state, step, normal_at(state.w + step, state.normal.overlap), options)
        state = settings.mark(state)
        enough = settings.report(state)
    return settings.end_run(state, training_clock() - began, enough=enough)


def burst_length(burst: int, spent: float) -> int:
    """Return the number of steps to take at a time, when `burst` of them took `spent` seconds."""
    return int(np.clip(burst * _SECONDS_PER_BURST / max(spent, 1e-6), 1, 4 * burst))


@jax.jit
def _first_state(w: Any, normal: Normal, ridge: Any) -> State:
    curvature = jnp.max(jnp.diag(normal.hessian), initial=0.0)
    finite = jnp.isfinite(normal.loss) & jnp.all(jnp.isfinite(normal.hessian))
    return State(
        w=w,
        normal=normal,
        damping=IDENTITY.first * jnp.maximum(curvature, 1e-300),
        growth=jnp.asarray(2.0),
        ridge=ridge,
        iteration=jnp.asarray(0),
        accepted=jnp.asarray(0),
        small=jnp.asarray(0),
        code=jnp.where(
            finite, jnp.where(is_spanned(normal), Ending.SPANNED, Ending.RUNNING), Ending.NON_FINITE
        ),
        mark=normal.loss,
    )


@partial(jax.jit, static_argnames="criterion")
def _advance(
    criterion: Any, state: State, arguments: tuple[Any, ...], options: Options, stop: Any
) -> State:
    return jax.lax.while_loop(
        lambda s: (s.code == Ending.RUNNING) & (s.iteration < stop),
        lambda s: _trial(criterion, s, arguments, options),
        state,
    )


def _trial(criterion: Any, state: State, arguments: tuple[Any, ...], options: Options) -> State:
    """Return one damped step: accept it, or damp more."""
    step = _propose(state)
    return _judge(
        state, step, one_pass(criterion, state.w + step, arguments, state.normal.overlap), options
    )


def _downhill(state: State) -> Any:
    return state.normal.gradient - state.ridge * state.w


@jax.jit
def _propose(state: State) -> Any:
    """Return the damped step."""
    shifted = state.normal.hessian + (state.ridge + state.damping) * jnp.eye(state.w.shape[0])
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(shifted), _downhill(state))


@jax.jit
def _judge(state: State, step: Any, trial: Normal, options: Options) -> State:
    """Return the state after a tried step: moved where the objective is lower, else damped more."""
    w, normal, alpha, downhill = state.w, state.normal, state.ridge, _downhill(state)
    before = normal.loss + _prior(alpha, w)
    after = trial.loss + _prior(alpha, w + step)
    gain = (before - after) / (step @ (state.damping * step + downhill))
    ok = jnp.isfinite(after) & (after < before) & jnp.all(jnp.isfinite(trial.hessian))

    small = jnp.where(
        ok, jnp.where(before - after < options.tolerance * before, state.small + 1, 0), state.small
    )
    accepted = state.accepted + ok
    damping = jnp.where(
        ok,
        state.damping * jnp.maximum(1 / 3, 1 - (2 * gain - 1) ** 3),
        state.damping * state.growth,
    )
    stuck = damping > IDENTITY.largest * jnp.max(jnp.diag(normal.hessian), initial=1e-300)
    code = jnp.where(small >= 2, Ending.CONVERGED, Ending.RUNNING)
    arrived = (accepted > 0) | _level(normal, downhill, before)
    code = jnp.where(stuck, jnp.where(arrived, Ending.CONVERGED, Ending.NO_DESCENT), code)
    moved = jax.tree.map(lambda new, old: jnp.where(ok, new, old), (w + step, trial), (w, normal))
    ridge = jax.lax.cond(
        ok & options.evidence, lambda: _evidence(moved[0], moved[1], alpha, options), lambda: alpha
    )
    return State(
        w=moved[0],
        normal=moved[1],
        damping=damping,
        growth=jnp.where(ok, 2.0, 2 * state.growth),
        ridge=ridge,
        iteration=state.iteration + 1,
        accepted=accepted,
        small=small,
        code=code,
        mark=state.mark,
    )


def _level(normal: Normal, downhill: Any, objective: Any) -> Any:
    """Return whether residual and Jacobian are orthogonal to rounding (MINPACK's gtol).

    No step can descend from such a minimum.
    """
    size = jnp.sqrt(jnp.maximum(jnp.diag(normal.hessian), 0.0) * objective)
    return jnp.all(jnp.abs(downhill) <= 1e-7 * size)


def _prior(alpha: Any, w: Any) -> Any:
    """Return `Σ α_i w_i²`."""
    return alpha * (w @ w) if alpha.ndim == 0 else w @ (alpha * w)


def _evidence(w: Any, normal: Normal, alpha: Any, options: Options) -> Any:
    """Return MacKay's fixed point of the ridge.

    `γ = tr(H(H + αI)⁻¹)`, `α = γ σ² / ‖w‖²` with `σ² = ‖r‖² / (N − γ)`.

    With groups γ and ‖w‖² are those of each group (automatic relevance determination).
    """
    if options.groups is None:
        effective = effective_weights(normal, alpha)
        variance = normal.loss / jnp.maximum(options.samples - effective, 1.0)
        return jnp.clip(effective * variance / jnp.maximum(w @ w, 1e-300), 1e-12, 1e12)
    each = _effective(normal, alpha)
    used, size = (
        jax.ops.segment_sum(x, options.groups, num_segments=len(w))[options.groups]
        for x in (each, w**2)
    )
    variance = normal.loss / jnp.maximum(options.samples - jnp.sum(each), 1.0)
    return jnp.clip(jnp.maximum(used, _UNUSED) * variance / jnp.maximum(size, 1e-300), 1e-12, 1e12)


def _effective(normal: Normal, alpha: Any) -> Any:
    """Return the diagonal of `H (H + A)⁻¹` for a ridge of each weight.

    From the eigenvalues of `A^-½ H A^-½`.
    """
    unit = 1 / jnp.sqrt(alpha)
    scaled = normal.hessian * unit[:, None] * unit
    values, vectors = jnp.linalg.eigh(jnp.where(jnp.isfinite(scaled), scaled, 0.0))
    values = jnp.maximum(values, 0.0)
    return vectors**2 @ (values / (1 + values))


@jax.jit
def effective_weights(normal: Normal, alpha: Any) -> Any:
    """Return tr(H (H + αI)⁻¹).

    Directions that are rounding beside the columns of J count as absent.
    """
    n = normal.hessian.shape[0]
    if n == 0:
        return jnp.asarray(0.0)
    if alpha.ndim:
        return jnp.sum(_effective(normal, alpha))
    values = jnp.linalg.eigvalsh(jnp.where(jnp.isfinite(normal.hessian), normal.hessian, 0.0))
    floor = n * jnp.finfo(float).eps * _largest_column(normal)
    return jnp.sum(jnp.where(values > floor, values / (values + alpha), 0.0))


def is_spanned(normal: Normal) -> Any:
    """Return whether P⊥J = 0: the learner lies in the span of the physics (Example 1)."""
    curvature = jnp.max(jnp.diag(normal.hessian), initial=0.0)
    return curvature <= _NOTHING_LEFT * _largest_column(normal)


def _largest_column(normal: Normal) -> Any:
    """Return the largest ‖J_i‖², before the projection."""
    return jnp.max(
        jnp.diag(normal.hessian) + jnp.sum(normal.overlap.jacobian**2, axis=0), initial=0.0
    )
