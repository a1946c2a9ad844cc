"""C99: one header and one source without allocation, in double or single precision."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from orthaug._base.checks import free_name
from orthaug.export.nodes import (
    ACTIVATIONS,
    SHARED_NAMES,
    Language,
    decimal,
    functions_in,
    names_in,
    wrap_items,
)
from orthaug.export.program import Block, Constant, Layer, Program, Signal, Vectors

_MATH = {*SHARED_NAMES, "atan", "atan2"}
_OWN = {
    "sign": "static real sign(real a) { return a > 0 ? 1 : a < 0 ? -1 : a; } /* NaN stays NaN */",
    "min": "static real least(real a, real b) { return a < b || isnan(a) ? a : b; }",
    "max": "static real largest(real a, real b) { return a > b || isnan(a) ? a : b; }",
    "square": "static real square(real a) { return a * a; }",
    "whole_power": """static real whole_power(real base, int n)
{
    real value = 1;
    unsigned left = n < 0 ? 0u - (unsigned)n : (unsigned)n;
    for (; left; left >>= 1, base *= base)
        if (left & 1u) value *= base;
    return n < 0 ? 1 / value : value;
}""",
}
_NAMES = {name: f"{name}_" for name in _MATH} | {
    "abs": "fabs_",
    "power": "pow_",
    "sign": "sign",
    "min": "least",
    "max": "largest",
}
_WORDS = """
auto break case char const continue default do double else enum extern float for goto if
inline int long register restrict return short signed sizeof static struct switch typedef
union unsigned void volatile while flag class bool true false new delete this template
operator private public protected namespace try catch throw using
typename virtual friend explicit export mutable and or not xor real
"""
FIELD_WORDS = frozenset(_WORDS.split())
"""Names that a field of the state cannot have, in C or in C++."""
_RK4 = """
static void substep(real x[NX], const real first[], const real middle[], const real last[])
{
    real k1[NX], k2[NX], k3[NX], k4[NX], at[NX];
    int i;
    rate(x, first, k1);
    for (i = 0; i < NX; i++) at[i] = x[i] + step / 2 * k1[i];
    rate(at, middle, k2);
    for (i = 0; i < NX; i++) at[i] = x[i] + step / 2 * k2[i];
    rate(at, middle, k3);
    for (i = 0; i < NX; i++) at[i] = x[i] + step * k3[i];
    rate(at, last, k4);
    for (i = 0; i < NX; i++) x[i] += step / 6 * (k1[i] + 2 * (k2[i] + k3[i]) + k4[i]);
}"""
_EXACT = """static void add_product(const real m[NX][NX], const real v[NX], real sum[NX])
{
    int i, j;
    for (i = 0; i < NX; i++)
        for (j = 0; j < NX; j++) sum[i] += m[i][j] * v[j];
}

/* What the linear part leaves of the rate. */
static void rest(const real x[NX], const real u[], real r[NX])
{
    int i, j;
    rate(x, u, r);
    for (i = 0; i < NX; i++)
        for (j = 0; j < NX; j++) r[i] -= m_linear[i][j] * x[j];
}

static void substep(real x[NX], const real first[], const real middle[], const real last[])
{
    real begin[NX], at_a[NX], at_b[NX], at_c[NX], a[NX], b[NX], c[NX], next[NX];
    int i;
    for (i = 0; i < NX; i++) a[i] = b[i] = c[i] = next[i] = 0;
    rest(x, first, begin);
    add_product(m_half, x, a);
    add_product(m_half1, begin, a);
    rest(a, middle, at_a);
    add_product(m_half, x, b);
    add_product(m_half1, at_a, b);
    rest(b, middle, at_b);
    for (i = 0; i < NX; i++) at_c[i] = 2 * at_b[i] - begin[i];
    add_product(m_half, a, c);
    add_product(m_half1, at_c, c);
    rest(c, last, at_c);
    for (i = 0; i < NX; i++) at_a[i] += at_b[i];
    add_product(m_whole, x, next);
    add_product(m_first, begin, next);
    add_product(m_middle, at_a, next);
    add_product(m_last, at_c, next);
    for (i = 0; i < NX; i++) x[i] = next[i];
}"""


@dataclass(frozen=True)
class CSource:
    """`NAME.h`, `NAME.c`, and `check.c`, which runs the test vectors."""

    summary = "C99: one header, one source, no allocation, double or single precision"

    def files(self, program: Program, vectors: Vectors) -> Mapping[str, str]:
        fields = fields_of(program)
        return {
            f"{program.name}.h": _header(program, fields),
            f"{program.name}.c": _source(program, fields),
            "check.c": _check(program, fields, vectors),
        }

    def usage(self, program: Program) -> str:
        name = program.name
        return f"""```sh
cc -std=c99 -O2 -Wall -Wextra -pedantic {name}.c check.c -lm -o check && ./check
```

