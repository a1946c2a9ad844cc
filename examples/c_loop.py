"""The fitted model as C in a loop, as a controller would call it, against the model itself.

    python examples/c_loop.py [folder]

Exports the paper's mass-spring-damper with its network, compiles it without a warning as C99, runs a free run sample by
sample in double and in single precision, and compares both with `simulate`. With arm-none-eabi-gcc it also compiles for
a Cortex-M4 and prints the size. Needs gcc.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import orthaug as oa

STRICT = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic")
CORTEX_M4 = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-DPLANT_FLOAT")
LOOP = """\
#include <stdio.h>
#include "plant.h"

/* Reads an input a line; writes the output of each sample, as a control loop would take it. */
int main(void)
{
    plant_state state;
    plant_real u[1], y[1];
    double number;

    plant_start(&state);
    while (scanf("%lf", &number) == 1) {
        u[0] = (plant_real)number;
        plant_step(&state, u, y);
        if (state.flag) return 1; /* NaN or infinity: hold the last safe output here */
        printf("%.17g\\n", (double)y[0]);
    }
    return 0;
}
"""


def compiled(folder: Path, *options: str) -> Path:
    """The loop with the exported code, as a program."""
    program = folder / f"loop{''.join(options).replace('-D', '_')}"
    made = ["gcc", *STRICT, *options, "loop.c", "plant.c", "-lm", "-o", program.name]
    subprocess.run(made, cwd=folder, check=True)
    return program


def run(program: Path, inputs: np.ndarray) -> np.ndarray:
    """The outputs of the loop from rest."""
    given = "\n".join(repr(float(value)) for value in inputs)
    done = subprocess.run([str(program)], input=given, check=True, capture_output=True, text=True)
    return np.array(done.stdout.split(), dtype=float)


def for_arm(folder: Path) -> str:
    """How large the code is on a microcontroller, in words."""
    compiler, size = shutil.which("arm-none-eabi-gcc"), shutil.which("arm-none-eabi-size")
    if compiler is None or size is None:
        return "no arm-none-eabi-gcc here: not compiled for a microcontroller"
    tried = subprocess.run(
        [compiler, "-E", "-"], input="#include <math.h>", capture_output=True, text=True
    )
    if tried.returncode:
        return (
            "arm-none-eabi-gcc has no C library here (newlib): not compiled for a microcontroller"
        )
    subprocess.run(
        [compiler, *STRICT, *CORTEX_M4, "-c", "plant.c", "-o", "plant.o"], cwd=folder, check=True
    )
    done = subprocess.run([size, "plant.o"], cwd=folder, check=True, capture_output=True, text=True)
    text, data, bss = done.stdout.splitlines()[1].split()[:3]
    return f"Cortex-M4, single precision: {text} bytes of code and constants, {int(data) + int(bss)} of data"


def main(place: str | None = None) -> dict[str, float]:
    """Fit, export, compile, run, and print the largest deviation from `simulate` over the largest output."""
    example, found = oa.synthetic.mass_spring_damper(), {}
    model = oa.estimate(example.train, example.baseline, learner=oa.MLP((16,)), restarts=1).model
    force = example.test.experiments[0].inputs[:, 0]
    rest = np.zeros(model.form.first_row)  # rows before the first one
    resting = oa.Record.from_arrays(np.r_[rest, force], sampling_time=0.01, inputs=["force"])
    expected = model.simulate(resting, initial="zero").model[len(rest) :, 0]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(place or temporary) / "c"
        oa.export(model, folder, "c", name="plant", force=True)
        (folder / "loop.c").write_text(LOOP)
        for precision, options in (("double", ()), ("float", ("-DPLANT_FLOAT",))):
            outputs = run(compiled(folder, *options), force)
            found[precision] = float(np.abs(outputs - expected).max() / np.abs(expected).max())
            print(
                f"{precision}: {len(outputs)} samples, deviation {found[precision]:.1e} of the largest output"
            )
        print(for_arm(folder))
    return found


if __name__ == "__main__":
    if shutil.which("gcc") is None:
        sys.exit("no gcc here: nothing was compiled")
    main(*sys.argv[1:2])
