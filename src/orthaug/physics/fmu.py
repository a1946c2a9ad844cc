"""Physics in a Functional Mock-up Unit: FMI 2.0 and 3.0, Model Exchange.

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
from orthaug.physics.model_exchange import Evaluation, Unit, open_unit
from orthaug.physics.sources import Description, FileSource, Functions, Quantity, Seen

_REAL = ("Real", "Float64")  # types of variables of FMI 2.0 and 3.0


@dataclass(frozen=True, kw_only=True)
class FMU(FileSource):
    """The equations of an FMU for Model Exchange, FMI 2.0 or 3.0: ẋ and outputs at points.

    Derivatives by states and inputs are the FMU's own where it provides them, otherwise central
    differences; those by parameters are differences. Time is 0, and the FMU must not use it.
    Relations, such as the sign of a speed, are evaluated anew at every point.

    Args:
        file, parameters, inputs, outputs, starts, learned: as of a `FileSource`.
        integrator, substeps, hold: of the motion.

    Examples:
        `oa.estimate(record, oa.FMU(file="model.fmu", parameters=("m", "c")), learner=None)`
    """

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

    def describe(self) -> Description:
        states = tuple(_quantity(v) for v in self.unit.states)
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
        f, h = (Evaluation(self.unit, p, u, of) for of in (None, y))
        self._check(f)
        states = [state.name for state in self.unit.states]
        if set(outputs) <= {*states}:
            return Points(f), Seen(tuple(states.index(name) for name in outputs))
        return Points(f), Points(h)

    def _check(self, f: Evaluation) -> None:
        """Raise InputError where the FMU does not run, or its equations depend on the time."""
        now, later = (f.at_start(time) for time in (0.0, 1000.1))
        if (now != later).any():
            raise InputError(
                f"{self.file}: its equations depend on the time; give what does as an input."
            )

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
