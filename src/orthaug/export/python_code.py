"""A program as a Python module, for NumPy and for symbolic libraries such as CasADi."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from orthaug.export.nodes import ACTIVATIONS, SHARED_NAMES, Language, decimal, wrap_items
from orthaug.export.program import Block, Program, Vectors


@dataclass(frozen=True)
class Dialect:
    """Syntax of a library for operations that Python has no sign for.

    Args:
        language: of scalar expressions.
        vector: of the texts of its entries, `{}`.
        array: of a constant vector or matrix as lists, `{}`.
        join: of the texts of vectors.
        constant: of a number.
    """

    language: Language
    vector: str
    array: str
    join: str
    constant: str = "{}"


def python_language(functions: dict[str, str]) -> Language:
    """Return Python with these functions."""
    return Language(
        functions, decimal, lambda base, n: f"{base}**{n}" if n >= 0 else f"{base}**({n})"
    )


def declarations(program: Program) -> str:
    """Return the names and the sampling time of a model."""
    names = {
        kind.upper(): tuple(signal.name for signal in getattr(program, kind))
        for kind in ("states", "inputs", "outputs")
    }
    lines = [f"{kind} = {texts!r}" for kind, texts in names.items()]
    units = {s.name: s.unit for s in (*program.states, *program.inputs, *program.outputs) if s.unit}
    lines += [f"UNITS = {units!r}", f"SAMPLING_TIME = {program.sampling_time!r}  # s"]
    return "\n".join([*lines, f'MODEL_SHA256 = "{program.digest}"'])


def arithmetic(program: Program, dialect: Dialect) -> str:
    """Return constants, activations, blocks and `advance(x, u, y)`, which gives the next state."""
    constants = [
        f"{c.name} = {dialect.constant.format(decimal(c.value))}  # {c.meaning}"
        for c in program.constants
    ]
    parts = ["\n".join(constants)] if constants else []
    parts += [array for block in program.blocks for array in _arrays(block, dialect)]
    for name in sorted(program.activations - {"identity"}):
        parts.append(f"\ndef _{name}(a):\n    return {dialect.language.write(ACTIVATIONS[name])}")
    parts += [_block(block, dialect) for block in program.blocks]
    parts += _advance(program, dialect)
    return "\n\n".join(parts)


def _arrays(block: Block, dialect: Dialect) -> list[str]:
    found = []
    for i, layer in enumerate(block.layers, start=1):
        found.append(_array(f"{block.name}_w{i}", layer.weight, dialect))
        if layer.bias is not None:
            found.append(_array(f"{block.name}_b{i}", layer.bias, dialect))
    return found


def _array(name: str, values: np.ndarray, dialect: Dialect) -> str:
    def list_numbers(numbers: np.ndarray, indent: str) -> str:
        return f"[{wrap_items([decimal(v) for v in numbers], indent).strip()}]"

    rows = ",\n".join(f"    {list_numbers(row, ' ' * 5)}" for row in np.atleast_2d(values))
    inner = list_numbers(values, " " * 4) if values.ndim == 1 else f"[\n{rows},\n]"
    return f"{name} = {dialect.array.format(inner)}"


def _block(block: Block, dialect: Dialect) -> str:
    write = dialect.language.write
    lines = [f"{name} = {write(node)}" for name, node in block.locals]
    if block.network is not None:
        lines.append(f"z = {_vector([write(node) for node in block.network.features], dialect)}")
        last = len(block.layers)
        for i, layer in enumerate(block.layers, start=1):
            target, source = "g" if i == last else f"h{i}", "z" if i == 1 else f"h{i - 1}"
            value = f"{block.name}_w{i} @ {source}" + (
                f" + {block.name}_b{i}" if layer.bias is not None else ""
            )
            lines.append(
                f"{target} = "
                f"{value if layer.activation == 'identity' else f'_{layer.activation}({value})'}"
            )
    lines.append(f"return {_vector([write(node) for node in block.results], dialect)}")
    return f"\ndef {block.name}(x, u):\n" + "\n".join(f"    {line}" for line in lines)


def _vector(entries: Sequence[str], dialect: Dialect) -> str:
    text = ", ".join(entries)
    return dialect.vector.format(
        f"\n{wrap_items([*entries], ' ' * 8)},\n    " if len(text) > 90 else text
    )


def _advance(program: Program, dialect: Dialect) -> list[str]:
    scheme = program.scheme
    if scheme is None:
        joined = dialect.join.format("y, u, x")
        return [
            f"FOLLOWING = {list(program.following)!r}",
            f"\ndef advance(x, u, y):\n    return {joined}[FOLLOWING]",
        ]
    if scheme.kind == "discrete":
        return ["\ndef advance(x, u, y):\n    return rate(x, u)"]
    constants = f"STEP = {scheme.step!r}  # s, {scheme.substeps} in a sample"
    parts = [
        constants,
        *(_array(name.upper(), matrix, dialect) for name, matrix in scheme.matrices),
    ]
    parts.append(_EXACT if scheme.kind == "exact" else _RK4)
    if program.ends == 1:
        body = (
            f"    for _ in range({scheme.substeps}):\n        x = substep(x, u, u, u)\n    return x"
        )
    else:
        halves, held = 2 * scheme.substeps, program.held
        now, after = (
            dialect.vector.format(", ".join(f"u[{i + first}]" for i in range(held)))
            for first in (0, held)
        )
        body = (
            f"    now, slope = {now}, ({after} - {now}) / {halves}\n    for j in range(0, "
            f"{halves}, 2):\n        x = substep(x, now + j * slope, now + (j + 1) * slope, "
            "now + (j + 2) * slope)\n    return x"
        )
    return [*parts, f"\ndef advance(x, u, y):\n{body}"]


_RK4 = """
def substep(x, first, middle, last):
    k1 = rate(x, first)
    k2 = rate(x + STEP / 2 * k1, middle)
    k3 = rate(x + STEP / 2 * k2, middle)
    k4 = rate(x + STEP * k3, last)
    return x + STEP / 6 * (k1 + 2 * (k2 + k3) + k4)"""

_EXACT = """
def rest(x, u):
    return rate(x, u) - LINEAR @ x


