"""Physics of a motion as nodes: of its expressions, or of its functions, taken apart by tracing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug._base.jax import jnp
from orthaug.export.nodes import Apply, Name, Node, Number, apply, identifier, node_of
from orthaug.models.motion_field import MotionField
from orthaug.physics.motion import Motion
from orthaug.physics.scalar_program import Operation, ScalarProgram, scalar_program
from orthaug.physics.sources import FileSource

_SAME = ("abs", "add", "cos", "div", "exp", "floor", "log", "max", "min", "mul", "neg")
_FUNCTIONS = {name: name for name in (*_SAME, "sign", "sin", "sqrt", "sub", "tan", "tanh")} | {
    "atan2": "atan2",
    "pow": "power",
}
"""Functions of nodes, by JAX's names."""


@dataclass(frozen=True)
class PhysicsNodes:
    """Physics at one point, with some parameters."""

    rates: list[Node]
    outputs: list[Node]
    learned: list[Node]
    """Rows of the learned equations, then of the learned outputs; forces where these are learned.
    """
    responses: list[list[Node]]
    """By how much all rates (nx,) grow with each learned force; empty where there are none."""


@dataclass
class NodesOfMotion:
    """Physics of a motion at points, and with parameters, that are nodes.

    Args:
        form: the motion with its learner.
        numeric: constants by name.
        own: nodes of the parameters beside the learner, those of the mass matrix.
        values: of these parameters, where a condition on them decides.
        symbols: names of the intermediate results for a reader, which are added.

    Raises:
        InputError: functions that cannot be taken apart.
    """

    form: MotionField
    numeric: Mapping[str, float]
    own: Mapping[str, Node]
    values: Mapping[str, float]
    symbols: dict[str, str]
    locals: dict[str, Node] = field(default_factory=dict)
    """Intermediate results so far, by name, in order."""

    def __post_init__(self) -> None:
        self._program = None
        if self.motion.functions is not None:
            self._program = _traced(self.form)

    @property
    def motion(self) -> Motion:
        return self.form.motion

    def at(
        self, names: Mapping[str, Node], values: Mapping[str, float], suffix: str = ""
    ) -> PhysicsNodes:
        """Return the physics where states, inputs and parameters are `names`.

        Args:
            values: of the parameters.
            suffix: of the intermediate results.
        """
        if self._program is None:
            return self._written(names, suffix)
        return self._taken_apart(self._program, names, values, suffix)

    def defined(self, names: Mapping[str, Node], suffix: str = "") -> dict[str, Node]:
        """Return the names with those of the definitions, in terms of the others."""
        found = dict(names)
        for key, expression in self.motion.definitions:
            local = f"v_{identifier(key)}{suffix}"
            self.locals[local] = node_of(expression, found, {}, self.numeric)
            found[key] = Name(local)
            self.symbols[local] = key
        return found

    def _written(self, names: Mapping[str, Node], suffix: str) -> PhysicsNodes:
        found = self.defined(names, suffix)
        rates, outputs = (
            [node_of(expression, found, {}, self.numeric) for expression in expressions]
            for expressions in (self.motion.equations.values(), self.motion.observations)
        )
        return self._gathered(rates, outputs)

    def _gathered(self, rates: list[Node], outputs: list[Node]) -> PhysicsNodes:
        states, seen = self.form.corrected
        return PhysicsNodes(
            rates, outputs, [*(rates[i] for i in states), *(outputs[i] for i in seen)], []
        )

    def _taken_apart(
        self,
        program: ScalarProgram,
        names: Mapping[str, Node],
        values: Mapping[str, float],
        suffix: str,
    ) -> PhysicsNodes:
        motion = self.motion
        parameters = [parameter.name for parameter in motion.parameters]
        points = [names[key] for key in (*motion.names_of_states, *motion.inputs)]
        own = [self.own[key] for key in parameters]
        inputs = [*points, *(names[key] for key in parameters), *own]
        given = [held[key] for held in (values, self.values) for key in parameters]
        known = [*(None for _ in points), *given]
        rates, outputs, *forces = self._named(program, inputs, known, suffix)
        if not forces:
            return self._gathered(rates, outputs)
        learned, responses = forces
        size = len(rates)
        apart = [responses[i : i + size] for i in range(0, len(responses), size)]
        return PhysicsNodes(rates, outputs, learned, apart)

    def _named(
        self,
        program: ScalarProgram,
        inputs: Sequence[Node],
        known: Sequence[float | None],
        suffix: str,
    ) -> list[list[Node]]:
        """Return the outputs of a program, whose operations become intermediate results."""
        found: list[Node] = []
        numbers: list[float | bool | None] = []  # of operations that only read parameters
        for i, each in enumerate(program.operations):
            numbers.append(_value_of(each, known, numbers))
            node = _node_of(each, inputs, found, numbers)
            if isinstance(node, Apply):
                local = f"v_step_{i}{suffix}"
                self.locals[local], self.symbols[local] = node, f"step_{i}"
                node = Name(local)
            found.append(node)
        return [[found[i] for i in output.ravel()] for output in program.outputs]


