"""Elimination of θ from the criterion, which leaves a small quadratic in QᵀF (F1)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.fitting.structures import PenaltyRows, Structure
from orthaug.physics.problem import Problem
from orthaug.physics.shared import SharedDirections

Fixed = dict[int, float]
"""Entries of θ at a bound, with its value."""


def settle(fixed: Fixed, run: Callable[[Fixed], Fixed | None]) -> Fixed:
    """Return the entries at a bound where a run with the same entries fixed ended.

    What was held together once before is not released again, so that this ends.

    Args:
        fixed: the entries fixed first.
        run: runs with some entries fixed, and returns those that are at a bound then; None to end.
    """
    tried = [fixed]
    while (active := run(fixed)) is not None:
        active = active | fixed if active in tried else active
        if active == fixed:
            break
        fixed = active
        tried.append(fixed)
    return fixed


@dataclass(frozen=True, eq=False)
class Elimination:
    """θ eliminated from the criterion.

    The criterion is `‖p − (I − P) f − Tθ‖² + ‖e − A θ − B f‖²` with f = QᵀF, p = QᵀY, and `T` the
    coordinates of θ.

    P, `taken`, is the projector onto what a split moves from the learner to θ: all in the paper's
    structure, nothing in the additive one. `(A, B, e)` are the structure's rows. An active set
    meets the bounds: some entries of θ are at a bound, and the others minimise the rest. Where
    the learner can imitate part of the physics only, they are known terms then, which a split moves
    nothing to: P is that of the `shared` directions that leave them alone.
    """

    to_coordinates: Matrix
    outputs: Vector
    taken: Matrix
    rows: PenaltyRows
    lower: Vector
    upper: Vector
    shared: SharedDirections | None = None
    """The directions that P projects onto; None where P is the same whichever entries are at a
    bound.
    """

    @property
    def bounded(self) -> bool:
        """True where an entry of θ has a bound."""
        return bool(np.isfinite(self.lower).any() or np.isfinite(self.upper).any())

    @property
    def projects(self) -> bool:
        """True where a part of the learner is moved to θ."""
        return bool(self.taken.any())

    @property
    def decoupled(self) -> bool:
        """True where θ is independent of the learner, and the learner of bounds (F1)."""
        return not self._learner({}).any()

    def taken_with_fixed(self, fixed: Fixed) -> Matrix:
        """Return P (nθ, nθ) where some entries of θ are at a bound."""
        if not fixed or self.shared is None:
            return self.taken
        basis = np.linalg.qr(self.to_coordinates @ self.shared.without_entries(fixed).basis)[0]
        return basis @ basis.T

    @property
    def _theta(self) -> Matrix:
        return np.concatenate([self.to_coordinates, self.rows.theta])

    def _learner(self, fixed: Fixed) -> Matrix:
        return np.concatenate(
            [np.eye(len(self.outputs)) - self.taken_with_fixed(fixed), self.rows.learner]
        )

    @property
    def _target(self) -> Vector:
        return np.concatenate([self.outputs, self.rows.target])

    def hold(self, fixed: Fixed) -> tuple[Matrix, Vector]:
        """Return `(S, t)`, (nθ, nθ) and (nθ,), through which the learner depends on θ.

        `min_θ (…) = ‖t − S f‖² + constant`.

        S is zero where θ can follow any f: without penalty rows and with no entry at a bound.
        """
        nt = len(self.outputs)
        if not len(self.rows.target) and not fixed:
            return np.zeros((nt, nt)), np.zeros(nt)
        free, offset = self._split(fixed)
        basis = np.linalg.qr(free)[0]
        stacked = np.column_stack([self._learner(fixed), self._target - offset])
        stacked = stacked - basis @ (basis.T @ stacked)
        small = np.linalg.qr(stacked, mode="r")[:nt]
        small = np.concatenate([small, np.zeros((nt - len(small), nt + 1))])
        return small[:, :nt], small[:, nt]

    def theta(self, f: Vector, fixed: Fixed) -> Vector:
        """Return the minimising θ (nθ,) for the learner's coordinates f (nθ,)."""
        free, offset = self._split(fixed)
        scale = np.linalg.norm(free, axis=0)
        right = self._target - self._learner(fixed) @ f - offset
        theta = np.empty(len(f))
        theta[[i for i in range(len(f)) if i not in fixed]] = (
            np.linalg.lstsq(free / scale, right, rcond=None)[0] / scale
        )
        for i, value in fixed.items():
            theta[i] = value
        return theta

    def active(self, f: Vector) -> Fixed:
        """Return a mask of the entries of θ at a bound, for the learner's coordinates f.

        Those of the nearest θ in the bounds where nothing is held; what a held entry leaves to the
        learner may move others past theirs, and these are added (`past`).
        """
        if not self.bounded:
            return {}
        from scipy.optimize import lsq_linear  # slow to import

        matrix, right = self._theta, self._target - self._learner({}) @ f
        scale = np.linalg.norm(matrix, axis=0)
        solution = lsq_linear(
            matrix / scale,
            right,
            bounds=(self.lower * scale, self.upper * scale),
            method="bvls",
            tol=1e-14,
        )
        return self.past(
            f,
            {
                i: float(self.lower[i] if side < 0 else self.upper[i])
                for i, side in enumerate(solution.active_mask)
                if side
            },
        )

    def settle(self, run: Callable[[Fixed], Vector | None]) -> Fixed:
        """Return the entries at a bound where training with the same entries fixed ended.

        Those of physics alone at first.

        Args:
            run: trains with some entries held, and gives the learner's coordinates f; None to leave
                it at that.
        """
        first = {} if self.decoupled else self.active(np.zeros_like(self.outputs))
        return settle(first, lambda fixed: None if (f := run(fixed)) is None else self.active(f))

    def past(self, f: Vector, fixed: Fixed) -> Fixed:
        """Return `fixed` and, at their bounds, all entries that would leave them.

        For the learner's coordinates f.
        """
        while True:
            theta = self.theta(f, fixed)
            beyond = {
                i: float(v)
                for i, v in enumerate(np.clip(theta, self.lower, self.upper))
                if v != theta[i]
            }
            if not beyond or not np.isfinite(theta).all():
                return fixed
            fixed = fixed | beyond

    def _split(self, fixed: Fixed) -> tuple[Matrix, Vector]:
        """Return the columns of the free entries, and the contribution of the fixed ones."""
        matrix = self._theta
        free = [i for i in range(matrix.shape[1]) if i not in fixed]
        return matrix[:, free], matrix[:, list(fixed)] @ np.array(list(fixed.values()), dtype=float)


