"""The verb `explain`: terms that a learner has found, their share, and the lines of a new spec."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import singledispatch
from typing import Any

import numpy as np

from orthaug._base.checks import Vector, check_count, check_type, is_number
from orthaug._base.errors import InputError, Warning, show
from orthaug._base.lines import percent
from orthaug.analysis.suspects import MotionSuspect, Suspect
from orthaug.data.expressions import FUNCTIONS, SAMPLING_TIME, Expression
from orthaug.data.record import Record
from orthaug.data.spec_lines import toml_value
from orthaug.data.terms import CONSTANT
from orthaug.data.writing import coefficient_unit
from orthaug.models.model import Model
from orthaug.physics.baseline import Baseline, Term
from orthaug.physics.motion import Motion
from orthaug.physics.parameters import PhysicalParameter
from orthaug.selection.explaining import (
    TERM,
    Candidate,
    Fit,
    Space,
    candidates_of,
    check_products,
    nearest_twins,
    rivals,
    select,
    settle_terms,
    single_terms,
)
from orthaug.selection.learned_linearization import (
    LearnedLinearization,
    linearization_of,
    signals_seen,
)

_DIVIDED = re.compile(r"\((?P<inner>.+)\)\s*/\s*(?P<by>[A-Za-z_]\w*)")


@dataclass(frozen=True)
class NewTerm:
    """A term to add: its parameter's `name`, the `text` with its `width` as a number, its place.

    `scale` is the expression whose unit the term has; None for one without a known unit.
    `template` has `{width}` in the width's place, None without one.
    """

    name: str
    text: str
    added_to: str
    coefficient: float
    unit: str | None
    width: float | None = None
    width_unit: str | None = None
    template: str | None = None
    scale: Expression | None = None

    @property
    def selected(self) -> bool:
        """True for a form that others could replace; a constant has no other form."""
        return self.text != CONSTANT


def names_for(kinds: Sequence[str], taken: Sequence[str]) -> list[str]:
    """Return a parameter's name for each kind of term, none of which is taken."""
    used, names = {*taken, *FUNCTIONS, SAMPLING_TIME, "k"}, []
    for kind in kinds:
        name, number = kind, 1
        while name in used:
            number += 1
            name = f"{kind}{number}"
        used.add(name)
        names.append(name)
    return names


def added_to_baseline(
    baseline: Baseline, values: Vector, added: Sequence[NewTerm], several: bool
) -> Baseline | None:
    """Return a baseline with terms, starting from these parameter values.

    None if it is a function.
    """
    if baseline.function is not None:
        return None
    low, high = baseline.bounds
    start = dict(zip(baseline.names, np.clip(values, low, high), strict=True))
    old = [
        term if term.fixed else replace(term, initial=float(start[term.parameter]))
        for term in baseline.terms
    ]
    new = [
        Term(
            one.name,
            one.text,
            initial=one.coefficient,
            unit=one.unit or "",
            output=one.added_to if several else None,
            selected=one.selected,
        )
        for one in added
    ]
    return Baseline.from_terms([*old, *new], dict(baseline.constants))


def baseline_lines(added: Sequence[NewTerm], several: bool) -> str:
    """Return the terms as tables of a spec."""
    blocks = []
    for one in added:
        entries = {"parameter": one.name, "regressor": one.text, "initial": _short(one.coefficient)}
        entries |= {"unit": one.unit} if one.unit else {}
        entries |= {"output": one.added_to} if several else {}
        entries |= {"selected": True} if one.selected else {}
        blocks.append(
            "\n".join(
                [
                    "[[baseline.terms]]",
                    *(f"{key} = {toml_value(value)}" for key, value in entries.items()),
                ]
            )
        )
    return "\n\n".join(blocks)


@dataclass(frozen=True, eq=False)
class ChangedMotion:
    """A motion with added terms, the new parameters, and the changed equations by their keys."""

    motion: Motion
    parameters: tuple[PhysicalParameter, ...]
    equations: tuple[tuple[str, str, str], ...]

    def lines(self) -> str:
        """Return the lines to change in a spec."""
        blocks = [f"[{table}]\n{key} = {toml_value(text)}" for table, key, text in self.equations]
        rows = []
        for one in self.parameters:
            entries = {"initial": _short(one.initial)} | ({"unit": one.unit} if one.unit else {})
            entries |= {"min": one.min} if np.isfinite(one.min) else {}
            entries |= {"selected": True} if one.selected else {}
            rows.append(
                f"{one.name} = {{ "
                f"{', '.join(f'{key} = {toml_value(value)}' for key, value in entries.items())} }}"
            )
        return "\n\n".join([*blocks, "\n".join(["[motion.parameters]", *rows])])


