"""Does a model's free run stay bounded and forget its start? Evidence from sampled points, never a proof.

With `A_{k,i} = ∂g/∂y_{k−i}` (ny, ny) a small change of the past, `s_k = (δy_{k−1}, …, δy_{k−na})`, obeys
`s_{k+1} = A_k s_k` in a free run; the companion matrix A_k has the A_{k,i} in its first ny rows and shifts the rest.
Two checks look at A_k: its spectral radius at every step, and a quadratic norm in which all sampled A_k contract
(Lohmiller and Slotine, Automatica 34, 1998). A third runs the model on larger and larger inputs. The paper's
`cond:pred_stab` is another matter: it asks for the one-step predictor, whose past is measured; see `lipschitz`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from orthaug._arrays import Matrix, Vector, check_choice, check_count
from orthaug._jax import jax, jnp
from orthaug.learners import External
from orthaug.model import Model
from orthaug.predictor import Form, Numbers, parts
from orthaug.record import Record

_BATCH = 1024  # rows per compiled call
_STEPS = 20_000  # most rows that are looked at; longer records are sampled evenly
_SAMPLES, _STEEPEST = 2000, 50  # most points of the contraction check; those of largest radius always among them
_WORK = 4e7  # most rows times (na ny)³
_LONGEST_STATE, _LARGEST_SEARCH = 200, 12  # na ny with eigenvalues at all; with a metric better than Lyapunov's
_ACTIVE = 64  # worst points that a round of the search for a metric adds
_HUGE = 1e100  # a derivative beyond this is none
_ABOVE_ONE = 1 + 1e-6  # a radius between 1 and this is the rounding of a pole at 1
_DIFFERENCE = 1e-3  # step of differences for an external learner, in standard deviations; bears single precision
_LARGEST_FACTOR = 1e4  # outputs of a stable linear model grow with its inputs, and 10⁶ times the largest is "diverged"
_PER_STEP = ("points", "jacobians", "radius")  # too long for JSON


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
    """How m steps of a run depend on the past outputs; radii are None where no A_k could be computed."""

    points: Points
    jacobians: Float[np.ndarray, "m na ny ny"]
    """A_{k,i} = ∂g/∂y_{k−i} at [:, i − 1], in the outputs' units; na is the memory of the model."""
    radius: Vector
    """Spectral radius of A_k at each step (m,), and over the steps:"""
    largest: float | None
    median: float | None
    share_above_one: float | None
    worst: Place | None
    steps: int
    """Steps of the run; where they are more than m, the m are spread evenly over them."""
    skipped: int
    """Points left out because the model has no finite derivative there."""
    diverged: tuple[str, ...]
    """Output and place at which the free run of an experiment left all bounds."""


@dataclass(frozen=True, eq=False)
class Contraction:
    """The best norm that was found, `|s|_P = √(sᵀ P s)`, P (na ny)² for s = (y_{k−1}, …, y_{k−na}), up to a factor.

    While all points met have a rate below 1, two free runs under one input approach each other as
    `|s_k − s̃_k| ≤ overshoot · rateᵏ |s_0 − s̃_0|`, outputs in their standard deviations.
    """

    rate: float
    """Largest `‖A_k‖_P` over the samples; no norm has one below `bound`, the largest spectral radius."""
    bound: float
    share: float
    """Share of the samples, 0 to 1, with `‖A_k‖_P < 1`."""
    samples: int
    overshoot: float
    metric: Matrix
    worst: Place

    @property
    def text(self) -> str:
        if self.rate < 1:
            return (
                f"On all {self.samples} sampled points the free run contracts in one metric (rate {self.rate:.4g}): "
                "evidence, not proof, that it forgets its start."
            )
        return (
            f"At {_percent(1 - self.share)} of the {self.samples} sampled points the free run does not contract in the "
            f"best metric that was found, worst at {self.worst}, rate {self.rate:.4g}."
        )


