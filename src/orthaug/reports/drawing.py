"""The style of all figures: fixed panels, labels, colours, and the formats of files."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec

import numpy as np

from orthaug._base.checks import check_type
from orthaug._base.errors import InputError
from orthaug.models.response import Response

try:
    from matplotlib import rc_context, rcParams, rcParamsDefault
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
except UnicodeDecodeError:
    raise InputError(
        "matplotlibrc: found letters that are not UTF-8; correct that file, or remove it."
    ) from None

# Okabe-Ito: distinguishable for every reader
BLACK, GREY, BLUE, ORANGE, GREEN = "#000000", "#B8B8B8", "#0072B2", "#E69F00", "#009E73"
CYCLE = (BLUE, ORANGE, GREEN, BLACK)
SIZE = (7.0, 2.4)  # inches per panel
TOP, BOTTOM, RIGHT = 0.6, 0.5, 0.15  # inches around panels
_LEFT, _GAP = 0.95, 0.32
_WINDOW = 250  # samples of a long record that are shown, so that single swings can be seen
_TITLE, _YLABEL, _XLABEL = 0.1, 0.72, 0.26  # inches from the figure's edge or the panel's
_SHARPNESS = 160  # pixels per inch
_COLUMNS = round(SIZE[0] * _SHARPNESS)  # more points than these cannot be distinguished
Drawn = ParamSpec("Drawn")


def _own_style() -> AbstractContextManager[None]:
    """Return a context in which the user's own settings of matplotlib do not change the figures.

    A `$` in a unit does not begin a formula.
    """
    own: dict[Any, Any] = {
        key: value for key, value in rcParamsDefault.items() if not key.startswith("backend")
    }
    own |= {"text.parse_math": False, "text.hinting": "none"}
    return rc_context({key: value for key, value in own.items() if rcParams[key] != value})


def plain(draw: Callable[Drawn, Figure]) -> Callable[Drawn, Figure]:
    """Return a function that draws in the style of this package."""

    @wraps(draw)
    def draw_styled(*arguments: Drawn.args, **options: Drawn.kwargs) -> Figure:
        with _own_style():
            return draw(*arguments, **options)

    return draw_styled


def axes_for(ax: Axes | None) -> Axes:
    """Return the given axes, or new ones: of pyplot where that is in use, for notebooks to show.

    Raises:
        InputError: something else.
    """
    check_type(ax, Axes | None, "ax", "axes of matplotlib, or None")
    if ax is not None:
        return ax
    return rule_axes(new_figure(SIZE[0], SIZE[1] + TOP + BOTTOM).add_subplot())


def new_figure(width: float, height: float) -> Figure:
    """Return a figure [inches]: of pyplot where that is in use, for notebooks to show."""
    made: Callable[..., Figure] = Figure
    if "matplotlib.pyplot" in sys.modules or "ipykernel" in sys.modules:
        from matplotlib import pyplot

        made = pyplot.figure
    return made(figsize=(width, height), layout="constrained")


def rule_axes(axis: Axes) -> Axes:
    """Return axes with a faint grid, and no frame above and beside it."""
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)
    return axis


def panels(response: Response, title: str, heights: tuple[int, ...] = (1,)) -> tuple[Figure, list]:
    """Return a figure with stacked axes, `len(heights)` per output."""
    ratios = heights * len(response.outputs)
    figure = Figure(figsize=(SIZE[0], TOP + SIZE[1] * sum(ratios) / max(heights)))
    axes = grid(figure, len(ratios), 1, sharex=True, height_ratios=ratios)[:, 0]
    headline(figure, title)
    return figure, list(axes)


def grid(
    figure: Figure,
    rows: int,
    columns: int,
    *,
    gap: tuple[float, float] = (_GAP, _GAP),
    left: float = _LEFT,
    bottom: float = BOTTOM,
    top: float = TOP,
    **options: Any,
) -> np.ndarray:
    """Return panels (rows, columns) at fixed places.

    A layout found from the sizes of all texts takes longer than drawing.

    Args:
        gap: inches between rows and columns; `left`, `bottom` and `top` those around them.
    """
    width, height = figure.get_size_inches()
    high, wide = height - top - bottom, width - left - RIGHT
    place = {
        "left": left / width,
        "right": 1 - RIGHT / width,
        "bottom": bottom / height,
        "top": 1 - top / height,
    }
    place["hspace"] = gap[0] * rows / max(high - gap[0] * (rows - 1), 0.1)
    place["wspace"] = gap[1] * columns / max(wide - gap[1] * (columns - 1), 0.1)
    axes = figure.subplots(rows, columns, squeeze=False, gridspec_kw=place, **options)
    for axis in axes.flat:
        rule_axes(axis)
    return axes


def headline(figure: Figure, title: str) -> None:
    """Write the title above all panels."""
    figure.suptitle(title, fontsize=10, y=1 - _TITLE / figure.get_size_inches()[1], va="top")


def label(
    axis: Axes, *, x: str | None = None, y: str | None = None, title: str | None = None
) -> None:
    """Label an axis at a fixed distance from the panel."""
    figure = axis.get_figure(root=True)
    assert figure is not None
    wide, high = axis.get_position().size * figure.get_size_inches()
    if x is not None:
        axis.set_xlabel(x)
        axis.xaxis.set_label_coords(0.5, -_XLABEL / high)
    if y is not None:
        axis.set_ylabel(y)
        axis.yaxis.set_label_coords(-_YLABEL / wide, 0.5)
    if title is not None:
        axis.set_title(title, fontsize=9, y=1.0)


def outline(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a curve to draw; of a long one the extremes in every column of pixels.

    It goes across rows without a value, between others.
    """
    there = np.isfinite(values)
    ends = np.flatnonzero(there)[[0, -1]] if there.any() else (0, 0)
    if not there[ends[0] : ends[1] + 1].all():
        time, values = time[there], values[there]
    if len(values) <= 4 * _COLUMNS:
        return time, values
    starts = np.linspace(0, len(values), _COLUMNS, endpoint=False).astype(int)
    ends = np.stack([ufunc.reduceat(values, starts) for ufunc in (np.fmin, np.fmax)], axis=1)
    return np.repeat(time[starts], 2), ends.ravel()


