"""An ONNX graph of one step, in double precision."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix
from orthaug._base.errors import InputError
from orthaug.export.nodes import ACTIVATIONS, Apply, Entry, Name, Node, Number
from orthaug.export.program import Block, Program, Vectors

_OPERATORS = {
    "add": "Add",
    "sub": "Sub",
    "mul": "Mul",
    "div": "Div",
    "power": "Pow",
    "whole_power": "Pow",
}
_OPERATORS |= {"neg": "Neg", "sin": "Sin", "cos": "Cos", "exp": "Exp", "log": "Log", "sqrt": "Sqrt"}
_OPERATORS |= {
    "abs": "Abs",
    "sign": "Sign",
    "floor": "Floor",
    "tanh": "Tanh",
    "min": "Min",
    "max": "Max",
}
_OPSET = 18


@dataclass(frozen=True)
class OnnxGraph:
    """`NAME.onnx`: (state, inputs) → (next_state, outputs), vectors of doubles.

    Empty vectors are left out.
    """

    summary = "an ONNX graph in double precision"

    def files(self, program: Program, vectors: Vectors) -> Mapping[str, str | bytes]:
        return {f"{program.name}.onnx": _Graph(program).bytes()}

    def usage(self, program: Program) -> str:
        return f"""```python
import numpy as np
import onnxruntime

session = onnxruntime.InferenceSession("{program.name}.onnx")
state, inputs = np.zeros({len(program.states)}), np.zeros({len(program.inputs)})
state, outputs = session.run(["next_state", "outputs"], {{"state": state, "inputs": inputs}})
```

