"""Levenberg-Marquardt on normal equations, with ridge or evidence regularisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

from annotated_types import Ge
from jaxtyping import Float

from orthaug._base.checks import Vector, check_number
from orthaug._base.jax import Array
from orthaug._base.registry import LIBRARY_ONLY, InSpec, check_fields
from orthaug.fitting.normal_equations import Normal
from orthaug.fitting.solvers import compiled
from orthaug.fitting.solvers.compiled import Settings, TrainingRun
from orthaug.fitting.solvers.descent import Descent, SquaredResiduals, descend
from orthaug.models.rows import Overlap


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Declaration of the solver.

    Args:
        iterations: trial steps at most.
        tolerance: two successive steps that lower the objective by less than this fraction end the run.
    """

    gauss_newton = True

    iterations: Annotated[int, Ge(0), InSpec(Ge(1))] = 300
    tolerance: Annotated[float, Ge(0)] = field(default=1e-6, metadata=LIBRARY_ONLY)

    def __post_init__(self) -> None:
        check_fields(self)
        check_number(self.tolerance, "tolerance")

    def at_most(self, iterations: int) -> LevenbergMarquardt:
        """The same with fewer iterations."""
        return replace(self, iterations=min(self.iterations, iterations))

    def minimise(
        self,
        criterion: Callable[..., Normal],
        w: Float[Array, "nw"],
        arguments: tuple[Any, ...],
        overlap: Overlap,
        **options: Any,
    ) -> TrainingRun:
        """`‖r(w)‖² + α‖w‖²` from `w`, compiled whole: the rows are in memory; see `compiled.minimise`."""
        return compiled.minimise(criterion, w, arguments, overlap, Settings(self.iterations, self.tolerance, **options))

    def drive(
        self, normal_at: Callable[[Any, Overlap], Normal], w: Float[Array, "nw"], overlap: Overlap, **options: Any
    ) -> TrainingRun:
        """The same, pass by pass: the rows are elsewhere; see `compiled.driven`."""
        return compiled.driven(normal_at, w, overlap, Settings(self.iterations, self.tolerance, **options))

    def descend(self, objective: SquaredResiduals, p: Vector, start: Any, **options: Any) -> Descent:
        """`‖r(p)‖² + α‖w‖²` from p, driven by the host; see `descent.descend`."""
        return descend(objective, p, start, iterations=self.iterations, tolerance=self.tolerance, **options)
