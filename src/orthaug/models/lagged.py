"""The lagged form: ŷ_k = φ(x_k)θ + f(x_k) − φ(x_k)θ_aux (eq:orth_param).

The regressor x holds past outputs and inputs.

As dynamics its state is the past outputs, newest first, and a step puts its own output in front of
them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import AnyArray, Array, ArrayModule, jax, jnp
from orthaug.data.expressions import Expression, Lag
from orthaug.data.record import Experiment, Record
from orthaug.data.regressors import Features, Layout, lag_matrix, largest_lag
from orthaug.models.beyond import beyond_of, clip_to_range, outside, remaining_factor
from orthaug.models.dynamics import Numbers, Parts, Run, free_run, in_batches
from orthaug.models.learners import Bound, nothing_learned
from orthaug.physics.baseline import Baseline
from orthaug.physics.parameters import Coordinates


@dataclass(frozen=True)
class LaggedDynamics:
    """Computations of a model of lagged signals, without its numbers: `Dynamics`."""

    baseline: Baseline
    features: Features
    layout: Layout
    outputs: tuple[str, ...]
    bound: Bound

    @property
    def physics_only(self) -> LaggedDynamics:
        """These dynamics without the learner."""
        return replace(self, features=Features(()), bound=nothing_learned(len(self.outputs)))

    @property
    def entries(self) -> tuple[Expression, ...]:
        """Expressions that the learner sees."""
        return self.features.entries

    @property
    def learns(self) -> bool:
        """False where the physics is alone."""
        return self.bound.learns

    @property
    def coordinates(self) -> Coordinates:
        """θ itself, as the criterion is linear in it."""
        return Coordinates(self.baseline.parameters, logarithms=False)

    separates = True
    steps_unevenly = False
    takes_gaps = False
    calls_host = False

    @property
    def linear(self) -> bool:
        return self.baseline.linear

    @property
    def beyond(self) -> str:
        """Behaviour of the learner's correction beyond its training range."""
        return beyond_of(self.bound.learner, "hold")

    @property
    def differentiable(self) -> bool:
        return self.bound.differentiable

    @property
    def first_row(self) -> int:
        return largest_lag(self.layout)

    @property
    def states(self) -> int:
        return self.memory * len(self.outputs)

    @property
    def unknowns(self) -> int:
        return len(self.baseline.names) + self.bound.size

    @property
    def fed_back(self) -> tuple[tuple[int, int], ...]:
        """(lag, number of the output) of every past output in the regressor, in its order."""
        return tuple(
            (lag.lag, self.outputs.index(lag.channel))
            for lag in self.layout
            if lag.channel in self.outputs
        )

    @property
    def memory(self) -> int:
        """na, how many past outputs the state holds of each output."""
        return max((lag for lag, _ in self.fed_back), default=0)

    @property
    def used(self) -> tuple[Lag, ...]:
        """The raw lags that the physics or the learner reads."""
        read = {*self.baseline.lags, *self.features.lags}
        return tuple(
            lag for lag in self.layout if lag in read or self.baseline.function is not None
        )

    @property
    def input_layout(self) -> Layout:
        """The lagged inputs of the regressor, in its order."""
        return tuple(lag for lag in self.layout if lag.channel not in self.outputs)

    def start(
        self, outputs: Matrix, rows: Sequence[int] | Int[np.ndarray, "r"]
    ) -> Float[np.ndarray, "r n0"]:
        before = np.asarray(rows)[:, None] - 1 - np.arange(self.memory)
        return outputs[before].reshape(len(before), self.states)

    def start_rows(self, weight: Matrix) -> Matrix:
        """Return weights under which a past output has the same errors as all others."""
        return np.kron(np.eye(self.memory), weight)

    def inputs(self, experiment: Experiment, record: Record) -> Matrix:
        return lag_matrix(experiment, self.input_layout, record, self.first_row)

    def states_at(
        self,
        numbers: Numbers,
        outputs: Matrix,
        inputs: Matrix,
        rows: Sequence[int] | Int[np.ndarray, "r"],
    ) -> Float[np.ndarray, "r n0"]:
        """Return the run's own past outputs, so that no step is computed again."""
        return self.start(outputs, rows)

    def at_samples(self, numbers: Numbers, states: Matrix, inputs: Matrix) -> Matrix:
        return inputs

    def features_at(self, states: Matrix, inputs: Matrix) -> Float[np.ndarray, "T nz"]:
        return self.features_of(self.regressor(states.T, inputs.T, np).T)

    def features_of(self, points: Matrix) -> Float[np.ndarray, "N nz"]:
        """Return the learner's features at regressors (N, nx)."""
        return np.asarray(self.features.evaluate(points, self.layout, np))

    @property
    def state_names(self) -> tuple[str, ...]:
        return tuple(
            str(Lag(name, lag)) for lag in range(1, self.memory + 1) for name in self.outputs
        )

    def learned_along(
        self, numbers: Numbers, run: Run, inputs: Matrix
    ) -> Iterator[tuple[str, Vector, Vector]]:
        yield from zip(self.outputs, run.parts.baseline.T, run.parts.learner.T, strict=True)

    @property
    def has_range(self) -> bool:
        """False for a function from another toolbox: its features are not scaled."""
        return self.differentiable

    def run(self, numbers: Numbers, start: Vector, inputs: Matrix) -> Run:
        """Return the free run; without feedback its rows are independent of each other."""
        if self.states:
            return free_run(self, numbers, start, inputs)
        return Run(np.zeros((len(inputs), 0)), self.parts_at(numbers, inputs))

    def describe(self, state: Vector, inputs: Vector) -> dict[str, float]:
        """Return the entries of the regressor."""
        x = self.regressor(state, inputs, np)
        return {str(lag): float(value) for lag, value in zip(self.layout, x, strict=True)}

    def regressors(self, experiment: Experiment, record: Record, row: int | None = None) -> Matrix:
        """Return measured regressors x (T, nx) of an experiment from a row on.

        By default it is the first row that has one.
        """
        return lag_matrix(experiment, self.layout, record, self.first_row if row is None else row)

    def regressor(self, state: Any, inputs: Any, xp: Any = jnp) -> Any:
        """Return x (nx, …) of a state (n0, …) and a row of lagged inputs (nu, …)."""
        past = state.reshape(self.memory, len(self.outputs), *state.shape[1:])
        lag, output = np.array(self.fed_back, dtype=int).reshape(-1, 2).T
        return xp.concatenate([past[lag - 1, output], inputs])

    def phi(self, x: AnyArray, xp: ArrayModule = jnp) -> AnyArray:
        """Return φ(x), (…, ny, nθ), of regressors (…, nx)."""
        return self.baseline.phi(x, self.layout, self.outputs, xp)

    def at(self, numbers: Numbers, x: Float[Array, "nx"]) -> Parts:
        """Return the prediction at one regressor x (nx,), in parts."""
        phi = self.phi(x)
        known = self.baseline.known(x, self.layout, self.outputs, jnp)
        physics = known + phi @ numbers.theta
        z = self.features.evaluate(x, self.layout, jnp)
        share: Any = 1.0
        if numbers.limits is not None:
            inside = clip_to_range(numbers.limits, z)
            phi = self.phi(x + numbers.pull @ (inside - z))
            share, z = remaining_factor(self.beyond, numbers.limits, z), inside
        raw = _learned_output(self.bound, numbers, (z - numbers.centre) / numbers.halfwidth, phi)
        return Parts(physics, share * (raw - phi @ numbers.theta_aux), raw)

    def parts_at(self, numbers: Numbers, x: Matrix) -> Parts:
        """Return the prediction at measured regressors (T, nx), in parts."""
        return in_batches(lambda rows: _predict_rows(self, numbers, rows), (x,))

    def learner_at(self, numbers: Numbers, x: Matrix) -> Matrix:
        """Return f (T, ny) at regressors (T, nx), in the outputs' units, whatever limits it has."""
        limits = numbers.limits
        if limits is not None and outside(limits, self.features_of(x)).any():
            numbers = numbers.free
        return self.parts_at(numbers, x).raw

    def prepare(self, numbers: Numbers) -> Numbers:
        """Return the numbers unchanged: nothing is common to all steps."""
        return numbers

    def step(self, numbers: Numbers, state: Array, inputs: Any) -> tuple[Any, Parts]:
        parts = self.at(numbers, self.regressor(state, inputs))
        return self._push(state, parts.total), parts

    def _push(self, state: Array, y: Array) -> Array:
        """Return the state (n0, …) one step later, when y (ny, …) is the newest output."""
        return jnp.concatenate([y, state[: -len(self.outputs)]]) if self.memory else state

    def first_slopes(self, width: int) -> Any:
        """Return one block (ny, n0 + n, m) for each past output, newest first."""
        n0, n, ny = self.states, self.unknowns, len(self.outputs)
        blocks = jnp.eye(n0, n0 + n).reshape(self.memory, ny, n0 + n, 1)
        return tuple(jnp.broadcast_to(blocks, (self.memory, ny, n0 + n, width)))

    def tangents(
        self, numbers: Numbers, state: Array, slopes: Any, inputs: Array
    ) -> tuple[Any, Any, Any, Any]:
        """Propagate `S_k = G_k + Σ_i A_{k,i} S_{k−i}`.

        G_k = ∂g/∂(c, w) and A_{k,i} = ∂g/∂ŷ_{k−i}.
        """
        value, slope, feedback = jax.vmap(
            partial(self._derivatives, numbers), in_axes=-1, out_axes=-1
        )(state, inputs)
        slope = jnp.pad(slope, ((0, 0), (self.states, 0), (0, 0)))
        for i, (lag, output) in enumerate(self.fed_back):
            slope = slope + feedback[:, i, None] * slopes[lag - 1][output]
        following = (slope, *slopes[:-1]) if self.memory else slopes
        return self._push(state, value), following, value, slope

    def _derivatives(self, numbers: Numbers, state: Array, inputs: Array) -> tuple[Any, Any, Any]:
        """Return the value (ny,), ∂g/∂(c, w) (ny, n) and ∂g/∂ŷ (ny, lags) of every fed-back lag."""
        leaves = self.bound.leaves(numbers.weights)
        past = state.reshape(self.memory, len(self.outputs))

        def predict(c: Array, leaves: Sequence[Array], past: Array) -> Array:
            return self.step(numbers._replace(theta=c, weights=leaves), past.reshape(-1), inputs)[
                1
            ].total

        value, pullback = jax.vjp(predict, numbers.theta, leaves, past)
        slopes, feedback = [], []
        for seed in jnp.eye(len(self.outputs)):
            to_c, to_leaves, to_past = pullback(seed)
            slopes.append(jnp.concatenate([to_c, *(jnp.ravel(leaf) for leaf in to_leaves)]))
            feedback.append(
                jnp.stack(
                    [to_past[lag - 1, output] for lag, output in self.fed_back] or [jnp.zeros(())]
                )
            )
        # a kink without a derivative, such as sqrt(max(y, 0)) at 0, counts as flat
        slope, back = (
            jnp.where(jnp.isfinite(d), d, 0.0) for d in (jnp.stack(slopes), jnp.stack(feedback))
        )
        return value, slope, back


@partial(jax.jit, static_argnames="form")
def _predict_rows(form: LaggedDynamics, numbers: Numbers, x: Float[Array, "m nx"]) -> Parts:
    return jax.vmap(lambda row: form.at(numbers, row))(x)


def _learned_output(bound: Bound, numbers: Numbers, z: Any, phi: AnyArray) -> Any:
    """Return f (ny,) at scaled features z; of an ensemble the median of `f_i + φ tilt_i`."""
    if numbers.tilt is None:
        return numbers.gain * bound.values(numbers.weights, z)
    each = jax.vmap(lambda w, tilt: numbers.gain * bound.values(w, z) + phi @ tilt)(
        numbers.weights, numbers.tilt
    )
    return jnp.median(each, axis=0)
