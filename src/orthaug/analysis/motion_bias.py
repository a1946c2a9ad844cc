"""Bias of a motion's parameters by terms that its equations may lack, and the evidence for them.

The free run answers for what the fit determines: a term moves these parameters as `motion_response`
says. Along the directions that the learner could imitate the nearest physics decides, so that there
a term moves p̂ by what the measure
makes of it: `d + B(Φ_μB)⁺G_μ` with d what the term moves c by, Φ the slopes ∂f/∂q of the learned
equations over the measure's points, and G what the learner holds of the term: all of it, and d = 0,
where it is a function of what the learner sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector, check_type
from orthaug.analysis.absorbed import complementary_parameters
from orthaug.analysis.bias import IN_SPAN, Certificate, SuspectedBias, find_certificate
from orthaug.analysis.motion_response import FreeRunPoint, TermsResponse, respond_to
from orthaug.analysis.motion_suspects import (
    MotionSuspect,
    check_motion_suspects,
    equations_of,
    soften_jumps,
    usual_motion_suspects,
)
from orthaug.analysis.robustness import block_of
from orthaug.fitting.field_points import field_under
from orthaug.fitting.motion_estimates import MotionEstimate
from orthaug.fitting.motion_task import MotionTask
from orthaug.fitting.structures import Structure
from orthaug.inference.motion_split import (
    Field,
    MotionSplit,
    learned_places,
    shared_of_motion,
    slopes_at,
)
from orthaug.models.motion_field import parts_at
from orthaug.physics.motion import Motion
from orthaug.physics.projection import Projection
from orthaug.physics.shared import SharedDirections, moves

_SAME = 1e-6  # of its size: what a term may change over a move that the learner does not see
# Of a measure at most, over which certificates and terms of each equation are sought
CERTIFIED_POINTS = 20_000


@dataclass(frozen=True)
class ResidualStep:
    """Effect of a term on the free run's residual beside the fit, by one Gauss-Newton step.

    `share` is by how much of the residual's squares it falls, `left` what stays of them beyond
    white noise.
    """

    coefficient: float
    std: float | None
    t: float | None
    share: float
    left: float


@dataclass(frozen=True, eq=False)
class TermBias:
    """Bias of a motion's parameters by a term.

    `moved` (np,) are the coordinates of p̂ less those without the term, per unit of its
    coefficient.
    """

    suspect: MotionSuspect
    equation: str
    names: tuple[str, ...]
    moved: Vector
    per_unit: Vector
    """The same of p̂, to first order."""
    value: Vector
    expected: Vector | None
    """The same times the guessed coefficient."""
    cosine: float | None
    size: float
    seen: bool | None
    explained: float | None
    coefficient_found: float | None
    certificate: Certificate | None
    residual: ResidualStep | None

    @property
    def removed_by(self) -> str | None:
        """Change that removes this bias from the parameters.

        None where that is not known, or nothing is to remove.
        """
        if self.seen is None:
            return "nothing" if self.moved.any() else None
        return self._as_suspected.removed_by

    @property
    def _as_suspected(self) -> SuspectedBias:
        relative = [b / v if v else None for b, v in zip(self.per_unit, self.value, strict=True)]
        shown: Any = self.suspect
        own = (
            self.names,
            tuple(self.per_unit),
            tuple(relative),
            None if self.expected is None else (*self.expected,),
        )
        found = (self.cosine, self.explained, self.coefficient_found, self.certificate, self.seen)
        return SuspectedBias(shown, *own, None, *found)

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers, text and None, for JSON."""
        return self._as_suspected.as_dict() | {
            "removed_by": self.removed_by,
            "equation": self.equation,
            "unit": self.suspect.unit,
            "size": self.size,
            "relative_physical_bias": None,
            "expected_physical_bias": None,
            "residual": self.residual,
        }


