"""Physics in a Functional Mock-up Unit: FMI 2.0 and 3.0, Model Exchange or co-simulation.

An FMU holds native code: to evaluate it is to run it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar
from xml.sax.saxutils import quoteattr

from orthaug._base.errors import InputError
from orthaug.physics.black_box import Points
from orthaug.physics.consent import CONSENTS
from orthaug.physics.fmu_points import Evaluation, Steps
from orthaug.physics.fmu_units import Unit, open_unit
from orthaug.physics.sources import Description, FileSource, Functions, Quantity, Seen

_REAL = ("Real", "Float64")  # types of variables of FMI 2.0 and 3.0


@dataclass(frozen=True, kw_only=True)
class FMU(FileSource):
    """The equations of an FMU for Model Exchange, FMI 2.0 or 3.0: ẋ and outputs at points.

    Derivatives by states and inputs are the FMU's own where it provides them, otherwise central
    differences; those by parameters are differences. Time is 0, and the FMU must not use it.
    Relations, such as the sign of a speed, are evaluated anew at every point.

    One for co-simulation alone is a discrete motion: `x⁺` is what it makes of x in one sample, by
    its own solver, and all slopes are differences. It is begun anew for every step, so its states
    must be variables that can be set, and all that it remembers.

    Args:
        file, parameters, inputs, outputs, starts, learned: as of a `FileSource`.
        states: variables that are its states, where an FMU for co-simulation does not list them.
        integrator, substeps, hold: of the motion.

    Examples:
        `oa.estimate(record, oa.FMU(file="model.fmu", parameters=("m", "c")), learner=None)`
    """

    states: tuple[str, ...] = ()

    ending: ClassVar[str] = ".fmu"
    native: ClassVar[bool] = True
    target: ClassVar[str] = "fmu-parameters"

    @property
    def compiled(self) -> bool:
        return False

    @cached_property
    def unit(self) -> Unit:
        """The FMU, unpacked."""
        return open_unit(self.file, self.content, self.sha256)

    @property
    def options(self) -> dict[str, Any]:
        own = super().options
        if not self.unit.advances:
            return own
        if self.integrator not in ("auto", "discrete"):
            raise InputError(
                f"{self.file}: an FMU for co-simulation integrates by itself; leave `integrator` "
                "out."
            )
        return own | {"integrator": "discrete"}

    @cached_property
    def _states(self) -> tuple[Any, ...]:
        """Variables that are states: those of the description, or the ones named.

        Raises:
            InputError: none, or names that are no variables of an FMU for co-simulation.
        """
        if self.states and not self.unit.advances:
            raise InputError(
                f"{self.file}: the states of an FMU for Model Exchange are those of its "
                "description; leave `states` out."
            )
        if not (self.states or self.unit.states):
            raise InputError(
                f"{self.file}: an FMU for co-simulation only, whose description lists no states; "
                "name in `states` the variables that hold them, or export it for Model Exchange."
            )
        named = {v.name: v for v in self.unit.description.modelVariables if v.type in _REAL}
        known = [_quantity(v) for v in named.values()]
        found = (self.find(name, known, "variable").name for name in self.states)
        return tuple(named[name] for name in found) or self.unit.states

    def describe(self) -> Description:
        states = tuple(_quantity(v) for v in self._states)
        own = {s.name: s for s in states}
        variables = [
            v for v in self.unit.description.modelVariables if v.type in _REAL and not v.dimensions
        ]
        return Description(
            states,
            tuple(_quantity(v) for v in variables if v.causality == "parameter"),
            tuple(_quantity(v) for v in variables if v.causality == "input"),
            tuple(
                own.get(v.name, _quantity(v))
                for v in variables
                if v.variability not in ("constant", "fixed", "tunable")
                and v.causality not in ("input", "independent")
            ),
        )

    def functions(
        self, parameters: Sequence[str], inputs: Sequence[str], outputs: Sequence[str]
    ) -> Functions:
        CONSENTS.give(self.sha256)  # whoever names an FMU wants it to run
        names = {v.name: v.valueReference for v in self.unit.description.modelVariables}
        p, u, y = (tuple(names[n] for n in group) for group in (parameters, inputs, outputs))
        x = tuple(state.valueReference for state in self._states)
        kind = Steps if self.unit.advances else Evaluation
        f, h = (kind(self.unit, x, p, u, of) for of in (None, y))
        f.check()
        states = [state.name for state in self._states]
        if set(outputs) <= {*states}:
            return Points(f), Seen(tuple(states.index(name) for name in outputs))
        return Points(f), Points(h)

    def written(self, values: Mapping[str, float]) -> dict[str, str]:
        """Return an SSP parameter set (.ssv)."""
        rows = "\n".join(
            f"    <ssv:Parameter name={quoteattr(name)}><ssv:Real value={quoteattr(repr(value))}/>"
            "</ssv:Parameter>"
            for name, value in values.items()
        )
        return {
            "parameters.ssv": (
                '<?xml version="1.0" encoding="UTF-8"?>\n'
                "<ssv:ParameterSet "
                'xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues" '
                f'version="1.0" name="estimates">\n  <ssv:Parameters>\n{rows}\n'
                "  </ssv:Parameters>\n</ssv:ParameterSet>\n"
            ),
        }


def _quantity(variable: Any) -> Quantity:
    declared = variable.declaredType

    def number(key: str) -> float | None:
        given = getattr(variable, key)
        if given is None and declared is not None:
            given = getattr(declared, key, None)
        return None if given is None else float(given)

    unit = variable.unit or (declared.unit if declared is not None else None) or ""
    start = None if variable.start is None else float(variable.start)
    return Quantity(variable.name, unit, start, number("min"), number("max"))
