"""Building blocks of the page: headings, fields, tables, curves.

Plain HTML where that is enough.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import contextmanager
from html import escape
from typing import Any, TypeVar

from nicegui import ui

from orthaug._base.lines import BIASED_INTERVAL
from orthaug.commands.app.processes import Run
from orthaug.commands.job import PHYSICS_ONLY

Drawn = TypeVar("Drawn", bound=ui.element)
_SHORT = 12  # letters that fit on one line
_WIDE = 5  # columns of a table that may be wider than its place


def label_widget(element: Drawn, label: str) -> Drawn:
    """Return a widget with its accessible name, which is plain text and never markup."""
    element.props["aria-label"] = label
    return element


def text(what: object, tag: str = "p", classes: str = "") -> ui.html:
    """Return an element with text that is never read as HTML."""
    return ui.html(marked(what), sanitize=False, tag=tag).classes(classes)


def marked(what: object) -> str:
    """Return escaped text: `names` as code, and no line breaks at the minus of a lag."""
    lines = re.sub(r"`([^`\n]+)`", r"<code>\1</code>", escape(str(what)))
    return re.sub(r"\[k-\d+\]", r"<span class='n'>\g<0></span>", lines)


def sentence(message: str) -> str:
    """Return a message with a capital first letter, unless it begins with the name of a file."""
    return message if "." in message.partition(" ")[0] else message[:1].upper() + message[1:]


def card(title: str, hint: str = "", classes: str = "") -> ui.element:
    """Return a section with a heading."""
    section = ui.element("section").classes(f"card {classes}")
    with section:
        text(title, "h2")
        if hint:
            text(hint, "p", "hint")
    return section


@contextmanager
def redrawn(place: ui.element) -> Any:
    """Draw the content of an element anew."""
    place.clear()
    with place:
        yield


def field(
    label: str, value: object, changed: Callable[[str], None], *, classes: str = "", hint: str = ""
) -> ui.input:
    """Return a line of text; `on_change` is called when it is left, or by Enter."""
    made = (
        ui.input(label, value="" if value is None else str(value))
        .props("outlined dense stack-label")
        .classes(classes)
    )
    if hint:
        made.props["placeholder"] = hint
    made.on("change", lambda: changed(made.value or ""))
    return made


def refuse(made: ui.input, why: str) -> None:
    """Show an error under a field."""
    made.props["error"], made.props["error-message"] = bool(why), why.replace("`", "")
    made.update()


def choice(
    label: str,
    options: Mapping[str, str],
    value: str,
    changed: Callable[[str], None],
    classes: str = "",
) -> ui.element:
    """Return a native list to choose from, with its label above."""
    with ui.element("label").classes(f"choice {classes}"):
        text(label, "span")
        made = label_widget(ui.element("select"), label)
        with made:
            for key, shown in options.items():
                option = ui.html(escape(shown), sanitize=False, tag="option")
                option.props["value"] = key
                if key == value:
                    option.props("selected")

        def emit_change(event: Any) -> None:
            changed(str(event.args))

        made.on("change", emit_change, js_handler="(event) => emit(event.target.value)")
    return made


def table(head: Sequence[str], rows: Sequence[Sequence[Any]], caption: str = "") -> None:
    """Draw a table; on a phone each row of more than two cells is a labelled block."""
    kinds = [
        "w" if any(str(row[i])[:1].isalpha() for row in rows) else "" for i in range(len(head))
    ]  # words, numbers
    lines = ["<table>", f"<caption>{escape(caption)}</caption>" if caption else "", "<thead><tr>"]
    lines += [
        f"<th scope='col' class='{kind}'>{escape(name)}</th>"
        for name, kind in zip(head, kinds, strict=True)
    ]
    lines.append("</tr></thead><tbody>")
    for row in rows:
        lines.append(f"<tr><th scope='row'>{marked(row[0])}</th>")
        for name, value, kind in zip(head[1:], map(str, row[1:]), kinds[1:], strict=True):
            kind += " n" if len(value) <= _SHORT else ""
            lines.append(
                f"<td class='{kind}' data-label='{escape(name, True)}'>{marked(value)}</td>"
            )
        lines.append("</tr>")
    made = ui.html("".join([*lines, "</tbody></table>"]), sanitize=False).classes("table")
    made.classes("cards" if len(head) > 2 else "")
    if len(head) >= _WIDE:  # it may scroll, by keys too
        label_widget(made.props("tabindex=0 role=region"), caption or head[0])


def number(value: object, digits: int = 5) -> str:
    """Return a number as text; a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}g}"


def button(
    label: str, clicked: Callable[[], object], *, main: bool = False, classes: str = ""
) -> ui.button:
    """Return a button; the main one of a card is filled."""
    made = ui.button(label, on_click=clicked, color=None).props(
        "no-caps unelevated" if main else "no-caps outline"
    )
    return made.classes(("main " if main else "plain ") + classes)


