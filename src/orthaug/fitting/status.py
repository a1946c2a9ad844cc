"""How training ended, with cause and remedy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

MESSAGES: Mapping[str, str] = MappingProxyType(
    {
        "exact": "",
        "converged": "",
        "iteration_limit": (
            "training stopped at its limit of iterations while the loss was still falling; "
            "the model is usable, more iterations may improve it"
        ),
        "no_descent": (
            "no step lowered the loss; the start is already a minimum, or the learner's gradient is wrong. "
            "Try another seed or another activation"
        ),
        "non_finite": (
            "the loss is not finite at the start: (a) a learner input grows without bound, "
            "(b) the learner returns NaN, or (c) channels differ by many orders of magnitude. "
            "Rescale the channels or choose other learner inputs"
        ),
    }
)


@dataclass(frozen=True)
class Status:
    """How training ended: `code` is one of `MESSAGES`, `message` its cause and remedy.

    `loss` is the mean of squared errors with every output divided by its standard deviation.
    """

    code: str
    iterations: int
    seconds: float
    loss: float

    @property
    def message(self) -> str:
        return MESSAGES[self.code]

    @property
    def ok(self) -> bool:
        """Whether there is a usable model."""
        return self.code != "non_finite"
