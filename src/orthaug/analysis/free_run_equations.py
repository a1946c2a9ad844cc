"""Normal equations of a free run: the response of an estimate to further terms in its physics.

With S the sensitivities of the free run to the parameters' coordinates c, the terms' coefficients κ
and a learner's weights w, the starts eliminated, a term of size κ that the fit does not know moves
(c, w) by `(SᵀS + ridge)⁻¹SᵀS_κ κ`: estimate less truth. What the free run leaves, r, determines κ
by one Gauss-Newton step, beside all that was fitted.

Before any training waves take the learner's place. They can be any function of what it sees.

How much of the estimate is an error of its integrator follows likewise. With Δy what twice as many
substeps add to the outputs, a fit with them ends at `(c, w) − (SᵀS + ridge)⁻¹SᵀΔy`. S is that of
the coarse steps; what finer ones change in it acts on the residual, which hardly follows S, while
Δy follows it as the outputs do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug._base.jax import Array, jax, jnp, quick_jit
from orthaug._base.lines import percent
from orthaug.analysis.absorbed import Waves
from orthaug.fitting.block_scores import FreeRunScores
from orthaug.fitting.initial_states import InitialStates
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.fitting.segmented_motion import SegmentedMotion
from orthaug.fitting.segments import Segments, packed, respond, sensitivity, sensitivity_once
from orthaug.models.dynamics import Numbers
from orthaug.models.learners import Bound
from orthaug.models.moving import MotionDynamics
from orthaug.models.statistics import prior_of
from orthaug.physics.motion import MOST_SUBSTEPS
from orthaug.physics.suspected_motion import SuspectedMotion, SuspectedTerm

LOOSER = 1e-4  # times the weight of the guesses of the starts, as where standard errors are made
# Directions without information: below so much of the largest eigenvalue, with unit columns.
_UNSEEN = 1e-9
ALIKE = 1e-6  # of a term's effect on the outputs: less than this beside what was fitted is rounding
_LARGE = 0.1  # standard errors
_LARGE_SHARE = 1e-3  # of a parameter that has no standard error


@dataclass(frozen=True, eq=False)
class FreeRunPoint:
    """Point of a free run's linearization: segments, coordinates, learner's weights, starts."""

    segmented: SegmentedMotion
    c: Vector
    w: Vector
    states: np.ndarray
    weight: Matrix
    """(ny, ny), multiplies errors."""
    ridge: float | Vector = 0.0
    """On the weights, in the unit of the weighted errors."""

    @classmethod
    def of(cls, fit: MotionEstimate) -> FreeRunPoint | None:
        """Return the point at which training ended; None without normal equations."""
        if fit.scores is None:
            return None
        c, w = np.asarray(fit.model.numbers.c), np.asarray(fit.model.numbers.weights)
        ridge = fit.model.statistics.ridge / fit.scores.unit
        return cls(fit.segmented, c, w, fit.states, fit.scores.weight, ridge)

    @property
    def inside(self) -> Bool[np.ndarray, "np"]:
        """Mask of the coordinates that are not at a bound."""
        return self.segmented.problem.motion.coordinates.inside(self.c)

    @property
    def start_rows(self) -> Matrix:
        """L of the guesses of the starts."""
        return LOOSER * self.segmented.objective().start_rows

    def respond(self, c: Vector, w: Vector) -> Any:
        """Return the outputs (k, T, ny, m) of the free run from the same starts, for any (c, w)."""
        run = self.segmented
        return respond(run.dynamics, run.numbers(c, w), run.segments, self.states)

    def moved_by(self, outputs: Float[np.ndarray, "k T ny m"]) -> Vector | None:
        """Return by how much (c, w) move with what `outputs` differ from the free run.

        That is `(SᵀS + ridge)⁻¹SᵀΔy`, to first order; a coordinate at its bound does not move. None
        where the information is not finite.

        Args:
            outputs: those of the free run over the segments, with an effect on them.
        """
        segmented, at = self.segmented, np.asarray(self.states)
        moved = segmented.segments._replace(target=outputs)
        numbers = segmented.numbers(self.c, self.w)
        slopes = sensitivity(segmented.dynamics, numbers, moved, at, self.weight)
        starts = InitialStates(at, free=True)
        information, gradient = starts.eliminate(slopes, at, self.start_rows)[:2]
        if not np.isfinite(information).all() or not np.isfinite(gradient).all():
            return None
        free = np.concatenate([self.inside, np.ones(len(self.w), dtype=bool)])
        penalised = information + np.diag(prior_of(information, self.ridge, len(self.c)))
        step = np.zeros(len(free))
        step[free] = solve_scaled(penalised[np.ix_(free, free)], gradient[free])
        return step


@dataclass(frozen=True, eq=False)
class TermEquations:
    """Normal equations of (c, κ, w), the starts eliminated.

    `fitted` are those that a fit has, κ left out.

    `form` and `numbers` are of the motion with the terms, with waves for a learner that is not
    trained yet.
    """

    place: FreeRunPoint
    form: MotionDynamics
    numbers: Numbers
    information: Matrix
    gradient: Vector
    slope: np.ndarray | None
    fitted: Bool[np.ndarray, "n"]
    terms: int
    segments: Segments
    """Those of the place, with the signals of terms with memory."""

    @property
    def parameters(self) -> int:
        return len(self.place.c)

    def moved(
        self, k: int, apart: Bool[np.ndarray, "np"]
    ) -> tuple[Vector, Float[np.ndarray, "nw"]]:
        """Return the changes of c (np,) and of the weights by a unit of term k.

        Parameters in `apart` stay.

        Args:
            apart: those whose change the learner could undo, so that it holds it instead.
        """
        free = self.fitted.copy()
        free[: self.parameters] &= ~apart
        found = np.zeros(len(free))
        found[free] = solve_scaled(
            self.penalised[np.ix_(free, free)], self.information[free, self.parameters + k]
        )
        return found[: self.parameters], found[self.parameters + self.terms :]

    @property
    def penalised(self) -> Matrix:
        """The information with the ridge."""
        nt = self.parameters + self.terms
        return self.information + np.diag(prior_of(self.information, self.place.ridge, nt))

    def held(self, dw: Vector, x: Matrix, u: Matrix) -> Matrix:
        """Return the learner's change (M, nl) by a change of weights, at x (M, nx), u (M, nu)."""
        return np.asarray(_learned_change(self.form, self.numbers, dw, x, u))

    def cosine(self, k: int) -> float | None:
        """Return the share of the term's effect on the outputs that the fit takes up, in [0, 1].

        None where it has none.
        """
        own = self.information[self.parameters + k, self.parameters + k]
        return (
            float(np.sqrt(np.clip(1 - self._remaining_information(k)[1] / own, 0.0, 1.0)))
            if own > 0
            else None
        )

    def size(self, k: int) -> float:
        """Return the RMS effect of a unit of the term on the outputs, in their deviations."""
        segmented, weight = self.place.segmented, self.place.weight
        counts = segmented.observations
        whole = float(np.sum(counts * (weight * segmented.deviation) ** 2))
        return float(
            np.sqrt(max(self.information[self.parameters + k, self.parameters + k], 0.0) / whole)
        )

    def step(self, k: int) -> tuple[float, float, Vector] | None:
        """Return a term's best coefficient, the decrease of squares, and its row (n,) of scores.

        None where the fit could hold the term as well.
        """
        row, left = self._remaining_information(k)
        if not left > ALIKE * self.information[self.parameters + k, self.parameters + k]:
            return None
        pulled = np.zeros(len(row))
        pulled[self.parameters + self.terms :] = self.place.ridge * np.asarray(self.numbers.weights)
        coefficient = float(row @ (self.gradient - pulled) / left)
        return coefficient, coefficient**2 * left, row / left

    def squares(self) -> tuple[float, float]:
        """Return the free run's sum of squares, and the part that neighbouring steps do not share.

        The second is half the sum of squared differences (von Neumann 1941): all of white noise,
        little of what physics leaves out.
        """
        place = self.place
        errors = place.segmented.objective().errors(
            place.c, place.w, place.states, place.segmented.segments
        )
        segments = place.segmented.segments
        errors = np.einsum("oi,ktim->ktom", place.weight, packed(errors, segments))
        scored = packed(segments.measured, segments)
        pairs = scored[:, 1:] & scored[:, :-1]
        apart = float(np.sum(np.where(pairs, np.diff(errors, axis=1), 0.0) ** 2)) / 2
        whole = float(np.sum(errors**2))
        return whole, min(apart * float(scored.sum() / max(pairs.sum(), 1)), whole)

    def scores(self) -> FreeRunScores:
        """Return the scores of all unknowns, for standard errors that hold for coloured errors."""
        place, objective = self.place, self.place.segmented.objective()
        missed = np.moveaxis(np.asarray(place.segmented.segments.start) - place.states, -1, 1)
        prior = LOOSER**2 * objective.start_rows.T @ objective.start_rows
        made = (self.form, self.numbers, self.segments, place.states, place.weight)
        return FreeRunScores(*made, 1.0, self.slope, missed @ prior)

    def _remaining_information(self, k: int) -> tuple[Vector, float]:
        """Return the row (n,) that removes the fit from the term, and the remaining information."""
        i = self.parameters + k
        row = np.zeros(len(self.fitted))
        row[i] = 1.0
        across = self.information[self.fitted, i]
        row[self.fitted] = -solve_scaled(self.penalised[np.ix_(self.fitted, self.fitted)], across)
        return row, float(self.information[i, i] + across @ row[self.fitted])


