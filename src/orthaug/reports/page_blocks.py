"""Building blocks of a page: sections of paragraphs, tables and plots.

And the format of numbers in cells.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from orthaug._base import lines
from orthaug._base.lines import MOST_DIGITS, digits_for, with_unit
from orthaug.analysis.fit_findings import ParameterResult

_LARGE = 7  # digits before the point from which a power of ten is written
_RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
_SMALL = 1e-4  # below it a power of ten is written, as `g` does
_ROUNDING = 1e-12  # of its scale: a smaller number is the rounding error of zero
_PERCENT, _SIGN = re.compile(r"(?<=\d) (?=%)"), re.compile(r"−(?=[\d.])")
_MINUS = re.compile(r"(?<![\w\])}.-])-(?=[\d.])")  # before a number of its own


def number(value: float | None, digits: int = 5, scale: float | None = None) -> str:
    """Return the text of a number; 0 for rounding error beside a `scale`, a dash for no number."""
    if value is None:
        return "–"
    if value == 0 or (scale is not None and abs(value) <= _ROUNDING * abs(scale)):
        return "0"
    text = f"{value:.{digits}g}"
    mantissa, _, power = text.partition("e")
    if power and 0 < int(power) < _LARGE:
        text = f"{float(text):.0f}"
    elif power:
        text = f"{mantissa}·10{str(int(power)).translate(_RAISED)}"
    return text.replace("-", "−")


def interval(ends: Sequence[float | None] | None, digits: int = 5) -> str:
    """Return the two ends of an interval, with at least as many digits as show their difference.

    A dash where there is none.
    """
    if ends is None:
        return "–"
    known = [end for end in ends if end is not None]
    scale = max(map(abs, known), default=None)
    digits = digits_for(scale, max(known) - min(known), digits) if known else digits
    decimals = None if not scale else digits - 1 - math.floor(math.log10(scale))
    if decimals is None or not 0 < decimals <= MOST_DIGITS or None in ends:
        return " … ".join(number(end, digits, scale) for end in ends)
    power = math.floor(math.log10(scale)) if scale and scale < _SMALL else 0
    rounding = _ROUNDING * (scale or 0.0)
    texts = [
        f"{0.0 if abs(end) <= rounding else end / 10.0**power:.{decimals + power}f}"
        for end in known
    ]
    while all(text.endswith("0") for text in texts) and "." in texts[0]:
        texts = [text[:-1].removesuffix(".") for text in texts]
    shown = " … ".join(texts).replace("-", "−")
    return f"({shown})·10{str(power).translate(_RAISED)}" if power else shown


def percent(share: float | None, digits: int = 2, *, signed: bool = False) -> str:
    """Return a share in per cent."""
    if share is None:
        return "–"
    shown = 0.0 if abs(share) < _ROUNDING else 100 * share
    if shown and abs(shown) < 10**-3:
        return "< 0.001 %"
    text = (
        lines.percent(shown / 100, digits, sign="+")
        if signed and shown
        else lines.percent(shown / 100, max(digits, 3))
    )
    mantissa, power, rest = text.partition("e")
    if power:
        text = f"{mantissa}·10{str(int(rest.removesuffix(' %'))).translate(_RAISED)} %"
    return text.replace("-", "−")


def chance(p: float | None) -> str:
    """Return a p-value; a small one is as good as a smaller one."""
    return "< 10⁻⁶" if p is not None and p < 1e-6 else number(p, 2)


def prose(text: str) -> str:
    r"""Return a sentence with the minus signs of the tables, whose figures no line end cuts.

    Examples:
        >>> prose("moves y[k-1] by -0.015, from -2 to 3")
        'moves y[k-1] by −\u20600.015, from −\u20602 to 3'
        >>> prose("5 % of it")
        '5\xa0% of it'
    """
    return unbroken(_MINUS.sub("−", text))


def unbroken(text: str) -> str:
    """Return a text whose lines end neither between a figure and % nor behind a minus sign."""
    return _PERCENT.sub("\xa0", _SIGN.sub("−\u2060", text))


def regressor_label(name: str, units: Mapping[str, str]) -> str:
    """Return a channel, or a lag of one, with its unit; units by channel."""
    return with_unit(name, units.get(name.partition("[")[0]))


def parameter_label(row: ParameterResult) -> str:
    """Return a parameter with its unit, or with the implied one where the spec gives none."""
    return with_unit(row.name, row.unit or ("" if row.derived_unit == "1" else row.derived_unit))


CATEGORIES = {"autorange": "reversed", "automargin": True, "type": "category"}
"""Plotly's axis of names, the first one at the top."""


def axis_titles(x: str, y: str) -> dict[str, Any]:
    """Return Plotly's layout of two axes with titles and no legend."""
    return {"xaxis": {"title": {"text": x}}, "yaxis": {"title": {"text": y}}, "showlegend": False}


def area(color: str, **place: Any) -> dict[str, Any]:
    """Return Plotly's rectangle behind the curves."""
    return {"type": "rect", **place, "fillcolor": color, "line": {"width": 0}, "layer": "below"}


def round_values(values: Any, digits: int = 6) -> list[Any]:
    """Return numbers, or rows of them, rounded for drawing; None for what is not finite."""
    if np.ndim(values) > 1:
        return [round_values(row, digits) for row in values]
    return [
        float(f"{v:.{digits}g}") if math.isfinite(v) else None
        for v in np.asarray(values, dtype=float).tolist()
    ]


@dataclass(frozen=True)
class Text:
    """A paragraph; `kind` is plain, note, warning, or hint for what is of use on a screen only."""

    text: str
    kind: str = "plain"


@dataclass(frozen=True)
class Table:
    """Cells as text, under a caption that is a sentence."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Code:
    """Verbatim text, such as a spec; folded where it is `long`."""

    text: str
    label: str
    long: bool = False


@dataclass(frozen=True)
class Plot:
    """A Plotly figure that the page draws.

    `label` is for screen readers, `caption` is shown below.
    """

    label: str
    caption: str
    traces: list[dict[str, Any]]
    layout: dict[str, Any] = field(default_factory=dict)
    height: int = 320
    small: bool = False
    series: Mapping[str, Any] = field(default_factory=dict)
    """Long curves by the name that traces refer to."""
    whole: tuple[float, float] | None = None
    """Range of the x axis with all curves, where the plot opens on a part of it."""


@dataclass(frozen=True)
class Grid:
    """Small plots beside each other, as many as the width holds."""

    plots: Sequence[Plot]


@dataclass(frozen=True)
class Section:
    """A chapter of a page; one that is `folded` shows its title until it is opened."""

    key: str
    title: str
    blocks: Sequence[Text | Table | Code | Plot | Grid]
    folded: bool = False


def plots_of(sections: Sequence[Section]) -> list[Plot]:
    """Return all plots in their order."""
    blocks = [block for section in sections for block in section.blocks]
    return [
        plot
        for block in blocks
        for plot in (block.plots if isinstance(block, Grid) else (block,))
        if isinstance(plot, Plot)
    ]
