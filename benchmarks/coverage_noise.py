"""Do intervals hold, or say that they do not, where the noise is coloured or uneven? Lagged physics and motions.

A silent miss is a parameter outside its interval without a warning that speaks of it. The level of the nonlinearity
test under such noise is here too.
Run: python benchmarks/coverage_noise.py [draws of lagged rows, default 40] [of motions, default 10]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from draws import seeds
from machine import describe
from scipy.signal import lfilter

import orthaug as oa
from orthaug.analysis.robustness import robust_free_run, robust_where_asked
from orthaug.physics.problem import pose
from orthaug.selection.nonlinearity import nonlinearity

DOUBTS = {
    "inconsistent", "sensor_noise", "coloured_residual", "too_long_memory", "unexplained", "not_identified",
    "not_unique", "no_standard_errors",
}  # fmt: skip
"""Codes that say that an interval may not hold."""
THETA = np.array([1.35, -0.48, 0.5])
LAGGED = oa.Baseline.from_terms(
    [
        oa.Term("a1", "y[k-1]", initial=1.2),
        oa.Term("a2", "y[k-2]", initial=-0.4),
        oa.Term("b", "u[k-1]", initial=0.4),
    ]
)
SEES = "y[k-1] - y[k-2]"
TS, MCK = 0.02, np.array([1.0, 2.0, 50.0])


class Row(NamedTuple):
    """A line of the table: `held` is the share of intervals that hold, `silent` that of silent misses, in percent."""

    system: str
    noise: str
    learner: str
    draws: int
    held: float
    silent: float
    width: float
    """Median width of an interval, in percent of the parameter."""
    shown: float
    """Share of the parameters that have an interval, in percent."""
    warned: float
    """Share of the draws with a warning of `DOUBTS`, in percent."""


def noise_of(kind: str, rng: np.random.Generator, u: np.ndarray) -> np.ndarray:
    """Noise of deviation 1 or so, as long as u."""
    white = rng.normal(size=len(u))
    if kind.startswith("AR("):
        pole = float(kind[3:-1])
        return np.asarray(lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], white))
    if kind == "heavy":
        return rng.standard_t(4, size=len(u)) / np.sqrt(2)
    if kind == "uneven":
        return white * np.abs(np.concatenate([[0.0], u[:-1]])) / u.std()
    return white


def input_of(rng: np.random.Generator, rows: int, hold: int) -> np.ndarray:
    return np.repeat(rng.normal(size=-(-rows // hold)), hold)[:rows]


def lagged_record(
    kind: str, seed: int, rows: int = 1000, size: float = 0.2, hold: int = 1, friction: float = 0.0
) -> Any:
    """y = 1.35 y₁ − 0.48 y₂ + 0.5 u₁ + δ(v) + e, the noise in the equation."""
    rng = np.random.default_rng([seed, 37])
    u = input_of(rng, rows, hold)
    e, y = size * noise_of(kind, rng, u), np.zeros(rows)
    for k in range(2, rows):
        v = y[k - 1] - y[k - 2]
        y[k] = THETA @ [y[k - 1], y[k - 2], u[k - 1]] - friction * np.tanh(v / 0.3) + e[k]
    return oa.Record.from_arrays(u, y, sampling_time=0.1)


def motion_record(
    kind: str, seed: int, rows: int = 1500, size: float = 0.05, place: str = "output"
) -> Any:
    """A mass, a spring and a damper by exact steps of 5 ms; noise on the position, or as a force."""
    rng, fine = np.random.default_rng([seed, 38]), 4
    u = 20 * input_of(rng, rows, 10)
    noise, (m, c, k) = noise_of(kind, rng, u), MCK
    force = u + (3 * noise if place == "force" else 0.0)
    x, found, h = np.zeros(2), [], TS / fine
    for f in force:
        found.append(x[0])
        for _ in range(fine):
            middle = x + h / 2 * np.array([x[1], (f - c * x[1] - k * x[0]) / m])
            x = x + h * np.array([middle[1], (f - c * middle[1] - k * middle[0]) / m])
    position = np.array(found)
    y = position + (
        size * position.std() * noise
        if place == "output"
        else 0.002 * position.std() * rng.normal(size=rows)
    )
    return oa.Record.from_arrays(u, y, sampling_time=TS, inputs=["force"], outputs=["position"])


def motion() -> Any:
    return oa.Motion.from_equations(
        states=[
            oa.State("x", "v", start="position"),
            oa.State("v", "(force - c*v - k*x)/m", start="derivative of position", learned=True),
        ],
        outputs=[oa.Output("position", "x")],
        inputs=["force"],
        parameters=[
            oa.PhysicalParameter(*given, min=0) for given in (("m", 1.2), ("c", 1.5), ("k", 60.0))
        ],
    )


def lagged_fit(
    record: Any, sees: str | None, seed: int
) -> tuple[Any, set[str], np.ndarray, np.ndarray | None]:
    """The fit as `orthaug fit` makes it, its warnings' codes, θ̂ and its intervals."""
    learner = None if sees is None else oa.MLP((6,), inputs=(sees,))
    fit = oa.estimate(
        record, LAGGED, learner=learner, criterion=oa.Prediction(), restarts=1, blocks=0, seed=seed
    )
    fit = robust_where_asked(fit, fit.model.predict(record))
    return fit, codes_of(fit), fit.theta, fit.interval


