"""Structures: how the fitted function `g = φc + f` is split between physics and learner (F2).

Every structure spans the same functions. It decides two things only: which rows join the criterion, and
which part of `c = θ − θ_aux` is called θ afterwards. The rows are linear in θ and in the learner's
coordinates `QᵀF`, so θ can always be eliminated, and what training sees of a structure, its penalty or
its bounds is one small quadratic in `QᵀF` (`Elimination`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple, Protocol, runtime_checkable

import numpy as np
import scipy.optimize
from annotated_types import Ge
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.registry import LIBRARY_ONLY, check_fields
from orthaug.inference.measures import Measure, Training
from orthaug.physics.problem import Problem

Fixed = dict[int, float]
"""Entries of θ that stand at a bound, with its value."""


class Rows(NamedTuple):
    """Residual rows `target − theta·θ − learner·QᵀF`, in whitened outputs."""

    theta: Float[np.ndarray, "m nt"]
    learner: Float[np.ndarray, "m nt"]
    target: Float[np.ndarray, "m"]


@runtime_checkable
class Structure(Protocol):
    """What `estimate(structure=…)` takes."""

    @property
    def name(self) -> str: ...

    @property
    def projects(self) -> bool:
        """Whether θ is split so that the learner is orthogonal to the physics."""
        ...

    @property
    def identifies(self) -> bool:
        """Whether the data alone determine θ where nothing is learned."""
        ...

    @property
    def measure(self) -> Measure:
        """The points over which θ is split; training itself knows the training measure only."""
        ...

    def penalty(self, names: Sequence[str], initial: Vector, unit: float) -> Rows:
        """The rows that join the criterion, given θ⁰ (nθ,) and the output's unit in whitened outputs."""
        ...


def _no_rows(nt: int) -> Rows:
    return Rows(np.zeros((0, nt)), np.zeros((0, nt)), np.zeros(0))


@dataclass(frozen=True)
class Orthogonal:
    """ŷ = φ(θ − θ_aux) + f with θ_aux = Φ_μ⁺F_μ (eq:orth_param).

    Under the training measure θ̂ = Φ⁺Y for every learner (F1); under another `measure` training is the same, and the
    fitted function is split over the measure's points at the end (F2).
    """

    projects = True
    identifies = True

    measure: Measure = field(default=Training(), metadata=LIBRARY_ONLY)  # noqa: RUF009  (frozen)
    name: str = field(default="orthogonal", metadata=LIBRARY_ONLY)

    def penalty(self, names: Sequence[str], initial: Vector, unit: float) -> Rows:
        return _no_rows(len(names))


@dataclass(frozen=True)
class Additive:
    """ŷ = φθ + f (eqs:additive_struct): θ takes what this learner happens to leave, so it is not unique."""

    name: str = field(default="additive", metadata=LIBRARY_ONLY)
    projects = False
    identifies = True
    measure = Training()

    def penalty(self, names: Sequence[str], initial: Vector, unit: float) -> Rows:
        return _no_rows(len(names))


@dataclass(frozen=True)
class OrthogonalPenalty:
    """Additive with `λ‖QᵀF‖²` in the criterion (Kon 2022, Györök 2025): drives the learner out of the physics.

    `weight` is λ, against the sum of squares in the output's units.
    """

    projects = False
    identifies = True
    measure = Training()

    weight: Annotated[float, Ge(0)] = 1.0
    name: str = field(default="orthogonal-penalty", metadata=LIBRARY_ONLY)

    def __post_init__(self) -> None:
        check_fields(self)

    def penalty(self, names: Sequence[str], initial: Vector, unit: float) -> Rows:
        nt = len(names)
        return Rows(np.zeros((nt, nt)), np.sqrt(self.weight) * np.eye(nt), np.zeros(nt))


@dataclass(frozen=True)
class BaselinePenalty:
    """Additive with `λ‖(θ − θ⁰)/θ⁰‖²` in the criterion (Bolderman 2022): keeps θ near its initial value.

    `weight` is λ, against the sum of squares in the output's units.
    """

    projects = False
    identifies = False
    measure = Training()

    weight: Annotated[float, Ge(0)] = 1.0
    name: str = field(default="baseline-penalty", metadata=LIBRARY_ONLY)

    def __post_init__(self) -> None:
        check_fields(self)

    def penalty(self, names: Sequence[str], initial: Vector, unit: float) -> Rows:
        """The rows `√λ (θ⁰ − θ)/θ⁰`.

        Raises:
            InputError: an initial value of 0, relative to which nothing can be penalised.
        """
        zero = [name for name, value in zip(names, initial, strict=True) if value == 0]
        if zero:
            raise InputError(
                f"the baseline penalty is relative to the initial values, but {', '.join(zero)} starts at 0; "
                "give it another `initial`, or use the orthogonal structure."
            )
        root = np.sqrt(self.weight) * unit
        return Rows(root * np.diag(1 / initial), np.zeros((len(names), len(names))), root * np.ones(len(names)))


