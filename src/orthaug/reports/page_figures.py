"""Plotly figures of a page from the numbers of a result, written as the JSON that Plotly reads."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from orthaug._base.lines import BIASED_INTERVAL, with_unit
from orthaug.analysis.findings import SuspectResult
from orthaug.analysis.fit_findings import ParameterResult, PartScores, RestartResult
from orthaug.analysis.residual_tests import RegressorResult, ResidualTestResult
from orthaug.reports.biases import bias_map
from orthaug.reports.page_blocks import (
    CATEGORIES,
    Plot,
    area,
    axis_titles,
    chance,
    number,
    parameter_label,
    percent,
    regressor_label,
    round_values,
)
from orthaug.reports.result import RowResult

_ROW = 62  # pixels of a parameter
# Height of its name on an axis from -1 to 1: between the numbers of its axis and the last
_NAMED = 0.8
_FAR = 6.0  # widths of an interval from which the initial value is not drawn
_DECADES = 20.0  # ratio of scores from which their axis is logarithmic
_BAD = 1.0  # NRMSE of the mean, from which it is too
_KINDS = {"prediction": ("one step", "@physics"), "simulation": ("free run", "@model")}


def interval_plot(rows: Sequence[ParameterResult]) -> Plot | None:
    """Return a plot of every parameter on an axis of its own unit, with its intervals.

    It shows the initial value too, where that is near.
    """
    drawn = [row for row in rows if row.value is not None and row.ci95 and None not in row.ci95]
    if not drawn:
        return None
    traces: list[dict[str, Any]] = []
    layout: dict[str, Any] = {"shapes": []}
    biased = any(row.ci95_with_bias for row in drawn)
    for i, row in enumerate(drawn):
        number = str(i + 1) if i else ""
        first = {
            "95 % interval": i == 0,
            "estimate": i == 0,
            "initial value": i == _first_row(drawn, _is_near),
        }
        first[BIASED_INTERVAL] = i == _first_row(drawn, lambda r: bool(r.ci95_with_bias))
        for trace in _interval_traces(row):
            own = {"xaxis": f"x{number}", "yaxis": f"y{number}", "legendgroup": trace["name"]}
            traces.append({**own, **trace, "showlegend": first[trace["name"]]})
        top = 1 - i / len(drawn)
        layout[f"yaxis{number}"] = {
            "domain": [top - 0.42 / len(drawn), top - 0.08 / len(drawn)],
            "anchor": f"x{number}",
            "range": [-1, 1],
            "tickvals": [_NAMED],
            "ticktext": [_tick(row)],
            "fixedrange": True,
            "showgrid": False,
            "zeroline": False,
        }
        layout[f"xaxis{number}"] = {
            "anchor": f"y{number}",
            "nticks": 6,
            "zeroline": False,
            "range": _reach(row),
        }
    caption = (
        "Every parameter has its own axis: the circle is the estimate, the thick bar its 95 % "
        "interval"
        + (
            f"; the thin bar is its {BIASED_INTERVAL}, which need not hold the estimate."
            if biased
            else "."
        )
        + " A diamond is the initial value, where it is near enough to be shown."
    )
    label = (
        "Intervals of "
        + ", ".join(row.name for row in drawn)
        + "; the table above has their numbers."
    )
    return Plot(label, caption, traces, layout, height=70 + _ROW * len(drawn))


def _interval_traces(row: ParameterResult) -> list[dict[str, Any]]:
    """Return the traces of a parameter: bars of its intervals, a circle, a diamond.

    The circle is the estimate, the diamond the initial value where it is near.
    """
    bars = {"95 % interval": (row.ci95, "@model", 7)}
    if row.ci95_with_bias and None not in row.ci95_with_bias:
        bars = {BIASED_INTERVAL: (row.ci95_with_bias, "@bias", 3), **bars}
    found: list[dict[str, Any]] = [
        {
            "name": name,
            "x": ends,
            "y": [0, 0],
            "mode": "lines",
            "line": {"color": color, "width": width},
        }
        for name, (ends, color, width) in bars.items()
    ]
    circle = {"color": "@paper", "size": 9, "line": {"color": "@ink", "width": 2}}
    found.append(
        {"name": "estimate", "x": [row.value], "y": [0], "mode": "markers", "marker": circle}
    )
    if _is_near(row):
        diamond = {"color": "@measured", "size": 9, "symbol": "diamond"}
        found.append(
            {
                "name": "initial value",
                "x": [row.initial],
                "y": [0],
                "mode": "markers",
                "marker": diamond,
            }
        )
    return found


def _first_row(rows: Sequence[ParameterResult], holds: Callable[[ParameterResult], bool]) -> int:
    """Return the number of the first row for which a condition holds."""
    return next((i for i, row in enumerate(rows) if holds(row)), 0)


def _tick(row: ParameterResult) -> str:
    """Return the name of a parameter, and half its interval in per cent of it."""
    low, high = row.ci95 or (None, None)
    half = (
        None
        if low is None or high is None or not row.value
        else abs((high - low) / (2 * row.value))
    )
    return f"<b>{parameter_label(row)}</b>" + ("" if half is None else f"<br>± {percent(half)}")


def _reach(row: ParameterResult) -> list[float]:
    """Return the limits of a parameter's axis: its intervals with a margin.

    They include the initial value where it is near.
    """
    ends = [
        row.value,
        *(row.ci95 or ()),
        *(row.ci95_with_bias or ()),
        row.initial if _is_near(row) else None,
    ]
    known = [end for end in ends if end is not None]
    margin = 0.35 * max(max(known) - min(known), 1e-300)
    return [min(known) - margin, max(known) + margin]


def _is_near(row: ParameterResult) -> bool:
    low, high = row.ci95 or (None, None)
    if row.initial is None or low is None or high is None or row.value is None:
        return False
    return abs(row.initial - row.value) <= _FAR * max(high - low, 1e-300)


def score_plot(
    scores: Mapping[str, Mapping[str, PartScores]], outputs: Sequence[str]
) -> Plot | None:
    """Return a plot of the NRMSE of every part, or of every model.

    Logarithmic where some are bad or far apart.

    Args:
        scores: by the name of a row, by the name of a part.
    """
    traces, values, lost = [], [], []
    for kind, (name, color) in _KINDS.items():
        x, y = [], []
        for row, parts in scores.items():
            for part, score in parts.items():
                place = f"{row}, {part}" if row else part
                numbers = score.kinds[kind].nrmse
                for j, value in enumerate(numbers or [None]):
                    where = f"{place}, {outputs[j]}" if numbers and len(numbers) > 1 else place
                    if value is None:
                        lost.append(f"{where} ({name})")
                        continue
                    x.append(max(value, 1e-16))
                    y.append(where)
        values += x
        symbol = "circle" if kind == "simulation" else "diamond"
        traces.append(
            {
                "x": x,
                "y": y,
                "mode": "markers",
                "name": name,
                "marker": {"color": color, "size": 11, "symbol": symbol},
            }
        )
    if not values:
        return None
    logarithmic = max(values) > _BAD or max(values) > _DECADES * min(values)
    caption = (
        "NRMSE of every part, the error over the output's deviation: 0 is perfect, 1 as bad as "
        "the mean"
    )
    caption += "; the axis is logarithmic." if logarithmic else "."
    if lost:
        caption += (
            f" There is no value of {', '.join(dict.fromkeys(lost))}: the run diverged, or the "
            "output does not move."
        )
    count = len({place for trace in traces for place in trace["y"]})
    axis: dict[str, Any] = (
        {"title": {"text": "NRMSE"}, "type": "log"}
        if logarithmic
        else {"title": {"text": "NRMSE"}, "range": [0, 1.1 * max(values)]}
    )
    if logarithmic:
        axis |= {
            "range": [math.log10(min(values)) - 0.2, math.log10(max(*values, 1.0)) + 0.2],
            "dtick": 1,
            "exponentformat": "power",
        }
    shapes = (
        [
            {
                "type": "line",
                "x0": 1,
                "x1": 1,
                "yref": "paper",
                "y0": 0,
                "y1": 1,
                "line": {"color": "@bad", "width": 1, "dash": "dot"},
            }
        ]
        if logarithmic
        else []
    )
    layout = {
        "xaxis": axis,
        "yaxis": CATEGORIES,
        "shapes": shapes,
    }
    return Plot(
        "NRMSE of every part; the table has the numbers.",
        caption,
        traces,
        layout,
        height=110 + 30 * count,
    )


def residual_plots(test: ResidualTestResult, what: str, units: Mapping[str, str]) -> list[Plot]:
    """Return plots of autocorrelation, correlation with the inputs, and means over a regressor.

    The regressor is the one that explains most of the residual.

    Units by channel.
    """
    plots = []
    if test.acf is not None and test.acf_band is not None:
        lags = list(range(1, len(test.acf)))
        bars = {
            "type": "bar",
            "x": lags,
            "y": test.acf[1:],
            "name": "autocorrelation",
            "marker": {"color": "@model"},
        }
        caption = (
            f"Autocorrelation of the {what} of {test.name}; the band holds 99 % of the values "
            f"that noise gives. The largest magnitude is {number(test.strongest_acf, 2)}."
        )
        layout = axis_titles("lag [samples]", "autocorrelation") | {
            "shapes": [_band(test.acf_band)],
            "showlegend": True,
        }
        plots.append(
            Plot(
                f"Autocorrelation of the {what} of {test.name}.",
                caption,
                [bars],
                layout,
                280,
                small=True,
            )
        )
    if test.crossed:
        traces = []
        for (name, cross), color in zip(
            test.crossed.items(), ("@model", "@physics", "@learner", "@bias") * 9, strict=False
        ):
            reach = len(cross.values) // 2
            traces.append(
                {
                    "x": list(range(-reach, reach + 1)),
                    "y": cross.values,
                    "mode": "lines+markers",
                    "name": name,
                    "line": {"color": color, "width": 1},
                    "marker": {"color": color, "size": 4},
                }
            )
        caption = (
            f"Correlation of the {what} of {test.name} with the inputs; beyond the band it is "
            "more than noise."
        )
        layout = axis_titles("lag behind the input [samples]", "correlation") | {
            "shapes": [_band(test.cross_band)]
        }
        layout["showlegend"] = True
        label = f"Correlation of the {what} of {test.name} with the inputs."
        plots.append(Plot(label, caption, traces, layout, 280, small=True))
    return plots + [
        _means_plot(test, name, curve, what, units) for name, curve in test.strongest.items()
    ]


def _means_plot(
    test: ResidualTestResult, name: str, curve: RegressorResult, what: str, units: Mapping[str, str]
) -> Plot:
    """Return a plot of the means over a regressor."""
    errors = [None if e is None else 2.576 * e for e in curve.errors]
    dots = {
        "x": curve.centres,
        "y": curve.means,
        "mode": "markers",
        "name": "mean",
        "error_y": {"array": errors, "color": "@learner", "thickness": 1},
        "marker": {"color": "@learner"},
    }
    surely = chance(curve.p)
    caption = (
        f"Mean of the {what} of {test.name}, less that of all rows, over {name}, with 99 % "
        "intervals. Both take its autocorrelation into account, as in the test: that it is flat "
        f"has p {'' if surely.startswith('<') else '= '}{surely}. Plain means explain "
        f"{percent(curve.share)} of its variance."
    )
    label = f"Mean of the {what} of {test.name} over {name}."
    layout = axis_titles(
        regressor_label(name, units), with_unit(f"residual of {test.name}", units.get(test.name))
    )
    return Plot(label, caption, [dots], layout, 280, small=True)


def bias_plot(suspects: Sequence[SuspectResult]) -> Plot:
    """Return a heat map of the bias of each parameter by each suspect, in per cent."""
    shown = bias_map(suspects)
    heat = {
        "type": "heatmap",
        "x": list(shown.parameters),
        "y": list(shown.suspects),
        "z": round_values(shown.colours, 5),
        "zmin": -shown.reach,
        "zmax": shown.reach,
        "text": shown.cells,
        "texttemplate": "%{text}",
        "textfont": {"size": 10},
        "showscale": False,
        "colorscale": "@diverging",
        "hovertemplate": "%{y} on %{x}: %{text} %<extra></extra>",
    }
    layout = {
        "yaxis": CATEGORIES,
        "xaxis": {"side": "top", "type": "category", "tickvals": list(shown.parameters)},
        "showlegend": False,
    }
    caption = (
        "Bias of each parameter (columns) by each term that may be missing from the physics "
        "(rows), in per cent of its value."
    )
    caption = " ".join([caption, *shown.sizes, "Colours are logarithmic.", shown.left_out]).strip()
    height = 90 + 28 * len(shown.suspects)
    return Plot("Bias of each parameter by each suspected term.", caption, [heat], layout, height)


def restart_plot(restarts: Sequence[RestartResult]) -> Plot | None:
    """Return a plot of the loss that every start reached."""
    if len([run for run in restarts if run.loss is not None]) < 3:
        return None
    place = [f"{run.seed}, {run.regularization}" for run in restarts]
    sizes = [13 if run.chosen else 8 for run in restarts]
    colors = ["@model" if run.chosen else "@measured" for run in restarts]
    dots = {
        "x": list(range(1, len(restarts) + 1)),
        "y": [run.loss for run in restarts],
        "mode": "markers",
        "text": place,
        "name": "loss",
        "marker": {"color": colors, "size": sizes},
    }
    losses = [run.loss for run in restarts if run.loss]
    wide = bool(losses) and max(losses) > _DECADES * min(losses) > 0
    seeds = [str(run.seed) for run in restarts]
    names = seeds if len(set(seeds)) == len(seeds) else place
    layout = axis_titles("seed" if names is seeds else "seed, regularization", "loss")
    shown = range(0, len(restarts), 1 + len(restarts) // 12)
    layout["xaxis"] |= {"tickvals": [i + 1 for i in shown], "ticktext": [names[i] for i in shown]}
    layout["yaxis"] = {"title": {"text": "loss"}, "type": "log" if wide else "linear"}
    caption = "The loss that every start reached; the large dot is the chosen one. "
    caption += "Where several starts reach the same loss, a poor local minimum is unlikely."
    return Plot("Loss that every start reached.", caption, [dots], layout, 260)


def parameter_comparison(rows: Sequence[RowResult]) -> list[Plot]:
    """Return plots of every parameter's value and 95 % interval in each model."""
    plots = []
    for parameter in rows[0].parameters:
        x, y, arms = [], [], []
        for row in rows:
            entry = next((p for p in row.parameters if p.name == parameter.name), None)
            if entry is not None and entry.value is not None:
                x.append(entry.value)
                y.append(row.name)
                ends = (
                    entry.ci95
                    if entry.ci95 and None not in entry.ci95
                    else (entry.value, entry.value)
                )
                arms.append(
                    (
                        max((ends[1] or 0.0) - entry.value, 0.0),
                        max(entry.value - (ends[0] or 0.0), 0.0),
                    )
                )
        dots = {
            "x": x,
            "y": y,
            "mode": "markers",
            "name": parameter.name,
            "marker": {"color": "@model", "size": 9},
            "error_x": {
                "type": "data",
                "symmetric": False,
                "array": [up for up, _ in arms],
                "arrayminus": [down for _, down in arms],
                "color": "@model",
                "thickness": 2,
            },
        }
        layout = {
            "xaxis": {"title": {"text": parameter_label(parameter)}, "nticks": 6},
            "yaxis": CATEGORIES,
            "showlegend": False,
        }
        caption = f"{parameter.name} in every model, with its 95 % interval where it has one."
        plots.append(Plot(caption, caption, [dots], layout, 120 + 30 * len(rows), small=True))
    return plots


def _band(half: float) -> dict[str, Any]:
    style = {"name": "99 % of what noise gives", "showlegend": True}
    return area("@reach", xref="paper", x0=0, x1=1, y0=-half, y1=half, **style)
