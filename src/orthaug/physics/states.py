"""States and outputs of a motion as declared, and the origin of its functions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from orthaug._base.checks import nearest
from orthaug._base.errors import InputError

_DERIVATIVE = "derivative of "


@runtime_checkable
class Origin(Protocol):
    """Origin of a motion's functions; `physics.sources` has them."""

    @property
    def compiled(self) -> bool:
        """True if the functions are JAX's; others are calls of the host at every point."""
        ...

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that it reads."""
        ...

    def keys(self) -> dict[str, Any]:
        """Return the keys of its declaration, as a saved model has them."""
        ...


@dataclass(frozen=True)
class State:
    """A state and its equation: `State("v", "(force - c*v)/m", start="derivative of position")`.

    Args:
        derivative: in time, of a discrete motion the state one sample later; None where the motion
            is a function.
        start: a first guess, for starts are always estimated: a number, an output, "derivative of"
            one, or None.
        learned: whether the learner is added to this equation.
        unit: of the state, such as "m/s".
        memory: whether it is a state of the learner, not of the physics (`physics.learner_states`).
    """

    name: str
    derivative: str | None = None
    start: float | str | None = None
    learned: bool = False
    unit: str = ""
    memory: bool = False

    @property
    def from_output(self) -> tuple[str, int] | None:
        """The output that the state starts from, and how often that is differentiated."""
        if not isinstance(self.start, str):
            return None
        return (
            (self.start[len(_DERIVATIVE) :].strip(), 1)
            if self.start.startswith(_DERIVATIVE)
            else (self.start, 0)
        )


@dataclass(frozen=True)
class Output:
    """An output channel, such as `Output("position", "x")`.

    Args:
        expression: of states, inputs and parameters; None where the motion is a function.
        learned: whether the learner is added to it: a sensor's curve, rather than a force that is
            missing.
    """

    name: str
    expression: str | None = None
    learned: bool = False


def check_given(given: Iterable[str], outputs: Sequence[str]) -> None:
    """Raise InputError for an output of a motion that is none of the data's."""
    for name in given:
        if name not in outputs:
            hint = nearest(name, outputs) or f"; its outputs are {', '.join(outputs)}."
            raise InputError(
                f"the motion gives the output '{name}', which the data do not have{hint}"
            )
