"""A result on a page: report.html, one file that needs no network."""

from __future__ import annotations

import base64
import gzip
import importlib.util
import json
import math
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape

from orthaug._base.errors import Warning
from orthaug.reports.page_blocks import Plot, Section, plots_of, prose
from orthaug.reports.page_compare import ComparePage, compare_sections
from orthaug.reports.page_fit import FitPage, Origin, fit_sections
from orthaug.reports.page_verdict import PageVerdict, compare_verdict, fit_verdict

_MOST_NAMES = 4  # of channels in a title
_TOLD_ELSEWHERE = ("witness", "free_run_diverged", "residual_not_analysed")


def fit_page(page: FitPage) -> str:
    """Return the page of a fit."""
    result = page.result
    title = _title("Model", page.outputs, result.spec, page.origin)
    kind = f"{result.structure} structure" + (
        f", {result.measure} measure" if result.measure else ""
    )
    warnings = [w for w in result.warnings if w.code not in _TOLD_ELSEWHERE]
    return _page(
        title,
        kind,
        fit_verdict(result),
        warnings,
        fit_sections(page),
        page.origin,
        result.validation.text if result.validation else "",
    )


def compare_page(page: ComparePage) -> str:
    """Return the page of a comparison."""
    title = _title(
        f"{len(page.result.comparison)} models", page.outputs, page.result.spec, page.origin
    )
    verdict = compare_verdict(page.result)
    return _page(
        title, "comparison", verdict, page.result.warnings, compare_sections(page), page.origin, ""
    )


def _title(what: str, outputs: Sequence[str], spec: Mapping[str, Any], origin: Origin) -> str:
    """Return the title of a page; it omits a spec that is called just that."""
    inputs = spec.get("data", {}).get("inputs") or []
    title = f"{what} of {_list_names(outputs)}" + (f" from {_list_names(inputs)}" if inputs else "")
    return title if origin.name == "spec" else f"{title}: {origin.name}"


def _list_names(names: Sequence[str]) -> str:
    return ", ".join([*names[:_MOST_NAMES], *(["…"] if len(names) > _MOST_NAMES else [])])


def _page(
    title: str,
    kind: str,
    verdict: PageVerdict,
    warnings: Sequence[Warning],
    sections: Sequence[Section],
    origin: Origin,
    judged: str,
) -> str:
    plots = plots_of(sections)
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(_template("page.html")).render(
        title=title,
        kind=kind,
        verdict=verdict,
        judged=judged,
        warnings=list(dict.fromkeys(w.text for w in warnings)),
        sections=sections,
        origin=origin,
        number_of={id(plot): i for i, plot in enumerate(plots)},
        key=id,
        ticked=_code_markup,
        prose=prose,
        kind_of=lambda block: type(block).__name__,
        style=_template("page.css"),
        script=_template("page.js"),
        figures=_embed([_figure(plot) for plot in plots]),
        plotly=_plotly(),
    )


def _code_markup(text: str) -> Markup:
    """Return markup with code for text between backticks, and the minus signs of the tables."""
    parts = [
        Markup("<code>{}</code>").format(part) if i % 2 else escape(prose(part))
        for i, part in enumerate(text.split("`"))
    ]
    return Markup("").join(parts) if len(parts) % 2 else escape(prose(text))


def _figure(plot: Plot) -> dict[str, Any]:
    return {
        "data": plot.traces,
        "layout": plot.layout,
        "height": plot.height,
        "small": plot.small,
        "series": plot.series,
        "whole": plot.whole,
    }


def _embed(content: Any) -> str:
    """Return JSON for a script element: finite, and without anything that would end the element."""
    text = json.dumps(_finite(content), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _finite(content: Any) -> Any:
    """Return the content with None for numbers that JSON does not have."""
    if isinstance(content, float):
        return content if math.isfinite(content) else None
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    return [_finite(value) for value in content] if isinstance(content, list | tuple) else content


def _template(name: str) -> str:
    return files("orthaug.reports").joinpath("templates", name).read_text(encoding="utf-8")


@cache
def _plotly() -> str:
    """Return Plotly's script from its package, compressed, for the page to unpack.

    The package itself is not imported. Level 4 takes half the time of level 6, for 4 % more bytes.
    """
    found = importlib.util.find_spec("plotly")
    assert found is not None and found.submodule_search_locations
    script = Path(found.submodule_search_locations[0]) / "package_data" / "plotly.min.js"
    return base64.b64encode(gzip.compress(script.read_bytes(), 4, mtime=0)).decode()
