"""The activations of networks as nodes of `a`, so that no target needs a table of them."""

from __future__ import annotations

import math

from orthaug.export.nodes import Apply, Name, Node, Number

_A, _ONE, _NULL = Name("a"), Number(1.0), Number(0.0)


def _of(function: str, *arguments: Node) -> Node:
    return Apply(function, arguments)


_SIGMOID = _of("div", _ONE, _of("add", _ONE, _of("exp", _of("neg", _A))))
_CUBIC = _of("add", _A, _of("mul", Number(0.044715), _of("whole_power", _A, Number(3.0))))
ACTIVATIONS: dict[str, Node] = {
    "tanh": _of("tanh", _A),
    "relu": _of("max", _A, _NULL),
    "gelu": _of(
        "mul",
        _of("mul", Number(0.5), _A),
        _of("add", _ONE, _of("tanh", _of("mul", Number(math.sqrt(2 / math.pi)), _CUBIC))),
    ),
    "sigmoid": _SIGMOID,
    "silu": _of("mul", _A, _SIGMOID),
    "elu": _of("add", _of("max", _A, _NULL), _of("expm1", _of("min", _A, _NULL))),
    "softplus": _of("add", _of("max", _A, _NULL), _of("log1p", _of("exp", _of("neg", _of("abs", _A))))),
    "identity": _A,
}
"""Those of `models.learners`, by the same names."""
