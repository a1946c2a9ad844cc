"""A model as a state and a step: `x_{k+1}, ŷ_k = step(numbers, x_k, u_k)`.

A free run, its training and its stability need no more. The lagged form (`models.lagged`) is the
case whose state is the past outputs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property, partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import AnyArray, Array, jax, jnp
from orthaug.data.expressions import Expression
from orthaug.data.record import Experiment, Record
from orthaug.models.learners import Bound, nothing_learned
from orthaug.physics.parameters import Coordinates

BATCH = 1024  # rows per compiled call: longer records share the program, of a free run too


class Numbers(NamedTuple):
    """The numbers of a model."""

    theta: Float[AnyArray, "nt"]
    theta_aux: Float[AnyArray, "nt"]
    weights: Any
    """One vector (nw,), or its leaves."""
    centre: Float[AnyArray, "nz"]
    halfwidth: Float[AnyArray, "nz"]
    gain: Float[AnyArray, "ny"]
    """Unit of the learner's output, in the outputs' units."""
    tilt: Any = None
    """(members, nθ) of an ensemble: the physics that each member adds. `weights` has a row for
    each; None otherwise.
    """
    scheme: Any = None
    """Results of `Dynamics.prepare` for all steps of a run."""
    limits: Any = None
    """(2, nz), the range of the features over the training rows; None for a learner that goes on as
    it is beyond it.
    """
    pull: Any = None
    """(n, nz), by which the regressor, or states and inputs, follow the features onto that range
    (`models.beyond`).
    """
    correction: Any = None
    """(nx, ny), the gain of a predictor (`models.predictor`); None for other dynamics."""

    @property
    def c(self) -> AnyArray:
        """θ − θ_aux (nt,): θ as it was fitted beside the learner, before the split."""
        return self.theta - self.theta_aux

    @property
    def unsplit(self) -> Numbers:
        """These numbers before any split: θ is the one fitted beside the learner."""
        c = np.asarray(self.c)
        return self._replace(theta=c, theta_aux=np.zeros_like(c))

    @property
    def free(self) -> Numbers:
        """These numbers without limits: the learner is not restricted beyond its training range."""
        return self if self.limits is None else self._replace(limits=None, pull=None)

    @property
    def physics_only(self) -> Numbers:
        """The numbers of the physics, in the shapes of a fit without a learner.

        Programs of such a fit can then be used again.
        """
        return Numbers(
            self.theta, np.zeros_like(self.theta), *[np.zeros(0)] * 3, gain=np.ones_like(self.gain)
        )


class Parts(NamedTuple):
    """The output of a step in parts, each (ny,).

    `baseline` = φθ + fixed terms, `learner` = f − φθ_aux, `raw` = f.
    """

    baseline: Any
    learner: Any
    raw: Any

    @property
    def total(self) -> Any:
        """ŷ (ny,)."""
        return self.baseline + self.learner


class Run(NamedTuple):
    """States before the rows of a free run (T, n0), and the outputs of its steps (T, ny)."""

    states: Any
    parts: Parts


@runtime_checkable
class Dynamics(Protocol):
    """A model without its numbers; hashable, so that compiled programs are reused.

    The state is one vector (n0,), the parameters are θ and the learner's weights, `unknowns`
    numbers together.
    """

    @property
    def outputs(self) -> tuple[str, ...]: ...

    @property
    def bound(self) -> Bound:
        """The learner with its sizes."""
        ...

    @property
    def entries(self) -> tuple[Expression, ...]:
        """Expressions that the learner sees."""
        ...

    @property
    def learns(self) -> bool:
        """False where the physics is alone."""
        ...

    @property
    def physics_only(self) -> Dynamics:
        """These dynamics without the learner."""
        ...

    @property
    def coordinates(self) -> Coordinates:
        """The parameters of the physics, and the map from θ to their values."""
        ...

    @property
    def steps_unevenly(self) -> bool:
        """True if a step may take another time than `sampling_time`, as between uneven instants."""
        ...

    @property
    def takes_gaps(self) -> bool:
        """True if the outputs of a record may be missing on some rows."""
        ...

    @property
    def separates(self) -> bool:
        """True if a step gives its output in the parts of physics and learner.

        Otherwise a run of the physics alone, from the same start, is the part of the physics.
        """
        ...

    @property
    def linear(self) -> bool:
        """True if the output is linear in θ for a given state and inputs.

        Training then eliminates θ (F1).
        """
        ...

    @property
    def differentiable(self) -> bool:
        """True if JAX can differentiate `step`; otherwise finite differences are used."""
        ...

    @property
    def calls_host(self) -> bool:
        """True if a step leaves the compiled program, so that each call counts."""
        ...

    @property
    def first_row(self) -> int:
        """The first row of an experiment that has an output."""
        ...

    @property
    def states(self) -> int:
        """n0, entries of the state; 0 without feedback: then no step depends on the one before."""
        ...

    @property
    def unknowns(self) -> int:
        """n = nθ + nw."""
        ...

    @property
    def memory(self) -> int:
        """Number of rows of measured outputs that `start` reads."""
        ...

    def start(self, outputs: Matrix, rows: Any) -> Float[np.ndarray, "r n0"]:
        """Return the states at some rows from the outputs (N, ny) measured before each of them."""
        ...

    def start_rows(self, weight: Matrix) -> Matrix:
        """Return L (n0, n0): a state x costs `‖L (x − start)‖²` about the measured one.

        `weight` (ny, ny) multiplies the errors of an output. Zero rows leave an entry free.
        """
        ...

    def inputs(self, experiment: Experiment, record: Record) -> Matrix:
        """Return the inputs of an experiment's steps, (T, nu), from its first row with an output.

        It is affine in the inputs.
        """
        ...

    def states_at(
        self, numbers: Numbers, outputs: Matrix, inputs: Matrix, rows: np.ndarray
    ) -> Float[np.ndarray, "r n0"]:
        """Return the states of a free run at some rows of an experiment.

        `outputs` (N, ny) are those of the run, before its first row the measured ones; `inputs` (T,
        nu) as its steps read them, up to the last of the rows at least.
        """
        ...

    def at_samples(self, numbers: Numbers, states: Matrix, inputs: Matrix) -> Matrix:
        """Return what the learner's features read beside the states, from the inputs of steps.

        Of a motion these are its inputs at the samples, with those that a controller sets.
        """
        ...

    def features_at(self, states: Matrix, inputs: Matrix) -> Matrix:
        """Return the learner's features (T, nz) at states (T, n0) and inputs of `at_samples`."""
        ...

    @property
    def state_names(self) -> tuple[str, ...]:
        """The entries of the state as expressions write them."""
        ...

    def learned_along(
        self, numbers: Numbers, run: Run, inputs: Matrix
    ) -> Iterator[tuple[str, Vector, Vector]]:
        """Yield name, physics and learner (T,) of each learned equation or output along a run."""
        ...

    @property
    def has_range(self) -> bool:
        """True if the range of the learner's features in training is known."""
        ...

    def run(self, numbers: Numbers, start: Vector, inputs: Matrix) -> Run:
        """Return the free run from a state along rows of inputs (T, nu)."""
        ...

    def describe(self, state: Vector, inputs: Vector) -> dict[str, float]:
        """Return a state and the inputs of a step by the names that a user knows."""
        ...

    def prepare(self, numbers: Numbers) -> Numbers:
        """Return the numbers with all that the steps of a run share, computed once."""
        ...

    def step(self, numbers: Numbers, state: Any, inputs: Any) -> tuple[Any, Parts]:
        """Return the next state (n0,) and the output from a state and one row of inputs (nu,)."""
        ...

    def first_slopes(self, width: int) -> Any:
        """Return ∂state/∂(state at the start, c, w) at the start of `width` runs.

        It is the identity and zeros, in any layout.
        """
        ...

    def tangents(
        self, numbers: Numbers, state: Any, slopes: Any, inputs: Any
    ) -> tuple[Any, Any, Any, Any]:
        """Return a step of m runs with its derivatives: (state, slopes, ŷ, ∂ŷ/∂(start, c, w)).

        Shapes: `state` (n0, m), `inputs` (nu, m), ŷ (ny, m), ∂ŷ (ny, n0 + n, m); `slopes` as in
        `first_slopes`.
        """
        ...


