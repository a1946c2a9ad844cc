"""The terms of a learner, each with its coefficient, unit and interval, and the fitted equation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.checks import check_choice
from orthaug._base.errors import InputError
from orthaug._base.lines import INTERVAL_HEAD, estimate_rows, table
from orthaug.data.expressions import Expression
from orthaug.data.terms import outside_brackets
from orthaug.data.writing import coefficient_unit, latex
from orthaug.inference.covariance import interval
from orthaug.models.model import Model
from orthaug.models.terms import Terms

if TYPE_CHECKING:
    import pandas as pd

WRITINGS = ("text", "latex", "python")


@dataclass(frozen=True)
class LearnedTerm:
    """A term of the learner in one output, or in one equation of a motion.

    `largest` is the largest contribution over the training data, in the unit of what it is added
    to; `std` and `ci95` are None where there are no standard errors.
    """

    term: str
    added_to: str
    coefficient: float
    unit: str | None
    largest: float
    std: float | None = None
    ci95: tuple[float, float] | None = None


def learned_terms(model: Model) -> tuple[LearnedTerm, ...]:
    """Return the learned terms of a fitted model, the largest contribution first.

    Empty where the learner is no sum of terms.
    """
    form, numbers, statistics = model.form, model.numbers, model.statistics
    if not isinstance(form.bound.learner, Terms) or numbers.tilt is not None:
        return ()
    places, features = _targets(model), _features(model)
    scale = np.asarray(numbers.gain)[:, None] / np.asarray(numbers.halfwidth)[None, :]
    values = (np.reshape(numbers.weights, scale.shape) * scale).ravel()
    nt = len(numbers.theta)
    joint = statistics.joint(nt)
    std = ci = None
    if joint is not None:
        k = np.column_stack([np.zeros((scale.size, nt)), np.diag(scale.ravel())])
        std = np.sqrt(np.diag(joint.of(k)))
        ci = interval(values, std, max(statistics.freedom, 1.0))
    units = _units(model)
    found = []
    for i, (place, unit) in enumerate(places):
        for j, feature in enumerate(features):
            n = i * len(features) + j
            known: dict[str, Any] = {}
            if std is not None and ci is not None:
                known = {"std": float(std[n]), "ci95": (float(ci[n, 0]), float(ci[n, 1]))}
            largest = abs(values[n]) * float(numbers.halfwidth[j])
            own = coefficient_unit(unit, feature, units)
            found.append(
                LearnedTerm(str(feature), place, float(values[n]), own, float(largest), **known)
            )
    return tuple(sorted(found, key=lambda term: -term.largest))


def equation(model: Model, writing: str = "text") -> str:
    """Return the fitted model with its numbers, an equation per output or per motion equation.

    Args:
        writing: "text", "latex", or "python": expressions of arrays that Python evaluates, in full
            precision.

    Raises:
        InputError: a learner that is no sum of terms, physics that is a Python function, another
            writing.
    """
    check_choice(writing, WRITINGS, "`writing`")
    form = model.form
    terms = learned_terms(model)
    if form.learns and not terms:
        raise InputError(
            "only a learner of terms can be written as an equation; `explain` finds terms for "
            "another."
        )
    written = []
    for left, physics in _physics(model, writing):
        own = [(term.coefficient, term.term) for term in terms if term.added_to == left[0]]
        pieces = [*physics, *(_product(value, text, writing) for value, text in own)]
        signed = [f"- {piece[1:]}" if piece.startswith("-") else f"+ {piece}" for piece in pieces]
        total = " ".join(signed).removeprefix("+ ") or "0"
        written.append(f"{left[1]} = {'-' + total[2:] if total.startswith('- ') else total}")
    return "\n".join(written)


def _features(model: Model) -> tuple[Expression, ...]:
    entries = model.form.features
    return entries if isinstance(entries, tuple) else entries.entries


def _moves(model: Model) -> bool:
    return hasattr(model.form, "motion")


def _targets(model: Model) -> list[tuple[str, str]]:
    """Return the name and unit of the quantity that each row of weights is added to."""
    if not _moves(model):
        return [(channel.name, channel.unit) for channel in model.outputs]
    motion = model.form.motion
    states, outputs = motion.learned
    units = {channel.name: channel.unit for channel in model.outputs}
    rates = [
        motion.mass.label(i)
        or (motion.states[i].name, f"({motion.states[i].unit})/s" if motion.states[i].unit else "")
        for i in states
    ]
    return [
        *rates,
        *((motion.outputs[i].name, units.get(motion.outputs[i].name, "")) for i in outputs),
    ]


def _units(model: Model) -> dict[str, str]:
    units = model.units
    if _moves(model):
        units |= {state.name: state.unit for state in model.form.motion.states}
    return units


def _physics(model: Model, writing: str) -> list[tuple[tuple[str, str], list[str]]]:
    """Return each equation's name and left side, and its terms of the physics."""
    if _moves(model):
        return _rates(model, writing)
    baseline = model.form.baseline
    if baseline.function is not None:
        raise InputError(
            "the physics is a Python function, which cannot be written as an equation."
        )
    c = dict(zip(baseline.names, model.theta - model.theta_aux, strict=True))
    found = []
    for channel in model.outputs:
        own = [term for term in baseline.terms if term.output in (None, channel.name)]
        values = [
            ((term.initial or 0.0) if term.fixed else c[term.parameter], term.regressor)
            for term in own
        ]
        left = (
            latex(Expression(f"{channel.name}[k]")) if writing == "latex" else f"{channel.name}[k]"
        )
        found.append(
            (
                (channel.name, left),
                [_product(value, text, writing) for value, text in values],
            )
        )
    return found


