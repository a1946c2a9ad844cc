"""Stability of a free run: a norm in which it contracts, and all checks together with their report.

They are evidence from sampled points, no proof, but for the last: beyond the training a held
correction is bounded, and stable linear physics keeps it so (`beyond_training`). Two of them look
at A_k, the derivative of a step by the state: its spectral radius at every step (`feedback`), and a
quadratic norm in which all sampled A_k contract (`contraction`): after Lohmiller and Slotine (1998)
a contracting run forgets its start. A third runs the model on larger and larger inputs
(`boundedness`). The paper's `cond:pred_stab` is another matter: it asks for the one-step predictor,
whose past is measured (`lipschitz`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy import linalg

from orthaug._base.checks import Matrix, Vector, check_count
from orthaug._base.errors import Warning
from orthaug._base.lines import percent
from orthaug._base.parallel import one_blas_thread
from orthaug.analysis.beyond_training import describe_beyond, radius_beyond
from orthaug.analysis.boundedness import Divergence, describe_divergence, find_divergence
from orthaug.analysis.feedback import MOST_WORK, Feedback, feedback, linearise_points
from orthaug.analysis.lipschitz import Lipschitz, lipschitz
from orthaug.analysis.visited import RunPoint, even_indices
from orthaug.data.record import Record
from orthaug.models.model import HoldsModel, Model, model_of
from orthaug.models.response import Response

_SAMPLES = 2000  # points at most
# Points of largest radius always among them; worst points that a round of search adds
_STEEPEST, _ACTIVE = (50, 64)
_LARGEST_SEARCH = 12  # n0 with a metric better than Lyapunov's


@dataclass(frozen=True, eq=False)
class Stability:
    """Evidence on the free run (None without a state).

    `diverges_at` is searched up to the factor `searched`.

    `lipschitz` is None for a model that does not predict from lagged signals. `radius_beyond` is
    the spectral radius of what goes on far beyond the training (`beyond_training`), None where that
    is not one linear system.
    """

    feedback: Feedback | None
    contraction: Contraction | None
    diverges_at: float | None
    searched: float
    lipschitz: Lipschitz | None
    warnings: tuple[Warning, ...]
    text: str
    radius_beyond: float | None = None


def stability(
    model: Model | HoldsModel,
    record: Record,
    *,
    response: Response | None = None,
    x: Matrix | None = None,
    box: int = 0,
    largest: float = 1024.0,
) -> Stability:
    """Return all checks of a model on a record, with a text that says what they mean.

    Args:
        model: a lagged model; of a fit its model.
        record: measured data.
        response: the model's free run of the record, if it is there already.
        x: the record's usable regressors (N, nx) in the model's layout, if they are stacked
            already.
        box, largest: as in `contraction` and `find_divergence`.

    Raises:
        InputError: no model; as the single checks.

    Examples:
        >>> import orthaug as oa
        >>> u = [1.0, 2.0, 0.0, 3.0, 1.0, 0.0]
        >>> y = [0.0, 0.5, 1.25, 0.625, 1.8125, 1.40625]  # 0.5 (y[k-1] + u[k-1])
        >>> record = oa.Record.from_arrays(u=u, y=y)
        >>> physics = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
        >>> found = stability(oa.estimate(record, physics, learner=None).model, record)
        >>> print(found.diverges_at, round(found.contraction.rate, 6))
        None 0.5
    """
    model = model_of(model)
    gradients, run = lipschitz(model, record, x=x), feedback(model, record, response=response)
    contracts = contraction(model, record, box=box, along=run)
    divergence = find_divergence(model, record, largest)
    radius = None if run is None else radius_beyond(model, run.points.states, run.points.inputs)
    factor, searched = divergence.factor, divergence.searched
    checks = Stability(run, contracts, factor, searched, gradients, (), "", radius)
    says = list(_sentences(checks, divergence, bool(model.inputs)))
    says += [(sentence, "") for sentence in (describe_beyond(model, radius),) if sentence]
    warnings = tuple(Warning(code, sentence) for sentence, code in says if code)
    return replace(checks, warnings=warnings, text="\n".join(sentence for sentence, _ in says))


def _sentences(
    checks: Stability, divergence: Divergence, driven: bool
) -> Iterator[tuple[str, str]]:
    """Yield what the checks say, sentence by sentence; with the code of a warning, or nothing."""
    run, contracts = checks.feedback, checks.contraction
    if checks.lipschitz:
        steepest = checks.lipschitz.gradient
        gradient = "without bound" if steepest is None else f"by up to {steepest:.4g} times as much"
        yield (
            f"On measured rows a change of past values moves the one-step prediction {gradient}; "
            "the free run is judged apart from that.",
            "",
        )
    if run is None:
        yield (
            "The model uses no past outputs: its free run cannot diverge, and does not depend "
            "on its start.",
            "",
        )
        return
    if run.diverged:
        yield (
            f"The free run diverges ({'; '.join(run.diverged)}); the checks end there.",
            "free_run_diverges",
        )
    if run.share_above_one is not None:
        above = (
            f"above 1 at {percent(run.share_above_one, 3)} of {len(run.radius)} steps of the "
            "free run"
        )
        peak = f"median {run.median:.4g}, largest {run.largest:.4g} at {run.worst}"
        warns = "spectral_radius_above_one" if run.share_above_one > 0.01 else ""
        yield f"The local spectral radius is {above}; {peak}.", warns
    if run.skipped:
        text = (
            f"At {run.skipped} points more the model has no finite derivative; they are left out."
        )
        yield text, "derivative_not_finite"
    if contracts is None:
        text = (
            "Contraction could not be checked: no finite derivatives, or more than 200 past "
            "outputs."
        )
        yield text, "contraction_not_checked"
    elif contracts.rate < 1:
        how = (
            f"contracts in one metric (rate {contracts.rate:.4g}): evidence, not proof, that "
            "it forgets its start"
        )
        yield f"On all {contracts.samples} sampled points the free run {how}.", ""
    else:
        share = f"{percent(1 - contracts.share, 3)} of the {contracts.samples} sampled points"
        worst = f"worst at {contracts.worst}, rate {contracts.rate:.4g}"
        yield (
            f"At {share} the free run does not contract in the best metric that was found, "
            f"{worst}.",
            "",
        )
    yield describe_divergence(divergence, driven)


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
