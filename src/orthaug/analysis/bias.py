"""Bias of the parameters by unmodelled terms: per unit of each suspect, and what would remove it.

With the truth `Y = Φθ* + Δ + E` (`eq:data_gen_sys_reformed_vect`) the estimate under a measure μ
errs by `θ̂ − θ* = Φ_μ⁺(Δ_μ − ε_μ)` (eq:error_val), ε the misfit of the whole model. Here Φ_μ and
Δ_μ are the rows multiplied by the square root of their weight.

A learner that sees only some features shares only some directions B of θ with the physics. Along
these alone the measure decides: the estimate errs by `d + B(Φ_μB)⁺G_μ`, d what the term moves c by
and G what the learner holds of it: all of the term, and d = 0, where it is a function of what the
learner sees.

All of this is one table for every physics. `TermPhysics` is what differs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from orthaug._base.checks import Matrix, Vector, check_unique
from orthaug._base.lines import percent
from orthaug.analysis.suspects import MotionSuspect, Suspect
from orthaug.inference.linearization import Certificate, Linearization
from orthaug.physics.parameters import PhysicsMap
from orthaug.physics.projection import Projection

_KNOWN = 1e-6  # of a term's size: what the physics leaves of one that it has, with roots and powers

RemovedBy = Literal["learner", "learner and measure", "learner in part", "measure", "nothing"]


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


class TermResponse(NamedTuple):
    """Response of a fit to a term of coefficient 1 that it does not know."""

    moved: Vector
    """What the term adds to the coordinates c (nθ,) of the physics, before the split."""
    held: Matrix | None
    """What the learner holds of it at the measure's points, weighted (M, ny); None without one."""
    seen: bool | None = None
    """True if it is a function of what the learner sees; None where that does not matter."""
    certified: Matrix | None = None
    """The values that a certificate is sought for, weighted; None for no certificate."""
    moved_by_split: Vector | None = None
    """`moved` with what the split adds, where that is known beyond first order in the learner."""
    effect: tuple[float | None, float] | None = None
    """Cosine and size of its effect on the outputs of a free run; None for those by the measure."""
    residual: ResidualStep | None = None


class TermPhysics(Protocol):
    """A fit as terms that it lacks meet it: all that differs between kinds of physics."""

    @property
    def fit(self) -> Any:
        """The estimate; None before a fit."""
        ...

    @property
    def map(self) -> PhysicsMap | None:
        """The map from physical parameters to θ."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters."""
        ...

    @property
    def value(self) -> Vector:
        """Their values (nθ,)."""
        ...

    @property
    def slopes(self) -> Vector:
        """Derivatives (nθ,) of the values by the coordinates that are fitted, NaN of no value."""
        ...

    @property
    def physical(self) -> tuple[Mapping[str, Vector], Vector] | None:
        """Rows dp/dθ of parameters that a map gives, by name, and their values p."""
        ...

    @property
    def linearization(self) -> Linearization:
        """The learned equations over the measure's points."""
        ...

    @property
    def memory(self) -> tuple[str, ...]:
        """Names of the learner's own states."""
        ...

    @property
    def certifies(self) -> bool:
        """True if the points are few enough to seek certificates for terms that no one named."""
        ...

    def equation(self, suspect: Any) -> str | None:
        """Return the equation of a motion that lacks a term."""
        ...

    def values(self, suspect: Any) -> Matrix:
        """Return a term (M, ny) at the measure's points, weighted."""
        ...

    def sees(self, suspects: Sequence[Any]) -> list[bool | None]:
        """Return of each term whether it is a function of what the learner sees."""
        ...

    def respond(self, suspects: Sequence[Any], *, run: bool) -> list[TermResponse] | None:
        """Return how the fit itself responds to each term; None where it has no sensitivities.

        Args:
            run: False for terms that the learner sees, by the measure alone.
        """
        ...

    def expected_shifts(self, bias: Vector) -> dict[str, dict[str, float | None]] | None:
        """Return the shift of every parameter of the map by a bias of θ, beyond first order."""
        ...


