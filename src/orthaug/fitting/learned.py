"""What training left, whatever the criterion, for the estimate to be concluded from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug.fitting.structures import Fixed
from orthaug.models.learners import Bound, Scaling


class FreeStatistics(NamedTuple):
    """What a training on the free run knows about its own errors."""

    noise: Matrix | None
    """Covariance (ny, ny) of the errors of the free run, in the outputs' units."""
    covariance: Matrix | None
    """Cov θ̂ (nθ, nθ) from the sensitivities."""
    freedom: float
    mean_square: float
    fixed: Fixed


@dataclass(frozen=True, eq=False)
class Learned:
    """What training left, whatever the criterion: the learner's weights, and its values F (N, ny) at the rows."""

    bound: Bound | None
    weights: Vector
    scaling: Scaling
    unit: Vector
    values: Float[np.ndarray, "N ny"]
    effective: float = 0.0
    gram: Matrix | None = None
    ridge: float = 0.0
    """Of the weights, in the units of `gram`."""
    middle: Callable[[Matrix], Matrix] | None = None
    """ΣψᵀΣ_eψ in the units of `gram`, for the noise covariance (ny, ny) of whitened outputs."""
    code: int | None = None
    iterations: int = 0
    seconds: float = 0.0
    coefficients: Vector | None = None
    """c = θ − θ_aux (nθ,) where it was an unknown of training; None where θ is solved."""
    free: FreeStatistics | None = None
    tilt: Matrix | None = None
    """(members, nθ) of an ensemble, whose weights are (members, nw)."""
    elsewhere: bool = False
    """Whether it is a function from another toolbox."""
