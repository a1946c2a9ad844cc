"""Free runs on a page: whole records with the residual below, packed as four-byte numbers.

The page draws the minimum and maximum of every curve in each column of pixels, anew at every zoom.
"""

from __future__ import annotations

import base64
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.data.channels import Channel
from orthaug.data.record import without_gaps
from orthaug.models.response import Response
from orthaug.reports.page_blocks import Plot, area, number, percent

MOST_POINTS = 100_000  # of a curve
_BUDGET = 560_000  # points of a page: three million letters
# Share of a pair of panels that is the upper one, and what lies between panels
_UPPER, _GAP = (0.64, 0.05)
_MOST_SHADES = 200  # areas of a plot
_PANEL = 330  # pixels of a pair of panels
_DASHES = ("dash", "solid", "dot", "dashdot")
_MOST_BREAKS = 40  # between experiments that are marked
_FAR = 3.0  # times the measured range: a curve that leaves it is cut off at the edge of the panel
_WINDOW = 400  # samples that a plot opens on: single swings are seen
_MOST_ERROR = 1e6  # squared errors beyond, of a run that goes off, are all alike
WITHOUT = "model without its learner"  # its label: it is not the physics fitted alone


@dataclass(frozen=True)
class Run:
    """A free run on a part.

    `alone` that of the model without its learner, None where nothing was learned.
    """

    part: str
    response: Response
    alone: Response | None = None


def run_plots(runs: Sequence[Run], band: Mapping[str, tuple[float, float]]) -> list[Plot]:
    """Return a plot for every part: measured, model, the model without its learner, residual.

    Args:
        band: limits of 95 % of the errors on the training data, for each output.
    """
    lengths = [
        _length(run)
        for run in runs
        for _ in run.response.outputs
        for _ in range(2 + (run.alone is not None))
    ]
    most = _points_per_curve(lengths, _BUDGET)
    return [_plot(run, band, most) for run in runs]


