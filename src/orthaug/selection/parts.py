"""Rows that choose and rows that are fitted.

Intervals hold after a choice that was made on other rows (Cox 1975).

Terms that one half of the data picked are fitted to the other: it had no say in the choice, so
estimates, intervals and p-values there are as if the terms had been declared. The half that is
fitted begins with lags of its own, so no row of the other is among its regressors. Where the rows
do not suffice for two halves all of them choose and are fitted, and nothing that these rows say of
the terms is an interval.
"""

from __future__ import annotations

from dataclasses import dataclass

from orthaug._base.errors import InputError
from orthaug.data.record import Record
from orthaug.inference.chosen_terms import SPLIT, Intervals
from orthaug.physics.baseline import Baseline
from orthaug.physics.problem import pose

FEWEST = 200
"""Usable rows of a half, where the halves are left to the data."""
_SHARE = 1 / 3  # of the rows that each part has at least, where whole experiments are parted


AS_DECLARED = Intervals(
    "declared",
    "nothing was chosen beside the physics, so it is fitted to all rows as it was declared.",
)
CONDITIONAL = Intervals(
    "conditional",
    "intervals of a fit on these data are conditional on the network, which was chosen on "
    "them; with `halves` one half of the data chooses and the other is fitted.",
)


@dataclass(frozen=True, eq=False)
class Parts:
    """The record that chooses, the one that is fitted, and what intervals of the latter are."""

    chooses: Record
    fitted: Record
    intervals: Intervals


def split_record(
    record: Record, baseline: Baseline, lags: int, *, by: str | None = None, least: int = FEWEST
) -> Parts:
    """Cut a record into the part that chooses and the one that is fitted.

    Args:
        record: the data.
        baseline: the physics.
        lags: leading rows of an experiment that are lags.
        by: "rows" cuts every experiment in two, "experiments" leaves each whole; None takes what
            parts the rows evenly.
        least: usable rows of each part.

    Raises:
        InputError: a part that is too short, or does not excite the physics; the message says
            which.
    """
    first, second = _cut(record, lags, by)
    fewest = min(_usable(part, lags) for part in (first, second))
    if fewest < least:
        raise InputError(
            f"a half of the data has {fewest} usable rows, and {least} are needed to choose "
            "and to fit"
        )
    if baseline.names:
        try:
            pose(second, baseline)
        except InputError:
            raise InputError(
                "the second half of the data does not excite all of the physics"
            ) from None
    return Parts(first, second, of_parts(_usable(second, lags)))


def of_parts(rows: int) -> Intervals:
    """Return what intervals are after a choice on other rows."""
    text = (
        f"coefficients and intervals are of {rows} rows that were not used for the choice (a "
        "split sample). They are as valid as if the terms had been declared."
    )
    return Intervals(SPLIT, text)


def _cut(record: Record, lags: int, by: str | None) -> tuple[Record, Record]:
    """Cut by whole experiments where that is asked for, or parts the rows evenly enough.

    Else every experiment.
    """
    lengths = [_rows(len(experiment), lags) for experiment in record.experiments]
    if by != "rows" and len(lengths) > 1:
        total = sum(lengths)
        cut = min(range(1, len(lengths)), key=lambda i: abs(2 * sum(lengths[:i]) - total))
        if by == "experiments" or _SHARE <= sum(lengths[:cut]) / max(total, 1) <= 1 - _SHARE:
            return record.split(cut / len(lengths), by="experiments")
    return record.split(0.5)


def _usable(record: Record, lags: int) -> int:
    return sum(_rows(len(experiment), lags) for experiment in record.experiments)


def _rows(length: int, lags: int) -> int:
    return max(length - lags, 0)
