"""Noise models of lagged physics: orders, coefficients and covariance by prediction error.

The criterion is `‖W L(η)(Y − Φθ − F(w))‖²`, W the output weights, plus the prior of the weights. At
given η it is that of filtered rows, which `estimate` minimises as any other. For given rows the
coefficients η are found together with all that is linear: θ, and the weights about their present
value, so that a turn moves η as far as if the learner followed. Both in turn end at a stationary
point of the joint criterion; without a learner, or with one that is linear in its weights, the
first turn is there.

The information of (θ, w) is what η leaves of it: with the derivatives ψ_η of the predictions by η,
`G − ψᵀψ_η (ψ_ηᵀψ_η)⁻¹ ψ_ηᵀψ`. Where φ has lagged outputs, θ̂ and η̂ are correlated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError, Warning
from orthaug._base.jax import training_clock
from orthaug._base.progress import LOG
from orthaug.fitting.colour import burg
from orthaug.fitting.criteria import Criterion, Prediction
from orthaug.fitting.independent_terms import independent_terms
from orthaug.fitting.kinds import Solver
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.noise import ARMA
from orthaug.fitting.output_noise import LAGS, LEVEL
from orthaug.fitting.solvers.limit import Limit
from orthaug.fitting.solvers.minimize import minimize
from orthaug.fitting.structures import Structure
from orthaug.fitting.whiteness import ljung_box
from orthaug.inference.covariance import mixing_matrix
from orthaug.inference.influence import LARGEST, one_step_slopes
from orthaug.models.rows import InMemory
from orthaug.models.statistics import JointCovariance, half_inverse, prior_of
from orthaug.physics.noise import NoiseModel, Orders, RowFilter
from orthaug.physics.problem import Problem
from orthaug.physics.projection import Projection
from orthaug.physics.streamed import StreamedProblem

_TURNS, _SETTLED = 20, 1e-3  # turns of learner and coefficients; change in their standard errors
_LIMIT, _TOLERANCE = Limit(200, 200), 1e-14
_SEARCH = (Limit(30, 30), 1e-6)  # the same where orders are compared
_CHOICES = 2  # turns that choose the orders; later ones keep them
_LONG = 12  # order of the autoregression that a search begins with
_ROWS_PER_ORDER = 20
_BEYOND = 2  # coefficients more than the best white model has: how far a search goes
_MANY = 300_000  # entries of the derivatives: with more, orders are chosen with the learner held


def check_noise(
    problem: Problem,
    noise: ARMA,
    solver: Solver,
    structure: Structure,
    criterion: Criterion,
    engine: Any,
    *,
    ensemble: bool,
) -> None:
    """Raise InputError where a noise model cannot be estimated with what is asked for."""
    if criterion.free_run is not None:
        raise InputError(
            "a noise model is for training one step ahead; take `Prediction()`, or white noise on "
            "the free run."
        )
    if isinstance(problem, StreamedProblem) or type(engine) is not InMemory:
        raise InputError(
            "a noise model needs all rows in the memory of this process; take the engine memory, "
            "or white noise."
        )
    if not solver.gauss_newton or structure.from_initial:
        raise InputError(
            "a noise model needs the levenberg-marquardt solver and a solved θ; leave out "
            "`from_initial` and other solvers, or take white noise."
        )
    if ensemble:
        raise InputError("a noise model has no ensemble of learners; leave out `ensemble`.")
    if not problem.baseline.linear:
        raise InputError("a noise model needs physics that is linear in θ; take white noise.")
    _check_orders(problem, noise)


def _check_orders(problem: Problem, noise: ARMA) -> None:
    """Raise InputError where the rows are too few for the smallest orders that may be chosen."""
    lengths, theta = problem.lengths, len(problem.baseline.names)
    if not _supported(noise, lengths, theta):
        ar, ma = noise.pairs[0]
        raise InputError(
            f"`noise`: ar = {ar} and ma = {ma} leave {_counted(ar, lengths)} of {sum(lengths)} "
            f"rows for {ar + ma + theta} unknowns. Give lower orders, or more rows."
        )


def _supported(noise: ARMA, lengths: Sequence[int], others: int) -> list[tuple[int, int]]:
    """Return the orders that leave more rows than there are unknowns, `others` beside them."""
    return [one for one in noise.pairs if _counted(one[0], lengths) > sum(one) + others]


def _counted(ar: int, lengths: Sequence[int]) -> int:
    """Return the rows whose innovations count: the first of a stretch serve as past only."""
    return sum(max(length - ar, 0) for length in lengths)


def fit_coloured(
    problem: Problem,
    noise: ARMA,
    fit: Callable[..., LaggedEstimate],
    options: Mapping[str, object],
) -> LaggedEstimate:
    """Return the fit with a noise model; white where `noise` chooses none.

    Args:
        problem: posed for white errors.
        noise: declaration.
        fit: makes an estimate of a problem, filtered or not, with options.
        options: of the fit as it was asked for.
    """
    given: dict[str, Any] = dict(options) | {"checkpoints": None}
    if given["criterion"].automatic:
        given["criterion"] = Prediction()
    problem, learner, left_out = independent_terms(problem, given["learner"])
    given["learner"] = learner
    again = {**given, "initial": None}
    last = white = fit(problem, **given)
    kept, settled, seconds = None, False, last.status.seconds
    for turn in range(_TURNS):
        if not last.status.ok or last.model.statistics.gram is None:
            settled = True
            break
        began, rows = training_clock(), _Rows.of(last)
        if kept is None or (turn < _CHOICES and noise.chooses):
            found = _choose(rows, noise)
        else:
            found = _descend(rows, [(rows.nothing, kept)])
        seconds += training_clock() - began
        LOG.info("noise: turn %d, %s, %s", turn + 1, found.noise, found.noise.values)
        if found.noise.white:
            model = replace(white.model, noise=found.noise)
            return replace(white, model=model, warnings=(*left_out, *white.warnings))
        same = kept is not None and kept.orders == found.noise.orders
        if same and kept is not None and found.apart(kept) < _SETTLED:
            settled = True
            break
        kept = found.noise
        last = fit(problem.filtered(RowFilter(kept, problem.lengths)), **again)
        seconds += last.status.seconds
        if not (last.learns or last.at_bound):  # the minimum over θ and η at once
            settled = True
            break
        if last.learns:
            chosen = next((r.regularization for r in last.restarts if r.chosen), "none")
            again |= {"initial": last.model, "regularization": chosen}
    warnings = (*left_out, *last.warnings, *([] if settled else [_unsettled()]))
    status = replace(last.status, seconds=seconds)
    return replace(_with_information(last), status=status, warnings=warnings)


def _unsettled() -> Warning:
    text = (
        f"the noise model still changes after {_TURNS} fits of the learner, so θ depends on where "
        "the iteration stopped. Give fewer orders, or a smaller learner."
    )
    return Warning("noise_unsettled", text)


class _Rows(NamedTuple):
    """Errors v of a fit and what moves them, not filtered, in the outputs' units."""

    errors: Matrix
    columns: np.ndarray
    """Derivatives of the predictions (N, ny, r) by all that is linear, near independent."""
    pull: Vector
    """Of the prior of the learner's weights on their coordinates (r,)."""
    stiff: Matrix
    """Its precisions there (r, r)."""
    weight: Matrix
    lengths: tuple[int, ...]
    skip: int | None = None

    @classmethod
    def of(cls, fit: LaggedEstimate) -> _Rows:
        problem, model, nt = fit.problem, fit.model, len(fit.theta)
        statistics = model.statistics
        assert statistics.gram is not None
        count = len(problem.rows) * len(problem.outputs) * len(statistics.gram)
        if count > LARGEST:
            raise InputError(
                f"a noise model takes the derivatives of {len(problem.rows)} rows by "
                f"{len(statistics.gram)} unknowns, {count:.2g} numbers; "
                f"{LARGEST:.2g} are the limit. "
                "Take a smaller learner, every n-th row, or white noise."
            )
        free = _free(fit)
        information = statistics.information(nt) * np.outer(free, free)
        root = half_inverse(information, nt)
        slopes = one_step_slopes(replace(problem, noise=None), model)
        columns = problem.weight.outputs(slopes) @ root
        prior = prior_of(statistics.gram, statistics.ridge, nt)
        weights = np.concatenate([np.zeros(nt), np.asarray(model.numbers.weights).ravel()])
        return cls(
            raw_errors(fit),
            columns,
            root.T @ (prior * weights),
            root.T @ (prior[:, None] * root),
            problem.weight.matrix,
            problem.lengths,
        )

    @property
    def nothing(self) -> Vector:
        """No move of what is linear."""
        return np.zeros(self.columns.shape[2])

    def output(self, o: int, skip: int) -> _Rows:
        """Return the rows of one output alone, with fewer that count."""
        one = self._replace(
            errors=self.errors[:, o : o + 1],
            columns=self.columns[:, o : o + 1],
            weight=np.ones((1, 1)) / max(float(np.std(self.errors[:, o])), 1e-300),
            skip=skip,
        )
        if one.columns.size <= _MANY:
            return one
        return one._replace(columns=one.columns[..., :0], pull=np.zeros(0), stiff=np.zeros((0, 0)))

    def filter(self, noise: NoiseModel) -> RowFilter:
        return RowFilter(noise, self.lengths, self.skip)

    def left(self, moved: Vector) -> Matrix:
        """Return v with what is linear moved."""
        return self.errors - self.columns @ moved

    def pieces(self, values: Matrix) -> list[Matrix]:
        return np.split(values, np.cumsum(self.lengths)[:-1])


