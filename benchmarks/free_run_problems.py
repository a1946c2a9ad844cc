"""Problems for free runs: measured sets, and generated ones of which some are unstable or marginally stable."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from machine import data_folder

from orthaug import MLP, Baseline, Lags, Record, Term, read_record


@dataclass(frozen=True)
class FreeRunProblem:
    """Records to fit and to hold out, of one distribution, and what is declared."""

    name: str
    train: Record
    held_out: Record
    baseline: Baseline
    lags: Lags
    learner: MLP


def problems(least: int = 0) -> Iterator[FreeRunProblem]:
    """All twelve; measured ones only where their data are."""
    for make in (*MEASURED, *GENERATED)[least:]:
        if make not in MEASURED or data_folder().is_dir():
            yield make()


def _terms(*texts: str) -> Baseline:
    return Baseline.from_terms([Term(f"t{i}", text) for i, text in enumerate(texts)])


def _silverbox() -> FreeRunProblem:
    file = data_folder() / "silverbox" / "SNLS80mV.csv"
    train, held_out = (
        read_record(file, inputs=["V1"], outputs=["V2"], sampling_time=0.001638468, rows=rows)
        for rows in ((40650, 43650), (80000, 84000))
    )
    baseline = _terms("V2[k-1]", "V2[k-2]", "V1[k]", "V1[k-1]", "V1[k-2]", "1")
    return FreeRunProblem(
        "silverbox",
        train,
        held_out,
        baseline,
        Lags(2, 3, 0),
        MLP((10,), inputs=("V2[k-1]", "V2[k-2]")),
    )


def _mr_damper() -> FreeRunProblem:
    file = data_folder() / "mr_damper" / "damper.mat"
    train, held_out = (
        read_record(file, inputs=["X"], outputs=["y"], sampling_time=0.005, rows=rows)
        for rows in ((0, 2000), (2000, 3499))
    )
    baseline = _terms("y[k-1]", "X[k]", "X[k-1]", "sign(X[k])", "1")
    return FreeRunProblem("MR damper", train, held_out, baseline, Lags(3, 5, 0), MLP((8,)))


def _tanks(first: str, second: str) -> Callable[[], FreeRunProblem]:
    def make() -> FreeRunProblem:
        file = data_folder() / "cascaded_tanks" / "dataBenchmark.csv"
        train, held_out = (
            read_record(
                file,
                inputs=["u"],
                outputs=["y"],
                sampling_time=4.0,
                columns={"u": f"u{part}", "y": f"y{part}"},
            )
            for part in (first, second)
        )
        baseline = _terms("y[k-1]", "y[k-2]", "u[k-1]", "sqrt(max(y[k-1], 0))", "1")
        return FreeRunProblem(
            f"tanks, {first}", train, held_out, baseline, Lags(3, 3, 1), MLP((8,))
        )

    return make


def _simulated(
    name: str,
    derivative: Callable[[np.ndarray, np.ndarray], np.ndarray],
    step: float,
    *,
    force: Callable[[np.random.Generator, int], np.ndarray],
    feedback: Callable[[np.ndarray, float], float] | None = None,
    outputs: tuple[int, ...] = (0,),
    states: int = 2,
    rows: int = 1000,
    noise: float = 0.01,
    baseline: Baseline | None = None,
    lags: Lags = Lags(2, 2, 1),  # noqa: B008  (frozen)
    hidden: int = 8,
    seed: int = 0,
) -> FreeRunProblem:
    """Runge-Kutta with ten substeps, the input held; sensor noise in shares of the output's deviation."""
    records = []
    for part in range(2):
        rng = np.random.default_rng([seed, part])
        u, x, measured = force(rng, rows), np.zeros(states), np.zeros((rows, len(outputs)))
        applied = np.zeros(rows)
        h = step / 10
        for k in range(rows):
            measured[k] = x[list(outputs)]
            applied[k] = u[k] + (feedback(x, u[k]) if feedback else 0.0)
            now = np.array([applied[k]])
            for _ in range(10):
                k1 = derivative(x, now)
                k2 = derivative(x + h / 2 * k1, now)
                k3 = derivative(x + h / 2 * k2, now)
                x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + derivative(x + h * k3, now))
        noisy = measured + noise * measured.std(axis=0) * rng.normal(size=measured.shape)
        records.append(Record.from_arrays(applied, noisy, sampling_time=step))
    if baseline is None:
        baseline = _terms("y[k-1]", "y[k-2]", "u[k-1]", "u[k-2]")
    return FreeRunProblem(name, records[0], records[1], baseline, lags, MLP((hidden,)))