def substep(x, first, middle, last):
    begin = rest(x, first)
    a = HALF @ x + HALF1 @ begin
    at_a = rest(a, middle)
    b = HALF @ x + HALF1 @ at_a
    at_b = rest(b, middle)
    c = HALF @ a + HALF1 @ (2 * at_b - begin)
    return WHOLE @ x + FIRST @ begin + MIDDLE @ (at_a + at_b) + LAST @ rest(c, last)"""


_SAME = (*SHARED_NAMES, "atan", "atan2", "sign", "power")
_OTHER = {"abs": "ca.fabs", "min": "ca.fmin", "max": "ca.fmax"}
CASADI = Dialect(
    python_language({name: f"ca.{name}" for name in _SAME} | _OTHER),
    vector="ca.vertcat({})",
    array="ca.DM({})",
    join="ca.vertcat({})",
)


@dataclass(frozen=True)
class CasadiModule:
    """`NAME.py` with `step()`, a CasADi Function of state and inputs."""

    summary = "a Python module that makes a CasADi Function"

    def files(self, program: Program, vectors: Vectors) -> Mapping[str, str]:
        title = f"{program.name}: one step of a fitted model as a CasADi Function."
        head = f'"""{title} Written by orthaug."""'
        step = _STEP.replace("NAME", program.name)
        text = [
            head,
            "",
            "import casadi as ca",
            "",
            declarations(program),
            "",
            arithmetic(program, CASADI),
            step,
        ]
        return {f"{program.name}.py": "\n".join(text)}

    def usage(self, program: Program) -> str:
        return f"""```python
import {program.name} as model

step = model.step()                # a casadi.Function: (state, inputs) -> (next_state, outputs)
state, outputs = step({[0] * len(program.states)}, {[0] * len(program.inputs)})
run = step.mapaccum(100)           # a free run of 100 steps, inputs in columns
```

It needs `casadi` (`pip install casadi`; the extra `orthaug[casadi]` installs it too).
`step` takes symbols as well as
numbers, so that an optimal control problem can call it once for each step of the horizon."""


_STEP = '''

def step(name="NAME"):
    """The next state and the outputs of one sample, as a Function of state and inputs."""
    state, inputs = ca.SX.sym("state", len(STATES)), ca.SX.sym("inputs", len(INPUTS))
    outputs = output(state, inputs)
    following = ca.densify(ca.SX(advance(state, inputs, outputs)))
    results = [following, ca.densify(ca.SX(outputs))]
    names = ["state", "inputs"], ["next_state", "outputs"]
    return ca.Function(name, [state, inputs], results, *names)
'''
