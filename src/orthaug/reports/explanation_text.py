"""An explanation in words: what `orthaug explain` prints."""

from __future__ import annotations

import textwrap

from orthaug.reports.explanation import ExplainResult

_WIDTH = 100


def explain_text(result: ExplainResult) -> str:
    """What the learner has found, the terms alone, θ with them in the physics, and what to write into the spec."""
    blocks = [textwrap.wrap(_capital(result.text), _WIDTH)]
    if result.noise is not None:
        blocks[0] += [f"Of what it adds, {100 * result.noise:.2g} % are its own errors, as far as training tells."]
    if result.terms:
        blocks += [_term_lines(result), _parameter_lines(result)]
    if result.singles:
        rows = [["each term alone", "share", "added to"]]
        rows += [[one.expression, _percent(one.share), one.added_to] for one in result.singles]
        blocks.append(_table(rows))
    if result.spec is not None:
        blocks.append(["Write into the spec, and fit again:", "", *result.spec.splitlines()])
    elif result.terms:
        blocks.append(["The physics is a Python function: add the terms there, and fit again."])
    blocks.append([f"warning: {warning.text}" for warning in result.warnings])
    return "\n\n".join("\n".join(lines) for lines in blocks if lines)


def _term_lines(result: ExplainResult) -> list[str]:
    rows = [["term", "coefficient", "std", "unit", "share", "alone", "added to"]]
    for term in result.terms:
        std = "–" if term.std is None else f"{term.std:.2g}"
        numbers = (f"{term.coefficient:.6g}", std, term.unit or "–", _percent(term.share), _percent(term.alone))
        rows.append([term.expression, *numbers, term.added_to])
    lines = _table(rows)
    for term in result.terms:
        if term.rivals:
            lines.append(f"nearly as well instead of {term.expression}: {', '.join(term.rivals)}")
    return lines


def _parameter_lines(result: ExplainResult) -> list[str]:
    rows = [["parameter", "now", "with them in the physics", "unit"]]
    rows += [[p.name, f"{p.value:.6g}", f"{p.value_with:.6g}", p.unit] for p in result.parameters]
    return _table(rows)


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.3g} %"


def _capital(text: str) -> str:
    """A sentence; one that begins with an expression stays as it is."""
    first = text.split(" ", 1)[0]
    return text[:1].upper() + text[1:] if first.isalpha() else text


def _table(rows: list[list[str]]) -> list[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
