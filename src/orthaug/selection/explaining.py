"""Regression of a learner's output over data on suspected terms and on products of its inputs.

Forward orthogonal regression: the physics is projected out first where the learner shares
directions with it, then the term that explains most beside those that are in comes next, or a pair
that explains more than it and one that is in (replacement). Widths, of a Stribeck curve say, are
refined with all others in.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.optimize
import scipy.special
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.columns import least_squares, span
from orthaug._base.errors import InputError
from orthaug._base.lines import plural
from orthaug.analysis.catalogue import SMOOTH_FRICTION
from orthaug.analysis.suspects import ODD_JUMPS, WIDTHS, changes_sign, is_level, suspect_text
from orthaug.data.terms import CONSTANT, TermLibrary, count_products, outside_brackets
from orthaug.selection.learned_linearization import LearnedLinearization

_RANK = 1e-9  # of the largest singular value
_ROUNDING = 1e-8  # of the largest variance
# Of a share: a dead zone and a saturation span the same beside a damper, and the first is taken
_DIGITS = 6


@dataclass(frozen=True, eq=False)
class LearnerTarget:
    """Target for terms from a learner: values `target` (r,) and their `covariance` (r, r).

    Values are its output in a space where its errors are known.

    `view` (P, r) takes whitened values over all points to that; None where the learner has no
    tangent space: then they are taken as they are, less the physics. `size` is the norm of the
    learner with all that physics expresses.
    """

    linearization: LearnedLinearization
    q: Float[np.ndarray, "R s"]
    view: Float[np.ndarray, "P r"] | None
    target: Vector
    covariance: Matrix | None
    size: float

    @classmethod
    def of(cls, linearization: LearnedLinearization) -> LearnerTarget:
        """Return the target in the learner's tangent space over the points, where it has one."""
        q = basis_of(linearization.physics_moves.T)
        raw = linearization.fitted_values(linearization.learner)
        rest, size, tangent = (
            project_out_basis(raw, q),
            float(np.linalg.norm(raw)),
            linearization.tangent,
        )
        if tangent is None:
            return cls(linearization, q, None, rest, None, size)
        ridge: Any = np.broadcast_to(np.asarray(tangent.ridge, dtype=float), tangent.weights.shape)
        u, sigma, vt = np.linalg.svd(project_out_basis(tangent.jacobian, q), full_matrices=False)
        kept = sigma > _RANK * sigma.max(initial=0.0)
        u, sigma, v = u[:, kept], sigma[kept], vt[kept].T
        # with U, Σ, V of J: S = U Σ (Σ² + VᵀλV)⁻¹ Σ Uᵀ
        inner = np.linalg.inv(np.diag(sigma**2) + v.T @ (ridge[:, None] * v))
        smooth = sigma[:, None] * inner * sigma
        target = smooth @ (u.T @ rest) + sigma * (inner @ (v.T @ (ridge * tangent.weights)))
        covariance = None
        if tangent.joint is not None:
            k = sigma[:, None] * (inner @ (sigma[:, None] ** 2 * v.T + v.T * ridge))
            covariance = tangent.joint.of(
                np.concatenate([np.zeros((len(k), tangent.joint.nt)), k], axis=1)
            )
        view = u @ smooth.T
        view = view if linearization.response is None else linearization.response.adjoint(view)
        return cls(linearization, q, view, target, covariance, size)

    @property
    def noise(self) -> float:
        """The variance of the learner's errors in a direction, on average.

        0 where it is not known.
        """
        return (
            0.0
            if self.covariance is None
            else float(np.trace(self.covariance)) / max(len(self.target), 1)
        )

    @property
    def p(self) -> float | None:
        """P-value of the learner being only its own errors, beside the physics (Wald's test).

        None if not known.
        """
        if self.covariance is None:
            return None
        values, vectors = np.linalg.eigh(self.covariance)
        kept = values > _ROUNDING * values.max(initial=0.0)
        square = float(np.sum((vectors[:, kept].T @ self.target) ** 2 / values[kept]))
        return float(scipy.special.chdtrc(max(int(kept.sum()), 1), square))

    def unit(self, column: Vector) -> Vector:
        """Return a column over the points (P,), of unit size, as the learner would show it."""
        with np.errstate(all="ignore"):
            column = column / np.linalg.norm(column)
        if not np.isfinite(column).all():
            return np.full(len(self.target), np.nan)
        if self.view is None:
            return project_out_basis(self.linearization.fitted_values(column), self.q)
        return self.view.T @ column


