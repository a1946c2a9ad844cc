"""Does a model's free run stay bounded and forget its start? Evidence from sampled points, never a proof.

With `A_{k,i} = ∂g/∂y_{k−i}` (ny, ny) a small change of the past, `s_k = (δy_{k−1}, …, δy_{k−na})`, obeys
`s_{k+1} = A_k s_k` in a free run, where the companion matrix A_k has the A_{k,i} in its first ny rows and shifts the
rest. Two checks look at A_k: its spectral radius, step by step, and a quadratic norm in which all sampled A_k contract
(Lohmiller and Slotine, Automatica 1998). A third runs the model on larger and larger inputs.

The paper's `cond:pred_stab` is another matter: it asks for the one-step predictor, whose past is measured; `lipschitz`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Array, Float, Int

from orthaug._arrays import Matrix, Vector, check_choice, check_count, check_number
from orthaug._jax import jax, jnp
from orthaug.errors import InputError
from orthaug.learners import External
from orthaug.model import Model
from orthaug.predictor import Form, Numbers, parts
from orthaug.record import Experiment, Record
from orthaug.regressors import lag_matrix

_BATCH = 1024  # rows per compiled call
_STEPS = 20_000  # most rows that are looked at; longer trajectories are sampled evenly
_SAMPLES = 2000  # most points of the contraction check
_STEEPEST = 50  # points of largest spectral radius that are always among them
_WORK = 4e7  # most rows times (na ny)³
_LONGEST_STATE = 200  # na ny beyond which no eigenvalues are computed
_LARGEST_SEARCH = 12  # na ny beyond which the metric is Lyapunov's and not improved
_ACTIVE = 64  # points that a round of the search adds, the worst ones
_ROUNDS = 6
_ABOVE_ONE = 1e-6  # a spectral radius beyond 1 by less is the rounding of a pole at 1
_DIFFERENCE = 1e-3  # step of differences of an external learner, in standard deviations; bears single precision
_LARGEST_FACTOR = 1e4  # the outputs of a stable linear model grow with the inputs; 10⁶ times the largest is "diverged"
_CLOSE = 1.05  # the factor at which a run diverges is known up to this
_SMALL_MARGIN = 1.5
_MANY = 0.01


@dataclass(frozen=True)
class Place:
    """A point of a record: number of the experiment and row in it (None off the trajectory), and the regressor."""

    experiment: int | None
    row: int | None
    where: str
    """As messages name it: the line of a file, where there is one."""
    regressor: dict[str, float]
    """Value of each lag, `y[k-1]` and so on, in the channels' units."""

    def __str__(self) -> str:
        return f"{self.where} ({', '.join(f'{name} = {value:.4g}' for name, value in self.regressor.items())})"

    def as_dict(self) -> dict[str, Any]:
        return {**self.__dict__, "regressor": dict(self.regressor)}


class _Points(NamedTuple):
    """Regressors x (m, nx) with the experiment and the row of each; -1 for points that are on none."""

    x: Matrix
    experiment: Int[np.ndarray, "m"]
    row: Int[np.ndarray, "m"]

    def take(self, which: Any) -> _Points:
        return _Points(self.x[which], self.experiment[which], self.row[which])


@dataclass(frozen=True, eq=False)
class Feedback:
    """How each looked-at step of a run depends on its past outputs; m steps, na the memory of the model."""

    points: _Points
    jacobians: Float[np.ndarray, "m na ny ny"]
    """A_{k,i} = ∂g/∂y_{k−i} at [:, i − 1], in the outputs' units."""
    radius: Vector
    """Spectral radius of the companion matrix of each step, (m,)."""
    steps: int
    """Steps of the run; where they are more than m, the m are spread evenly over them."""
    skipped: int
    """Points left out because the model has no finite derivative there."""
    worst: Place | None

    @property
    def companions(self) -> Float[np.ndarray, "m n n"]:
        """Companion matrices, n = na ny, of the state (y_{k−1}, …, y_{k−na})."""
        return _companions(self.jacobians)

    @property
    def largest(self) -> float | None:
        """The largest spectral radius; None where there is none."""
        return float(self.radius.max()) if len(self.radius) else None

    @property
    def median(self) -> float | None:
        return float(np.median(self.radius)) if len(self.radius) else None

    @property
    def share_above_one(self) -> float | None:
        """Share of the steps, 0 to 1, whose spectral radius is above 1."""
        return float(np.mean(self.radius > 1 + _ABOVE_ONE)) if len(self.radius) else None

    def as_dict(self) -> dict[str, Any]:
        return {
            "steps": self.steps,
            "looked_at": len(self.radius),
            "skipped": self.skipped,
            "largest_radius": self.largest,
            "median_radius": self.median,
            "share_above_one": self.share_above_one,
            "worst": self.worst.as_dict() if self.worst else None,
        }


