"""Progress of training: from the iteration of a run to whoever shows it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

Tell = Callable[[int, int, float], None]
"""Called now and then with the number of the run, its iteration and the loss; it may raise to stop the training.

What it raises ends it without a result, but for `Enough`.
"""


RunTell = Callable[[int, float], None]
"""The same of one run: called with its iteration and the loss."""


class Enough(Exception):
    """Raised by whoever is told: end this run with what it has reached, as its result."""


def quiet(iteration: int, loss: float) -> None:
    """Nobody listens to a run."""


def _nothing(run: int, iteration: int, loss: float) -> None:
    """Nobody listens to any."""


@dataclass(frozen=True)
class Progress:
    """Tells `(run, iteration, loss)`. Runs and iterations are counted on from those that were told before.

    Examples:
        >>> told = Progress(lambda run, iteration, loss: print(run, iteration, loss))
        >>> told.after(runs=3)(0, 1, 0.5)
        3 1 0.5
        >>> told.of(2)(20, 0.5)
        2 20 0.5
    """

    tell: Tell = _nothing
    runs: int = 0
    iterations: int = 0

    def __call__(self, run: int, iteration: int, loss: float) -> None:
        self.tell(self.runs + run, self.iterations + iteration, loss)

    def after(self, *, runs: int = 0, iterations: int = 0) -> Progress:
        """The progress of what follows so many runs or iterations."""
        return replace(self, runs=self.runs + runs, iterations=self.iterations + iterations)

    def of(self, run: int) -> RunTell:
        """What one run tells: its iteration and the loss."""
        return lambda iteration, loss: self(run, iteration, loss)


SILENT = Progress()