@dataclass(frozen=True, eq=False)
class MotionLinearization:
    """Linearization of a motion for biases: the linearized free run, and the points of p̂'s split.

    Args:
        q: coordinates of p̂; those in `shared` directions come from the nearest physics.
        field: the measure's points.
        learned: the learner (M, nl) there beside p̂; None before a fit, and without one.
        unknown: parameters that no output determines: a term does anything to them.
    """

    place: FreeRunPoint
    q: Vector
    shared: SharedDirections
    field: Field
    learned: Matrix | None = None
    unknown: tuple[str, ...] = ()
    slope: Matrix | None = None
    """How p̂ follows (c, w) of a fit (np, np + nw); None where that is not known."""

    @property
    def motion(self) -> Motion:
        return self.place.segmented.problem.motion

    @property
    def learns(self) -> bool:
        """True if there is a learner."""
        return self.place.segmented.bound.learns

    @cached_property
    def phi(self) -> Projection:
        """∂f/∂q of the learned equations over the points, with rows weighted.

        A row is multiplied by the root of its weight over its size.
        """
        slopes = np.asarray(
            slopes_at(
                self.place.segmented.dynamics.physics_only, self.q, self.field.x, self.field.u
            )
        )
        slopes = slopes[:, learned_places(self.motion)]
        return Projection.factor(self.weigh(np.moveaxis(slopes, 2, 0)).transpose(1, 2, 0))

    def weigh(self, rows: np.ndarray) -> np.ndarray:
        """Return rows (M, nl) times the root of their weights over their sizes."""
        return rows * np.sqrt(self.field.weight)[:, None] / self.field.size

    def usual(self) -> tuple[MotionSuspect, ...]:
        """Return the usual suspects, with widths from the range of the run."""
        place = self.place
        segmented = place.segmented if len(place.w) else place.segmented.physics_only
        x, u = segmented.trajectory(place.c, place.w, place.states)
        there = np.isfinite(x).all(axis=1)
        on = [entry.text for entry in segmented.problem.features]
        return usual_motion_suspects(self.motion, x[there], u[there], on)

    def table(
        self, suspects: Sequence[MotionSuspect], used: float | None = None, steps: int | None = None
    ) -> list[TermBias]:
        """Return the bias by every suspect; empty where the free run has no sensitivities.

        Args:
            used: weights that a fit used, where its residual is to be used; `steps` of a
                block, where its errors are coloured.
        """
        added = tuple(suspect.term(self.motion) for suspect in suspects)
        response = respond_to(self.place, added)
        if not np.isfinite(response.information).all() or not np.isfinite(response.gradient).all():
            return []
        seen = [self.sees(suspect) if self.learns else None for suspect in suspects]
        residuals: list[ResidualStep | None] = [None] * len(added)
        if used is not None and not all(
            seen
        ):  # what the learner sees it has taken from the residual
            residuals = residual_steps(response, used, steps)
        rows = enumerate(zip(suspects, seen, residuals, strict=True))
        return [self._entry(response, k, *row) for k, row in rows]

    def _entry(
        self,
        response: TermsResponse,
        k: int,
        suspect: MotionSuspect,
        seen: bool | None,
        residual: ResidualStep | None,
    ) -> TermBias:
        motion, names = self.motion, self.motion.names
        place = suspect.place(motion)
        basis, certificate, explained, found = self.shared.basis, None, None, None
        # A learner that is not may hold all along shared directions
        trained = bool(len(self.place.w))
        apart = (
            np.zeros(len(names), dtype=bool)
            if trained
            else ~np.isin(np.arange(len(names)), complementary_parameters(basis))
        )
        moved, dw = response.moved(k, apart)
        if self.learns:
            delta = self._rows(suspect, place)
            held = delta if seen else response.held(dw, self.field.x, self.field.u)
            held = self.weigh(held)
            if not seen and trained and self.slope is not None:
                moved = self.slope @ np.concatenate([moved, dw])
            elif basis.shape[1]:
                moved = (0.0 if seen else moved) + self.phi.solve_along(held, basis)
            elif seen:
                moved = np.zeros(len(names))
            if basis.shape[1] and len(held) <= CERTIFIED_POINTS and np.any(delta):
                certificate = find_certificate(self.phi, self.weigh(delta), basis)
            explained, found = self._explained_share(held)
        moved = np.where(np.isin(names, self.unknown), np.nan, moved)
        coordinates = motion.coordinates
        value, per_unit = coordinates.physical(self.q), coordinates.slopes(self.q) * moved
        expected = None
        if suspect.coefficient is not None:
            expected = suspect.coefficient * per_unit
        own = (suspect, equations_of(motion)[place], names, moved, per_unit, value, expected)
        effect = (response.cosine(k), response.size(k), seen, explained, found, certificate)
        return TermBias(*own, *effect, None if seen else residual)

    def after(self, causes: Sequence[TermBias], table: Sequence[TermBias]) -> list[TermBias]:
        """Return the suspects that the learner sees, by their shares beside given causes.

        Nothing of other causes.
        """
        if self.learned is None or not all(cause.seen for cause in causes):
            return []
        learned, gone = np.array(self.learned), {cause.suspect for cause in causes}
        for cause in causes:
            learned -= (cause.coefficient_found or 0.0) * self._rows(
                cause.suspect, cause.suspect.place(self.motion)
            )
        rest, found = replace(self, learned=learned), []
        for entry in table:
            if entry.seen and entry.suspect not in gone:
                explained, coefficient = rest._explained_share(self.held(entry.suspect))
                found.append(replace(entry, explained=explained, coefficient_found=coefficient))
        return found

    def held(self, suspect: MotionSuspect) -> Matrix:
        """Return a term that the learner sees (M, nl), weighed."""
        return self.weigh(self._rows(suspect, suspect.place(self.motion)))

    def physics_cosine(self, suspect: MotionSuspect) -> float:
        """Return the cosine between a term that the learner sees and the shared directions."""
        held = self.held(suspect)
        size = float(np.linalg.norm(held))
        return (
            float(np.sqrt(max(1 - (np.linalg.norm(self.beside(held)) / size) ** 2, 0.0)))
            if size > 0
            else 0.0
        )

    def entry_without_run(self, suspect: MotionSuspect) -> TermBias:
        """Return the bias by a term that the learner sees, by the measure without the free run."""
        motion, held = self.motion, self.held(suspect)
        moved = self.phi.solve_along(held, self.shared.basis)
        moved = np.where(np.isin(motion.names, self.unknown), np.nan, moved)
        explained, found = self._explained_share(held)
        coordinates = motion.coordinates
        value, per_unit = coordinates.physical(self.q), coordinates.slopes(self.q) * moved
        equation, size = equations_of(motion)[suspect.place(motion)], float(np.linalg.norm(held))
        own = (suspect, equation, motion.names, moved, per_unit, value, None)
        return TermBias(*own, None, size, True, explained, found, None, None)

    def unshared_learner(self) -> Matrix:
        """Return the learner (M, nl), weighed, beside the shared directions."""
        return self.beside(self.weigh(np.asarray(self.learned)))

    def beside(self, values: Matrix) -> Matrix:
        """Return the part of weighted values (M, nl) outside the shared directions."""
        basis = self.shared.basis
        return (
            values - self.phi.phi @ self.phi.solve_along(values, basis)
            if basis.shape[1]
            else values
        )

    def _rows(self, suspect: MotionSuspect, place: int) -> Matrix:
        """Return the term (M, nl) in the learned equations, 0 where it acts elsewhere."""
        learned = learned_places(self.motion)
        rows = np.zeros((len(self.field.x), len(learned)))
        if place in learned and suspect.memory is None:
            p = self.motion.coordinates.physical(self.q)
            rows[:, learned.index(place)] = suspect.values(
                self.motion, p, self.field.x, self.field.u
            )
        return np.where(np.isfinite(rows), rows, 0.0)

    def _explained_share(self, held: Matrix) -> tuple[float | None, float | None]:
        """Return the share of the learner that a term explains, and its coefficient.

        Both are taken beside the shared directions.
        """
        if self.learned is None:
            return None, None
        rest, tilde, size = self.beside(held), self.unshared_learner(), np.linalg.norm(held)
        norm = np.linalg.norm(rest)
        if not np.any(tilde) or norm <= IN_SPAN * size:
            return None, None
        product = float(np.vdot(rest, tilde)) / norm
        return float(min((product / np.linalg.norm(tilde)) ** 2, 1.0)), float(product / norm)

    def sees(self, suspect: MotionSuspect) -> bool:
        """Return whether the term acts where the learner does, and is a function of its inputs."""
        hidden = suspect.memory is not None  # a function of the past is none of one sample
        if hidden or suspect.place(self.motion) not in learned_places(self.motion):
            return False
        start, end = self._moves
        p, nx = self.motion.coordinates.physical(self.q), len(self.motion.states)
        pairs = np.stack(
            [suspect.values(self.motion, p, x[:, :nx], x[:, nx:]) for x in (start, end)]
        )
        there: Any = np.isfinite(pairs).all(axis=0)
        pairs = pairs[:, there]
        size = np.sqrt(np.mean(pairs**2)) if pairs.size else 0.0
        return bool(np.abs(pairs[1] - pairs[0]).max(initial=0.0) <= _SAME * size)

    @cached_property
    def _moves(self) -> tuple[Matrix, Matrix]:
        """Pairs of points that the learner does not distinguish."""
        form, nx = self.place.segmented.dynamics, len(self.motion.states)
        points = np.concatenate([self.field.x, self.field.u], axis=1)
        return moves(
            lambda rows: np.asarray(form.seen(rows[:, :nx].T, rows[:, nx:].T, np)).T, points
        )


