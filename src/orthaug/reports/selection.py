"""What `orthaug select` leaves: as JSON, and in words."""

from __future__ import annotations

from typing import Any

from orthaug._base.lines import fold
from orthaug.reports.fields import Content, Flag, Number, WarningResult, Whole
from orthaug.reports.result import DataResult, Headed

_SHOWN = 12  # models of a stage in the text


class OrdersResult(Content):
    """The orders that were chosen, of each input."""

    na: Whole
    nb: list[Whole]
    nk: list[Whole]


class DelayResult(Content):
    """The delay of an input, by its cross-correlation with the output and by the fit, in samples."""

    input: str
    correlation: int | None
    fitted: Whole


class NonlinearityResult(Content):
    """Whether anything nonlinear is missing beside physics and linear lags."""

    p: Number
    regressors: dict[str, Number]
    matter: list[str]
    text: str


class TermShareResult(Content):
    """A chosen term, and how often it is chosen over random halves of the data."""

    term: str
    chosen: Number


class JudgedResult(Content):
    """A model that was judged: a row of the table."""

    stage: str
    model: str
    size: Whole
    score: Number
    standard_error: Number
    within: Flag
    chosen: Flag
    seconds: Number


class SelectResult(Headed):
    """What `orthaug select` leaves."""

    data: DataResult
    orders: OrdersResult
    delays: list[DelayResult]
    nonlinearity: NonlinearityResult | None
    learner: dict[str, Any] | None
    focus: str
    terms: list[TermShareResult] | None
    models: list[JudgedResult]
    seconds: Number
    stopped: Flag
    warnings: list[WarningResult]


def selection_text(result: SelectResult) -> str:
    """A page: what was chosen, why, and the models beside it."""
    from orthaug.selection.orders import Delay, Orders

    orders = Orders(result.orders.na, tuple(result.orders.nb), tuple(result.orders.nk))
    lines = [f"orders       {orders}"]
    lines += [f"delay        {Delay(delay.input, delay.correlation, delay.fitted)}" for delay in result.delays]
    if result.nonlinearity is not None:
        lines.append(f"nonlinear    {result.nonlinearity.text}")
    lines.append(f"learner      {_learner(result)}")
    if result.terms:
        width = max(len(term.term) for term in result.terms)
        lines += ["", f"{'term':<{width}}  chosen over random halves of the data"]
        lines += [f"{t.term:<{width}}  {'–' if t.chosen is None else f'{100 * t.chosen:.0f} %'}" for t in result.terms]
    for stage in dict.fromkeys(row.stage for row in result.models):
        lines += ["", *_table(stage, [row for row in result.models if row.stage == stage])]
    for warning in result.warnings:
        lines += ["", f"note: {warning.text}"]
    return "\n".join(fold(lines))


def _learner(result: SelectResult) -> str:
    learner = result.learner
    if learner is None:
        return "none: on the blocks that were held out nothing beside the physics lowers the error"
    if learner["kind"] == "terms":
        return f"{len(learner['terms'])} terms"
    seen = ", ".join(learner.get("inputs") or ["all lags"])
    return f"{learner['hidden'][0]} neurons of {seen}"


def _table(stage: str, rows: list[JudgedResult]) -> list[str]:
    chosen = next((i for i, row in enumerate(rows) if row.chosen), 0)
    first = max(0, min(chosen - _SHOWN // 2, len(rows) - _SHOWN))
    shown = rows[first : first + _SHOWN]
    lines = [f"{stage:<8} {'size':>5}  {'error':>11}  {'std. error':>10}  {'s':>6}"]
    if len(rows) > len(shown):
        lines[0] += f"   {len(shown)} of {len(rows)} models"
    for row in shown:
        score = "runs away" if row.score is None else f"{row.score:.5g}"
        error = "–" if row.standard_error is None else f"{row.standard_error:.2g}"
        mark = "→" if row.chosen else " "
        lines.append(f"{mark:<8} {row.size:5d}  {score:>11}  {error:>10}  {row.seconds or 0:6.1f}   {row.model}")
    return lines
