"""Do nominal 95 % intervals hold the truth in 95 % of noise draws? θ, predictions and physical parameters.

Static example, data set 1, 30 dB, training warm-started from the noiseless fit with the same ridge (evidence: with
about the ridge that it arrives at); and a mass-spring-damper without friction.
Run: python benchmarks/coverage.py [draws, default 2000]
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable

os.environ.setdefault(
    "OPENBLAS_NUM_THREADS", "1"
)  # the matrices are small, and its threads would wait for JAX's

import numpy as np
from machine import describe
from scipy.signal import lfilter

import orthaug as oa
from orthaug.inference.covariance import interval

# M, c, k of the mass-spring-damper, and its sampling time
TRUE, TS = (np.array([1.0, 100.0, 1000.0]), 0.01)
LABELS = (
    "θ1, θ3, training",
    "θ1, θ3, uniform",
    "θ1, θ3, paper's convention",
    "200 predictions, mean",
)
ALLOWED = ("94 to 96", "93 to 97", "about 99.4", "93 to 97")


def inside(limits: np.ndarray, truth: np.ndarray | float) -> np.ndarray:
    """Which intervals (n, 2) hold the truth."""
    return (limits[:, 0] <= truth) & (truth <= limits[:, 1])


def static(regularization: str | float, ridge: float) -> Callable[[int], list[np.ndarray]]:
    """One draw: what is inside its interval, a vector for each of `LABELS`."""
    example = oa.synthetic.static(1)
    start, long = (
        oa.estimate(example.train, example.baseline, regularization="none"),
        oa.LevenbergMarquardt(3000, 1e-10),
    )
    noiseless = oa.estimate(
        example.train, example.baseline, initial=start, regularization=ridge, solver=long
    )
    held_out = example.test.rows(0, 200)
    truth, clean = held_out.experiments[0].outputs, example.train.experiments[0]
    node, weight = np.polynomial.legendre.leggauss(64)
    # Uniform({"u[k]": (-0.6, 0.6)}) with 64 nodes, not 2¹⁸
    measure = oa.Samples({"u[k]": 0.6 * node}, weight / 2)

    def draw(seed: int) -> list[np.ndarray]:
        noise = np.random.default_rng([seed, 1]).normal(
            0.0, oa.synthetic.NOISE_30_DB, clean.outputs.shape
        )
        record = oa.Record.from_arrays(clean.inputs, clean.outputs + noise)
        fit = oa.estimate(
            record, example.baseline, initial=noiseless, regularization=regularization
        )
        moved = fit.split(measure)
        if seed == 0:
            exact = fit.split(oa.Uniform({"u[k]": (-0.6, 0.6)}))
            assert np.allclose(moved.theta, exact.theta, rtol=1e-10) and np.allclose(
                moved.std, exact.std, rtol=1e-6
            )
        paper = np.sqrt(np.diag(fit.joint_covariance("paper"))[:2])
        error = (fit.model.predict(held_out).model - truth)[:, 0]
        return [
            inside(fit.interval, example.theta),
            inside(moved.interval, example.theta),
            inside(interval(fit.theta, paper, fit.freedom), example.theta),
            inside(
                interval(error, oa.prediction_std(fit.model, held_out)[0][:, 0], fit.freedom), 0.0
            ),
        ]

    return draw


def mass_spring_damper() -> Callable[[int], list[np.ndarray]]:
    """One draw: which of m, c, k are inside their intervals. Backward Euler, the noise in the equation."""
    gamma = "(m + c*Ts + ks*Ts**2)"
    physics = oa.PhysicsMap.of(
        [
            oa.PhysicalParameter(n, p, u)
            for n, p, u in (("m", 0.8, "kg"), ("c", 80.0, "Ns/m"), ("ks", 800.0, "N/m"))
        ],
        {"theta1": f"(2*m + c*Ts)/{gamma}", "theta2": f"-m/{gamma}", "theta3": f"Ts**2/{gamma}"},
        {"Ts": TS},
    )
    terms = zip(
        physics.theta_names, ("y[k-1]", "y[k-2]", "u[k-1]"), physics.initial_theta(), strict=True
    )
    baseline = oa.Baseline.from_terms(
        [oa.Term(name, text, initial=float(value)) for name, text, value in terms]
    )
    theta = physics.theta(TRUE)
    force, poles = np.random.default_rng(0).normal(0.0, 100.0, 2000), [1.0, -theta[0], -theta[1]]
    clean = lfilter([0.0, theta[2]], poles, force)

    def draw(seed: int) -> list[np.ndarray]:
        noise = np.random.default_rng([seed, 2]).normal(0.0, 0.00018, len(force))
        record = oa.Record.from_arrays(
            force, clean + lfilter([1.0], poles, noise), sampling_time=TS
        )
        return [
            inside(
                np.array(oa.estimate(record, baseline, learner=None).physical(physics).ci95), TRUE
            )
        ]

    return draw


def shares(draw: Callable[[int], list[np.ndarray]], draws: int) -> list[list[float]]:
    """Per kind of interval the coverage of each in per cent, the mean where there are many."""
    found = zip(*(draw(seed) for seed in range(draws)), strict=True)
    covered = [100 * np.mean(hits, axis=0) for hits in found]
    return [[float(share.mean())] if len(share) > 3 else share.tolist() for share in covered]


def table() -> list[list[float]]:
    """The numbers of benchmarks/README.md, in its order: paper's convention under the ridge only."""
    ridge, evidence = shares(static(1e-4, 1e-4), 2000), shares(static("evidence", 1e-2), 2000)
    return [*ridge, *evidence[:2], evidence[3], *shares(mass_spring_damper(), 2000)]


