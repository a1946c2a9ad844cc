"""The minimizer's contract: certified answers of NIST's problems from both starts, known minima of others, against SciPy."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).resolve().parents[1] / "benchmarks"))

from minimize import SOLVERS, by_compiled, by_orthaug, by_scipy, outcomes, summary
from minimize_problems import Problem, more, nist

NOT_REACHED = {
    "MGH17, start 1": "a minimum at infinity, an exponential that only the first row sees",
    "BoxBOD, start 1": "a minimum at infinity, y constant; MINPACK ends there, too",
    "MGH10, start 1": "more than 2000 steps along a bent valley",
    "16 Brown-Dennis": "more than 2000 steps where residuals of thousands bend the valley",
}


def parameters(problems: tuple[Problem, ...]) -> list:
    return [pytest.param(problem, id=problem.name.replace(", ", "-")) for problem in problems]


@pytest.mark.parametrize("problem", parameters(nist()[::2]))
def test_data_and_certified_values_give_the_certified_sum_of_squares(problem: Problem) -> None:
    """So data and models are NIST's; Lanczos1 has no noise, and its certified values are rounded."""
    (certified,) = problem.minima
    assert problem.theta is not None
    exact = problem.name.startswith("Lanczos1")
    assert problem.loss(problem.theta) == pytest.approx(
        certified, rel=0.0 if exact else 1e-9, abs=1e-20 if exact else 0.0
    )


@pytest.mark.parametrize("problem", parameters((*nist(), *more())))
def test_known_answers_are_reached_to_six_digits(problem: Problem) -> None:
    end = by_orthaug(problem)
    assert end.reached == (problem.name not in NOT_REACHED), (end.digits, end.p)
    assert problem.loss(end.p) <= problem.loss(problem.start)


@pytest.mark.parametrize("problem", parameters((*nist()[1::12], *more()[::12])))
def test_the_compiled_loop_takes_the_same_steps(problem: Problem) -> None:
    """Until rounding decides."""
    begun, other = by_compiled(problem, 6), by_orthaug(problem, 6)
    assert begun.evaluations == other.evaluations == 7
    np.testing.assert_allclose(begun.p, other.p, rtol=1e-6, atol=1e-9 * np.max(np.abs(other.p)))
    assert by_compiled(problem).reached


@pytest.mark.parametrize("name", ["Hahn1, start 1", "ENSO, start 1", "15 Kowalik-Osborne"])
def test_scipy_ends_at_the_same_parameters(name: str) -> None:
    problem = next(problem for problem in (*nist(), *more()) if problem.name == name)
    ours, theirs = by_orthaug(problem).p, by_scipy(problem, "lm").p
    np.testing.assert_allclose(ours, theirs, rtol=1e-5)


@pytest.mark.proof
@pytest.mark.parametrize("solver", SOLVERS)
def test_solvers_on_problems_with_known_answers(solver: str, record_property) -> None:
    """As many starts as SciPy's reach, but for the few that are named above."""
    found = outcomes(SOLVERS[solver])
    of_nist, others, digits, evaluations = summary(found)
    record_property(
        solver,
        f"NIST {of_nist} of {len(nist())}, others {others} of {len(more())}, {digits:.1f} digits, "
        f"{evaluations:.0f} evaluations",
    )
    assert of_nist + others >= len(found) - len(NOT_REACHED)