@dataclass(frozen=True, eq=False)
class Contraction:
    """The best quadratic norm that was found, `|s|_P = √(sᵀ P s)`: by how much each sampled step shrinks it.

    While all points met have a rate below 1, two free runs under one input approach each other as
    `|s_k − s̃_k| ≤ overshoot · rateᵏ |s_0 − s̃_0|`, outputs in their standard deviations.
    """

    rate: float
    """Largest `‖A_k‖_P` over the samples."""
    share: float
    """Share of the samples, 0 to 1, with `‖A_k‖_P < 1`."""
    samples: int
    bound: float
    """Largest spectral radius over the samples: no norm has a smaller rate."""
    overshoot: float
    """Square root of the condition number of P."""
    metric: Matrix
    """P (na ny, na ny) for the state (y_{k−1}, …, y_{k−na}), up to a factor."""
    worst: Place

    @property
    def found(self) -> bool:
        """Whether all samples contract."""
        return self.rate < 1

    @property
    def text(self) -> str:
        if self.found:
            return (
                f"On all {self.samples} sampled points the free run contracts in one metric (rate {self.rate:.4g}): "
                "evidence, not proof, that it forgets its start."
            )
        return (
            f"No metric was found in which the free run contracts on all {self.samples} sampled points: at "
            f"{_percent(1 - self.share)} of them it does not, worst at {self.worst}, rate {self.rate:.4g}."
        )

    def as_dict(self) -> dict[str, Any]:
        plain = {**self.__dict__, "metric": self.metric.tolist(), "worst": self.worst.as_dict()}
        return {**plain, "found": self.found, "text": self.text}


@dataclass(frozen=True)
class Lipschitz:
    """Largest gradients of the one-step predictor over measured rows; None where there is no finite one.

    `gradient` is the largest ‖∂g/∂x‖₂ (ny, nx), in output units per regressor unit, and `phi` the largest ‖∂φ/∂x‖₂,
    with (ny nθ) rows. Scaled: each regressor and output in its standard deviation, each column of φ in its RMS.
    """

    gradient: float | None
    gradient_scaled: float | None
    worst: Place | None
    """Of the scaled gradient."""
    phi: float | None
    phi_scaled: float | None
    phi_worst: Place | None
    rows: int

    def as_dict(self) -> dict[str, Any]:
        places = {name: p.as_dict() if (p := getattr(self, name)) else None for name in ("worst", "phi_worst")}
        return {**self.__dict__, **places}


@dataclass(frozen=True, eq=False)
class Stability:
    """Evidence on the free run (None in a model without past outputs), and the one-step predictor apart from it."""

    feedback: Feedback | None
    contraction: Contraction | None
    diverges_at: float | None
    """Factor on the inputs' deviations from their means from which the free run leaves all bounds; None up to
    `searched`."""
    searched: float
    diverged: tuple[str, ...]
    """Where and in which output the free run of the record itself left all bounds, per experiment that did."""
    lipschitz: Lipschitz
    warnings: tuple[str, ...]
    text: str

    def as_dict(self) -> dict[str, Any]:
        """Plain content for JSON; never NaN or infinity."""
        return {
            "feedback": self.feedback.as_dict() if self.feedback else None,
            "contraction": self.contraction.as_dict() if self.contraction else None,
            "diverges_at": self.diverges_at,
            "searched": self.searched,
            "diverged": list(self.diverged),
            "lipschitz": self.lipschitz.as_dict(),
            "warnings": list(self.warnings),
            "text": self.text,
        }