def link(label: str, place: str) -> ui.element:
    """Return a link to a file for download that looks like a button."""
    made = text(label, "a", "download").props("download")
    made.props["href"] = place
    return made


def note(what: str, kind: str = "") -> ui.html:
    """Return a highlighted note: `bad`, `care` or `good`."""
    return text(what, "p", f"note {kind}").props("role=alert" if kind == "bad" else "role=status")


_MOST_ENTRIES = 8  # of a legend
_ENTRY = 19  # px of one
_AXIS = 58  # px of an axis with its title
_COLORS = ("#3b82d0", "#d9730d", "#159a7c", "#9a5fd6", "#c2498a", "#8a7a12")


def curves_figure(
    rows: Sequence[tuple[str, Sequence[Mapping[str, Any]]]],
) -> dict[str, object]:
    """Return a figure of curves below one another on a common time axis.

    Each row has a label, and traces with `x`, `y`, `name` and `raw`; where they have an `entry`,
    each name has one in the legend, and the color of that number.
    """
    traces: list[dict[str, object]] = []
    named = set[str]()
    layout = _layout(70 + 130 * len(rows))
    layout["xaxis"] |= {
        "title": _compact_layout("time in s"),
        "anchor": f"y{len(rows)}" if len(rows) > 1 else "y",
    }
    gap = 0.12 / max(len(rows), 1)
    for i, (label, drawn) in enumerate(rows):
        axis, top = (f"y{i + 1}" if i else "y"), 1 - i / len(rows)
        layout[f"yaxis{i + 1 if i else ''}"] = {
            **{
                "domain": [max(0.0, top - 1 / len(rows) + gap), top - gap / 2],
                "zeroline": False,
                "automargin": True,
            },
            **{"title": _compact_layout(label), "nticks": 5, "anchor": "x", "exponentformat": "e"},
        }
        for curve in drawn:
            raw, entry = curve.get("raw", False), curve.get("entry")
            color = _COLORS[(i if entry is None else entry) % len(_COLORS)]
            line = {
                "width": 2.4 if raw and entry is not None else 1.2,
                "color": "#8b949e" if raw else color,
            }
            own = {
                "name": curve["name"],
                "x": curve["x"],
                "y": curve["y"],
                "line": line,
                "opacity": 0.6 if raw else 1,
            }
            traces.append(
                {
                    **own,
                    "type": "scatter",
                    "mode": "lines",
                    "xaxis": "x",
                    "yaxis": axis,
                    "legendgroup": curve["name"],
                    "showlegend": entry is not None and curve["name"] not in named,
                }
            )
            named.add(curve["name"])
    if any(trace["showlegend"] for trace in traces):
        layout["margin"]["t"] += _ENTRY + 8
        layout["legend"] = {
            "orientation": "h",
            "yref": "container",
            "y": 1,
            "yanchor": "top",
            "x": 0,
        }
    return {"data": traces, "layout": layout, "config": _CONFIG}


def interval_figure(
    models: Sequence[tuple[str, Sequence[Mapping[str, Any]]]], units: Mapping[str, str]
) -> dict[str, object]:
    """Return a figure of each parameter in every model, with its 95 % interval.

    A thin bar is the interval with the bias, which need not hold the estimate.
    """
    names = list(dict.fromkeys(row["name"] for _, rows in models for row in rows))
    one = 22 * len(models) + 8  # px of the dots of a parameter, with its axis below
    whole = (one + _AXIS) * len(names)
    layout, traces = _layout(whole + 16), list[dict[str, Any]]()
    layout |= {"hovermode": "closest", "showlegend": False}
    layout["margin"] |= {"t": 8, "b": 8}
    for i, name in enumerate(names):
        axis, top = (str(i + 1) if i else ""), 1 - i * (one + _AXIS) / whole
        title = f"{name} [{units[name]}]" if units.get(name, "1") != "1" else name
        layout[f"xaxis{axis}"] = {
            **{"zeroline": False, "nticks": 5, "anchor": f"y{axis}", "exponentformat": "e"},
            "title": _compact_layout(escape(title)) | {"standoff": 4},
        }
        layout[f"yaxis{axis}"] = {
            **{"type": "category", "automargin": True, "anchor": f"x{axis}"},
            **{"domain": [max(0.0, top - one / whole), top]},
            **{"range": [len(models) - 0.4, -0.6]},
            **{"categoryorder": "array", "categoryarray": [escape(own) for own, _ in models]},
        }
        for j, (model, rows) in enumerate(models):
            row = next((row for row in rows if row["name"] == name), None)
            if row is None or row["value"] is None:
                continue
            low, high = row["ci95"] or (None, None)
            bar = [0.0 if end is None else abs(end - row["value"]) for end in (high, low)]
            color = _COLORS[j % len(_COLORS)]
            if wide := row.get("ci95_with_bias"):
                traces.append(
                    {
                        **{"type": "scatter", "mode": "lines", "name": BIASED_INTERVAL},
                        **{"x": wide, "y": [escape(model)] * 2, "opacity": 0.6},
                        **{"xaxis": f"x{axis}", "yaxis": f"y{axis}"},
                        "line": {"width": 1, "color": color},
                    }
                )
            traces.append(
                {
                    **{"type": "scatter", "mode": "markers", "name": escape(model)},
                    **{"x": [row["value"]], "y": [escape(model)]},
                    **{"xaxis": f"x{axis}", "yaxis": f"y{axis}"},
                    "marker": {"size": 8, "color": color},
                    "error_x": {
                        **{"type": "data", "symmetric": False, "color": color, "thickness": 2},
                        **{"array": bar[:1], "arrayminus": bar[1:]},
                    },
                }
            )
    return {"data": traces, "layout": layout, "config": _CONFIG}