def project_out_basis(values: np.ndarray, basis: Float[np.ndarray, "R k"]) -> np.ndarray:
    """Return values less the part that an orthonormal basis expresses, projected twice."""
    for _ in range(2 if basis.size else 0):
        values = values - basis @ (basis.T @ values)
    return values


def basis_of(columns: Sequence[Vector] | Matrix) -> Float[np.ndarray, "R k"]:
    """Return an orthonormal basis of columns, given one by one, each taken as of size 1."""
    return span(np.asarray(columns, dtype=float).T) if len(columns) else np.zeros((0, 0))


MOST_CANDIDATES = 3000
TERM = "term"
"""The kind of a product of what the learner sees."""
_PLAIN = ("coulomb", "quadratic_drag", "cubic", "square_root")
_WIDE = (
    *SMOOTH_FRICTION,
    *(kind for kind in ("stribeck", "stribeck_gauss", "dead_zone", "saturation") if kind in WIDTHS),
)
# Times the median size of what a term acts on
_WIDTHS = tuple(2.0 ** (i / 2) for i in range(-8, 3))
_REFINED = 2.0  # how far, as a factor, a width is moved from where it was found
_COMPLEXITY = {
    **dict.fromkeys(_PLAIN, 1),
    **dict.fromkeys(SMOOTH_FRICTION, 3),
    "stribeck": 3,
    "stribeck_gauss": 3,
    "dead_zone": 4,
    "saturation": 4,
}
_FORMS = {"stribeck_gauss": "stribeck", "atan": "tanh"}
"""Kinds that are another's on the same variable."""
_OWN = 1e-4  # of a candidate's squared norm: what physics, learner and other terms must leave of it
# Share of the learner: within this of the best the simpler term is taken
_TIE, _TIE_UNKNOWN = (2e-4, 2e-3)
_PART = 0.1  # of what even the best leaves: less does not separate two terms either
# Variances of the noise in one direction: what two terms with widths differ by at random
_DRAWS = 10.0
_ROUGH, _FINE = 0.03, 1e-3  # of its logarithm
_SAME_SHARE = 1e-6  # of the learner: terms that explain it equally well
_TRIED = 10  # kinds of terms, or pairs of kinds, that are refined before the choice
_BLOCK, _LOOKED = 256, 200  # candidates whose pairs are looked at together, and pairs of them
_T = 3.0  # standard errors that a coefficient must differ from 0: the term was chosen among many


@dataclass(frozen=True)
class Candidate:
    """A term that could explain the learner in one output or equation: `kind` of `on`, `width`."""

    kind: str
    on: str | None
    width: float | None
    place: int
    text: str
    declared: bool = False
    """True of a suspect of the user's: its width, if it has one, is not sought."""

    def wide(self, width: float) -> Candidate:
        """Return the candidate with another width, of four digits."""
        width = float(f"{width:.4g}")
        return replace(self, width=width, text=_expression_text(self.kind, self.on, width))

    @property
    def name(self) -> str:
        """In words."""
        return self.text if self.kind == TERM else f"{self.kind} of {self.on}"

    @property
    def complexity(self) -> int:
        """Complexity of the term: of terms that explain as much the simplest is taken.

        A learner is smooth: clipping imitates jumps last. What was expected comes before its like.
        """
        products = 2 + self.text.replace("**", "").count("*")
        return _COMPLEXITY.get(self.kind, products) - self.declared

    @property
    def identity(self) -> tuple[str, str, int]:
        """Key of the term without its width."""
        return self.kind, self.text if self.on is None else self.on, self.place

    @property
    def form(self) -> tuple[str, str, int]:
        """Key of the term without its width, with both kinds of a peak, or a bend, alike."""
        return _FORMS.get(self.kind, self.kind), *self.identity[1:]


