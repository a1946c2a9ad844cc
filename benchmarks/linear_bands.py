"""Do 95 % bands of the frequency response cover? At ten frequencies, over many draws of a known system.

ARX: a resonant second-order system with white noise in its equation, fitted one step ahead. Output error: the same
system with white noise on the sensor, fitted on the free run. Augmented: a cubic spring besides, left to a learner of
terms that holds it, and to six neurons that do not; the truth is the linear system about rest at the input 0.3.
Also the bands of poles and static gain. Gain and phase count each by itself.
Run: python benchmarks/linear_bands.py [draws, default 500; of neurons a fifth]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np
from machine import describe
from scipy.signal import lfilter

import orthaug as oa

SAMPLES, WARM_UP, STEP = 1500, 200, 0.01
A1, A2, B1 = 1.5, -0.7, 0.3
CUBIC, HELD = -0.03, 0.3
FREQUENCIES = np.geomspace(0.3, 45.0, 10)  # Hz; Nyquist's is 50
LINES = [oa.Term("a1", "y[k-1]"), oa.Term("a2", "y[k-2]"), oa.Term("b1", "u[k-1]")]
BASELINE = oa.Baseline.from_terms(LINES)


def record(
    seed: int, *, equation: float = 0.0, sensor: float = 0.0, cubic: float = 0.0
) -> oa.Record:
    """One draw."""
    rng = np.random.default_rng([seed, 41])
    n = SAMPLES + WARM_UP
    u, e, v = rng.normal(size=n), equation * rng.normal(size=n), sensor * rng.normal(size=n)
    if not cubic:
        y = lfilter([0.0, B1], [1.0, -A1, -A2], u) + lfilter([1.0], [1.0, -A1, -A2], e)
    else:
        y = np.zeros(n)
        for k in range(2, n):
            y[k] = A1 * y[k - 1] + A2 * y[k - 2] + B1 * u[k - 1] + cubic * y[k - 1] ** 3 + e[k]
    return oa.Record.from_arrays(u[WARM_UP:], (y + v)[WARM_UP:], sampling_time=STEP)


def truth(cubic: float) -> tuple[np.ndarray, float, float]:
    """The response at the frequencies, the magnitude of the poles and the static gain, about rest at `HELD`."""
    rest = (
        np.roots([cubic, 0.0, A1 + A2 - 1, B1 * HELD])
        if cubic
        else np.array([B1 * HELD / (1 - A1 - A2)])
    )
    y = float(min(rest[np.abs(rest.imag) < 1e-9].real, key=abs))
    a1 = A1 + 3 * cubic * y**2
    z = np.exp(2j * np.pi * FREQUENCIES * STEP)
    return (
        B1 * z / (z**2 - a1 * z - A2),
        float(np.abs(np.roots([1.0, -a1, -A2])).max()),
        B1 / (1 - a1 - A2),
    )


def arx(seed: int) -> oa.Estimate:
    return oa.estimate(record(seed, equation=0.1), BASELINE, learner=None)


def output_error(seed: int) -> oa.Estimate:
    return oa.estimate(
        record(seed, sensor=0.3), BASELINE, learner=None, criterion=oa.Simulation(0, 40)
    )


def of_terms(seed: int) -> oa.Estimate:
    """With the learner that can be right."""
    return oa.estimate(
        record(seed, equation=0.1, cubic=CUBIC), BASELINE, learner=oa.Terms(["y[k-1]**3"])
    )


def of_neurons(seed: int) -> oa.Estimate:
    """With one that can only come near."""
    learner = oa.MLP(hidden=(6,), inputs=("y[k-1]",))
    return oa.estimate(record(seed, equation=0.1, cubic=CUBIC), BASELINE, learner=learner)


CASES: dict[str, tuple[Callable[[int], oa.Estimate], float, float]] = {
    "ARX, physics alone": (arx, 0.0, 1.0),
    "output error, physics alone": (output_error, 0.0, 1.0),
    "ARX with a cubic term learned": (of_terms, CUBIC, 1.0),
    "ARX with a cubic that six neurons learn": (of_neurons, CUBIC, 0.2),
}


def coverage(name: str, draws: int) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Shares of draws that cover gain and phase at each frequency (10,), the poles' magnitude and the static gain."""
    fitted, cubic, share = CASES[name]
    draws = max(1, int(draws * share))
    response, magnitude, gain = truth(cubic)
    inside = np.zeros((2, len(FREQUENCIES)))
    of_pole = of_gain = 0
    for seed in range(draws):
        view = oa.linearize(fitted(seed).model, {"u": HELD}, frequencies=FREQUENCIES)[0]
        bode = view.bode
        size, phase = bode.magnitude_ci95[:, 0, 0], bode.phase_ci95[:, 0, 0]
        turned = np.degrees(np.angle(response))
        turned = turned + 360 * np.round((phase.mean(axis=1) - turned) / 360)
        for i, (band, true) in enumerate(((size, np.abs(response)), (phase, turned))):
            inside[i] += (band[:, 0] <= true) & (true <= band[:, 1])
        low, high = view.poles[0].magnitude_ci95
        of_pole += low <= magnitude <= high
        low, high = view.gain_ci95[0, 0]
        of_gain += low <= gain <= high
    return inside[0] / draws, inside[1] / draws, of_pole / draws, of_gain / draws


def row(name: str, draws: int = 500) -> list[float]:
    """In per cent: least, mean and largest coverage of the gain over the frequencies, the same of the phase, of the
    poles' magnitude, of the static gain."""
    size, phase, pole, gain = coverage(name, draws)
    spread = [f(values) for values in (size, phase) for f in (np.min, np.mean, np.max)]
    return [100 * float(value) for value in (*spread, pole, gain)]


def linear(draws: int = 500) -> list[list[float]]:
    """The rows of linear systems."""
    return [row(name, draws) for name in list(CASES)[:2]]


def of_more_draws() -> list[float]:
    """Of output error over 2000 draws, in per cent: least and largest coverage of the gain, and of the phase."""
    size, phase, *_ = coverage("output error, physics alone", 2000)
    return [100 * float(f(values)) for values in (size, phase) for f in (np.min, np.max)]


def augmented(draws: int = 500) -> list[list[float]]:
    """The rows of augmented ones."""
    return [row(name, draws) for name in list(CASES)[2:]]


def main(draws: int) -> None:
    print(describe())
    began = time.perf_counter()
    print(
        "| system | gain, least | mean | largest | phase, least | mean | largest | poles | "
        "static gain |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for name in CASES:
        print(f"| {name} | {' | '.join(f'{v:.1f} %' for v in row(name, draws))} |", flush=True)
    print(f"\n{draws} draws, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 500)