def residual_steps(
    response: TermsResponse, used: float, steps: int | None
) -> list[ResidualStep | None]:
    """Return the effect of every term on the residual, with standard errors.

    They hold for coloured errors where `steps` is given.

    Args:
        used: weights that the fit used.
    """
    whole, noise = response.squares()
    free = max(response.place.segmented.residuals - response.parameters - used, 1.0)
    middle = (
        None if steps is None else response.scores().middle(steps, response.parameters + used)[0]
    )
    found: list[ResidualStep | None] = []
    for k in range(response.terms):
        step = response.step(k)
        if step is None or not whole > 0:
            found.append(None)
            continue
        coefficient, fall, row = step
        variance = (
            whole / free * float(row @ response.information @ row)
            if middle is None
            else row @ middle @ row
        )
        std = float(np.sqrt(variance)) if variance > 0 else None
        shares = min(fall / whole, 1.0), float(np.clip((whole - noise - fall) / whole, 0.0, 1.0))
        found.append(
            ResidualStep(coefficient, std, None if std is None else coefficient / std, *shares)
        )
    return found


def suspected_bias(fit: MotionEstimate, suspects: Sequence[MotionSuspect]) -> list[TermBias]:
    """Return the bias of a fitted motion's parameters by terms that its equations may lack.

    Raises:
        InputError: suspects that the motion cannot have, or a fit of difference equations.
    """
    check_type(
        fit,
        MotionEstimate,
        "fit",
        "a fit of equations of motion (for difference equations use `bias_budget`)",
    )
    check_motion_suspects(suspects, fit.problem)
    linearization = linearize_fit(fit)
    if linearization is None or not suspects:
        return []
    steps = block_of(fit) if fit.plain_covariance is not None else None
    return linearization.table(suspects, fit.effective_weights, steps)