@dataclass(frozen=True, eq=False)
class Space:
    """Candidates as a learner would show them beside the physics, (K, r), and the `target` (r,).

    The target has norm 1, so that squares are shares of what the learner adds; `norm` is what it
    had. `tie` is the share within which two terms count as equal.
    """

    linearization: LearnedLinearization
    shown: LearnerTarget
    target: Vector
    norm: float
    candidates: tuple[Candidate, ...]
    columns: Float[np.ndarray, "K r"]
    tie: float

    @classmethod
    def of(cls, linearization: LearnedLinearization, candidates: Sequence[Candidate]) -> Space:
        """Return the space without candidates that have no value, or that the physics expresses.

        Candidates that no learner could show are out, too.
        """
        shown = LearnerTarget.of(linearization)
        norm = float(np.linalg.norm(shown.target))
        kept, columns = [], []
        for candidate in candidates:
            column = shown.unit(
                linearization.column(linearization.parse(candidate.text), candidate.place)
            )
            if np.isfinite(column).all() and column @ column > _OWN:
                kept.append(candidate)
                columns.append(column)
        table = np.array(columns).reshape(len(columns), len(shown.target))
        target = shown.target / norm if norm > 1e-9 * shown.size else 0.0 * shown.target
        tie = _TIE_UNKNOWN if shown.covariance is None else _TIE
        tie = max(tie, _DRAWS * shown.noise / norm**2) if norm > 0 else tie
        return cls(linearization, shown, target, norm, tuple(kept), table, tie)

    @property
    def empty(self) -> bool:
        """True if the learner adds nothing beside the physics, or nothing could explain it."""
        return not self.target.any() or not self.candidates

    def column(self, candidate: Candidate) -> Vector:
        """Return a candidate as the learner would show it, (r,)."""
        return self.shown.unit(
            self.linearization.column(self.linearization.parse(candidate.text), candidate.place)
        )

    def gains(self, chosen: Sequence[Vector]) -> Vector:
        """Return the share of the learner that each candidate adds to the `chosen` ones (K,)."""
        basis = basis_of(chosen)
        left = np.einsum("kr,kr->k", self.columns, self.columns)
        if basis.size:
            left = left - np.sum((self.columns @ basis) ** 2, axis=1)
        able = left > _OWN
        return np.where(
            able,
            (self.columns @ project_out_basis(self.target, basis)) ** 2 / np.where(able, left, 1.0),
            0.0,
        )

    def explained_share(self, chosen: Sequence[Vector]) -> float:
        """Return the share of the learner that chosen columns explain together."""
        return float(np.sum((basis_of(chosen).T @ self.target) ** 2)) if len(chosen) else 0.0


def check_products(signals: int, degree: int, functions: Sequence[str], places: int) -> None:
    """Raise InputError where products of what a learner sees are too many, before work begins."""
    _check_count(signals, degree, count_products(signals, degree, len(set(functions))) * places)


def _check_count(signals: int, degree: int, count: int) -> None:
    if count > MOST_CANDIDATES:
        raise InputError(
            f"{plural(signals, 'signal')} to the degree {degree} make {count} candidate "
            f"terms; at most {MOST_CANDIDATES} are looked at. Lower the degree, or give fewer "
            "functions."
        )


def candidates_of(
    linearization: LearnedLinearization,
    degree: int,
    functions: Sequence[str],
    suspects: Sequence[tuple[str, int]],
) -> tuple[Candidate, ...]:
    """Return the candidates that could explain the learner, simple ones first.

    Args:
        degree, functions: of products of what the learner sees (`TermLibrary`).
        suspects: further expressions, each with the number of its place.

    Raises:
        InputError: more than can be kept in memory.
    """
    library = TermLibrary.of(linearization.signals[: linearization.seen], degree, functions)
    plain = [
        (kind, on)
        for kind in _PLAIN
        for on in linearization.signals
        if _is_likely(linearization, kind, on)
    ]
    known = {_expression_text(kind, on) for kind, on in plain}
    texts = [text for text in library.texts if text != CONSTANT and text not in known]
    wide = [
        (kind, on)
        for kind in _WIDE
        for on in linearization.signals
        if _is_likely(linearization, kind, on)
    ]
    wide = [(kind, on, width) for kind, on in wide for width in _grid(linearization, on)]
    places = range(len(linearization.places))
    _check_count(linearization.seen, degree, (len(texts) + len(wide)) * len(places))
    found = [Candidate(TERM, None, None, place, text, declared=True) for text, place in suspects]
    for place in places:
        found += [
            Candidate(kind, on, None, place, _expression_text(kind, on)) for kind, on in plain
        ]
        found += [Candidate(TERM, None, None, place, CONSTANT)]
        found += [Candidate(TERM, None, None, place, text) for text in texts]
        found += [
            Candidate(kind, on, width, place, _expression_text(kind, on, width))
            for kind, on, width in wide
        ]
    return tuple(found)