says the largest difference from the test vectors. With `-D{name.upper()}_FLOAT` all numbers are
`float`.

```c
{name}_state state;
{name}_real u[{max(len(program.inputs), 1)}], y[{len(program.outputs)}];
{name}_start(&state);          /* zeros; or set the fields of the state */
{name}_step(&state, u, y);     /* one sample: y, and the state goes on */
```

`{name}_run` takes many samples at once. Where an input or a result is NaN or infinite,
`state.flag` is 1 after the step and the state is left as it was; otherwise it is 0. There is no
allocation, no input or output, and no global that changes, so that several instances need only a
state each. Do not compile with `-ffast-math`, which takes NaN for impossible."""


def fields_of(program: Program) -> list[tuple[str, Signal, int]]:
    """Return the fields of the state: C name, signal, and number of samples.

    The number is 0 for a field that is one number.
    """
    if program.scheme is None:
        wanted = [(signal.identifier, signal, depth) for signal, depth in program.lines if depth]
    else:
        wanted = [(signal.identifier, signal, 0) for signal in program.states]
    taken: set[str] = set(FIELD_WORDS)
    fields = []
    for identifier, signal, depth in wanted:
        identifier = free_name(identifier, taken)
        taken.add(identifier)
        fields.append((identifier, signal, depth))
    return fields


def places_of(fields: list[tuple[str, Signal, int]]) -> list[str]:
    """Return every entry of the state as a member of its struct."""
    return [
        f"{name}[{i}]" if depth else name for name, _, depth in fields for i in range(max(depth, 1))
    ]


def _header(program: Program, fields: list[tuple[str, Signal, int]]) -> str:
    name, upper = program.name, program.name.upper()
    members = []
    for identifier, signal, depth in fields:
        unit = f" [{signal.unit}]" if signal.unit else ""
        what = (
            f"{signal.name}[k-1] to {signal.name}[k-{depth}]"
            if depth > 1
            else f"{signal.name}[k-1]"
        )
        size = f"[{depth}]" if depth else ""
        members.append(
            f"    {name}_real {identifier}{size}; /* "
            f"{comment((what if depth else signal.name) + unit)} */"
        )
    inputs = "".join(
        f"\n *   u[{i}]  {comment(signal.label)}" for i, signal in enumerate(program.inputs)
    )
    outputs = "".join(
        f"\n *   y[{i}]  {comment(signal.label)}" for i, signal in enumerate(program.outputs)
    )
    done = comment(program.preparation)
    prepared = f" * Inputs and outputs are data after {done}.\n" if done else ""
    return f"""/* {name}: one step of a fitted model, every {program.sampling_time!r} s.
 * Written by orthaug.
 * Model sha256 {program.digest}
{prepared} *{inputs}{outputs}
 */
#ifndef {upper}_H
#define {upper}_H

#include <stddef.h>

#ifdef __cplusplus
extern "C" {{
#endif

#ifdef {upper}_FLOAT
typedef float {name}_real;
#else
typedef double {name}_real;
#endif

#define {upper}_INPUTS {len(program.inputs)}
#define {upper}_OUTPUTS {len(program.outputs)}
#define {upper}_STATES {len(program.states)}

typedef struct {{
{chr(10).join(members)}
    int flag; /* 1 where the last step met NaN or infinity; the state was left as it was then */
}} {name}_state;

/* A state of zeros. */
void {name}_start({name}_state *state);

/* One sample: outputs y of inputs u, and the next state. */
void {name}_step({name}_state *state, const {name}_real u[], {name}_real y[]);

/* n samples, row after row; how many of them were flagged. */
size_t {name}_run({name}_state *state, const {name}_real u[], {name}_real y[], size_t n);

#ifdef __cplusplus
}}
#endif

