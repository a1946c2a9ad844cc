"""Display of records, physics, fits and models in notebooks: a title, a few facts, a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import singledispatch
from typing import Any

import jinja2
import numpy as np

from orthaug._base.lines import BIASED_INTERVAL, estimate_rows
from orthaug.analysis.fit_findings import Findings
from orthaug.data.record import Record
from orthaug.fitting.estimates import STD_KINDS, Estimate
from orthaug.models.model import Model
from orthaug.physics.baseline import Baseline
from orthaug.physics.motion import Motion
from orthaug.reports.page_blocks import unbroken

# Colours are the notebook's own, so that a card is read on light and on dark.
_TEMPLATE = """<div class="orthaug" style="max-width:60em;overflow-x:auto">
<style>.orthaug table{border-collapse:collapse;margin:.4em 0;font-variant-numeric:tabular-nums}\
.orthaug th,.orthaug td{text-align:left;padding:.15em .8em .15em 0;\
border-bottom:1px solid rgba(128,128,128,.35)}\
.orthaug th{font-weight:600}.orthaug .facts{opacity:.8}.orthaug p{margin:.2em 0}</style>
<p><strong>{{ card.title }}</strong></p>
{% for name, value in card.facts.items() %}
<p class="facts">{{ name }}: {{ value }}</p>
{% endfor %}
{% for table in card.tables if table.rows %}
<table><thead><tr>{% for head in table.columns %}<th scope="col">{{ head }}</th>{% endfor %}\
</tr></thead><tbody>
{% for row in table.rows %}
<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}
</tbody></table>
{% endfor %}
{% for note in card.notes %}
<p>⚠ {{ note }}</p>
{% endfor %}
</div>
"""
_MOST_ROWS = 40  # of a table


@dataclass(frozen=True)
class Table:
    """Columns and rows of text."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Card:
    """The content that is shown of an object."""

    title: str
    facts: Mapping[str, str] = field(default_factory=dict)
    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()


def html_of(shown: object) -> str:
    """Return the object, or a card, as HTML, escaped."""
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        finalize=lambda shown: unbroken(shown) if isinstance(shown, str) else shown,
    )
    card = shown if isinstance(shown, Card) else card_of(shown)
    tables = [Table(t.columns, _shorten_table(t)) for t in card.tables]
    return environment.from_string(_TEMPLATE).render(
        card=Card(card.title, card.facts, tables, card.notes)
    )


def _shorten_table(table: Table) -> Sequence[Sequence[str]]:
    more = len(table.rows) - _MOST_ROWS
    if more <= 1:
        return table.rows
    return [*table.rows[:_MOST_ROWS], [f"and {more} more", *[""] * (len(table.columns) - 1)]]


@singledispatch
def card_of(shown: object) -> Card:
    """Return the card of an object."""
    return Card(repr(shown))


@card_of.register
def _record(record: Record) -> Card:
    count, step = len(record.experiments), record.sampling_time
    facts = {
        "samples": f"{len(record)} in {count} experiment{'s' * (count != 1)}, {step:g} s apart, "
        f"{len(record) * step:g} s in all"
    }
    rows = []
    for role, channels in (("input", record.inputs), ("output", record.outputs)):
        for i, channel in enumerate(channels):
            values = np.concatenate(
                [np.asarray(getattr(e, role + "s"))[:, i] for e in record.experiments]
            )
            there = values[np.isfinite(values)]
            numbers = (
                (there.min(), there.max(), there.mean(), there.std())
                if len(there)
                else (np.nan,) * 4
            )
            missing = len(values) - len(there)
            rows.append(
                [
                    channel.name,
                    role,
                    channel.unit or "–",
                    *map(_number, numbers),
                    str(missing or "–"),
                ]
            )
    columns = ["channel", "role", "unit", "least", "largest", "mean", "deviation", "missing"]
    return Card("Record", facts, [Table(columns, rows)])


@card_of.register
def _baseline(baseline: Baseline) -> Card:
    facts = {"constants": ", ".join(f"{k} = {v:g}" for k, v in dict(baseline.constants).items())}
    if baseline.function is not None:
        facts["terms"] = "a function of the regressor"
    rows = [
        [f"{t.parameter} (fixed)" if t.fixed else t.parameter, t.regressor] for t in baseline.terms
    ]
    columns = ["parameter", "regressor"]
    if any(t.output for t in baseline.terms):  # else there is only one
        columns = ["output", *columns]
        rows = [[t.output or "–", *row] for t, row in zip(baseline.terms, rows, strict=True)]
    return Card(
        "Baseline", _facts(facts), [Table(columns, rows), _declared_table(baseline.parameters)]
    )