def default(draws: int = 200) -> list[float]:
    """Under the default, each draw trained anew: mean, least and largest coverage of the 200 prediction intervals."""
    example = oa.synthetic.static(1)
    held_out, clean = example.test.rows(0, 200), example.train.experiments[0]
    hits = []
    for seed in range(draws):
        noise = np.random.default_rng([seed, 1]).normal(
            0.0, oa.synthetic.NOISE_30_DB, clean.outputs.shape
        )
        fit = oa.estimate(
            oa.Record.from_arrays(clean.inputs, clean.outputs + noise), example.baseline
        )
        error = (fit.model.predict(held_out).model - held_out.experiments[0].outputs)[:, 0]
        hits.append(
            inside(
                interval(error, oa.prediction_std(fit.model, held_out)[0][:, 0], fit.freedom), 0.0
            )
        )
    covered = 100 * np.mean(hits, axis=0)
    return [float(covered.mean()), float(covered.min()), float(covered.max())]


def unregularized() -> list[float]:
    """Without regularization: the least and the largest share of a fit's prediction intervals, over 100 draws."""
    draw = static("none", 1e-4)
    single = [100 * draw(seed)[3].mean() for seed in range(100)]
    return [min(single), max(single), float(np.mean(single))]


def rows(
    name: str, draw: Callable[[int], list[np.ndarray]], draws: int, labels: tuple, allowed: tuple
) -> None:
    """Print the lines of the table of one example."""
    began = time.perf_counter()
    covered = shares(draw, draws)
    spent = f"{1e3 * (time.perf_counter() - began) / draws:.0f} ms"
    for label, share, limits in zip(labels, covered, allowed, strict=True):
        print(
            f"| {name} | {label} | {', '.join(f'{v:.1f}' for v in share)} % | {limits} % | "
            f"{spent} |",
            flush=True,
        )


def main(draws: int) -> None:
    print(describe())
    print(
        f"{draws} draws: a coverage of 95 % is seen with a standard error of "
        f"{100 * np.sqrt(0.0475 / draws):.1f} %.\n"
    )
    print("| example | intervals of | coverage | allowed | a draw |\n|---|---|---|---|---|")
    rows("static, ridge 1e-4", static(1e-4, 1e-4), draws, LABELS, ALLOWED)
    rows("static, evidence", static("evidence", 1e-2), draws, LABELS, ALLOWED)
    print(
        "static, default, 200 draws: mean {:.1f} %, points from {:.0f} to {:.0f} %".format(
            *default()
        )
    )
    rows("mass-spring-damper", mass_spring_damper(), draws, ("m, c, k",), ("94 to 96",))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2000)
