"""Criteria: what is minimised, as declarations. One step ahead, several, or over a free run."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, ClassVar

from annotated_types import Ge

from orthaug._base.errors import KeyedError
from orthaug._base.registry import LIBRARY_ONLY, check_fields


@dataclass(frozen=True)
class Prediction:
    """Declaration: the error of the prediction `horizon` steps ahead; 1 is the paper's criterion (eq:cost_fun)."""

    horizon: Annotated[int, Ge(1)] = 1

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def one_step(self) -> bool:
        """Whether it is the error one step ahead, which is linear in θ."""
        return self.horizon == 1

    @property
    def flown(self) -> Simulation | None:
        """The free run that gives it: segments of `horizon` steps whose last one is scored; None for one step."""
        return Simulation(self.horizon, self.horizon - 1, exact_start=True) if self.horizon > 1 else None


@dataclass(frozen=True)
class Simulation:
    """Declaration: the error of a free run over segments that start from measured lags.

    With a washout, or over whole experiments, the outputs before a segment are taken for as noisy as all others: they
    are unknowns too (`Pasts`). Segments without a washout start exactly from what was measured.

    Args:
        segment: steps of a segment; 0 for whole experiments.
        washout: leading steps of a segment that are not scored, until its start is forgotten.
        start_iterations: one-step iterations that training starts from.
        exact_start: whether a segment starts exactly from what was measured; None for the rule above.
    """

    one_step: ClassVar[bool] = False

    segment: Annotated[int, Ge(0)] = 512
    washout: Annotated[int, Ge(0)] = 40
    start_iterations: Annotated[int, Ge(0)] = 20
    exact_start: bool | None = field(default=None, metadata=LIBRARY_ONLY)

    def __post_init__(self) -> None:
        check_fields(self)
        if self.segment and self.washout >= self.segment:
            raise KeyedError(
                f"`washout` must be shorter than `segment`; got {self.washout} and {self.segment}: nothing is scored.",
                "washout",
                f": found {self.washout}; expected less than the segment, {self.segment}",
            )

    @property
    def flown(self) -> Simulation:
        """Itself: the free run that training makes."""
        return self

    @property
    def estimates_pasts(self) -> bool:
        """Whether the outputs before a segment are unknowns."""
        if self.exact_start is not None:
            return not self.exact_start
        return self.washout > 0 or self.segment == 0


Criterion = Prediction | Simulation
