"""Result of `orthaug explain`, and its text."""

from __future__ import annotations

from orthaug._base.content import Flag, Number, Whole
from orthaug._base.errors import Warning
from orthaug._base.lines import Copied, continued, fold, join_blocks, percent, table
from orthaug.analysis.findings import MemoryResult
from orthaug.reports.result import ResultHeader
from orthaug.selection.explanation import ExplainingTerm, MovedParameter, SingleTerm

_MEMORY = 5  # terms with memory that the text lists


class ExplainResult(ResultHeader):
    """The result of `orthaug explain`."""

    found: Flag
    share: Number
    noise: Number
    p: Number
    points: Whole
    terms: list[ExplainingTerm]
    singles: list[SingleTerm]
    parameters: list[MovedParameter]
    spec: str | None
    text: str
    memory: list[MemoryResult] = []
    warnings: list[Warning]


def explain_text(result: ExplainResult) -> str:
    """Return the terms that were found, their effect on θ, and the lines for the spec, as text."""
    blocks = [[_capital(result.text)]]
    if result.noise is not None:
        blocks[0] += [
            f"Of what it adds, {percent(result.noise)} are its own errors, as far as training "
            "shows."
        ]
    if result.terms:
        blocks += [_term_lines(result), _parameter_lines(result)]
    if result.singles:
        several = len({one.added_to for one in result.singles}) > 1
        rows = [["share", *["added to"] * several, "each term alone"]]  # which may be long
        rows += [
            [_percent(one.share), *[one.added_to] * several, one.expression]
            for one in result.singles
        ]
        blocks.append(table(continued(rows)))
    if result.memory:
        rows = [["share", "equation", "term with memory in the free run's residual"]]
        rows += [[_percent(one.share), one.equation, one.name] for one in result.memory[:_MEMORY]]
        blocks.append(table(continued(rows)))
    if result.spec is not None:
        blocks += [["Write into the spec, and fit again:"], Copied(result.spec.splitlines())]
    elif result.terms:
        blocks.append(["The physics is a Python function: add the terms there, and fit again."])
    blocks.append([f"warning: {warning.text}" for warning in result.warnings])
    return join_blocks(blocks)


def _term_lines(result: ExplainResult) -> list[str]:
    several = len({term.added_to for term in result.terms}) > 1
    head = ["term", "coefficient", "std", "unit", "share", "alone"]
    rows = [[*head, *["added to"] * several]]
    for term in result.terms:
        std = "–" if term.std is None else f"{term.std:.2g}"
        numbers = (
            f"{term.coefficient:.6g}",
            std,
            term.unit or "–",
            _percent(term.share),
            _percent(term.alone),
        )
        rows.append([term.expression, *numbers, *[term.added_to] * several])
    lines = table(rows, drop=["alone", "unit", "std"])
    for term in result.terms:
        if term.rivals:
            rivals = f"nearly as well instead of {term.expression}: {', '.join(term.rivals)}"
            lines += fold([rivals])
    return lines


def _parameter_lines(result: ExplainResult) -> list[str]:
    rows = [["parameter", "now", "with them in the physics", "unit"]]
    rows += [[p.name, f"{p.value:.6g}", f"{p.value_with:.6g}", p.unit] for p in result.parameters]
    return table(rows)


def _percent(share: float | None) -> str:
    return "–" if share is None else percent(share, 3)


def _capital(text: str) -> str:
    """Return a sentence with a capital first letter, unless it begins with an expression."""
    first = text.split(" ", 1)[0]
    return text[:1].upper() + text[1:] if first.isalpha() else text