def raw_errors(fit: LaggedEstimate) -> Matrix:
    """Return the errors v (N, ny) of the usable rows, before a noise model."""
    return replace(fit.model, noise=None).predict(fit.problem.record).errors


def _free(fit: LaggedEstimate) -> Vector:
    """Return 0 for entries of θ at a bound, 1 for all other unknowns."""
    gram = fit.model.statistics.gram
    assert gram is not None
    free = np.ones(len(gram))
    free[[fit.problem.baseline.names.index(name) for name in fit.at_bound]] = 0.0
    return free


class _Trial(NamedTuple):
    """A trial at p = (what is linear, η): innovations weighed (N, ny), and the objective."""

    p: Vector
    noise: NoiseModel
    errors: Matrix
    innovations: Matrix
    loss: float


class _Linear(NamedTuple):
    hessian: Matrix
    gradient: Vector
    start: None = None


@dataclass(frozen=True, eq=False)
class _Objective:
    """`‖W L(η)(v − A m)‖²` and the prior, of p = (m, η); infinite where C is not invertible."""

    rows: _Rows
    orders: Orders

    @property
    def physics(self) -> int:
        """All unknowns are without a ridge."""
        return len(self.rows.nothing) + sum(map(sum, self.orders))

    def evaluate(self, p: Vector, start: Any) -> _Trial:
        rows, r = self.rows, len(self.rows.nothing)
        noise, left = NoiseModel.of(self.orders, p[r:]), rows.left(p[:r])
        if not noise.invertible:
            return _Trial(p, noise, left, left, np.inf)
        with np.errstate(all="ignore"):
            innovations = rows.filter(noise).rows(left) @ rows.weight.T
            loss = float(np.sum(innovations**2))
        prior = 2 * rows.pull @ p[:r] + p[:r] @ rows.stiff @ p[:r]
        return _Trial(p, noise, left, innovations, loss + float(prior))

    def linearise(self, point: _Trial) -> _Linear:
        jacobian, rows, r = self.jacobian(point), self.rows, len(self.rows.nothing)
        hessian, gradient = jacobian.T @ jacobian, -jacobian.T @ point.innovations.ravel()
        hessian[:r, :r] += rows.stiff
        gradient[:r] -= rows.pull + rows.stiff @ point.p[:r]
        return _Linear(hessian, gradient)

    def jacobian(self, point: _Trial) -> Matrix:
        """Return the derivative of the innovations (N ny, r + nη)."""
        through, weight = self.rows.filter(point.noise), self.rows.weight
        parts = [-through.rows(self.rows.columns), through.slopes(point.errors)]
        both = np.einsum("oi,kin->kon", weight, np.concatenate(parts, axis=2))
        return both.reshape(-1, both.shape[2])

    def samples(self, point: _Trial) -> tuple[float, float]:
        return float(point.innovations.size), 1.0


