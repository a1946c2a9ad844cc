"""Physics with terms added to it, as a declaration and as lines of a spec."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orthaug._base.checks import Vector
from orthaug.data.expressions import FUNCTIONS, SAMPLING_TIME, Expression
from orthaug.data.writing import coefficient_unit
from orthaug.physics.baseline import Baseline, Term
from orthaug.physics.motion import Motion
from orthaug.physics.parameters import PhysicalParameter

_DIVIDED = re.compile(r"\((?P<inner>.+)\)\s*/\s*(?P<by>[A-Za-z_]\w*)")


@dataclass(frozen=True)
class NewTerm:
    """A term to be added: its parameter's `name`, the `text` with its `width` as a number, and where it goes.

    `scale` is the expression whose unit the term has; None for one by which no unit is told. `template` has `{width}`
    where the width stands, None without one.
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


def names_for(kinds: Sequence[str], taken: Sequence[str]) -> list[str]:
    """A parameter's name for each kind of term, none of which is taken."""
    used, names = {*taken, *FUNCTIONS, SAMPLING_TIME, "k"}, []
    for kind in kinds:
        name, number = kind, 1
        while name in used:
            number += 1
            name = f"{kind}{number}"
        used.add(name)
        names.append(name)
    return names


def added_to_baseline(baseline: Baseline, values: Vector, added: Sequence[NewTerm], several: bool) -> Baseline | None:
    """A baseline with terms, starting from these parameter values; None if it is a function."""
    if baseline.function is not None:
        return None
    low, high = baseline.bounds
    start = dict(zip(baseline.names, np.clip(values, low, high), strict=True))
    old = [term if term.fixed else replace(term, initial=float(start[term.parameter])) for term in baseline.terms]
    new = [
        Term(one.name, one.text, initial=one.coefficient, unit=one.unit or "", output=one.added_to if several else None)
        for one in added
    ]
    return Baseline.from_terms([*old, *new], dict(baseline.constants))


def baseline_lines(added: Sequence[NewTerm], several: bool) -> str:
    """The terms as tables of a spec."""
    blocks = []
    for one in added:
        entries = {"parameter": one.name, "regressor": one.text, "initial": _short(one.coefficient)}
        entries |= {"unit": one.unit} if one.unit else {}
        entries |= {"output": one.added_to} if several else {}
        blocks.append("\n".join(["[[baseline.terms]]", *(f"{key} = {_toml(value)}" for key, value in entries.items())]))
    return "\n\n".join(blocks)


@dataclass(frozen=True, eq=False)
class ChangedMotion:
    """A motion with terms added to its equations, the new parameters, and the equations that changed by their keys."""

    motion: Motion
    parameters: tuple[PhysicalParameter, ...]
    equations: tuple[tuple[str, str, str], ...]

    def lines(self) -> str:
        """What to change in a spec."""
        blocks = [f"[{table}]\n{key} = {_toml(text)}" for table, key, text in self.equations]
        rows = []
        for one in self.parameters:
            entries = {"initial": _short(one.initial)} | ({"unit": one.unit} if one.unit else {})
            entries |= {"min": one.min} if np.isfinite(one.min) else {}
            rows.append(f"{one.name} = {{ {', '.join(f'{key} = {_toml(value)}' for key, value in entries.items())} }}")
        return "\n\n".join([*blocks, "\n".join(["[motion.parameters]", *rows])])


def added_to_motion(motion: Motion, values: Vector, added: Sequence[NewTerm], units: dict[str, str]) -> Any:
    """A `ChangedMotion` that starts from these parameter values; None if the equations are functions.

    A term of an equation `(…)/m` goes inside, so that its coefficient is a force. A width becomes a parameter.
    """
    if motion.functions is not None:
        return None
    start = dict(zip(motion.names, values, strict=True))
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
        if inside and _balanced(inside["inner"]) and inside["by"] in start:
            coefficient, unit = coefficient * start[inside["by"]], _unit_inside(inside["inner"], one, units)
        sign, factor = ("-", -1.0) if coefficient < 0 else ("+", 1.0)
        summand = f" {sign} {one.name}" + ("" if product == "1" else f"*{_closed(product)}")
        if inside and _balanced(inside["inner"]) and inside["by"] in start:
            texts[one.added_to] = f"({inside['inner']}{summand})/{inside['by']}"
        else:
            texts[one.added_to] = f"{text}{summand}"
        new.append(PhysicalParameter(one.name, factor * coefficient, unit or ""))
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
    own = "next" if motion.integrator == "discrete" else "derivative"
    states = {state.name for state in motion.states}
    places = dict.fromkeys(one.added_to for one in added)
    equations = tuple(
        (f"motion.states.{name}", own, texts[name])
        if name in states
        else (f"motion.outputs.{name}", "expression", texts[name])
        for name in places
    )
    return ChangedMotion(changed, tuple(new), equations)


def _unit_inside(inner: str, added: NewTerm, units: dict[str, str]) -> str:
    """The unit of a term's coefficient within a sum; none where the sum's or the term's is not told."""
    unit = _unit_of_first(inner, units)
    if not unit or added.scale is None:
        return unit
    return coefficient_unit(unit, added.scale, units) or ""


def _unit_of_first(inner: str, units: dict[str, str]) -> str:
    """The unit of a sum by its first summand, where that is a name with a unit."""
    first = re.match(r"\s*([A-Za-z_]\w*)\s*(?=[-+]|$)", inner)
    return units.get(first[1], "") if first else ""


def _closed(text: str) -> str:
    depth = 0
    for i, character in enumerate(text):
        depth += (character in "([") - (character in ")]")
        if depth == 0 and character in "+-" and text[i - 1 : i] not in ("e", "*", "("):
            return f"({text})"
    return text


def _balanced(text: str) -> bool:
    depth = 0
    for character in text:
        depth += (character == "(") - (character == ")")
        if depth < 0:
            return False
    return depth == 0


def _short(value: float) -> float:
    """Six digits: more the learner does not tell."""
    return float(f"{value:.6g}")


def _toml(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else repr(value)