#endif
"""


def comment(text: str) -> str:
    """Return text that cannot end a comment."""
    return text.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?").replace("\\", "/")


def _source(program: Program, fields: list[tuple[str, Signal, int]]) -> str:
    name, upper = program.name, program.name.upper()
    step = (
        _lagged_step(program, fields) if program.scheme is None else _motion_step(program, fields)
    )
    zeros = []
    for identifier, _, depth in fields:
        if depth:
            zeros.append(f"    for (i = 0; i < {depth}; i++) state->{identifier}[i] = 0;")
        else:
            zeros.append(f"    state->{identifier} = 0;")
    counter = ["    int i;"] if any(depth for *_, depth in fields) else []
    return f"""/* {name}: one step of a fitted model (see the header). Written by orthaug. */
#include "{name}.h"

#include <math.h>

typedef {name}_real real;
#define R(number) ((real)(number))

{arithmetic(program)}

void {name}_start({name}_state *state)
{{
{chr(10).join([*counter, *zeros, "    state->flag = 0;"])}
}}

{step}

size_t {name}_run({name}_state *state, const {name}_real u[], {name}_real y[], size_t n)
{{
    size_t k, flagged = 0;
    for (k = 0; k < n; k++) {{
        {name}_step(state, u + k * {upper}_INPUTS, y + k * {upper}_OUTPUTS);
        flagged += (size_t)state->flag;
    }}
    return flagged;
}}
"""


def _finite(name: str, count: int) -> str:
    return f"    for (i = 0; i < {count}; i++) ok = ok && isfinite({name}[i]);"


def _step_head(program: Program) -> list[str]:
    name = program.name
    return [f"void {name}_step({name}_state *state, const {name}_real u[], {name}_real y[])", "{"]


def _checks(program: Program, following: bool) -> list[str]:
    lines = [_finite("u", len(program.inputs))] if program.inputs else ["    (void)u;"]
    lines.append(_finite("y", len(program.outputs)))
    lines += [_finite("x", len(program.states))] if following else []
    return [*lines, "    state->flag = !ok;", "    if (!ok) return;"]


def _lagged_step(program: Program, fields: list[tuple[str, Signal, int]]) -> str:
    """Return the block on the state's fields, and the lines that shift the state by one sample."""
    place = [f"state->{place}" for place in places_of(fields)]
    lines = [*_step_head(program), "    int i, ok = 1;"]
    lines += body(
        program.output, "y", lambda vector, i: place[i] if vector == "x" else f"{vector}[{i}]"
    )
    lines += _checks(program, following=False)
    now = {s.name: f"y[{i}]" for i, s in enumerate(program.outputs)}
    now |= {s.name: f"u[{i}]" for i, s in enumerate(program.inputs)}
    for identifier, signal, depth in fields:
        if depth > 1:
            lines.append(
                f"    for (i = {depth - 1}; i > 0; i--) state->{identifier}[i] = "
                f"state->{identifier}[i - 1];"
            )
        lines.append(f"    state->{identifier}[0] = {now[signal.name]};")
    return "\n".join([*lines, "}"])


def _motion_step(program: Program, fields: list[tuple[str, Signal, int]]) -> str:
    scheme = program.scheme
    assert scheme is not None
    lines = [*_step_head(program), f"    real x[{len(program.states)}];", "    int i, ok = 1;"]
    lines += [f"    x[{i}] = state->{identifier};" for i, (identifier, *_) in enumerate(fields)]
    lines += [
        "    output(x, u, y);",
        *advance(program),
        *_checks(program, following=True),
    ]
    lines += [f"    state->{identifier} = x[{i}];" for i, (identifier, *_) in enumerate(fields)]
    return "\n".join([*lines, "}"])


