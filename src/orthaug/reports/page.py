"""A result on a page: report.html, one file that needs no network."""

from __future__ import annotations

import base64
import json
from importlib.resources import files
from pathlib import Path

import jinja2

from orthaug.reports.result import FitResult


def page(name: str, result: FitResult, figures: Path) -> str:
    """One HTML file of a result, with the figures of a folder inside."""
    source = files("orthaug.reports").joinpath("templates/report.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(source).render(
        name=name,
        result=result,
        figures={p.stem: base64.b64encode(p.read_bytes()).decode() for p in sorted(figures.glob("*.png"))},
        spec=json.dumps(result.spec, indent=1, ensure_ascii=False),
        number=lambda value, digits=6: "–" if value is None else f"{value:.{digits}g}",
    )