def motion_fit(
    record: Any, sees: str | None, seed: int, segment: int | None = None
) -> tuple[Any, set[str], Any, Any]:
    learner = None if sees is None else oa.MLP((6,), inputs=(sees,))
    options: dict[str, Any] = (
        {} if segment is None else {"criterion": oa.Simulation(segment=segment)}
    )
    fit = robust_free_run(
        oa.estimate(record, motion(), learner=learner, blocks=0, seed=seed, **options)
    )
    return fit, codes_of(fit), fit.values, fit.interval


def codes_of(fit: Any) -> set[str]:
    found = oa.diagnose(fit)
    return {
        warning.code for warning in (*fit.warnings, *(found.warnings if found is not None else ()))
    }


def row(
    system: str,
    noise: str,
    sees: str | None,
    truth: np.ndarray,
    record: Callable[[int], Any],
    fit: Callable[..., Any],
    draws: int,
) -> Row:
    """One line of the table. Parameters that a learner could imitate are left out: their truth is a split."""
    held, silent, width, shown, warned = [], [], [], [], []
    for seed in seeds(draws, system, noise, sees):
        made, codes, _, limits = fit(record(seed), sees, seed)
        own = np.ones(len(truth), dtype=bool)
        if sees is not None and made.model.form.separates:
            own = np.array([False, False, True])
        elif sees is not None:
            own = np.array([name in made.shared.untouched for name in made.problem.motion.names])
        warned.append(bool(codes & DOUBTS))
        if limits is None:
            shown += [False] * int(own.sum())
            continue
        inside = (limits[:, 0] <= truth) & (truth <= limits[:, 1])
        there = own & np.isfinite(limits).all(axis=1)
        shown += there[own].tolist()
        held += inside[there].tolist()
        silent += (~inside[there] & (not warned[-1])).tolist()
        width += (100 * np.ptp(limits, axis=1) / np.abs(truth))[there].tolist()
    share = lambda values: 100 * float(np.mean(values)) if values else float("nan")  # noqa: E731
    middle = float(np.median(width)) if width else float("nan")
    return Row(
        system,
        noise,
        sees or "none",
        draws,
        share(held),
        share(silent),
        middle,
        share(shown),
        share(warned),
    )


def lagged_rows(draws: int = 40) -> Iterator[Row]:
    """Lagged physics, trained one step ahead."""
    cases = [
        ("1000 rows", "white", {}, None),
        ("1000 rows", "heavy", {}, None),
        ("3000 rows", "AR(0.2)", {"rows": 3000}, None),
        ("2000 rows", "AR(0.3)", {"rows": 2000, "size": 0.1}, None),
        ("1000 rows, held input", "AR(0.9)", {"hold": 10}, None),
        ("1000 rows", "uneven", {}, None),
        ("300 rows", "uneven", {"rows": 300}, None),
        ("100 rows", "uneven", {"rows": 100}, None),
        ("friction", "white", {"friction": 0.15}, SEES),
        ("friction, 3000 rows", "AR(0.2)", {"friction": 0.15, "rows": 3000}, SEES),
        ("friction", "uneven", {"friction": 0.15}, SEES),
    ]
    for system, noise, options, sees in cases:
        yield row(
            system, noise, sees, THETA, partial(lagged_record, noise, **options), lagged_fit, draws
        )


