"""The minimizer compiled whole, for a criterion with rows in memory.

Steps, settings and driver are those of `minimize`. A trial costs one pass over the rows, and this
pass is also the linearisation for the next step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from orthaug._base.checks import Vector
from orthaug._base.jax import Array, jax, jnp, training_clock
from orthaug.fitting.normal_equations import Normal, linearise, one_pass
from orthaug.fitting.solvers import damped_step, minimize
from orthaug.fitting.solvers.damped_step import Damping, StepControl
from orthaug.fitting.solvers.limit import Tail
from orthaug.fitting.status import Ending
from orthaug.models.rows import Overlap

_NOTHING_LEFT = 1e-22  # of ‖J‖²: what rounding leaves of a Jacobian in the span of the physics


class State(NamedTuple):
    """The iterate with its linearisation. These are plain arrays, so a run can pause and go on."""

    w: Float[Array, "nw"]
    normal: Normal
    control: StepControl
    ridge: Float[Array, "*nw"]
    iteration: Int[Array, ""]
    mark: Float[Array | np.ndarray, ""]
    """The loss where the last window of the limit began."""

    @property
    def loss(self) -> Float[Array, ""]:
        """‖r‖²."""
        return self.normal.loss


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
    """True if a penalty or a bound held the learner, so that `normal` has its rows too."""
    fixed: dict[int, float] | None = None
    """Entries of θ that stood at a bound, with its value."""
    tail: Tail | None = None
    """The last steps; None where nobody looked at them."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Settings(minimize.Settings):
    """The settings of a compiled run.

    Args:
        samples: residuals less the physics' own parameters, for the noise variance.
        groups: which weights share an α, by number; None where all do.
    """

    samples: int
    groups: Int[np.ndarray, "nw"] | None = None

    def prepare(self, w: Array) -> tuple[Options, Any, State | None]:
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

    def end_run(self, state: State, ending: Ending, seconds: float) -> TrainingRun:
        """Return the run from its last state."""
        held: Any = (
            np.asarray(state.ridge)
            if self.groups is not None
            else np.float64(state.ridge if self.evidence else self.ridge)
        )
        return TrainingRun(
            state.w,
            state.normal,
            held if self.groups is not None else float(held),
            float(effective_weights(state.normal, held)),
            int(state.iteration),
            ending,
            seconds,
            tail=self.tail(state),
        )


def minimize_compiled(
    criterion: Callable[..., Normal],
    w: Float[Array, "nw"],
    arguments: tuple[object, ...],
    overlap: Overlap,
    settings: Settings,
) -> TrainingRun:
    """Minimize `‖r(w)‖² + α‖w‖²` from `w`.

    Args:
        criterion: hashable; `(w, *arguments, overlap) -> Normal`.
        overlap: a first guess of the learner's share in the physics; zeros do.
    """
    options, ridge, state = settings.prepare(w)
    if state is None:
        normal = linearise(criterion, w, arguments, overlap)
        state = _first_state(w, normal, ridge, settings.damping)

    def advance(state: State, stop: int) -> State:
        return jax.block_until_ready(
            _advance(criterion, settings.damping, state, arguments, options, np.int64(stop))
        )

    if settings.runs(state):  # a run beside this one may be compiling: no time of this one
        advance(state, 0)
    began = training_clock()
    end, ending = settings.drive(state, advance)
    return settings.end_run(end, ending, training_clock() - began)


def minimize_by_engine(
    normal_at: Callable[[Any, Overlap], Normal],
    w: Float[Array, "nw"],
    overlap: Overlap,
    settings: Settings,
) -> TrainingRun:
    """Minimize as `minimize_compiled` does, each pass over the rows made by the caller's engine.

    The steps are the same wherever the sums are computed.

    Args:
        normal_at: the criterion at weights, with the overlap of the pass before.
    """
    options, ridge, state = settings.prepare(w)
    first = normal_at(w, overlap) if state is None else None  # compiles: no time of the run
    began = training_clock()
    if first is not None:
        # Less what rounding left of J in the physics
        state = _first_state(w, normal_at(w, first.overlap), ridge, settings.damping)
    assert state is not None

    def advance(state: State, stop: int) -> State:
        step = _propose(state, settings.damping)
        trial = normal_at(state.w + step, state.normal.overlap)
        return _judge(state, step, trial, options, settings.damping)

    end, ending = settings.drive(state, advance)
    return settings.end_run(end, ending, training_clock() - began)


@partial(jax.jit, static_argnames="damping")
def _first_state(w: Array, normal: Normal, ridge: Array, damping: Damping) -> State:
    finite = jnp.isfinite(normal.loss) & jnp.all(jnp.isfinite(normal.hessian))
    start = jnp.where(is_spanned(normal), int(Ending.SPANNED), int(Ending.RUNNING))
    code = jnp.where(finite, start, int(Ending.NON_FINITE))
    return State(
        w=w,
        normal=normal,
        control=StepControl.begin(damping, normal.hessian, code, jnp),
        ridge=ridge,
        iteration=jnp.asarray(0),
        mark=normal.loss,
    )