def respond_to(place: FreeRunPoint, added: tuple[SuspectedTerm, ...]) -> TermEquations:
    """Linearise a free run with further terms, and with all that its learner could hold."""
    motion = place.segmented.problem.motion
    segmented = place.segmented.with_signals(_signals(place, added))
    suspected = SuspectedMotion.of(motion, added)
    bound, w = segmented.bound, place.w
    if len(w) < bound.size:  # a learner that is not trained yet
        bound = Bound(Waves(), bound.nz, bound.ny)
        w = np.zeros(bound.size)
    form = replace(segmented.dynamics, motion=suspected, bound=bound)
    numbers = segmented.numbers(np.concatenate([place.c, np.zeros(len(added))]), w)
    slopes = sensitivity_once(form, numbers, segmented.segments, place.states, place.weight)
    initial = segmented.objective().initial
    information, gradient, _, slope = initial.eliminate(slopes, place.states, place.start_rows)
    fitted = np.concatenate(
        [place.inside, np.zeros(len(added), dtype=bool), np.ones(len(w), dtype=bool)]
    )
    own = (information, gradient, slope, fitted, len(added), segmented.segments)
    return TermEquations(place, form, numbers, *own)


def _signals(place: FreeRunPoint, added: Sequence[SuspectedTerm]) -> list[Matrix]:
    """Return the signals of terms with memory along every experiment, (N, ns)."""
    signals = [term.signal for term in added if term.signal is not None]
    if not signals:
        return []
    segmented, motion = place.segmented, place.segmented.problem.motion
    p, step = motion.coordinates.physical(place.c), segmented.record.sampling_time
    states = segmented.states_by_row(place.c, place.w, place.states)
    form, numbers = segmented.dynamics, segmented.numbers(place.c, place.w)
    rows = [form.inputs(one, segmented.record) for one in segmented.record.experiments]
    inputs = [form.at_samples(numbers, x, row) for x, row in zip(states, rows, strict=True)]
    return [
        np.stack([signal.along(motion, p, x, u, step) for signal in signals], axis=1)
        for x, u in zip(states, inputs, strict=True)
    ]


