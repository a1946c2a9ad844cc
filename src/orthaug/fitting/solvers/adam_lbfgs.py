"""The paper's pipeline as a declaration: Adam, then L-BFGS, over θ and the learner's weights together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from orthaug._base.checks import check_count, check_number


@dataclass(frozen=True)
class AdamLBFGS:
    """Declaration of the solver.

    Args:
        adam_iterations: steps of Adam with `learning_rate`.
        lbfgs_iterations: steps of L-BFGS (zoom line search) from where Adam ended, at most.
        learning_rate: of Adam, per step in normalised unknowns.
    """

    adam_iterations: int = 500
    lbfgs_iterations: int = 1000
    learning_rate: float = 1e-3

    gauss_newton: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_count(self.adam_iterations, "adam_iterations", least=0)
        check_count(self.lbfgs_iterations, "lbfgs_iterations", least=0)
        check_number(self.learning_rate, "learning_rate", positive=True)

    @property
    def iterations(self) -> int:
        """Steps at most."""
        return self.adam_iterations + self.lbfgs_iterations
