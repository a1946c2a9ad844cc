"""Does a model's free run stay bounded and forget its start? Evidence from sampled points, never a proof.

With `A_{k,i} = ∂g/∂y_{k−i}` (ny, ny) a small change of the past, `s_k = (δy_{k−1}, …, δy_{k−na})`, obeys
`s_{k+1} = A_k s_k` in a free run; the companion matrix A_k has the A_{k,i} in its first ny rows and shifts the rest.
Two checks look at A_k: its spectral radius at every step, and a quadratic norm in which all sampled A_k contract
(Lohmiller and Slotine, Automatica 34, 1998). A third runs the model on larger and larger inputs. The paper's
`cond:pred_stab` is another matter: it asks for the one-step predictor, whose past is measured; see `lipschitz`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int
from scipy import linalg, optimize

from orthaug._base.checks import Matrix, Vector, check_choice, check_count, check_number
from orthaug._base.errors import InputError
from orthaug._base.jax import jax, jnp
from orthaug._base.parallel import one_blas_thread
from orthaug.data.record import Record
from orthaug.data.regressors import lag_matrix
from orthaug.models.learners import External
from orthaug.models.model import Model
from orthaug.models.predictor import Form, Numbers, parts

_STEPS, _SAMPLES = 20_000, 2000  # most rows that are looked at, spread evenly; most points of the contraction check
_STEEPEST, _ACTIVE = 50, 64  # points of largest radius always among them; worst points that a round of search adds
_BATCH, _WORK = 1024, 4e7  # rows per compiled call; most rows times (na ny)³
_LONGEST_STATE, _LARGEST_SEARCH = 200, 12  # na ny with eigenvalues at all; with a metric better than Lyapunov's
_LARGEST_FACTOR = 1e4  # outputs of a stable linear model grow with its inputs, and 10⁶ times the largest is "diverged"


@dataclass(frozen=True)
class Place:
    """A point: experiment, row in it and its name in messages, and the regressor there; no row off the trajectory."""

    experiment: int | None
    row: int | None
    where: str
    regressor: dict[str, float]

    def __str__(self) -> str:
        return f"{self.where} ({', '.join(f'{name} = {value:.4g}' for name, value in self.regressor.items())})"


class Points(NamedTuple):
    """Regressors (m, nx) with the experiment and the row of each; -1 for points off the trajectory."""

    x: Matrix
    experiment: Int[np.ndarray, "m"]
    row: Int[np.ndarray, "m"]

    def take(self, which: Any) -> Points:
        return Points(*(part[which] for part in self))


@dataclass(frozen=True, eq=False)
class Feedback:
    """How m of the `steps` of a run, spread evenly, depend on the past outputs.

    `jacobians[:, i - 1]` are the A_{k,i} in the outputs' units, `radius` (m,) the spectral radii of the A_k, and their
    summary is None where there are none. `skipped` points are left out because the model has no finite derivative
    there; `diverged` says in which output and where a free run left all bounds; `unit` (ny,) is the deviation of y.
    """

    points: Points
    jacobians: Float[np.ndarray, "m na ny ny"]
    radius: Vector
    unit: Vector
    largest: float | None
    median: float | None
    share_above_one: float | None
    worst: Place | None
    steps: int
    skipped: int
    diverged: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Contraction:
    """The best norm that was found, `|s|_P = √(sᵀ P s)`, P (na ny)² for s = (y_{k−1}, …, y_{k−na}), up to a factor.

    `rate` is the largest `‖A_k‖_P` over the samples; `bound`, the largest spectral radius, is the least that any norm
    has. `share`, 0 to 1, is that of the samples with `‖A_k‖_P < 1`. Were it so at all points between two runs under one
    input: `|s_k − s̃_k| ≤ overshoot · rateᵏ |s_0 − s̃_0|`, outputs in their standard deviations.
    """

    rate: float
    bound: float
    share: float
    samples: int
    overshoot: float
    metric: Matrix
    worst: Place


@dataclass(frozen=True)
class Lipschitz:
    """Largest ‖∂g/∂x‖ and ‖∂φ/∂x‖ (Frobenius, no less than ‖·‖₂) over measured rows; None where none is finite.

    ∂g/∂x is (ny, nx) in output units per regressor unit, ∂φ/∂x is (ny nθ, nx). Scaled, and for the places: regressors
    and outputs in their standard deviations, each column of φ in its RMS.
    """

    gradient: float | None
    gradient_scaled: float | None
    worst: Place | None
    phi: float | None
    phi_scaled: float | None
    phi_worst: Place | None
    rows: int


@dataclass(frozen=True, eq=False)
class Stability:
    """Evidence on the free run (None without past outputs); `diverges_at` is searched up to the factor `searched`."""

    feedback: Feedback | None
    contraction: Contraction | None
    diverges_at: float | None
    searched: float
    lipschitz: Lipschitz
    warnings: tuple[str, ...]
    text: str


def stability(model: Model, record: Record, *, box: int = 0, largest: float = 1024.0) -> Stability:
    """All checks of a model on a record, with a text that says what they mean; arguments and errors as of each."""
    gradients, found = lipschitz(model, record), feedback(model, record)
    contracts, factor = contraction(model, record, box=box, along=found), divergence_scaling(model, record, largest)
    checks = Stability(found, contracts, factor, float(largest), gradients, (), "")
    says = list(_sentences(checks))
    return replace(checks, warnings=tuple(s for s, warns in says if warns), text="\n".join(s for s, _ in says))


def feedback(model: Model, record: Record, *, along: str = "simulation") -> Feedback | None:
    """A_{k,i} = ∂g/∂y_{k−i} and the spectral radius of A_k along a run; None for a model without past outputs.

    At most 20000 steps, fewer where na ny is large and none where it is above 200, spread evenly. Radii below 1 do not
    make a nonlinear run stable, nor do some above 1 make it unstable: they say where to look. `along` is "simulation",
    regressors of the model's own outputs up to where it diverges, or "measured".

    Raises:
        InputError: a record that does not fit the model, or another `along`.
    """
    free = check_choice(along, ("simulation", "measured"), "`along`") == "simulation"
    if not model.form.memory:
        return None
    every, unit, diverged = _visited(model, record, free)
    size = model.form.memory * len(model.outputs)
    some = every.take(_evenly(len(every.x), 0 if size > _LONGEST_STATE else min(_STEPS, int(_WORK / size**3))))
    points, jacobians, radius = _linearised(model, some)
    largest, worst = _worst(model, record, points, radius)
    median, share = (float(np.median(radius)), float(np.mean(radius > 1 + 1e-6))) if worst else (None, None)
    skipped = len(some.x) - len(points.x)
    return Feedback(points, jacobians, radius, unit, largest, median, share, worst, len(every.x), skipped, diverged)


@one_blas_thread()
def contraction(model: Model, record: Record, *, box: int = 0, along: Feedback | None = None) -> Contraction | None:
    """The quadratic norm in which the free run contracts on as many of at most 2000 sampled points as was reached.

    Minimises `max_k ‖T A_k T⁻¹‖₂`, P = TᵀT. Along `T(t) = exp(tX) T`, X symmetric, the logarithm of each norm is convex
    in t with the slope `uᵀXu − vᵀXv`, u and v its singular vectors: there are no false minima. It starts from
    Lyapunov's P of the mean A_k and takes quasi-Newton steps on a smooth maximum over the worst points; where not all
    points contract, it does so again without the worst of them. None where no A_k is there. `along` is a result of
    `feedback`, computed if it is not given; `box` adds points uniform in the box of the regressors that it met.

    Raises:
        InputError: as `feedback`, or a `box` that is no number of points.
    """
    box, found = check_count(box, "box", 0), along or feedback(model, record)
    if not found or not found.worst:
        return None
    unit = np.tile(found.unit, model.form.memory)
    most = min(_SAMPLES, int(_WORK / len(unit) ** 3))
    steepest = np.argsort(-found.radius, kind="stable")[: min(_STEEPEST, most // 2)]
    points = found.points.take(np.union1d(_evenly(len(found.radius), most - len(steepest)), steepest))
    if box:
        x, nowhere = found.points.x, np.full(box, -1)  # the same points on every call:
        more = np.random.default_rng(0).uniform(x.min(axis=0), x.max(axis=0), (box, x.shape[1]))
        points = Points(*(np.concatenate(p) for p in zip(points, (more, nowhere, nowhere), strict=True)))
    points, jacobians, radius = _linearised(model, points)
    a = companions(jacobians) * unit / unit[:, None]
    sizes, metric = _sizes(t := _best_metric(a), a), (t / unit).T @ (t / unit)
    rate, worst = _worst(model, record, points, sizes)
    assert rate is not None and worst is not None  # there are points, and no norm is infinite
    bound, share, overshoot = float(radius.max()), float(np.mean(sizes < 1)), float(np.linalg.cond(t))
    return Contraction(rate, bound, share, len(a), overshoot, metric / np.trace(metric), worst)


def divergence_scaling(model: Model, record: Record, largest: float = 1024.0) -> float | None:
    """Factor on the inputs from which the free run leaves all bounds (10⁶ times the largest training output).

    It scales each input's deviation from its mean over the record; the measured outputs that the run starts from stay.
    Doubled until a run diverges, then bisected to 5 %; what is returned did diverge, and others below it may. Of longer
    records 20000 rows are used, the first of each experiment. None where no run up to `largest` diverges, as without
    past outputs; at most 1 where the record's own run does, and 0 where it does with its inputs at their means.

    Raises:
        InputError: a record that does not fit the model, or a `largest` that is not above 1 and at most 10⁴.
    """
    if not 1 < check_number(largest, "largest", positive=True) <= _LARGEST_FACTOR:
        raise InputError(f"`largest` must be a factor above 1 and at most {_LARGEST_FACTOR:g}; got {largest!r}.")
    if not model.form.memory:
        return None
    rows = max(_STEPS // len(record.experiments), model.form.start + 1)
    record = replace(record, experiments=tuple(e.rows(None, rows) for e in record.experiments))
    mean = np.concatenate([e.inputs for e in record.experiments]).mean(axis=0)

    def diverges(factor: float) -> bool:
        scaled = (replace(e, inputs=mean + factor * (e.inputs - mean)) for e in record.experiments)
        return any(t.diverged for t in model.simulate(replace(record, experiments=tuple(scaled))).trajectories)

    low = high = 1.0
    if diverges(1.0):
        while diverges(low := low / 2):
            high = low
            if low < 1 / _LARGEST_FACTOR:
                return 0.0 if diverges(0.0) else low
    else:
        while not diverges(high := min(2 * low, float(largest))):
            low = high
            if low == largest:
                return None
    while high > 1.05 * low:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if diverges(middle) else (middle, high)
    return high


def lipschitz(model: Model, record: Record) -> Lipschitz:
    """Gradients of the one-step predictor g, and of ∂g/∂θ = φ, over measured regressors (`cond:pred_stab`).

    The predictor γ_k = g(x_k) reads the last n samples only. With ‖∂g/∂x‖ ≤ L on a convex set of all regressors,
    `|γ − γ̃| ≤ L Σ_{i≥k−n} (|u_i − ũ_i| + |y_i − ỹ_i|) ≤ L λ⁻ⁿ Γ_k` for every λ in (0, 1), because λ^{k−i} ≥ λⁿ there:
    the condition holds with `C = max(L λ⁻ⁿ, |g(0)|)`, and likewise for ∂γ/∂θ. Bounded gradients are all that it asks
    of a finite memory. Here L is that of at most 20000 measured rows and of this θ; it may be larger elsewhere, and the
    learner's weights are not in φ. None of it tells about the free run: y_k = 2 y_{k−1} fulfils the condition.

    Raises:
        InputError: a record that does not fit the model, or has no outputs.
    """
    (every, y_scale, _), form = _visited(model, record, False), model.form
    points, x_scale, found = every.take(_evenly(len(every.x), _STEPS)), every.x.std(axis=0), []
    size = partial(np.linalg.norm, axis=(1, 2))
    with np.errstate(all="ignore"):
        phi = np.asarray(form.baseline.phi(points.x, form.layout, form.outputs, np))
        rms = np.sqrt(np.mean(np.sum((phi / y_scale[:, None]) ** 2, axis=1), axis=0))
        for of_phi, scale in ((False, y_scale), (True, np.outer(y_scale, _positive(rms)).ravel())):
            batches = (g.reshape(len(g), len(scale), len(x_scale)) for g in _gradients(model, points.x, of_phi))
            norms = [(size(g), size(g * x_scale / scale[:, None])) for g in batches]
            plain, scaled = (np.concatenate(column) for column in zip(*norms, strict=True))
            found += [_worst(model, record, points, plain)[0], *_worst(model, record, points, scaled)]
    return Lipschitz(*found, rows=len(points.x))


@partial(jax.jit, static_argnames=("form", "of_phi"))
def _gradient_rows(form: Form, numbers: Numbers, x: Float[Array, "m nx"], step: Any, of_phi: bool) -> Array:
    """∂g/∂x (m, ny, nx), by differences of width `step` (nx,) where a learner has no derivative; or ∂φ/∂x."""

    def g(row: Any) -> Any:
        found = parts(form, numbers, row)
        return found.baseline + found.learner

    def differences(row: Any) -> Any:
        width = jnp.diag(step)
        return ((jax.vmap(g)(row + width) - jax.vmap(g)(row - width)) / (2 * step[:, None])).T

    if of_phi:
        return jax.vmap(jax.jacfwd(lambda row: form.baseline.phi(row, form.layout, form.outputs, jnp)))(x)
    external = form.bound is not None and isinstance(form.bound.learner, External)
    return jax.vmap(differences if external else jax.jacrev(g))(x)


def _gradients(model: Model, x: Matrix, of_phi: bool = False) -> Iterator[Any]:
    """∂g/∂x or ∂φ/∂x in batches that are computed at one shape."""
    step = 1e-3 * _positive(x.std(axis=0))  # bears a learner in single precision
    for begin in range(0, len(x), _BATCH):
        rows = x[begin : begin + _BATCH]
        padded = np.concatenate([rows, np.repeat(rows[-1:], _BATCH - len(rows), axis=0)])
        yield np.asarray(_gradient_rows(model.form, model.numbers, padded, step, of_phi))[: len(rows)]


def companions(jacobians: Float[np.ndarray, "m na ny ny"]) -> Float[np.ndarray, "m n n"]:
    """Companion matrices, n = na ny, of A_{k,i} at [k, i − 1]; the state is (y_{k−1}, …, y_{k−na})."""
    m, na, ny, _ = jacobians.shape
    shift = np.broadcast_to(np.eye(na * ny)[: (na - 1) * ny], (m, (na - 1) * ny, na * ny))
    return np.concatenate([jacobians.swapaxes(1, 2).reshape(m, ny, na * ny), shift], axis=1)


def _linearised(model: Model, points: Points) -> tuple[Points, Float[np.ndarray, "m na ny ny"], Vector]:
    """The points with finite derivatives, their A_{k,i} and their spectral radii."""
    found = np.zeros((len(points.x), model.form.memory, len(model.outputs), len(model.outputs)))
    if len(found):
        gradients = np.concatenate(list(_gradients(model, points.x)))
        for column, (lag, output) in enumerate(model.form.fed_back):
            found[:, lag - 1, :, output] = gradients[:, :, column]
    finite = (np.abs(found) < 1e100).all(axis=(1, 2, 3))  # beyond, a derivative is none
    radius = np.abs(np.linalg.eigvals(companions(found[finite]))).max(axis=1, initial=0.0)
    return points.take(finite), found[finite], radius


def _visited(model: Model, record: Record, free: bool) -> tuple[Points, Vector, tuple[str, ...]]:
    """Regressors of a free run, up to where it diverged, or measured ones; standard deviations of y; where that was."""
    response = model.simulate(record) if free else model.predict(record)
    pieces, measured, diverged, start = [], [], [], model.form.start
    for i, (e, t) in enumerate(zip(record.experiments, response.trajectories, strict=True)):
        assert t.measured is not None  # a record without outputs was refused
        outputs = np.concatenate([t.measured[:start], (t.model if free else t.measured)[start:]])
        run = replace(e, outputs=outputs).rows(None, t.diverged[0] + 1 if t.diverged else None)
        x = lag_matrix(run, model.form.layout, replace(record, outputs=model.outputs), start)
        pieces.append((x, np.full(len(x), i), np.arange(start, len(run))))
        measured.append(t.measured)
        diverged += [f"{t.diverged[1]} at experiment {i}, {e.where(t.diverged[0])}"] if t.diverged else []
    points = Points(*(np.concatenate(part) for part in zip(*pieces, strict=True)))
    return points, _positive(np.concatenate(measured).std(axis=0)), tuple(diverged)


def _positive(scale: Vector) -> Vector:
    return np.where(np.isfinite(scale) & (scale > 0), scale, 1.0)


def _evenly(count: int, most: int) -> Int[np.ndarray, "m"]:
    """At most `most` of `count` indices, spread evenly."""
    return np.arange(count) if count <= most else np.linspace(0, count - 1, most).round().astype(int)


def _sizes(t: Matrix, a: Float[np.ndarray, "m n n"]) -> Vector:
    """‖T A T⁻¹‖₂ of each matrix."""
    b = t @ a @ np.linalg.inv(t)
    return np.sqrt(np.linalg.eigvalsh(b.swapaxes(1, 2) @ b)[:, -1])


def _best_metric(a: Float[np.ndarray, "m n n"]) -> Matrix:
    """T (n, n) in which all of the matrices contract, or else as many as was reached; deterministic."""
    tried, some = [_metric(a)], a[:: -(-len(a) // 500)]
    shares = [np.mean(_sizes(tried[0], a) < 1)]
    for quantile in (1.0, 0.95, 0.8, 0.5) if shares[0] < 1 else ():
        sizes = _sizes(tried[int(np.argmax(shares))], some)
        new = [_metric(some[sizes <= np.quantile(sizes, quantile)])] if quantile < 1 else [*_lyapunov(a.mean(axis=0))]
        tried, shares = tried + new, shares + [np.mean(_sizes(t, a) < 1) for t in new]
    return tried[int(np.argmax(shares))]


def _metric(a: Float[np.ndarray, "m n n"]) -> Matrix:
    """T (n, n) with a small largest `‖T A T⁻¹‖₂`, close to the least."""
    n, bound, active = a.shape[1], np.abs(np.linalg.eigvals(a)).max(), _evenly(len(a), _ACTIVE)
    best = t = min([np.eye(n), *_lyapunov(a.mean(axis=0))], key=lambda t: _sizes(t, a).max())
    sizes, least = _sizes(t, a), max(_sizes(t, a).max(), 1e-9)
    for sharpness in (4, 8, 16, 32) if 1 < n <= _LARGEST_SEARCH else ():
        if (gap := np.log(least / max(bound, 1e-3 * least))) <= 0.06 * abs(np.log(least)):
            break  # the rest would cost overshoot
        active = np.union1d(active, np.argsort(-sizes, kind="stable")[:_ACTIVE])
        t = _descend(t @ a[active] @ np.linalg.inv(t), sharpness * np.log(n * len(active)) / gap) @ t
        sizes = _sizes(t := t / np.linalg.norm(t), a)
        best, least = (t, sizes.max()) if sizes.max() < least else (best, least)
    return best


def _lyapunov(mean: Matrix) -> Iterator[Matrix]:
    """Factors T of P = TᵀT with `(A/c)ᵀ P (A/c) − P = −I`, so that `‖A‖_P < c`, for some c above the radius of A."""
    radius = max(float(np.abs(np.linalg.eigvals(mean)).max()), 1e-3)
    for c in (radius**0.95, radius**0.8, radius**0.5, 1.1 * radius, 1.5 * radius):
        if c > radius:
            p = linalg.solve_discrete_lyapunov((mean / c).T, np.eye(len(mean)))
            values, vectors = np.linalg.eigh((p + p.T) / 2)
            if values[0] > 1e-14 * values[-1]:
                yield np.sqrt(values / values[-1])[:, None] * vectors.T


def _descend(a: Float[np.ndarray, "m n n"], sharpness: float) -> Matrix:
    """Y that lowers `log Σ σ^sharpness / sharpness`, over all singular values σ of all Y A Y⁻¹, from Y = I."""
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

    found = optimize.minimize(value, np.eye(n).ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 30})
    return np.asarray(found.x).reshape(n, n)


def _worst(model: Model, record: Record, points: Points, values: Vector) -> tuple[float | None, Place | None]:
    """The largest value and its point; None where no value is finite."""
    values = np.where(np.isfinite(values), values, -1.0)
    if values.max(initial=-1.0) < 0:
        return None, None
    i = int(np.argmax(values))
    number, row, size = int(points.experiment[i]), int(points.row[i]), float(values[i])
    regressor = {str(lag): float(v) for lag, v in zip(model.form.layout, points.x[i], strict=True)}
    if number < 0:
        return size, Place(None, None, "a point off the trajectory", regressor)
    return size, Place(number, row, f"experiment {number}, {record.experiments[number].where(row)}", regressor)


def _sentences(given: Stability) -> Iterator[tuple[str, bool]]:
    """What the checks say, sentence by sentence, and whether it is a warning."""
    found, contracts, factor, steepest = given.feedback, given.contraction, given.diverges_at, given.lipschitz.gradient
    gradient = "no finite gradient" if steepest is None else f"a gradient of at most {steepest:.4g}"
    yield f"The one-step predictor has {gradient} on measured rows; that says nothing about the free run.", False
    if found is None:
        yield "The model uses no past outputs: its free run cannot diverge, and keeps nothing of its start.", False
        return
    if found.diverged:
        yield f"The free run diverges ({'; '.join(found.diverged)}); it is looked at up to there.", True
    if found.share_above_one is not None:
        above = f"above 1 at {100 * found.share_above_one:.3g} % of {len(found.radius)} steps of the free run"
        peak = f"median {found.median:.4g}, largest {found.largest:.4g} at {found.worst}"
        yield f"The local spectral radius is {above}; {peak}.", found.share_above_one > 0.01
    if found.skipped:
        yield f"At {found.skipped} points more the model has no finite derivative; they are left out.", True
    if contracts is None:
        yield "Contraction could not be checked: no finite derivatives, or more than 200 past outputs.", True
    elif contracts.rate < 1:
        how = f"contracts in one metric (rate {contracts.rate:.4g}): evidence, not proof, that it forgets its start"
        yield f"On all {contracts.samples} sampled points the free run {how}.", False
    else:
        share = f"{100 * (1 - contracts.share):.3g} % of the {contracts.samples} sampled points"
        worst = f"worst at {contracts.worst}, rate {contracts.rate:.4g}"
        yield f"At {share} the free run does not contract in the best metric that was found, {worst}.", False
    stays, times = ("stays within", given.searched) if factor is None else ("leaves", factor)
    bounds = f"{stays} all bounds with the inputs' deviations from their means {times:.4g} times as large"
    yield f"The free run {bounds}.", factor is not None and factor < 1.5
