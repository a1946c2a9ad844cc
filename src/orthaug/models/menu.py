"""A lagged model with terms that are chosen while programs run: what selecting terms by the free run is made of.

`ŷ_k = φ(x_k)θ + Σ_j w_j t_j(x_k)`, the t_j products of few factors whose numbers come with the weights. So every choice
of `width` terms runs by the same compiled programs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from orthaug._base.jax import jax, jnp
from orthaug.data.terms import products_of
from orthaug.models.dynamics import Numbers, Parts
from orthaug.models.lagged import Lagged


@dataclass(frozen=True)
class Menu(Lagged):
    """A lagged form, its `features` the factors, with places for `width` terms of up to `order` factors.

    Of `Numbers`, `weights` are a pair: the factors' numbers (width, order) of each term, and its coefficient (width,).
    `halfwidth` are the factors' sizes. It has one output.
    """

    width: int = 0
    order: int = 1

    @property
    def unknowns(self) -> int:
        return len(self.baseline.names) + self.width

    def numbers(self, theta: Any, products: Any, weights: Any, sizes: Any) -> Numbers:
        """The model's numbers, of coefficients (width,) of terms of the factors divided by their `sizes`."""
        pair = (np.asarray(products), np.asarray(weights, dtype=float))
        return Numbers(np.asarray(theta), np.zeros(len(theta)), pair, np.zeros(len(sizes)), sizes, np.ones(1))

    def terms(self, numbers: Numbers, x: Any) -> Any:
        """t (width,) at one regressor x (nx,)."""
        factors = self.features.evaluate(x, self.layout, jnp) / numbers.halfwidth
        return products_of(factors, numbers.weights[0], jnp)

    def at(self, numbers: Numbers, x: Any) -> Parts:
        return self._with_slopes(numbers, x)[0]

    def _with_slopes(self, numbers: Numbers, x: Any) -> tuple[Parts, Any]:
        """The prediction at x in parts, and ∂ŷ/∂(c, w) (1, n): it is linear in both."""
        phi = self.baseline.phi(x, self.layout, self.outputs, jnp)
        known = self.baseline.known(x, self.layout, self.outputs, jnp)
        terms = self.terms(numbers, x)[None, :]
        learned = terms @ numbers.weights[1]
        return Parts(known + phi @ numbers.theta, learned, learned), jnp.concatenate([phi, terms], axis=1)

    def _derivatives(self, numbers: Numbers, state: Any, inputs: Any) -> tuple[Any, Any, Any]:
        def predict(state: Any) -> tuple[Any, Any]:
            parts, slope = self._with_slopes(numbers, self.regressor(state, inputs))
            return parts.total[0], (parts.total, slope)

        to_state, (value, slope) = jax.grad(predict, has_aux=True)(state)
        back = jnp.stack([to_state[lag - 1] for lag, _ in self.fed_back] or [jnp.zeros(())])[None, :]
        # a kink without a derivative counts as flat
        slope, feedback = (jnp.where(jnp.isfinite(d), d, 0.0) for d in (slope, back))
        return value, slope, feedback