def stability(model: Model, record: Record, *, box: int = 0, largest: float = 1024.0) -> Stability:
    """All checks of a model on a record, with a text that says what they mean.

    A free run that diverges is looked at up to the step at which it left all bounds.

    Args:
        model: the fitted model.
        record: measured inputs and outputs; its free run starts from the measured outputs.
        box: points for the contraction check besides the trajectory, see `contraction`.
        largest: factor on the inputs up to which divergence is searched, see `divergence_scaling`.

    Raises:
        InputError: a record that does not fit the model, a `box` or a `largest` that are no such numbers.
    """
    largest, box = _checked_factor(largest), check_count(box, "box", 0)
    gradients = lipschitz(model, record)
    if not model.form.memory:
        text = "The model uses no past outputs: its free run cannot diverge, and keeps nothing of its start.\n"
        return Stability(None, None, None, largest, (), gradients, (), text + _gradient_text(gradients))
    found, diverged = _feedback(model, record, "simulation")
    contracts = _contraction(model, record, found, box)
    factor = divergence_scaling(model, record, largest)
    warnings = tuple(_warnings(found, contracts, factor, diverged))
    text = "\n".join(_lines(found, contracts, factor, largest, diverged) + [_gradient_text(gradients)])
    return Stability(found, contracts, factor, largest, diverged, gradients, warnings, text)


def feedback(model: Model, record: Record, *, along: str = "simulation") -> Feedback | None:
    """Local Jacobians A_{k,i} = ∂g/∂y_{k−i} and the spectral radius of their companion matrix, along a run.

    At most 20000 steps, fewer where na ny is large, spread evenly. A radius below 1 at every step does not make a
    time-varying or nonlinear run stable, nor does one above 1 make it unstable: it says where to look.

    Args:
        model: the fitted model.
        record: inputs, and measured outputs to start from.
        along: "simulation", regressors of the model's own outputs, up to where it diverges, or "measured".

    Returns:
        None for a model without past outputs; no radius (m = 0) where na ny is above 200.

    Raises:
        InputError: a record that does not fit the model, or another `along`.
    """
    check_choice(along, ("simulation", "measured"), "`along`")
    return _feedback(model, record, along)[0] if model.form.memory else None


def contraction(model: Model, record: Record, *, box: int = 0) -> Contraction | None:
    """The quadratic norm in which the free run contracts on as many sampled points as could be reached.

    Minimises `max_k ‖T A_k T⁻¹‖₂`, P = TᵀT. Along `T(t) = exp(tX) T` with X symmetric the logarithm of each norm is
    convex in t, with the derivative `uᵀXu − vᵀXv` for the singular vectors u, v: there are no false minima. It starts
    from Lyapunov's P of the mean A_k and takes quasi-Newton steps on a smooth maximum over the worst points.

    Args:
        model: the fitted model.
        record: inputs, and measured outputs to start from.
        box: that many points more, uniform in the box of the regressors met by the free run.

    Returns:
        None for a model without past outputs, or where no A_k could be computed.

    Raises:
        InputError: a record that does not fit the model, or a `box` that is no number of points.
    """
    found = feedback(model, record)
    return _contraction(model, record, found, check_count(box, "box", 0)) if found else None


def divergence_scaling(model: Model, record: Record, largest: float = 1024.0) -> float | None:
    """Factor on the inputs from which the free run leaves all bounds (10⁶ times the largest training output).

    It scales each input's deviation from its mean over the record; the measured outputs that the run starts from stay.
    Doubled until a run diverges, then bisected to 5 %; what is returned diverged. The first 20000 rows are used. An
    answer between the factors that were tried is not excluded, nor another input that diverges below it.

    Returns:
        None where no run up to `largest` diverged, as for a model without past outputs; below 1 where the record's own
        run diverges, 0 where it does so with inputs at rest.

    Raises:
        InputError: a record that does not fit the model, or a `largest` outside 1 to 10⁴.
    """
    largest = _checked_factor(largest)
    if not model.form.memory:
        return None
    record = _first_rows(record, model.form.start, _STEPS)
    mean = np.concatenate([e.inputs for e in record.experiments]).mean(axis=0)

    def diverges(factor: float) -> bool:
        scaled = (replace(e, inputs=mean + factor * (e.inputs - mean)) for e in record.experiments)
        run = model.simulate(replace(record, experiments=tuple(scaled)))
        return any(t.diverged for t in run.trajectories)

    low, high = 0.0, 1.0
    if diverges(1.0):
        if diverges(0.0):
            return 0.0
        while high > 1 / largest and diverges(high / 2):
            high /= 2
        if high <= 1 / largest:
            return high
        low = high / 2
    else:
        while not diverges(min(2 * high, largest)):
            high = min(2 * high, largest)
            if high >= largest:
                return None
        low, high = high, min(2 * high, largest)
    while high > _CLOSE * low:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if diverges(middle) else (middle, high)
    return high