def _traced(form: MotionField) -> ScalarProgram:
    """Return rates, outputs, and rows and responses of forces, from states, inputs, parameters.

    Raises:
        InputError: functions of the host, or with loops and other calls.
    """
    motion = form.motion
    assert motion.functions is not None
    f, h = motion.functions
    if isinstance(motion.source, FileSource) and not motion.source.compiled:
        raise InputError(
            f"the motion is read from {Path(motion.source.file).name}, which has no code here; "
            f"`--to {motion.source.target}` writes its parameters."
        )
    states = np.array(form.corrected[0], int)
    outputs = np.array(form.corrected[1], int)

    def physics(x: Any, u: Any, p: Any, own: Any) -> Any:
        rates, seen = jnp.asarray(f(x, u, p)), jnp.asarray(h(x, u, p))
        if not (motion.mass.rows and len(states)):
            return rates, seen
        rows = motion.mass.balance(rates, x, own)[states]
        pushes = jnp.eye(len(x))[states]
        responses = jnp.stack([motion.mass.rates(push, x, own) for push in pushes])
        return rates, seen, jnp.concatenate([rows, seen[outputs]]), responses

    count = (len(motion.parameters),)
    program = scalar_program(
        physics, (len(motion.states),), (len(motion.inputs),), count, count, slopes=False
    )
    whole = [program.calls[each.reads[0]] for each in program.operations if each.name == "call"]
    if whole:
        raise InputError(
            f"the motion is a function with '{whole[0].equation.primitive.name}', which no target "
            "can write; give it as expressions, or call `model.step` where Python with JAX runs."
        )
    return program


def _value_of(
    each: Operation, known: Sequence[float | None], values: Sequence[float | bool | None]
) -> float | bool | None:
    """Return the number of an operation, None where it reads states or inputs."""
    if each.name == "input":
        return known[each.reads[0]]
    if each.name == "constant":
        return each.reads[0]
    read = [values[i] for i in each.sources]
    return None if any(value is None for value in read) else each.value(read)


def _node_of(
    each: Operation,
    inputs: Sequence[Node],
    found: Sequence[Node],
    values: Sequence[float | bool | None],
) -> Node:
    """Return an operation as a node of those before it.

    Raises:
        InputError: a condition on states or inputs.
    """
    if each.name == "input":
        return inputs[each.reads[0]]
    if each.name == "constant":
        return Number(float(each.reads[0]))
    if each.name == "select":
        condition, *cases = each.reads
        if (decided := values[condition]) is not None:
            return found[cases[0] if decided else cases[1]]
    if each.name in _FUNCTIONS:
        return apply(_FUNCTIONS[each.name], *(found[i] for i in each.reads))
    if values[-1] is not None:
        return Number(float(values[-1]))
    raise InputError(
        f"the motion is a function with '{each.name}' of a state or an input, which no target can "
        "write; use abs, min, max or sign, or call `model.step` where Python with JAX runs."
    )
