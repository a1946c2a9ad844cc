"""Bias of every parameter and physical parameter, as rows with an interval that covers it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug.analysis.bias import TermPhysics
from orthaug.analysis.bias_hull import Candidate, OtherForm, is_determined
from orthaug.analysis.causes import Causes
from orthaug.analysis.mapped_bias import physical_with_bias

_ALIKE = 1e-6  # of a bias


@dataclass(frozen=True)
class ParameterBias:
    """Bias of a parameter, estimate less truth, with an interval that covers bias and noise."""

    name: str
    value: float
    cause: str
    share: float | None
    """Share of the learner that the cause explains; None for another form of a selected term."""
    relative: float | None
    errors: float | None
    """Its size in standard errors; None where there are none."""
    ci95: tuple[float, float] | None
    """The hull over all causes that noise cannot separate; None where that determines nothing."""
    determined: bool = True
    """True if the data determine the parameter beside this learner: the hull is no wider than the
    value itself.
    """


def owners_of(
    found: Sequence[Causes | Candidate], moved: Float[np.ndarray, "k n"]
) -> list[tuple[str, float | None]]:
    """Return for each parameter the causes that move it most, and their share.

    Of causes that move it alike the first: a dead zone and a saturation differ by a damper.
    """
    size = np.abs(moved)
    most = size >= (1 - _ALIKE) * size.max(axis=0)
    named = [(one.name, None if isinstance(one, OtherForm) else one.share) for one in found]
    return [named[i] for i in np.argmax(most, axis=0)]


def physical_biases(
    terms: TermPhysics,
    found: Sequence[Causes | Candidate],
    candidates: Sequence[Candidate],
    other: Vector | float = 0.0,
) -> tuple[tuple[ParameterBias, ...], list[Warning]]:
    """Return the biases of the physical parameters: the hull over the causes that matter.

    Those are the causes that move any of them farthest.

    Args:
        found: the causes that move them, with candidates[0] all together.
        candidates: all that may be true.
        other: a standard deviation that every cause has beside its own.
    """
    if terms.map is None:
        return (), []
    fit, slopes, count = terms.fit, terms.physical, len(terms.names)
    physical = fit.physical(terms.map)
    own = np.array([np.nan if s is None else s for s in physical.std])
    turned = (
        np.array([slopes[0][name] for name in physical.names]) if slopes else np.zeros((0, count))
    )
    chosen = [candidates[0]]
    for row in turned:
        for sign in (-1.0, 1.0):
            wide = [
                sign * row @ c.moved + np.sqrt(np.sum((row * c.unsure) ** 2)) for c in candidates
            ]
            chosen.append(candidates[int(np.argmax(np.nan_to_num(wide, nan=-np.inf)))])
    ends, shifts = [], []
    for c in {id(c): c for c in chosen}.values():
        spread = np.outer(c.unsure, c.unsure) + np.diag(np.zeros(count) + other) ** 2
        spread = spread + (0.0 if fit.covariance is None else fit.covariance)
        known = terms.map, fit.problem, terms.value, c.moved
        moves, limits = physical_with_bias(*known, fit.covariance, spread, fit.freedom)
        shifts.append(moves)
        ends.append(limits)
    # NaN where one has none
    ends = np.stack([np.min(ends, axis=0)[:, 0], np.max(ends, axis=0)[:, 1]], axis=-1)
    owners = owners_of(found, np.array([one.moved for one in found]) @ turned.T) if slopes else []
    bias = shifts[0] if np.any(candidates[0].moved) else farthest(np.array(shifts))
    rows = parameter_biases(physical.names, physical.value, own, bias, ends, owners, fit.freedom)
    return rows, _unbounded_warnings(physical.names, own, ends)


def farthest(moved: Float[np.ndarray, "k n"]) -> Vector:
    """Return of each parameter the largest of several moves, with its sign."""
    return moved[np.argmax(np.abs(moved), axis=0), np.arange(moved.shape[1])]


def parameter_biases(
    names: Sequence[str],
    value: Vector,
    std: Vector,
    bias: Vector,
    ends: Matrix,
    causes: Sequence[tuple[str, float | None]],
    freedom: float,
) -> tuple[ParameterBias, ...]:
    """Return a row for each parameter whose bias is known.

    `ends` are those of its interval, `causes` names and shares.
    """
    found = []
    for name, v, s, b, ci, (cause, share) in zip(
        names, value, std, bias, ends, causes, strict=True
    ):
        if np.isfinite(b):
            errors = float(abs(b) / s) if s > 0 else None
            # Per cent of what may be 0 mean nothing
            relative = float(b / v) if v and not abs(v) <= s else None
            limits = (float(ci[0]), float(ci[1])) if np.isfinite(ci).all() else None
            determined = limits is None or is_determined(float(v), float(s), freedom, *limits)
            found.append(
                ParameterBias(
                    name,
                    float(b),
                    cause,
                    share,
                    relative,
                    errors,
                    limits if determined else None,
                    determined,
                )
            )
    return tuple(found)


def _unbounded_warnings(names: Sequence[str], std: Vector, ends: Matrix) -> list[Warning]:
    """Return a warning where physical parameters have an interval but no bounded bias."""
    none = [
        name
        for name, s, e in zip(names, std, ends, strict=True)
        if np.isfinite(s) and not np.isfinite(e).all()
    ]
    if not none:
        return []
    text = (
        f"no interval of {', '.join(none)} includes the bias: some values of theta within the "
        "wider intervals"
    )
    return [Warning("physics_not_met", f"{text} correspond to no physical parameters.")]