def _check(program: Program, fields: list[tuple[str, Signal, int]], vectors: Vectors) -> str:
    name, upper = program.name, program.name.upper()
    rows = len(vectors.outputs)

    def table(kind: str, values: list[list[float]]) -> str:
        body = ",\n".join("    {" + ", ".join(map(repr, row)) + "}" for row in values or [[0.0]])
        return (
            "static const double "
            f"{kind}[{max(rows, 1)}][{max(len(values[0]) if values else 1, 1)}] = "
            f"{{\n{body}\n}};"
        )

    inputs = vectors.inputs.tolist() if program.inputs else [[0.0]] * rows
    setting = "\n".join(
        f"        state.{place} = (real)states[k][{i}];"
        for i, place in enumerate(places_of(fields))
    )
    states = vectors.states.tolist() if program.states else [[0.0]] * rows
    return f"""/* Test vectors: `cc -std=c99 -O2 {name}.c check.c -lm -o check && ./check`. */
#include "{name}.h"

#include <math.h>
#include <stdio.h>

typedef {name}_real real;
enum {{ ROWS = {rows} }};

{table("inputs", inputs)}

{table("states", states)}

{table("outputs", vectors.outputs.tolist())}

int main(void)
{{
    const double allowed = sizeof(real) == sizeof(double) ? 1e-12 : 1e-4;
    double worst = 0, largest = 0;
    int k, i, flagged = 0;
    for (k = 0; k < ROWS; k++) {{
        {name}_state state;
        real u[{max(len(program.inputs), 1)}], y[{upper}_OUTPUTS];
        {name}_start(&state);
{setting or "        (void)states;"}
        for (i = 0; i < {max(len(program.inputs), 1)}; i++) u[i] = (real)inputs[k][i];
        {name}_step(&state, u, y);
        flagged += state.flag;
        for (i = 0; i < {upper}_OUTPUTS; i++) {{
            const double error = fabs((double)y[i] - outputs[k][i]), size = fabs(outputs[k][i]);
            if (error > worst) worst = error;
            if (size > largest) largest = size;
        }}
    }}
    printf("%d steps: largest difference %.3g, largest output %.3g, %d flagged\\n",
           (int)ROWS, worst, largest, flagged);
    return flagged || !(worst <= allowed * (largest > 1e-300 ? largest : 1));
}}
"""


def _language(entry: Callable[[str, int], str]) -> Language:
    return Language(_NAMES, _number, _power, entry=entry)


def _number(value: float) -> str:
    if not np.isfinite(value):
        return "R(NAN)" if np.isnan(value) else f"R({'-' * (value < 0)}INFINITY)"
    return f"R({decimal(value)})"


def _power(base: str, n: int) -> str:
    return f"square({base})" if n == 2 else f"whole_power({base}, {n})"


def _plain(vector: str, index: int) -> str:
    return f"{vector}[{index}]"


def arithmetic(program: Program) -> str:
    """Return the code before the functions that the header declares."""
    parts = [_functions(program)]
    parts += [
        "\n".join(
            f"static const real {c.name} = {_number(c.value)}; /* {_safe(c.meaning)} */"
            for c in _used_constants(program)
        )
    ]
    for name in sorted(program.activations - {"identity"}):
        written = _language(_plain).write(ACTIVATIONS[name])
        parts.append(f"static real act_{name}(real a) {{ return {written}; }}")
    parts += [_network(block) for block in program.blocks if block.network is not None]
    if program.rate is not None:
        parts += [_function(block, program) for block in program.blocks]
        parts += _integrator(program)
    return "\n\n".join(part for part in parts if part)


def _safe(text: str) -> str:
    return text.replace("*/", "* /").replace("/*", "/ *")


def _used_constants(program: Program) -> list[Constant]:
    """Return constants that some block reads: compilers warn of an unused one."""
    read = set[str]().union(*(names_in(node) for block in program.blocks for node in block.nodes))
    return [constant for constant in program.constants if constant.name in read]


def _functions(program: Program) -> str:
    """Return names of mathematical functions for either precision, and those that C lacks."""
    wanted = program.functions | set[str]().union(
        *(functions_in(ACTIVATIONS[name]) for name in program.activations)
    )
    called = sorted(
        {"abs": "fabs", "power": "pow"}.get(name, name)
        for name in wanted & (_MATH | {"abs", "power"})
    )
    upper = program.name.upper()
    lines = []
    if called:
        lines += [
            f"#ifdef {upper}_FLOAT",
            *(f"#define {name}_ {name}f" for name in called),
            "#else",
        ]
        lines += [*(f"#define {name}_ {name}" for name in called), "#endif"]
    return "\n".join([*lines, *(text for name, text in _OWN.items() if name in wanted)])


def _table(name: str, values: np.ndarray) -> str:
    if values.ndim == 1:
        return (
            f"static const real {name}[{len(values)}] = "
            f"{{\n{wrap_items(list(map(_number, values)), ' ' * 4)}\n}};"
        )
    rows = ",\n".join(
        f"    {{{wrap_items(list(map(_number, row)), ' ' * 5).strip()}}}" for row in values
    )
    return f"static const real {name}[{values.shape[0]}][{values.shape[1]}] = {{\n{rows}\n}};"


