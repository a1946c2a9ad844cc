"""Account of the preparation of a record: steps, their options, and the samples they changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from orthaug._base.errors import InputError

FILTERS = ("lowpass", "highpass", "decimate")
_DONE = {
    "outliers": "marked as missing",
    "repeats": "marked as missing",
    "limits": "marked as missing",
    "fill": "reconstructed",
}


@dataclass(frozen=True)
class Preparation:
    """A step of preparation: its kind, its options, and how many samples it changed.

    Changed samples were marked as missing or filled.
    """

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
    def looks_ahead(self) -> bool:
        """True if the step is a filter of zero phase, whose output depends on later samples."""
        return self.step in FILTERS and self.options.get("phase", "zero") == "zero"

    @property
    def text(self) -> str:
        """The step with its options and the number of samples that it changed."""
        done = _DONE.get(self.step)
        samples = "1 sample" if self.samples == 1 else f"{self.samples} samples"
        return f"{self.named}: {samples} {done}" if done else self.named

    def with_samples(self, samples: int) -> Preparation:
        """Return the step with another number of samples."""
        return replace(self, samples=samples)


def added_up(prepared: Sequence[tuple[Preparation, ...]]) -> tuple[Preparation, ...]:
    """Return the steps of records that are joined, with the sums of their samples.

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
