"""Contraction of a free run: a quadratic norm in which sampled A_k contract.

After Lohmiller and Slotine (1998): a contracting run forgets its start.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import linalg

from orthaug._base.checks import Matrix, Vector, check_count
from orthaug._base.parallel import one_blas_thread
from orthaug.analysis.feedback import MOST_WORK, Feedback, feedback, linearise_points
from orthaug.analysis.visited import RunPoint, even_indices
from orthaug.data.record import Record
from orthaug.models.model import Model

_SAMPLES = 2000  # points at most
# Points of largest radius always among them; worst points that a round of search adds
_STEEPEST, _ACTIVE = (50, 64)
_LARGEST_SEARCH = 12  # n0 with a metric better than Lyapunov's


@dataclass(frozen=True, eq=False)
class Contraction:
    """The best norm that was found, `|x|_P = √(xᵀ P x)` of the state, P (n0, n0) up to a factor.

    `rate` is the largest `‖A_k‖_P` over the samples; `bound`, the largest spectral radius, is the
    least that any norm has. `share`, 0 to 1, is that of the samples with `‖A_k‖_P < 1`. Were it so
    at all points between two runs under one input: `|x_k − x̃_k| ≤ overshoot · rateᵏ |x_0 − x̃_0|`,
    each entry of the state in its deviation.
    """

    rate: float
    bound: float
    share: float
    samples: int
    overshoot: float
    metric: Matrix
    worst: RunPoint


@one_blas_thread()
def contraction(
    model: Model,
    record: Record,
    *,
    box: int = 0,
    along: Feedback | None = None,
) -> Contraction | None:
    """Return a quadratic norm in which the free run contracts on as many points as possible.

    At most 2000 points are sampled.

    It minimises `max_k ‖T A_k T⁻¹‖₂`, P = TᵀT. Along `T(t) = exp(tX) T`, X symmetric, the logarithm
    of each norm is convex in t with the slope `uᵀXu − vᵀXv`, u and v its singular vectors: there
    are no false minima. The search starts from Lyapunov's P of the mean A_k and takes quasi-Newton
    steps on a smooth maximum over the worst points. Where not all points contract, it starts again
    without the worst of them. None where no A_k is there.

    Args:
        box: how many points to add, uniform in the box of the states and inputs that the run met.
        along: a result of `feedback`, computed if it is not given.

    Raises:
        InputError: as `feedback`, or a `box` that is no number of points.
    """
    box = check_count(box, "box", 0)
    run = feedback(model, record) if along is None else along
    if not run or not run.worst:
        return None
    unit, most = run.unit, min(_SAMPLES, int(MOST_WORK / len(run.unit) ** 3))
    steepest = np.argsort(-run.radius, kind="stable")[: min(_STEEPEST, most // 2)]
    some = run.points.take(
        np.union1d(even_indices(len(run.radius), most - len(steepest)), steepest)
    )
    points, transition, radius = linearise_points(model, some.with_box(run.points, box))
    a = transition * unit / unit[:, None]
    sizes, metric = _sizes(t := _best_metric(a), a), (t / unit).T @ (t / unit)
    rate, worst = points.worst(record, sizes, model.form.describe)
    assert rate is not None and worst is not None  # there are points, and no norm is infinite
    bound, share, overshoot = (
        float(radius.max()),
        float(np.mean(sizes < 1)),
        float(np.linalg.cond(t)),
    )
    return Contraction(rate, bound, share, len(a), overshoot, metric / np.trace(metric), worst)


def _sizes(t: Matrix, a: Float[np.ndarray, "m n n"]) -> Vector:
    """Return ‖T A T⁻¹‖₂ of each matrix."""
    b = t @ a @ np.linalg.inv(t)
    return np.sqrt(np.linalg.eigvalsh(b.swapaxes(1, 2) @ b)[:, -1])


def _best_metric(a: Float[np.ndarray, "m n n"]) -> Matrix:
    """Return T (n, n) in which all of the matrices contract, or else as many as was reached.

    Deterministic.
    """
    tried, some = [_metric(a)], a[:: -(-len(a) // 500)]
    shares = [np.mean(_sizes(tried[0], a) < 1)]
    for quantile in (1.0, 0.95, 0.8, 0.5) if shares[0] < 1 else ():
        sizes = _sizes(tried[int(np.argmax(shares))], some)
        new = (
            [_metric(some[sizes <= np.quantile(sizes, quantile)])]
            if quantile < 1
            else [*_lyapunov(a.mean(axis=0))]
        )
        tried, shares = tried + new, shares + [np.mean(_sizes(t, a) < 1) for t in new]
    return tried[int(np.argmax(shares))]


def _metric(a: Float[np.ndarray, "m n n"]) -> Matrix:
    """Return T (n, n) with a small largest `‖T A T⁻¹‖₂`, close to the least."""
    n, bound, active = a.shape[1], np.abs(np.linalg.eigvals(a)).max(), even_indices(len(a), _ACTIVE)
    best = t = min([np.eye(n), *_lyapunov(a.mean(axis=0))], key=lambda t: _sizes(t, a).max())
    sizes, least = _sizes(t, a), max(_sizes(t, a).max(), 1e-9)
    for sharpness in (4, 8, 16, 32) if 1 < n <= _LARGEST_SEARCH else ():
        if (gap := np.log(least / max(bound, 1e-3 * least))) <= 0.06 * abs(np.log(least)):
            break  # the rest would cost overshoot
        active = np.union1d(active, np.argsort(-sizes, kind="stable")[:_ACTIVE])
        t = (
            _descend(t @ a[active] @ np.linalg.inv(t), sharpness * np.log(n * len(active)) / gap)
            @ t
        )
        sizes = _sizes(t := t / np.linalg.norm(t), a)
        best, least = (t, sizes.max()) if sizes.max() < least else (best, least)
    return best


def _lyapunov(mean: Matrix) -> Iterator[Matrix]:
    """Yield factors T of P = TᵀT with `‖A‖_P < c`, for some c above the radius of A.

    They solve `(A/c)ᵀ P (A/c) − P = −I`.
    """
    radius = max(float(np.abs(np.linalg.eigvals(mean)).max()), 1e-3)
    for c in (radius**0.95, radius**0.8, radius**0.5, 1.1 * radius, 1.5 * radius):
        if c > radius:
            p = linalg.solve_discrete_lyapunov((mean / c).T, np.eye(len(mean)))
            values, vectors = np.linalg.eigh((p + p.T) / 2)
            if values[0] > 1e-14 * values[-1]:
                yield np.sqrt(values / values[-1])[:, None] * vectors.T


def _descend(a: Float[np.ndarray, "m n n"], sharpness: float) -> Matrix:
    """Return Y that lowers `log Σ σ^sharpness / sharpness` over the σ of all Y A Y⁻¹, from I."""
    from scipy import optimize  # slow to import

    n = a.shape[1]

    def value(flat: Vector) -> tuple[float, Vector]:
        y = flat.reshape(n, n)
        if np.linalg.cond(y) > 1e6:
            return 1e6, np.zeros(n * n)
        b = y @ a @ (inverse := np.linalg.inv(y))
        squares, v = np.linalg.eigh(b.swapaxes(1, 2) @ b)
        squares, u = np.maximum(squares, 1e-200), b @ v
        total = float(np.logaddexp.reduce(logarithms := sharpness * np.log(squares) / 2, axis=None))
        weight = np.exp(logarithms - total)
        both = np.concatenate([u, v]).swapaxes(0, 1).reshape(n, -1)  # Σ w (u uᵀ − v vᵀ)
        slope = both * np.concatenate([weight / squares, -weight]).ravel() @ both.T
        return total / sharpness, (slope @ inverse.T).ravel()

    lowest = optimize.minimize(
        value, np.eye(n).ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 30}
    )
    return np.asarray(lowest.x).reshape(n, n)