def lipschitz(model: Model, record: Record) -> Lipschitz:
    """Gradients of the one-step predictor, g and ∂g/∂θ = φ, over measured regressors (`cond:pred_stab`).

    The predictor γ_k = g(x_k) reads the last n samples only. If ‖∂g/∂x‖ ≤ L on a convex set that holds all regressors,
    `|γ − γ̃| ≤ L Σ_{i≥k−n} (|u_i − ũ_i| + |y_i − ỹ_i|) ≤ L λ⁻ⁿ Γ_k` for every λ in (0, 1), because λ^{k−i} ≥ λⁿ there:
    the condition holds with `C = max(L λ⁻ⁿ, |g(0)|)`, and for ∂γ/∂θ likewise with the gradient of φ. So bounded
    gradients are all that it asks of a finite memory. The numbers here are L on at most 20000 measured rows: a
    polynomial has a larger one farther out, and other θ or the learner's own weights have others. None of this speaks
    about the free run, whose memory does not end: y_k = 2 y_{k−1} fulfils the condition.

    Raises:
        InputError: a record that does not fit the model, or has no outputs.
    """
    form = model.form
    model.predict(record)  # refuses a record that does not fit
    y_scale, every = _deviation(model, record), _measured(model, record)
    points, x_scale = every.take(_evenly(len(every.x), _STEPS)), every.x.std(axis=0)
    with np.errstate(all="ignore"):
        phi = np.asarray(form.baseline.phi(points.x, form.layout, form.outputs, np)) / y_scale[:, None]
        rms = np.sqrt(np.nanmean(np.sum(phi**2, axis=1), axis=0))
    phi_scale = y_scale[:, None] * np.where(np.isfinite(rms) & (rms > 0), rms, 1.0)  # (ny, nθ)
    gradient, gradient_scaled = _norms(_gradients(model, points.x), y_scale, x_scale)
    curvature, curvature_scaled = _norms(_phi_gradients(model, points.x), phi_scale.ravel(), x_scale)
    return Lipschitz(
        _peak(gradient),
        _peak(gradient_scaled),
        _place(model, record, points, gradient_scaled),
        _peak(curvature),
        _peak(curvature_scaled),
        _place(model, record, points, curvature_scaled),
        len(points.x),
    )


@partial(jax.jit, static_argnames="form")
def _gradient_rows(
    form: Form, numbers: Numbers, x: Float[Array, "m nx"], step: Float[Array, "nx"]
) -> Float[Array, "m ny nx"]:
    """∂g/∂x of every row; by central differences of width `step` where a learner has no derivative."""

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
    rows = len(model.outputs) * len(model.theta)
    found = _batches(lambda batch: _phi_gradient_rows(model.form, batch), x)
    return (batch.reshape(len(batch), rows, x.shape[1]) for batch in found)


def _batches(function: Callable[[Any], Any], x: Matrix) -> Iterator[Any]:
    """`function` of batches of rows that all have one shape."""
    for begin in range(0, len(x), _BATCH):
        rows = x[begin : begin + _BATCH]
        padded = np.concatenate([rows, np.repeat(rows[-1:], _BATCH - len(rows), axis=0)])
        yield np.asarray(function(jnp.asarray(padded)))[: len(rows)]


def _norms(gradients: Iterator[Any], row_scale: Vector, x_scale: Vector) -> tuple[Vector, Vector]:
    """Spectral norms of matrices in batches (m, rows, nx), as they are and scaled; NaN where one is not finite."""
    plain, scaled = [], []
    for batch in gradients:
        plain.append(_spectral(batch))
        scaled.append(_spectral(batch * x_scale / row_scale[:, None]))
    return np.concatenate(plain), np.concatenate(scaled)


def _spectral(matrices: Any) -> Vector:
    """‖·‖₂ of each matrix (m, r, c); NaN where one is not finite."""
    finite = np.isfinite(matrices).all(axis=(1, 2))
    found = np.full(len(matrices), np.nan)
    if min(matrices.shape[1:]):
        found[finite] = np.linalg.norm(matrices[finite], 2, axis=(1, 2))
    return found


