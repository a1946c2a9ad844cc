"""Origin of the intervals of a fit whose terms were chosen."""

from __future__ import annotations

from dataclasses import dataclass

SPLIT, NONE = "split sample", "none"


@dataclass(frozen=True)
class Intervals:
    """Source of the intervals of a fit of the choice, in a word and in a sentence.

    `source` is "split sample", from rows that had no say in the choice; "none", for there are none;
    "declared", where nothing was chosen beside the physics; or "conditional", of a network that was
    chosen on the rows that are fitted.
    """

    source: str
    text: str

    @classmethod
    def empty(cls, why: str) -> Intervals:
        """Return that there are none, and why."""
        return cls(
            NONE,
            f"no intervals and no p-values: {why}. The terms were chosen on the rows that are "
            "fitted, where they look more certain than they are. Fit the choice to other data "
            "for intervals.",
        )
