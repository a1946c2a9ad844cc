"""A Python module that makes a CasADi Function, for optimal control."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from orthaug.export.program import Program
from orthaug.export.python_code import Dialect, arithmetic, declarations, python_language
from orthaug.export.vectors import Vectors

_SAME = ("sin", "cos", "tan", "atan", "atan2", "exp", "log", "sqrt", "sign", "floor", "tanh", "expm1", "log1p", "power")
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
        head = f'"""{program.name}: one step of a fitted model as a CasADi Function. Written by orthaug."""'
        step = _STEP.replace("NAME", program.name)
        text = [head, "", "import casadi as ca", "", declarations(program), "", arithmetic(program, CASADI), step]
        return {f"{program.name}.py": "\n".join(text)}

    def usage(self, program: Program) -> str:
        return f"""```python
import {program.name} as model

step = model.step()                # a casadi.Function: (state, inputs) -> (next_state, outputs)
state, outputs = step({[0] * len(program.states)}, {[0] * len(program.inputs)})
run = step.mapaccum(100)           # a free run of 100 steps, inputs in columns
```

It needs `casadi` (`pip install casadi`; the extra `orthaug[casadi]` installs it too). `step` takes symbols as well as
numbers, so that it can stand in an optimal control problem: one call for each step of the horizon."""


_STEP = '''

def step(name="NAME"):
    """The next state and the outputs of one sample, as a Function of state and inputs."""
    state, inputs = ca.SX.sym("state", len(STATES)), ca.SX.sym("inputs", len(INPUTS))
    outputs = output(state, inputs)
    following = ca.densify(ca.SX(advance(state, inputs, outputs)))
    results = [following, ca.densify(ca.SX(outputs))]
    return ca.Function(name, [state, inputs], results, ["state", "inputs"], ["next_state", "outputs"])
'''
