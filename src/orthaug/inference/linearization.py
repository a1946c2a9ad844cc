"""The fitted physics linearised over the points of a measure: what θ follows, and what is left.

With J the slopes of the learned equations by θ (Φ itself where the physics is linear in θ), B the
directions of θ that the learner could imitate, and rows multiplied by the root of their weight,

    moved = B(JB)⁺v,    rest = v − J·moved,    share = (rest'·own)² / (‖rest‖²‖own‖²)

for the values v of a term, `own` the rest of the learner. This is the same for difference equations
and for equations of motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug.physics.projection import Projection

# Rows whose ‖φᵀδ‖ is below this share of the largest ‖φ‖‖δ‖: only weights of 1e12 could use them
NEGLIGIBLE = 1e-12
# Between Φa and Δ; below it the optimum of the linear program counts as zero
SMALLEST_COSINE = 1e-6
# Of (φᵀa)δ, rows and a of unit length; the linear program itself is solved to 1e-10
VIOLATION = 1e-9
WORKING_SET = 1000  # rows of the first linear program, and the most that are added at a time
MOST_ROUNDS = 50
IN_SPAN = 1e-8  # ‖rest‖/‖Δ‖ below which Δ counts as physics: rounding of nearly dependent columns

Removability = Literal["unremovable", "removable", "undecided", "orthogonal"]


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


class TermEffect(NamedTuple):
    """Effect of a term on θ and on the learner, per unit of its coefficient.

    `share` is the squared cosine between the rests of term and learner, `coefficient` that of the
    term which fits the learner best: None without a learner, or where the term is physics.
    """

    moved: Vector
    share: float | None
    coefficient: float | None


@dataclass(frozen=True, eq=False)
class Linearization:
    """The fitted physics linearised over the points of a measure, rows weighted.

    Args:
        jacobian: ∂f/∂θ of the learned outputs or equations, (M, ny, nθ).
        basis: (nθ, s) directions of θ that the learner could imitate; None for all.
        learner: its values there, weighted alike (M, ny); None without one.
    """

    jacobian: Projection
    basis: Matrix | None = None
    learner: Matrix | None = None

    def project(self, values: Matrix) -> Vector:
        """Return B(JB)⁺v (nθ,): by how much weighted values (M, ny) move θ."""
        return self.jacobian.solve_along(values, self.basis)

    def residual(self, values: Matrix) -> Matrix:
        """Return the part of weighted values (M, ny) that no shared direction explains."""
        if self.basis is None:
            return self.jacobian.orthogonal_part(values)
        if not self.basis.shape[1]:
            return values
        return values - self.jacobian.phi @ self.project(values)

    @cached_property
    def unshared_learner(self) -> Matrix | None:
        """The part of the learner (M, ny) that no shared direction explains; None without one."""
        return None if self.learner is None else self.residual(self.learner)

    def explain(self, term: Matrix) -> TermEffect:
        """Return the effect of a term, by its weighted values (M, ny)."""
        moved, own = self.project(term), self.unshared_learner
        size = np.abs(term).max(initial=0.0)
        if own is None or not size > 0 or not np.any(own):
            return TermEffect(moved, None, None)
        unit = term / size  # squares of the smallest numbers would be lost
        rest = self.residual(unit)
        left = float(np.linalg.norm(rest))
        if left <= IN_SPAN * np.linalg.norm(unit):
            return TermEffect(moved, None, None)
        product = float(np.vdot(rest, own)) / left
        share = (product / float(np.linalg.norm(own))) ** 2
        return TermEffect(moved, float(min(share, 1.0)), float(product / left / size))

    def cosine(self, term: Matrix) -> float | None:
        """Return the cosine between a term and the shared directions; None for a term of zeros."""
        size = np.abs(term).max(initial=0.0)
        if not size > 0:
            return None
        unit = term / size
        inside = self.jacobian.coordinates(unit)
        if self.basis is not None:
            kept = self.jacobian.without_null(self.basis)
            inside = self.jacobian.along(kept) @ inside
        return float(min(np.linalg.norm(inside) / np.linalg.norm(unit), 1.0))

    def certificate(self, term: Matrix) -> Certificate:
        """Return whether a measure on these points can make a term orthogonal to the directions."""
        return find_certificate(self.jacobian, term, self.basis)


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
