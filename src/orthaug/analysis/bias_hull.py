"""Hull of the biases that a learner implies, over all causes that noise cannot separate.

A cause that explains the share s of what the learner holds beside the physics leaves 1 − s of it.
The truth leaves what the noise puts into the learner, `ν = E‖noise of it‖²/‖it‖²`, and what no form
of the catalogue has; so a cause may be the true one where

    1 − s ≤ 12 (1 − s_best + ν),    and s at least 0.8 of s_best.

Two laws that jump may act together, as Coulomb's and Stribeck's do, and a network rounds a jump:
by chance it does so as one law alone would, and closer than the true mixture comes. So mixtures of
the best with others count that leave 7 (1 − s_best + ν) of it.
Terms that are nearly the physics itself, `|v|^1.1`, fit anything with a huge size and stay out.
Every such cause has an interval about the estimate less its bias, as wide as noise and what it
leaves. What is shown is the hull of them; where that is wider than the value itself, the data do
not determine it beside this learner.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Vector
from orthaug._base.errors import Warning
from orthaug._base.lines import first_words, percent
from orthaug.inference.covariance import reach

# Over 17 forms, half of them in no catalogue, the right bias was within in 130 draws; in 128 by 8
AS_LIKELY = 12.0
# 500 rows at 2 % noise: of a Stribeck law with v² the truth is then missed in 1 % of 100 draws
# instead of 17, of Coulomb's in 3 % of 60 (benchmarks/README.md, silent misses)
_MIXED = 7.0
# Cosine with the physics: beyond it a term is six times larger than what the learner shows of it
MOST_PHYSICS = 0.986
LEAST = 0.8  # of the best share: what explains less is no likely cause
_LISTED = 4  # parameters that a warning lists at most


@dataclass(frozen=True, eq=False)
class Candidate:
    """Candidate for the true cause, with the parameters' shift by its size, estimate less truth."""

    name: str
    share: float
    moved: Vector
    declared: bool = False

    @property
    def unsure(self) -> Vector:
        """Standard deviation of the bias that the candidate leaves unexplained.

        Relative to its size that part is assumed to be as biased as the cause.
        """
        return np.abs(self.moved) * np.sqrt(max(1 - self.share, 0.0) / self.share)


@dataclass(frozen=True, eq=False)
class NamedCause(Candidate):
    """The cause that is named, with the standard deviation of what it leaves."""

    rest: Vector | float = 0.0

    @property
    def unsure(self) -> Vector:
        """Standard deviation of the bias that it does not explain."""
        return self.rest + np.zeros(len(self.moved))


class OtherForm(Candidate):
    """Another form of a term whose form was selected from the data."""


def compatible(candidates: Sequence[Candidate], noise: float) -> list[Candidate]:
    """Return the causes that noise cannot distinguish from the best.

    Where any of these is declared, only declared ones are returned.

    Args:
        noise: ν, the share of what the learner holds that is noise.
    """
    likely = [c for c in candidates if c.share > 0]
    if not likely:
        return []
    best = max(c.share for c in likely)
    left = min(AS_LIKELY * (1 - best + noise), 1 - LEAST * best)
    kept = [c for c in likely if 1 - c.share <= left]
    return [c for c in kept if c.declared] or kept


def most_mixed(best: float, noise: float) -> float:
    """Return the share of the learner that a mixture of causes may leave, by that of the best."""
    return min(_MIXED * (1 - best + noise), 1 - LEAST * best)


def hull(
    value: Vector,
    noise: Float[np.ndarray, "n 2"],
    freedom: float,
    candidates: Sequence[Candidate],
    extra: Vector | float = 0.0,
) -> Float[np.ndarray, "n 2"]:
    """Return 95 % intervals (n, 2) that hold the truth whichever of the candidates is the cause.

    Args:
        noise: the intervals by noise alone; those of positive parameters reach farther upwards, and
            do so beside a bias, too.
        extra: a standard deviation that every cause has beside its own.
    """
    below, above = value - noise[:, 0], noise[:, 1] - value
    unsure = [reach(freedom) * np.hypot(c.unsure, extra) for c in candidates]
    pairs = list(zip(candidates, unsure, strict=True))
    low = np.min([value - c.moved - np.hypot(below, more) for c, more in pairs], axis=0)
    high = np.max([value - c.moved + np.hypot(above, more) for c, more in pairs], axis=0)
    return np.stack([low, high], axis=-1)


def is_determined(value: float, std: float, freedom: float, low: float, high: float) -> bool:
    """Return False where an interval is wider than its value and noise does not make it so wide."""
    noise = 2 * reach(freedom) * std
    return not (high - low > abs(value) and high - low > 2 * noise)


def undetermined_warning(
    names: Sequence[str],
    candidates: Sequence[Candidate],
    remedies: Sequence[str],
    *,
    entries: int,
    outputs: int,
) -> Warning:
    """Return the warning on parameters that the hull leaves open, with reason and remedy.

    Args:
        entries: inputs of the learner.
        outputs: of the model.
    """
    shown = first_words(names, _LISTED)
    apart = sorted(candidates, key=lambda c: float(np.sum(np.sign(c.moved) * c.moved**2)))
    pair = [apart[0], apart[-1]] if len(apart) > 1 else apart
    causes = " and ".join(f"{c.name} ({percent(c.share)} of what it found)" for c in pair)
    alike = len({c.name for c in pair}) == 1
    if alike:
        causes = f"{pair[0].name} in one output and in another"
    of = f": {causes} imply different values" if len(pair) > 1 else ""
    if alike and outputs == 1:
        of = f": {pair[0].name} may be of several sizes" if len(pair) > 1 else ""
    cure = " or ".join(
        remedies
        or (
            "split under another measure",
            *(["give the learner fewer inputs"] if entries > 1 else []),
            "use an input designed for these parameters (`orthaug design`)",
        )
    )
    verb = "is" if len(names) == 1 else "are"
    return Warning(
        "not_determined",
        f"{shown} {verb} not determined by these data with this learner{of}. Remedy: {cure}.",
    )