def _feedback(model: Model, record: Record, along: str) -> tuple[Feedback, tuple[str, ...]]:
    """With where the free run left all bounds."""
    form, ny = model.form, len(model.outputs)
    diverged: tuple[str, ...] = ()
    if along == "simulation":
        every, diverged = _simulated(model, record)
    else:
        model.predict(record)  # refuses a record that does not fit
        every = _measured(model, record)
    size = form.memory * ny
    allowed = 0 if size > _LONGEST_STATE else int(min(_STEPS, _WORK / size**3))
    points = every.take(_evenly(len(every.x), allowed))
    jacobians = _jacobians(model, points.x)
    finite = np.isfinite(jacobians).all(axis=(1, 2, 3))
    points, jacobians = points.take(finite), jacobians[finite]
    radius = np.abs(np.linalg.eigvals(_companions(jacobians))).max(axis=1, initial=0.0)
    worst = _place(model, record, points, radius)
    return Feedback(points, jacobians, radius, len(every.x), int(np.sum(~finite)), worst), diverged


def _jacobians(model: Model, x: Matrix) -> Float[np.ndarray, "m na ny ny"]:
    """A_{k,i} at regressors (m, nx)."""
    found = np.zeros((len(x), model.form.memory, len(model.outputs), len(model.outputs)))
    if len(x):
        gradients = np.concatenate(list(_gradients(model, x)))
        for column, (lag, output) in enumerate(model.form.fed_back):
            found[:, lag - 1, :, output] = gradients[:, :, column]
    return found


def _companions(jacobians: Float[np.ndarray, "m na ny ny"]) -> Float[np.ndarray, "m n n"]:
    m, na, ny, _ = jacobians.shape
    shift = np.broadcast_to(np.eye(na * ny, k=-ny)[ny:], (m, (na - 1) * ny, na * ny))
    return np.concatenate([jacobians.swapaxes(1, 2).reshape(m, ny, na * ny), shift], axis=1)


def _simulated(model: Model, record: Record) -> tuple[_Points, tuple[str, ...]]:
    """Regressors of the free run, up to the step at which it diverged, and where that was."""
    experiments, stops, diverged = [], [], []
    for e, t in zip(record.experiments, model.simulate(record).trajectories, strict=True):
        assert t.measured is not None  # a model without past outputs does not come here
        experiments.append(replace(e, outputs=np.concatenate([t.measured[: t.start], t.model[t.start :]])))
        stops.append(t.diverged[0] + 1 if t.diverged else len(e))
        if t.diverged:
            diverged.append(f"output {t.diverged[1]} at {_where(record, len(stops) - 1, t.diverged[0])}")
    return _measured(model, replace(record, outputs=model.outputs, experiments=tuple(experiments)), stops), (*diverged,)


def _measured(model: Model, record: Record, stops: list[int] | None = None) -> _Points:
    """Regressors of a record's rows, of each experiment up to its stop."""
    form, stops = model.form, stops or [len(e) for e in record.experiments]
    pieces = [
        (lag_matrix(e.rows(None, stop), form.layout, record, form.start), i, np.arange(form.start, stop))
        for i, (e, stop) in enumerate(zip(record.experiments, stops, strict=True))
    ]
    x, row = np.concatenate([p[0] for p in pieces]), np.concatenate([p[2] for p in pieces])
    return _Points(x, np.repeat([p[1] for p in pieces], [len(p[2]) for p in pieces]), row)


def _evenly(count: int, most: int) -> Int[np.ndarray, "m"]:
    """At most `most` of `count` indices, spread evenly, the first and the last among them."""
    return np.arange(count) if count <= most else np.linspace(0, count - 1, most).round().astype(int)