def _network(block: Block) -> str:
    """Return the tables of a network and the function that evaluates it."""
    assert block.network is not None
    layers, parts, declared, loops = block.network.layers, [], [], []
    for i, layer in enumerate(layers, start=1):
        parts.append(_table(f"{block.name}_w{i}", layer.weight))
        if layer.bias is not None:
            parts.append(_table(f"{block.name}_b{i}", layer.bias))
        target, source = "g" if i == len(layers) else f"h{i}", "z" if i == 1 else f"h{i - 1}"
        if target != "g":
            declared.append(f"    real {target}[{len(layer.weight)}];")
        loops.append(_layer(f"{block.name}_", i, layer, target, source))
    first, last = layers[0].weight.shape[1], len(layers[-1].weight)
    head = f"static void {block.name}_learner(const real z[{first}], real g[{last}])\n{{"
    return "\n".join([*parts, "", head, *declared, "    int i, j;", *loops, "}"])


def _layer(prefix: str, number: int, layer: Layer, target: str, source: str) -> str:
    rows, columns = layer.weight.shape
    start = "0" if layer.bias is None else f"{prefix}b{number}[i]"
    value = "sum" if layer.activation == "identity" else f"act_{layer.activation}(sum)"
    return f"""    for (i = 0; i < {rows}; i++) {{
        real sum = {start};
        for (j = 0; j < {columns}; j++) sum += {prefix}w{number}[i][j] * {source}[j];
        {target}[i] = {value};
    }}"""


def body(block: Block, result: str, entry: Callable[[str, int], str] = _plain) -> list[str]:
    """Return the lines that evaluate a block, in braces of their own, into the vector `result`."""
    write = _language(entry).write
    lines = [f"const real {name} = {write(node)};" for name, node in block.locals]
    if block.network is not None:
        features = block.network.features
        lines.append(f"real z[{len(features)}], g[{len(block.network.layers[-1].weight)}];")
        lines += [f"z[{i}] = {write(node)};" for i, node in enumerate(features)]
        lines.append(f"{block.name}_learner(z, g);")
    lines += [f"{result}[{i}] = {write(node)};" for i, node in enumerate(block.results)]
    return ["    {", *(f"        {line}" for line in lines), "    }"]


def _function(block: Block, program: Program) -> str:
    result = "dx" if block is program.rate else "y"
    unused = ["    (void)x;", "    (void)u;"]
    head = f"static void {block.name}(const real x[], const real u[], real {result}[])\n{{"
    return "\n".join([head, *unused, *body(block, result), "}"])


def advance(program: Program) -> list[str]:
    """Return the lines of a step that make `x` the next state."""
    scheme = program.scheme
    assert scheme is not None
    n = len(program.states)
    if scheme.kind == "discrete":
        return [
            "    {",
            f"        real dx[{n}];",
            "        rate(x, u, dx);",
            f"        for (i = 0; i < {n}; i++) x[i] = dx[i];",
            "    }",
        ]
    if program.ends == 1:
        return [f"    for (i = 0; i < {scheme.substeps}; i++) substep(x, u, u, u);"]
    held, halves = program.held, 2 * scheme.substeps
    points = ("first", "middle", "last")
    return [
        f"    for (i = 0; i < {halves}; i += 2) {{",
        f"        real {', '.join(f'{point}[{held}]' for point in points)};",
        "        int j;",
        f"        for (j = 0; j < {held}; j++) {{",
        f"            const real slope = (u[{held} + j] - u[j]) / {halves};",
        *(
            f"            {point}[j] = u[j] + (real)(i{f' + {k}' * (k > 0)}) * slope;"
            for k, point in enumerate(points)
        ),
        "        }",
        "        substep(x, first, middle, last);",
        "    }",
    ]


def _integrator(program: Program) -> list[str]:
    scheme = program.scheme
    assert scheme is not None
    n = len(program.states)
    if scheme.kind == "discrete":
        return []
    if scheme.kind == "rk4":
        return [
            f"static const real step = {_number(scheme.step)}; /* s "
            f"*/\n{_RK4.replace('NX', str(n))}"
        ]
    tables = [_table(f"m_{name}", matrix) for name, matrix in scheme.matrices]
    return ["\n".join(tables), _EXACT.replace("NX", str(n))]
