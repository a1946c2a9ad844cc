"""Free runs on a page: whole records with the residual below, packed as numbers of four bytes for the page to draw.

The page draws of every curve the least and the largest value in each column of pixels, anew whenever it is zoomed.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.data.record import Channel
from orthaug.models.response import Response, Trajectory
from orthaug.reports.clipping import Left, curves_left, frame_of, marker_of, told_left
from orthaug.reports.page_blocks import Plot, number, percent, with_unit

MOST_POINTS = 100_000  # of a curve
_BUDGET = 560_000  # points of a page: three million letters
_UPPER, _GAP = 0.64, 0.05  # share of a pair of panels that is the upper one, and what lies between panels
_PANEL = 330  # pixels of a pair of panels
_DASHES = ("dash", "solid", "dot", "dashdot")
_MOST_BREAKS = 40  # between experiments that are marked
WITHOUT = "model without its learner"  # its name where it is drawn: the physics that is fitted by itself is another


@dataclass(frozen=True)
class Run:
    """A free run on a part; `alone` that of the model without its learner, None where nothing was learned."""

    part: str
    response: Response
    alone: Response | None = None


def run_plots(runs: Sequence[Run], band: Mapping[str, tuple[float, float]]) -> list[Plot]:
    """A plot for every part: measured, model, the model without its learner, and the residual.

    Args:
        band: of each output the two limits between which 95 % of the errors on the training data lie.
    """
    lengths = [_length(run) for run in runs for _ in run.response.outputs for _ in range(2 + (run.alone is not None))]
    most = _fair(lengths, _BUDGET)
    return [_plot(run, band, most) for run in runs]


def compared_plots(responses: Mapping[str, Mapping[str, Response]]) -> list[Plot]:
    """A plot for every part: measured, and the free run of every model."""
    parts = list(dict.fromkeys(part for runs in responses.values() for part in runs))
    count = sum(len(t.model) + 1 for runs in responses.values() for r in runs.values() for t in r.trajectories)
    outputs = max((len(r.outputs) for runs in responses.values() for r in runs.values()), default=1)
    most = min(MOST_POINTS, max(_BUDGET // max(2 * len(parts) * (len(responses) + 1) * outputs, 1), 1000))
    most = MOST_POINTS if 2 * count * outputs < _BUDGET else most
    return [_compared(part, {k: runs[part] for k, runs in responses.items() if part in runs}, most) for part in parts]


def _compared(part: str, runs: Mapping[str, Response], most: int) -> Plot:
    first = next(iter(runs.values()))
    step, several = first.sampling_time, len(first.trajectories) > 1
    start = 0.0 if several else first.trajectories[0].start_time
    layout: dict[str, Any] = {"shapes": [], "annotations": []}
    traces: list[dict[str, Any]] = []
    panels, measured = 2 * len(first.outputs), [t.measured for t in first.trajectories]
    known = None if any(m is None for m in measured) else joined(first, measured)
    series: dict[str, Any] = {}
    models = {name: joined(run, [t.model for t in run.trajectories]) for name, run in runs.items()}
    left: list[Left] = []
    for i, channel in enumerate(first.outputs):
        own = {"yaxis": f"y{2 * i + 1}", "showlegend": i == 0}
        if known is not None:
            series[f"measured {i}"] = packed(known[:, i], start, step, most)
            traces.append(
                {**own, "series": f"measured {i}", "name": "measured", "line": {"color": "@measured", "width": 3}}
            )
        for name, color, dash in zip(
            models, ("@physics", "@model", "@learner", "@bias") * 9, _DASHES * 9, strict=False
        ):
            line = {"color": color, "width": 1.3, "dash": dash}
            given = {"name": name, "legendgroup": name, "line": line}
            key = f"{name} {i}"
            series[key] = packed(models[name][:, i], start, step, most)
            traces.append({**own, **given, "series": key})
            if known is not None:
                residual = _residual(series, f"measured {i}", key, known[:, i] - models[name][:, i], most)
                traces.append({**given, **residual, "yaxis": f"y{2 * i + 2}", "showlegend": False})
        limits = frame_of(known, list(models.values()), i)
        left += curves_left({name: model[:, i] for name, model in models.items()}, limits, channel, start, step)
        layout |= _axes(i, panels, channel, limits)
    rows = len(next(iter(models.values())))
    layout["xaxis"] = {
        "title": {"text": "time [s]"},
        "range": [start, start + step * (rows - 1)],
        "anchor": f"y{panels}",
    }
    lost = [name for name, run in runs.items() if any(t.diverged for t in run.trajectories)]
    caption = (
        f"The free runs of {', '.join(runs)} on {part}, all {rows - len(first.trajectories) + 1} samples, with what "
        "each leaves of the measured output under them."
    )
    caption += f" The run of {', '.join(lost)} diverges." if lost else ""
    caption += told_left(left)
    traces += [marker_of(one, first.outputs) for one in left]
    label = f"Free runs of every model on {part}, with their residuals below."
    return Plot(label, caption, traces, layout, 60 + _PANEL * len(first.outputs), series=series)


def error_band(response: Response) -> dict[str, tuple[float, float]]:
    """Of each output the limits between which 95 % of the errors of a run lie; none of one that diverged."""
    found = {}
    if any(t.measured is None or t.diverged for t in response.trajectories):
        return found
    for i, channel in enumerate(response.outputs):
        errors = np.concatenate([(t.measured - t.model)[t.start :, i] for t in response.trajectories])  # type: ignore
        errors = errors[np.isfinite(errors)]
        if len(errors) >= 40:
            found[channel.name] = tuple(float(limit) for limit in np.quantile(errors, [0.025, 0.975]))
    return found


def _length(run: Run) -> int:
    return sum(len(t.model) + 1 for t in run.response.trajectories)


def _fair(lengths: Sequence[int], budget: int) -> int:
    """How many points a curve may have, so that short ones stay whole and all fit into the budget."""
    left, ordered = budget, sorted(lengths)
    for i, length in enumerate(ordered):
        share = left // (len(ordered) - i)
        if length > share:
            return min(share, MOST_POINTS)
        left -= length
    return MOST_POINTS


def packed(values: Vector, x0: float, dx: float, most: int = MOST_POINTS) -> dict[str, Any]:
    """A curve at even steps as the page reads it; of a longer one the least and the largest value of each stretch."""
    step = dx
    if len(values) > most:
        stride = -(-len(values) // (most // 2))
        filled = np.full(-(-len(values) // stride) * stride, np.nan)
        filled[: len(values)] = values
        cells = filled.reshape(-1, stride)
        values = np.stack([np.fmin.reduce(cells, axis=1), np.fmax.reduce(cells, axis=1)], axis=1).ravel()
        dx = dx * stride / 2
    finite = values[np.isfinite(values)]
    shift = float(finite.mean()) if len(finite) else 0.0
    with np.errstate(over="ignore"):
        bare = (values - shift).astype("<f4")
    return {"x0": x0, "dx": dx, "step": step, "shift": shift, "f4": base64.b64encode(bare.tobytes()).decode()}


def joined(response: Response, values: Sequence[Matrix | None]) -> Matrix:
    """Experiments one after another, with a gap between."""
    gap = np.full((1, len(response.outputs)), np.nan)
    pieces = [np.asarray(piece, dtype=float) for piece in values if piece is not None]
    return np.concatenate([part for piece in pieces for part in (piece, gap)][:-1])


def _plot(run: Run, band: Mapping[str, tuple[float, float]], most: int) -> Plot:
    response, step = run.response, run.response.sampling_time
    several = len(response.trajectories) > 1
    start = 0.0 if several else response.trajectories[0].start_time
    model = joined(response, [t.model for t in response.trajectories])
    measured = [t.measured for t in response.trajectories]
    known = None if any(m is None for m in measured) else joined(response, measured)
    alone = None if run.alone is None else joined(response, [t.model for t in run.alone.trajectories])
    traces: list[dict[str, Any]] = []
    layout: dict[str, Any] = {"shapes": [], "annotations": []}
    panels = 2 * len(response.outputs)
    series: dict[str, Any] = {}
    left: list[Left] = []
    for i, channel in enumerate(response.outputs):
        curves = {"measured": known, "physics": alone, "model": model}
        series |= {f"{k} {i}": packed(v[:, i], start, step, most) for k, v in curves.items() if v is not None}
        limits = band.get(channel.name)
        traces += _upper([k for k, v in curves.items() if v is not None], i, limits)
        if known is not None:
            given = _residual(series, f"measured {i}", f"model {i}", known[:, i] - model[:, i], most)
            line = {"color": "@residual", "width": 1}
            traces.append(
                {**given, "name": "measured − model", "yaxis": f"y{2 * i + 2}", "line": line, "showlegend": False}
            )
            if limits is not None:
                layout["shapes"].append(_stripe(limits, 2 * i + 2))
        drawn = {"the model": model} | ({} if alone is None else {f"the {WITHOUT}": alone})
        frame = frame_of(known, list(drawn.values()), i)
        left += curves_left({name: curve[:, i] for name, curve in drawn.items()}, frame, channel, start, step)
        layout |= _axes(i, panels, channel, frame)
    end = start + step * (len(model) - 1)
    layout["xaxis"] = {
        "title": {"text": "time [s]" if not several else "time, experiments one after another [s]"},
        "range": [start, end],
        "anchor": f"y{panels}",
    }
    _mark(layout, run, start, step)
    return Plot(
        _label(run),
        _caption(run, most) + told_left(left),
        [*traces, *(marker_of(one, response.outputs) for one in left)],
        layout,
        60 + _PANEL * len(response.outputs),
        series=series,
    )


def _residual(series: dict[str, Any], measured: str, model: str, residual: Vector, most: int) -> dict[str, Any]:
    """A residual as the page reads it: the difference of two curves, or of thinned ones a curve of its own."""
    if len(residual) <= most:
        return {"minus": [measured, model]}
    series[f"{measured} − {model}"] = packed(residual, series[model]["x0"], series[model]["step"], most)
    return {"series": f"{measured} − {model}"}


def _upper(curves: Sequence[str], i: int, limits: tuple[float, float] | None) -> list[dict]:
    """Measured, band, the model without its learner and with it, of output i; the legend tells of the first."""
    found = []
    if "measured" in curves:
        line = {"color": "@measured", "width": 3}
        found.append({"series": f"measured {i}", "name": "measured", "line": line})
    if limits is not None:
        edge: dict[str, Any] = {"series": f"model {i}", "line": {"width": 0, "color": "@band"}, "hoverinfo": "skip"}
        fill = {"fill": "tonexty", "fillcolor": "@band"}
        found.append({**edge, "edge": "min", "plus": limits[0], "name": "lower limit", "showlegend": False})
        found.append({**edge, **fill, "edge": "max", "plus": limits[1], "name": "95 % band"})
    if "physics" in curves:
        line = {"color": "@physics", "width": 1.3, "dash": "dash"}
        found.append({"series": f"physics {i}", "name": WITHOUT, "line": line})
    found.append({"series": f"model {i}", "name": "model", "line": {"color": "@model", "width": 1.3}})
    own = {"yaxis": f"y{2 * i + 1}", "showlegend": i == 0}
    return [{**own, "legendgroup": trace["name"], **trace} for trace in found]


def _axes(i: int, panels: int, channel: Channel, limits: list[float] | None) -> dict[str, Any]:
    """The two panels of an output from the top down, on the x axis that all share."""
    high = 2 / panels
    top = 1 - i * high
    middle = top - (high - _GAP) * _UPPER
    bottom = top - high + (_GAP if i + 1 < panels // 2 else 0)
    title = with_unit(channel.name, channel.unit)
    upper = {"title": {"text": title}, "domain": [middle, top]} | ({"range": limits} if limits else {})
    lower = {
        "title": {"text": with_unit("residual", channel.unit)},
        "domain": [max(bottom, 0), middle - _GAP / 2],
    }
    return {f"yaxis{2 * i + 1}" if i else "yaxis": upper, f"yaxis{2 * i + 2}": lower}


def _stripe(limits: tuple[float, float], axis: int) -> dict[str, Any]:
    return {
        "type": "rect",
        "xref": "paper",
        "x0": 0,
        "x1": 1,
        "yref": f"y{axis}",
        "y0": limits[0],
        "y1": limits[1],
        "fillcolor": "@band",
        "line": {"width": 0},
        "layer": "below",
    }


def _mark(layout: dict[str, Any], run: Run, start: float, step: float) -> None:
    """Lines where an experiment begins, and where a run left all bounds."""
    row, breaks = 0, len(run.response.trajectories) <= _MOST_BREAKS
    for i, trajectory in enumerate(run.response.trajectories):
        if i and breaks:
            layout["shapes"].append(_line(start + step * (row - 0.5), "@grid", "dot"))
        for name, told in (("free run", trajectory), (f"the {WITHOUT}", _of(run.alone, i))):
            if told is not None and told.diverged:
                at = start + step * (row + told.diverged[0])
                layout["shapes"].append(_line(at, "@bad", "solid"))
                layout["annotations"].append(
                    {
                        "x": at,
                        "y": 1,
                        "xref": "x",
                        "yref": "paper",
                        "yanchor": "top",
                        "showarrow": False,
                        "xanchor": "right" if row + told.diverged[0] > _length(run) / 2 else "left",
                        "text": f"{name} diverges in {told.diverged[1]}",
                        "font": {"color": "@bad"},
                    }
                )
        row += len(trajectory.model) + 1


def _of(response: Response | None, i: int) -> Trajectory | None:
    return None if response is None else response.trajectories[i]


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
    """What is drawn, in sentences."""
    response = run.response
    rows, count = sum(len(t.model) for t in response.trajectories), len(response.trajectories)
    files = f" of {count} experiments" if count > 1 else ""
    told = [f"The free run on {run.part}, all {rows} samples{files}, and the residual under it on the same time axis."]
    if rows > most:
        told.append(
            f"Of each curve {number(most, 3)} points are kept, the least and the largest value of every stretch."
        )
    for t in response.trajectories:
        if t.diverged:
            told.append(f"The run leaves all bounds in {t.diverged[1]} at row {t.diverged[0]}, where it is cut off.")
    outside = [t.outside for t in response.trajectories if t.outside is not None]
    beyond = float(np.concatenate(outside).mean()) if outside else 0.0
    if beyond > 0:
        told.append(f"On {percent(beyond)} of the samples the learner is outside what it was trained on.")
    return " ".join(told)