def _is_likely(linearization: LearnedLinearization, kind: str, on: str) -> bool:
    """Return whether a kind suits a variable: friction needs both signs, a root a positive one."""
    if kind not in (*ODD_JUMPS, *SMOOTH_FRICTION, "square_root"):
        return True
    if kind in SMOOTH_FRICTION and "*" in on:  # a product is no velocity
        return False
    values = _values(linearization, on)
    return bool(np.isfinite(values).all()) and (
        is_level if kind == "square_root" else changes_sign
    )(values)


def _values(linearization: LearnedLinearization, on: str) -> Vector:
    with np.errstate(all="ignore"):
        return np.asarray(linearization.evaluate(linearization.parse(on)), dtype=float)


def _grid(linearization: LearnedLinearization, on: str) -> Iterator[float]:
    """Yield widths that the data can resolve; none for what is zero, or has no value somewhere."""
    size = np.abs(_values(linearization, on))
    if np.isfinite(size).all() and np.any(size > 0):
        yield from (float(f"{share * np.median(size[size > 0]):.4g}") for share in _WIDTHS)


def _expression_text(kind: str, on: str | None, width: float | None = None) -> str:
    if kind == "cubic" and on is not None and not outside_brackets(on, "+-*/ "):
        return f"{on}**3"
    if kind in SMOOTH_FRICTION and on is not None:
        return SMOOTH_FRICTION[kind].expression(on, repr(width))
    return suspect_text(kind, on, width, lambda text: text, "v")[0]


def select(space: Space, most: int, least: float) -> list[Candidate]:
    """Return the terms, in the order in which they explain most.

    Args:
        most: at most so many.
        least: share of the learner that each must explain beside all others.
    """
    chosen: list[Candidate] = []
    while len(chosen) < most and not space.empty:
        grown = _grow(space, chosen)
        if not grown or _share(space, grown) < _share(space, chosen) + least:
            break
        chosen = grown
    return _order(space, _prune(space, chosen, least))


def _share(space: Space, chosen: Sequence[Candidate]) -> float:
    return space.explained_share([space.column(one) for one in chosen])


def _grow(space: Space, chosen: list[Candidate]) -> list[Candidate]:
    """Return one term more: beside all that are in, or a pair beside all but one.

    Widths refined, the simplest of the best.

    Friction has the sum of a jump and of a peak, neither of which is the best term alone. Two peaks
    on one variable, or two widths of another kind, are the difference of nearly the same, and no
    law.
    """
    trials = [[*chosen, one] for one in _best_single(space, chosen)]
    for i in range(len(chosen)):
        others = chosen[:i] + chosen[i + 1 :]
        trials += [[*others, *pair] for pair in _best_pairs(space, others)]
    trials = [trial for trial in trials if len({one.form for one in trial}) == len(trial)]
    trials = [_refine(space, trial, _ROUGH) for trial in trials]
    shares = [_share(space, trial) for trial in trials]
    best = max(shares, default=0.0)
    tie = max(space.tie, _PART * (1 - best))
    able = [i for i, share in enumerate(shares) if share >= best - tie]
    taken = min(
        able,
        key=lambda i: (sum(one.complexity for one in trials[i]), -round(shares[i], _DIGITS)),
        default=None,
    )
    return [] if taken is None else _refine(space, trials[taken])


def _best_single(space: Space, chosen: Sequence[Candidate]) -> list[Candidate]:
    gains = space.gains([space.column(one) for one in chosen])
    found: dict[object, Candidate] = {}
    for i in np.argsort(-np.round(gains, _DIGITS), kind="stable"):
        if len(found) == _TRIED or gains[i] <= 0:
            break
        found.setdefault(space.candidates[int(i)].identity, space.candidates[int(i)])
    return list(found.values())


