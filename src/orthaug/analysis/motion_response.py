"""How a motion's estimate answers to further terms in its equations: normal equations of the free run with them in it.

With S the sensitivities of the free run to the parameters' coordinates c, the terms' coefficients κ and what a learner
could hold h, the starts eliminated, a term of size κ that the fit does not know moves (c, h) by `(SᵀS)⁻¹ Sᵀ S_κ κ`:
estimate less truth. What the free run leaves, r, tells κ itself by one Gauss-Newton step, beside all that was fitted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector
from orthaug.analysis.waves import Waves, functions_of
from orthaug.fitting.block_scores import FreeRunScores
from orthaug.fitting.motion_course import MotionCourse
from orthaug.fitting.segments import sensitivity
from orthaug.models.dynamics import Numbers
from orthaug.models.learners import Bound
from orthaug.models.motion_model import MotionModel
from orthaug.models.moving import Moving
from orthaug.physics.suspected_motion import AddedTerm, SuspectedMotion

LOOSER = 1e-4  # times the weight of the guesses of the starts, as where standard errors are made
_UNSEEN = 1e-9  # of the largest eigenvalue of normal equations with unit columns: directions that nothing tells
ALIKE = 1e-6  # of a term's effect on the outputs: less than this beside what was fitted is rounding


@dataclass(frozen=True, eq=False)
class Place:
    """Where a free run is linearised: a course with its coordinates, its learner's weights, and its segments' starts."""

    course: MotionCourse
    c: Vector
    w: Vector
    states: Any
    weight: Matrix
    """(ny, ny), multiplies errors."""


@dataclass(frozen=True, eq=False)
class TermsResponse:
    """Normal equations of (c, κ, w, h), the starts eliminated; `fitted` are those that a fit has, κ left out.

    `form` and `numbers` are of the motion with the terms, and a learner of h beside its own.
    """

    place: Place
    form: Moving
    numbers: Numbers
    information: Matrix
    gradient: Vector
    slope: Any
    fitted: Bool[np.ndarray, "n"]
    terms: int

    @property
    def parameters(self) -> int:
        return len(self.place.c)

    def moved(self, k: int, apart: Bool[np.ndarray, "np"]) -> tuple[Vector, Float[np.ndarray, "n"]]:
        """What a unit of term k adds to c (np,), and to all unknowns; parameters in `apart` stay.

        Args:
            apart: those whose change the learner could undo, so that it holds it instead.
        """
        free = self.fitted.copy()
        free[: self.parameters] &= ~apart
        found = np.zeros(len(free))
        found[free] = _solved(self.information[np.ix_(free, free)], self.information[free, self.parameters + k])
        return found[: self.parameters], found

    def held(self, found: Vector, x: Matrix, u: Matrix) -> Matrix:
        """What the learner holds (M, nl) at states (M, nx) and inputs (M, nu), of what a term adds to all unknowns."""
        numbers, ny = self.numbers, self.form.bound.ny if self.form.bound else 0
        weights = found[len(found) - int(self.fitted[self.parameters :].sum()) :].reshape(ny, -1)
        z = (self.form.seen(x.T, u.T, np).T - numbers.centre) / numbers.halfwidth
        return numbers.gain * (weights @ functions_of(z.T, np)).T

    def cosine(self, k: int) -> float | None:
        """How much of the term's effect on the outputs the fit takes up, in [0, 1]; None where it has none."""
        own = self.information[self.parameters + k, self.parameters + k]
        return float(np.sqrt(np.clip(1 - self._beside(k)[1] / own, 0.0, 1.0))) if own > 0 else None

    def size(self, k: int) -> float:
        """RMS effect of a unit of the term on the outputs, in their deviations."""
        course, weight = self.place.course, self.place.weight
        whole = course.segments.count * float(np.sum((weight * course.deviation) ** 2))
        return float(np.sqrt(max(self.information[self.parameters + k, self.parameters + k], 0.0) / whole))

    def step(self, k: int) -> tuple[float, float, Vector] | None:
        """The coefficient that lowers what is left most, by how much that falls, and the row (n,) of scores it is.

        None where the fit could hold the term as well.
        """
        row, left = self._beside(k)
        if not left > ALIKE * self.information[self.parameters + k, self.parameters + k]:
            return None
        coefficient = float(row @ self.gradient / left)
        return coefficient, coefficient**2 * left, row / left

    def scores(self) -> FreeRunScores:
        """The scores of all unknowns, for standard errors that hold for coloured errors."""
        place, objective = self.place, self.place.course.objective()
        missed = np.moveaxis(np.asarray(place.course.segments.start) - place.states, -1, 1)
        prior = LOOSER**2 * objective.start_rows.T @ objective.start_rows
        made = (self.form, self.numbers, place.course.segments, place.states, place.weight)
        return FreeRunScores(*made, 1.0, self.slope, missed @ prior)

    def _beside(self, k: int) -> tuple[Vector, float]:
        """The row (n,) that takes what was fitted off the term, and what information on it is left."""
        i = self.parameters + k
        row = np.zeros(len(self.fitted))
        row[i] = 1.0
        across = self.information[self.fitted, i]
        row[self.fitted] = -_solved(self.information[np.ix_(self.fitted, self.fitted)], across)
        return row, float(self.information[i, i] + across @ row[self.fitted])


def respond_to(place: Place, added: tuple[AddedTerm, ...]) -> TermsResponse:
    """Linearise a free run with further terms, and with all that its learner could hold."""
    course, motion = place.course, place.course.problem.motion
    suspected = SuspectedMotion.of(motion, added)
    bound, features = None, course.problem.features
    if course.bound is not None:
        inner = course.bound.learner if len(place.w) else None
        bound = Bound(Waves(inner), len(features), sum(map(len, motion.learned)))
    form = replace(course.dynamics, motion=suspected, bound=bound, features=features if bound else ())
    held = 0 if bound is None else bound.size - len(place.w)
    c, w = np.concatenate([place.c, np.zeros(len(added))]), np.concatenate([place.w, np.zeros(held)])
    numbers = course.numbers(c, w)
    slopes = sensitivity(form, numbers, course.segments, place.states, place.weight)
    objective = course.objective()
    rows = LOOSER * objective.start_rows
    information, gradient, _, slope = objective.initial.eliminate(slopes, place.states, rows)
    low, high = motion.coordinates.bounds
    fitted = np.concatenate(
        [(low < place.c) & (place.c < high), np.zeros(len(added) + len(place.w), dtype=bool), np.ones(held, dtype=bool)]
    )
    return TermsResponse(place, form, numbers, information, gradient, slope, fitted, len(added))


def _solved(matrix: Matrix, right: Vector) -> Vector:
    """Least squares with unit columns; what nothing tells stays at 0."""
    if not len(matrix):
        return np.zeros(0)
    scale = 1 / np.sqrt(np.where(np.diag(matrix) > 0, np.diag(matrix), 1.0))
    values, vectors = np.linalg.eigh(matrix * scale * scale[:, None])
    kept = values > _UNSEEN * values[-1]
    vectors = vectors[:, kept]
    return scale * (vectors @ ((vectors.T @ (scale * right)) / values[kept]))


def place_of(model: MotionModel, course: MotionCourse, states: Any, weight: Matrix) -> Place:
    """Where a fitted model is."""
    c = np.asarray(model.numbers.theta - model.numbers.theta_aux)
    return Place(course, c, np.asarray(model.numbers.weights), states, weight)
