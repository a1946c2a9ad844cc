"""Progress of training, and the logger `orthaug`, which is silent until a handler is added.

Stages of a fit are INFO, what was tried instead is DEBUG. What a user must know is in warnings
of results.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, NamedTuple

LOG = logging.getLogger("orthaug")
LOG.addHandler(logging.NullHandler())


class Stage(StrEnum):
    """Stages of a fit after its runs, in their order; a fit may omit some."""

    CHOICE = "choosing between the runs"
    SCORES = "scores"
    INTERVALS = "intervals and residual tests"
    VERDICT = "verdict on the learner"
    DOUBTS = "unmodelled effects"
    ADVICE = "trials of advice"
    FIGURES = "figures"
    REPORT = "report"

    def enter(self, part: str = "") -> None:
        """Log that a fit has come to this stage, or to a part of it."""
        _STAGE_LOG.info("%s", f"{self.value}: {part}" if part else self.value)


class ReachedStage(NamedTuple):
    """How far a fit is after its runs."""

    stage: Stage
    text: str
    """The stage in words, with its part."""

    @classmethod
    def of(cls, text: str, before: ReachedStage | None) -> ReachedStage:
        """Return what a logged text says, or what was reached before if that is later.

        A trial of advice comes to earlier stages again, which are part of it.
        """
        order, stage = list(Stage), Stage(text.partition(": ")[0])
        if before is not None and order.index(stage) < order.index(before.stage):
            return before
        return cls(stage, text)


_SHOWN_EVERY = 3.0  # s: how often the model of a run that has not ended is shown
_STAGE_LOG, _MODEL_LOG = LOG.getChild("stage"), LOG.getChild("model")
_MODEL_LOG.propagate = False  # its records are no text


def show_model(name: str, fit: Callable[[], object], record: object) -> None:
    """Hand a fit that training has reached to who follows this process.

    Args:
        fit: makes it, or None; it is called only where somebody follows.
        record: the training data.
    """
    if not _MODEL_LOG.handlers:
        return
    try:
        _MODEL_LOG.info("%s", name, extra={"fit": fit(), "record": record})
    except Exception:  # it is shown only: training goes on
        LOG.debug("a model of training cannot be shown", exc_info=True)


def watch_run(name: str, record: object) -> Watch | None:
    """Return what shows the fit of a run every few seconds; None where nobody follows."""
    if not _MODEL_LOG.handlers:
        return None
    shown = time.monotonic()

    def watch(fit: Callable[[], object]) -> None:
        nonlocal shown
        if time.monotonic() - shown >= _SHOWN_EVERY:
            show_model(name, fit, record)
            shown = time.monotonic()

    return watch


def follow_training(
    show_stage: Callable[[str], None], show_fit: Callable[[str, Any, Any], None] | None = None
) -> None:
    """Call functions with every stage, and every model with its record, of fits of this process.

    Models are made for this only; without `show_fit` they are not.
    """
    stop_following()
    _call_for_records(_STAGE_LOG, lambda record: show_stage(record.getMessage()))
    if show_fit is not None:
        _call_for_records(
            _MODEL_LOG, lambda record: show_fit(record.getMessage(), record.fit, record.record)
        )


def _call_for_records(log: logging.Logger, show: Callable[[Any], None]) -> None:
    handler = logging.Handler()
    handler.emit = show  # pyright: ignore[reportAttributeAccessIssue]
    log.handlers[:] = [handler]
    log.setLevel(logging.INFO)


def stop_following() -> None:
    """Call no function any more."""
    for log in (_STAGE_LOG, _MODEL_LOG):
        log.handlers.clear()
        log.setLevel(logging.NOTSET)


ProgressCallback = Callable[[int, int, float], None]
"""Called now and then with the number of the run, its iteration and the loss; it may raise to stop
the training.

What it raises ends it without a result, but for `StopTraining`.
"""


Plan = Sequence[Mapping[str, Any]]
"""Description of each run of a fit: `structure`, `start` from 1 on, `regularization`."""


RunProgress = Callable[[int, float], None]
"""Progress callback of one run: called with its iteration and the loss."""


Watch = Callable[[Callable[[], Any]], None]
"""Called between the steps of a run with what makes its present end, which costs time."""


class StopTraining(Exception):
    """Raised by a progress callback: end this run with its present result."""


def quiet(iteration: int, loss: float) -> None:
    """Ignore the progress of a run."""


def _ignore_plan(first: int, plan: Plan) -> None:
    """Ignore the plan of the runs."""


def _ignore_progress(run: int, iteration: int, loss: float) -> None:
    """Ignore the progress of all runs."""


@dataclass(frozen=True, repr=False)
class Progress:
    """Callback of `(run, iteration, loss)`.

    Runs and iterations are counted on from those that were reported before.

    Examples:
        >>> progress = Progress(lambda run, iteration, loss: print(run, iteration, loss))
        >>> progress.after(runs=3)(0, 1, 0.5)
        3 1 0.5
        >>> progress.of(2)(20, 0.5)
        2 20 0.5
    """

    report: ProgressCallback = _ignore_progress
    runs: int = 0
    iterations: int = 0
    plan: Callable[[int, Plan], None] = _ignore_plan
    """Called with the number of the first run of a fit, and with its plan."""

    def __repr__(self) -> str:
        """Return `SILENT`, as signatures show it, or the names of its callbacks."""
        if self == Progress():
            return "SILENT"
        named = getattr(self.report, "__qualname__", type(self.report).__name__)
        return f"Progress({named}, runs={self.runs}, iterations={self.iterations})"

    def __call__(self, run: int, iteration: int, loss: float) -> None:
        self.report(self.runs + run, self.iterations + iteration, loss)

    def after(self, *, runs: int = 0, iterations: int = 0) -> Progress:
        """Return the progress of the runs and iterations after so many."""
        return replace(self, runs=self.runs + runs, iterations=self.iterations + iterations)

    def planned(self, plan: Plan) -> None:
        """Pass on the plan of the runs that follow."""
        self.plan(self.runs, plan)

    def of(self, run: int) -> RunProgress:
        """Return the progress callback of one run: its iteration and the loss."""
        return lambda iteration, loss: self(run, iteration, loss)


SILENT = Progress()


def show_log(level: str) -> None:
    """Write the log to standard error from `level` on, with the time of each line.

    The level is info or debug.
    """
    if any(isinstance(handler, logging.StreamHandler) for handler in LOG.handlers):
        return
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s", "%H:%M:%S"))
    LOG.addHandler(handler)
    LOG.setLevel(level.upper())
    LOG.propagate = False
