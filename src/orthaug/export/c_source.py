"""C99: one header and one source without allocation, in double or single precision."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from orthaug._base.checks import free_name
from orthaug.export import c_arithmetic
from orthaug.export.c_arithmetic import FIELD_WORDS
from orthaug.export.program import Program, Signal, Vectors


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

{c_arithmetic.arithmetic(program)}

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
    lines += c_arithmetic.body(
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
        *c_arithmetic.advance(program),
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
