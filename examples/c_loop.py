"""The fitted model as C in a loop, as a controller would call it, against the model itself.

    python examples/c_loop.py [folder]

Exports the paper's mass-spring-damper with its network, compiles it without a warning as C99, runs a free run sample by
sample in double and in single precision, and compares both with `simulate`. On Linux a loop of 1 kHz says how long a
step takes. With arm-none-eabi-gcc it also compiles for a Cortex-M4 and prints the size, and with qemu-system-arm runs
there and prints the instructions of a step. Needs gcc.
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
TIMED = """\
#include <stdio.h>
#include <time.h>
#include "plant.h"

static double microseconds(const struct timespec *a, const struct timespec *b)
{
    return 1e6 * (double)(b->tv_sec - a->tv_sec) + 1e-3 * (double)(b->tv_nsec - a->tv_nsec);
}

/* 1,000 samples, one every millisecond: the longest step, the mean in microseconds, and how many
 * samples began more than half a millisecond late. */
int main(void)
{
    plant_state state;
    plant_real u[1], y[1];
    struct timespec due, began, ended;
    double longest = 0, sum = 0;
    int k, late = 0;

    plant_start(&state);
    clock_gettime(CLOCK_MONOTONIC, &due);
    for (k = 0; k < 1000; k++) {
        due.tv_nsec += 1000000;
        if (due.tv_nsec >= 1000000000) { due.tv_nsec -= 1000000000; due.tv_sec++; }
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL) != 0) { }
        clock_gettime(CLOCK_MONOTONIC, &began);
        late += microseconds(&due, &began) > 500;
        u[0] = (plant_real)(k % 20 < 10 ? 0.1 : -0.1);
        plant_step(&state, u, y);
        clock_gettime(CLOCK_MONOTONIC, &ended);
        sum += microseconds(&began, &ended);
        if (microseconds(&began, &ended) > longest) longest = microseconds(&began, &ended);
    }
    printf("%g %g %d\\n", longest, sum / k, late);
    return state.flag;
}
"""
COUNTED = """\
#include <stdint.h>
#include <stdio.h>
#include "plant.h"

#define AT(address) (*(volatile uint32_t *)(address))

int _start(void);

/* The floating-point unit is coprocessors 10 and 11; the C library's start follows. */
static void reset(void)
{
    AT(0xE000ED88) |= 0xFu << 20;
    __asm volatile("dsb\\nisb");
    _start();
}
__attribute__((section(".vectors"), used)) static void (*const vectors[])(void) = {
    (void (*)(void))0x20400000, reset
};

/* Ticks of the timer in 1,000 steps, with inputs in no order. */
int main(void)
{
    plant_state state;
    plant_real u[1], y[1];
    uint32_t seed = 1, began, ended, k;

    plant_start(&state);
    AT(0xE000E014) = 0xFFFFFF; /* SysTick: from here down, by the processor's clock */
    AT(0xE000E018) = 0;
    AT(0xE000E010) = 5;
    began = AT(0xE000E018);
    for (k = 0; k < 1000; k++) {
        seed = 1664525u * seed + 1013904223u;
        u[0] = (plant_real)(seed >> 8) / 16777216 - (plant_real)0.5;
        plant_step(&state, u, y);
    }
    ended = AT(0xE000E018);
    printf("%lu %d\\n", (unsigned long)((began - ended) & 0xFFFFFF), state.flag);
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


def at_one_kilohertz(folder: Path) -> str:
    """How long a step takes in a loop that wakes every millisecond, for a second, in words."""
    if sys.platform != "linux":
        return "the loop of 1 kHz needs the clock of Linux: not run"
    (folder / "timed.c").write_text(TIMED)
    options = (*STRICT, "-D_POSIX_C_SOURCE=200809L")
    subprocess.run(
        ["gcc", *options, "timed.c", "plant.c", "-lm", "-o", "timed"], cwd=folder, check=True
    )
    done = subprocess.run([str(folder / "timed")], check=True, capture_output=True, text=True)
    longest, mean, late = map(float, done.stdout.split())
    return f"1 kHz for a second: a step takes {mean:.2f} µs, at most {longest:.2f} µs of 1,000; {late:.0f} steps began late"


def for_arm(folder: Path) -> str:
    """How large the code is on a microcontroller, and how many instructions a step has, in words."""
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
    return (
        f"Cortex-M4, single precision: {text} bytes of code and constants, "
        f"{int(data) + int(bss)} of data; {instructions(folder, compiler)}"
    )


def instructions(folder: Path, compiler: str) -> str:
    """How many instructions a step has, counted by QEMU's board with a Cortex-M4, in words."""
    emulator = shutil.which("qemu-system-arm")
    if emulator is None:
        return "no qemu-system-arm here: instructions are not counted"
    (folder / "counted.c").write_text(COUNTED)
    options = ["-std=gnu99", "-O2", *CORTEX_M4, "--specs=rdimon.specs"]
    placed = ["-Wl,--section-start=.vectors=0", "counted.c", "plant.c", "-lm", "-o", "counted.elf"]
    subprocess.run([compiler, *options, *placed], cwd=folder, check=True, capture_output=True)
    # An instruction lasts 2³ ns of the board's time, a tick of its timer 40 ns (25 MHz)
    board = [emulator, "-M", "mps2-an386", "-nographic", "-semihosting", "-icount", "shift=3"]
    done = subprocess.run(
        [*board, "-kernel", "counted.elf"],
        cwd=folder,
        check=True,
        capture_output=True,
        text=True,
        timeout=60,
    )
    ticks, flag = map(int, done.stdout.split())
    assert flag == 0
    return f"{ticks * 40 / 8 / 1000:,.0f} instructions a step (QEMU counts no cycles)"


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
        print(at_one_kilohertz(folder))
        print(for_arm(folder))
    return found


if __name__ == "__main__":
    if shutil.which("gcc") is None:
        sys.exit("no gcc here: nothing was compiled")
    main(*sys.argv[1:2])
