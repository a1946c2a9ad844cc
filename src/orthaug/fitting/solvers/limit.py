"""The limit of a run's iterations, and its extension while the loss still falls noticeably.

A run that has not converged at its limit is judged by the last quarter of the limit: did the loss
fall there by more than the `noticeable` fraction? For residuals of variance σ² the parameters are
at most `√(N d)` standard errors from the minimum when the loss is the fraction d above it, since `N
d` is what χ² has still to fall by. What is still to fall is about what fell last, so a fall of
`1/(4 N)` means half a standard error: `noticeable_in(N)`.
"""

from __future__ import annotations

from typing import NamedTuple

_HALF_AN_ERROR = 0.25  # of χ²: (½ standard error)²
_FEWEST = 5  # steps of a window: one alone may be a trial that was rejected
_PROLONGED = 10  # times the limit, at most


class Limit(NamedTuple):
    """Trial steps that a run may take.

    Args:
        iterations: the limit.
        longest: the limit while the loss still falls noticeably; `iterations` for none beyond.
        noticeable: a relative fall of the loss over the last quarter of the limit that is worth
            going on for.
    """

    iterations: int
    longest: int
    noticeable: float = 0.0

    @property
    def window(self) -> int:
        """Number of last steps over which the fall of the loss is judged."""
        return max(self.iterations // 4, min(_FEWEST, self.iterations), 1)

    def is_past(self, done: int, before: float, loss: float) -> bool:
        """Return whether a run ends after `done` steps.

        Args:
            before: the loss where the last window began.
            loss: the loss now.
        """
        if done >= self.longest or not self.iterations:
            return True
        return bool(done) and done % self.iterations == 0 and not self.falls(before, loss)

    def falls(self, before: float, loss: float) -> bool:
        """Return whether the loss fell noticeably from `before`."""
        return relative_fall(before, loss) > self.noticeable

    def next_look(self, done: int) -> int:
        """Return the step after `done` where a window begins or the limit is reached."""
        end = min((done // self.iterations + 1) * self.iterations, self.longest)
        begin = end - self.window
        return begin if done < begin else end

    def begins_window(self, done: int) -> bool:
        """Return whether a window begins after `done` steps."""
        end = (
            min((done // self.iterations + 1) * self.iterations, self.longest)
            if self.iterations
            else 0
        )
        return done == end - self.window


def relative_fall(before: float, loss: float) -> float:
    """Return the relative change of the loss; with evidence it may also rise."""
    return abs(before - loss) / loss if loss > 0 else 0.0


class Tail(NamedTuple):
    """The last steps of a run.

    Args:
        done: steps of the run.
        limit: its limit of iterations.
        window: the number of last steps that are judged.
        fall: the fraction of itself by which the loss fell over them.
        noticeable: whether the run ended while the loss fell noticeably.
    """

    done: int
    limit: int
    window: int
    fall: float
    noticeable: bool

    @classmethod
    def of(cls, limit: Limit, done: int, before: float, loss: float, *, converged: bool) -> Tail:
        """Return the tail of a run with that limit; `before` and `loss` as in `Limit.reached`."""
        noticeable = not converged and limit.iterations > 0 and limit.falls(before, loss)
        return cls(
            done, limit.iterations, min(limit.window, done), relative_fall(before, loss), noticeable
        )

    @property
    def prolonged(self) -> bool:
        """True where the run went on past its limit."""
        return 0 < self.limit < self.done


def longest_of(iterations: int, default: int) -> int:
    """Return the largest number of steps of a run: ten times the default limit.

    A limit that somebody chose is not passed.
    """
    return _PROLONGED * iterations if iterations == default else iterations


def noticeable_in(residuals: float) -> float:
    """Return the noticeable fall of a loss over N residuals.

    At that fall, parameters still move by half a standard error.
    """
    return _HALF_AN_ERROR / max(residuals, 1.0)