def eliminate(structure: Structure, problem: Problem) -> Elimination:
    """Return the elimination of θ from a problem's criterion.

    With a structure's rows and the baseline's bounds.
    """
    baseline, projection = problem.baseline, problem.projection
    nt = len(baseline.names)
    shared = _shared_directions(structure, problem)
    partly = structure.projects and np.isfinite(baseline.bounds).any() and not shared.all
    return Elimination(
        to_coordinates=projection.to_coordinates,
        outputs=problem.target_coordinates,
        taken=projection.along(directions(structure, problem))
        if structure.projects
        else np.zeros((nt, nt)),
        rows=structure.penalty(baseline.names, baseline.initial, problem.weight.unit),
        lower=baseline.bounds[0],
        upper=baseline.bounds[1],
        shared=shared if partly else None,
    )


def _shared_directions(structure: Structure, problem: Problem) -> SharedDirections:
    names = problem.baseline.names
    return (
        SharedDirections(names, np.eye(len(names))) if structure.shared == "all" else problem.shared
    )


def directions(structure: Structure, problem: Problem, fixed: Iterable[int] = ()) -> Matrix | None:
    """Return the directions of θ (nθ, s) along which a split makes the learner orthogonal.

    None for all.

    Args:
        fixed: entries of θ at a bound, which no direction moves.
    """
    shared = _shared_directions(structure, problem)
    return None if shared.all else shared.without_entries(fixed).basis


class ThetaSplit(NamedTuple):
    """θ and θ_aux, and the entries of θ that are at a bound."""

    theta: Vector
    theta_aux: Vector
    fixed: Fixed


def split_theta(
    structure: Structure,
    problem: Problem,
    share: Vector,
    coefficients: Vector | None = None,
    fixed: Fixed | None = None,
) -> ThetaSplit:
    """Return θ, and θ_aux, the part of the learner that the structure moves to θ.

    They follow from the learner's share QᵀF (nθ,) in the physics.

    Args:
        coefficients: c = θ − θ_aux (nθ,) where it was an unknown of training; None to solve for θ.
        fixed: entries at a bound, where training knows them.
    """
    baseline, factor = problem.baseline, problem.projection
    elimination = eliminate(structure, problem)
    if (
        coefficients is not None and fixed is None
    ):  # an iterate need not satisfy what only its end satisfies
        apart = elimination.shared is not None  # nothing is moved to entries at a bound
        reached = coefficients + (
            0.0 if apart else factor.from_coordinates(elimination.taken @ share)
        )
        inside = np.clip(reached, *baseline.bounds)
        fixed = elimination.active(share) | {
            i: value for i, value in enumerate(inside) if value != reached[i]
        }
    fixed = elimination.active(share) if fixed is None else fixed
    taken = elimination.taken_with_fixed(fixed) @ share
    aux = factor.from_coordinates(taken)
    if elimination.shared is not None:
        aux[list(fixed)] = 0.0  # but for rounding it is
    if coefficients is not None:
        theta = np.array([fixed.get(i, value) for i, value in enumerate(coefficients + aux)])
    elif fixed or len(elimination.rows.target):
        theta = elimination.theta(share, fixed)
    else:  # refined least squares, as exact as double precision allows
        theta = problem.least_squares - factor.from_coordinates(share - taken)
    return ThetaSplit(theta, aux, fixed)
