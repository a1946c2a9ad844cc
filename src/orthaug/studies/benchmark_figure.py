"""The figure of `orthaug benchmark`: errors of every model on every test, on a logarithmic axis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from orthaug.reports.benchmark import SetResult
from orthaug.reports.drawing import BLACK, BLUE, GREEN, GREY, ORANGE, new_figure, plain, rule_axes
from orthaug.studies.public_sets import DECLARED, DEFAULT, PHYSICS

_ROW, _EDGE, _WIDTH = 0.32, 0.75, 8.0  # inches a test, around the tests of a set, of the figure
_STYLES = {
    PHYSICS: ("s", GREY),
    DEFAULT: ("^", GREEN),
    DECLARED: ("o", BLUE),
    "published": ("|", BLACK),
    "other packages": ("x", ORANGE),
}


@plain
def benchmark_figure(sets: Sequence[SetResult]):
    """Return a figure with a panel for each set and a row for each test."""
    points = [list(_points(one)) for one in sets]
    rows = [list(dict.fromkeys(label for label, _, _ in own)) or [""] for own in points]
    heights = [_ROW * len(own) + _EDGE for own in rows]
    figure = new_figure(_WIDTH, sum(heights) + 0.3)
    panels = figure.subplots(len(sets), squeeze=False, height_ratios=heights)[:, 0]
    used: dict[str, Any] = {}
    for one, own, labels, axis in zip(sets, points, rows, panels, strict=True):
        rule_axes(axis)
        for label, kind, value in own:
            marker, colour = _STYLES[kind]
            used[kind] = axis.plot(
                value,
                labels.index(label),
                marker,
                color=colour,
                markersize=12 if marker == "|" else 6,
                linestyle="none",
            )[0]
        axis.set_yticks(range(len(labels)), labels)
        axis.set_ylim(len(labels) - 0.5, -0.5)
        axis.set_xscale("log")
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        axis.xaxis.set_minor_formatter(NullFormatter())
        units = {verdict.unit for verdict in one.verdicts} - {""}
        axis.set_xlabel(f"RMSE, {units.pop()}" if len(units) == 1 else "RMSE")
        axis.set_title(one.title, loc="left", fontsize="medium")
    kinds = [kind for kind in _STYLES if kind in used]
    figure.legend(
        [used[kind] for kind in kinds], kinds, loc="outside lower center", ncols=len(kinds) or 1
    )
    return figure


def _points(one: SetResult) -> Iterator[tuple[str, str, float]]:
    """Yield test, kind and RMSE of all that has a figure above zero."""
    outputs = {error.output for model in one.models for error in model.errors}
    for kind, errors in (
        *((model.fit, model.errors) for model in one.models),
        *(("other packages", other.errors) for other in one.beside),
    ):
        for error in errors:
            if error.rmse:
                label = error.test if len(outputs) < 2 else f"{error.test}, {error.output}"
                yield label, kind, error.rmse
    for entry in one.published:
        for test, rmse in entry.errors.items():
            if rmse:
                yield test, "published", rmse
