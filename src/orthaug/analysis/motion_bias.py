"""What terms that a motion's equations may lack do to its parameters, and what tells of them.

The free run answers for what the fit determines: a term moves these parameters as `motion_response` says. Along the
directions that the learner could imitate the nearest physics decides, so that there a term moves p̂ by what the measure
makes of it: `d + B(Φ_μB)⁺G_μ` with d what the term moves c by, Φ the slopes ∂f/∂q of the learned equations over the
measure's points, and G what the learner holds of the term: all of it, and d = 0, where it is a function of what the
learner sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool

from orthaug._base.checks import Matrix, Vector
from orthaug.analysis.absorbed import completing
from orthaug.analysis.bias import IN_SPAN, Certificate, SuspectedBias, find_certificate
from orthaug.analysis.motion_response import Place, TermsResponse, respond_to
from orthaug.analysis.motion_suspects import MotionSuspect
from orthaug.inference.motion_split import Field, slopes_at
from orthaug.physics.motion import Motion
from orthaug.physics.projection import Projection
from orthaug.physics.shared import Shared, moves

_SAME = 1e-6  # of its size: what a term may change over a move that the learner does not see
CERTIFIED_POINTS = 20_000  # of a measure at most, over which certificates are sought


@dataclass(frozen=True)
class Told:
    """What the free run's residual tells of a term beside all that was fitted: one Gauss-Newton step.

    `share` is by how much of the residual's squares it falls.
    """

    coefficient: float
    std: float | None
    t: float | None
    share: float


@dataclass(frozen=True, eq=False)
class TermBias:
    """What a term of a motion does to its parameters if it is there.

    `moved` (np,) are the coordinates of p̂ less those without the term, per unit of its coefficient.
    """

    suspect: MotionSuspect
    equation: str
    names: tuple[str, ...]
    moved: Vector
    per_unit: Vector
    """The same of p̂, to first order."""
    value: Vector
    expected: Vector | None
    """p̂ less p without the term, of the guessed coefficient."""
    cosine: float | None
    size: float
    seen: bool | None
    explained: float | None
    coefficient_found: float | None
    certificate: Certificate | None
    residual: Told | None

    @property
    def removed_by(self) -> str | None:
        """What leaves the parameters unbiased by it; None where that is not known, or nothing is to remove."""
        if self.seen is None:
            return "nothing" if self.moved.any() else None
        return self._told.removed_by

    @property
    def _told(self) -> SuspectedBias:
        relative = [b / v if v else None for b, v in zip(self.per_unit, self.value, strict=True)]
        shown: Any = self.suspect
        own = (self.names, tuple(self.per_unit), tuple(relative), None if self.expected is None else (*self.expected,))
        found = (self.cosine, self.explained, self.coefficient_found, self.certificate, self.seen)
        return SuspectedBias(shown, *own, None, *found)

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, text and None, for JSON."""
        return self._told.as_dict() | {
            "removed_by": self.removed_by,
            "equation": self.equation,
            "unit": self.suspect.unit,
            "size": self.size,
            "relative_physical_bias": None,
            "expected_physical_bias": None,
            "residual": self.residual,
        }