def _best_pairs(space: Space, others: Sequence[Candidate]) -> list[tuple[Candidate, Candidate]]:
    """Return the pairs that explain most together beside others, of each two kinds the best."""
    basis = basis_of([space.column(one) for one in others])
    x, y = space.columns, project_out_basis(space.target, basis)
    if basis.size:
        x = x - (x @ basis) @ basis.T
    size, along = np.einsum("kr,kr->k", x, x), x @ y
    able = np.flatnonzero(size > _OWN)
    x, size, along = x[able], size[able], along[able]
    found: dict[object, tuple[float, Candidate, Candidate]] = {}
    for begin in range(0, len(able), _BLOCK):
        rows = slice(begin, begin + _BLOCK)
        across = x[rows] @ x.T
        left = np.outer(size[rows], size) - across**2
        gain = (
            along[rows, None] ** 2 * size
            + along**2 * size[rows, None]
            - 2 * np.outer(along[rows], along) * across
        )
        gain = np.where(
            left > _OWN * np.outer(size[rows], size), gain / np.where(left > 0, left, 1.0), 0.0
        )
        gain = np.where(np.arange(len(able)) > begin + np.arange(len(gain))[:, None], gain, 0.0)
        best = np.argpartition(-gain, min(_LOOKED, gain.size - 1), axis=None)[:_LOOKED]
        for flat in best[np.argsort(-gain.ravel()[best], kind="stable")]:
            i, j = np.unravel_index(flat, gain.shape)
            one, other = space.candidates[able[begin + i]], space.candidates[able[j]]
            kinds = (one.identity, other.identity)
            if gain[i, j] > found.get(kinds, (0.0,))[0]:
                found[kinds] = (float(gain[i, j]), one, other)
    ordered = sorted(found.values(), key=lambda entry: -entry[0])
    return [(one, other) for _, one, other in ordered[:_TRIED]]


def _refine(space: Space, chosen: list[Candidate], within: float = _FINE) -> list[Candidate]:
    for i, candidate in enumerate(chosen):
        if candidate.width is None:
            continue
        others = [space.column(one) for one in chosen[:i] + chosen[i + 1 :]]

        def unexplained_share(
            log: float, candidate: Candidate = candidate, others: list[Vector] = others
        ) -> float:
            return -space.explained_share(
                [*others, space.column(candidate.wide(float(np.exp(log))))]
            )

        centre = float(np.log(candidate.width))
        around = (centre - np.log(_REFINED), centre + np.log(_REFINED))
        options: Any = {"xatol": within}
        best = scipy.optimize.minimize_scalar(
            unexplained_share, bounds=around, method="bounded", options=options
        )
        if best.fun < unexplained_share(centre) - 1e-6:
            chosen = [*chosen[:i], candidate.wide(float(np.exp(best.x))), *chosen[i + 1 :]]
    return chosen


def _prune(space: Space, chosen: list[Candidate], least: float) -> list[Candidate]:
    """Return the chosen terms less those that the others make superfluous."""
    while len(chosen) > 1:
        columns = [space.column(one) for one in chosen]
        whole = space.explained_share(columns)
        losses = [
            whole - space.explained_share(columns[:i] + columns[i + 1 :])
            for i in range(len(columns))
        ]
        weakest = int(np.argmin(losses))
        if losses[weakest] >= least:
            break
        chosen = _refine(space, chosen[:weakest] + chosen[weakest + 1 :])
    return chosen


def _order(space: Space, chosen: list[Candidate]) -> list[Candidate]:
    """Return each next the one that explains most beside those before it."""
    left, order = list(chosen), []
    while left:
        known = [space.column(one) for one in order]
        shares = [space.explained_share([*known, space.column(one)]) for one in left]
        order.append(left.pop(int(np.argmax(shares))))
    return order


@dataclass(frozen=True, eq=False)
class Fit:
    """Chosen terms fitted beside the physics: its shift (s,), coefficients (k,), Cov or None."""

    along: Vector
    coefficients: Vector
    covariance: Matrix | None

    def doubtful(self) -> int | None:
        """Return the number of the least significant term, None where all are significant."""
        if self.covariance is None or not len(self.coefficients):
            return None
        std = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        t = np.abs(self.coefficients) / np.where(std > 0, std, 1e-300)
        return int(np.argmin(t)) if t.min() < _T else None