def run_name(run: Run, *, of_structure: bool = False, of_regularization: bool = True) -> str:
    """Return a description of a run; its number where nothing else is known."""
    words = [run.structure] if of_structure and run.structure else []
    words += [f"start {run.start}"] if run.start else []
    if of_regularization and run.regularization:
        words.append(run.regularization)
    return ", ".join(words) or run.structure or f"run {run.number}"


def of_several(runs: Iterable[Run]) -> bool:
    """Return whether the runs are of more than one structure."""
    return len({run.structure for run in runs if run.structure}) > 1


def loss_figure(losses: Sequence[tuple[Run, int, float | None]]) -> dict[str, object]:
    """Return a figure of the loss of every run over its iterations.

    Each run has a name below the axis; of several structures, each structure has one. A curve is
    broken where its run begins again.
    """
    runs: dict[Run, tuple[list[int | None], list[float | None]]] = {}
    for run, iteration, loss in losses:
        x, y = runs.setdefault(run, ([], []))
        if x and iteration <= (x[-1] or 0):  # it began again, such as on the free run
            x.append(None)
            y.append(None)
        x.append(iteration)
        y.append(loss)
    several = of_several(runs)
    differ = len({run.regularization for run in runs if run.structure != PHYSICS_ONLY}) > 1
    names = {run: run_name(run, of_structure=several, of_regularization=differ) for run in runs}
    groups = {run: (run.structure or "run made again") if several else names[run] for run in runs}
    entries = list(dict.fromkeys(groups[run] for run in sorted(runs)))
    shown = 1 < len(entries) <= _MOST_ENTRIES
    layout = _layout(260 + _ENTRY * len(entries) * shown)
    layout["xaxis"] |= {"title": _compact_layout("iteration")}
    layout |= {
        "hovermode": "closest",
        "legend": {"yref": "container", "y": 0, "yanchor": "bottom", "x": 0, "tracegroupgap": 0},
    }
    layout["margin"]["b"] += _ENTRY * len(entries) * shown
    layout["yaxis"] = {
        "type": "log",
        "title": _compact_layout("loss"),
        "automargin": True,
        "exponentformat": "e",
        "nticks": 5,
    }
    own = {"type": "scatter", "mode": "lines+markers", "marker": {"size": 4}}
    traces, named = [], set[str]()
    for run, (x, y) in sorted(runs.items()):
        group = groups[run]
        color = _COLORS[entries.index(group) % len(_COLORS)]
        hover = f"{escape(names[run])}<br>iteration %{{x}}, loss %{{y:.4g}}<extra></extra>"
        entry = {
            "name": escape(group),
            "legendgroup": group,
            "showlegend": shown and group not in named,
        }
        traces.append(
            {
                **own,
                **entry,
                "x": x,
                "y": y,
                "hovertemplate": hover,
                "line": {"width": 1.5, "color": color},
            }
        )
        named.add(group)
    return {"data": traces, "layout": layout, "config": _CONFIG}


_CONFIG = {"displayModeBar": False, "responsive": False, "displaylogo": False}


def _compact_layout(title: str) -> dict[str, Any]:
    return {"text": title, "font": {"size": 12}}


def _layout(height: int) -> dict[str, Any]:
    plain: dict[str, object] = {
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "height": height,
    }
    plain |= {
        "margin": {"l": 56, "r": 12, "t": 8, "b": 40},
        "font": {"size": 12},
        "hovermode": "x unified",
    }
    return plain | {
        "xaxis": {"zeroline": False, "automargin": True},
        "legend": {"orientation": "h", "y": 1.12},
    }


def plot(figure: dict[str, object], label: str) -> ui.plotly:
    """Return a figure with a text for screen readers."""
    return label_widget(ui.plotly(figure).classes("plot").props("role=img"), label)
