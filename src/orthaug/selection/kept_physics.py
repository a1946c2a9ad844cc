"""Comparison of θ of physics alone with θ beside the chosen terms.

A term within the span of the physics takes over a part of it: the sum predicts as before, and θ
means nothing any more. So each parameter is compared before and after, in units of what the two
standard errors allow, and of each column the share is given that the others leave: one over it is
the factor by which they widen its standard error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug.selection.forward import Equations, spanned_columns
from orthaug.selection.term_runs import Point, TermRuns

MOVED, SPANNED = "physics_moved", "terms_within_span"
_SURE = 1.96  # standard errors
# Of the largest eigenvalue: columns whose smallest is below depend on each other
_DETERMINED = 1e-14


@dataclass(frozen=True)
class Shift:
    """A parameter of physics alone, and with the chosen terms.

    Standard errors are those of the search's criterion, `None` where the data do not determine the
    parameter. `left` is the share of the parameter's regressor, of its norm, that the other columns
    of the model leave.
    """

    parameter: str
    unit: str | None
    before: float
    before_std: float | None
    after: float
    after_std: float | None
    left: float

    @property
    def times(self) -> float | None:
        """By how many times what the standard errors allow at 95 % the parameter moves."""
        if self.before_std is None or self.after_std is None:
            return None
        allowed = _SURE * float(np.hypot(self.before_std, self.after_std))
        return abs(self.after - self.before) / allowed if allowed > 0 else None

    @property
    def moved(self) -> bool:
        """True if the parameter moves by more than its standard errors allow."""
        return self.times is None or self.times > 1

    def __str__(self) -> str:
        before, after = _figure(self.before, self.before_std), _figure(self.after, self.after_std)
        return f"{self.parameter} from {before} to {after}{f' {self.unit}' if self.unit else ''}"


@dataclass(frozen=True, eq=False)
class PhysicsComparison:
    """Comparison of the physics without and beside the chosen terms."""

    shifts: tuple[Shift, ...]
    left: dict[str, float]
    """Of each chosen term the share of its norm that physics and the other terms leave."""
    condition: float
    """Of the columns of physics and terms, each scaled to norm 1."""
    excluded: int
    """Candidate terms that are not chosen and lie within the span of physics and chosen terms."""
    candidates: int
    collinear: float
    """Share of a term's deviation below which it lies within the span."""

    @property
    def notes(self) -> list[Warning]:
        """Warnings for parameters that moved, and a note on the candidates within the span."""
        notes, moved = [], [shift for shift in self.shifts if shift.moved]
        if moved and self.left:
            times = max((shift.times for shift in moved if shift.times is not None), default=None)
            allowed = (
                "more"
                if times is None
                else f"up to {times:.2g} times"
                if len(moved) > 1
                else f"{times:.2g} times"
            )
            least = min(moved, key=lambda shift: shift.left)
            text = (
                f"the chosen terms move {'; '.join(map(str, moved))}: {allowed} what the "
                f"standard errors allow. The terms leave {100 * least.left:.2g} % of the "
                f"regressor of {least.parameter}. Either physics alone was biased by the effect "
                "of the terms, or the terms took over a part of the physics. Compare both values "
                "with what is known of the parameters. Where the first is right, put the missing "
                "effect into the physics, or `exclude` the terms that replace it."
            )
            notes.append(Warning(MOVED, text))
        if self.excluded:
            beside = "physics and the chosen terms" if self.left else "the physics"
            text = (
                f"{self.excluded} of {self.candidates} candidate terms lie within the span of "
                f"{beside} and were not taken: these explain all but {100 * self.collinear:g} "
                f"% of each. Their condition number is {self.condition:.3g}."
            )
            notes.append(Warning(SPANNED, text))
        return notes


def kept_physics(runs: TermRuns, alone: Point, chosen: Point) -> PhysicsComparison:
    """Compare θ of physics alone with θ beside the chosen terms, both trained on the criterion."""
    physics, nt, texts = runs.problem.baseline, len(alone.c), runs.library.texts
    columns = [*range(nt), *(nt + i for i in chosen.chosen)]
    every = runs.equations(chosen, None)
    before_std, _ = standard_errors(runs, alone, runs.equations(alone, ()).of(range(nt)))
    after_std, _ = standard_errors(runs, chosen, every.of(columns))
    left, condition = _what_is_left(every.of(columns))
    shifts = tuple(
        Shift(
            p.name,
            p.unit,
            float(alone.c[i]),
            before_std[i],
            float(chosen.c[i]),
            after_std[i],
            float(left[i]),
        )
        for i, p in enumerate(physics.parameters)
    )
    within = spanned_columns(every, columns, runs.collinear, runs.constant) if columns else []
    terms = dict(zip((texts[i] for i in chosen.chosen), map(float, left[nt:]), strict=True))
    return PhysicsComparison(shifts, terms, condition, len(within), len(texts), runs.collinear)


def standard_errors(
    runs: TermRuns, point: Point, own: Equations
) -> tuple[list[float | None], float]:
    """Return standard errors of all columns of a model and the freedom.

    A standard error is None where the rows do not determine it.
    """
    size, inverse, values = _inverse(own)
    share = runs.independent_share(point)
    freedom = max(own.rows - len(size), 1)
    variance = max(own.miss(own.solve()), 0.0) / freedom / share
    stds = np.sqrt(variance * np.diag(inverse)) / size
    determined = bool(values[0] > _DETERMINED * values[-1])
    found = [float(std) if determined and np.isfinite(std) else None for std in stds]
    return found, max(share * own.rows - len(size), 1.0)


def _what_is_left(own: Equations) -> tuple[Vector, float]:
    """Return the share of each column's norm that the others leave, and the condition number."""
    _, inverse, values = _inverse(own)
    left = 1 / np.sqrt(np.maximum(np.diag(inverse), 1.0))
    return left, float(np.sqrt(values[-1] / values[0])) if values[0] > _DETERMINED * values[
        -1
    ] else np.inf


def _inverse(own: Equations) -> tuple[Vector, Matrix, Vector]:
    """Return the norms of the columns, and inverse and eigenvalues of their Gram at norm 1."""
    size = np.sqrt(np.maximum(np.diag(own.hessian), 1e-300))
    gram: Matrix = own.hessian / np.outer(size, size)
    values = np.linalg.eigvalsh(gram) if len(gram) else np.ones(1)
    return size, np.linalg.pinv(gram, rcond=1e-14, hermitian=True), values


def _figure(value: float, std: float | None) -> str:
    return f"{value:.4g}" if std is None else f"{value:.4g} ± {std:.2g}"
