"""What other forms of selected terms would make of the parameters, as a budget of biases."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.errors import Warning
from orthaug._base.lines import first_words, join_words
from orthaug.analysis.bias_hull import AS_LIKELY, OtherForm, hull
from orthaug.analysis.budget import Budget, BudgetTerms
from orthaug.analysis.parameter_bias import (
    ParameterBias,
    farthest,
    owners_of,
    parameter_biases,
    physical_biases,
)
from orthaug.analysis.rival_forms import RivalForm, rival_forms

_LISTED = 3  # forms and parameters that a warning lists at most
_ROUNDING = 1e-6  # of a standard error


def budget_by_forms(terms: BudgetTerms) -> Budget | None:
    """Return the bias of every parameter by the forms that fit as well as the selected ones.

    None where a learner is beside the physics, and where no form was selected or has a rival. A
    warning names the terms of which no other form can be tried.
    """
    if terms.learned is not None or not any(p.selected for p in terms.fit.problem.parameters):
        return None
    rivals, untried = rival_forms(terms)
    alone = (
        _form_alone(untried, "it acts in several equations or is a function") if untried else None
    )
    if not rivals:
        return Budget((), 1.0, (), (), (alone,)) if alone else None
    fit, value = terms.fit, terms.value
    moved = np.array([rival.moved for rival in rivals])
    forms = [OtherForm(rival.name, 1.0, rival.moved) for rival in rivals]
    every = [OtherForm("the selected form", 1.0, np.zeros(len(value))), *forms]
    noise = np.full((len(value), 2), np.nan) if fit.interval is None else fit.interval
    ends = np.clip(hull(value, noise, fit.freedom, every), *terms.bounds.T[:, :, None])
    bias, std = farthest(moved), fit.known_std
    owners = owners_of(forms, moved)
    rows = parameter_biases(terms.names, value, std, bias, ends, owners, fit.freedom)
    physical, unbounded = physical_biases(terms, forms, every)
    rows, physical = (tuple(filter(_is_moved, of)) for of in (rows, physical))
    warnings = [_warning(rivals, terms.names, value, moved, std), alone, *unbounded]
    return Budget((), 1.0, rows, physical, tuple(w for w in warnings if w is not None))


def selected_alone(fit: Any, *, forecasts: bool = False) -> list[Warning]:
    """Return the warning that what is beside the physics leaves a selected form alone.

    Args:
        forecasts: True for a motion whose noise model forecasts its errors.
    """
    beside = "a learner" if fit.learns else "a noise model" if forecasts else ""
    found = [one.name for one in fit.problem.parameters if one.selected] if beside else []
    return [_form_alone(found, f"{beside} is beside the physics")] if found else []


def _form_alone(names: Sequence[str], why: str) -> Warning:
    return Warning(
        "rival_forms",
        f"the form of the term{'s' if len(names) > 1 else ''} of {join_words(names)} was selected "
        f"from these data. No other form was tried, because {why}. All intervals hold for this "
        "form alone. Remedy: fit other forms of it, too, and compare the parameters. Where the "
        "form is known from elsewhere, leave out `selected`.",
    )


def _is_moved(row: ParameterBias) -> bool:
    """Return whether a bias is more than rounding."""
    return abs(row.value) > 0 and (row.errors is None or row.errors > _ROUNDING)


def _warning(
    rivals: Sequence[RivalForm],
    names: Sequence[str],
    value: Vector,
    moved: np.ndarray,
    std: Vector,
) -> Warning | None:
    """Return the warning that other forms imply other values; None where they do not."""
    size = np.abs(moved).max(axis=0) / np.where(std > 0, std, np.inf)
    large = [i for i in np.argsort(-size) if size[i] > 1]
    if not large:
        return None
    parameters = list(dict.fromkeys(rival.parameter for rival in rivals))
    forms = list(dict.fromkeys(rival.name for rival in rivals))
    implied = np.vstack([value, value - moved])
    reach = [
        f"{names[i]} from {implied[:, i].min():.4g} to {implied[:, i].max():.4g}"
        for i in large[:_LISTED]
    ]
    whose = f"the term{'s' if len(parameters) > 1 else ''} of {join_words(parameters)}"
    first = f" {rivals[0].name} fits clearly better." if rivals[0].rise < -AS_LIKELY else ""
    return Warning(
        "rival_forms",
        f"the form of {whose} was selected from these data, and {_some(forms)} "
        f"fit{'s' if len(forms) == 1 else ''} as well: with these forms {join_words(reach)}. The "
        "standard errors hold for the selected form alone, the intervals with the bias for all of "
        f"these.{first} Remedy: data over a wider range. Where the form is known from elsewhere, "
        "leave out `selected`.",
    )


def _some(forms: Sequence[str]) -> str:
    """Return the first forms in words, and how many more there are."""
    return first_words(forms, _LISTED) if len(forms) > _LISTED else join_words(forms)
