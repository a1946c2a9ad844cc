"""Structures: how the fitted function `g = φc + f` is split between physics and learner (F2).

Every structure spans the same functions. It decides two things only: which rows join the criterion,
and which part of `c = θ − θ_aux` is called θ afterwards. The rows are linear in θ and in the
learner's coordinates `QᵀF`, so θ can always be eliminated. Training sees a structure, its penalty
and its bounds as one small quadratic in `QᵀF` (`fitting.elimination`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from annotated_types import Ge
from jaxtyping import Float

from orthaug._base.checks import Vector, check_type
from orthaug._base.errors import InputError
from orthaug._base.registry import LIBRARY_ONLY, check_fields
from orthaug.inference.measures import Measure, Training


class PenaltyRows(NamedTuple):
    """Residual rows `target − theta·θ − learner·QᵀF`, in whitened outputs."""

    theta: Float[np.ndarray, "m nt"]
    learner: Float[np.ndarray, "m nt"]
    target: Float[np.ndarray, "m"]


@runtime_checkable
class Structure(Protocol):
    """A structure as `estimate(structure=…)` accepts it."""

    @property
    def name(self) -> str: ...

    @property
    def projects(self) -> bool:
        """True where θ is split so that the learner is orthogonal to the physics."""
        ...

    @property
    def identifies(self) -> bool:
        """True where the data determine θ by themselves where nothing is learned."""
        ...

    @property
    def from_initial(self) -> bool:
        """True where one-step training starts θ at θ⁰ beside the weights.

        Otherwise it solves θ for any weights.
        """
        ...

    @property
    def shared(self) -> str:
        """Directions of θ along which the learner is made orthogonal.

        "auto" for those it could imitate, or "all".
        """
        ...

    @property
    def measure(self) -> Measure:
        """The points over which θ is split; training itself knows the training measure only."""
        ...

    def penalty(self, names: Sequence[str], initial: Vector, unit: float) -> PenaltyRows:
        """Return the penalty's rows of the criterion, in whitened outputs.

        They depend on θ⁰ (nθ,) and on the output's unit.
        """
        ...


class _SolvedTheta:
    """θ solved for any weights, without rows in the criterion.

    Called what is left beside the learner.
    """

    projects = False
    identifies = True
    from_initial: bool = False
    measure: Measure = Training()
    shared: str = "auto"

    def penalty(self, names: Sequence[str], initial: Vector, unit: float) -> PenaltyRows:
        nt = len(names)
        return PenaltyRows(np.zeros((0, nt)), np.zeros((0, nt)), np.zeros(0))


@dataclass(frozen=True)
class Orthogonal(_SolvedTheta):
    """ŷ = φ(θ − θ_aux) + f: the learner f is kept orthogonal to the physics φ.

    θ_aux = Φ_μ⁺F_μ is the least-squares fit of the physics to the learner over the points of the
    measure μ (`eq:orth_param` in docs/notation.md). Under the training measure θ is therefore the
    least-squares fit of physics alone, for every learner that sees all lags. Under another
    `measure` training is the same; at the end the fitted function is split over its points.

    A learner that sees less can imitate only some directions of θ. `shared` "auto" projects along
    these alone, `θ_aux = B(Φ_μB)⁺F_μ`; the others are what the fit determines beside the learner.
    "all" projects along every direction, as the paper does.

    Examples:
        >>> from orthaug.inference.measures import Symmetrized
        >>> Orthogonal(measure=Symmetrized(), shared="all").measure.name
        'symmetrized'
    """

    projects = True

    measure: Measure = field(default=Training(), metadata=LIBRARY_ONLY)  # noqa: RUF009  (frozen)
    shared: Literal["auto", "all"] = "auto"
    name: str = field(default="orthogonal", metadata=LIBRARY_ONLY)


@dataclass(frozen=True)
class Additive(_SolvedTheta):
    """ŷ = φθ + f (eqs:additive_struct). θ depends on the learner, so it is not unique.

    With `from_initial` θ starts at θ⁰ and is trained with the weights, one step ahead; without, it
    is solved for any weights and never sees θ⁰.
    """

    from_initial: bool = False
    name: str = field(default="additive", metadata=LIBRARY_ONLY)

    def __post_init__(self) -> None:
        check_type(self.from_initial, bool, "from_initial", "true or false")


@dataclass(frozen=True)
class OrthogonalPenalty(_SolvedTheta):
    """Additive with `λ‖QᵀF‖²` in the criterion (Kon 2022, Györök 2025).

    The penalty drives the learner out of the physics.

    `weight` is λ, against the sum of squares in the output's units.
    """

    weight: Annotated[float, Ge(0)] = 1.0
    name: str = field(default="orthogonal-penalty", metadata=LIBRARY_ONLY)

    def __post_init__(self) -> None:
        check_fields(self)

    def penalty(self, names: Sequence[str], initial: Vector, unit: float) -> PenaltyRows:
        nt = len(names)
        return PenaltyRows(np.zeros((nt, nt)), np.sqrt(self.weight) * np.eye(nt), np.zeros(nt))


@dataclass(frozen=True)
class BaselinePenalty(_SolvedTheta):
    """Additive with `λ‖(θ − θ⁰)/θ⁰‖²` in the criterion (Bolderman 2022).

    The penalty keeps θ near its initial value.

    `weight` is λ, against the sum of squares in the output's units.
    """

    identifies = False

    weight: Annotated[float, Ge(0)] = 1.0
    name: str = field(default="baseline-penalty", metadata=LIBRARY_ONLY)

    def __post_init__(self) -> None:
        check_fields(self)

    def penalty(self, names: Sequence[str], initial: Vector, unit: float) -> PenaltyRows:
        """Return the rows `√λ (θ⁰ − θ)/θ⁰`.

        Raises:
            InputError: an initial value of 0, relative to which nothing can be penalised.
        """
        zero = [name for name, value in zip(names, initial, strict=True) if value == 0]
        if zero:
            start = "starts" if len(zero) == 1 else "start"
            raise InputError(
                "the baseline penalty is relative to the initial values, but "
                f"{', '.join(zero)} {start} at 0; give it another `initial`, or use the "
                "orthogonal structure."
            )
        root = np.sqrt(self.weight) * unit
        return PenaltyRows(
            root * np.diag(1 / initial),
            np.zeros((len(names), len(names))),
            root * np.ones(len(names)),
        )


def with_measure(structure: Any, measure: Measure) -> Structure:
    """Return a structure under a measure, where it splits θ."""
    takes = any(field.name == "measure" for field in fields(structure))
    return replace(structure, measure=measure) if takes else structure
