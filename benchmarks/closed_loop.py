"""A cart and pole in the loop of a controller: θ by simulating the loop, and by the measured input.

The plant is unstable. A state feedback acts on the measured position and angle, noise included, so that the input
contains the noise as well. "loop" simulates the loop from the reference by `controller=`; "input" runs the plant from
the measured input, in segments of 1 s, because a longer run diverges. The disturbance is a force on the cart, an AR(1)
process with coefficient 0.95. With friction the physics lacks a dry friction of the cart, which a learner of its speed
takes up. Intervals are the ones that `orthaug fit` reports, and the plain ones.
Run: python benchmarks/closed_loop.py [draws, default 100] [cases, default all] [ways, default loop,input]
     [rows, default 2500] [first seed, default 500]
"""

from __future__ import annotations

import sys
import time
from typing import Any, NamedTuple

import numpy as np
from machine import describe
from scipy.signal import lfilter

import orthaug as oa
from orthaug.analysis.robustness import robust_free_run

ROWS, TS, SUBSTEPS = 2500, 0.02, 4
TRUE = {"M": 0.8, "m": 0.2, "l": 0.5, "c": 0.6}
GAINS = {"k1": -5.0, "k2": -9.0, "k3": -55.0, "k4": -12.0}  # of position, speed, angle and its rate
FILTER = 0.5  # share of a difference that enters its filter at a sample
NOISE = np.array([5e-4, 5e-4])  # m, rad
DRY = 0.5  # N
NAMES = ("M", "m", "l", "c")
DIRECT = oa.Simulation(segment=50, washout=0)


class Case(NamedTuple):
    """Deviation of the disturbance [N], and whether there is dry friction."""

    disturbance: float = 0.0
    friction: bool = False


CASES = {
    "noise": Case(),
    "disturbance": Case(disturbance=0.03),
    "friction": Case(friction=True),
}


def slope(x: np.ndarray, force: float, dry: float) -> np.ndarray:
    """Return the rates of position, speed, angle and its rate."""
    _, v, angle, rate = x
    big, small, length, c = TRUE.values()
    sine, cosine = np.sin(angle), np.cos(angle)
    total = force - c * v - dry * np.tanh(v / 0.05)
    gained = (total + small * length * rate**2 * sine - small * 9.81 * sine * cosine) / (
        big + small * sine**2
    )
    return np.array([v, gained, rate, (9.81 * sine - gained * cosine) / length])


