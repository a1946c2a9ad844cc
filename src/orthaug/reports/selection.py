"""Result of `orthaug select`: as JSON, and in words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from orthaug._base.content import Content, Flag, Number, Whole
from orthaug._base.errors import Warning
from orthaug._base.lines import continued, estimate_cells, fold, plural, table
from orthaug.inference.chosen_terms import Intervals
from orthaug.reports.result import DataResult, ResultHeader
from orthaug.selection.orders import Delay, Orders

if TYPE_CHECKING:
    from orthaug.data.channels import Channel

_SHOWN = 12  # models of a stage in the text
_CHOOSE_LAGS = ', which kind = "terms" in [learner] chooses from'
_EXPLAINED = (
    "chosen: share of random halves of the data that choose the term. left: share of its norm "
    "that physics and other terms do not explain. rate: lowest rate of false discoveries at "
    "which it is kept.",
    "p, q: of the term on rows that were not used for the choice, and the rate of false "
    "discoveries among the chosen ones.",
)


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
    orders: Orders
    delays: list[Delay]
    nonlinearity: NonlinearityResult | None
    learner: dict[str, Any] | None
    focus: str
    terms: list[TermShareResult] | None
    intervals: Intervals
    level: Number
    physics: list[ShiftResult] | None = None
    condition: Number = None
    models: list[SelectionRowResult]
    seconds: Number
    stopped: Flag
    warnings: list[Warning]


def selection_text(result: SelectResult, output: Channel) -> str:
    """Return a page of text: what was chosen, why, and the models beside it.

    Args:
        output: the one that is simulated; the errors have its unit.
    """
    from orthaug.selection.orders import Delay, Orders

    orders = Orders(result.orders.na, tuple(result.orders.nb), tuple(result.orders.nk))
    lines = [f"orders       {orders}"]
    lines += [
        f"delay        {Delay(delay.input, delay.correlation, delay.fitted, delay.square)}"
        for delay in result.delays
    ]
    if result.nonlinearity is not None:
        lines.append(f"nonlinear    {result.nonlinearity.text}{_chosen_anyway(result, output)}")
    lines.append(f"learner      {_learner(result)}")
    lines.append(f"intervals    {result.intervals.source}: {result.intervals.text}")
    if result.terms:
        rows = [
            [t.term, _percent(t.chosen), _percent(t.left), *map(_p_text, (t.rate, t.p, t.q))]
            for t in result.terms
        ]
        lines += ["", *table([["term", "chosen", "left", "rate", "p", "q"], *rows])]
        lines += ["", *_EXPLAINED]
        lines += _physics(result)
    for stage in dict.fromkeys(row.stage for row in result.models):
        lines += ["", *_table(stage, [row for row in result.models if row.stage == stage])]
    if result.models:
        lines += ["", _explain_error(output)]
    for warning in result.warnings:
        lines += ["", f"note: {warning.text}"]
    return "\n".join(fold(lines))


def _explain_error(output: Channel) -> str:
    """Return what the error of the tables is, in which unit and over what rows."""
    unit = output.unit or f"the unit of {output.name}"
    return (
        f"error: root mean square error of {output.name} in free runs, in {unit}, on blocks of the "
        "training rows that the model was not fitted to. The arrow marks the smallest model whose "
        "error is as good as the lowest, within its standard error or 2 %."
    )


def _chosen_anyway(result: SelectResult, output: Channel) -> str:
    """Return why a nonlinear learner is chosen where the test found nothing; else empty."""
    from orthaug.selection.nonlinearity import Nonlinearity

    test, learner = result.nonlinearity, result.learner
    if test is None or test.p is None or learner is None:
        return ""
    bent = [one for one in learner.get("terms", ["network"]) if one not in test.regressors]
    rows = [row for row in result.models if row.stage in ("learner", "terms")]
    alone = next((row for row in rows if not row.size), None)
    chosen = next((row for row in rows if row.chosen), None)
    lags = next((row for row in result.models if row.stage == "orders" and row.chosen), None)
    if not bent or alone is None or chosen is None or Nonlinearity(test.p, {}).found:
        return ""
    before, after = (_error_of(row, output) for row in (alone, chosen))
    what, also = ("Terms are", "") if "terms" in learner else ("A network is", _CHOOSE_LAGS)
    linear = "" if lags is None else f" Linear lags alone reach {_error_of(lags, output)}{also}."
    return (
        f" {what} chosen all the same: in free runs over held-out blocks the error falls from "
        f"{before} to {after}.{linear}"
    )


def _error_of(row: SelectionRowResult, output: Channel) -> str:
    return "no bound" if row.score is None else f"{row.score:.3g} {output.unit}".rstrip()


def _p_text(p: float | None) -> str:
    return "–" if p is None else f"{p:.2g}"


def _percent(share: float | None) -> str:
    return (
        "–" if share is None else f"{100 * share:.0f} %" if share > 0.1 else f"{100 * share:.2g} %"
    )


def _physics(result: SelectResult) -> list[str]:
    """Return the table of parameters, of physics alone and with the terms."""
    if not result.physics:
        return []
    rows = [["parameter", "physics alone", "with the terms", "left", ""]]
    for shift in result.physics:
        rows.append(
            [
                shift.parameter,
                _figure(shift.before, shift.before_std),
                _figure(shift.after, shift.after_std),
                _percent(shift.left),
                "moves beyond its std" if shift.moved else "",
            ]
        )
    condition = "infinite" if result.condition is None else f"{result.condition:.3g}"
    return ["", *table(rows), f"condition number of physics and terms together: {condition}"]


def _figure(value: float | None, std: float | None) -> str:
    shown, spread, _, _ = estimate_cells(value, std)
    return shown if std is None else f"{shown} ± {spread}"


def _learner(result: SelectResult) -> str:
    learner = result.learner
    if learner is None:
        return "none: nothing beside the physics surely lowers the error on the held-out blocks"
    if learner["kind"] == "terms":
        return plural(len(learner["terms"]), "term")
    seen = ", ".join(learner.get("inputs") or ["all lags"])
    return f"{plural(learner['hidden'][0], 'neuron')} of {seen}"


def _table(stage: str, rows: list[SelectionRowResult]) -> list[str]:
    chosen = next((i for i, row in enumerate(rows) if row.chosen), 0)
    first = max(0, min(chosen - _SHOWN // 2, len(rows) - _SHOWN))
    shown = rows[first : first + _SHOWN]
    cells = [[stage, "size", "error", "std. error", "s", "model"]]
    for row in shown:
        score = "runs away" if row.score is None else f"{row.score:.5g}"
        error = "–" if row.standard_error is None else f"{row.standard_error:.2g}"
        mark = "→" if row.chosen else ""
        cells.append([mark, str(row.size), score, error, f"{row.seconds or 0:.1f}", row.model])
    lines = table(continued(cells, drop=["s"]))
    if len(rows) > len(shown):
        lines.append(f"{len(shown)} of {len(rows)} models are shown.")
    return lines