def motion_rows(draws: int = 10) -> Iterator[Row]:
    """Mass, spring and damper, trained on the free run."""
    cases = [
        ("on the position", "white", {}, None, None),
        ("on the position", "AR(0.9)", {}, None, None),
        ("on the position, segments of 50", "AR(0.97)", {}, None, 50),
        ("on the position, 300 rows", "AR(0.97)", {"rows": 300}, None, None),
        ("on the position", "uneven", {}, None, None),
        ("as a force", "white", {"place": "force"}, None, None),
        ("as a force", "AR(0.9)", {"place": "force"}, None, None),
        ("on the position", "white", {}, "v", None),
        ("on the position", "AR(0.9)", {}, "v", None),
    ]
    for system, noise, options, sees, segment in cases:
        fit = partial(motion_fit, segment=segment)
        yield row(
            f"motion, {system}",
            noise,
            sees,
            MCK,
            partial(motion_record, noise, **options),
            fit,
            draws,
        )


def rows(lagged: int = 40, motions: int = 10) -> list[Row]:
    """Every line of the table, lagged physics first."""
    return [*lagged_rows(lagged), *motion_rows(motions)]


def nonlinear_level(draws: int = 200) -> list[tuple[str, float]]:
    """How often something nonlinear is said to be missing where nothing is, in percent, at the level of 5 %."""
    cases = [
        ("white", 1),
        ("heavy", 1),
        ("uneven", 1),
        ("AR(0.9)", 1),
        ("white", 10),
        ("AR(0.9)", 10),
    ]
    found = []
    for noise, hold in cases:
        tests = (
            nonlinearity(
                pose(lagged_record(noise, seed, hold=hold), LAGGED), ["y[k-1]", "y[k-2]", "u[k-1]"]
            )
            for seed in range(draws)
        )
        level = 100 * float(np.mean([test.found for test in tests if test is not None]))
        found.append((f"{noise}, input held for {hold}", level))
    return found


def selected_level(draws: int = 100) -> list[tuple[str, float]]:
    """Return the same inside `select`, which chooses the orders first, on half of the rows."""
    found = []
    for noise, hold in (("white", 1), ("white", 10), ("AR(0.9)", 1), ("AR(0.9)", 10)):
        tests = (
            oa.select(lagged_record(noise, seed, hold=hold), LAGGED, learner=None).nonlinearity
            for seed in range(draws)
        )
        level = 100 * float(np.mean([test is not None and test.found for test in tests]))
        found.append((f"{noise}, input held for {hold}", level))
    return found


def selected_table(draws: int = 100) -> list[float]:
    """Return the rates of `selected_level`."""
    return [level for _, level in selected_level(draws)]


def main(lagged: int = 40, motions: int = 10) -> None:
    print(describe())
    print(
        "\n| system | noise | learner sees | draws | held | silent misses | median width | "
        "shown | warned |"
    )
    print(9 * "|---" + "|")
    began = time.perf_counter()
    for one in chain(lagged_rows(lagged), motion_rows(motions)):
        shares = (
            f"{one.held:.0f} % | {one.silent:.1f} % | {one.width:.2g} % | {one.shown:.0f} % | "
            f"{one.warned:.0f} %"
        )
        print(
            f"| {one.system} | {one.noise} | {one.learner} | {one.draws} | {shares} |", flush=True
        )
    print(
        f"\n{time.perf_counter() - began:.0f} s. Nonlinearity test, rejections at 5 % where "
        "nothing is missing:"
    )
    for name, level in nonlinear_level():
        print(f"{name}: {level:.1f} %", flush=True)
    for name, level in selected_level():
        print(f"inside `select`, {name}: {level:.1f} %", flush=True)


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:]))