@partial(jax.jit, static_argnames=("criterion", "damping"))
def _advance(
    criterion: Any,
    damping: Damping,
    state: State,
    arguments: tuple[object, ...],
    options: Options,
    stop: Array,
) -> State:
    def try_step(state: State) -> State:
        step = _propose(state, damping)
        trial = one_pass(criterion, state.w + step, arguments, state.normal.overlap)
        return _judge(state, step, trial, options, damping)

    return jax.lax.while_loop(
        lambda s: (s.control.code == Ending.RUNNING) & (s.iteration < stop), try_step, state
    )


def _downhill(state: State) -> Array:
    return state.normal.gradient - state.ridge * state.w


@partial(jax.jit, static_argnames="damping")
def _propose(state: State, damping: Damping) -> Any:
    """Return the damped step."""
    hessian, mu = state.normal.hessian, state.control.damping
    return damped_step.propose(hessian, state.ridge, _downhill(state), mu, damping, jnp)


@partial(jax.jit, static_argnames="damping")
def _judge(state: State, step: Array, trial: Normal, options: Options, damping: Damping) -> State:
    """Return the state after a tried step: moved where the objective is lower, else damped more."""
    w, normal, alpha, downhill = state.w, state.normal, state.ridge, _downhill(state)
    if damping.diagonal:
        model = {"hessian": normal.hessian + alpha * jnp.eye(w.shape[0])}
    else:
        model = {"mu": state.control.damping}
    before = normal.loss + _prior(alpha, w)
    after = trial.loss + _prior(alpha, w + step)
    accepted = jnp.isfinite(after) & (after < before) & jnp.all(jnp.isfinite(trial.hessian))
    control = damped_step.judge(
        state.control,
        damping,
        decrease=before - after,
        predicted=damped_step.predicted_decrease(step, downhill, **model),
        before=before,
        accepted=accepted,
        stuck=~jnp.any(step != 0),
        level=jnp.all(damped_step.level_entries(normal.hessian, downhill, before, jnp)),
        unit=damping.unit(normal.hessian, jnp),
        tolerance=options.tolerance,
        xp=jnp,
    )
    moved, linear = jax.tree.map(
        lambda new, old: jnp.where(accepted, new, old), (w + step, trial), (w, normal)
    )
    ridge = jax.lax.cond(
        accepted & options.evidence, lambda: _evidence(moved, linear, alpha, options), lambda: alpha
    )
    return State(moved, linear, control, ridge, state.iteration + 1, state.mark)


def _prior(alpha: Array, w: Array) -> Array:
    """Return `Σ α_i w_i²`."""
    return alpha * (w @ w) if alpha.ndim == 0 else w @ (alpha * w)


def _evidence(w: Array, normal: Normal, alpha: Array, options: Options) -> Any:
    """Return the ridge of the evidence, or of each group's; see `damped_step.evidence_ridge`."""
    if options.groups is None:
        effective = effective_weights(normal, alpha)
        return damped_step.evidence_ridge(normal.loss, effective, w @ w, options.samples, jnp)
    each = damped_step.effective_of_each(normal.hessian, alpha, jnp)
    used, size = (
        jax.ops.segment_sum(x, options.groups, num_segments=len(w))[options.groups]
        for x in (each, w**2)
    )
    return damped_step.evidence_ridge(
        normal.loss, used, size, options.samples, jnp, total=jnp.sum(each)
    )


@jax.jit
def effective_weights(normal: Normal, alpha: Array) -> Any:
    """Return tr(H (H + αI)⁻¹).

    Directions that are rounding beside the columns of J count as absent.
    """
    n = normal.hessian.shape[0]
    if n == 0:
        return jnp.asarray(0.0)
    if alpha.ndim:
        return jnp.sum(damped_step.effective_of_each(normal.hessian, alpha, jnp))
    floor = n * jnp.finfo(float).eps * _largest_column(normal)
    return damped_step.effective_weights(normal.hessian, alpha, floor, jnp)


def is_spanned(normal: Normal) -> Array:
    """Return whether P⊥J = 0: the learner lies in the span of the physics (Example 1)."""
    curvature = jnp.max(jnp.diag(normal.hessian), initial=0.0)
    return curvature <= _NOTHING_LEFT * _largest_column(normal)


def _largest_column(normal: Normal) -> Array:
    """Return the largest ‖J_i‖², before the projection."""
    return jnp.max(
        jnp.diag(normal.hessian) + jnp.sum(normal.overlap.jacobian**2, axis=0), initial=0.0
    )