@dataclass(frozen=True)
class SuspectedBias:
    """Bias of the parameters by a suspect, per unit of the suspect's coefficient.

    `bias` (nt,) is `Φ_μ⁺Δ_μ`, in the unit of the parameter per unit of the coefficient; `relative`
    the same divided by the parameter (None where it is 0); `physical` the same for physical
    parameters of a map, to first order; `expected` is `bias` times the guessed coefficient.
    `cosine` is `‖QᵀΔ‖/‖Δ‖` in [0, 1], 0 where the paper's `cond:special_PE` holds: None for Δ = 0;
    of a motion it is the share of the term's effect on the outputs that the fit takes up.
    `explained` is the squared cosine between P⊥Δ and the learner's values, and `coefficient_found`
    that with which P⊥Δ fits them best: both None without a learner, or where Δ lies in the span of
    Φ.
    """

    suspect: Any
    """A `Suspect`, or a `MotionSuspect` of a motion."""
    names: tuple[str, ...]
    bias: tuple[float, ...]
    relative: tuple[float | None, ...] | None
    expected: tuple[float, ...] | None
    physical: tuple[tuple[str, float], ...] | None
    cosine: float | None
    explained: float | None
    coefficient_found: float | None
    certificate: Certificate | None
    equation: str | None = None
    """The equation of a motion that lacks the term."""
    seen: bool | None = None
    """True if it is a function of what the learner sees, where that leaves some directions of θ to
    the fit.
    """
    size: float | None = None
    """Norm of the term over the measure; of a motion RMS of its effect on the outputs, in their
    deviations.
    """
    residual: ResidualStep | None = None
    """Of a motion: what the free run's residual says of the term."""
    relative_physical: tuple[tuple[str, float | None], ...] | None = None
    expected_physical: dict[str, dict[str, float | None]] | None = None
    physics_cosine: float | None = None
    """Cosine between what the learner holds of the term and the shared directions."""
    split: bool = True
    """True if a measure decides on any direction; without a learner a free run decides alone."""

    @property
    def per_unit(self) -> Vector:
        """The bias as an array (nt,)."""
        return np.array(self.bias)

    @property
    def shift(self) -> Vector:
        """The bias (nt,) by a term of the size found in the learner."""
        return (self.coefficient_found or 0.0) * self.per_unit

    @property
    def share(self) -> float:
        """The share of the learner that the term explains, 0 where none is known."""
        return self.explained or 0.0

    @property
    def coefficient(self) -> float:
        """The size of the term found in the learner, else by what the free run leaves."""
        if self.explained is None and self.residual is not None:
            return self.residual.coefficient
        return self.coefficient_found or 0.0

    @property
    def removed_by(self) -> RemovedBy | None:
        """Change that removes this bias; None where none is known, or nothing is to remove.

        A learner that sees the term removes its bias from all that the learner could not imitate.
        Along the shared directions a measure may remove the rest.
        """
        if not self.split:
            return "nothing" if any(self.bias) else None
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

        suspect = self.suspect
        return {
            "name": suspect.name,
            "expression": suspect.expression,
            "memory": None if suspect.memory is None else suspect.memory.name,
            "output": suspect.output,
            "equation": self.equation,
            "unit": suspect.unit,
            "coefficient": suspect.coefficient,
            "bias": by_name(self.bias),
            "relative_bias": by_name(self.relative),
            "expected_bias": by_name(self.expected),
            "physical_bias": None if self.physical is None else dict(self.physical),
            "relative_physical_bias": None
            if self.relative_physical is None
            else dict(self.relative_physical),
            "expected_physical_bias": self.expected_physical,
            "cosine": self.cosine,
            "size": self.size,
            "seen": self.seen,
            "removed_by": self.removed_by,
            "explained": self.explained,
            "coefficient_found": self.coefficient_found,
            "residual": self.residual,
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
    physics: TermPhysics, suspects: Sequence[Any], *, certify: bool = True, every: bool = True
) -> list[SuspectedBias]:
    """Return the bias by every suspect; empty where the fit has no sensitivities.

    Args:
        certify: search for certificates, a linear program per suspect.
        every: also terms that are zero on all points.
    """
    check_unique((suspect.name for suspect in suspects), "suspect")
    if not every:
        suspects = [suspect for suspect in suspects if np.any(physics.values(suspect))]
    responses = physics.respond(suspects, run=True) if suspects else []
    return [
        term_bias(physics, suspect, response, certify=certify)
        for suspect, response in zip(suspects, responses or (), strict=responses is not None)
    ]