def solve_scaled(matrix: Matrix, right: Vector) -> Vector:
    """Return least squares with unit columns; unknowns without information stay 0."""
    if not len(matrix):
        return np.zeros(0)
    scale = 1 / np.sqrt(np.where(np.diag(matrix) > 0, np.diag(matrix), 1.0))
    values, vectors = np.linalg.eigh(matrix * scale * scale[:, None])
    kept = values > _UNSEEN * values[-1]
    vectors = vectors[:, kept]
    return scale * (vectors @ ((vectors.T @ (scale * right)) / values[kept]))


@partial(quick_jit, static_argnames="form")
def _learned_change(
    form: MotionDynamics,
    numbers: Numbers,
    dw: Float[Array, "nw"],
    x: Float[Array, "m nx"],
    u: Float[Array, "m nu"],
) -> Float[Array, "m nl"]:
    def learned_output(w: Array) -> Array:
        return jax.vmap(lambda x, u: form.learned(numbers._replace(weights=w), x, u))(x, u)

    return jax.jvp(learned_output, (jnp.asarray(numbers.weights),), (jnp.asarray(dw),))[1]


@dataclass(frozen=True, eq=False)
class SubstepBias:
    """p̂ less what a fit with twice the `substeps` gives, to first order (np,)."""

    names: tuple[str, ...]
    substeps: int
    value: Vector
    errors: Vector
    """Its size in standard errors (np,); NaN where there are none."""
    warnings: tuple[Warning, ...] = ()

    def as_dict(self) -> dict[str, float]:
        """Return the biases by parameter."""
        return dict(zip(self.names, map(float, self.value), strict=True))