def _rates(model: Model, writing: str) -> list[tuple[tuple[str, str], list[str]]]:
    motion = model.form.motion
    if motion.functions is not None:
        raise InputError("the physics are Python functions, which cannot be written as equations.")
    discrete = motion.scheme.discrete
    found = []
    for state in motion.states:
        symbol = latex(Expression(state.name))
        left = f"{state.name}[k+1]" if discrete else f"d{state.name}/dt"
        if writing == "latex":
            left = f"{symbol}_{{k+1}}" if discrete else rf"\dot{{{symbol}}}"
        found.append(((state.name, left), [_expression(state.derivative, writing)]))
    for output in motion.outputs:
        found.append(((output.name, output.name), [_expression(output.expression, writing)]))
    return found


def _expression(text: str, writing: str) -> str:
    return latex(Expression(text)) if writing == "latex" else text


def _product(value: float, text: str, writing: str) -> str:
    number = repr(float(value)) if writing == "python" else f"{value:.6g}"
    if writing == "latex":
        number = _power_of_ten(number)
        return number if text == "1" else rf"{number}\,{latex(Expression(text))}"
    return (
        number
        if text == "1"
        else f"{number}*({text})"
        if outside_brackets(text, "+-")
        else f"{number}*{text}"
    )


def _power_of_ten(number: str) -> str:
    mantissa, _, power = number.partition("e")
    return rf"{mantissa} \cdot 10^{{{int(power)}}}" if power else number


def term_frame(terms: Sequence[LearnedTerm]) -> pd.DataFrame:
    """Return a table with a row per term; NaN where there is no interval."""
    import pandas as pd

    from orthaug._base.frames import EstimateFrame

    nothing = (np.nan, np.nan)
    ci = np.array([term.ci95 or nothing for term in terms]).reshape(-1, 2)
    return EstimateFrame(
        {
            "added_to": [term.added_to for term in terms],
            "unit": [term.unit for term in terms],
            "coefficient": [term.coefficient for term in terms],
            "std": [np.nan if term.std is None else term.std for term in terms],
            "ci95_low": ci[:, 0],
            "ci95_high": ci[:, 1],
            "largest": [term.largest for term in terms],
        },
        index=pd.Index([term.term for term in terms], name="term"),
    )


def term_lines(terms: Sequence[LearnedTerm], interval_head: str = INTERVAL_HEAD) -> list[str]:
    """Return the terms as a table in text, with a heading.

    A dash where there is no interval.
    """
    if not terms:
        return []
    cells = estimate_rows((term.coefficient, term.std, term.ci95) for term in terms)
    several = len({term.added_to for term in terms}) > 1
    head = ["term", "coefficient", "std", interval_head, "largest", "unit"]
    rows = [
        [term.term, *own, f"{term.largest:.5g}", term.unit or "", *[term.added_to] * several]
        for term, own in zip(terms, cells, strict=True)
    ]
    return ["", *table([[*head, *["added to"] * several], *rows], drop=["unit", "largest"])]
