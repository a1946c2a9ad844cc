"""The paper's solver: Adam, then L-BFGS, over θ and weights together, compiled whole.

θ starts at θ⁰ in units of its columns, the weights where the caller says. L-BFGS is optax's, in one
compiled loop. SciPy's L-BFGS-B, called back from Python, took 3 to 6 times longer on both of the
paper's examples.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, NamedTuple

from annotated_types import Ge, Gt
from jaxtyping import Float

from orthaug._base.jax import Array, jax, jnp, training_clock
from orthaug._base.progress import RunProgress, StopTraining, quiet
from orthaug._base.registry import check_fields
from orthaug.fitting.paper_criterion import PaperCriterion, Physics
from orthaug.fitting.solvers.minimize import burst_length
from orthaug.fitting.status import Ending
from orthaug.models.rows import Chunk

_MEMORY = 20  # pairs that L-BFGS keeps
_SMALL = 1e-14  # a relative decrease below this, five steps in a row, is rounding


class GradientRun(NamedTuple):
    """The end of one run: θ's unknowns and the weights."""

    v: Float[Array, "nt"]
    w: Float[Array, "nw"]
    iterations: int
    ending: Ending
    seconds: float


class _GradientState(NamedTuple):
    unknowns: tuple[Float[Array, "nt"], Float[Array, "nw"]]
    optimizer: Any
    loss: Float[Array, ""]
    iteration: Array
    small: Any


@dataclass(frozen=True)
class AdamLBFGS:
    """Declaration of the solver.

    Args:
        adam_iterations: steps of Adam with `learning_rate`.
        lbfgs_iterations: steps of L-BFGS (zoom line search) from where Adam ended, at most.
        learning_rate: of Adam, per step in normalised unknowns.
    """

    gauss_newton = False

    adam_iterations: Annotated[int, Ge(0)] = 500
    lbfgs_iterations: Annotated[int, Ge(0)] = 1000
    learning_rate: Annotated[float, Gt(0)] = 1e-3

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def iterations(self) -> int:
        """Steps at most."""
        return self.adam_iterations + self.lbfgs_iterations

    def at_most(self, iterations: int) -> AdamLBFGS:
        """Return itself: the pipeline is run whole."""
        return self

    def minimize(
        self,
        criterion: PaperCriterion,
        w: Float[Array, "nw"],
        chunks: Chunk,
        physics: Physics,
        *,
        progress: RunProgress = quiet,
    ) -> GradientRun:
        """Minimise the joint criterion from θ⁰ and `w`.

        The loss that `progress` receives is a mean square.
        """
        import optax

        began = training_clock()
        unknowns = (jnp.zeros_like(physics.start), w)
        loss = _value(criterion, unknowns, chunks, physics)
        enough = False
        done, state = 0, _GradientState(unknowns, None, loss, jnp.asarray(0), jnp.asarray(0))
        phases = (
            (self.adam_iterations, optax.adam(self.learning_rate)),
            (self.lbfgs_iterations, optax.lbfgs(memory_size=_MEMORY)),
        )
        for limit, optimizer in phases:
            begun = {"iteration": jnp.asarray(0), "small": jnp.asarray(0)}
            state = state._replace(optimizer=optimizer.init(state.unknowns), **begun)
            burst, second = 1, optimizer is phases[1][1]
            while int(state.iteration) < limit and bool(_goes_on(state)) and not enough:
                tick = training_clock()
                stop = jnp.asarray(min(int(state.iteration) + burst, limit))
                advance = _lbfgs if second else _adam
                state = jax.block_until_ready(
                    advance(criterion, state, chunks, physics, self.learning_rate, stop)
                )
                burst = burst_length(burst, training_clock() - tick)
                try:
                    progress(
                        done + int(state.iteration), float(state.loss) * float(physics.samples)
                    )
                except StopTraining:
                    enough = True
            done += int(state.iteration)
        finite = bool(jnp.isfinite(state.loss))
        still = Ending.STOPPED if enough else Ending.RUNNING
        ending = (
            Ending.NON_FINITE
            if not finite
            else Ending.CONVERGED
            if int(state.small) >= 5
            else still
        )
        v, w = state.unknowns
        return GradientRun(v, w, done, ending, training_clock() - began)


def _goes_on(state: _GradientState) -> Array:
    """Return whether another step makes sense: the loss is finite and still falls."""
    return jnp.isfinite(state.loss) & (state.small < 5)


@partial(jax.jit, static_argnames="criterion")
def _value(
    criterion: PaperCriterion, unknowns: tuple[Array, Array], chunks: Chunk, physics: Physics
) -> Array:
    return criterion(unknowns, chunks, physics)


@partial(jax.jit, static_argnames="criterion")
def _adam(
    criterion: PaperCriterion,
    state: _GradientState,
    chunks: Chunk,
    physics: Physics,
    rate: Array,
    stop: Array,
) -> _GradientState:
    import optax

    optimizer = optax.adam(rate)

    def step(s: _GradientState) -> _GradientState:
        loss, gradient = jax.value_and_grad(criterion)(s.unknowns, chunks, physics)
        update, inner = optimizer.update(gradient, s.optimizer)
        unknowns: Any = optax.apply_updates(s.unknowns, update)
        return _GradientState(unknowns, inner, loss, s.iteration + 1, s.small)

    return jax.lax.while_loop(lambda s: (s.iteration < stop) & _goes_on(s), step, state)


@partial(jax.jit, static_argnames="criterion")
def _lbfgs(
    criterion: PaperCriterion,
    state: _GradientState,
    chunks: Chunk,
    physics: Physics,
    rate: Array,
    stop: Array,
) -> _GradientState:
    import optax

    optimizer = optax.lbfgs(memory_size=_MEMORY)

    def value(unknowns: tuple[Array, Array]) -> Array:
        return criterion(unknowns, chunks, physics)

    value_and_grad = optax.value_and_grad_from_state(value)

    def step(s: _GradientState) -> _GradientState:
        loss, gradient = value_and_grad(s.unknowns, state=s.optimizer)
        update, inner = optimizer.update(
            gradient, s.optimizer, s.unknowns, value=loss, grad=gradient, value_fn=value
        )
        unknowns: Any = optax.apply_updates(s.unknowns, update)
        reached = optax.tree.get(inner, "value")
        small = jnp.where(loss - reached <= _SMALL * loss, s.small + 1, 0)
        return _GradientState(unknowns, inner, reached, s.iteration + 1, small)

    return jax.lax.while_loop(lambda s: (s.iteration < stop) & _goes_on(s), step, state)