def compared_plots(responses: Mapping[str, Mapping[str, Response]]) -> list[Plot]:
    """Return a plot for every part: measured, and the free run of every model."""
    parts = list(dict.fromkeys(part for runs in responses.values() for part in runs))
    count = sum(
        len(t.model) + 1
        for runs in responses.values()
        for r in runs.values()
        for t in r.trajectories
    )
    outputs = max((len(r.outputs) for runs in responses.values() for r in runs.values()), default=1)
    most = min(
        MOST_POINTS, max(_BUDGET // max(2 * len(parts) * (len(responses) + 1) * outputs, 1), 1000)
    )
    most = MOST_POINTS if 2 * count * outputs < _BUDGET else most
    return [
        _comparison_plot(
            part, {k: runs[part] for k, runs in responses.items() if part in runs}, most
        )
        for part in parts
    ]


def _comparison_plot(part: str, runs: Mapping[str, Response], most: int) -> Plot:
    first = next(iter(runs.values()))
    panels = _Panels(first, most)
    models = {
        name: join_experiments(run, [t.model for t in run.trajectories])
        for name, run in runs.items()
    }
    for i in range(len(first.outputs)):
        own = {"yaxis": f"y{2 * i + 1}", "showlegend": i == 0}
        if panels.measured is not None:
            key = panels.keep("measured", i, panels.measured)
            panels.traces.append(
                {
                    **own,
                    "series": key,
                    "name": "measured",
                    "line": {"color": "@measured", "width": 3},
                    "envelope": "area",
                }
            )
        colors = ("@physics", "@model", "@learner", "@bias") * 9
        for (name, model), color, dash in zip(models.items(), colors, _DASHES * 9, strict=False):
            line = {"color": color, "width": 1.3, "dash": dash}
            given = {"name": name, "legendgroup": name, "line": line}
            drawn = {"series": panels.keep(name, i, model), "envelope": "outline"}
            panels.traces.append({**own, **given, **drawn})
            if panels.measured is not None:
                panels.add_residual(name, i, model, given)
        panels.finish(i, models)
    panels.open_on_worst(next(iter(models.values())))
    lost = [name for name, run in runs.items() if any(t.diverged for t in run.trajectories)]
    samples = sum(len(t.model) for t in first.trajectories)
    caption = (
        f"The free runs of {', '.join(runs)} on {part}, all {samples} samples, with their "
        "residuals below."
    )
    caption += f" The run of {', '.join(lost)} diverges." if lost else ""
    return panels.plot(
        f"Free runs of every model on {part}, with their residuals below.", caption, "time [s]"
    )


def error_band(response: Response) -> dict[str, tuple[float, float]]:
    """Return for each output the limits between which 95 % of the errors of a run are.

    None for a run that diverged.
    """
    found = {}
    if any(t.measured is None or t.diverged for t in response.trajectories):
        return found
    for i, channel in enumerate(response.outputs):
        errors = response.errors[:, i]
        errors = errors[np.isfinite(errors)]
        if len(errors) >= 40:
            found[channel.name] = tuple(
                float(limit) for limit in np.quantile(errors, [0.025, 0.975])
            )
    return found


def _length(run: Run) -> int:
    return sum(len(t.model) + 1 for t in run.response.trajectories)


def _points_per_curve(lengths: Sequence[int], budget: int) -> int:
    """Return how many points a curve may have: short ones are whole, all fit the budget."""
    left, ordered = budget, sorted(lengths)
    for i, length in enumerate(ordered):
        share = left // (len(ordered) - i)
        if length > share:
            return min(share, MOST_POINTS)
        left -= length
    return MOST_POINTS


def pack_curve(values: Vector, x0: float, dx: float, most: int = MOST_POINTS) -> dict[str, Any]:
    """Return a curve at even steps as the page reads it.

    A longer one is kept as the minimum and maximum of each stretch.
    """
    step = dx
    if len(values) > most:
        stride = -(-len(values) // (most // 2))
        filled = np.full(-(-len(values) // stride) * stride, np.nan)
        filled[: len(values)] = values
        cells = filled.reshape(-1, stride)
        values = np.stack(
            [np.fmin.reduce(cells, axis=1), np.fmax.reduce(cells, axis=1)], axis=1
        ).ravel()
        dx = dx * stride / 2
    finite = values[np.isfinite(values)]
    shift = float(finite.mean()) if len(finite) else 0.0
    with np.errstate(over="ignore"):
        bare = (values - shift).astype("<f4")
    return {
        "x0": x0,
        "dx": dx,
        "step": step,
        "shift": shift,
        "f4": base64.b64encode(bare.tobytes()).decode(),
    }


def join_experiments(response: Response, values: Sequence[Matrix | None]) -> Matrix:
    """Return the experiments one after another, with a gap between."""
    gap = np.full((1, len(response.outputs)), np.nan)
    pieces = [np.asarray(piece, dtype=float) for piece in values if piece is not None]
    return np.concatenate([part for piece in pieces for part in (piece, gap)][:-1])


class _Panels:
    """A plot of runs while it is drawn: for each output a panel of curves, and the residuals below.

    `measured` (N, ny) are the measured outputs, experiments one after another; None where there are
    none.
    """

    def __init__(self, response: Response, most: int) -> None:
        self.outputs, self.step, self.most = response.outputs, response.sampling_time, most
        several = len(response.trajectories) > 1
        self.start = 0.0 if several else response.trajectories[0].start_time
        measured = [t.measured for t in response.trajectories]
        self.measured = (
            None if any(m is None for m in measured) else join_experiments(response, measured)
        )
        begins = np.cumsum([0, *(len(t.model) + 1 for t in response.trajectories)])
        self._ranges = [slice(a, b - 1) for a, b in itertools.pairwise(begins)]
        self.gaps = any(m is not None and bool(np.isnan(m).any()) for m in measured)
        self.rows = sum(len(t.model) + 1 for t in response.trajectories) - 1
        self.traces: list[dict[str, Any]] = []
        self.layout: dict[str, Any] = {"shapes": [], "annotations": []}
        self.series: dict[str, Any] = {}
        self._left: list[PanelExit] = []
        self._shown: tuple[float, float] | None = None
        self._lost = next(
            (
                int(begin) + t.diverged[0]
                for begin, t in zip(begins, response.trajectories, strict=False)
                if t.diverged
            ),
            None,
        )

    def keep(self, name: str, i: int, values: Matrix) -> str:
        """Return the name by which traces find the curve of output i.

        What was measured goes across rows without a sample.
        """
        values = self._across(values) if name == "measured" else values
        self.series[f"{name} {i}"] = pack_curve(values[:, i], self.start, self.step, self.most)
        return f"{name} {i}"

    def add_residual(self, name: str, i: int, model: Matrix, drawn: Mapping[str, Any]) -> None:
        """Draw measured less a curve that is kept, as their difference or as a curve of its own."""
        assert self.measured is not None
        own: dict[str, Any] = {"minus": [f"measured {i}", f"{name} {i}"]}
        if len(model) > self.most or self.gaps:
            key, residual = f"measured {i} − {name} {i}", self._across(self.measured - model)
            self.series[key] = pack_curve(residual[:, i], self.start, self.step, self.most)
            own = {"series": key}
        self.traces.append({**own, **drawn, "yaxis": f"y{2 * i + 2}", "showlegend": False})

    def _across(self, values: Matrix) -> Matrix:
        """Return values (N, ny) with straight lines across rows without a sample."""
        if not self.gaps:
            return values
        filled = values.copy()
        for rows in self._ranges:
            filled[rows] = without_gaps(values[rows])
        return filled

    def finish(self, i: int, drawn: Mapping[str, Matrix]) -> None:
        """Draw the axes of output i, and mark where the curves in `drawn` leave them."""
        curves = {name: curve[:, i] for name, curve in drawn.items()}
        limits = None if self.measured is None else frame_of(self.measured[:, i], curves.values())
        if limits is not None:
            self._left += curves_left(curves, limits, i, self.start, self.step)
        self.layout |= _axes(i, 2 * len(self.outputs), self.outputs[i], limits)

    def plot(self, label: str, caption: str, time: str) -> Plot:
        """Return the whole plot; `time` is the title of the axis that the panels share."""
        for one in self._left:
            channel = self.outputs[one.output]
            reached = f"{number(one.farthest, 3)} {channel.unit}".strip()
            caption += (
                f" At {number(one.time, 4)} s {channel.name} of {one.name} leaves the panel, "
                "at the triangle;"
            )
            caption += f" it goes to {reached}."
        if self.gaps:
            caption += " Lines join measured values across rows without one."
        whole = (self.start, self.start + self.step * (self.rows - 1))
        shown = self._shown
        if shown is not None:
            why = "the run diverges" if self._lost is not None else "the error is largest"
            caption += (
                f" It opens on {number(shown[0], 4)} to {number(shown[1], 4)} s, where {why}."
            )
        self.layout["xaxis"] = {
            "title": {"text": time},
            "range": [*(shown or whole)],
            "anchor": f"y{2 * len(self.outputs)}",
        }
        traces = [*self.traces, *(one.marker() for one in self._left)]
        height = 60 + _PANEL * len(self.outputs)
        return Plot(
            label,
            caption,
            traces,
            self.layout,
            height,
            series=self.series,
            whole=whole if shown is not None else None,
        )

    def open_on_worst(self, model: Matrix) -> None:
        """Open on the window in which the model errs most or diverges, where the record is long."""
        if self.measured is None or self.rows <= 2 * _WINDOW:
            return
        first = worst_window(self.measured, model, _WINDOW)
        if self._lost is not None:
            first = min(max(self._lost - 3 * _WINDOW // 4, 0), self.rows - _WINDOW)
        begin = self.start + self.step * first
        self._shown = (begin, begin + self.step * (_WINDOW - 1))


@dataclass(frozen=True)
class PanelExit:
    """A curve that leaves its panel: output, instant [s], edge, and the value farthest out."""

    name: str
    output: int
    time: float
    edge: float
    above: bool
    farthest: float

    def marker(self) -> dict[str, Any]:
        """Return a triangle at the edge."""
        return {
            "x": [self.time],
            "y": [self.edge],
            "yaxis": f"y{2 * self.output + 1}",
            "type": "scatter",
            "mode": "markers",
            "name": f"{self.name} leaves the panel",
            "cliponaxis": False,
            "showlegend": False,
            "marker": {
                "color": "@bad",
                "size": 12,
                "symbol": "triangle-up" if self.above else "triangle-down",
            },
        }


def worst_window(measured: Matrix, model: Matrix, width: int) -> int:
    """Return the first row of the window of `width` rows with the largest error.

    The errors (N, ny) are squared, over the deviation of each output, and added up; rows without
    one count nothing.
    """
    with np.errstate(all="ignore"):
        deviation = np.nanstd(measured, axis=0)
        error = (measured - model) / np.where(deviation > 0, deviation, 1.0)
        squares = np.nan_to_num(error**2, nan=0.0, posinf=0.0).sum(axis=1)
    sums = np.cumsum(np.concatenate([[0.0], np.minimum(squares, _MOST_ERROR)]))
    return int(np.argmax(sums[width:] - sums[:-width]))


def frame_of(measured: Vector, curves: Iterable[Vector]) -> list[float] | None:
    """Return the limits of the upper panel where a curve leaves the measured range by far.

    None for the whole range.
    """
    low, high = float(np.nanmin(measured)), float(np.nanmax(measured))
    width = max(high - low, 1e-300)
    for curve in curves:
        inside = curve[np.isfinite(curve)]
        if len(inside) and (
            inside.min() < low - _FAR * width or inside.max() > high + _FAR * width
        ):
            return [low - width, high + width]
    return None


def curves_left(
    curves: Mapping[str, Vector], limits: Sequence[float], output: int, start: float, step: float
) -> list[PanelExit]:
    """Return the curves that are cut off at the edge of a panel, in the order of the drawing."""
    found: list[PanelExit] = []
    for name, curve in curves.items():
        with np.errstate(invalid="ignore"):
            outside = np.flatnonzero((curve < limits[0]) | (curve > limits[1]))
        if len(outside):
            row, above = int(outside[0]), bool(curve[outside[0]] > limits[1])
            farthest = curve[outside][np.argmax(np.abs(curve[outside] - np.mean(limits)))]
            found.append(
                PanelExit(name, output, start + step * row, limits[above], above, float(farthest))
            )
    return found


def _plot(run: Run, band: Mapping[str, tuple[float, float]], most: int) -> Plot:
    response, panels = run.response, _Panels(run.response, most)
    model = join_experiments(response, [t.model for t in response.trajectories])
    alone = (
        None
        if run.alone is None
        else join_experiments(response, [t.model for t in run.alone.trajectories])
    )
    curves = {"measured": panels.measured, "physics": alone, "model": model}
    drawn = {"the model": model} | ({} if alone is None else {f"the {WITHOUT}": alone})
    for i, channel in enumerate(response.outputs):
        for name, curve in curves.items():
            if curve is not None:
                panels.keep(name, i, curve)
        limits = band.get(channel.name)
        panels.traces += _upper(
            [name for name, curve in curves.items() if curve is not None], i, limits
        )
        if panels.measured is not None:
            sentences = {"name": "measured − model", "line": {"color": "@residual", "width": 1}}
            panels.add_residual("model", i, model, sentences)
            if limits is not None:
                low, high = limits
                place = {"xref": "paper", "x0": 0, "x1": 1, "yref": f"y{2 * i + 2}"}
                panels.layout["shapes"].append(area("@band", **place, y0=low, y1=high))
        panels.finish(i, drawn)
    panels.open_on_worst(model)
    _mark(panels.layout, run, panels.start, panels.step)
    panels.layout["shapes"] += _shades(response, panels.start, panels.step)
    time = (
        "time [s]" if len(response.trajectories) == 1 else "time, experiments one after another [s]"
    )
    return panels.plot(_label(run), _caption(run, most), time)


def _upper(curves: Sequence[str], i: int, limits: tuple[float, float] | None) -> list[dict]:
    """Return the traces of output i: measured, band, the model without its learner and with it.

    The legend has the first.
    """
    found = []
    if "measured" in curves:
        line = {"color": "@measured", "width": 3}
        found.append(
            {"series": f"measured {i}", "name": "measured", "line": line, "envelope": "area"}
        )
    if limits is not None:
        edge: dict[str, Any] = {
            "series": f"model {i}",
            "line": {"width": 0, "color": "@band"},
            "hoverinfo": "skip",
        }
        fill = {"fill": "tonexty", "fillcolor": "@band"}
        found.append(
            {**edge, "edge": "min", "plus": limits[0], "name": "lower limit", "showlegend": False}
        )
        found.append({**edge, **fill, "edge": "max", "plus": limits[1], "name": "95 % band"})
    if "physics" in curves:
        line = {"color": "@physics", "width": 1.3, "dash": "dash"}
        found.append({"series": f"physics {i}", "name": WITHOUT, "line": line})
    found.append(
        {
            "series": f"model {i}",
            "name": "model",
            "line": {"color": "@model", "width": 1.3},
            "envelope": "outline",
        }
    )
    own = {"yaxis": f"y{2 * i + 1}", "showlegend": i == 0}
    return [{**own, "legendgroup": trace["name"], **trace} for trace in found]


def _axes(i: int, panels: int, channel: Channel, limits: list[float] | None) -> dict[str, Any]:
    """Return the axes of the two panels of an output, from the top down, on a shared x axis."""
    high = 2 / panels
    top = 1 - i * high
    middle = top - (high - _GAP) * _UPPER
    bottom = top - high + (_GAP if i + 1 < panels // 2 else 0)
    title = {"text": _two_line_title(channel.name, channel.unit)}
    upper = {"title": title, "domain": [middle, top]} | ({"range": limits} if limits else {})
    lower = {
        "title": {"text": _two_line_title("residual", channel.unit)},
        "domain": [max(bottom, 0), middle - _GAP / 2],
    }
    return {f"yaxis{2 * i + 1}" if i else "yaxis": upper, f"yaxis{2 * i + 2}": lower}


def _two_line_title(name: str, unit: str) -> str:
    """Return a title on two lines: the panels are too low on paper for name and unit on one."""
    return f"{name}<br>[{unit}]" if unit else name


def _mark(layout: dict[str, Any], run: Run, start: float, step: float) -> None:
    """Mark where an experiment begins, and where a run diverged."""
    row, breaks = 0, len(run.response.trajectories) <= _MOST_BREAKS
    for i, trajectory in enumerate(run.response.trajectories):
        if i and breaks:
            layout["shapes"].append(_line(start + step * (row - 0.5), "@grid", "dot"))
        alone = None if run.alone is None else run.alone.trajectories[i]
        for name, sentences in (("free run", trajectory), (f"the {WITHOUT}", alone)):
            if sentences is not None and sentences.diverged:
                at = start + step * (row + sentences.diverged[0])
                layout["shapes"].append(_line(at, "@bad", "solid"))
                layout["annotations"].append(
                    {
                        "x": at,
                        "y": 1,
                        "xref": "x",
                        "yref": "paper",
                        "yanchor": "top",
                        "showarrow": False,
                        "xanchor": "right"
                        if row + sentences.diverged[0] > _length(run) / 2
                        else "left",
                        "text": f"{name} diverges in {sentences.diverged[1]}",
                        "font": {"color": "@bad"},
                    }
                )
        row += len(trajectory.model) + 1


def _line(x: float, color: str, dash: str) -> dict[str, Any]:
    return {
        "type": "line",
        "xref": "x",
        "x0": x,
        "x1": x,
        "yref": "paper",
        "y0": 0,
        "y1": 1,
        "line": {"color": color, "width": 1.2, "dash": dash},
    }


def _label(run: Run) -> str:
    outputs = ", ".join(channel.name for channel in run.response.outputs)
    shown = f"measured, model and {WITHOUT}" if run.alone is not None else "measured and model"
    return f"Free run on {run.part}: {outputs} over time, {shown}, with the residual below."


def _caption(run: Run, most: int) -> str:
    """Return sentences on what is drawn."""
    response = run.response
    rows, count = sum(len(t.model) for t in response.trajectories), len(response.trajectories)
    files = f" of {count} experiments" if count > 1 else ""
    sentences = [
        f"The free run on {run.part}, all {rows} samples{files}, and the residual under it on "
        "the same time axis."
    ]
    if rows > most:
        sentences.append(
            f"Each curve is drawn by {number(most, 3)} points, the minimum and maximum of "
            "every stretch."
        )
    for t in response.trajectories:
        if t.diverged:
            sentences.append(
                f"The run diverges in {t.diverged[1]} at row {t.diverged[0]}, where it is cut off."
            )
    outside = [t.outside for t in response.trajectories if t.outside is not None]
    beyond = float(np.concatenate(outside).mean()) if outside else 0.0
    if beyond > 0:
        sentences.append(
            f"On {percent(beyond)} of the samples, shaded, the learner is outside its training "
            "data; `learner.beyond` sets its correction there."
        )
    return " ".join(sentences)


def _shades(response: Response, start: float, step: float) -> list[dict[str, Any]]:
    """Return areas over stretches where the learner extrapolates; close ones are merged."""
    rows, flags = 0, []
    for t in response.trajectories:
        flags.append(
            np.zeros(len(t.model)) if t.outside is None else np.asarray(t.outside, dtype=float)
        )
        flags.append(np.zeros(1))  # the gap between experiments
        rows += len(t.model) + 1
    edges = np.diff(np.concatenate([[0.0], *flags, [0.0]]))
    first, after = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    apart = np.flatnonzero(first[1:] - after[:-1] > rows // _MOST_SHADES)
    first, after = (
        first[np.concatenate([[0], apart + 1])[: len(first)]],
        after[np.append(apart, -1)[: len(after)]],
    )
    place = {
        "yref": "paper",
        "y0": 0,
        "y1": 1,
        "name": "outside of training",
        "legendgroup": "outside",
    }
    return [
        area(
            "@reach",
            **place,
            x0=start + step * (a - 0.5),
            x1=start + step * (b - 0.5),
            showlegend=not i,
        )
        for i, (a, b) in enumerate(zip(first.tolist(), after.tolist(), strict=True))
    ]
