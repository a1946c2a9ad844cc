"""An experiment on its way through steps of preparation, and what a step is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from orthaug._base.checks import Matrix, Vector, check_type, nearest
from orthaug._base.errors import InputError

Channels = tuple[str, ...] | None


@dataclass(frozen=True, eq=False)
class Run:
    """An experiment on its way through the steps: `values` (N, n), NaN where a sample is missing, at `instants` [s]."""

    values: Matrix
    instants: Vector
    names: tuple[str, ...]
    inputs: int
    """How many of the channels, the first ones, are inputs."""
    step: float
    """Sampling time [s]; of uneven instants the usual one."""
    even: bool = True
    first: int = 0
    """Rows that were cut off at the begin."""
    stride: int = 1
    moved: bool = False
    """Whether the samples are no rows of the file any more."""

    def columns(self, channels: Channels, usual: range | None = None) -> list[int]:
        """Indices of channels; without names the usual ones, which are all unless given."""
        if channels is None:
            return list(range(len(self.names)) if usual is None else usual)
        check_type(channels, tuple | list, "channels", "a list of channel names")
        for name in channels:
            if name not in self.names:
                known = ", ".join(self.names)
                raise InputError(f"`channels`: no channel '{name}'{nearest(name, self.names)}; there are {known}.")
        return [self.names.index(name) for name in channels]

    def holding(self, columns: list[int], values: Matrix) -> Run:
        """The same with other values in some columns."""
        changed = self.values.copy()
        changed[:, columns] = values
        return replace(self, values=changed)

    def check_even(self, what: str) -> None:
        """Raise InputError where the instants are uneven."""
        if not self.even:
            raise InputError(f"{what} needs even sampling; put a step `resample` before it.")


@runtime_checkable
class Step(Protocol):
    """A step of preparation: a frozen declaration."""

    def apply(self, run: Run) -> Run:
        """The experiment after the step.

        Raises:
            InputError: what cannot be done with these samples.
        """
        ...


def stretches(values: Matrix) -> Iterator[slice]:
    """Half-open ranges of rows without a missing sample."""
    there = np.isfinite(values).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(int)))
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        yield slice(begin, end)