def has_term(jacobian: Projection, values: Matrix) -> bool:
    """Return whether physics expresses a term by its own parameters.

    A constant beside the physics' own, or a root of what it has the root of, is nothing that it
    lacks.

    Args:
        jacobian: ∂f/∂θ over points.
        values: the term there (M, ny).
    """
    size = np.abs(values).max(initial=0.0)
    if not 0 < size < np.inf:
        return False
    unit = values / size
    return bool(np.linalg.norm(jacobian.orthogonal_part(unit)) <= _KNOWN * np.linalg.norm(unit))


def seen_table(physics: TermPhysics, suspects: Sequence[Any]) -> list[SuspectedBias]:
    """Return the biases by those terms that the learner sees, by the measure alone."""
    visible = zip(suspects, physics.sees(suspects), strict=True)
    seen = [suspect for suspect, sees in visible if sees is not False]
    seen = [suspect for suspect in seen if np.any(physics.values(suspect))]
    return [
        term_bias(physics, suspect, response, certify=False)
        for suspect, response in zip(seen, physics.respond(seen, run=False) or (), strict=True)
    ]


def table_beside(
    physics: TermPhysics, causes: Sequence[SuspectedBias], table: Sequence[SuspectedBias]
) -> list[SuspectedBias]:
    """Return the other terms of a table by their shares of what some causes leave of the learner.

    The learner sees all of these terms, unless it could imitate every change of the parameters.
    """
    linearization, gone = physics.linearization, {cause.suspect for cause in causes}
    others = [entry for entry in table if entry.suspect not in gone]
    both = [entry.suspect for entry in (*causes, *others)]
    held = [np.asarray(one.held) for one in physics.respond(both, run=False) or ()]
    taken = [(cause.coefficient_found or 0.0) * h for cause, h in zip(causes, held, strict=False)]
    left = np.asarray(linearization.learner) - np.sum(taken, axis=0)
    rest, found = replace(linearization, learner=left), []
    for entry, values in zip(others, held[len(causes) :], strict=True):
        _, share, coefficient = rest.explain(values)
        found.append(replace(entry, explained=share, coefficient_found=coefficient))
    return found


def term_bias(
    physics: TermPhysics,
    suspect: Suspect | MotionSuspect,
    response: TermResponse,
    *,
    certify: bool = True,
) -> SuspectedBias:
    """Return the bias by one term, as the fit responds to it."""
    moved, share, found, cosine, certificate = response.moved, None, None, None, None
    if response.held is not None:
        linearization = physics.linearization
        by_split, share, found = linearization.explain(response.held)
        moved = moved + by_split if response.moved_by_split is None else response.moved_by_split
        cosine = linearization.cosine(response.held)
        if certify and response.certified is not None:
            certificate = linearization.certificate(response.certified)
    bias, coefficient = physics.slopes * moved, suspect.coefficient
    expected = None if coefficient is None else coefficient * bias
    effect = response.effect
    if effect is None:
        values = physics.values(suspect) if response.seen is False else response.held
        effect = cosine, float(np.linalg.norm(np.asarray(values)))
    by_map, physical = physics.physical, None
    if by_map is not None:
        physical = tuple((name, float(np.dot(row, bias))) for name, row in by_map[0].items())
    return SuspectedBias(
        suspect,
        physics.names,
        tuple(map(float, bias)),
        _relative(bias, physics.value),
        None if expected is None else tuple(map(float, expected)),
        physical,
        effect[0],
        share,
        found,
        certificate,
        physics.equation(suspect),
        response.seen,
        effect[1],
        response.residual,
        None
        if by_map is None or physical is None
        else tuple(
            zip(by_map[0], _relative([shift for _, shift in physical], by_map[1]), strict=True)
        ),
        None if expected is None else physics.expected_shifts(expected),
        cosine,
        response.held is not None,
    )


def _relative(bias: Sequence[float] | Vector, value: Vector) -> tuple[float | None, ...]:
    return tuple(float(b / v) if v else None for b, v in zip(bias, value, strict=True))
