"""What is told of work: progress of training, to whoever shows it, and the logger `orthaug`, silent until one listens.

Stages of a fit are INFO, what was tried instead is DEBUG. What a user must know stands in warnings
of results.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

LOG = logging.getLogger("orthaug")
LOG.addHandler(logging.NullHandler())

ProgressCallback = Callable[[int, int, float], None]
"""Called now and then with the number of the run, its iteration and the loss; it may raise to stop
the training.

What it raises ends it without a result, but for `StopTraining`.
"""


Plan = Sequence[Mapping[str, Any]]
"""What is known of each run of a fit: `structure`, `start` from 1 on, `regularization`."""


RunProgress = Callable[[int, float], None]
"""The same of one run: called with its iteration and the loss."""


class StopTraining(Exception):
    """Raised by whoever is told: end this run with what it has reached, as its result."""


def quiet(iteration: int, loss: float) -> None:
    """Nobody listens to a run."""


def _unplanned(first: int, plan: Plan) -> None:
    """Nobody asks what the runs are."""


def _nothing(run: int, iteration: int, loss: float) -> None:
    """Nobody listens to any."""


@dataclass(frozen=True)
class Progress:
    """Tells `(run, iteration, loss)`.

    Runs and iterations are counted on from those that were told before.

    Examples:
        >>> told = Progress(lambda run, iteration, loss: print(run, iteration, loss))
        >>> told.after(runs=3)(0, 1, 0.5)
        3 1 0.5
        >>> told.of(2)(20, 0.5)
        2 20 0.5
    """

    tell: ProgressCallback = _nothing
    runs: int = 0
    iterations: int = 0
    plan: Callable[[int, Plan], None] = _unplanned
    """Called with the number of the first run of a fit, and what is known of its runs."""

    def __call__(self, run: int, iteration: int, loss: float) -> None:
        self.tell(self.runs + run, self.iterations + iteration, loss)

    def after(self, *, runs: int = 0, iterations: int = 0) -> Progress:
        """Return the progress of what follows so many runs or iterations."""
        return replace(self, runs=self.runs + runs, iterations=self.iterations + iterations)

    def planned(self, plan: Plan) -> None:
        """Say what the runs that follow are."""
        self.plan(self.runs, plan)

    def of(self, run: int) -> RunProgress:
        """Return what one run tells: its iteration and the loss."""
        return lambda iteration, loss: self(run, iteration, loss)


SILENT = Progress()


def show_log(level: str) -> None:
    """Write the log to standard error from `level` on, info or debug, with the time of each line."""
    if any(isinstance(handler, logging.StreamHandler) for handler in LOG.handlers):
        return
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s", "%H:%M:%S"))
    LOG.addHandler(handler)
    LOG.setLevel(level.upper())
    LOG.propagate = False
