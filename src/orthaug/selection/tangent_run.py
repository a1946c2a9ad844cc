"""What small terms in a motion's equations do to its outputs: the tangent system along a free run.

`s_{k+1} = A_k s_k + h/2 (A_k t_k + t_{k+1})`, `y_k = C_k s_k + o_k` for terms t in the equations and o in the outputs,
h the sampling time; A and C are derivatives of the fitted motion. A segment of training starts anew, from a state that
was estimated beside everything else.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix
from orthaug._base.jax import jax
from orthaug.models.dynamics import Numbers
from orthaug.models.moving import Moving


@dataclass(frozen=True, eq=False)
class MotionResponse:
    """The linear map from terms at M points, in the equations and outputs `places`, to whitened outputs (M·ny,).

    `begins` (M,) tells where segments begin. Steps (M, nx, nx) and outputs (M, ny, nx) are the derivatives A and C.
    """

    steps: Float[np.ndarray, "M nx nx"]
    outputs: Float[np.ndarray, "M ny nx"]
    begins: Float[np.ndarray, "M"]
    weight: Matrix
    half: float
    """h/2; 0 of a discrete motion, where a term acts on the next state."""

    @classmethod
    def of(
        cls, form: Moving, numbers: Numbers, x: Matrix, u: Matrix, rows: Matrix, begins: Any, weight: Matrix
    ) -> MotionResponse:
        """Along states x (M, nx) and inputs u (M, nu), with the rows that steps read."""
        steps, outputs = (np.asarray(part) for part in _derivatives(form, numbers, x, u, rows))
        half = 0.0 if form.motion.integrator == "discrete" else form.sampling_time / 2
        return cls(np.nan_to_num(steps), weight @ np.nan_to_num(outputs), begins, weight, half)

    def forward(self, terms: Float[np.ndarray, "M n k"]) -> Float[np.ndarray, "R k"]:
        """Of terms in all equations and then all outputs (n = nx + ny)."""
        count, nx, _ = self.steps.shape
        moved, direct = terms[:, :nx], np.einsum("oi,mik->mok", self.weight, terms[:, nx:])
        s, found = np.zeros((nx, terms.shape[2])), np.zeros_like(direct)
        for k in range(count):
            if self.begins[k]:
                s = np.zeros_like(s)
            elif self.half:
                s = self.steps[k - 1] @ (s + self.half * moved[k - 1]) + self.half * moved[k]
            else:
                s = self.steps[k - 1] @ s + moved[k - 1]
            found[k] = self.outputs[k] @ s + direct[k]
        return found.reshape(-1, terms.shape[2])

    def adjoint(self, values: Float[np.ndarray, "R k"]) -> Float[np.ndarray, "M n k"]:
        """The transpose of `forward`."""
        count, nx, _ = self.steps.shape
        w = values.reshape(count, -1, values.shape[1])
        direct = np.einsum("oi,mok->mik", self.weight, w)
        found = np.zeros((count, nx, w.shape[2]))
        back = np.zeros(found.shape[1:])  # what the state does from the next row on
        for k in range(count - 1, -1, -1):
            along = self.steps[k].T @ back
            here = self.outputs[k].T @ w[k] + along
            found[k] = self.half * along if self.half else back
            if self.begins[k]:
                back = np.zeros_like(back)
            else:
                found[k] += self.half * here
                back = here
        return np.concatenate([found, direct], axis=1)

    def starts(self) -> Float[np.ndarray, "R s"]:
        """What the states at the begin of each segment do."""
        count, nx, _ = self.steps.shape
        places = np.flatnonzero(self.begins)
        found = np.zeros((count, self.outputs.shape[1], nx * len(places)))
        for i, begin in enumerate(places):
            end, s = (places[i + 1] if i + 1 < len(places) else count), np.eye(nx)
            for k in range(begin, end):
                found[k, :, i * nx : (i + 1) * nx] = self.outputs[k] @ s
                s = self.steps[k] @ s
        return found.reshape(-1, found.shape[2])


@partial(jax.jit, static_argnames="form")
def _derivatives(form: Moving, numbers: Numbers, x: Any, u: Any, rows: Any) -> tuple[Any, Any]:
    """∂(next state)/∂x and ∂y/∂x at points."""
    numbers = form.prepared(numbers)
    steps = jax.vmap(lambda x, row: jax.jacfwd(lambda s: form.step(numbers, s, row)[0])(x))(x, rows)
    return steps, jax.vmap(lambda x, u: jax.jacfwd(lambda s: form.observed(numbers, s, u))(x))(x, u)