@dataclass(frozen=True)
class Lipschitz:
    """Largest ‖∂g/∂x‖₂ and ‖∂φ/∂x‖₂ of the one-step predictor over measured rows; None where none is finite.

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
    """Evidence on the free run (None in a model without past outputs), and the one-step predictor apart from it.

    `diverges_at` is the factor of `divergence_scaling`, None where there is none up to `searched`.
    """

    feedback: Feedback | None
    contraction: Contraction | None
    diverges_at: float | None
    searched: float
    lipschitz: Lipschitz
    warnings: tuple[str, ...]
    text: str

    def as_dict(self) -> dict[str, Any]:
        """Plain content for JSON, without what is there for every step; never NaN or infinity."""
        return _plain(self)


def stability(model: Model, record: Record, *, box: int = 0, largest: float = 1024.0) -> Stability:
    """All checks of a model on a record, with a text that says what they mean.

    A free run that diverges is looked at up to the step at which it left all bounds. `box` is that of `contraction`,
    `largest` that of `divergence_scaling`.

    Raises:
        InputError: a record that does not fit the model, a `box` or a `largest` that are no such numbers.
    """
    _check_factor(largest)
    check_count(box, "box", 0)
    gradients = lipschitz(model, record)
    found = feedback(model, record)
    contracts = _contraction(model, record, found, box) if found else None
    factor = divergence_scaling(model, record, largest)
    text = "\n".join([*_free_run_lines(found, contracts, factor, largest), _gradient_line(gradients)])
    warnings = tuple(_warnings(found, contracts, factor)) if found else ()
    return Stability(found, contracts, factor, float(largest), gradients, warnings, text)


def feedback(model: Model, record: Record, *, along: str = "simulation") -> Feedback | None:
    """A_{k,i} = ∂g/∂y_{k−i} and the spectral radius of A_k along a run; None for a model without past outputs.

    At most 20000 steps, fewer where na ny is large and none where it is above 200, spread evenly. Radii below 1 do not
    make a nonlinear run stable, nor do some above 1 make it unstable: they say where to look.

    Args:
        model: the fitted model.
        record: inputs, and measured outputs to start from.
        along: "simulation", regressors of the model's own outputs, up to where it diverges, or "measured".

    Raises:
        InputError: a record that does not fit the model, or another `along`.
    """
    free = check_choice(along, ("simulation", "measured"), "`along`") == "simulation"
    if not model.form.memory:
        return None
    every, diverged = _simulated(model, record) if free else (_measured(model, record), ())
    size = model.form.memory * len(model.outputs)
    points = every.take(_evenly(len(every.x), 0 if size > _LONGEST_STATE else min(_STEPS, _WORK / size**3)))
    points, jacobians, radius, skipped = _linearised(model, points)
    largest, worst = _worst(model, record, points, radius)
    median, share = (float(np.median(radius)), float(np.mean(radius > _ABOVE_ONE))) if worst else (None, None)
    return Feedback(points, jacobians, radius, largest, median, share, worst, len(every.x), skipped, diverged)


def contraction(model: Model, record: Record, *, box: int = 0) -> Contraction | None:
    """The quadratic norm in which the free run contracts on as many of at most 2000 sampled points as was reached.

    Minimises `max_k ‖T A_k T⁻¹‖₂`, P = TᵀT. Along `T(t) = exp(tX) T`, X symmetric, the logarithm of each norm is convex
    in t with the slope `uᵀXu − vᵀXv`, u and v its singular vectors: there are no false minima. It starts from
    Lyapunov's P of the mean A_k and takes quasi-Newton steps on a smooth maximum over the worst points; where not all
    points contract, it does so again without the worst of them. None as for `feedback`.

    Args:
        model: the fitted model.
        record: inputs, and measured outputs to start from.
        box: that many points more, uniform in the box of the regressors that the free run meets.

    Raises:
        InputError: a record that does not fit the model, or a `box` that is no number of points.
    """
    box, found = check_count(box, "box", 0), feedback(model, record)
    return _contraction(model, record, found, box) if found else None


def divergence_scaling(model: Model, record: Record, largest: float = 1024.0) -> float | None:
    """Factor on the inputs from which the free run leaves all bounds (10⁶ times the largest training output).

    It scales each input's deviation from its mean over the record; the measured outputs that the run starts from stay.
    Doubled until a run diverges, then bisected to 5 %; what is returned did diverge. Only the first 20000 rows are
    used, and factors between those that were tried may diverge too. None where no run up to `largest` does, as without
    past outputs; at most 1 where the record's own run diverges, and 0 where it does with its inputs at their means.

    Raises:
        InputError: a record that does not fit the model, or a `largest` that is not above 1 and at most 10⁴.
    """
    _check_factor(largest)
    if not model.form.memory:
        return None
    record = _first_rows(record, model.form.start)
    mean = np.concatenate([e.inputs for e in record.experiments]).mean(axis=0)

    def diverges(factor: float) -> bool:
        scaled = (replace(e, inputs=mean + factor * (e.inputs - mean)) for e in record.experiments)
        run = model.simulate(replace(record, experiments=tuple(scaled)))
        return any(t.diverged for t in run.trajectories)

    low = high = 1.0
    if diverges(1.0):
        while diverges(low := low / 2 if low > 1 / _LARGEST_FACTOR else 0.0):
            high = low
            if low == 0:
                return 0.0
        low = low or high / 2
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
    of a finite memory. Here L is that of at most 20000 measured rows and of this θ; a polynomial has a larger one
    farther out, and the learner's weights are not in φ. Nothing of this speaks about the free run, whose memory does
    not end: y_k = 2 y_{k−1} fulfils the condition.

    Raises:
        InputError: a record that does not fit the model, or has no outputs.
    """
    every, form = _measured(model, record), model.form
    points, x_scale, y_scale = every.take(_evenly(len(every.x), _STEPS)), every.x.std(axis=0), _unit(model, record)
    with np.errstate(all="ignore"):
        phi = np.asarray(form.baseline.phi(points.x, form.layout, form.outputs, np))
        rms = np.sqrt(np.mean(np.sum((phi / y_scale[:, None]) ** 2, axis=1), axis=0))
    phi_scale = np.outer(y_scale, np.where(np.isfinite(rms) & (rms > 0), rms, 1.0)).ravel()
    found: list[Any] = []
    for gradients, scale in ((_gradients(model, points.x), y_scale), (_phi_gradients(model, points.x), phi_scale)):
        norms = [(_spectral(batch), _spectral(batch * x_scale / scale[:, None])) for batch in gradients]
        plain, scaled = (np.concatenate(column) for column in zip(*norms, strict=True))
        found += [_worst(model, record, points, plain)[0], *_worst(model, record, points, scaled)]
    return Lipschitz(*found, len(points.x))


