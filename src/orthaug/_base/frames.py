"""Table of estimates that a notebook shows with significant digits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pandas as pd

from orthaug._base.lines import estimate_cells

_ESTIMATE = (("value", "coefficient"), ("std",), ("ci95_low",), ("ci95_high",))
"""Columns of an estimate: its value, standard error, and the ends of its interval."""


class EstimateFrame(pd.DataFrame):
    """DataFrame of estimates, one per row.

    It is shown with as many digits as the standard errors allow, value and interval with equal
    decimals; what it holds are the numbers in full. Columns that are taken from it are shown so
    too.

    Examples:
        >>> EstimateFrame({"value": [9.312e-05, 2.0], "std": [1.04e-06, 0.25]}, index=["a", "b"])
               value      std
        a  9.312e-05  1.0e-06
        b       2.00     0.25
    """

    @property
    def _constructor(self) -> Callable[..., EstimateFrame]:
        return EstimateFrame

    def __repr__(self) -> str:
        return repr(_texts(self))

    def _repr_html_(self) -> Any:
        return _texts(self)._repr_html_()  # type: ignore[operator]


def _texts(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a frame with texts in the place of numbers."""
    shown = pd.DataFrame(frame).astype(object)
    floats = [i for i, kind in enumerate(frame.dtypes) if kind.kind == "f"]
    for i in floats:
        shown.isetitem(i, [_text(x) for x in frame.iloc[:, i]])
    places = [_place(frame, names, floats) for names in _ESTIMATE]
    if places[0] is None:
        return shown
    rows = []
    for k in range(len(frame)):
        value, std, low, high = (None if i is None else frame.iat[k, i] for i in places)
        rows.append(estimate_cells(value, std, None if low is None else (low, high)))
    for i, cells in zip(places, zip(*rows, strict=True), strict=False):
        if i is not None:
            shown.isetitem(i, list(cells))
    return shown


def _place(frame: pd.DataFrame, names: tuple[str, ...], floats: list[int]) -> int | None:
    """Return which column of numbers has one of the names; None for none."""
    return next((i for i in floats if frame.columns[i] in names), None)


def _text(x: float) -> str:
    return "–" if pd.isna(x) else f"{x:.6g}"
