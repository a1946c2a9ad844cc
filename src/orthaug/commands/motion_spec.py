"""The section [motion] of a spec: equations of motion instead of a baseline."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field, model_validator

from orthaug.commands.sections import Finite, PhysicalSection, Section
from orthaug.physics.motion import HOLDS, INTEGRATORS, MOST_SUBSTEPS, Motion, Output, State

Text = Annotated[str, Field(min_length=1)]


class StateSection(Section):
    """A state: its equation, where it starts, whether a learner is added to the equation."""

    derivative: Text | Finite | None = None
    next: Text | Finite | None = None
    start: Finite | Text | None = None
    learned: bool = False
    unit: str = ""


class OutputSection(Section):
    """An output as an expression of the states, and whether a learner is added to it."""

    expression: Text
    learned: bool = False


class MotionSection(Section):
    """Equations of motion: states, outputs, parameters, and how they are integrated."""

    integrator: Literal[INTEGRATORS] = "rk4"  # type: ignore[valid-type]
    substeps: Literal["auto"] | Annotated[int, Field(ge=1, le=MOST_SUBSTEPS, strict=True)] = "auto"
    hold: Literal[HOLDS] = "zero-order"  # type: ignore[valid-type]
    states: Annotated[dict[str, StateSection], Field(min_length=1)]
    outputs: Annotated[dict[str, Text | OutputSection], Field(min_length=1)]
    parameters: Annotated[dict[str, PhysicalSection], Field(min_length=1)]
    define: dict[str, Text] = {}
    constants: dict[str, Finite] = {}

    @model_validator(mode="after")
    def _check_equations(self) -> MotionSection:
        """Each state has the equation that its integrator reads."""
        discrete = self.integrator == "discrete"
        own, other = ("next", "derivative") if discrete else ("derivative", "next")
        kind = "a discrete motion" if discrete else f'`integrator = "{self.integrator}"`'
        for name, state in self.states.items():
            if getattr(state, other) is not None:
                raise ValueError(f"`states.{name}` has the key `{other}`; {kind} reads `{own}`")
            if getattr(state, own) is None:
                raise ValueError(f"`states.{name}` has no `{own}`; expected its equation")
        return self

    @property
    def learns(self) -> bool:
        """Whether a learner is added to any equation or output."""
        outputs = (output.learned for output in self.outputs.values() if not isinstance(output, str))
        return any(state.learned for state in self.states.values()) or any(outputs)

    def declared(self, inputs: Sequence[str], outputs: Sequence[str]) -> Motion:
        """The motion, its channels in the order of the data.

        Raises:
            InputError: names and expressions that cannot be, and what else `Motion.from_equations` refuses.
        """
        given = {name: OutputSection(expression=o) if isinstance(o, str) else o for name, o in self.outputs.items()}
        known = [*(name for name in outputs if name in given), *(name for name in given if name not in outputs)]
        states = []
        for name, state in self.states.items():
            equation = state.next if self.integrator == "discrete" else state.derivative
            states.append(State(name, str(equation), state.start, state.learned, state.unit))
        return Motion.from_equations(
            states=states,
            outputs=[Output(name, given[name].expression, given[name].learned) for name in known],
            parameters=[section.declared(name) for name, section in self.parameters.items()],
            inputs=inputs,
            constants=self.constants,
            define=self.define,
            integrator=self.integrator,
            substeps=None if self.substeps == "auto" else self.substeps,
            hold=self.hold,
        )