def record_of(case: Case, seed: int, rows: int = ROWS) -> tuple[Any, Any]:
    """Return a record from the reference, and the same from the measured input."""
    rng = np.random.default_rng([seed, 7])
    reference = np.repeat(rng.uniform(-0.4, 0.4, rows // 50), 50)
    noise = NOISE * rng.normal(size=(rows, 2))
    pushed = lfilter([np.sqrt(1 - 0.95**2)], [1, -0.95], rng.normal(size=rows)) * case.disturbance
    x, filtered, before = np.zeros(4), np.zeros(2), np.zeros(2)
    measured, force = np.zeros((rows, 2)), np.zeros(rows)
    for k in range(rows):
        y = x[[0, 2]] + noise[k]
        filtered = filtered + FILTER * ((y - before) / TS - filtered)
        k1, k2, k3, k4 = GAINS.values()
        u = -(k1 * (y[0] - reference[k]) + k2 * filtered[0] + k3 * y[1] + k4 * filtered[1])
        before, measured[k], force[k] = y, y, u
        h, push = TS / SUBSTEPS, u + pushed[k]
        for _ in range(SUBSTEPS):
            a = slope(x, push, DRY * case.friction)
            b = slope(x + h / 2 * a, push, DRY * case.friction)
            c = slope(x + h / 2 * b, push, DRY * case.friction)
            x = x + h / 6 * (a + 2 * b + 2 * c + slope(x + h * c, push, DRY * case.friction))
    named = {"sampling_time": TS, "outputs": ["position", "angle"]}
    return (
        oa.Record.from_arrays(reference, measured, inputs=["reference"], **named),
        oa.Record.from_arrays(force, measured, inputs=["force"], **named),
    )


def motion_of(learned: bool) -> oa.Motion:
    """Return the cart and pole; with a learner its friction is left to that."""
    names = [name for name in NAMES if name != "c" or not learned]
    drag = "" if learned else " - c*v"
    return oa.Motion.from_equations(
        states=[
            oa.State("x", "v", start="position", unit="m"),
            oa.State("v", "gained", start="derivative of position", learned=learned),
            oa.State("a", "w", start="angle", unit="rad"),
            oa.State("w", "(9.81*sin(a) - gained*cos(a))/l", start="derivative of angle"),
        ],
        outputs=[oa.Output("position", "x"), oa.Output("angle", "a")],
        inputs=["force"],
        define={
            "gained": f"(force{drag} + m*l*w**2*sin(a) - m*9.81*sin(a)*cos(a))/(M + m*sin(a)**2)"
        },
        parameters=[oa.PhysicalParameter(name, 1.2 * TRUE[name], min=0) for name in names],
        substeps=2,
    )


def controller() -> oa.Controller:
    """Return the state feedback, which is known."""
    states, define = [], {}
    for name in ("position", "angle"):
        define[f"{name}_rate"] = (
            f"{name}_filtered + {FILTER}*(({name} - {name}_before)/Ts - {name}_filtered)"
        )
        states.append(oa.State(f"{name}_filtered", f"{name}_rate", 0.0))
        states.append(oa.State(f"{name}_before", name, name))
    law = "k1*(position - reference) + k2*position_rate + k3*angle + k4*angle_rate"
    return oa.Controller.from_equations(
        {"force": f"-({law})"}, states, constants=GAINS, define=define
    )


def fit_of(case: Case, seed: int, method: str, rows: int = ROWS) -> Any:
    """Return the fit of the loop, or that by the measured input; None where there is none."""
    loop, direct = record_of(case, seed, rows)
    options: dict[str, Any] = {"learner": None}
    if case.friction:
        options = {"learner": oa.MLP((4,), inputs=("v",)), "blocks": 0, "regularization": "none"}
    if method == "loop":
        options |= {"controller": controller(), "criterion": oa.Simulation(segment=0, washout=0)}
    else:
        options |= {"criterion": DIRECT}
    motion = motion_of(case.friction)
    fit = oa.estimate(loop if method == "loop" else direct, motion, **options)
    return fit if fit.status.ok and fit.std is not None else None


class Found(NamedTuple):
    """Of each fit: relative errors, and which intervals hold; NaN where a fit gives none."""

    errors: np.ndarray
    plain: np.ndarray
    reported: np.ndarray


def measure(case: Case, seeds: range, method: str, rows: int = ROWS) -> Found:
    """Return what the fits of some draws found, a row each."""
    found = []
    for seed in seeds:
        fit = fit_of(case, seed, method, rows)
        if fit is None:
            continue
        truth = np.array([TRUE[p] for p in fit.parameters.index])
        own = []
        for one in (fit, robust_free_run(fit)):
            none = one.interval is None
            held = np.full(len(truth), np.nan) if none else 1.0 * covered(one, truth)
            own.append(held if none else np.where(np.isnan(one.interval[:, 0]), np.nan, held))
        found.append((fit.values / truth - 1, *own))
    return Found(*(np.array(part) for part in zip(*found, strict=True)))


def covered(fit: Any, truth: np.ndarray) -> np.ndarray:
    """Return which of the intervals hold the truth."""
    return (fit.interval[:, 0] <= truth) & (truth <= fit.interval[:, 1])


def line_of(name: str, method: str, draws: int, found: Found) -> str:
    """Return a line of the table."""
    names = [p for p in NAMES if p != "c" or not CASES[name].friction]
    mean, spread = 100 * found.errors.mean(axis=0), 100 * found.errors.std(axis=0, ddof=1)
    errors = ", ".join(
        f"{p} {m:+.2f} ± {s:.2f}" for p, m, s in zip(names, mean, spread, strict=True)
    )
    plain, held = (100 * np.nanmean(part, axis=0) for part in (found.plain, found.reported))
    given = 100 * np.mean(~np.isnan(found.reported))
    return (
        f"| {name} | {method} | {len(found.errors)} of {draws} | {errors} | {plain.mean():.1f} "
        f"| {held.min():.0f} to {held.max():.0f} | {held.mean():.1f} | {given:.0f} |"
    )


def main(draws: int, names: list[str], methods: list[str], rows: int, first: int) -> None:
    print(describe())
    print(
        "| case | way | fits | error in %, mean ± deviation | plain, % | reported, % | mean | given, % |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name in names:
        for method in methods:
            began = time.perf_counter()
            found = measure(CASES[name], range(first, first + draws), method, rows)
            seconds = time.perf_counter() - began
            print(f"{line_of(name, method, draws, found)}  {seconds:.0f} s", flush=True)


if __name__ == "__main__":
    given = sys.argv[1:]
    asked = given[1].split(",") if len(given) > 1 and given[1] != "all" else list(CASES)
    ways = given[2].split(",") if len(given) > 2 else ["loop", "input"]
    rest = [int(one) for one in given[3:]] + [ROWS, 500][len(given[3:]) :]
    main(int(given[0]) if given else 100, asked, ways, *rest)
