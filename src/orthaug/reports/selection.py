"""Result of `orthaug select`: as JSON, and in words."""

from __future__ import annotations

from typing import Any

from orthaug._base.lines import fold
from orthaug.reports.fields import Content, Flag, IntervalsResult, Number, WarningResult, Whole
from orthaug.reports.result import DataResult, ResultHeader

_SHOWN = 12  # models of a stage in the text
_EXPLAINED = (
    "chosen: share of random halves that choose the term; left: of its norm, beside physics "
    "and other terms; rate: the least rate of false discoveries at which it stays.",
    "p, q: of the term on rows that had no say in the choice, and the rate of false "
    "discoveries among the chosen ones.",
)


class OrdersResult(Content):
    """The orders that were chosen, of each input."""

    na: Whole
    nb: list[Whole]
    nk: list[Whole]


class DelayResult(Content):
    """The delay of an input in samples, by three estimates."""

    input: str
    correlation: int | None
    fitted: int | None
    square: int | None = None


class NonlinearityResult(Content):
    """Test of whether physics and linear lags lack something nonlinear."""

    p: Number
    regressors: dict[str, Number]
    matter: list[str]
    text: str


class TermShareResult(Content):
    """A chosen term: its stability, its uniqueness and its significance.

    `rate` is the least rate of false discoveries at which the choice keeps it, on the rows that
    chose; `p` and `q` are those of the rows that had no say. `rivals` are candidates that it may
    replace. `chosen` is the share of random halves that choose it, `left` the share of it that the
    other columns leave.
    """

    term: str
    chosen: Number
    left: Number = None
    rate: Number = None
    p: Number = None
    q: Number = None
    rivals: list[str] = []


class ShiftResult(Content):
    """A parameter without and with the chosen terms, and the share of its regressor left."""

    parameter: str
    unit: str | None
    before: Number
    before_std: Number
    after: Number
    after_std: Number
    left: Number
    moved: Flag


class SelectionRowResult(Content):
    """A model that was judged: a row of the table."""

    stage: str
    model: str
    size: Whole
    score: Number
    standard_error: Number
    within: Flag
    chosen: Flag
    seconds: Number


class SelectResult(ResultHeader):
    """The result of `orthaug select`."""

    data: DataResult
    orders: OrdersResult
    delays: list[DelayResult]
    nonlinearity: NonlinearityResult | None
    learner: dict[str, Any] | None
    focus: str
    terms: list[TermShareResult] | None
    intervals: IntervalsResult
    level: Number
    physics: list[ShiftResult] | None = None
    condition: Number = None
    models: list[SelectionRowResult]
    seconds: Number
    stopped: Flag
    warnings: list[WarningResult]


def selection_text(result: SelectResult) -> str:
    """Return a page of text: what was chosen, why, and the models beside it."""
    from orthaug.selection.orders import Delay, Orders

    orders = Orders(result.orders.na, tuple(result.orders.nb), tuple(result.orders.nk))
    lines = [f"orders       {orders}"]
    lines += [
        f"delay        {Delay(delay.input, delay.correlation, delay.fitted, delay.square)}"
        for delay in result.delays
    ]
    if result.nonlinearity is not None:
        lines.append(f"nonlinear    {result.nonlinearity.text}")
    lines.append(f"learner      {_learner(result)}")
    lines.append(f"intervals    {result.intervals.source}: {result.intervals.text}")
    if result.terms:
        width = max(len(term.term) for term in result.terms)
        lines += [
            "",
            f"{'term':<{width}}  {'chosen':>6}  {'left':>6}  {'rate':>8}  {'p':>8}  {'q':>8}",
        ]
        lines += [
            f"{t.term:<{width}}  {_percent(t.chosen):>6}  {_percent(t.left):>6}  "
            f"{_p_text(t.rate)}  {_p_text(t.p)}  {_p_text(t.q)}"
            for t in result.terms
        ]
        lines += ["", *_EXPLAINED]
        lines += _physics(result)
    for stage in dict.fromkeys(row.stage for row in result.models):
        lines += ["", *_table(stage, [row for row in result.models if row.stage == stage])]
    for warning in result.warnings:
        lines += ["", f"note: {warning.text}"]
    return "\n".join(fold(lines))


def _p_text(p: float | None) -> str:
    return f"{'–' if p is None else f'{p:.2g}':>8}"


def _percent(share: float | None) -> str:
    return (
        "–" if share is None else f"{100 * share:.0f} %" if share > 0.1 else f"{100 * share:.2g} %"
    )


def _physics(result: SelectResult) -> list[str]:
    """Return the table of parameters, of physics alone and with the terms."""
    if not result.physics:
        return []
    width = max(9, *(len(shift.parameter) for shift in result.physics))
    lines = [
        "",
        f"{'parameter':<{width}}  {'physics alone':>22}  {'with the terms':>22}  {'left':>6}",
    ]
    for shift in result.physics:
        before, after = (
            _figure(shift.before, shift.before_std),
            _figure(shift.after, shift.after_std),
        )
        mark = "  moves by more than its standard errors allow" if shift.moved else ""
        lines.append(
            f"{shift.parameter:<{width}}  {before:>22}  {after:>22}  "
            f"{_percent(shift.left):>6}{mark}"
        )
    condition = "infinite" if result.condition is None else f"{result.condition:.3g}"
    return [*lines, f"condition number of physics and terms together: {condition}"]


def _figure(value: float | None, std: float | None) -> str:
    shown = "–" if value is None else f"{value:.4g}"
    return shown if std is None else f"{shown} ± {std:.2g}"


def _learner(result: SelectResult) -> str:
    learner = result.learner
    if learner is None:
        return "none: nothing beside the physics lowers the error on the held-out blocks"
    if learner["kind"] == "terms":
        return f"{len(learner['terms'])} terms"
    seen = ", ".join(learner.get("inputs") or ["all lags"])
    return f"{learner['hidden'][0]} neurons of {seen}"


def _table(stage: str, rows: list[SelectionRowResult]) -> list[str]:
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
        lines.append(
            f"{mark:<8} {row.size:5d}  {score:>11}  {error:>10}  {row.seconds or 0:6.1f}   "
            f"{row.model}"
        )
    return lines
