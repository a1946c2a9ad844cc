"""Criteria: declarations of what is minimised, the error one step ahead, several steps ahead, or of a free run."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Protocol, runtime_checkable

from annotated_types import Ge

from orthaug._base.errors import KeyedError
from orthaug._base.registry import LIBRARY_ONLY, check_fields

if TYPE_CHECKING:
    from orthaug.data.record import Record
    from orthaug.models.model import Model
    from orthaug.models.response import Response


@runtime_checkable
class Criterion(Protocol):
    """What `estimate(criterion=…)` takes."""

    @property
    def one_step(self) -> bool:
        """Whether it is the error one step ahead, which is linear in θ."""
        ...

    @property
    def simulates(self) -> bool:
        """Whether runs are compared by free runs over whole experiments."""
        ...

    @property
    def washout(self) -> int:
        """Leading steps of a free run that are not scored."""
        ...

    @property
    def flown(self) -> Simulation | None:
        """The free run that training makes; None for one step ahead."""
        ...

    def response(self, model: Model, record: Record) -> Response:
        """The response whose error judges a model on a validation part."""
        ...


@dataclass(frozen=True)
class Prediction:
    """Declaration: the error of the prediction `horizon` steps ahead; 1 is the paper's criterion (eq:cost_fun).

    Examples:
        >>> Prediction(10).flown
        Simulation(segment=10, washout=9, start_iterations=20, exact_start=True)
    """

    simulates = False
    washout = 0

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

    def response(self, model: Model, record: Record) -> Response:
        """The prediction."""
        return model.predict(record, self.horizon)


@dataclass(frozen=True)
class Simulation:
    """Declaration: the error of a free run over segments that start from measured lags.

    With a washout, or over whole experiments, the outputs before a segment count as noisy like all others: they are
    unknowns too (`InitialStates`). Segments without a washout start exactly from what was measured.

    Args:
        segment: steps of a segment; 0 for whole experiments.
        washout: leading steps of a segment that are not scored, until its start is forgotten.
        start_iterations: one-step iterations that training starts from.
        exact_start: whether a segment starts exactly from what was measured; None for the rule above.

    Examples:
        >>> Simulation(segment=0, washout=0).estimates_pasts  # whole experiments, from starts that are estimated
        True
    """

    one_step = False
    simulates = True

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

    def response(self, model: Model, record: Record) -> Response:
        """The free run."""
        return model.simulate(record)

    @property
    def estimates_pasts(self) -> bool:
        """Whether the outputs before a segment are unknowns."""
        if self.exact_start is not None:
            return not self.exact_start
        return self.washout > 0 or self.segment == 0