@dataclass(frozen=True, eq=False)
class Elimination:
    """θ taken out of `‖p − f − Tθ‖² + ‖e − A θ − B f‖²`, with f = QᵀF, p = QᵀY, `T` = coordinates of θ.

    `(A, B, e)` are the structure's rows. Bounds are met by an active set: some entries of θ stand at a
    bound, the others are free and minimise the rest.
    """

    to_coordinates: Matrix
    outputs: Vector
    rows: Rows
    lower: Vector
    upper: Vector

    @property
    def bounded(self) -> bool:
        """Whether any entry of θ has a bound."""
        return bool(np.isfinite(self.lower).any() or np.isfinite(self.upper).any())

    @property
    def _theta(self) -> Matrix:
        return np.concatenate([self.to_coordinates, self.rows.theta])

    @property
    def _learner(self) -> Matrix:
        return np.concatenate([np.eye(len(self.outputs)), self.rows.learner])

    @property
    def _target(self) -> Vector:
        return np.concatenate([self.outputs, self.rows.target])

    def hold(self, fixed: Fixed) -> tuple[Matrix, Vector]:
        """`(S, t)` with `min_θ (…) = ‖t − S f‖² + constant`: what remains for the learner to see, (nθ, nθ) and (nθ,).

        S is zero where θ can follow any f: without penalty rows and with no entry at a bound.
        """
        nt = len(self.outputs)
        if not len(self.rows.target) and not fixed:
            return np.zeros((nt, nt)), np.zeros(nt)
        free, offset = self._split(fixed)
        basis = np.linalg.qr(free)[0]
        stacked = np.column_stack([self._learner, self._target - offset])
        stacked = stacked - basis @ (basis.T @ stacked)
        small = np.linalg.qr(stacked, mode="r")[:nt]
        small = np.concatenate([small, np.zeros((nt - len(small), nt + 1))])
        return small[:, :nt], small[:, nt]

    def theta(self, f: Vector, fixed: Fixed) -> Vector:
        """The minimising θ (nθ,) for the learner's coordinates f (nθ,)."""
        free, offset = self._split(fixed)
        scale = np.linalg.norm(free, axis=0)
        right = self._target - self._learner @ f - offset
        theta = np.empty(len(f))
        theta[[i for i in range(len(f)) if i not in fixed]] = (
            np.linalg.lstsq(free / scale, right, rcond=None)[0] / scale
        )
        for i, value in fixed.items():
            theta[i] = value
        return theta

    def active(self, f: Vector) -> Fixed:
        """Which entries of θ stand at which bound, for the learner's coordinates f."""
        if not self.bounded:
            return {}
        matrix, right = self._theta, self._target - self._learner @ f
        scale = np.linalg.norm(matrix, axis=0)
        found = scipy.optimize.lsq_linear(
            matrix / scale, right, bounds=(self.lower * scale, self.upper * scale), method="bvls", tol=1e-14
        )
        return {
            i: float(self.lower[i] if side < 0 else self.upper[i]) for i, side in enumerate(found.active_mask) if side
        }

    def _split(self, fixed: Fixed) -> tuple[Matrix, Vector]:
        """The columns of the free entries, and what the fixed ones contribute."""
        matrix = self._theta
        free = [i for i in range(matrix.shape[1]) if i not in fixed]
        return matrix[:, free], matrix[:, list(fixed)] @ np.array(list(fixed.values()), dtype=float)


def eliminate(structure: Structure, problem: Problem) -> Elimination:
    """The elimination of θ from a problem's criterion with a structure's rows and the baseline's bounds."""
    baseline, projection, weight = problem.baseline, problem.projection, problem.weight
    unit = float(weight[0]) if len(weight) == 1 else 1.0  # λ counts in the output's units where there is one
    return Elimination(
        to_coordinates=projection.r / projection.scale if projection.scale.size else projection.r,
        outputs=projection.coordinates(problem.whitened_target),
        rows=structure.penalty(baseline.names, baseline.initial, unit),
        lower=baseline.bounds[0],
        upper=baseline.bounds[1],
    )


class Split(NamedTuple):
    """θ and θ_aux, and which entries of θ stand at a bound."""

    theta: Vector
    theta_aux: Vector
    fixed: Fixed


def split(
    structure: Structure,
    problem: Problem,
    values: Float[np.ndarray, "N ny"],
    coefficients: Vector | None = None,
    fixed: Fixed | None = None,
) -> Split:
    """θ for the learner's whitened values F (N, ny), and its share θ_aux that the structure moves to θ.

    Args:
        coefficients: c = θ − θ_aux (nθ,) where training found it; None to solve for θ.
        fixed: what stands at a bound, where training found that.
    """
    projection, baseline = problem.projection, problem.baseline
    orthogonal = structure.projects
    aux = projection.solve(values)
    elimination = eliminate(structure, problem)
    f = np.zeros(len(aux)) if orthogonal else projection.coordinates(values)
    if coefficients is not None:
        theta = coefficients + (aux if orthogonal else 0.0)
        if fixed is None:  # an iterate need not satisfy what only its end satisfies
            inside = np.clip(theta, *baseline.bounds)
            fixed = elimination.active(f) | {i: value for i, value in enumerate(inside) if value != theta[i]}
        theta = np.array([fixed.get(i, value) for i, value in enumerate(theta)])
    elif (fixed := elimination.active(f)) or len(elimination.rows.target):
        theta = elimination.theta(f, fixed)
    else:  # refined least squares, as exact as double precision allows
        theta = projection.solve(problem.whitened_target) - (0.0 if orthogonal else aux)
    return Split(theta, aux if orthogonal else 0.0 * aux, fixed)
