"""Levenberg-Marquardt on normal equations, with ridge or evidence regularisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any

from annotated_types import Ge
from jaxtyping import Float

from orthaug._base.checks import Vector, check_count, check_number
from orthaug._base.jax import Array
from orthaug._base.registry import LIBRARY_ONLY, SpecLimit, check_fields
from orthaug.fitting.normal_equations import Normal
from orthaug.fitting.solvers import compiled
from orthaug.fitting.solvers.compiled import Settings, TrainingRun
from orthaug.fitting.solvers.damped_step import IDENTITY
from orthaug.fitting.solvers.limit import Limit, longest_of
from orthaug.fitting.solvers.minimize import Descent, SquaredResiduals, minimize
from orthaug.models.rows import Overlap

if TYPE_CHECKING:
    from orthaug.fitting.initial_states import Start


_ITERATIONS = 300  # the default limit


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Declaration of the solver.

    Args:
        iterations: trial steps at most. Only the default, 300, is a limit that a run passes where
            the loss still falls noticeably (`solvers/limit.py`), up to ten times.
        tolerance: two successive steps that lower the objective by less than this fraction end the
            run.
        longest: trial steps at most where the loss still falls; None for what `iterations` says.
    """

    gauss_newton = True

    iterations: Annotated[int, Ge(0), SpecLimit(Ge(1))] = _ITERATIONS
    tolerance: Annotated[float, Ge(0)] = field(default=1e-6, metadata=LIBRARY_ONLY)
    longest: int | None = field(default=None, metadata=LIBRARY_ONLY)

    def __post_init__(self) -> None:
        check_fields(self)
        check_number(self.tolerance, "tolerance")
        if self.longest is not None:
            check_count(self.longest, "longest", least=self.iterations)

    def at_most(self, iterations: int) -> LevenbergMarquardt:
        """Return the solver with fewer iterations, a limit that no run passes."""
        iterations = min(self.iterations, iterations)
        return replace(self, iterations=iterations, longest=iterations)

    @property
    def within_limit(self) -> LevenbergMarquardt:
        """The solver without iterations past the limit, for runs that only lead to others."""
        return self.at_most(self.iterations)

    def until(self, tolerance: float) -> LevenbergMarquardt:
        """Return the solver that ends at larger steps, if its own tolerance is smaller."""
        return replace(self, tolerance=max(self.tolerance, tolerance))

    def after(self, done: int) -> LevenbergMarquardt:
        """Return the solver with the iterations that are left after `done` of them."""
        limit = self.limit()
        left = max(limit.iterations - done, 0)
        return replace(self, iterations=left, longest=max(limit.longest - done, left))

    def limit(self, noticeable: float = 0.0) -> Limit:
        """Return the limit of a run; `noticeable` as in `Limit`."""
        longest = longest_of(self.iterations, _ITERATIONS) if self.longest is None else self.longest
        return Limit(self.iterations, longest, noticeable)

    def _settings(self, noticeable: float = 0.0, **options: Any) -> Settings:
        options = {"damping": IDENTITY} | options
        return Settings(limit=self.limit(noticeable), tolerance=self.tolerance, **options)

    def minimize(
        self,
        criterion: Callable[..., Normal],
        w: Float[Array, "nw"],
        arguments: tuple[object, ...],
        overlap: Overlap,
        **options: Any,
    ) -> TrainingRun:
        """Minimize `‖r(w)‖² + α‖w‖²` from `w`, compiled whole: the rows are in memory.

        See `compiled.minimize_compiled`.
        """
        return compiled.minimize_compiled(
            criterion, w, arguments, overlap, self._settings(**options)
        )

    def drive(
        self,
        normal_at: Callable[[Any, Overlap], Normal],
        w: Float[Array, "nw"],
        overlap: Overlap,
        **options: Any,
    ) -> TrainingRun:
        """Minimize the same pass by pass, for rows elsewhere; see `compiled.minimize_by_engine`."""
        return compiled.minimize_by_engine(normal_at, w, overlap, self._settings(**options))

    def descend(
        self,
        objective: SquaredResiduals,
        p: Vector,
        start: Start,
        *,
        noticeable: float = 0.0,
        **options: Any,
    ) -> Descent:
        """Minimize `‖r(p)‖² + α‖w‖²` from p, driven by the host; see `minimize.minimize`."""
        return minimize(
            objective, p, start, limit=self.limit(noticeable), tolerance=self.tolerance, **options
        )
