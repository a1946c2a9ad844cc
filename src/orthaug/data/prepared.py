"""What was done to the samples of a record: steps with their options, and how many samples they changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from orthaug._base.errors import InputError


@dataclass(frozen=True)
class Prepared:
    """A step that data went through: its kind, its options, and how many samples it marked as missing or filled."""

    step: str
    options: dict[str, Any]
    samples: int = 0

    @property
    def named(self) -> str:
        """The step with its options in words."""
        values = {
            name: " ".join(v) if isinstance(v, list) else v for name, v in self.options.items()
        }
        return f"{self.step} ({', '.join(f'{name} {value}' for name, value in values.items())})"

    @property
    def text(self) -> str:
        """The same with what it found."""
        done = {"outliers": "marked as missing", "fill": "reconstructed"}.get(self.step)
        samples = "1 sample" if self.samples == 1 else f"{self.samples} samples"
        return f"{self.named}: {samples} {done}" if done else self.named

    def with_samples(self, samples: int) -> Prepared:
        """The same step of more samples."""
        return replace(self, samples=samples)


def added_up(prepared: Sequence[tuple[Prepared, ...]]) -> tuple[Prepared, ...]:
    """Return what was done to records that are joined, their samples added up.

    All went through the same steps.

    Raises:
        InputError: they did not.
    """
    kinds = {tuple((done.step, repr(done.options)) for done in one) for one in prepared}
    if len(kinds) > 1:
        raise InputError(
            "records that went through different preparation cannot be joined; prepare all alike."
        )
    return tuple(
        done[0].with_samples(sum(one.samples for one in done))
        for done in zip(*prepared, strict=True)
    )