def extent(response: Response, rows: slice) -> str:
    """Return a text on which samples of the record are drawn."""
    whole = len(response.trajectories[0].model)
    text = f"samples {rows.start} to {rows.stop - 1} of {whole}"
    return text + (
        f", first of {len(response.trajectories)} experiments"
        if len(response.trajectories) > 1
        else ""
    )


def window(response: Response) -> tuple[np.ndarray, slice]:
    """Return the instants [s] and the rows that a figure shows of the first experiment."""
    trajectory = response.trajectories[0]
    rows = slice(trajectory.start, min(trajectory.start + _WINDOW, len(trajectory.model)))
    return trajectory.time(response.sampling_time)[rows], rows


def legend(axis: Axes, *shown: object) -> None:
    """Draw the legend above the panel: of its own lines, or of those in `shown`."""
    axis.legend(
        *shown,
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        borderaxespad=0.2,
        fontsize=8,
        frameon=False,
        ncols=3,
    )


def save(figure: Figure, path: Path, kind: str = "png") -> None:
    """Write a figure that is sharp at column width; `kind` is also pdf or svg."""
    with warnings.catch_warnings(), _own_style():
        warnings.simplefilter("ignore")  # such as a unit in letters that the font lacks
        figure.set_dpi(_SHARPNESS)
        if kind == "png":
            FigureCanvasAgg(figure).print_png(
                path, pil_kwargs={"compress_level": 2}
            )  # `savefig` would draw it twice
        else:
            figure.savefig(path, format=kind)


def floats(values: Sequence[float | None]) -> np.ndarray:
    """Return the numbers of a result, NaN for None."""
    return np.array(values, dtype=float)