All are vectors of doubles in the orders above; a vector without entries is left out."""


class _Graph:
    """The graph as it is built, a node at a time."""

    def __init__(self, program: Program) -> None:
        try:
            import onnx  # pyright: ignore[reportMissingImports]  (optional)
        except ImportError:
            raise InputError(
                "an ONNX graph is written by the package onnx, which is not installed; pip "
                "install onnx."
            ) from None
        self.onnx, self.program = onnx, program
        self.nodes: list[object] = []
        self.tables: dict[str, np.ndarray] = {}
        self.constants = {constant.name: constant.value for constant in program.constants}

    def bytes(self) -> bytes:
        program, helper = self.program, self.onnx.helper
        u = "inputs"
        now = self.part(u, range(program.held)) if program.ends == 2 else u
        y = self.add("Identity", self.block(program.output, "state", now), out="outputs")
        if program.states:
            self.add("Identity", self.following_state(now, u, y), out="next_state")
        real = self.onnx.TensorProto.DOUBLE
        sizes = {"state": program.states, "inputs": program.inputs}
        results = {"next_state": program.states, "outputs": program.outputs}
        given, made = (
            [
                helper.make_tensor_value_info(name, real, [len(signals)])
                for name, signals in group.items()
                if signals
            ]
            for group in (sizes, results)
        )
        tables = [
            self.onnx.numpy_helper.from_array(value, name) for name, value in self.tables.items()
        ]
        graph = helper.make_graph(self.nodes, program.name, given, made, tables)
        about = {"producer_name": "orthaug", "doc_string": f"sha256 {program.digest}"}
        model = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=8, **about
        )
        self.onnx.checker.check_model(model)
        return model.SerializeToString()

    def add(self, operator: str, *inputs: str, out: str | None = None, **attributes: object) -> str:
        """Add a node and return its result."""
        out = out or f"n{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(operator, list(inputs), [out], **attributes))
        return out

    def table(self, value: Any) -> str:
        """Return a constant tensor."""
        name = f"t{len(self.tables)}"
        self.tables[name] = np.ascontiguousarray(value)
        return name

    def real(self, value: float) -> str:
        return self.table(np.array([value], dtype=float))

    def part(self, vector: str, which: Sequence[int] | range) -> str:
        return self.add("Gather", vector, self.table(np.array(list(which), dtype=np.int64)))

    def concat(self, parts: Sequence[str]) -> str:
        return parts[0] if len(parts) == 1 else self.add("Concat", *parts, axis=0)

    def block(self, block: Block, x: str, u: str) -> str:
        """Return the results of a block as a vector."""
        known = {"x": x, "u": u}
        for name, node in block.locals:
            known[name] = self.node(node, known)
        if block.network is not None:
            z = self.concat([self.node(node, known) for node in block.network.features])
            for layer in block.network.layers:
                z = self.product(layer.weight, z)
                z = z if layer.bias is None else self.add("Add", z, self.table(layer.bias))
                z = (
                    z
                    if layer.activation == "identity"
                    else self.node(ACTIVATIONS[layer.activation], {"a": z})
                )
            known["g"] = z
        return self.concat([self.node(node, known) for node in block.results])

    def product(self, weight: Matrix, z: str) -> str:
        """Return W z.

        Of one entry it is no matrix product: runtimes would draw its scaling in, in single
        precision.
        """
        if weight.shape[1] == 1:
            return self.add("Mul", self.table(weight[:, 0]), z)
        return self.add("MatMul", self.table(weight), z)

    def node(self, node: Node, known: Mapping[str, str]) -> str:
        """Return a node of the program as a vector of one entry, or of a layer's entries."""
        if isinstance(node, Number):
            return self.real(node.value)
        if isinstance(node, Name):
            return known[node.name] if node.name in known else self.real(self.constants[node.name])
        if isinstance(node, Entry):
            return self.part(known[node.vector], [node.index])
        assert isinstance(node, Apply)
        inner = [self.node(argument, known) for argument in node.arguments]
        if node.function == "tan":
            return self.add("Div", self.add("Sin", *inner), self.add("Cos", *inner))
        if node.function == "expm1":
            return self.add("Sub", self.add("Exp", *inner), self.real(1.0))
        if node.function == "log1p":
            return self.add("Log", self.add("Add", self.real(1.0), *inner))
        if node.function in ("atan", "atan2"):
            return self.angle(*inner) if len(inner) == 2 else self.arctangent(*inner)
        return self.add(_OPERATORS[node.function], *inner)

    def arctangent(self, x: str) -> str:
        """Return atan(x) from that in single precision, which is all that runtimes have.

        What it lacks is a small angle.
        """
        types = self.onnx.TensorProto
        near = self.add("Atan", self.add("Cast", x, to=types.FLOAT))
        near = self.add("Cast", near, to=types.DOUBLE)
        sin, cos = self.add("Sin", near), self.add("Cos", near)
        across = self.add("Sub", self.add("Mul", x, cos), sin)
        along = self.add("Add", cos, self.add("Mul", x, sin))
        return self.add("Add", near, self.add("Div", across, along))

    def angle(self, y: str, x: str) -> str:
        """Return atan2(y, x), which ONNX lacks, by the half plane of x."""
        zero, turned = self.real(0.0), self.real(np.pi)
        right = self.arctangent(self.add("Div", y, x))
        up = self.add("Where", self.add("Less", y, zero), self.add("Neg", turned), turned)
        beside = self.add("Where", self.add("Less", x, zero), self.add("Add", right, up), right)
        upright = self.add("Mul", self.add("Sign", y), self.real(np.pi / 2))
        return self.add("Where", self.add("Equal", x, zero), upright, beside)

    def following_state(self, now: str, u: str, y: str) -> str:
        """Return the next state."""
        program, scheme = self.program, self.program.scheme
        if scheme is None or program.rate is None:
            parts = [
                name
                for name, there in ((y, True), (u, program.inputs), ("state", program.states))
                if there
            ]
            return self.part(self.concat(parts), program.following)
        if scheme.kind == "discrete":
            return self.block(program.rate, "state", u)
        x, halves, slope = "state", 2 * scheme.substeps, ""
        if program.ends == 2:
            after = self.part(u, range(program.held, 2 * program.held))
            slope = self.add("Div", self.add("Sub", after, now), self.real(halves))
        for j in range(0, halves, 2):
            at = [self.combine(now, (j + i, slope)) if slope else now for i in range(3)]
            x = self.exact(x, *at) if scheme.kind == "exact" else self.runge_kutta(x, *at)
        return x

    def combine(self, x: str, *terms: tuple[float, str]) -> str:
        """Return x plus multiples of vectors."""
        for factor, vector in terms:
            x = self.add("Add", x, self.add("Mul", self.real(factor), vector))
        return x

    def runge_kutta(self, x: str, first: str, middle: str, last: str) -> str:
        rate, scheme = self.program.rate, self.program.scheme
        assert rate is not None and scheme is not None
        h = scheme.step
        k1 = self.block(rate, x, first)
        k2 = self.block(rate, self.combine(x, (h / 2, k1)), middle)
        k3 = self.block(rate, self.combine(x, (h / 2, k2)), middle)
        k4 = self.block(rate, self.combine(x, (h, k3)), last)
        return self.combine(
            x, (h / 6, self.add("Add", self.combine(k1, (2.0, self.add("Add", k2, k3))), k4))
        )

    def exact(self, x: str, first: str, middle: str, last: str) -> str:
        rate, scheme = self.program.rate, self.program.scheme
        assert rate is not None and scheme is not None
        matrices = dict(scheme.matrices)

        def product(name: str, vector: str) -> str:
            return self.add("MatMul", self.table(matrices[name]), vector)

        def rest(x: str, u: str) -> str:
            return self.add("Sub", self.block(rate, x, u), product("linear", x))

        def plus(*parts: str) -> str:
            total = parts[0]
            for part in parts[1:]:
                total = self.add("Add", total, part)
            return total

        begin = rest(x, first)
        a = plus(product("half", x), product("half1", begin))
        at_a = rest(a, middle)
        b = plus(product("half", x), product("half1", at_a))
        at_b = rest(b, middle)
        turned = self.add("Sub", plus(at_b, at_b), begin)
        c = plus(product("half", a), product("half1", turned))
        ends = plus(product("first", begin), product("last", rest(c, last)))
        return plus(product("whole", x), ends, product("middle", plus(at_a, at_b)))
