"""Channels of a record: names, units, and their form in files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from orthaug._base.checks import (
    check_label,
    check_type,
    check_unique,
    is_number,
)
from orthaug._base.errors import LONGEST, InputError, show, visible
from orthaug._base.lines import with_unit
from orthaug.data.expressions import RESERVED, is_name

_DERIVED = ("model", "baseline", "learner", "model_low", "model_high")  # columns of result tables


def _other_name(name: Any) -> str:
    """Return what to call the channel of a column with such a name, as a sentence; or nothing."""
    words = "_".join(re.findall(r"[A-Za-z0-9]+", name if isinstance(name, str) else ""))
    words = words[:LONGEST]
    other = words if is_name(words) else f"the_{words}"[:LONGEST]
    if not words or not is_name(other):
        return ""
    column = visible(name)
    return f' Call it {other}, and give the name in the file as its column: column = "{column}".'


@dataclass(frozen=True)
class Channel:
    """A named signal with its unit, and its form in files.

    A file holds `value = scale * cell + offset` of `column`.

    Examples:
        >>> Channel("force", "N", column="F (kN)", scale=1000.0).label
        'force [N]'
    """

    name: str
    unit: str = ""
    column: str = ""
    scale: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        if not is_name(self.name):
            raise InputError(
                f"{_quote(self.name)} cannot name a channel.{_other_name(self.name)} Use letters, "
                f"digits and underscores, at most {LONGEST}, not starting with a digit, and none "
                f"of {', '.join(sorted(RESERVED))}."
            )
        check_label(self.unit, f"the unit of '{self.name}'")
        check_type(self.column, str, f"column of '{self.name}'", "a column's name")
        if not (is_number(self.scale) and self.scale != 0 and is_number(self.offset)):
            raise InputError(
                f"channel '{self.name}': `scale` must be finite and not 0, `offset` finite; "
                f"got {show(self.scale)} and {show(self.offset)}."
            )

    @property
    def file_column(self) -> str:
        """The column of a file that holds it; by default the one of its name."""
        return self.column or self.name

    @property
    def label(self) -> str:
        """`name [unit]`, the label of an axis."""
        return with_unit(self.name, self.unit)


def _quote(name: object) -> str:
    return f"'{name}'" if isinstance(name, str) else show(name)


def as_channels(given: object, what: str) -> tuple[Channel, ...]:
    """Return the channels of names or `Channel`s.

    Raises:
        InputError: one text instead of several, or anything else that names no channels.
    """
    if (
        isinstance(given, str)
        or not isinstance(given, Iterable)
        or isinstance(given, np.ndarray)
        and not given.ndim
    ):
        example = given if isinstance(given, str) else "y"
        raise InputError(
            f"`{what}` must be a list of names or Channels, such as ['{example}']; got "
            f"{show(given)}."
        )
    return tuple(name if isinstance(name, Channel) else Channel(name) for name in given)


def check_channels(inputs: Sequence[Channel], outputs: Sequence[Channel]) -> None:
    """Raise InputError for a name that is given twice, or that result tables use.

    Outputs must not be named like a column of result tables.
    """
    check_unique((channel.name for channel in (*inputs, *outputs)), "channel")
    derived = [f"{c.name}_{part}" for c in outputs for part in _DERIVED]
    for channel in outputs:
        if channel.name in ("time", *derived):
            raise InputError(
                f"an output cannot be called '{channel.name}': results have a column of that name."
            )
