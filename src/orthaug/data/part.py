"""A part of the data: the rows for training, for validation, or for a test."""

from __future__ import annotations

from dataclasses import dataclass

from orthaug.data.record import Record
from orthaug.data.sources import Source


@dataclass(frozen=True, eq=False)
class Part:
    """A part of the data: its record, and the leading samples of each recording not scored."""

    name: str
    record: Record
    skip: int = 0
    source: Source | None = None
    """All rows of the part, where its record is only a subsample of them."""

    @property
    def skips(self) -> tuple[int, ...]:
        """Return how many leading samples of each experiment are not scored."""
        return tuple(
            max(0, self.skip - experiment.offset) for experiment in self.record.experiments
        )
