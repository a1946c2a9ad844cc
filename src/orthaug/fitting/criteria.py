"""Criteria: declarations of the error that is minimised.

One step ahead, several steps ahead, or of a free run.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, runtime_checkable

import numpy as np
from annotated_types import Ge

from orthaug._base.checks import check_count
from orthaug._base.errors import KeyedError
from orthaug._base.registry import LIBRARY_ONLY, check_fields
from orthaug.fitting.colour import autocorrelation

if TYPE_CHECKING:
    from orthaug.data.record import Record
    from orthaug.models.model import Model
    from orthaug.models.response import Response


@runtime_checkable
class Criterion(Protocol):
    """A criterion as `estimate(criterion=…)` accepts it."""

    @property
    def one_step(self) -> bool:
        """True for the error one step ahead, which is linear in θ."""
        ...

    @property
    def simulates(self) -> bool:
        """True where runs are compared by free runs over whole experiments."""
        ...

    @property
    def washout(self) -> int:
        """Leading steps of a free run that are not scored."""
        ...

    @property
    def automatic(self) -> bool:
        """True where the data decide between one step ahead and the free run."""
        ...

    @property
    def free_run(self) -> Simulation | None:
        """The free run that training makes; None for one step ahead."""
        ...

    def on(self, record: Record, first_row: int = 0, most: int = 0) -> Any:
        """Return the criterion with its open choices made for a record."""
        ...

    @property
    def streamed(self) -> Any:
        """The criterion with its open choices made for rows that are not in memory."""
        ...

    def response(self, model: Model, record: Record) -> Response:
        """Return the response whose error judges a model on a validation part."""
        ...


Steps = Annotated[int, Ge(0)] | Literal["auto"]
SHORT = 512  # steps of a segment at least, where its length is left to the record
_MEMORIES = 20  # times that the outputs remember themselves: a segment shows their slowest mode
_LOOKED_AT = 2**17  # samples of which the autocorrelation is taken


@dataclass(frozen=True)
class Prediction:
    """Declaration: the error of the prediction `horizon` steps ahead.

    With a horizon of 1 it is the paper's criterion, the mean square of Y − Ŷ (`eq:cost_fun` in
    docs/notation.md).

    Examples:
        >>> Prediction(10).free_run
        Simulation(segment=10, washout=9, start_iterations=20, exact_start=True)
    """

    simulates = False
    automatic = False
    washout = 0

    horizon: Annotated[int, Ge(1)] = 1

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def one_step(self) -> bool:
        """True for the error one step ahead, which is linear in θ."""
        return self.horizon == 1

    @property
    def free_run(self) -> Simulation | None:
        """The free run of which it is a part: segments of `horizon` steps, the last one scored.

        None for one step.
        """
        return (
            Simulation(self.horizon, self.horizon - 1, exact_start=True)
            if self.horizon > 1
            else None
        )

    def on(self, record: Record, first_row: int = 0, most: int = 0) -> Prediction:
        """Return itself: it does not depend on a record."""
        return self

    @property
    def streamed(self) -> Prediction:
        """The declaration itself."""
        return self

    def response(self, model: Model, record: Record) -> Response:
        """Return the prediction."""
        return model.predict(record, self.horizon)


@dataclass(frozen=True)
class Simulation:
    """Declaration: the error of a free run over segments that start from measured lags.

    With a washout, or over whole experiments, the outputs before a segment count as noisy like all
    others: they are unknowns too (`InitialStates`). Segments without a washout start exactly from
    what was measured.

    Args:
        segment: steps of a segment; 0 for whole experiments; "auto" for 20 times as many steps as
            the outputs remember themselves, 512 or more, and whole experiments where these are not
            twice as long.
        washout: leading steps of a segment that are not scored, until its start is forgotten.
        start_iterations: one-step iterations that training starts from.
        exact_start: whether a segment starts exactly from what was measured; None for the rule
            above.

    Examples:
        >>> Simulation(segment=0, washout=0).estimates_pasts  # whole experiments, estimated starts
        True
    """

    one_step = False
    simulates = True
    automatic = False

    segment: Steps = "auto"
    washout: Annotated[int, Ge(0)] = 40
    start_iterations: Annotated[int, Ge(0)] = 20
    exact_start: bool | None = field(default=None, metadata=LIBRARY_ONLY)

    def __post_init__(self) -> None:
        check_fields(self)
        if self.segment != "auto":
            check_count(self.segment, "segment", least=0)
        if isinstance(self.segment, int) and self.segment and self.washout >= self.segment:
            raise KeyedError(
                f"`washout` must be shorter than `segment`; got {self.washout} and "
                f"{self.segment}: nothing is scored.",
                "washout",
                f": found {self.washout}; expected less than the segment, {self.segment}",
            )

    @property
    def free_run(self) -> Simulation:
        """The declaration itself: the free run that training makes."""
        return self

    @property
    def steps(self) -> int:
        """Steps of a segment, 0 for whole experiments.

        The fewest where their number is left to a record.
        """
        return max(SHORT, 2 * self.washout) if isinstance(self.segment, str) else self.segment

    def on(self, record: Record, first_row: int = 0, most: int = 0) -> Simulation:
        """Return the declaration with segments whose length suits a record, if none is given.

        Args:
            most: steps at most, 0 for any number.
        """
        if self.segment != "auto":
            return self
        segment = segment_for(record, first_row, self.washout)
        longer = most and (segment == 0 or segment > most)
        return replace(self, segment=max(most, self.washout + 1) if longer else segment)

    @property
    def streamed(self) -> Simulation:
        """The declaration with the shortest segments, if no length is given."""
        return replace(self, segment=self.steps)

    def response(self, model: Model, record: Record) -> Response:
        """Return the free run."""
        return model.simulate(record)

    @property
    def estimates_pasts(self) -> bool:
        """True where the outputs before a segment are unknowns."""
        if self.exact_start is not None:
            return not self.exact_start
        return self.washout > 0 or self.segment == 0


@dataclass(frozen=True)
class Auto:
    """Declaration: the error one step ahead, or that of the free run where this is not enough.

    A fit one step ahead stays where its free run is finite and no worse than that of physics alone
    where nothing was fitted, and where its residual is noise of the equation. Otherwise physics and
    learner are trained on the free run as well, and the best of all in free run is the result
    (`Estimate.focus`).

    Args:
        segment, washout, start_iterations: of the free run, as in `Simulation`.

    Examples:
        >>> Auto(washout=10).simulation.washout
        10
    """

    one_step = True
    simulates = False
    automatic = True

    segment: Steps = "auto"
    washout: Annotated[int, Ge(0)] = 40
    start_iterations: Annotated[int, Ge(0)] = 20

    def __post_init__(self) -> None:
        check_fields(self)
        Simulation(self.segment, self.washout, self.start_iterations)

    @property
    def free_run(self) -> None:
        """None: training begins one step ahead."""
        return None

    @property
    def simulation(self) -> Simulation:
        """The free run that is trained where one step ahead is not enough."""
        return Simulation(self.segment, self.washout, self.start_iterations)

    def on(self, record: Record, first_row: int = 0, most: int = 0) -> Auto:
        """Return itself: training begins one step ahead."""
        return self

    @property
    def streamed(self) -> Prediction:
        """One step ahead, for rows that are not in memory."""
        return Prediction()

    def response(self, model: Model, record: Record) -> Response:
        """Return the free run."""
        return model.simulate(record)


def segment_for(record: Record, first_row: int, washout: int) -> int:
    """Return the steps of a segment of a free run; 0 for whole experiments.

    It is 20 times as long as the outputs remember themselves (their autocorrelation is below 1/e),
    so that it shows the slowest mode that they have, and longer than its washout.
    """
    longest = max(record.experiments, key=len)
    steps = len(longest) - first_row
    outputs = longest.outputs[:_LOOKED_AT]
    centred = np.nan_to_num(outputs - np.nanmean(outputs, axis=0))
    found = [rho for rho in (autocorrelation(own[None]) for own in centred.T) if rho is not None]
    short = np.all([rho <= 1 / np.e for rho in found], axis=0)  # none of constant outputs
    remembered = int(np.argmax(np.append(short, True))) + 1
    segment = max(SHORT, _MEMORIES * remembered, 2 * washout)
    return 0 if 2 * segment > steps else segment