class _Found(NamedTuple):
    """The minimum over what is linear and η."""

    moved: Vector
    noise: NoiseModel
    loss: float
    innovations: Matrix
    precision: Matrix
    """Information of η, what is linear eliminated, per unit of noise variance."""

    def apart(self, other: NoiseModel) -> float:
        """Return the largest change of a coefficient in its standard error."""
        change = self.noise.values - other.values
        variance = self.loss / max(self.innovations.size - len(change), 1)
        return float(np.sqrt(max(change @ self.precision @ change, 0.0) / max(variance, 1e-300)))


def _descend(
    rows: _Rows,
    starts: Sequence[tuple[Vector, NoiseModel]],
    limit: Limit = _LIMIT,
    tolerance: float = _TOLERANCE,
) -> _Found:
    """Return the lowest minimum from several starts."""
    found = []
    for moved, noise in starts:
        objective = _Objective(rows, noise.orders)
        first = np.concatenate([moved, noise.reflected().values])
        end = minimize(objective, first, None, limit=limit, tolerance=tolerance)
        r, nothing = len(moved), np.zeros((len(first), len(first)))
        hessian = nothing if end.linear is None else end.linear.hessian
        across = np.linalg.lstsq(hessian[:r, :r], hessian[:r, r:], rcond=1e-13)[0]
        precision = hessian[r:, r:] - hessian[r:, :r] @ across
        point = end.point
        found.append(_Found(point.p[:r], point.noise, point.loss, point.innovations, precision))
    return min(found, key=lambda one: one.loss)