def added_to_motion(
    motion: Motion, values: Vector, added: Sequence[NewTerm], units: dict[str, str]
) -> Any:
    """Return a `ChangedMotion` that starts from these parameter values.

    None if the equations are functions.

    A term of an equation `(…)/m` goes inside, so that its coefficient is a force. A width becomes a
    parameter.
    """
    if motion.functions is not None:
        return None
    loop, motion = motion, motion.plant
    start = dict(zip(loop.names, values, strict=True))
    texts = {state.name: str(state.derivative) for state in motion.states}
    texts |= {output.name: str(output.expression) for output in motion.outputs}
    new: list[PhysicalParameter] = []
    taken = [*motion.known, *(one.name for one in added)]
    for one in added:
        text, unit, coefficient = texts[one.added_to], one.unit, one.coefficient
        product = one.text
        if one.template is not None and one.width is not None:
            width = names_for([f"{one.name}_width"], taken)[0]
            new.append(PhysicalParameter(width, float(one.width), one.width_unit or "", min=0))
            product = one.template.format(width=width)
        inside = _DIVIDED.fullmatch(text.strip())
        if inside and _is_balanced(inside["inner"]) and inside["by"] in start:
            coefficient, unit = (
                coefficient * start[inside["by"]],
                _unit_inside(inside["inner"], one, units),
            )
        sign, factor = ("-", -1.0) if coefficient < 0 else ("+", 1.0)
        summand = f" {sign} {one.name}" + (
            "" if product == "1" else f"*{_close_parentheses(product)}"
        )
        if inside and _is_balanced(inside["inner"]) and inside["by"] in start:
            texts[one.added_to] = f"({inside['inner']}{summand})/{inside['by']}"
        else:
            texts[one.added_to] = f"{text}{summand}"
        start_value = factor * coefficient
        new.append(PhysicalParameter(one.name, start_value, unit or "", selected=one.selected))
    changed = Motion.from_equations(
        states=[replace(state, derivative=texts[state.name]) for state in motion.states],
        outputs=[replace(output, expression=texts[output.name]) for output in motion.outputs],
        parameters=[*(replace(p, initial=float(start[p.name])) for p in motion.parameters), *new],
        inputs=motion.inputs,
        constants=dict(motion.constants),
        define={name: str(expression) for name, expression in motion.definitions},
        integrator=motion.integrator,
        substeps=motion.substeps,
        hold=motion.hold,
    )
    states = {state.name for state in motion.states}
    places = dict.fromkeys(one.added_to for one in added)
    equations = tuple(
        (f"motion.states.{name}", motion.equation_key, texts[name])
        if name in states
        else (f"motion.outputs.{name}", "expression", texts[name])
        for name in places
    )
    return ChangedMotion(loop.around(changed), tuple(new), equations)


def _unit_inside(inner: str, added: NewTerm, units: dict[str, str]) -> str:
    """Return the unit of a term's coefficient within a sum.

    None where the sum's or the term's is unknown.
    """
    unit = _unit_of_first(inner, units)
    if not unit or added.scale is None:
        return unit
    return coefficient_unit(unit, added.scale, units) or ""


def _unit_of_first(inner: str, units: dict[str, str]) -> str:
    """Return the unit of a sum by its first summand, where that is a name with a unit."""
    first = re.match(r"\s*([A-Za-z_]\w*)\s*(?=[-+]|$)", inner)
    return units.get(first[1], "") if first else ""


def _close_parentheses(text: str) -> str:
    depth = 0
    for i, character in enumerate(text):
        depth += (character in "([") - (character in ")]")
        if depth == 0 and character in "+-" and text[i - 1 : i] not in ("e", "*", "("):
            return f"({text})"
    return text


def _is_balanced(text: str) -> bool:
    depth = 0
    for character in text:
        depth += (character == "(") - (character == ")")
        if depth < 0:
            return False
    return depth == 0


def _short(value: float) -> float:
    """Return the value to six digits, as accurate as the learner is."""
    return float(f"{value:.6g}")


