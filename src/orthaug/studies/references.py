"""Results of the authors' published scripts: mean, smallest and largest per configuration.

`python tests/test_references.py FOLDER` makes `references.json` from the single runs, and says how
they were measured.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np

from orthaug._base.lines import percent

_AXES = {
    "static": ("data_set", "noise_30dB", "structure"),
    "mass_spring_damper": ("structure", "weight"),
}


class Spread(NamedTuple):
    """A quantity over the scripts' runs."""

    mean: float
    low: float
    high: float
    runs: int

    def __str__(self) -> str:
        # As many as make low and high differ
        digits = 3 if self.high - self.low > 0.01 * self.mean else 6
        return f"{self.mean:.{digits}g} ({self.low:.{digits}g} … {self.high:.{digits}g})"

    def scaled(self, factor: float) -> Spread:
        return Spread(factor * self.mean, factor * self.low, factor * self.high, self.runs)

    def beside(self, values: Any, *, smaller_is_better: bool = False) -> tuple[bool, str]:
        """Return whether the mean of our runs is within the range of theirs, and a text on it.

        Three digits count, as they are shown.

        Args:
            smaller_is_better: below all of theirs is met too, as for an error of prediction.
        """
        ours = float(np.mean(np.asarray(values, dtype=float)))
        if self.low <= ours <= self.high:
            return True, f"mean within the scripts' smallest and largest of {self.runs} runs"
        side, which, end = (
            ("below", "smallest", self.low) if ours < self.low else ("above", "largest", self.high)
        )
        if f"{ours:.3g}" == f"{end:.3g}":
            return True, f"mean, in three digits, equal to the scripts' {which} of {self.runs} runs"
        text = f"mean {side} the scripts' {which} of {self.runs} runs ({_ratio(ours, end)})"
        return smaller_is_better and ours < self.low, text


def _ratio(ours: float, end: float) -> str:
    ratio = ours / end
    return f"by {percent(abs(ratio - 1))}" if abs(ratio - 1) < 0.1 else f"{ratio:.2g} times it"


@cache
def _tables() -> dict[str, dict[tuple[object, ...], Mapping[str, object]]]:
    content = json.loads(
        files("orthaug.studies").joinpath("references.json").read_text(encoding="utf-8")
    )
    return {
        name: {tuple(row[axis] for axis in axes): row for row in content[name]}
        for name, axes in _AXES.items()
    }


def static(data_set: int, structure: str, quantity: str, *, noise: bool = False) -> Spread:
    """Return `test_rmse`, `test_sse`, `theta_error` or `seconds` of Sect. 5.1."""
    return _spread(_tables()["static"][data_set, noise, structure], quantity)


def mass_spring_damper(structure: str, weight: float, quantity: str) -> Spread | None:
    """Return `test_rmse` [m], `theta_error` (relative) or `seconds` of Sect. 5.2.

    None for a weight that was not run.
    """
    row = _tables()["mass_spring_damper"].get((structure, weight))
    return None if row is None else _spread(row, quantity)


def seconds(example: str) -> tuple[float, float]:
    """Return the shortest and the longest run of an example, compilation included."""
    spreads = [_spread(row, "seconds") for row in _tables()[example].values()]
    return min(spread.low for spread in spreads), max(spread.high for spread in spreads)


def _spread(row: Mapping[str, Any], quantity: str) -> Spread:
    return Spread(*(row[quantity][part] for part in ("mean", "min", "max")), runs=row["runs"])