def fit_terms(space: Space, chosen: Sequence[Candidate]) -> Fit:
    """Fit the terms to the learner by least squares, as it would show them.

    The physics takes what they do not express.
    """
    linearization, shown = space.linearization, space.shown
    raw = [linearization.column(linearization.parse(one.text), one.place) for one in chosen]
    size = np.array([np.linalg.norm(column) for column in raw])
    inverse = np.zeros((0, len(shown.target)))
    if chosen:
        inverse = (
            np.linalg.pinv(np.column_stack([shown.unit(column) for column in raw])) / size[:, None]
        )
    coefficients = inverse @ shown.target
    rest = linearization.learner - sum((b * c for b, c in zip(coefficients, raw, strict=True)), 0.0)
    covariance = None if shown.covariance is None else inverse @ shown.covariance @ inverse.T
    return Fit(
        least_squares(linearization.physics_moves, linearization.fitted_values(rest)),
        coefficients,
        covariance,
    )


def settle_terms(space: Space, chosen: list[Candidate]) -> tuple[list[Candidate], Fit, bool]:
    """Return the terms whose coefficients are significant against the learner's own errors.

    The last value is whether any other was dropped.
    """
    fit, dropped = fit_terms(space, chosen), False
    while (weak := fit.doubtful()) is not None:
        chosen, dropped = chosen[:weak] + chosen[weak + 1 :], True
        fit = fit_terms(space, chosen)
    return chosen, fit, dropped


_TWINS = {"saturation": "dead_zone", "dead_zone": "saturation"}
"""Kinds whose terms of one width add up to their variable, so that either can replace the other."""


def nearest_twins(space: Space, chosen: list[Candidate], fit: Fit) -> tuple[list[Candidate], Fit]:
    """Return the terms with those of saturation and dead zone that move the physics least.

    Beside a spring an end stop is a dead zone, whose coefficient is the stop's stiffness, or a
    saturation that takes the stop from a spring as stiff: the same force, and another k.
    """
    for i, one in enumerate(chosen):
        if one.kind not in _TWINS or one.width is None:
            continue
        twin = replace(one, kind=_TWINS[one.kind]).wide(one.width)
        other = [*chosen[:i], twin, *chosen[i + 1 :]]
        if abs(_share(space, other) - _share(space, chosen)) > _SAME_SHARE:
            continue
        there = fit_terms(space, other)
        if _movement(space, there) < _movement(space, fit):
            chosen, fit = other, there
    return chosen, fit


def _movement(space: Space, fit: Fit) -> float:
    """Return by how much the parameters move, in logarithms; infinite where a sign changes."""
    now = np.asarray(space.linearization.values, dtype=float)
    then = np.asarray(space.linearization.moved(fit.along), dtype=float)
    known = (now != 0) & np.isfinite(now) & np.isfinite(then)
    ratio = then[known] / now[known]
    return float(np.sum(np.abs(np.log(ratio)))) if (ratio > 0).all() else np.inf


def rivals(
    space: Space, chosen: Sequence[Candidate], number: int, most: int = 3
) -> tuple[str, ...]:
    """Return other terms that could replace one and explain nearly as much."""
    columns = [space.column(one) for one in chosen]
    others = columns[:number] + columns[number + 1 :]
    gains = space.gains(others) + space.explained_share(others)
    near = gains >= space.explained_share(columns) - 2 * space.tie
    own = chosen[number]
    found = [
        space.candidates[int(i)]
        for i in np.argsort(-np.round(gains, _DIGITS), kind="stable")
        if near[int(i)]
    ]
    names = dict.fromkeys(one.name for one in found if one.identity != own.identity)
    return tuple(names)[:most]


def single_terms(space: Space, most: int) -> list[tuple[Candidate, float]]:
    """Return the terms that explain most if each is the only one, the best width of each."""
    gains, found = space.gains([]), []
    for i in np.argsort(-np.round(gains, _DIGITS), kind="stable"):
        candidate = space.candidates[int(i)]
        if gains[i] > 0 and all(candidate.identity != other.identity for other, _ in found):
            found.append((candidate, float(min(gains[i], 1.0))))
        if len(found) == most:
            break
    return found
