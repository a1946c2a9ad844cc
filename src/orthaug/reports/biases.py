"""Table of the parameters' biases, by their causes.

It selects the biases for a heat map, and formats its cells.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix
from orthaug._base.lines import percent, plain_number, plural
from orthaug.analysis.causes import SURE_SHARE
from orthaug.analysis.findings import NO_GUESS, SuspectResult
from orthaug.analysis.fit_findings import ParameterResult
from orthaug.reports import page_blocks

REMOVED_BY = (
    "Removed by: a measure, if some weighting of these points leaves none; the learner, if it sees "
    "the term, from what it could not imitate."
)
_MOST_COLUMNS = 12  # more cells beside each other are too narrow for their numbers on paper
_MOST_CELLS = 200
_LEAST = 0.01  # per cent: a smaller bias is written as "less", since a cell is narrow
_ZERO = 1e-7


@dataclass(frozen=True, eq=False)
class BiasMap:
    """The part of a bias table that is drawn, with a number in every cell.

    `shares` (suspects, parameters) are in per cent, NaN where there is none; `colours` are their
    signed logarithms, so that biases of 0.1 % and of 100 % both show, and lie within ± `reach`.
    """

    parameters: tuple[str, ...]
    suspects: tuple[str, ...]
    shares: Matrix
    left_out: str
    """A sentence on what the map leaves out; empty where it is complete."""
    sizes: tuple[str, ...]
    """Sentences: how large each term counts, and how large the learner found it."""

    @property
    def colours(self) -> Matrix:
        """Values that the colours show."""
        return np.sign(self.shares) * np.log10(1 + np.abs(self.shares))

    @property
    def reach(self) -> float:
        """The largest colour."""
        return max(float(np.nanmax(np.abs(self.colours), initial=0.0)), 1e-12)

    @property
    def cells(self) -> list[list[str]]:
        """Texts of the cells."""
        return [[_cell(value) for value in row] for row in self.shares]


def biased_by(rows: Sequence[ParameterResult]) -> dict[tuple[str, float], list[ParameterResult]]:
    """Return the parameters with a bias, by its cause and the share that this explains."""
    found: dict[tuple[str, float], list[ParameterResult]] = {}
    for row in rows:
        if row.bias and row.bias.share is not None:
            found.setdefault((row.bias.cause, row.bias.share), []).append(row)
    return found


OF_FORMS = (
    "Other forms of a selected term fit as well. The largest bias by any of them, and the interval "
    "that holds for all:"
)


def hang_on_form(rows: Sequence[ParameterResult]) -> list[ParameterResult]:
    """Return the parameters that another form of a selected term would change."""
    return [row for row in rows if row.bias and row.bias.share is None]


def of_selected_form(result: Any) -> list[str]:
    """Return the coefficients of selected terms, where other forms fit as well."""
    if not any(warning.code == "rival_forms" for warning in result.warnings):
        return []
    return [row.name for row in result.parameters if row.selected]


def is_biased(row: ParameterResult) -> bool:
    """Return whether a bias is larger than the standard error."""
    return row.bias is not None and bool(row.std) and abs(row.bias.value or 0.0) > (row.std or 0.0)


def size_of_bias(rows: Sequence[ParameterResult]) -> str:
    """Return the size of the largest bias: of the value, and in standard errors."""
    worst = max(rows, key=lambda row: row.errors_of_bias)
    if worst.bias is None or worst.bias.value is None:
        return ""
    times = f"{plain_number(worst.errors_of_bias)} times its standard error"
    relative = worst.share_of_bias
    share = "" if relative is None else page_blocks.percent(relative, signed=True)
    size = f"{share}, {times}" if share else times
    return f" by about {size}" if len(rows) == 1 else f", {worst.name} by about {size}"


def bias_map(suspects: Sequence[SuspectResult]) -> BiasMap:
    """Return all biases, or the largest, in the order of the result.

    Where there are too many, it has the suspects and parameters with the largest ones.
    """
    names = list(suspects[0].percent)
    shares = np.array(
        [[suspect.percent[name] for name in names] for suspect in suspects], dtype=float
    )
    shares = np.where(np.abs(shares) < _ZERO, 0.0, shares)
    size = np.nan_to_num(np.abs(shares))
    columns = _largest_indices(size.max(axis=0), _MOST_COLUMNS)
    rows = _largest_indices(
        size[:, columns].max(axis=1, initial=0.0), _MOST_CELLS // max(len(columns), 1)
    )
    shown = [suspects[i].name for i in rows]
    parts = [
        (len(rows), plural(len(suspects), "suspect")),
        (len(columns), plural(len(names), "parameter")),
    ]
    fewer = " and ".join(
        f"{count} of {whole}" for count, whole in parts if count < int(whole.partition(" ")[0])
    )
    text = (
        f"Shown are those with the largest biases, {fewer}; result.json has all." if fewer else ""
    )
    return BiasMap(
        tuple(names[j] for j in columns),
        tuple(shown),
        shares[np.ix_(rows, columns)],
        text,
        tuple(_sizes(suspects)),
    )


def _sizes(suspects: Sequence[SuspectResult]) -> Iterator[str]:
    """Yield how large the terms count, and how large the learner found the one it shows."""
    if any(suspect.coefficient is not None for suspect in suspects):
        yield "A term with a guessed coefficient has the size of the guess."
    free = [suspect for suspect in suspects if suspect.coefficient is None and suspect.size]
    if free:
        yield (
            f"Without a guess, the bias is that of a term whose RMS is {percent(NO_GUESS)} of "
            "the output's standard deviation."
        )
    best = max(free, key=lambda suspect: suspect.explained or 0.0, default=None)
    if best is not None and (best.explained or 0.0) >= SURE_SHARE:
        times = abs(best.coefficient_found or 0.0) * (best.size or 0.0) / NO_GUESS
        large = f"{plain_number(times)} times as large"
        yield f"The learner found {best.name} {large}, and so is its bias."


def _largest_indices(size: np.ndarray, most: int) -> list[int]:
    """Return the indices of the largest values, in their order."""
    return sorted(np.argsort(-size, kind="stable")[:most].tolist())


def _cell(share: float) -> str:
    if not np.isfinite(share):
        return "–"
    if share and abs(share) < _LEAST:
        return f"< {_LEAST}"
    return plain_number(share, sign="+").replace("-", "−") if share else "0"
