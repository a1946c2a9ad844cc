"""How a motion's estimate answers to further terms in its equations: normal equations of the free run with them in it.

With S the sensitivities of the free run to the parameters' coordinates c, the terms' coefficients κ and a learner's
weights w, the starts eliminated, a term of size κ that the fit does not know moves (c, w) by `(SᵀS + ridge)⁻¹SᵀS_κ κ`:
estimate less truth. What the free run leaves, r, tells κ itself by one Gauss-Newton step, beside all that was fitted.

Before any training waves stand for the learner. They can be any function of what it sees.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import Array, jax, jnp
from orthaug.analysis.absorbed import Waves
from orthaug.fitting.block_scores import FreeRunScores
from orthaug.fitting.motion_course import MotionCourse
from orthaug.fitting.segments import sensitivity
from orthaug.models.dynamics import Numbers
from orthaug.models.learners import Bound
from orthaug.models.moving import Moving
from orthaug.physics.suspected_motion import AddedTerm, SuspectedMotion

LOOSER = 1e-4  # times the weight of the guesses of the starts, as where standard errors are made
_UNSEEN = 1e-9  # of the largest eigenvalue of normal equations with unit columns: directions that nothing tells
ALIKE = 1e-6  # of a term's effect on the outputs: less than this beside what was fitted is rounding


@dataclass(frozen=True, eq=False)
class Place:
    """Where a free run is linearised: a course with its coordinates, its learner's weights and its segments' starts."""

    course: MotionCourse
    c: Vector
    w: Vector
    states: Any
    weight: Matrix
    """(ny, ny), multiplies errors."""
    ridge: float | Vector = 0.0
    """On the weights, in the unit of the weighted errors."""


@dataclass(frozen=True, eq=False)
class TermsResponse:
    """Normal equations of (c, κ, w), the starts eliminated; `fitted` are those that a fit has, κ left out.

    `form` and `numbers` are of the motion with the terms, with waves for a learner that is not trained yet.
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

    def moved(self, k: int, apart: Bool[np.ndarray, "np"]) -> tuple[Vector, Float[np.ndarray, "nw"]]:
        """What a unit of term k adds to c (np,), and to the weights; parameters in `apart` stay.

        Args:
            apart: those whose change the learner could undo, so that it holds it instead.
        """
        free = self.fitted.copy()
        free[: self.parameters] &= ~apart
        found = np.zeros(len(free))
        found[free] = solved(self.penalised[np.ix_(free, free)], self.information[free, self.parameters + k])
        return found[: self.parameters], found[self.parameters + self.terms :]

    @property
    def penalised(self) -> Matrix:
        """The information with the ridge."""
        ridge = np.zeros(len(self.fitted))
        ridge[self.parameters + self.terms :] = self.place.ridge
        return self.information + np.diag(ridge)

    def held(self, dw: Vector, x: Matrix, u: Matrix) -> Matrix:
        """What a change of the weights adds to the learner (M, nl) at states (M, nx) and inputs (M, nu)."""
        return np.asarray(_along(self.form, self.numbers, dw, x, u))

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
        pulled = np.zeros(len(row))
        pulled[self.parameters + self.terms :] = self.place.ridge * np.asarray(self.numbers.weights)
        coefficient = float(row @ (self.gradient - pulled) / left)
        return coefficient, coefficient**2 * left, row / left

    def squares(self) -> tuple[float, float]:
        """The sum of squares that the free run leaves, and as much of it as neighbouring steps do not share.

        The second is half the sum of squared differences (von Neumann 1941): all of white noise, little of what physics
        leaves out.
        """
        place = self.place
        errors = place.course.objective().errors(place.c, place.w, place.states, place.course.segments)
        errors = np.einsum("oi,ktim->ktom", place.weight, errors)
        scored = np.asarray(place.course.segments.scored)[:, :, None]
        pairs = scored[:, 1:] & scored[:, :-1]
        apart = float(np.sum(np.where(pairs, np.diff(errors, axis=1), 0.0) ** 2)) / 2
        whole = float(np.sum(errors**2))
        return whole, min(apart * float(scored.sum() / max(pairs.sum(), 1)), whole)

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
        row[self.fitted] = -solved(self.penalised[np.ix_(self.fitted, self.fitted)], across)
        return row, float(self.information[i, i] + across @ row[self.fitted])


def respond_to(place: Place, added: tuple[AddedTerm, ...]) -> TermsResponse:
    """Linearise a free run with further terms, and with all that its learner could hold."""
    course, motion = place.course, place.course.problem.motion
    suspected = SuspectedMotion.of(motion, added)
    bound, w = course.bound, place.w
    if bound is not None and not len(w):
        bound = Bound(Waves(), bound.nz, bound.ny)
        w = np.zeros(bound.size)
    form = replace(course.dynamics, motion=suspected, bound=bound)
    numbers = course.numbers(np.concatenate([place.c, np.zeros(len(added))]), w)
    slopes = sensitivity(form, numbers, course.segments, place.states, place.weight)
    objective = course.objective()
    rows = LOOSER * objective.start_rows
    information, gradient, _, slope = objective.initial.eliminate(slopes, place.states, rows)
    low, high = motion.coordinates.bounds
    inside = (low < place.c) & (place.c < high)
    fitted = np.concatenate([inside, np.zeros(len(added), dtype=bool), np.ones(len(w), dtype=bool)])
    return TermsResponse(place, form, numbers, information, gradient, slope, fitted, len(added))


def solved(matrix: Matrix, right: Vector) -> Vector:
    """Least squares with unit columns; what nothing tells stays at 0."""
    if not len(matrix):
        return np.zeros(0)
    scale = 1 / np.sqrt(np.where(np.diag(matrix) > 0, np.diag(matrix), 1.0))
    values, vectors = np.linalg.eigh(matrix * scale * scale[:, None])
    kept = values > _UNSEEN * values[-1]
    vectors = vectors[:, kept]
    return scale * (vectors @ ((vectors.T @ (scale * right)) / values[kept]))


@partial(jax.jit, static_argnames="form")
def _along(
    form: Moving, numbers: Numbers, dw: Float[Array, "nw"], x: Float[Array, "m nx"], u: Float[Array, "m nu"]
) -> Float[Array, "m nl"]:
    def learned(w: Any) -> Any:
        return jax.vmap(lambda x, u: form.learned(numbers._replace(weights=w), x, u))(x, u)

    return jax.jvp(learned, (jnp.asarray(numbers.weights),), (jnp.asarray(dw),))[1]