@partial(jax.jit, static_argnames="form")
def _gradient_rows(form: Form, numbers: Numbers, x: Float[Array, "m nx"], step: Float[Array, "nx"]) -> Array:
    """∂g/∂x (m, ny, nx); by central differences of width `step` where the learner has no derivative."""

    def g(row: Any) -> Any:
        found = parts(form, numbers, row)
        return found.baseline + found.learner

    def differences(row: Any) -> Any:
        ahead, back = (jax.vmap(g)(row + sign * jnp.diag(step)) for sign in (1.0, -1.0))
        return ((ahead - back) / (2 * step[:, None])).T

    external = form.bound is not None and isinstance(form.bound.learner, External)
    return jax.vmap(differences if external else jax.jacrev(g))(x)


@partial(jax.jit, static_argnames="form")
def _phi_gradient_rows(form: Form, x: Float[Array, "m nx"]) -> Float[Array, "m ny nt nx"]:
    return jax.vmap(jax.jacfwd(lambda row: form.baseline.phi(row, form.layout, form.outputs, jnp)))(x)


def _gradients(model: Model, x: Matrix) -> Iterator[Any]:
    deviation = x.std(axis=0)
    step = jnp.asarray(_DIFFERENCE * np.where(deviation > 0, deviation, 1.0))
    return _batches(lambda rows: _gradient_rows(model.form, model.numbers, rows, step), x)


def _phi_gradients(model: Model, x: Matrix) -> Iterator[Any]:
    shape = (len(model.outputs) * len(model.theta), x.shape[1])
    return (
        batch.reshape(-1, *shape) if batch.size else np.zeros((len(batch), *shape))
        for batch in _batches(lambda rows: _phi_gradient_rows(model.form, rows), x)
    )