def softened_bias(fit: MotionEstimate, suspects: Sequence[MotionSuspect]) -> list[TermBias]:
    """Return the biases by smooth forms of the friction among the suspects.

    Widths follow the size of the variable.

    Nothing without a learner: it alone shows the shape of what is missing.
    """
    if not fit.learns:
        return []
    field = fit.split_by.field
    smooth = soften_jumps(suspects, fit.problem.motion, fit.values, field.x, field.u)
    return suspected_bias(fit, smooth) if smooth else []


def usual_biases(fit: MotionEstimate) -> tuple[list[TermBias], list[TermBias]]:
    """Return the biases by usual terms that nobody declared, and by their smooth forms.

    Only terms that the learner sees count: others are no likely cause. There is none where the
    learner could imitate no change of a parameter.
    """
    linearization = linearize_fit(fit)
    if linearization is None or not linearization.learns or not fit.shared.basis.shape[1]:
        return [], []
    seen = [suspect for suspect in linearization.usual() if linearization.sees(suspect)]
    smooth = soften_jumps(
        seen, fit.problem.motion, fit.values, linearization.field.x, linearization.field.u
    )
    table = linearization.table((*seen, *smooth))  # one program for all
    return table[: len(seen)], table[len(seen) :]


def linearize_fit(fit: MotionEstimate) -> MotionLinearization | None:
    """Return the linearization of a fitted motion under the measure that it was split under.

    None where it has no normal equations.
    """
    if not fit.status.ok or fit.scores is None:
        return None
    numbers, field, learned = fit.model.numbers, fit.split_by.field, None
    ridge = fit.model.statistics.ridge / fit.scores.unit
    c, w = np.asarray(numbers.theta - numbers.theta_aux), np.asarray(numbers.weights)
    place = FreeRunPoint(fit.segmented, c, w, fit.states, fit.scores.weight, ridge)
    if fit.learns:
        learned = parts_at(fit.model.form, fit.model.numbers, field.x, field.u)[1]
        learned = np.where(np.isfinite(learned), learned, 0.0)
    unknown = (*fit.unidentified, *fit.at_bound)
    return MotionLinearization(
        place, fit.theta, fit.shared, field, learned, unknown, fit.split_by.slope
    )


def linearize_physics(task: MotionTask, structure: Structure) -> MotionLinearization | None:
    """Return the linearization of physics without a learner, for a learner of the task's features.

    None where it has no run.
    """
    if task.physics is None:
        return None
    segmented, point = task.plan, task.physics.end.point
    form, names = segmented.dynamics, segmented.problem.motion.names
    weights = np.zeros(0)
    place = FreeRunPoint(
        segmented, point.theta, weights, point.states, task.physics.objective.weight
    )
    none = MotionSplit.empty("training", form, point.theta)
    if not segmented.bound.learns:
        return MotionLinearization(place, point.theta, none.shared, none.field)
    field = field_under(
        structure.measure,
        segmented.physics_only,
        segmented.physics_only.numbers(point.theta, weights),
        point.states,
    )[0]
    if structure.shared == "all":
        return MotionLinearization(
            place, point.theta, SharedDirections(names, np.eye(len(names))), field
        )
    return MotionLinearization(
        place, point.theta, shared_of_motion(form, point.theta, field.x, field.u), field
    )
