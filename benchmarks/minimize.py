"""Levenberg-Marquardt against SciPy's least squares, and optimistix where it is installed, on problems with known answers.

Every solver is driven to rounding and judged by the digits of its answer. Run: python benchmarks/minimize.py
"""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
from machine import describe
from minimize_problems import DIGITS, Problem, more, nist

from orthaug import LevenbergMarquardt
from orthaug._base.jax import jax, jnp
from orthaug.fitting.normal_equations import Normal
from orthaug.fitting.solvers.damped_step import MARQUARDT
from orthaug.models.rows import Overlap

MOST = 2000  # steps, or evaluations
TINY = 1e-15


class Outcome(NamedTuple):
    """Where a solver ended, to how many digits, and after how many evaluations of the residuals."""

    p: np.ndarray
    digits: float
    evaluations: int

    @property
    def reached(self) -> bool:
        return self.digits >= DIGITS


class Trial(NamedTuple):
    p: np.ndarray
    loss: float


class Linear(NamedTuple):
    hessian: np.ndarray
    gradient: np.ndarray
    start: None


class LeastSquares:
    """A problem as the objective of the solver."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self.physics = problem, len(problem.start)

    def evaluate(self, p: np.ndarray, start: Any) -> Trial:
        return Trial(p, self.problem.loss(p))

    def linearise(self, point: Trial) -> Linear:
        jacobian, residual = self.problem.jacobian(point.p), self.problem.residual(point.p)
        return Linear(jacobian.T @ jacobian, -jacobian.T @ residual, None)

    def samples(self, point: Trial) -> tuple[float, float]:
        return float(len(self.problem.residual(point.p))), 1.0


def by_orthaug(problem: Problem, most: int = MOST) -> Outcome:
    """Solve with the damping of the free run, driven by the host."""
    solver = LevenbergMarquardt(most, 1e-14, most)
    end = solver.descend(LeastSquares(problem), np.array(problem.start), None, damping=MARQUARDT)
    return Outcome(end.point.p, problem.digits(end.point.p), end.iterations + 1)


@dataclass(frozen=True)
class Criterion:
    """A problem as the criterion of the compiled loop, beside no physics."""

    residuals: Callable[[Any], Any]

    def __call__(self, p: Any, overlap: Overlap) -> Normal:
        residual, jacobian = self.residuals(p), jax.jacfwd(self.residuals)(p)
        return Normal(jacobian.T @ jacobian, -jacobian.T @ residual, residual @ residual, overlap)


def by_compiled(problem: Problem, most: int = MOST) -> Outcome:
    """Solve with the same damping, compiled whole."""
    n, solver = len(problem.start), LevenbergMarquardt(most, 1e-14, most)
    nothing = Overlap(jnp.zeros((0, n)), jnp.zeros(0))
    criterion, p = Criterion(problem.residuals), jnp.asarray(problem.start)
    end = solver.minimize(criterion, p, (), nothing, samples=n, damping=MARQUARDT)
    p = np.asarray(end.w)
    return Outcome(p, problem.digits(p), end.iterations + 1)


def by_scipy(problem: Problem, method: str) -> Outcome:
    options: dict[str, Any] = {"xtol": TINY, "ftol": TINY, "gtol": TINY, "max_nfev": MOST}
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        end = scipy.optimize.least_squares(
            problem.residual,
            problem.start,
            problem.jacobian,
            method=method,  # pyright: ignore[reportArgumentType]
            x_scale="jac",
            **options,
        )
    return Outcome(end.x, problem.digits(end.x), end.nfev)


def by_optimistix(problem: Problem) -> Outcome:
    import optimistix  # pyright: ignore[reportMissingImports]

    end = optimistix.least_squares(
        lambda p, _: problem.residuals(p),
        optimistix.LevenbergMarquardt(rtol=1e-13, atol=1e-13),
        jnp.asarray(problem.start),
        max_steps=MOST,
        throw=False,
    )
    p = np.asarray(end.value)
    jax.clear_caches()  # a program for each problem
    return Outcome(p, problem.digits(p), int(end.stats["num_steps"]))


SOLVERS: dict[str, Callable[[Problem], Outcome]] = {
    "orthaug, driven by the host": by_orthaug,
    "orthaug, compiled": by_compiled,
    "SciPy, lm (MINPACK)": lambda problem: by_scipy(problem, "lm"),
    "SciPy, trf": lambda problem: by_scipy(problem, "trf"),
}


def outcomes(solver: Callable[[Problem], Outcome]) -> list[tuple[Problem, Outcome]]:
    """Return where a solver ends from every start of every problem."""
    return [(problem, solver(problem)) for problem in (*nist(), *more())]


def summary(found: list[tuple[Problem, Outcome]]) -> tuple[int, int, float, float]:
    """Return starts reached of NIST and of the others, and the median digits and evaluations of those reached."""
    reached = [(problem, end) for problem, end in found if end.reached]
    of_nist = sum(problem.theta is not None for problem, _ in reached)
    digits = float(np.median([end.digits for _, end in reached]))
    evaluations = float(np.median([end.evaluations for _, end in reached]))
    return of_nist, len(reached) - of_nist, digits, evaluations


def table() -> list[tuple[int, int, float, float]]:
    """The numbers of README.md: a row for each solver that the project has anyway."""
    return [summary(outcomes(solver)) for solver in SOLVERS.values()]


def main() -> None:
    print(describe())
    solvers = dict(SOLVERS)
    if importlib.util.find_spec("optimistix") is not None:
        solvers["optimistix"] = by_optimistix
    print(f"| solver | NIST, of {len(nist())} | others, of {len(more())} | digits | evaluations |")
    print("|---|---|---|---|---|")
    for name, solver in solvers.items():
        found = outcomes(solver)
        *counts, digits, evaluations = summary(found)
        print(f"| {name} | {counts[0]} | {counts[1]} | {digits:.1f} | {evaluations:.0f} |")
        missed = [problem.name for problem, end in found if not end.reached]
        print(f"<!-- {name} misses: {'; '.join(missed) or 'none'} -->")


if __name__ == "__main__":
    main()