def _choose(rows: _Rows, noise: ARMA) -> _Found:
    """Return the minimum with the orders that are declared, or chosen output by output.

    Of those whose innovations pass for white the lowest BIC is taken, of all others the lowest AIC.
    """
    ny = rows.errors.shape[1]
    if noise.chooses:
        pairs = _supported(noise, rows.lengths, len(rows.nothing)) or noise.pairs[:1]
        skip = max(p for p, _ in pairs)
        each = [_choose_orders(rows.output(o, skip), pairs) for o in range(ny)]
        orders = tuple(one.noise.orders[0] for one in each)
    else:
        orders = ((noise.ar, noise.ma),) * ny  # type: ignore[assignment]
    starts = [(rows.nothing, _nothing(orders))]
    if any(map(sum, orders)):
        long = _long_autoregression(rows)
        starts.append((long.moved, _regress(rows, long, orders)))
    return _descend(rows, starts)


def _choose_orders(rows: _Rows, pairs: Sequence[tuple[int, int]]) -> _Found:
    """Return the minimum with the best orders of one output, all on the same rows.

    The search ends where models of two more coefficients are no better.
    """
    long, counted = _long_autoregression(rows), rows.filter(_nothing(((0, 0),))).counted
    tried: dict[tuple[int, int], _Found] = {}
    scores: dict[tuple[int, int], tuple[bool, float]] = {}
    for p, q in pairs:
        best = min(scores, key=scores.__getitem__, default=None)
        if best is not None and not scores[best][0] and p + q > sum(best) + _BEYOND:
            break
        if (p + q) * _ROWS_PER_ORDER > counted and tried:
            continue
        starts = [(long.moved, _regress(rows, long, ((p, q),)))]
        smaller = [tried[before] for before in ((p - 1, q), (p, q - 1)) if before in tried]
        if smaller:  # never above a smaller model
            before = min(smaller, key=lambda one: one.loss)
            ar, ma = before.noise.ar[0], before.noise.ma[0]
            values = np.r_[ar, np.zeros(p - len(ar)), ma, np.zeros(q - len(ma))]
            starts.append((before.moved, NoiseModel.of(((p, q),), values)))
        tried[p, q] = one = _descend(rows, starts, *_SEARCH)
        pieces = [piece[rows.skip or 0 :, 0] for piece in rows.pieces(one.innovations)]
        box = ljung_box([piece for piece in pieces if len(piece)], LAGS, p + q)
        square = max(float(np.sum(one.innovations**2)), 1e-300)
        white = box is None or box.p >= LEVEL
        price = np.log(counted) if white else 2.0
        scores[p, q] = (not white, counted * np.log(square / counted) + price * (p + q))
        LOG.debug("noise: orders %d, %d: white %s, %.6g", p, q, white, scores[p, q][1])
    return tried[min(scores, key=scores.__getitem__)]


def _nothing(orders: Orders) -> NoiseModel:
    """Return white errors as a model of these orders."""
    return NoiseModel.of(orders, np.zeros(sum(map(sum, orders))))


