"""Bias of θ by unmodelled terms: per unit of each suspect, and whether a measure can remove it.

With the truth `Y = Φθ* + Δ + E` (`eq:data_gen_sys_reformed_vect`) the estimate under a measure μ
errs by `θ̂ − θ* = Φ_μ⁺(Δ_μ − ε_μ)` (eq:error_val), ε the misfit of the whole model. Here Φ_μ and
Δ_μ are the rows multiplied by the square root of their weight.

A learner that sees only some features shares only some directions B of θ with the physics. Along
these alone the measure decides: the estimate errs by `d + B(Φ_μB)⁺G_μ`, d what the term moves c by
and G what the learner holds of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector, check_unique
from orthaug._base.errors import InputError
from orthaug._base.lines import percent
from orthaug.analysis.absorbed import TermAfterFit
from orthaug.analysis.suspects import Suspect
from orthaug.physics.excitation import excitation, require_rank
from orthaug.physics.output_weights import times
from orthaug.physics.projection import Projection

# Rows whose ‖φᵀδ‖ is below this share of the largest ‖φ‖‖δ‖: only weights of 1e12 could use them
NEGLIGIBLE = 1e-12
# Between Φa and Δ; below it the optimum of the linear program counts as zero
SMALLEST_COSINE = 1e-6
# Of (φᵀa)δ, rows and a of unit length; the linear program itself is solved to 1e-10
VIOLATION = 1e-9
WORKING_SET = 1000  # rows of the first linear program, and the most that are added at a time
MOST_ROUNDS = 50
IN_SPAN = 1e-10  # ‖P⊥Δ‖/‖Δ‖ below which Δ counts as physics

Removability = Literal["unremovable", "removable", "undecided", "orthogonal"]
RemovedBy = Literal["learner", "learner and measure", "learner in part", "measure", "nothing"]


@dataclass(frozen=True)
class Certificate:
    """Certificate that a measure on the given points can, or cannot, make φ and δ orthogonal.

    By Stiemke's lemma exactly one of the two holds: positive weights on all points with `Σ μ_k
    φ_kᵀδ_k = 0` (`removable`), or a direction a with `(φ_kᵀa)δ_k ≥ 0` on all points and `> 0` on
    some (`unremovable`). `undecided` is a numerical failure; `orthogonal` means that `φ_kᵀδ_k` is
    zero on every point.

    `direction` (nt,) is a in the units of θ, `Φa` of root mean square 1; `shares` (nt,) is the same
    with the columns of Φ scaled to root mean square 1 and the largest entry 1, to read. `cosine` is
    that between Φa and Δ, `positive` the fraction of points where `(φᵀa)δ > 0`: a measure on the
    rest alone is not excluded.
    """

    verdict: Removability
    direction: tuple[float, ...] | None = None
    shares: tuple[float, ...] | None = None
    cosine: float | None = None
    positive: float | None = None


@dataclass(frozen=True)
class SuspectedBias:
    """Bias of θ by a suspect, per unit of the suspect's coefficient.

    `bias` (nt,) is `Φ_μ⁺Δ_μ`, in the unit of θ per unit of the coefficient; `relative` the same
    divided by θ (None where θ is 0); `physical` the same for physical parameters, to first order;
    `expected` is `bias` times the guessed coefficient. `cosine` is `‖QᵀΔ‖/‖Δ‖` in [0, 1], 0 where
    the paper's `cond:special_PE` holds: None for Δ = 0. `explained` is the squared cosine between
    P⊥Δ and the learner's values, and `coefficient_found` that with which P⊥Δ fits them best: both
    None without a learner, or where Δ lies in the span of Φ.
    """

    suspect: Suspect
    names: tuple[str, ...]
    bias: tuple[float, ...]
    relative: tuple[float | None, ...] | None
    expected: tuple[float, ...] | None
    physical: tuple[tuple[str, float], ...] | None
    cosine: float | None
    explained: float | None
    coefficient_found: float | None
    certificate: Certificate | None
    seen: bool | None = None
    """Whether it is a function of what the learner sees, where that leaves some directions of θ to
    the fit.
    """

    @property
    def removed_by(self) -> RemovedBy | None:
        """Change that removes this bias from θ; None where none is known.

        A learner that sees the term removes its bias from all that the learner could not imitate.
        Along the shared directions a measure may remove the rest.
        """
        if self.seen and not any(self.bias):
            return "learner"
        verdict = self.certificate.verdict if self.certificate else "undecided"
        if self.seen is False:
            return "nothing" if any(self.bias) else None
        answers: dict[str, tuple[RemovedBy, RemovedBy]] = {
            "unremovable": ("nothing", "learner in part"),
            "removable": ("measure", "learner and measure"),
            "orthogonal": ("measure", "learner"),
        }
        return answers[verdict][bool(self.seen)] if verdict in answers else None

    @property
    def sentence(self) -> str:
        """The certificate in words; empty where none was sought."""
        certificate = self.certificate
        if self.seen is False:
            return (
                f"{self.suspect.name}: the learner does not see all of this term, so the term "
                "biases θ under every measure."
            )
        if certificate is None:
            return ""
        if certificate.verdict == "orthogonal":
            return (
                f"{self.suspect.name}: φᵀδ is zero on all of these points, so this term "
                "biases nothing there."
            )
        if certificate.verdict == "removable":
            return f"{self.suspect.name}: some weighting of these points leaves θ unbiased."
        if certificate.verdict == "undecided":
            return (
                f"{self.suspect.name}: whether a weighting of these points leaves θ unbiased "
                "could not be decided."
            )
        assert certificate.shares is not None and certificate.positive is not None
        terms = [
            f"{share:+.3g} {name}"
            for share, name in zip(certificate.shares, self.names, strict=True)
            if abs(share) > 5e-3
        ]
        return (
            f"{self.suspect.name}: no weighting that counts any of "
            f"{percent(certificate.positive, 3)} of these points leaves θ unbiased. There "
            f"(φᵀa)δ is positive, and it is nowhere negative; a = {' '.join(terms)} (columns "
            "scaled to root mean square 1). A measure can then only make the bias small."
        )

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers, text and None, for JSON."""
        certificate = self.certificate

        def by_name(values: tuple[float | None, ...] | None) -> dict[str, float | None] | None:
            return None if values is None else dict(zip(self.names, values, strict=True))

        memory = self.suspect.memory
        return {
            "name": self.suspect.name,
            "expression": self.suspect.expression,
            "memory": None if memory is None else memory.name,
            "output": self.suspect.output,
            "coefficient": self.suspect.coefficient,
            "bias": by_name(self.bias),
            "relative_bias": by_name(self.relative),
            "expected_bias": by_name(self.expected),
            "physical_bias": None if self.physical is None else dict(self.physical),
            "cosine": self.cosine,
            "seen": self.seen,
            "removed_by": self.removed_by,
            "explained": self.explained,
            "coefficient_found": self.coefficient_found,
            "certificate": None
            if certificate is None
            else {
                "verdict": certificate.verdict,
                "direction": by_name(certificate.direction),
                "shares": by_name(certificate.shares),
                "cosine": certificate.cosine,
                "positive": certificate.positive,
                "sentence": self.sentence,
            },
        }


def bias_table(
    projection: Projection,
    names: Sequence[str],
    suspects: Sequence[Suspect],
    deltas: Float[np.ndarray, "ns N ny"],
    *,
    gain: np.ndarray | None = None,
    theta: Vector | None = None,
    physical: Mapping[str, Sequence[float] | Vector] | None = None,
    learned: Matrix | None = None,
    certify: bool = True,
    directions: Matrix | None = None,
    absorbed: Sequence[TermAfterFit] | None = None,
) -> tuple[SuspectedBias, ...]:
    """Return one `SuspectedBias` for each suspect, under the measure of `projection`.

    Args:
        projection: of the rows of φ, their outputs multiplied by `gain`.
        names: the nt parameters.
        suspects: their forms; `deltas` (ns, N, ny) their values, as `suspects.suspect_columns`
            gives them.
        gain: a matrix (ny, ny) for all rows, or one of each row (N, ny, ny); None for none.
        theta: θ (nt,), for relative biases.
        physical: a row of dp/dθ (nt,) for each physical parameter p, by name.
        learned: the learner's values (N, ny) in the outputs' units, projected or not.
        certify: search for certificates, a linear program per suspect.
        directions: (nt, s) along which θ is split; None for all.
        absorbed: what the fit makes of each suspect, where `directions` are not all.

    Raises:
        InputError: shapes that do not fit, values that are not finite, suspects of one name;
            RankError for physics that the points do not determine.
    """
    names = tuple(names)
    if not names:
        raise InputError(
            "the physics has no parameters; there is nothing that a suspect could bias."
        )
    _check_shapes(projection, names, suspects, deltas, theta, physical, learned)
    gain = np.eye(deltas.shape[2]) if gain is None else _row_gain(gain, deltas.shape[1:])
    require_rank(excitation(projection.r, names), projection.q.shape[0] * projection.q.shape[1])
    tilde = (
        None
        if learned is None
        else orthogonal_part(projection, times(gain, np.asarray(learned)), directions)
    )
    entries = []
    for i, (suspect, delta) in enumerate(zip(suspects, deltas, strict=True)):
        if not np.all(np.isfinite(delta)):
            raise InputError(f"suspect '{suspect.name}' is not finite on every row.")
        part = None if absorbed is None else absorbed[i]
        weighted = times(gain, delta if part is None else part.held)
        bias = projection.solve_along(weighted, directions)
        bias = bias if part is None else part.moved + bias
        cosine, explained, coefficient = _overlaps(projection, weighted, tilde, directions)
        entries.append(
            SuspectedBias(
                suspect,
                names,
                _numbers(bias),
                None
                if theta is None
                else tuple(float(b / t) if t else None for b, t in zip(bias, theta, strict=True)),
                None if suspect.coefficient is None else _numbers(suspect.coefficient * bias),
                None
                if physical is None
                else tuple((p, float(np.dot(row, bias))) for p, row in physical.items()),
                cosine,
                explained,
                coefficient,
                find_certificate(projection, weighted, directions) if certify else None,
                None if part is None else part.seen,
            )
        )
    return tuple(entries)


def _overlaps(
    projection: Projection, delta: Matrix, tilde: Matrix | None, directions: Matrix | None
) -> tuple[float | None, float | None, float | None]:
    """Return cos(Δ, span Φ), R² of the learner's P⊥F on P⊥Δ, and the coefficient of that fit.

    All are taken along `directions` only.
    """
    size = np.abs(delta).max(initial=0.0)
    if size == 0:
        return None, None, None
    unit = delta / size  # squares of the smallest numbers would be lost
    norm = np.linalg.norm(unit)
    inside = projection.coordinates(unit)
    inside = inside if directions is None else projection.along(directions) @ inside
    cosine = float(min(np.linalg.norm(inside) / norm, 1.0))
    rest = orthogonal_part(projection, unit, directions)
    left = np.linalg.norm(rest)
    if tilde is None or not np.any(tilde) or left < IN_SPAN * norm:
        return cosine, None, None
    product = float(np.vdot(rest, tilde)) / left
    explained = (product / float(np.linalg.norm(tilde))) ** 2
    return cosine, float(min(explained, 1.0)), float(product / left / size)


def orthogonal_part(projection: Projection, values: Matrix, directions: Matrix | None) -> Matrix:
    """Return P⊥v, or what is left of v along some directions of θ."""
    if directions is None:
        return projection.orthogonal_part(values)
    return values - projection.phi @ projection.solve_along(values, directions)


def find_certificate(
    projection: Projection, delta: Float[np.ndarray, "N ny"], directions: Matrix | None = None
) -> Certificate:
    """Maximise `Σ (φᵀa)δ` subject to `(φᵀa)δ ≥ 0` on every point and `|a| ≤ 1`.

    The program is in the coordinates of Q, so that neither units nor conditioning of Φ matter; a
    row of several outputs counts the sum over them, weighted as in `projection`. The linear program
    is solved on a working set, to which the most violated rows are added until there are none: the
    optimum of a subset bounds that of all.

    Args:
        projection: of the weighted rows of φ.
        delta: δ weighted alike, (N, ny).
        directions: (nt, s), to look for a among these only; None for all.
    """
    if directions is not None:
        return _certificate_along(projection, delta, directions)
    from scipy.optimize import linprog  # slow to import

    size = np.abs(delta).max(initial=0.0)
    delta = delta / size if size > 0 else delta  # squares of the smallest numbers would be lost
    products = np.einsum("kon,ko->kn", projection.q, delta)
    lengths = np.linalg.norm(products, axis=1)
    largest = (np.linalg.norm(projection.q, axis=2) * np.abs(delta)).max(initial=0.0)
    kept = lengths > NEGLIGIBLE * largest
    if not kept.any():
        return Certificate("orthogonal")
    rows = products[kept] / lengths[kept, None]
    objective = products.sum(axis=0) / np.linalg.norm(delta)
    chosen = np.unique(np.linspace(0, len(rows) - 1, min(WORKING_SET, len(rows))).astype(int))
    for _ in range(MOST_ROUNDS):
        solved = linprog(
            -objective,
            A_ub=-rows[chosen],
            b_ub=np.zeros(len(chosen)),
            bounds=(-1, 1),
            method="highs",
            options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
        )
        if solved.x is None:
            return Certificate("undecided")
        a = solved.x
        # A ray that exists reaches the box; one that does not is only the program's own tolerance.
        if np.abs(a).max() < 0.5 or objective @ a < SMALLEST_COSINE * np.linalg.norm(a):
            return Certificate("removable")
        a = a / np.linalg.norm(a)
        margin = rows @ a
        violated = np.flatnonzero(margin < -VIOLATION)
        if not violated.size:
            return _certificate(projection, a, float(objective @ a), margin, len(products))
        worst = violated[np.argsort(margin[violated])[:WORKING_SET]]
        grown = np.union1d(chosen, worst)
        if len(grown) == len(chosen):
            break
        chosen = grown
    return Certificate("undecided")


def _certificate_along(projection: Projection, delta: Matrix, directions: Matrix) -> Certificate:
    """Return the certificate among some directions, as weights of all parameters."""
    directions = projection.without_null(directions)
    if not directions.shape[1]:
        return Certificate("orthogonal")
    found = find_certificate(Projection.factor(projection.phi @ directions), delta)
    if found.direction is None:
        return found
    direction = directions @ np.array(found.direction)
    shares = direction * np.linalg.norm(projection.phi, axis=(0, 1))
    return replace(
        found, direction=_numbers(direction), shares=_numbers(shares / np.abs(shares).max())
    )


def _certificate(
    projection: Projection, a: Vector, cosine: float, margin: Vector, points: int
) -> Certificate:
    # ‖Qa‖ = 1, so Φa has root mean square 1
    direction = projection.from_coordinates(a) * np.sqrt(points)
    sizes = (
        np.sqrt(np.square(projection.phi * projection.scale).sum(axis=(0, 1))) / projection.scale
    )
    shares = direction * sizes
    return Certificate(
        "unremovable",
        _numbers(direction),
        _numbers(shares / np.abs(shares).max()),
        cosine,
        float(np.sum(margin > VIOLATION) / points),
    )


def _numbers(values: Vector) -> tuple[float, ...]:
    return tuple(float(v) for v in values)


def _row_gain(gain: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return `gain`, checked against rows of the shape (N, ny)."""
    gain, ny = np.asarray(gain, dtype=float), shape[1]
    if gain.shape not in ((ny, ny), (*shape, ny)):
        raise InputError(
            f"`gain` has shape {gain.shape}, which does not fit rows of shape {shape}."
        )
    if not np.all(np.isfinite(gain)):
        raise InputError("`gain` must be finite.")
    return gain


def _check_shapes(
    projection: Projection,
    names: tuple[str, ...],
    suspects: Sequence[Suspect],
    deltas: np.ndarray,
    theta: Vector | None,
    physical: Mapping[str, Sequence[float] | Vector] | None,
    learned: Matrix | None,
) -> None:
    rows, ny, nt = projection.q.shape
    check_unique((suspect.name for suspect in suspects), "suspect")
    wanted: list[tuple[str, Any, tuple[int, ...]]] = [
        ("names", names, (nt,)),
        ("deltas", deltas, (len(suspects), rows, ny)),
    ]
    if theta is not None:
        wanted.append(("theta", theta, (nt,)))
    if learned is not None:
        wanted.append(("learned", learned, (rows, ny)))
    wanted += [(f"physical['{name}']", row, (nt,)) for name, row in (physical or {}).items()]
    for what, values, shape in wanted:
        if np.shape(values) != shape:
            raise InputError(f"`{what}` has shape {np.shape(values)}; expected {shape}.")
        if what not in ("names", "deltas") and not np.all(np.isfinite(values)):
            raise InputError(f"`{what}` must be finite numbers.")
