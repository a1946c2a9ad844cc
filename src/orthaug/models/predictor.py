"""The one-step predictor g(x) = φ(x)θ + f(x) − φ(x)θ_aux, and how a free run feeds it its own outputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.jax import Array, jax, jnp
from orthaug.data.expressions import Lag
from orthaug.data.regressors import Features, Layout, largest_lag
from orthaug.models.learners import Bound
from orthaug.physics.baseline import Baseline

AnyArray = Array | np.ndarray


@dataclass(frozen=True)
class Form:
    """What a model computes, without its numbers: hashable, so compiled programs are reused."""

    baseline: Baseline
    features: Features
    layout: Layout
    outputs: tuple[str, ...]
    bound: Bound | None

    @property
    def start(self) -> int:
        """The first row of an experiment that can be predicted."""
        return largest_lag(self.layout)

    @property
    def fed_back(self) -> tuple[tuple[int, int], ...]:
        """(lag, number of the output) of every past output in the regressor, in its order."""
        return tuple((lag.lag, self.outputs.index(lag.channel)) for lag in self.layout if lag.channel in self.outputs)

    @property
    def memory(self) -> int:
        """How many past outputs a free run keeps."""
        return max((lag for lag, _ in self.fed_back), default=0)

    @property
    def used(self) -> tuple[Lag, ...]:
        """The raw lags that the physics or the learner reads."""
        read = {*self.baseline.lags, *self.features.lags}
        return tuple(lag for lag in self.layout if lag in read or self.baseline.function is not None)

    @property
    def input_layout(self) -> Layout:
        """The lagged inputs of the regressor, in its order."""
        return tuple(lag for lag in self.layout if lag.channel not in self.outputs)


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
    """(members, nθ) where the learner is the median of several, one row of weights each: the physics each one adds."""


class Parts(NamedTuple):
    """The prediction of a row in parts: `baseline` = φθ + fixed terms, `learner` = f − φθ_aux, `raw` = f."""

    baseline: Any
    learner: Any
    raw: Any


def parts(form: Form, numbers: Numbers, x: Float[Array, "nx"]) -> Parts:
    """The prediction at one regressor x (nx,), each part (ny,) (eq:orth_param)."""
    phi = form.baseline.phi(x, form.layout, form.outputs, jnp)
    known = form.baseline.known(x, form.layout, form.outputs, jnp)
    if form.bound is None:
        raw = jnp.zeros(len(form.outputs))
    else:
        z = (form.features.evaluate(x, form.layout, jnp) - numbers.centre) / numbers.halfwidth
        raw = _learned(form.bound, numbers, z, phi)
    return Parts(known + phi @ numbers.theta, raw - phi @ numbers.theta_aux, raw)


def _learned(bound: Bound, numbers: Numbers, z: Any, phi: Any) -> Any:
    """f (ny,) at scaled features z; of an ensemble the median of `f_i + φ tilt_i`."""
    if numbers.tilt is None:
        return numbers.gain * bound.values(numbers.weights, z)
    each = jax.vmap(lambda w, tilt: numbers.gain * bound.values(w, z) + phi @ tilt)(numbers.weights, numbers.tilt)
    return jnp.median(each, axis=0)


def regressor(form: Form, past: Any, inputs: Any) -> Any:
    """x of the outputs' past (na, ny), newest first, and the row of lagged inputs."""
    lag, output = np.array(form.fed_back, dtype=int).reshape(-1, 2).T
    return jnp.concatenate([past[lag - 1, output], inputs])


def push(past: Any, y: Any) -> Any:
    """The past (na, ny) one step later, when y (ny,) is its newest entry."""
    return jnp.concatenate([y[None], past[:-1]]) if past.shape[0] else past
