"""A Python module that needs only NumPy, and one with a nonlinear system of python-control."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from orthaug.export.nodes import SHARED_NAMES
from orthaug.export.program import Program, Vectors
from orthaug.export.python_code import Dialect, arithmetic, declarations, python_language

_SAME = (*SHARED_NAMES, "abs", "sign", "power")
_OTHER = {"atan": "np.arctan", "atan2": "np.arctan2", "min": "np.minimum", "max": "np.maximum"}
NUMPY = Dialect(
    python_language({name: f"np.{name}" for name in _SAME} | _OTHER),
    vector="np.array([{}])",
    array="np.array({})",
    join="np.concatenate(({}))",
    constant="np.float64({})",
)


@dataclass(frozen=True)
class NumpyModule:
    """`NAME.py` with `step(state, inputs)` and `run(state, inputs)`."""

    summary = "a Python module that needs NumPy alone"

    def files(self, program: Program, vectors: Vectors) -> Mapping[str, str]:
        return {f"{program.name}.py": module(program)}

    def usage(self, program: Program) -> str:
        return f"""```python
import numpy as np
import {program.name} as model

state = model.start()                             # zeros, in the order of model.STATES
state, outputs = model.step(state, np.zeros({len(program.inputs)}))  # inputs as model.INPUTS
outputs = model.run(state, np.zeros((100, {len(program.inputs)})))   # a free run
```

`step` is a pure function. It needs NumPy and nothing else."""


def module(program: Program) -> str:
    """Return the text of the module."""
    return "\n".join(
        [
            f'"""{program.name}: one step of a fitted model. Written by orthaug."""',
            "",
            "import numpy as np",
            "",
            declarations(program),
            "",
            arithmetic(program, NUMPY),
            _STEP,
        ]
    )


_STEP = '''

def start():
    """A state of zeros."""
    return np.zeros(len(STATES))


def step(state, inputs):
    """The next state and the outputs of one sample."""
    x, u = np.asarray(state, dtype=float), np.asarray(inputs, dtype=float)
    with np.errstate(all="ignore"):
        y = output(x, u)
        return advance(x, u, y), y


def run(state, inputs):
    """The outputs of a free run, a row for each row of inputs."""
    outputs = np.empty((len(inputs), len(OUTPUTS)))
    for k, row in enumerate(inputs):
        state, outputs[k] = step(state, row)
    return outputs
'''


@dataclass(frozen=True)
class ControlModule:
    """`NAME.py`: the NumPy module with `system()`, a `NonlinearIOSystem` in discrete time."""

    summary = "a Python module that makes a NonlinearIOSystem of python-control"

    def files(self, program: Program, vectors: Vectors) -> Mapping[str, str]:
        labels = {
            kind: [signal.identifier for signal in getattr(program, kind)]
            for kind in ("inputs", "outputs", "states")
        }
        text = _SYSTEM.replace("NAME", program.name).replace("LABELS", repr(labels))
        return {f"{program.name}.py": module(program) + text}

    def usage(self, program: Program) -> str:
        return f"""```python
import control
import numpy as np
import {program.name} as model

plant = model.system()
time = np.arange(100) * model.SAMPLING_TIME
response = control.input_output_response(plant, time, np.zeros(({len(program.inputs)}, 100)))
```

It needs `control` (python-control) and NumPy. The system runs in discrete time with the model's
sampling time; its
states are named `y_1` for `y[k-1]`. `step` and `run` work without python-control."""


_SYSTEM = '''

def system(name="NAME"):
    """The model as a NonlinearIOSystem in discrete time."""
    import control

    def following(t, x, u, params):
        return step(x, np.reshape(u, len(INPUTS)))[0]

    def outputs(t, x, u, params):
        with np.errstate(all="ignore"):
            return output(np.asarray(x, dtype=float), np.reshape(u, len(INPUTS)))

    return control.NonlinearIOSystem(following, outputs, name=name, dt=SAMPLING_TIME, **LABELS)
'''