class Local(NamedTuple):
    """Independent steps: next states and outputs (n0 + ny, r), and their derivatives.

    The derivatives are by the state and by the unknowns.
    """

    value: Any
    to_state: Any
    """(n0 + ny, n0, r)."""
    to_unknowns: Any
    """(n0 + ny, n, r)."""

    def along(self, slopes: Any, fused: bool = False) -> tuple[Array, Array, Array, Array]:
        """Return state, slopes, outputs and their slopes as `Dynamics.tangents`, for given slopes.

        `fused` sums instead of a matrix product are faster where the slopes are cheap to compute.
        """
        n0 = len(slopes)
        if fused:
            through = sum(self.to_state[:, i, None] * slopes[None, i] for i in range(n0))
        else:
            through = jnp.einsum("ijm,jnm->inm", self.to_state, slopes)
        slope = through + jnp.pad(self.to_unknowns, ((0, 0), (n0, 0), (0, 0)))
        return self.value[:n0], slope[:n0], self.value[n0:], slope[n0:]


class AutodiffDynamics:
    """Derivatives by automatic differentiation of `step`, for dynamics without a faster way.

    `first_slopes` and `tangents` by automatic differentiation, `states_at` by running it. Without
    a learner and without parameters, if nothing else is written.
    """

    coordinates: Any = Coordinates(())
    entries: tuple[Expression, ...] = ()
    separates = False
    steps_unevenly = False
    takes_gaps = False
    differentiable = True
    calls_host = False

    def prepare(self, numbers: Numbers) -> Numbers:
        return numbers

    has_range = True

    @cached_property  # a class of dynamics may have a field of this name instead
    def bound(self) -> Bound:
        return nothing_learned()

    @property
    def learns(self) -> bool:
        return self.bound.learns

    @property
    def physics_only(self) -> Any:
        return self

    @property
    def state_names(self: Any) -> tuple[str, ...]:
        return tuple(f"x{i + 1}" for i in range(self.states))

    def at_samples(self, numbers: Numbers, states: Matrix, inputs: Matrix) -> Matrix:
        return inputs

    def features_at(self, states: Matrix, inputs: Matrix) -> Matrix:
        return np.zeros((len(states), 0))

    def learned_along(
        self, numbers: Numbers, run: Run, inputs: Matrix
    ) -> Iterator[tuple[str, Vector, Vector]]:
        return iter(())

    def run(self: Any, numbers: Numbers, start: Vector, inputs: Matrix) -> Run:
        return free_run(self, numbers, start, inputs)

    def states_at(
        self: Dynamics,
        numbers: Numbers,
        outputs: Matrix,
        inputs: Matrix,
        rows: Int[np.ndarray, "r"],
    ) -> Float[np.ndarray, "r n0"]:
        start = self.start(outputs, [self.first_row])[0]
        return self.run(numbers, start, inputs).states[np.asarray(rows, dtype=int) - self.first_row]

    def first_slopes(self: Dynamics, width: int) -> Array:
        n0 = self.states
        return jnp.broadcast_to(
            jnp.eye(n0, n0 + self.unknowns)[..., None], (n0, n0 + self.unknowns, width)
        )

    def local(self: Dynamics, numbers: Numbers, states: AnyArray, inputs: AnyArray) -> Local:
        """Return steps from r states (n0, r) and inputs (nu, r), each by itself."""
        nt = len(numbers.theta)

        def value_twice(state: Array, unknowns: Array, inputs: Array) -> tuple[Array, Array]:
            own = numbers._replace(theta=unknowns[:nt], weights=unknowns[nt:])
            following, parts = self.step(own, state, inputs)
            value = jnp.concatenate([following, parts.total])
            # to differentiate, and as it is: the program contains the step once
            return value, value

        unknowns = jnp.concatenate([jnp.asarray(numbers.theta), jnp.asarray(numbers.weights)])
        differentiated = jax.jacrev(value_twice, (0, 1), has_aux=True)
        slopes, value = jax.vmap(differentiated, (-1, None, -1), -1)(states, unknowns, inputs)
        # a kink without a derivative, such as sqrt(max(y, 0)) at 0, counts as flat
        return Local(value, *(jnp.where(jnp.isfinite(d), d, 0.0) for d in slopes))

    def tangents(
        self: Any, numbers: Numbers, state: AnyArray, slopes: AnyArray, inputs: AnyArray
    ) -> tuple[Array, Array, Array, Array]:
        """Propagate `S⁺ = A S + [0 B]` with A = ∂x⁺/∂x and B = ∂x⁺/∂(c, w); the output alike."""
        return self.local(numbers, state, inputs).along(slopes)