@card_of.register
def _motion(motion: Motion) -> Card:
    facts = {
        "inputs": ", ".join(motion.inputs),
        "constants": ", ".join(f"{k} = {v:g}" for k, v in motion.constants),
        "integrator": f"{motion.integrator}, inputs held by {motion.hold}",
    }
    if motion.functions is not None:
        facts["equations"] = "functions of states, inputs and parameters"
    rows = [
        [f"d/dt {s.name}", s.derivative or "–", s.unit or "–", "yes" if s.learned else "–"]
        for s in motion.states
    ]
    rows += [
        [o.name, o.expression or "–", "–", "yes" if o.learned else "–"] for o in motion.outputs
    ]
    defined = [[name, str(expression)] for name, expression in motion.definitions]
    equations = Table(["", "equation", "unit of the state", "learned beside it"], rows)
    return Card(
        "Motion",
        _facts(facts),
        [equations, Table(["defined", "as"], defined), _declared_table(motion.parameters)],
    )


@card_of.register(Estimate)
def _fit_card(fit: Estimate) -> Card:
    status = fit.status
    facts = {
        "structure": fit.model.structure,
        "learner": str(fit.model.form.bound),
        "data": repr(fit.problem.record),
        "status": f"{status.code}, {status.iterations} iterations, {status.seconds:.2f} s, loss "
        f"{status.loss:.6g}",
        "": status.message or "",
        "std": "" if fit.plain_covariance is None else STD_KINDS[fit.std_kind],
    }
    found = fit.parameters.to_dict("index")
    cells = estimate_rows(
        (row["value"], row["std"], (row["ci95_low"], row["ci95_high"])) for row in found.values()
    )
    rows = [
        [str(name), *map(_compact, own), row["unit"] or "–"]
        for (name, row), own in zip(found.items(), cells, strict=True)
    ]
    parameters = Table(["parameter", "value", "std", "95 % interval", "unit"], rows)
    return Card(
        type(fit).__name__, _facts(facts), [parameters], [warning.text for warning in fit.warnings]
    )


def card_of_result(fit: Estimate, result: Findings) -> Card:
    """Return the card of a fit with the findings on every parameter, and all warnings."""
    parameters = [*result.parameters, *(result.physical_parameters or ())]
    columns = ["parameter", "value", "std", "95 % interval", "unit"]
    cells = estimate_rows((row.value, row.std, row.ci95) for row in parameters)
    rows = [
        [row.name, *map(_compact, own), row.shown_unit]
        for row, own in zip(parameters, cells, strict=True)
    ]
    if any(row.bias for row in parameters):
        columns += ["bias", BIASED_INTERVAL]
        wider = estimate_rows((row.value, None, row.ci95_with_bias) for row in parameters)
        for own, row, (*_, reach) in zip(rows, parameters, wider, strict=True):
            known = row.bias is None or row.bias.determined
            shown = _compact(reach) if known else "not determined"
            own += [_number(row.bias.value if row.bias else None, 3), shown]
    notes = [f"Verdict: {result.verdict}", *(warning.text for warning in result.warnings)]
    return replace(card_of(fit), tables=[Table(columns, rows)], notes=notes)


@card_of.register(Model)
def _model(model: Model) -> Card:
    facts = {
        "structure": model.structure,
        "learner": str(model.form.bound),
        "outputs": ", ".join(channel.label for channel in model.outputs),
        "inputs": ", ".join(channel.label for channel in model.inputs),
        "sampling time": f"{model.sampling_time:g} s",
    }
    parameters, values = model.estimated
    rows = [
        [p.name, _number(value), p.unit or "–"] for p, value in zip(parameters, values, strict=True)
    ]
    return Card(type(model).__name__, _facts(facts), [Table(["parameter", "value", "unit"], rows)])


def _declared_table(parameters: Sequence[Any]) -> Table:
    """Return the parameters as they were declared."""
    rows = []
    for p in parameters:
        rows.append([p.name, _number(p.initial), p.unit or "–", _bounds(p.min, p.max)])
    return Table(["parameter", "initial", "unit", "bounds"], rows)


def _facts(facts: Mapping[str, str]) -> dict[str, str]:
    """Return the facts without empty ones; a value without a name continues the fact before it."""
    named: dict[str, str] = {}
    for name, value in facts.items():
        if value and not name and named:
            last = list(named)[-1]
            named[last] += f"; {value}"
        elif value:
            named[name] = value
    return named


def _number(value: Any, digits: int = 6) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:.{digits}g}"


def _bounds(low: float, high: float) -> str:
    if np.isfinite(low) and np.isfinite(high):
        return _interval(low, high)
    return f"≥ {low:g}" if np.isfinite(low) else f"≤ {high:g}" if np.isfinite(high) else "–"


def _compact(cell: str) -> str:
    """Return a cell without the spaces that align it in text."""
    return cell.replace("[ ", "[").replace("  ", " ") if cell.startswith("[") else cell


def _interval(low: Any, high: Any) -> str:
    ends = ("–" if end is None or not np.isfinite(end) else f"{end:.6g}" for end in (low, high))
    return "[{}, {}]".format(*ends)
