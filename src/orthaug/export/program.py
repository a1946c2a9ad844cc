"""A model's step in the intermediate form: constants, blocks of expressions, integration.

A target writes a `Program`, and knows nothing of models.
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from orthaug._base.lines import with_unit
from orthaug.export.nodes import Node, functions_in


@dataclass(frozen=True)
class Signal:
    """An entry of state, inputs or outputs: the user's name, an ASCII identifier, the unit."""

    name: str
    identifier: str
    unit: str = ""

    @property
    def label(self) -> str:
        """`name [unit]`."""
        return with_unit(self.name, self.unit)


@dataclass(frozen=True)
class Constant:
    """A named number; `meaning` is one line."""

    name: str
    value: float
    meaning: str


@dataclass(frozen=True, eq=False)
class Layer:
    """`activation(weight @ z + bias)`; without a bias where that is None."""

    weight: Float[np.ndarray, "no ni"]
    bias: Float[np.ndarray, "no"] | None
    activation: str


@dataclass(frozen=True, eq=False)
class Network:
    """The learner: layers on scaled features.

    Its values are the vector `g` of its block.
    """

    features: tuple[Node, ...]
    layers: tuple[Layer, ...]


@dataclass(frozen=True, eq=False)
class Block:
    """A function of `x` and `u`: intermediate results in order, a network, and the results."""

    name: str
    locals: tuple[tuple[str, Node], ...]
    network: Network | None
    results: tuple[Node, ...]

    @property
    def nodes(self) -> tuple[Node, ...]:
        """All its expressions."""
        features = self.network.features if self.network is not None else ()
        return (*(node for _, node in self.locals), *features, *self.results)

    @property
    def layers(self) -> tuple[Layer, ...]:
        """The layers of its network."""
        return self.network.layers if self.network is not None else ()


WRITTEN = ("discrete", "rk4", "exact")
"""Schemes that targets can write; `numpy_step` takes any."""


@dataclass(frozen=True, eq=False)
class Scheme:
    """Scheme by which a motion advances one sample: `discrete`, `rk4`, or `exact` by matrices.

    Of the exact one, with the rest r = rate − `linear` x and substep h:
    `a = half x + half1 r(x)`, `b = half x + half1 r(a)`, `c = half a + half1 (2 r(b) − r(x))`,
    `x⁺ = whole x + first r(x) + middle (r(a) + r(b)) + last r(c)`.
    """

    kind: str
    step: float
    """The substep h [s]."""
    substeps: int
    matrices: tuple[tuple[str, Float[np.ndarray, "nx nx"]], ...] = ()


@dataclass(frozen=True, eq=False)
class Program:
    """A step: `output` gives y of state x and inputs u; then the state goes on.

    Of a lagged model `lines` are the channels that it remembers with how many samples of each,
    outputs first; the state is these lines, newest first, and outputs and inputs are put in front
    of them. Of a motion `rate` and `scheme` make the next state; under a first-order hold, `ends` =
    2, the inputs of the next sample follow those of this one.
    """

    name: str
    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    sampling_time: float
    constants: tuple[Constant, ...]
    output: Block
    lines: tuple[tuple[Signal, int], ...] = ()
    following: tuple[int, ...] = ()
    """Positions of the next state's entries of a lagged model among outputs, inputs and state."""
    rate: Block | None = None
    scheme: Scheme | None = None
    ends: int = 1
    symbols: tuple[tuple[str, str], ...] = ()
    """The names of constants and intermediate results as users write them."""
    digest: str = ""
    preparation: str = ""
    """Preparation of the data that inputs, outputs and state refer to, in words."""

    def __repr__(self) -> str:
        names = (
            ", ".join(signal.name for signal in group) for group in (self.inputs, self.outputs)
        )
        inputs, outputs = names
        return (
            f"Program({self.name!r}: {inputs or 'no inputs'} to {outputs}, "
            f"{len(self.states)} states, Ts = {self.sampling_time:g} s)"
        )

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks that a step evaluates."""
        return (self.output,) if self.rate is None else (self.output, self.rate)

    @property
    def functions(self) -> set[str]:
        """The functions of all expressions."""
        return set[str]().union(
            *(functions_in(node) for block in self.blocks for node in block.nodes)
        )

    @property
    def activations(self) -> set[str]:
        """The activations of all networks."""
        return {layer.activation for block in self.blocks for layer in block.layers}

    @property
    def held(self) -> int:
        """Number of inputs at one instant, of which a step takes `ends`."""
        return len(self.inputs) // self.ends


@dataclass(frozen=True, eq=False)
class Vectors:
    """Test vectors of an export: inputs, the state before each step and the outputs, all finite."""

    inputs: Float[np.ndarray, "r nu"]
    states: Float[np.ndarray, "r n"]
    outputs: Float[np.ndarray, "r ny"]

    def csv(self, program: Program) -> str:
        """Return a column for each input, state and output.

        Names that occur twice get `state:` or `output:` in front.
        """
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        kinds = {"input": program.inputs, "state": program.states, "output": program.outputs}
        writer.writerow(
            [f"{kind}:{signal.name}" for kind, signals in kinds.items() for signal in signals]
        )
        for row in np.concatenate([self.inputs, self.states, self.outputs], axis=1):
            writer.writerow([repr(float(value)) for value in row])
        return text.getvalue()
