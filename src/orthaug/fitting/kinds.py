"""The structures, criteria and solvers that a spec knows by name, and what a solver declares.

A new one is a file, and an entry here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from orthaug._base.registry import Registry
from orthaug.fitting.criteria import Auto, Prediction, Simulation
from orthaug.fitting.solvers.adam_lbfgs import AdamLBFGS
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Additive, BaselinePenalty, Orthogonal, OrthogonalPenalty


@runtime_checkable
class Solver(Protocol):
    """What `estimate(solver=…)` takes: a frozen declaration."""

    @property
    def gauss_newton(self) -> bool:
        """Return whether it works on normal equations over the weights, with θ eliminated.

        Evidence and the free run need them. Other solvers get the criterion of θ and the weights
        together (`PaperCriterion`).
        """
        ...

    @property
    def iterations(self) -> int:
        """Steps at most."""
        ...

    @property
    def minimise(self) -> Callable[..., Any]:
        """One run: as `LevenbergMarquardt.minimise` on normal equations, otherwise as `AdamLBFGS.minimise`."""
        ...

    def at_most(self, iterations: int) -> Solver:
        """The same with fewer iterations, where that is the same method."""
        ...


STRUCTURES = Registry(
    "structure",
    {
        "additive": Additive,
        "orthogonal": Orthogonal,
        "orthogonal-penalty": OrthogonalPenalty,
        "baseline-penalty": BaselinePenalty,
    },
    reserved=("kind", "measure"),
)
_BESIDE = (
    "solver",
    "focus",
    "restarts",
    "ensemble",
    "seed",
    "regularization",
)  # the other keys of [training]
CRITERIA = Registry(
    "criterion",
    {"auto": Auto, "prediction": Prediction, "simulation": Simulation},
    reserved=_BESIDE,
)
SOLVERS = Registry(
    "solver",
    {"levenberg-marquardt": LevenbergMarquardt, "adam-lbfgs": AdamLBFGS},
    reserved=_BESIDE,
    beside=CRITERIA,
)