def free_run(
    form: Dynamics, numbers: Numbers, start: Vector, inputs: Matrix, batch: int = BATCH
) -> Run:
    """Return the free run from a state along rows of inputs (T, nu), a batch of them at a time."""
    state, pieces = start, []
    for begin in range(0, len(inputs), batch):
        rows = inputs[begin : begin + batch]
        padded = np.pad(rows, ((0, batch - len(rows)), (0, 0)), mode="edge")
        state, run = _scan(form, numbers, state, padded)
        pieces.append([np.asarray(part)[: len(rows)] for part in (run.states, *run.parts)])
    states, *parts = (np.concatenate(piece) for piece in zip(*pieces, strict=True))
    return Run(states, Parts(*parts))


@partial(jax.jit, static_argnames="form")
def _scan(
    form: Dynamics, numbers: Numbers, state: Float[Array, "n0"], inputs: Float[Array, "T nu"]
) -> tuple[Float[Array, "n0"], Run]:
    """Return the state behind the rows, and the run along them."""
    numbers = form.prepare(numbers)

    def step(state: Array, row: Array) -> tuple[Any, Run]:
        following, parts = form.step(numbers, state, row)
        return following, Run(state, parts)

    return jax.lax.scan(step, state, inputs)


@partial(jax.jit, static_argnames="form")
def last_outputs(
    form: Dynamics,
    numbers: Numbers,
    states: Float[Array, "n0 m"],
    inputs: Float[Array, "T nu m"],
    steps: Array,
    added: Float[Array, "T ny m"] | None = None,
) -> Parts:
    """Return the last outputs (ny, m) of `steps` of runs side by side.

    What is `added` to an output is in the past of the steps after it, where states are past
    outputs.
    """
    numbers = form.prepare(numbers)
    side_by_side = jax.vmap(lambda state, row: form.step(numbers, state, row), -1, -1)

    def advance(i: Array, states: Array) -> Array:
        following = side_by_side(states, inputs[i])[0]
        return following if added is None else following.at[: len(form.outputs)].add(added[i])

    states = jax.lax.fori_loop(0, steps - 1, advance, states)
    return side_by_side(states, inputs[steps - 1])[1]


def in_batches(
    function: Callable[..., Parts], rows: tuple[np.ndarray, ...], largest: int = BATCH
) -> Parts:
    """Call `function` on batches of rows, padded to one shape, and concatenate its results."""
    count = len(rows[0])
    size, pieces = min(BATCH, largest), []
    for begin in range(0, count, size):
        batch = [array[begin : begin + size] for array in rows]
        padding = size - len(batch[0])
        padded = [
            np.concatenate([b, np.repeat(b[-1:], padding, axis=0)]) if padding else b for b in batch
        ]
        parts = function(*padded)
        pieces.append([np.asarray(part)[: size - padding] for part in parts])
    return Parts(*(np.concatenate(piece) for piece in zip(*pieces, strict=True)))