def _contraction(model: Model, record: Record, found: Feedback, box: int) -> Contraction | None:
    if not len(found.radius):
        return None
    most = int(min(_SAMPLES, _WORK / len(found.companions[0]) ** 3))
    steepest = np.argsort(-found.radius, kind="stable")[: min(_STEEPEST, most // 2)]
    points = found.points.take(np.union1d(_evenly(len(found.radius), most - len(steepest)), steepest))
    if box:
        low, high = found.points.x.min(axis=0), found.points.x.max(axis=0)
        more = np.random.default_rng(0).uniform(low, high, (box, len(low)))  # the same points on every call
        nowhere = np.full(box, -1)
        points = _Points(*(np.concatenate(p) for p in zip(points, (more, nowhere, nowhere), strict=True)))
    jacobians = _jacobians(model, points.x)
    finite = np.isfinite(jacobians).all(axis=(1, 2, 3))
    points, a = points.take(finite), _companions(jacobians[finite])
    unit = np.tile(_deviation(model, record), model.form.memory)
    a = a * unit / unit[:, None]
    radius = np.abs(np.linalg.eigvals(a)).max(axis=1)
    t = _metric(a, radius)
    stable = radius < 1
    if _sizes(t, a).max() >= 1 and 0 < stable.sum() < len(a):  # no norm contracts where the radius is above 1
        t = max(t, _metric(a[stable], radius[stable]), key=lambda t: np.mean(_sizes(t, a) < 1))
    sizes, metric = _sizes(t, a), (t / unit).T @ (t / unit)
    worst = _place(model, record, points, sizes)
    assert worst is not None
    rate, share, overshoot = float(sizes.max()), float(np.mean(sizes < 1)), float(np.linalg.cond(t))
    return Contraction(rate, share, len(a), float(radius.max()), overshoot, metric / np.trace(metric), worst)


def _sizes(t: Matrix, a: Float[np.ndarray, "m n n"]) -> Vector:
    """‖T A T⁻¹‖₂ of each matrix."""
    return np.linalg.norm(t @ a @ np.linalg.inv(t), 2, axis=(1, 2))


def _metric(a: Float[np.ndarray, "m n n"], radius: Vector) -> Matrix:
    """T (n, n) with a small largest `‖T A T⁻¹‖₂`; deterministic."""
    n = a.shape[1]
    best = min([np.eye(n), *_lyapunov(a.mean(axis=0))], key=lambda t: _sizes(t, a).max())
    if n == 1 or n > _LARGEST_SEARCH:
        return best
    active = np.zeros(len(a), dtype=bool)
    for sharpness in 2.0 ** np.arange(1, _ROUNDS + 1):
        sizes = _sizes(best, a)
        gap = np.log(sizes.max() / max(radius.max(), 1e-3 * sizes.max())) if sizes.max() > 0 else 0.0
        if gap < 0.01 * abs(np.log(sizes.max())) + 1e-12:
            break
        active[np.argsort(-sizes, kind="stable")[:_ACTIVE]] = True
        t = _descend(best @ a[active] @ np.linalg.inv(best), sharpness * np.log(n * active.sum()) / gap) @ best
        best = min(best, t / np.linalg.norm(t), key=lambda t: _sizes(t, a).max())
    return best


def _lyapunov(mean: Matrix) -> Iterator[Matrix]:
    """Factors T of P = TᵀT with `(A/c)ᵀ P (A/c) − P = −I`, so that `‖A‖_P < c`, for some c above the radius of A."""
    radius = max(float(np.abs(np.linalg.eigvals(mean)).max()), 1e-3)
    for c in (radius**0.9, radius**0.5, 1.1 * radius, 1.5 * radius):
        if c > radius:
            p = scipy.linalg.solve_discrete_lyapunov((mean / c).T, np.eye(len(mean)))
            values, vectors = np.linalg.eigh((p + p.T) / 2)
            if np.isfinite(values).all() and values[0] > 1e-14 * values[-1]:
                yield np.sqrt(values / values[-1])[:, None] * vectors.T


def _descend(a: Float[np.ndarray, "m n n"], sharpness: float) -> Matrix:
    """Y that lowers `log Σ σ^sharpness / sharpness`, over all singular values σ of all Y A Y⁻¹, from Y = I."""
    n = a.shape[1]

    def value(flat: Vector) -> tuple[float, Vector]:
        y = flat.reshape(n, n)
        if np.linalg.cond(y) > 1e8:
            return 1e6, np.zeros(n * n)
        inverse = np.linalg.inv(y)
        b = y @ a @ inverse
        squares, v = np.linalg.eigh(b.swapaxes(1, 2) @ b)
        squares = np.maximum(squares, 1e-200)
        logarithms = sharpness * np.log(squares) / 2
        top = logarithms.max()
        weight = np.exp(logarithms - top)
        total, weight = weight.sum(), weight / weight.sum()
        right = np.einsum("mij,mj,mkj->ik", v, weight, v, optimize=True)
        u = b @ v
        left = np.einsum("mij,mj,mkj->ik", u, weight / squares, u, optimize=True)
        return (top + np.log(total)) / sharpness, ((left - right) @ inverse.T).ravel()

    found = scipy.optimize.minimize(value, np.eye(n).ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 40})
    return np.asarray(found.x).reshape(n, n)


def _deviation(model: Model, record: Record) -> Vector:
    """Standard deviation of each output of the model over a record; 1 for one that does not move."""
    place = [[c.name for c in record.outputs].index(c.name) for c in model.outputs]
    deviation = np.concatenate([e.outputs for e in record.experiments])[:, place].std(axis=0)
    return np.where(deviation > 0, deviation, 1.0)


def _first_rows(record: Record, start: int, most: int) -> Record:
    """The first rows of a record, whole experiments and a piece of one; at least one row after the lags."""
    kept: list[Experiment] = []
    left = max(most, start + 1)
    for e in record.experiments:
        if left > start:
            kept.append(e.rows(None, left) if len(e) > left else e)
            left -= len(e)
    return replace(record, experiments=tuple(kept))


def _checked_factor(largest: float) -> float:
    if not 1 < check_number(largest, "largest", positive=True) <= _LARGEST_FACTOR:
        raise InputError(f"`largest` must be a factor above 1 and at most {_LARGEST_FACTOR:g}; got {largest!r}.")
    return float(largest)


def _peak(values: Vector) -> float | None:
    return float(np.nanmax(values)) if np.isfinite(values).any() else None


def _place(model: Model, record: Record, points: _Points, values: Vector) -> Place | None:
    """The point of the largest value."""
    if not np.isfinite(values).any():
        return None
    i = int(np.nanargmax(values))
    regressor = {str(lag): float(v) for lag, v in zip(model.form.layout, points.x[i], strict=True)}
    experiment, row = int(points.experiment[i]), int(points.row[i])
    if experiment < 0:
        return Place(None, None, "a point off the trajectory", regressor)
    return Place(experiment, row, _where(record, experiment, row), regressor)


def _where(record: Record, experiment: int, row: int) -> str:
    e = record.experiments[experiment]
    return e.where(row) if e.source or len(record.experiments) == 1 else f"experiment {experiment}, {e.where(row)}"


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


def _lines(
    found: Feedback, contracts: Contraction | None, factor: float | None, largest: float, diverged: tuple[str, ...]
) -> list[str]:
    """What the checks of the free run say."""
    lines = [f"The free run diverges ({'; '.join(diverged)}); looked at up to there."] if diverged else []
    if found.worst:
        lines.append(
            f"Free run of {found.steps} steps, {len(found.radius)} looked at: local spectral radius {found.median:.4g} "
            f"in the median and at most {found.largest:.4g}, at {found.worst}; above 1 at "
            f"{_percent(found.share_above_one or 0.0)} of the steps."
        )
    lines += [contracts.text] if contracts else []
    if factor is None:
        lines.append(f"It stays in bounds with the inputs' deviations from their means {largest:g} times as large.")
    else:
        lines.append(f"It leaves all bounds with the inputs' deviations from their means {factor:.3g} times as large.")
    return lines


def _gradient_text(found: Lipschitz) -> str:
    if found.gradient is None:
        return "The one-step predictor has no finite gradient on the measured rows."
    return (
        f"One-step predictor, which remembers only its lags: gradient at most {found.gradient:.4g} on {found.rows} "
        "measured rows. That bounds its predictions from measured outputs and says nothing about the free run."
    )


def _warnings(
    found: Feedback, contracts: Contraction | None, factor: float | None, diverged: tuple[str, ...]
) -> Iterator[str]:
    if diverged:
        yield f"the free run diverges: {'; '.join(diverged)}."
    if (found.share_above_one or 0.0) > _MANY:
        yield f"the local spectral radius is above 1 at {_percent(found.share_above_one or 0.0)} of the steps."
    if factor is not None and factor < _SMALL_MARGIN and not diverged:
        yield f"the free run diverges with inputs only {factor:.3g} times as large; do not use it beyond its data."
    if contracts is None:
        yield "contraction could not be checked: no derivatives, or more than 200 past outputs."
    elif not contracts.found:
        yield f"contraction was not found: at {_percent(1 - contracts.share)} of the sampled points, rate {contracts.rate:.4g}."
    if found.skipped:
        yield f"at {found.skipped} points of the free run the model has no finite derivative; they are left out."
