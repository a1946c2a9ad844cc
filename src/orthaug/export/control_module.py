"""A Python module that makes a nonlinear system of python-control."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from orthaug.export.numpy_module import module
from orthaug.export.program import Program
from orthaug.export.vectors import Vectors


@dataclass(frozen=True)
class ControlModule:
    """`NAME.py`: the NumPy module with `system()`, a `NonlinearIOSystem` in discrete time."""

    summary = "a Python module that makes a NonlinearIOSystem of python-control"

    def files(self, program: Program, vectors: Vectors) -> Mapping[str, str]:
        labels = {
            kind: [signal.identifier for signal in getattr(program, kind)] for kind in ("inputs", "outputs", "states")
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

It needs `control` (python-control) and NumPy. The system runs in discrete time with the model's sampling time; its
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
