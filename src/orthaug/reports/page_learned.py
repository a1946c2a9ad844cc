"""The learned part on a page: a curve over each input, and a surface over the two main ones."""

from __future__ import annotations

from typing import Any

import numpy as np

from orthaug._base.lines import with_unit
from orthaug.reports.learned_part import Curve, LearnedPart, curve_limits, spread_indices
from orthaug.reports.page_blocks import Grid, Plot, Text, area, axis_titles, percent, round_values

_MOST_CURVES = 12
_CLOUD = 600  # points of a cloud
_COLOURED = 0.98  # of the cells of a surface have a colour of their own
_LEVEL = 0.02  # share of the learned part below which an input is said to explain little


def learned_blocks(part: LearnedPart, measure: str) -> list[Text | Grid | Plot]:
    """Return the curves over the inputs, by the share that each explains, and the surface."""
    shares = part.shares()
    ranked = list(part.rank())
    blocks: list[Text | Grid | Plot] = [Text(_introduction(part, ranked, shares, measure))]
    plots = [
        _curve_plot(part, k, feature, shares[part.features.index(feature), k])
        for k in range(len(part.names))
        for feature in ranked[:_MOST_CURVES]
    ]
    blocks.append(Grid(plots))
    if len(ranked) > _MOST_CURVES:
        blocks.append(
            Text(
                f"The {_MOST_CURVES} inputs that explain most, of {len(ranked)}, are drawn.", "note"
            )
        )
    if len(ranked) > 1:
        blocks += [_surface_plot(part, k, *part.leading_pair()) for k in range(len(part.names))]
    return blocks


def _introduction(part: LearnedPart, ranked: list[str], shares: Any, measure: str) -> str:
    explained = shares.max(axis=1)
    text = f"The learner sees {', '.join(part.features)}, and adds to {', '.join(part.names)}"
    text += f" what the {measure} measure does not assign to the physics" if measure else ""
    if len(ranked) == 1:
        return f"{text}. The curve shows what it adds over that input."
    text += (
        ". The curves show what it adds over each input, the one that explains most first: the "
        "share of its variance"
    )
    text += " that its means over bins of the input have."
    idle = [name for name in ranked[1:] if explained[part.features.index(name)] < _LEVEL]
    if idle:
        itself, explains = ("itself", "explains") if len(idle) == 1 else ("themselves", "explain")
        text += (
            f" By {itself} {', '.join(idle)} {explains} less than {percent(_LEVEL)} of it; with "
            "other inputs it may be more."
        )
    return text


def _curve_plot(part: LearnedPart, k: int, feature: str, share: float) -> Plot:
    j = part.features.index(feature)
    name, axis = part.names[k], with_unit(feature, part.units[j])
    few = spread_indices(len(part.seen), _CLOUD)
    cloud = part.seen[few, j], part.values[few, k]
    traces: list[dict[str, Any]] = [
        {
            "x": round_values(cloud[0]),
            "y": round_values(cloud[1]),
            "mode": "markers",
            "name": "training data",
            "marker": {"color": "@measured", "size": 4},
        }
    ]
    layout: dict[str, Any] = {
        "xaxis": {"title": {"text": axis}},
        "yaxis": {"title": {"text": name}},
        "shapes": [],
    }
    curve = None if part.is_tied(feature) else part.curve(feature)
    text, one = f"Over {feature}", len(part.features) == 1
    if curve is not None:
        traces += _curve_traces(curve, k)
        layout["yaxis"]["range"] = list(curve_limits(curve, k, cloud[1]))
        reach = curve.along[curve.inside]
        told_as = {"name": "reach of the data", "showlegend": True}
        ends = {"xref": "x", "x0": float(reach[0]), "x1": float(reach[-1])}
        layout["shapes"].append(area("@reach", **ends, yref="paper", y0=0, y1=1, **told_as))
        text += (
            ", the one input of the learner" if one else ", all else at its median"
        ) + ": solid within the shaded"
        text += (
            " range of the data, dashed beyond; the dots are what it adds along the training data"
        )
        text += ", and the band is its 95 % interval." if curve.half is not None else "."
    else:
        centres, means = part.means(feature)
        traces.append(
            {
                "x": round_values(centres),
                "y": round_values(means[:, k]),
                "mode": "lines+markers",
                "name": "mean",
                "line": {"color": "@learner", "width": 2},
                "marker": {"color": "@learner", "size": 5},
            }
        )
        text += ": the mean along the training data, on which other inputs move with it."
    text += "" if one else f" Its means over {feature} have {percent(share)} of its variance."
    return Plot(
        f"Learned part of {name} over {feature}.", text, traces, layout, height=300, small=True
    )


def _curve_traces(curve: Curve, k: int) -> list[dict[str, Any]]:
    along, learned = curve.along, curve.learned[:, k]
    found: list[dict[str, Any]] = []
    if curve.half is not None:
        edge: dict[str, Any] = {
            "x": round_values(along),
            "mode": "lines",
            "line": {"width": 0, "color": "@band"},
            "hoverinfo": "skip",
        }
        found.append(
            {
                **edge,
                "y": round_values(learned - curve.half[:, k]),
                "showlegend": False,
                "name": "lower limit",
            }
        )
        found.append(
            {
                **edge,
                "y": round_values(learned + curve.half[:, k]),
                "fill": "tonexty",
                "name": "95 % interval",
                "fillcolor": "@learned-band",
            }
        )
    line = {"color": "@learner", "width": 2}
    found.append(
        {
            "x": round_values(along),
            "y": round_values(learned),
            "mode": "lines",
            "showlegend": False,
            "name": "beyond the data",
            "line": {**line, "dash": "dash", "width": 1.2},
        }
    )
    inside = curve.inside
    found.append(
        {
            "x": round_values(along[inside]),
            "y": round_values(learned[inside]),
            "mode": "lines",
            "name": "learner",
            "line": line,
        }
    )
    return found


def _surface_plot(part: LearnedPart, k: int, across: str, along: str) -> Plot:
    surface = part.surface(across, along)
    values = surface.learned[..., k].T
    seen = np.abs(values[np.isfinite(values)])
    reach = float(np.quantile(seen, _COLOURED)) or 1.0 if seen.size else 1.0
    units = dict(zip(part.features, part.units, strict=True))
    heat = {
        "type": "heatmap",
        "x": round_values(surface.across),
        "y": round_values(surface.along),
        "hoverongaps": False,
        "z": round_values(values, 5),
        "zmin": -reach,
        "zmax": reach,
        "colorscale": "@diverging",
        "colorbar": {"title": {"text": part.names[k], "side": "top"}, "thickness": 14},
    }
    few = spread_indices(len(part.seen), _CLOUD)
    points = {
        "x": round_values(part.seen[few, part.features.index(across)]),
        "mode": "markers",
        "name": "training data",
        "y": round_values(part.seen[few, part.features.index(along)]),
        "hoverinfo": "skip",
        "marker": {"color": "@ink", "size": 2, "opacity": 0.45},
    }
    how = (
        "all else at its median"
        if part.is_separable(across, along)
        else "the mean of the training data in each cell"
    )
    caption = (
        f"What the learner adds to {part.names[k]} over {across} and {along}, the inputs with "
        f"the largest shares, {how}. It is drawn where training data are near; the dots are these "
        "data."
    )
    layout = axis_titles(with_unit(across, units[across]), with_unit(along, units[along]))
    return Plot(
        f"Learned part of {part.names[k]} over {across} and {along}.",
        caption,
        [heat, points],
        layout,
        420,
    )
