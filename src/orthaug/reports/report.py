"""Results in words and on a page: what `orthaug check` and `orthaug fit` print, and report.html."""

from __future__ import annotations

import base64
import json
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthaug.reports import suspects

if TYPE_CHECKING:
    from orthaug.fitting.estimates import Estimate


def fit_text(fit: Estimate, result: dict[str, Any]) -> str:
    """Parameters, scores on every part, what the residual says, whether the learner earns its place, warnings."""
    if not fit.status.ok:
        return ""
    blocks = [fit.summary().split("\nwarning: ")[0].rstrip().splitlines()]
    if result["physical_parameters"]:
        blocks.append(_physical_text(result))
    blocks.append(_scores_text(fit, result))
    told = [found["text"] for found in (result["residuals"], result["validation"]) if found]
    blocks += [told, [f"warning: {text}" for text in dict.fromkeys(result["warnings"]) if text not in told]]
    return "\n\n".join("\n".join(lines) for lines in blocks if lines)


def page(name: str, result: dict[str, Any], figures: Path) -> str:
    """One HTML file of a result, with the figures of a folder inside; it needs no network."""
    import jinja2

    source = files("orthaug.reports").joinpath("templates/report.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    parts = {"train": result["data"]["train"], **result["data"].get("tests", {})}
    return environment.from_string(source).render(
        name=name,
        result=result,
        figures={p.stem: base64.b64encode(p.read_bytes()).decode() for p in sorted(figures.glob("*.png"))},
        spec=json.dumps(result["spec"], indent=1, ensure_ascii=False),
        data=parts.items(),
        number=lambda value, digits=6: "–" if value is None else f"{value:.{digits}g}",
    )


def _physical_text(result: dict[str, Any]) -> list[str]:
    rows = result["physical_parameters"]
    width = max([9, *(len(row["name"]) for row in rows)])
    lines = [f"{'physical':<{width}}  {'value':>14}  {'std':>11}  {'95 % interval':^29}  {'initial':>11}  unit"]
    for row in rows:
        std, ci = row["std"], row.get("profile95") or row["ci95"]
        spread = f"{std:11.4g}" if std is not None else f"{'–':>11}"
        reach = f"[{_limit(ci[0])}, {_limit(ci[1])}]" if ci is not None else f"{'–':^29}"
        value = f"{row['name']:<{width}}  {row['value']:14.8g}"
        lines.append(f"{value}  {spread}  {reach}  {row['initial']:11.5g}  {row['unit']}".rstrip())
    if result["physical_consistency"]:
        lines.append(result["physical_consistency"]["text"])
    return lines


def _limit(value: float | None) -> str:
    return f"{'–':>13}" if value is None else f"{value:13.7g}"


def check_text(report: dict[str, Any]) -> str:
    """Excitation, identifiability, and what would bias the parameters."""
    found, ident = report["excitation"], report["identifiability"]
    condition = f"{found['condition']:.4g}" if found["condition"] is not None else "infinite"
    lines = [
        f"parameters       {', '.join(report['parameters']) or 'none'}",
        f"regressor        {', '.join(report['regressor'])}",
        f"usable rows      {report['rows']}",
        f"excitation       rank {found['rank']} of {found['columns']} on the data, condition {condition}",
        f"identifiability  rank {ident['rank']} of {ident['columns']} at random points: "
        + ("the parameters can be told apart" if ident["identifiable"] else "no data can tell the parameters apart"),
    ]
    for group in ident["inseparable"]:
        lines.append(f"  inseparable by any data: {', '.join(group)}")
    if ident["identifiable"]:
        for group in found["collinear"]:
            lines.append(f"  not excited separately by these data: {', '.join(group)}")
    if report["bias"]:
        lines += [
            "",
            "Bias of each parameter if a term is missing from the physics. Size: its share of the output's deviation,",
            "1 % where no coefficient is given. Removable: whether some weighting of these points leaves no bias.",
            *suspects.text(report["bias"]),
        ]
    lines += [f"warning: {text}" for text in report["warnings"]]
    return "\n".join(lines)


def _scores_text(fit: Estimate, result: dict[str, Any]) -> list[str]:
    """The scores as a table, one line per part, kind and output."""
    rows = []
    outputs = fit.model.outputs
    for part, kinds in result["scores"].items():
        for kind, entry in kinds.items():
            for i, channel in enumerate(outputs):
                cells = [entry[key][i] if entry[key] is not None else None for key in ("rmse", "nrmse", "fit")]
                rmse, nrmse, percent = ("–" if c is None else f"{c:.6g}" for c in cells)
                rows.append((part, kind, channel.name, f"{rmse} {channel.unit}".strip(), nrmse, percent))
    if not rows:
        return []
    table = [("part", "horizon", "output", "RMSE", "NRMSE", "FIT %"), *rows]
    widths = [max(len(row[i]) for row in table) for i in range(6)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in table]
    return lines