LEAST = 0.005
_HALF = 0.5  # of the learner, less its own errors: terms that explain less are none to be added
_LEVEL = 0.01  # at which the learner is something beside its own errors
_ENDED = ("converged", "exact")
_SHOWN = 8  # terms, each as the only one
_OUTSIDE = 0.05  # share of rows beyond the training data that is reported
_CONDITIONAL = (
    "the terms were chosen on these data. Intervals of a fit of these terms to the same data "
    "are conditional on the choice; those of a fit to other data are not."
)
_NAMES = {
    "coulomb": "coulomb",
    "quadratic_drag": "drag",
    "stribeck_gauss": "stribeck",
    "tanh": "friction",
    "atan": "friction",
    TERM: "term",
}
# Of an input, such as a valve, the same functions are no friction
_OF_INPUTS = {
    "coulomb": "jump",
    "stribeck": "peak",
    "stribeck_gauss": "peak",
    "tanh": "bend",
    "atan": "bend",
}


@dataclass(frozen=True)
class ExplainingTerm:
    """A term to add to the physics.

    `coefficient` is in `unit`, None where that is unknown; `std` is its standard error by the
    learner's, None if not known. `share` is what it adds to the terms before it, `alone` what it
    explains as the only one. `rivals` would explain nearly as much in its place.
    """

    parameter: str
    expression: str
    kind: str
    on: str | None
    width: float | None
    added_to: str
    coefficient: float
    unit: str | None
    std: float | None
    share: float
    alone: float
    rivals: tuple[str, ...]


@dataclass(frozen=True)
class SingleTerm:
    """A term that was looked at, and the share of the learner that it explains as the only one."""

    name: str
    expression: str
    added_to: str
    share: float


@dataclass(frozen=True)
class MovedParameter:
    """A parameter of the physics now, and with the terms in it."""

    name: str
    unit: str
    value: float
    value_with: float


@dataclass(frozen=True, eq=False)
class Explanation:
    """Terms that a learner has found.

    `share` is what the `terms` explain together of the mean square that the learner adds beside the
    physics, `noise` the share that is its own error as far as training shows, `p` that of the
    learner being nothing else; None if not known. `physics` is the baseline or motion with the
    terms added, None where there are none or it is a function; `spec` the same as lines of a spec
    file.
    """

    terms: tuple[ExplainingTerm, ...]
    share: float
    noise: float | None
    p: float | None
    singles: tuple[SingleTerm, ...]
    parameters: tuple[MovedParameter, ...]
    physics: Baseline | Motion | None
    spec: str | None
    points: int
    text: str
    warnings: tuple[Warning, ...]

    @property
    def found(self) -> bool:
        """True if there are terms to add."""
        return bool(self.terms)

    def __repr__(self) -> str:
        return f"Explanation({self.text})"


def explain(
    model: Any,
    record: Record | None = None,
    *,
    suspects: Sequence[Suspect | MotionSuspect] = (),
    degree: int = 3,
    functions: Sequence[str] = (),
    most: int = 6,
    least: float = LEAST,
) -> Explanation:
    """Find the terms that a learner holds: its output over a record on suspects and products.

    Friction with a jump or smooth, drag, hardening, dead zones and saturations of everything that
    the learner sees are tried, and products of it. Each is taken as the learner would show it, for
    a smooth one shows no jumps (`selection.as_shown`).

    Args:
        model: a model with a learner, or what `estimate` returned.
        record: best the one that it was trained on; may be left out for an estimate. Outputs are
            needed but for a motion, whose free run then starts from 0.
        suspects: further terms to try.
        degree, functions: of the products, as in `Terms`.
        most: terms at most.
        least: share of the learner that each term must explain beside all others.

    Raises:
        InputError: no learner, other channels, suspects that cannot be read, too many candidates.
    """
    fit = model
    if not isinstance(model, Model):
        model = getattr(fit, "model", None)
        if not isinstance(model, Model):
            raise InputError(
                f"`model` must be a model or what `estimate` returns; got {show(fit)}."
            )
        record = (
            getattr(getattr(fit, "problem", None), "record", None) if record is None else record
        )
    check_type(record, Record, "record", "the Record that the model was trained on")
    assert record is not None
    degree, most = (
        check_count(degree, "degree", of="factors"),
        check_count(most, "most", of="terms"),
    )
    if not is_number(least) or not 0 < least < 1:
        raise InputError(f"`least` must be a share between 0 and 1; got {show(least)}.")
    if isinstance(functions, str) or any(not isinstance(name, str) for name in functions):
        raise InputError(
            f"`functions` must be a list of names, such as ['abs']; got {show(functions)}."
        )
    if model.learns:
        check_products(len(signals_seen(model)), degree, functions, model.form.bound.ny)
    linearization = linearization_of(model, record)
    space = Space.of(
        linearization,
        candidates_of(
            linearization, degree, functions, _declared_expressions(suspects, linearization)
        ),
    )
    chosen, fitted, dropped = settle_terms(space, select(space, most, least))
    chosen, fitted = nearest_twins(space, chosen, fitted)
    explanation = _explanation(space, chosen, fitted, dropped)
    code = getattr(getattr(fit, "status", None), "code", "converged")
    if code not in _ENDED:
        text = (
            "training did not end at a minimum, so the terms that the learner shows may be "
            "distorted; train longer."
        )
        explanation = replace(
            explanation, warnings=(*explanation.warnings, Warning("not_converged", text))
        )
    return explanation