def _batches(function: Callable[[Any], Any], x: Matrix) -> Iterator[Any]:
    """`function` of batches of rows that all have one shape."""
    for begin in range(0, len(x), _BATCH):
        rows = x[begin : begin + _BATCH]
        padded = np.concatenate([rows, np.repeat(rows[-1:], _BATCH - len(rows), axis=0)])
        yield np.asarray(function(jnp.asarray(padded)))[: len(rows)]


def _spectral(matrices: Any) -> Vector:
    """‖·‖₂ of each matrix (m, r, c); NaN where one is not finite."""
    finite = (np.abs(matrices) < _HUGE).all(axis=(1, 2))
    found = np.full(len(matrices), np.nan)
    if matrices[0].size:
        found[finite] = np.linalg.norm(matrices[finite], 2, axis=(1, 2))
    return found


def companions(jacobians: Float[np.ndarray, "m na ny ny"]) -> Float[np.ndarray, "m n n"]:
    """Companion matrices, n = na ny, of A_{k,i} at [k, i − 1]; the state is (y_{k−1}, …, y_{k−na})."""
    m, na, ny, _ = jacobians.shape
    shift = np.broadcast_to(np.eye(na * ny)[: (na - 1) * ny], (m, (na - 1) * ny, na * ny))
    return np.concatenate([jacobians.swapaxes(1, 2).reshape(m, ny, na * ny), shift], axis=1)


def _linearised(model: Model, points: Points) -> tuple[Points, Float[np.ndarray, "m na ny ny"], Vector, int]:
    """The points with finite derivatives, their A_{k,i} and spectral radii, and how many points had none."""
    ny = len(model.outputs)
    found = np.zeros((len(points.x), model.form.memory, ny, ny))
    if len(found):
        gradients = np.concatenate(list(_gradients(model, points.x)))
        for column, (lag, output) in enumerate(model.form.fed_back):
            found[:, lag - 1, :, output] = gradients[:, :, column]
    finite = (np.abs(found) < _HUGE).all(axis=(1, 2, 3))
    found = found[finite]
    radius = np.abs(np.linalg.eigvals(companions(found))).max(axis=1, initial=0.0)
    return points.take(finite), found, radius, int(np.sum(~finite))


def _simulated(model: Model, record: Record) -> tuple[Points, tuple[str, ...]]:
    """Regressors of the free run, up to the step at which it diverged, and where that was."""
    own, diverged = [], []
    for i, (e, t) in enumerate(zip(record.experiments, model.simulate(record).trajectories, strict=True)):
        assert t.measured is not None  # a run from measured outputs was refused without them
        outputs = np.concatenate([t.measured[: t.start], t.model[t.start :]])
        own.append(replace(e, outputs=outputs).rows(None, t.diverged[0] + 1 if t.diverged else None))
        if t.diverged:
            diverged.append(f"{t.diverged[1]} at {_where(record, i, t.diverged[0])}")
    return _points(model, replace(record, outputs=model.outputs, experiments=tuple(own))), tuple(diverged)


def _measured(model: Model, record: Record) -> Points:
    model.predict(record)  # refuses a record that does not fit
    return _points(model, record)


def _points(model: Model, record: Record) -> Points:
    """The regressor of every usable row."""
    start, experiments = model.form.start, record.experiments
    x = np.concatenate([lag_matrix(e, model.form.layout, record, start) for e in experiments])
    number = np.repeat(np.arange(len(experiments)), [len(e) - start for e in experiments])
    return Points(x, number, np.concatenate([np.arange(start, len(e)) for e in experiments]))


def _evenly(count: int, most: float) -> Int[np.ndarray, "m"]:
    """At most `most` of `count` indices, spread evenly."""
    return np.arange(count) if count <= most else np.linspace(0, count - 1, int(most)).round().astype(int)


def _unit(model: Model, record: Record) -> Vector:
    """Standard deviation of each output of the model over a record; 1 for one that does not move."""
    place = [[c.name for c in record.outputs].index(c.name) for c in model.outputs]
    deviation = np.concatenate([e.outputs for e in record.experiments])[:, place].std(axis=0)
    return np.where(deviation > 0, deviation, 1.0)


