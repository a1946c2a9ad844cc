"""A step in NumPy alone: no JAX in the loop, no text that is run as code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.errors import InputError
from orthaug.export.lowering import program_of
from orthaug.export.nodes import ACTIVATIONS, SHARED_NAMES, Apply, Entry, Name, Node, Number
from orthaug.export.program import Block, Program, Scheme
from orthaug.models.model import HoldsModel, Model
from orthaug.physics.integrators import INTEGRATORS

Values = dict[str, Any]
"""`x`, `u`, `g` and intermediate results by name."""
Evaluation = Callable[[Values], Any]

FUNCTIONS: dict[str, Any] = {
    "neg": np.negative,
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "power": np.power,
    "whole_power": lambda a, n: a ** int(n),
    "atan": np.arctan,
    "atan2": np.arctan2,
    "min": np.minimum,
    "max": np.maximum,
} | {name: getattr(np, name) for name in (*SHARED_NAMES, "abs", "sign")}


class NumpyStep:
    """`state, outputs = step(state, inputs)` on NumPy vectors, as `model.step`.

    Make one with `numpy_step`.
    """

    def __init__(self, program: Program) -> None:
        self.state_names = tuple(signal.name for signal in program.states)
        self.step_inputs = tuple(signal.name for signal in program.inputs)
        self._sizes = len(program.states), len(program.inputs)
        self._constants = {
            constant.name: np.float64(constant.value) for constant in program.constants
        }
        self._output = self._block(program.output)
        self._following = np.array(program.following, dtype=int)
        self._advance = None
        if program.rate is not None and program.scheme is not None:
            self._advance = _advance_function(
                self._block(program.rate), program.scheme, program.held, program.ends
            )
        self._held = program.held

    def __call__(self, state: Any, inputs: Any) -> tuple[Vector, Vector]:
        """Return the next state (n,) and the outputs (ny,) of one sample.

        Raises:
            InputError: vectors of another length.
        """
        x, u = np.asarray(state, dtype=float), np.asarray(inputs, dtype=float)
        if x.shape != self._sizes[:1] or u.shape != self._sizes[1:]:
            raise InputError(
                f"a step takes a state of {self._sizes[0]} and inputs of {self._sizes[1]} "
                f"numbers; got the shapes {x.shape} and {u.shape}."
            )
        with np.errstate(all="ignore"):
            y = self._output(x, u[: self._held])
            if self._advance is not None:
                return self._advance(x, u), y
            return np.concatenate((y, u, x))[self._following], y

    def _block(self, block: Block) -> Callable[[Vector, Vector], Vector]:
        intermediate = [(name, self._evaluation(node)) for name, node in block.locals]
        features = (
            [] if block.network is None else list(map(self._evaluation, block.network.features))
        )
        layers = []
        for layer in block.layers:
            bias = np.zeros(len(layer.weight)) if layer.bias is None else layer.bias
            act = (
                None
                if layer.activation == "identity"
                else self._evaluation(ACTIVATIONS[layer.activation])
            )
            layers.append((layer.weight, bias, act))
        results = [self._evaluation(node) for node in block.results]

        def evaluate(x: Vector, u: Vector) -> Vector:
            values: Values = {"x": x, "u": u}
            for name, of in intermediate:
                values[name] = of(values)
            if layers:
                z = np.array([of(values) for of in features], dtype=float)
                for weight, bias, act in layers:
                    z = weight @ z + bias
                    z = z if act is None else act({"a": z})
                values["g"] = z
            return np.array([of(values) for of in results], dtype=float)

        return evaluate

    def _evaluation(self, node: Node) -> Evaluation:
        if isinstance(node, Number):
            value = np.float64(node.value)
            return lambda values: value
        if isinstance(node, Name):
            name = node.name
            if name in self._constants:
                constant = self._constants[name]
                return lambda values: constant
            return lambda values: values[name]
        if isinstance(node, Entry):
            vector, index = node.vector, node.index
            return lambda values: values[vector][index]
        assert isinstance(node, Apply)
        function, arguments = (
            FUNCTIONS[node.function],
            [self._evaluation(argument) for argument in node.arguments],
        )
        if len(arguments) == 1:
            (only,) = arguments
            return lambda values: function(only(values))
        first, second = arguments
        return lambda values: function(first(values), second(values))


def numpy_step(model: Model | HoldsModel) -> NumpyStep:
    """Return the step of a fitted model in NumPy, for loops in Python.

    It is for places where JAX is too slow to call.

    Args:
        model: as `load` gives it, or a fit; of one in a loop the plant is taken.

    Returns:
        The step: `state, outputs = step(state, inputs)`; `step.state_names` and `step.step_inputs`
        list the entries of both.

    Raises:
        InputError: physics or a learner that is a Python function, an ensemble, a spline hold.

    Examples:
        >>> import orthaug as oa
        >>> u = [1.0, 2.0, 0.0, 3.0, 1.0, 0.0]
        >>> y = [0.0, 0.5, 1.25, 0.625, 1.8125, 1.40625]  # 0.5 (y[k-1] + u[k-1])
        >>> record = oa.Record.from_arrays(u=u, y=y)
        >>> physics = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
        >>> step = numpy_step(oa.estimate(record, physics, learner=None))
        >>> step.state_names, step.step_inputs
        (('y[k-1]', 'u[k-1]'), ('u',))
        >>> state, outputs = step([4.0, 1.0], [1.0])
        >>> outputs.round(6), state.round(6)
        (array([2.5]), array([2.5, 1. ]))
    """
    return NumpyStep(program_of(model))


def _advance_function(
    rate: Callable[[Vector, Vector], Vector], scheme: Scheme, held: int, ends: int
) -> Callable[[Vector, Vector], Vector]:
    """Return x one sample later, of x and the step's inputs."""
    if scheme.kind == "discrete":
        return rate
    h, halves = scheme.step, 2 * scheme.substeps
    one = (
        _exponential(rate, dict(scheme.matrices))
        if scheme.kind == "exact"
        else INTEGRATORS[scheme.kind]().step(rate, h)
    )

    def advance(x: Vector, u: Vector) -> Vector:
        now = u[:held]
        slope = (u[held:] - now) / halves if ends == 2 else None
        for j in range(0, halves, 2):
            points = (
                (now, now, now)
                if slope is None
                else (now + j * slope, now + (j + 1) * slope, now + (j + 2) * slope)
            )
            x = one(x, *points)
        return x

    return advance


def _exponential(
    rate: Callable[[Vector, Vector], Vector], m: dict[str, object]
) -> Callable[..., Vector]:
    def rest(x: Vector, u: Vector) -> Vector:
        return rate(x, u) - m["linear"] @ x

    def one(x: Vector, first: Vector, middle: Vector, last: Vector) -> Vector:
        begin = rest(x, first)
        a = m["half"] @ x + m["half1"] @ begin
        at_a = rest(a, middle)
        b = m["half"] @ x + m["half1"] @ at_a
        at_b = rest(b, middle)
        c = m["half"] @ a + m["half1"] @ (2 * at_b - begin)
        ends = m["first"] @ begin + m["last"] @ rest(c, last)
        return m["whole"] @ x + ends + m["middle"] @ (at_a + at_b)

    return one