def _declared_expressions(
    suspects: Sequence[Any], linearization: LearnedLinearization
) -> list[tuple[str, int]]:
    """Return expressions of suspects with the number of their output or equation."""
    names, found = [name for name, _ in linearization.places], []
    for suspect in suspects:
        check_type(
            suspect,
            Suspect | MotionSuspect,
            "suspects",
            "a list of Suspects, or of MotionSuspects of a motion",
        )
        where = suspect.equation or suspect.output
        if where is not None and where not in names:
            raise InputError(
                f"suspect '{suspect.name}': the learner adds nothing to '{where}', but to "
                f"{', '.join(names)}."
            )
        linearization.evaluate(linearization.parse(suspect.expression))
        found.append((suspect.expression, 0 if where is None else names.index(where)))
    return found


def _explanation(space: Space, chosen: list[Candidate], fitted: Fit, dropped: bool) -> Explanation:
    linearization, noise, p = space.linearization, None, space.shown.p
    if space.shown.covariance is not None and space.norm > 0:
        noise = min(float(np.trace(space.shown.covariance)) / space.norm**2, 1.0)
    singles = tuple(
        SingleTerm(one.name, one.text, linearization.places[one.place][0], share)
        for one, share in single_terms(space, _SHOWN)
    )
    share = space.explained_share([space.column(one) for one in chosen])
    real = p is None or p < _LEVEL
    if space.empty or not real or share < _HALF * (1 - (noise or 0.0)):
        chosen, text = [], _why_nothing(space, real, dropped, share, singles)
    terms = _terms(space, chosen, fitted)
    moved = linearization.moved(fitted.along) if chosen else linearization.values
    parameters = tuple(
        MovedParameter(p.name, p.unit, float(now), float(then))
        for p, now, then in zip(linearization.parameters, linearization.values, moved, strict=True)
    )
    physics, spec = _physics(linearization, terms, moved) if terms else (None, None)
    share = share if chosen else 0.0
    if terms:
        places = len(linearization.places)
        names = [_placed(term.expression, term.added_to, places) for term in terms]
        named = " and ".join(names) if len(terms) < 3 else ""
        what = named or f"{len(terms)} terms"
        verb = "explains" if len(terms) == 1 else "explain"
        text = f"{what} {verb} {percent(share, 3)} of what the learner adds beside the physics."
    warnings = []
    if linearization.outside > _OUTSIDE:
        reach = (
            f"{100 * linearization.outside:.0f} % of the rows lie beyond what the learner saw "
            "in training"
        )
        warnings.append(Warning("beyond_training", f"{reach}: its values there are extrapolated."))
    if terms:
        warnings.append(Warning("conditional_on_selection", _CONDITIONAL))
    points = len(linearization.target)
    return Explanation(
        terms, share, noise, p, singles, parameters, physics, spec, points, text, tuple(warnings)
    )


def _placed(expression: str, added_to: str, places: int) -> str:
    """Return a term with the equation that it is added to, where there are several of them."""
    return expression if places == 1 else f"{expression} in {added_to}"