def _held(rng: np.random.Generator, rows: int, hold: int, size: float) -> np.ndarray:
    return size * np.repeat(rng.normal(size=-(-rows // hold)), hold)[:rows]


def _friction() -> FreeRunProblem:
    def derivative(x: Any, u: Any) -> Any:
        friction = 2.0 * np.tanh(20 * x[1]) * (1 + np.exp(-np.abs(x[1]) / 0.1))
        return np.array([x[1], u[0] - x[1] - 60 * x[0] - friction])

    return _simulated("friction", derivative, 0.02, force=lambda r, n: _held(r, n, 10, 8.0))


def _duffing() -> FreeRunProblem:
    def derivative(x: Any, u: Any) -> Any:
        return np.array([x[1], u[0] - 0.8 * x[1] - 20 * x[0] - 40 * x[0] ** 3])

    return _simulated("duffing", derivative, 0.05, force=lambda r, n: _held(r, n, 5, 12.0))


def _pendulum() -> FreeRunProblem:
    """Swings through large angles, hardly damped."""

    def derivative(x: Any, u: Any) -> Any:
        return np.array([x[1], u[0] - 0.05 * x[1] - 9.81 * np.sin(x[0])])

    return _simulated("pendulum", derivative, 0.05, force=lambda r, n: _held(r, n, 6, 2.0))


def _inverted_pendulum() -> FreeRunProblem:
    """Unstable without its controller; the controller's output is the measured input."""

    def derivative(x: Any, u: Any) -> Any:
        return np.array([x[1], u[0] - 0.2 * x[1] + 9.81 * np.sin(x[0])])

    control = {
        "force": lambda r, n: _held(r, n, 8, 8.0),
        "feedback": lambda x, u: -25 * x[0] - 5 * x[1],
    }
    return _simulated("inverted pendulum", derivative, 0.02, **control)


def _double_integrator() -> FreeRunProblem:
    def derivative(x: Any, u: Any) -> Any:
        return np.array([x[1], u[0] - 0.5 * x[1] * np.abs(x[1])])

    control = {"force": lambda r, n: _held(r, n, 15, 3.0), "feedback": lambda x, u: -0.3 * x[0]}
    return _simulated("double integrator", derivative, 0.05, **control)


def _tank() -> FreeRunProblem:
    def derivative(x: Any, u: Any) -> Any:
        return np.array(
            [
                u[0] - 0.6 * np.sqrt(max(x[0], 0.0)),
                0.6 * np.sqrt(max(x[0], 0)) - 0.5 * np.sqrt(max(x[1], 0)),
            ]
        )

    force = {"force": lambda r, n: 0.6 + np.abs(_held(r, n, 20, 0.6))}
    return _simulated("two tanks", derivative, 0.5, outputs=(1,), **force)


def _saturation() -> FreeRunProblem:
    def derivative(x: Any, u: Any) -> Any:
        return np.array([x[1], 4 * np.tanh(u[0]) - 1.2 * x[1] - 9 * x[0]])

    return _simulated(
        "saturated input", derivative, 0.1, force=lambda r, n: _held(r, n, 4, 1.5), noise=0.05
    )


def _coupled() -> FreeRunProblem:
    """Two masses, two outputs, a hardening spring between them."""

    def derivative(x: Any, u: Any) -> Any:
        spring = 15 * (x[0] - x[1]) + 60 * (x[0] - x[1]) ** 3
        return np.array(
            [x[2], x[3], u[0] - spring - 10 * x[0] - 0.6 * x[2], spring - 5 * x[1] - 0.6 * x[3]]
        )

    names = [f"y{j}[k-{i}]" for j in (1, 2) for i in (1, 2)] + ["u[k-1]", "u[k-2]"]
    terms = [Term(f"p{j}{i}", text, output=f"y{j}") for j in (1, 2) for i, text in enumerate(names)]
    options = {"outputs": (0, 1), "states": 4, "baseline": Baseline.from_terms(terms)}
    return _simulated(
        "two masses", derivative, 0.05, force=lambda r, n: _held(r, n, 6, 6.0), **options
    )


MEASURED = (_silverbox, _mr_damper, _tanks("Est", "Val"), _tanks("Val", "Est"))
GENERATED = (
    _friction,
    _duffing,
    _pendulum,
    _inverted_pendulum,
    _double_integrator,
    _tank,
    _saturation,
    _coupled,
)
