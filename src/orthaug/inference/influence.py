"""The influence of each row on an estimate: derivatives by rows, leverage, uneven noise.

To first order `p̂ − p = M⁻¹ Σ_k ψ_kᵀe_k` with `M = Σψᵀψ + ridge`, and `θ̂ − θ = Σ_k b_kᵀe_k` with
`b_k = ψ_k M⁻¹ Kᵀ`, K how θ follows p = (c, w). The plain covariance takes all errors for equally
large. Where their size goes with what b_k is made of it is wrong, and there alone: White's test
(Econometrica 1980) regresses e_k² on the products of the entries of b_k, in the form of Koenker (J.
Econometrics 1981), whose level does not rest on normal errors. HC3 (MacKinnon and White 1985), `Σ
ψᵀẽẽᵀψ` with `ẽ_k = (I − φ_k(ΦᵀΦ)⁻¹φ_kᵀ)⁻¹e_k`, holds for both, also of few rows. The rows are those
of one step ahead or of a free run: both have ψ and e.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.special
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.columns import span
from orthaug._base.jax import jnp
from orthaug.inference.covariance import changes
from orthaug.models.model import Model
from orthaug.models.rows import chunk_shape, from_chunks, in_chunks
from orthaug.models.statistics import Statistics, column_units, half_inverse
from orthaug.physics.problem import Problem

LARGEST = 30_000_000  # entries of ψ that are made at once, 240 MB
# entries of b bᵀ that the squared errors are regressed on; of more parameters only the squares
_MOST_PRODUCTS = 30
_ROWS_PER_PRODUCT = 20
_RANK = 1e-8  # of the largest singular value of the products with columns of size 1

Slopes = Float[np.ndarray, "N ny n"]


@dataclass(frozen=True, eq=False)
class Influence:
    """Rows of an estimate in coordinates in which `M` is the identity.

    `rows` are `ψ_k H` with `H Hᵀ = M⁻¹`, `along` is K H, `root` is H itself; outputs are whitened.
    """

    rows: Float[np.ndarray, "N ny r"]
    root: Float[np.ndarray, "n r"]
    along: Float[np.ndarray, "m r"]
    physics: Float[np.ndarray, "N ny s"]
    """The same rows of θ alone, in coordinates of their own: their squares are its leverage."""
    inflation: float
    """What the learner has used up: √(N / (N − effective weights)), for its leverage is no matter
    of a single row.
    """

    @classmethod
    def of(
        cls, slopes: Slopes, statistics: Statistics, k: Float[np.ndarray, "m n"], nt: int
    ) -> Influence:
        """Return the statistics of derivatives ψ (N, ny, n) with their Gram matrix, prior and K.

        Args:
            nt: how many of the n unknowns are θ.
        """
        assert statistics.gram is not None
        root = half_inverse(statistics.information(nt), nt)
        rows, own = slopes @ root, slopes[..., :nt] @ half_inverse(statistics.gram[:nt, :nt], nt)
        used, count = (
            max(float(np.sum(rows**2) - np.sum(own**2)), 0.0),
            rows.shape[0] * rows.shape[1],
        )
        return cls(rows, root, k @ root, own, float(np.sqrt(count / max(count - used, 1.0))))

    def leave_one_out(self, errors: Matrix) -> Matrix:
        """Return `(I − H_k)⁻¹ e_k` of every row (N, ny).

        This is the error that physics fitted without this row leaves of it.
        """
        own = np.eye(errors.shape[1]) - np.einsum("kor,kpr->kop", self.physics, self.physics)
        errors = self.inflation * errors
        if errors.shape[1] == 1:
            return errors / np.maximum(own[:, :, 0], np.sqrt(np.finfo(float).eps))
        values, vectors = np.linalg.eigh(own)
        along = np.einsum("kij,ki->kj", vectors, errors) / np.maximum(
            values, np.sqrt(np.finfo(float).eps)
        )
        return np.einsum("kij,kj->ki", vectors, along)

    def uneven(self, errors: Matrix) -> float:
        """Return the p-value of White's test for variances that depend on the row's influence.

        Of several outputs the smallest, times their number (Bonferroni).
        """
        errors = self.leave_one_out(errors)
        found = [_white_test(self.rows[:, o] @ self.along.T, e) for o, e in enumerate(errors.T)]
        return min(1.0, len(found) * min(found))


def _white_test(influence: Matrix, errors: Vector) -> float:
    """Return the p-value of White's test of one output.

    The squared errors are regressed on the products of the influences: `N R²` is χ² with as many
    degrees of freedom as there are products.
    """
    size = np.sqrt(np.mean(influence**2, axis=0))
    b = influence[:, size > 0] / size[size > 0]
    first, second = np.triu_indices(b.shape[1])
    products = b[:, first] * b[:, second]
    if products.shape[1] > min(_MOST_PRODUCTS, len(errors) // _ROWS_PER_PRODUCT):
        products = b**2
    if not products.size or products.shape[1] > len(errors) // _ROWS_PER_PRODUCT:
        return 1.0
    products = products - products.mean(axis=0)
    basis = span(products, _RANK)
    squares = errors**2 - np.mean(errors**2)
    total = float(squares @ squares)
    if not total > 0 or not basis.shape[1]:
        return 1.0
    statistic = len(errors) * float(np.sum((basis.T @ squares) ** 2)) / total
    return float(scipy.special.chdtrc(basis.shape[1], statistic))


def one_step_slopes(problem: Problem, model: Model, x: Matrix | None = None) -> Slopes:
    """Return ∂ŷ/∂(c, w) in whitened outputs on the rows x (N, nx), filtered by a noise model.

    By default, on the rows of the problem.
    """
    x = problem.rows.x if x is None else x
    gram = model.statistics.gram
    assert gram is not None
    unit, ny = column_units(gram, len(model.theta)), len(problem.outputs)
    chunks = jnp.asarray(in_chunks(x, chunk_shape(len(x)), repeat=True))
    moved = from_chunks(
        np.asarray(changes(model.form, model.numbers, chunks, jnp.diag(unit))), len(x)
    )
    slopes = moved.reshape(len(x), len(unit), ny) / unit[:, None]
    if problem.noise is not None:
        slopes = np.swapaxes(problem.noise.rows(np.swapaxes(slopes, 1, 2)), 1, 2)
    return np.einsum("oi,kni->kon", problem.weight.matrix, slopes)


def hc3(
    statistics: Statistics, slopes: Slopes, errors: Matrix, nt: int, share: float = 1.0
) -> Statistics:
    """Return statistics whose middle `ΣψᵀΣ_eψ` takes each row's own error (HC3).

    Otherwise one noise variance holds for all rows.

    Args:
        errors: of the same rows (N, ny), whitened as ψ is.
        nt: how many of the unknowns are θ.
        share: how many times more rows were trained on than these, which then represent them.
    """
    influence = Influence.of(slopes, statistics, np.eye(slopes.shape[2]), nt)
    scores = np.einsum("kon,ko->kn", slopes, influence.leave_one_out(errors))
    return replace(statistics, middle=share * scores.T @ scores)
