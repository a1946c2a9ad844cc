"""The endings of training: code, cause and remedy."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Ending(IntEnum):
    """The ending of a run. Compiled loops carry the number, programs read `code`."""

    code: str
    cause: str
    remedy: str

    def __new__(cls, number: int, code: str, cause: str = "", remedy: str = "") -> Ending:
        member = int.__new__(cls, number)
        member._value_, member.code, member.cause, member.remedy = number, code, cause, remedy
        return member

    RUNNING = (
        0,
        "iteration_limit",
        "training stopped at its limit of iterations while the loss was still falling",
        "the model is usable, more iterations may improve it",
    )
    CONVERGED = 1, "converged"
    NO_DESCENT = (
        2,
        "no_descent",
        "no step lowered the loss; the start is already a minimum, or the learner's gradient "
        "is wrong",
        "Try another seed or another activation",
    )
    NON_FINITE = (
        3,
        "non_finite",
        "the loss is not finite: (a) a learner input grows without bound, (b) the learner "
        "returns NaN, (c) channels differ by many orders of magnitude, or (d) `learning_rate` "
        "is too large",
        "Rescale the channels, choose other learner inputs, or lower the rate",
    )
    SPANNED = 4, "converged"
    """P⊥J = 0: the learner has nothing to learn beside the physics."""
    EXACT = 5, "exact"
    """No learner, no iteration."""

    STOPPED = (
        6,
        "stopped",
        "training was stopped on request while the loss was still falling",
        "the model is usable, more iterations may improve it",
    )

    @property
    def message(self) -> str:
        """Cause and remedy as one text; empty where there is nothing to say."""
        if not self.cause:
            return ""
        return f"{self.cause}{'. ' if self.remedy[0].isupper() else '; '}{self.remedy}"

    @property
    def usable(self) -> bool:
        """True where there is a model."""
        return self is not Ending.NON_FINITE


ALONE = {
    Ending.NO_DESCENT: (
        "no step of the physics' parameters lowered the loss: the start is already a minimum, "
        "or the free run is too sensitive there. Try other initial values, or a shorter "
        "`segment`"
    ),
    Ending.NON_FINITE: (
        "physics alone has no finite free run from its initial values. Give others, or bounds "
        "that keep it from diverging"
    ),
}
"""The messages of a training without a learner, where others speak of one."""


@dataclass(frozen=True)
class Status:
    """The ending of training.

    `loss` is the mean of squared errors with every output divided by its standard deviation,
    `start_loss` that of physics alone under the same criterion.
    """

    ending: Ending
    iterations: int
    seconds: float
    """Of training, without compiling its programs."""
    loss: float
    start_loss: float | None = None
    reason: str = ""
    """Cause and remedy, where more is known than how training ended."""

    def __repr__(self) -> str:
        return (
            f"Status({self.code}, {self.iterations} iterations, {self.seconds:.2f} s, loss "
            f"{self.loss:.6g})"
        )

    @property
    def code(self) -> str:
        return self.ending.code

    @property
    def message(self) -> str:
        return self.reason or self.ending.message

    @property
    def lines(self) -> list[str]:
        """The status as lines of a fit's summary."""
        ended = (
            f"status      {self.code}, {self.iterations} iterations, {self.seconds:.2f} s, "
            f"loss {self.loss:.6g}"
        )
        return [ended, f"            {self.message}"] if self.message else [ended]

    @property
    def ok(self) -> bool:
        """True where there is a usable model."""
        return self.ending.usable