def _long_autoregression(rows: _Rows) -> _Found:
    """Return the minimum with a long autoregression: consistent for all stationary errors."""
    ny, counted = rows.errors.shape[1], sum(rows.lengths)
    order = max(1, min(_LONG, counted // _ROWS_PER_ORDER, max(rows.lengths) // 4))
    values = []
    for o in range(ny):
        size = float(np.sqrt(np.mean(rows.errors[:, o] ** 2))) or 1.0
        a = burg([piece[:, o] / size for piece in rows.pieces(rows.errors)], order)
        values.append(np.r_[a[1:], np.zeros(order + 1 - len(a))])
    noise = NoiseModel.of(((order, 0),) * ny, np.concatenate(values))
    return _descend(
        rows._replace(skip=max(order, rows.skip or 0)), [(rows.nothing, noise)], *_SEARCH
    )


def _regress(rows: _Rows, long: _Found, orders: Orders) -> NoiseModel:
    """Return coefficients by regression on past errors and innovations (Hannan and Rissanen)."""
    left, values = rows.left(long.moved), []
    innovations = RowFilter(long.noise, rows.lengths).rows(left)
    first = long.noise.past
    for o, (p, q) in enumerate(orders):
        lines, right = [np.zeros((0, p + q))], [np.zeros(0)]
        begin = first + max(p, q)
        for v, e in zip(rows.pieces(left[:, o]), rows.pieces(innovations[:, o]), strict=True):
            if len(v) > begin:
                past = [-v[begin - i : len(v) - i] for i in range(1, p + 1)]
                past += [e[begin - i : len(e) - i] for i in range(1, q + 1)]
                lines.append(np.reshape(past, (p + q, len(v) - begin)).T)
                right.append(v[begin:])
        values.append(np.linalg.lstsq(np.concatenate(lines), np.concatenate(right), rcond=None)[0])
    return NoiseModel.of(orders, np.concatenate(values)).reflected()


def _with_information(fit: LaggedEstimate) -> LaggedEstimate:
    """Return a fit of filtered rows with statistics that count the coefficients as estimated."""
    problem, model, nt = fit.problem, fit.model, len(fit.theta)
    statistics, through = model.statistics, problem.noise
    if through is None or statistics.gram is None or statistics.middle is None:
        return fit
    assert model.noise is not None and statistics.noise is not None
    weight, free = problem.weight, _free(fit)
    errors = raw_errors(fit)
    own = np.einsum("oi,kin->kon", weight.matrix, -through.slopes(errors))
    rows = np.concatenate([one_step_slopes(problem, model) * free, own], axis=2)
    mixed = np.einsum("oi,kin->kon", mixing_matrix(weight.whitened(statistics.noise)), rows)
    gram, middle = (np.einsum("kon,kom->nm", x, x, optimize=True) for x in (rows, mixed))
    n = len(statistics.gram)
    ridge = prior_of(statistics.gram, statistics.ridge, nt)[nt:]
    joint = JointCovariance(gram, np.r_[ridge, np.zeros(own.shape[2])], middle, nt)
    half = half_inverse(gram[n:, n:], 0)
    reduce = np.column_stack([np.eye(n), -(gram[:n, n:] @ half) @ half.T])
    kept = replace(statistics, gram=reduce @ gram @ reduce.T, middle=reduce @ middle @ reduce.T)
    each = np.column_stack([np.zeros((own.shape[2], n)), np.eye(own.shape[2])])
    noise = replace(model.noise, covariance=joint.of(each))
    covariance = fit.covariance
    if covariance is not None:
        k = np.column_stack([fit.theta_slope, _split_slope(fit)])
        held = np.flatnonzero(free[:nt] == 0)
        covariance = joint.of(k)
        covariance[held] = covariance[:, held] = np.nan
        covariance = fit._enlarge(covariance, kept)
    model = replace(model, statistics=kept, noise=noise)
    return replace(fit, model=model, covariance=covariance)


def _split_slope(fit: LaggedEstimate) -> Matrix:
    """Return ∂θ_aux/∂η (nθ, nη): the inner product that θ is split in depends on η."""
    problem, model, through = fit.problem, fit.model, fit.problem.noise
    assert through is not None
    values = through.noise.values
    found = np.zeros((len(fit.theta), len(values)))
    if not fit.learns or (model.shared is not None and not model.shared.shape[1]):
        return found
    phi = problem.baseline.on(problem.rows.x, problem.layout, problem.outputs)[0]
    learned = model.learner_at(problem.rows.x)

    def aux(at: Vector) -> Vector:
        own = replace(through, noise=through.noise.moved(at))
        projection = Projection.factor(problem.weight.rows(own.rows(phi)))
        return projection.solve_along(problem.weight.rows(own.rows(learned)), model.shared)

    for i, value in enumerate(values):
        step = 1e-5 * max(1.0, abs(value)) * np.eye(len(values))[i]
        found[:, i] = (aux(values + step) - aux(values - step)) / (2 * step[i])
    return found