def _contraction(model: Model, record: Record, found: Feedback, box: int) -> Contraction | None:
    if not found.worst:
        return None
    unit = np.tile(_unit(model, record), model.form.memory)
    most = min(_SAMPLES, int(_WORK / len(unit) ** 3))
    steepest = np.argsort(-found.radius, kind="stable")[: min(_STEEPEST, most // 2)]
    points = found.points.take(np.union1d(_evenly(len(found.radius), most - len(steepest)), steepest))
    if box:
        low, high, nowhere = found.points.x.min(axis=0), found.points.x.max(axis=0), np.full(box, -1)
        more = np.random.default_rng(0).uniform(low, high, (box, len(low)))  # the same points on every call
        points = Points(*(np.concatenate(p) for p in zip(points, (more, nowhere, nowhere), strict=True)))
    points, jacobians, _, _ = _linearised(model, points)
    a = companions(jacobians) * unit / unit[:, None]
    t = _best_metric(a)
    sizes, metric = _sizes(t, a), (t / unit).T @ (t / unit)
    rate, worst = _worst(model, record, points, sizes)
    assert rate is not None and worst is not None
    bound, share = float(np.abs(np.linalg.eigvals(a)).max()), float(np.mean(sizes < 1))
    return Contraction(rate, bound, share, len(a), float(np.linalg.cond(t)), metric / np.trace(metric), worst)


def _sizes(t: Matrix, a: Float[np.ndarray, "m n n"]) -> Vector:
    """‖T A T⁻¹‖₂ of each matrix."""
    return np.linalg.norm(t @ a @ np.linalg.inv(t), 2, axis=(1, 2))


def _best_metric(a: Float[np.ndarray, "m n n"]) -> Matrix:
    """T (n, n) in which all of the matrices contract, or else as many as was reached; deterministic."""
    best = _metric(a)
    if _sizes(best, a).max() < 1:
        return best
    best = max([best, *_lyapunov(a.mean(axis=0))], key=lambda t: np.mean(_sizes(t, a) < 1))
    for quantile in (0.95, 0.8, 0.5):
        sizes = _sizes(best, a)
        t = _metric(a[sizes <= np.quantile(sizes, quantile)])
        best = max(best, t, key=lambda t: np.mean(_sizes(t, a) < 1))
    return best


def _metric(a: Float[np.ndarray, "m n n"]) -> Matrix:
    """T (n, n) with a small largest `‖T A T⁻¹‖₂`, close to the least."""
    n, bound = a.shape[1], np.abs(np.linalg.eigvals(a)).max()
    best = min([np.eye(n), *_lyapunov(a.mean(axis=0))], key=lambda t: _sizes(t, a).max())
    active = np.zeros(len(a), dtype=bool)
    for sharpness in (2, 4, 8, 16, 32) if 1 < n <= _LARGEST_SEARCH else ():
        sizes = _sizes(best, a)
        largest = max(sizes.max(), 1e-9)
        gap = np.log(largest / max(bound, 1e-3 * largest))
        if gap <= 0.05 * abs(np.log(largest)):  # the rest would cost overshoot
            break
        active[np.argsort(-sizes, kind="stable")[:_ACTIVE]] = True
        t = _descend(best @ a[active] @ np.linalg.inv(best), sharpness * np.log(n * active.sum()) / gap) @ best
        best = min(best, t / np.linalg.norm(t), key=lambda t: _sizes(t, a).max())
    return best


def _lyapunov(mean: Matrix) -> Iterator[Matrix]:
    """Factors T of P = TᵀT with `(A/c)ᵀ P (A/c) − P = −I`, so that `‖A‖_P < c`, for some c above the radius of A."""
    radius = max(float(np.abs(np.linalg.eigvals(mean)).max()), 1e-3)
    for c in (radius**0.95, radius**0.8, radius**0.5, 1.1 * radius, 1.5 * radius):
        if c > radius:
            p = scipy.linalg.solve_discrete_lyapunov((mean / c).T, np.eye(len(mean)))
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
        inverse = np.linalg.inv(y)
        b = y @ a @ inverse
        squares, v = np.linalg.eigh(b.swapaxes(1, 2) @ b)
        squares = np.maximum(squares, 1e-200)
        logarithms = sharpness * np.log(squares) / 2
        top, u = logarithms.max(), b @ v
        weight = np.exp(logarithms - top)
        total, weight = weight.sum(), weight / weight.sum()
        left, right = (
            np.einsum("mij,mj,mkj->ik", q, w, q, optimize=True) for q, w in ((u, weight / squares), (v, weight))
        )
        return (top + np.log(total)) / sharpness, ((left - right) @ inverse.T).ravel()

    found = scipy.optimize.minimize(value, np.eye(n).ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 40})
    return np.asarray(found.x).reshape(n, n)


def _first_rows(record: Record, start: int) -> Record:
    """The first rows of a record, whole experiments and a piece of one; at least one row after the lags."""
    kept: list[Experiment] = []
    left = max(_STEPS, start + 1)
    for e in record.experiments:
        if left > start:
            kept.append(e.rows(None, left))
            left -= len(e)
    return replace(record, experiments=tuple(kept))


def _check_factor(largest: float) -> None:
    if not 1 < check_number(largest, "largest", positive=True) <= _LARGEST_FACTOR:
        raise InputError(f"`largest` must be a factor above 1 and at most {_LARGEST_FACTOR:g}; got {largest!r}.")


def _worst(model: Model, record: Record, points: Points, values: Vector) -> tuple[float | None, Place | None]:
    """The largest value and its point; None where no value is finite."""
    if not np.isfinite(values).any():
        return None, None
    i = int(np.nanargmax(values))
    number, row = int(points.experiment[i]), int(points.row[i])
    regressor = {str(lag): float(v) for lag, v in zip(model.form.layout, points.x[i], strict=True)}
    if number < 0:
        return float(values[i]), Place(None, None, "a point off the trajectory", regressor)
    return float(values[i]), Place(number, row, _where(record, number, row), regressor)


def _where(record: Record, number: int, row: int) -> str:
    e = record.experiments[number]
    return e.where(row) if e.source or len(record.experiments) == 1 else f"experiment {number}, {e.where(row)}"


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return list(value)
    if hasattr(value, "__dataclass_fields__"):
        return {name: _plain(v) for name, v in value.__dict__.items() if name not in _PER_STEP}
    return value.tolist() if isinstance(value, np.ndarray) else value


def _free_run_lines(
    found: Feedback | None, contracts: Contraction | None, factor: float | None, largest: float
) -> Iterator[str]:
    if not found:
        yield "The model uses no past outputs: its free run cannot diverge, and keeps nothing of its start."
        return
    if found.diverged:
        yield f"The free run diverges ({'; '.join(found.diverged)}); looked at up to there."
    if found.worst:
        yield (
            f"Free run of {found.steps} steps, {len(found.radius)} looked at: local spectral radius {found.median:.4g} "
            f"in the median and at most {found.largest:.4g}, at {found.worst}; above 1 at "
            f"{_percent(found.share_above_one or 0.0)} of the steps."
        )
    if contracts:
        yield contracts.text
    how, times = ("stays within", largest) if factor is None else ("leaves", factor)
    yield f"It {how} all bounds with the inputs' deviations from their means {times:.3g} times as large."


def _gradient_line(found: Lipschitz) -> str:
    largest = "has no finite gradient" if found.gradient is None else f"gradient at most {found.gradient:.4g}"
    return (
        f"One-step predictor, which remembers only its lags: {largest} on {found.rows} measured rows. That bears on "
        "predictions from measured outputs and says nothing about the free run."
    )


def _warnings(found: Feedback, contracts: Contraction | None, factor: float | None) -> Iterator[str]:
    share = found.share_above_one or 0.0
    if found.diverged:
        yield f"the free run diverges: {'; '.join(found.diverged)}."
    elif factor is not None and factor < 1.5:
        yield f"the free run diverges with inputs only {factor:.3g} times as large; do not use it beyond its data."
    if share > 0.01:
        yield f"the local spectral radius is above 1 at {_percent(share)} of the steps."
    if contracts is None:
        yield "contraction could not be checked: no finite derivatives, or more than 200 past outputs."
    elif contracts.rate >= 1:
        yield f"contraction was not found: not at {_percent(1 - contracts.share)} of the sampled points."
    if found.skipped:
        yield f"at {found.skipped} points of the free run the model has no finite derivative; they are left out."
