"""Units of parameters as their regressors ask for them: that of the output over that of the term."""

from __future__ import annotations

from collections.abc import Sequence

from orthaug.data.expressions import parse
from orthaug.data.record import Channel
from orthaug.data.writing import coefficient_unit
from orthaug.physics.baseline import Baseline


def derived_units(baseline: Baseline, outputs: Sequence[Channel], inputs: Sequence[Channel]) -> dict[str, str]:
    """The unit of each parameter by its name, "1" where it has none; without those that the channels do not tell.

    Examples:
        >>> from orthaug.physics.baseline import Term
        >>> spring = Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "u[k-1]")])
        >>> derived_units(spring, [Channel("y", "mm")], [Channel("u", "N")])
        {'a': '1', 'b': 'mm/N'}
    """
    units, constants = {channel.name: channel.unit for channel in (*outputs, *inputs)}, dict(baseline.constants)
    found: dict[str, set[str | None]] = {}
    for term in baseline.terms:
        own = units[term.output or outputs[0].name]
        told = coefficient_unit(own, parse(term.regressor, constants), units) if own else None
        found.setdefault(term.parameter, set()).add("1" if told == "" else told)
    agreed = {name: next(iter(told)) for name, told in found.items() if len(told) == 1}
    return {name: unit for name, unit in agreed.items() if unit is not None}