def substep_bias(fit: MotionEstimate) -> SubstepBias | None:
    """Return the part of p̂ that is the integrator's.

    None of a motion that is not integrated, or without normal equations.

    Args:
        fit: of a motion, from `estimate`.

    Returns:
        p̂ less what a fit with twice the substeps would give, to first order, in the units of p and
        in standard errors.
    """
    motion, place = fit.problem.motion, FreeRunPoint.of(fit)
    substeps = fit.segmented.dynamics.substeps
    if (
        motion.scheme.discrete
        or place is None
        or fit.split_by.slope is None
        or 2 * substeps > MOST_SUBSTEPS
    ):
        return None
    finer = replace(place, segmented=fit.segmented.with_substeps(2 * substeps))
    step = place.moved_by(finer.respond(place.c, place.w))
    if step is None:
        return None
    value = fit.moved_by(step)
    errors = np.abs(value) / np.where(fit.known_std > 0, fit.known_std, np.nan)
    found = SubstepBias(motion.names, substeps, value, errors)
    return replace(found, warnings=_warnings(found, fit))


def _warnings(found: SubstepBias, fit: MotionEstimate) -> tuple[Warning, ...]:
    """Return one sentence on the parameters that finer steps would move."""
    shifts = []
    for name, moved, errors, value in zip(
        found.names, found.value, found.errors, fit.values, strict=True
    ):
        share = f", {percent(moved / value, sign='+')}" if value else ""
        if np.isfinite(errors) and errors > _LARGE:
            shifts.append(f"{name} by {moved:+.2g} ({errors:.2g} standard errors{share})")
        elif (
            np.isnan(errors)
            and name not in fit.unidentified
            and abs(moved) > _LARGE_SHARE * abs(value)
        ):
            per_cent = share.replace(",", " (", 1).replace("( ", "(") + (")" if share else "")
            shifts.append(f"{name} by {moved:+.2g}{per_cent}")
    if not shifts:
        return ()
    steps = f"{found.substeps} substep{'s' * (found.substeps > 1)} in a sample"
    text = (
        f"the integrator is too coarse for the parameters: with {steps} instead of "
        f"{2 * found.substeps} substeps the fit moves {', '.join(shifts)}; give substeps = "
        f"{2 * found.substeps} or more."
    )
    return (Warning("too_few_substeps", text),)