def _why_nothing(
    space: Space, real: bool, dropped: bool, share: float, singles: Sequence[SingleTerm]
) -> str:
    if not space.target.any():
        return (
            "the learner adds nothing over these data that the physics could not express; "
            "there is nothing to explain."
        )
    if not space.candidates:
        return "nothing explains the learner: the physics expresses all candidate terms already."
    if not real:
        return (
            "what the learner adds is not significant against its own errors; there is nothing "
            "to explain."
        )
    best = _placed(singles[0].expression, singles[0].added_to, len(space.linearization.places))
    best = f"the best single term, {best}, explains {percent(singles[0].share)} of it"
    if dropped and share < _HALF:
        return f"no term is significant against the learner's own errors; {best}. Keep the learner."
    return (
        f"a few terms explain less than half of what the learner adds; {best}. Keep the "
        "learner, or try other suspects."
    )


def _terms(space: Space, chosen: Sequence[Candidate], fitted: Fit) -> tuple[ExplainingTerm, ...]:
    linearization, before, found = space.linearization, 0.0, []
    taken = [*linearization.units, *(p.name for p in linearization.parameters)]
    taken += linearization.physics.names_taken
    inputs = getattr(linearization.physics, "inputs", ())
    names = names_for([_base_name(one, inputs) for one in chosen], taken)
    columns = [space.column(one) for one in chosen]
    std = (
        None if fitted.covariance is None else np.sqrt(np.maximum(np.diag(fitted.covariance), 0.0))
    )
    for i, one in enumerate(chosen):
        place, unit = linearization.places[one.place]
        whole = space.explained_share(columns[: i + 1])
        scale = _scale(one.kind, one.on, one.text)
        found.append(
            ExplainingTerm(
                parameter=names[i],
                expression=one.text,
                kind=one.kind,
                on=one.on,
                width=one.width,
                added_to=place,
                coefficient=float(fitted.coefficients[i]),
                unit=coefficient_unit(unit, linearization.parse(scale), linearization.units),
                std=None if std is None else float(std[i]),
                share=whole - before,
                alone=space.explained_share([columns[i]]),
                rivals=rivals(space, chosen, i),
            )
        )
        before = whole
    return tuple(found)


def _scale(kind: str, on: str | None, text: str) -> str:
    """Return the expression whose unit a term has."""
    return on if kind in ("dead_zone", "saturation") and on is not None else text


def _base_name(candidate: Candidate, inputs: Sequence[str]) -> str:
    if candidate.on in inputs and candidate.kind in _OF_INPUTS:
        return _OF_INPUTS[candidate.kind]
    return "offset" if candidate.text == CONSTANT else _NAMES.get(candidate.kind, candidate.kind)


def _physics(
    linearization: LearnedLinearization, terms: Sequence[ExplainingTerm], moved: Vector
) -> tuple[Baseline | Motion | None, str | None]:
    """Return the physics with the terms added, and the lines that say so in a spec."""
    added = [_new_term(linearization, term) for term in terms]
    return _with_terms(linearization.physics, linearization, moved, added)


@singledispatch
def _with_terms(
    physics: Any, linearization: LearnedLinearization, moved: Any, added: Sequence[NewTerm]
) -> tuple[Baseline | Motion | None, str | None]:
    """Return physics of a kind with terms, and the lines of a spec."""
    raise NotImplementedError


@_with_terms.register(Motion)
def _motion_with_terms(
    physics: Motion, linearization: LearnedLinearization, moved: Vector, added: Sequence[NewTerm]
) -> tuple[Motion | None, str | None]:
    changed = added_to_motion(physics, moved, added, linearization.units)
    return (None, None) if changed is None else (changed.motion, changed.lines())


@_with_terms.register(Baseline)
def _baseline_with_terms(
    physics: Baseline, linearization: LearnedLinearization, moved: Vector, added: Sequence[NewTerm]
) -> tuple[Baseline | None, str | None]:
    several = len(linearization.places) > 1
    baseline = added_to_baseline(physics, moved, added, several)
    return (None, None) if baseline is None else (baseline, baseline_lines(added, several))


def _new_term(linearization: LearnedLinearization, term: ExplainingTerm) -> NewTerm:
    template = unit = None
    if term.width is not None:
        template = term.expression.replace(repr(term.width), "{width}")
        unit = coefficient_unit("1", linearization.parse(str(term.on)), linearization.units)
        unit = None if unit is None else linearization.units.get(str(term.on), "")
    where = (term.added_to, term.coefficient, term.unit)
    scale = linearization.parse(_scale(term.kind, term.on, term.expression))
    return NewTerm(term.parameter, term.expression, *where, term.width, unit, template, scale)