@dataclass(frozen=True, eq=False)
class MotionGround:
    """What biases of a motion are computed on: where it is linearised, and the points that p̂ was split over.

    Args:
        q: coordinates of p̂; those in `shared` directions are told by the nearest physics.
        field: the measure's points.
        learned: the learner (M, nl) there beside p̂; None before a fit, and without one.
        unknown: parameters that no output tells: a term does anything to them.
    """

    place: Place
    q: Vector
    shared: Shared
    field: Field
    learned: Matrix | None = None
    unknown: tuple[str, ...] = ()

    @property
    def motion(self) -> Motion:
        return self.place.course.problem.motion

    @property
    def learns(self) -> bool:
        """Whether there is a learner."""
        return self.place.course.bound is not None

    @cached_property
    def phi(self) -> Projection:
        """∂f/∂q of the learned equations over the points, rows times the root of their weights over their sizes."""
        states, outputs = self.motion.learned
        rows = [*states, *(len(self.motion.states) + i for i in outputs)]
        slopes = np.asarray(slopes_at(self.place.course.dynamics.alone, self.q, self.field.x, self.field.u))[:, rows]
        return Projection.factor(self._weighed(np.moveaxis(slopes, 2, 0)).transpose(1, 2, 0))

    def _weighed(self, rows: np.ndarray) -> np.ndarray:
        return rows * np.sqrt(self.field.weight)[:, None] / self.field.size

    def table(
        self, suspects: Sequence[MotionSuspect], used: float | None = None, steps: int | None = None
    ) -> list[TermBias]:
        """What every suspect does; nothing where the free run has no sensitivities.

        Args:
            used: weights that a fit used, where it is asked what its residual tells; `steps` of a block, where its
                errors are coloured.
        """
        added = tuple(suspect.term(self.motion) for suspect in suspects)
        response = respond_to(self.place, added)
        if not np.isfinite(response.information).all() or not np.isfinite(response.gradient).all():
            return []
        residuals = [None] * len(added) if used is None else told_by_residual(response, used, steps)
        return [self._entry(response, k, suspect, residuals[k]) for k, suspect in enumerate(suspects)]

    def _entry(self, response: TermsResponse, k: int, suspect: MotionSuspect, residual: Told | None) -> TermBias:
        motion, names = self.motion, self.motion.names
        place = suspect.place(motion)
        basis, certificate, explained, found = self.shared.basis, None, None, None
        seen = self._seen(suspect, place) if self.learns else None
        apart = ~np.isin(np.arange(len(names)), completing(basis))
        moved, unknowns = response.moved(k, apart)
        if self.learns:
            delta = self._rows(suspect, place)
            held = delta if seen else response.held(unknowns, self.field.x, self.field.u)
            held = self._weighed(held)
            moved = np.zeros(len(names)) if seen else moved
            if basis.shape[1]:
                moved = moved + self.phi.solve_along(held, basis)
                if len(held) <= CERTIFIED_POINTS and np.any(delta):
                    certificate = find_certificate(self.phi, self._weighed(delta), basis)
            explained, found = self._explained(held)
        moved = np.where(np.isin(names, self.unknown), np.nan, moved)
        coordinates = motion.coordinates
        value = coordinates.physical(self.q)
        expected = None
        if suspect.coefficient is not None:
            expected = value - coordinates.physical(self.q - suspect.coefficient * moved)
        known = (*motion.names_of_states, *(output.name for output in motion.outputs))
        per_unit = coordinates.slopes(self.q) * moved
        own = (suspect, known[place], names, moved, per_unit, value, expected)
        told = (response.cosine(k), response.size(k), seen, explained, found, certificate)
        return TermBias(*own, *told, None if seen else residual)

    def _rows(self, suspect: MotionSuspect, place: int) -> Matrix:
        """The term (M, nl) in the learned equations, 0 where it acts elsewhere."""
        states, outputs = self.motion.learned
        places = [*states, *(len(self.motion.states) + i for i in outputs)]
        rows = np.zeros((len(self.field.x), len(places)))
        if place in places:
            p = self.motion.coordinates.physical(self.q)
            rows[:, places.index(place)] = suspect.values(self.motion, p, self.field.x, self.field.u)
        return np.where(np.isfinite(rows), rows, 0.0)

    def _explained(self, held: Matrix) -> tuple[float | None, float | None]:
        """How much of the learner a term explains, and with which coefficient, beside the shared directions."""
        if self.learned is None:
            return None, None

        def left(values: Matrix) -> Matrix:
            basis = self.shared.basis
            return values - self.phi.phi @ self.phi.solve_along(values, basis) if basis.shape[1] else values

        rest, tilde, size = left(held), left(self._weighed(self.learned)), np.linalg.norm(held)
        norm = np.linalg.norm(rest)
        if not np.any(tilde) or norm <= IN_SPAN * size:
            return None, None
        product = float(np.vdot(rest, tilde)) / norm
        return float(min((product / np.linalg.norm(tilde)) ** 2, 1.0)), float(product / norm)

    def _seen(self, suspect: MotionSuspect, place: int) -> bool:
        """Whether the learner is added where the term acts, and the term is a function of what the learner sees."""
        states, outputs = self.motion.learned
        if place not in (*states, *(len(self.motion.states) + i for i in outputs)):
            return False
        start, end = self._moves
        p, nx = self.motion.coordinates.physical(self.q), len(self.motion.states)
        pairs = np.stack([suspect.values(self.motion, p, x[:, :nx], x[:, nx:]) for x in (start, end)])
        there: Bool[np.ndarray, "M"] = np.isfinite(pairs).all(axis=0)
        pairs = pairs[:, there]
        size = np.sqrt(np.mean(pairs**2)) if pairs.size else 0.0
        return bool(np.abs(pairs[1] - pairs[0]).max(initial=0.0) <= _SAME * size)

    @cached_property
    def _moves(self) -> tuple[Matrix, Matrix]:
        """Pairs of points that the learner does not tell apart."""
        form, nx = self.place.course.dynamics, len(self.motion.states)
        points = np.concatenate([self.field.x, self.field.u], axis=1)
        return moves(lambda rows: np.asarray(form.seen(rows[:, :nx].T, rows[:, nx:].T, np)).T, points)


def told_by_residual(response: TermsResponse, used: float, steps: int | None) -> list[Told | None]:
    """What the residual tells of every term, with standard errors that hold for coloured errors where `steps` is given.

    Args:
        used: weights that the fit used.
    """
    place, parameters = response.place, response.parameters
    course = place.course
    with np.errstate(all="ignore"):
        errors = course.objective().errors(place.c, place.w, place.states, course.segments)
        whole = float(np.sum(np.einsum("oi,ktim->ktom", place.weight, errors) ** 2))
    white = whole / max(course.residuals - parameters - used, 1.0)
    middle = None if steps is None else response.scores().middle(steps, parameters + used)[0]
    found: list[Told | None] = []
    for k in range(response.terms):
        step = response.step(k)
        if step is None or not whole > 0:
            found.append(None)
            continue
        coefficient, fall, row = step
        alone = white * float(row @ response.information @ row)
        variance = alone if middle is None else float(row @ middle @ row)
        std = float(np.sqrt(variance)) if variance > 0 else None
        found.append(Told(coefficient, std, None if std is None else coefficient / std, min(fall / whole, 1.0)))
    return found
