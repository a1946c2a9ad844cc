"""A step of the paper's mass-spring-damper model in exported C against the same arithmetic by hand, and in NumPy.

Run: python benchmarks/export_step.py (needs gcc and size)
"""

from __future__ import annotations

import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from machine import describe

import orthaug as oa
from orthaug.models.model import Model

STEPS, ROUNDS = 1_000_000, 15
OPTIONS = ("gcc", "-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic")
NEURONS = 16

TIMER = """
#define _POSIX_C_SOURCE 199309L
#include "model.h"
#include <stdio.h>
#include <time.h>
void by_hand(double past[3], const double u[], double y[]);

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

int main(void)
{
    static double u[4096];
    int i, round;
    for (i = 0; i < 4096; i++) u[i] = 100.0 * (double)((i * 7919) % 4096 - 2048) / 2048.0;
    for (round = 0; round < ROUNDS; round++) {
        model_state state;
        double past[3] = {0, 0, 0}, y[1], z[1], sum = 0, begin, middle, end;
        model_start(&state);
        begin = now();
        for (i = 0; i < STEPS; i++) { model_step(&state, u + (i & 4095), y); sum += y[0]; }
        middle = now();
        for (i = 0; i < STEPS; i++) { by_hand(past, u + (i & 4095), z); sum -= z[0]; }
        end = now();
        printf("%.6e %.6e %.3e %.3e\\n", (middle - begin) / STEPS, (end - middle) / STEPS, y[0] - z[0], sum);
    }
    return 0;
}
"""


def paper_model() -> Model:
    """The paper's example, fitted with a network of 16."""
    example = oa.synthetic.mass_spring_damper()
    fit = oa.estimate(
        example.train,
        example.baseline,
        lags=oa.Lags(na=2, nb=1, nk=1),
        learner=oa.MLP((NEURONS,)),
        solver=oa.LevenbergMarquardt(iterations=30),
        seed=0,
    )
    return fit.model


def by_hand(model: Model) -> str:
    """What one would write for this model: arrays, two loops, no checks."""
    bound, numbers = model.form.bound, model.numbers
    w1, b1, w2, b2 = (np.asarray(leaf) for leaf in bound.leaves(np.asarray(numbers.weights)))
    gain = float(numbers.gain[0])
    tables = {
        "w1": w1.ravel(),
        "b1": b1,
        "w2": gain * w2.ravel(),
        "centre": numbers.centre,
        "half": numbers.halfwidth,
    }
    tables |= {"theta": model.theta - model.theta_aux}
    text = "\n".join(
        f"static const double {name}[] = {{{', '.join(repr(float(v)) for v in values)}}};"
        for name, values in tables.items()
    )
    return f"""#include <math.h>
{text}
void by_hand(double past[3], const double u[], double y[]);
void by_hand(double past[3], const double u[], double y[])
{{
    double z[3], f = {gain * float(b2[0])!r};
    int i, j;
    for (i = 0; i < 3; i++) z[i] = (past[i] - centre[i]) / half[i];
    for (i = 0; i < {NEURONS}; i++) {{
        double a = b1[i];
        for (j = 0; j < 3; j++) a += w1[3 * i + j] * z[j];
        f += w2[i] * tanh(a);
    }}
    y[0] = theta[0] * past[0] + theta[1] * past[1] + theta[2] * past[2] + f;
    past[1] = past[0];
    past[0] = y[0];
    past[2] = u[0];
}}
"""


def run(*command: str, folder: Path) -> str:
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout


def main() -> None:
    print(describe())
    print(
        subprocess.run(
            ["gcc", "--version"], capture_output=True, text=True, check=True
        ).stdout.splitlines()[0]
    )
    model = paper_model()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "c"
        oa.export(model, folder, "c")
        (folder / "hand.c").write_text(by_hand(model))
        (folder / "timer.c").write_text(TIMER)
        sizes = [f"-DSTEPS={STEPS}", f"-DROUNDS={ROUNDS}"]
        run(*OPTIONS, *sizes, "model.c", "hand.c", "timer.c", "-lm", "-o", "timer", folder=folder)
        rounds = np.array(
            [line.split() for line in run("./timer", folder=folder).splitlines()], dtype=float
        )
        exported, hand = np.median(rounds[:, :2], axis=0)
        ratio = np.median(rounds[:, 0] / rounds[:, 1])
        print(
            f"C, exported: {1e6 * exported:.3f} us a step; by hand {1e6 * hand:.3f} us; ratio "
            f"{ratio:.2f}"
        )
        print(f"largest difference after a run: {np.abs(rounds[:, 2]).max():.1e}")
        for label, option in (
            ("double, -O2", []),
            ("float, -O2", ["-DMODEL_FLOAT"]),
            ("float, -Os", ["-DMODEL_FLOAT", "-Os"]),
        ):
            run(*OPTIONS, *option, "-fstack-usage", "-c", "model.c", folder=folder)
            text, data, bss = run("size", "model.o", folder=folder).splitlines()[1].split()[:3]
            stack = [line.split("\t") for line in (folder / "model.su").read_text().splitlines()]
            used = {place.rsplit(":", 1)[-1]: int(size) for place, size, _ in stack}
            print(
                f"{label}: code and constants {text} bytes, data {data}, bss {bss}; stack by "
                f"function {used}"
            )
        run(
            *OPTIONS,
            "-fsanitize=address,undefined",
            "model.c",
            "check.c",
            "-lm",
            "-o",
            "check",
            folder=folder,
        )
        print(f"sanitizers: {run('./check', folder=folder).strip()}")
    numpy_step = oa.numpy_step(model)
    state, inputs = np.zeros(3), np.array([50.0])
    times = []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        for _ in range(2000):
            state, _ = numpy_step(state, inputs)
        times.append((time.perf_counter() - began) / 2000)
    print(f"NumPy: {1e6 * np.median(times):.1f} us a step")


if __name__ == "__main__":
    main()
