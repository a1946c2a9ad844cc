"""Weights of several outputs against each other, in criterion and measure alike.

Errors e (ny,) count as `‖W e‖²`. The rows of Φ, of the learner and of Y are multiplied by the same
W, so that θ is solved exactly (F1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector, check_choice
from orthaug._base.errors import InputError, show

CHOICES = ("auto", "none", "std", "covariance")
# Of one weight against another: beyond, an output does not count at all
_SMALLEST, _LARGEST = (1e-12, 1e12)


@dataclass(frozen=True, eq=False)
class OutputWeights:
    """The weight matrix W, and how it was chosen.

    `matrix` (ny, ny) is W, scaled so that whitened outputs have a mean square of one; `unit` is
    that scale, against which penalties count. `kind` is "none", "std", "covariance" or "given";
    `choice` is what was asked for.
    """

    kind: str
    matrix: Matrix
    unit: float
    choice: str | tuple[float, ...]

    @property
    def one_output(self) -> bool:
        """True for a single output, which needs no weight."""
        return len(self.matrix) == 1

    def as_dict(self) -> dict[str, Any]:
        """Return the choice and W."""
        return {"kind": self.kind, "matrix": self.matrix.tolist()}

    def __str__(self) -> str:
        texts = {
            "none": "every output in its own unit",
            "std": "each output in its standard deviation",
            "covariance": "outputs weighted by the covariance of their errors",
            "given": "outputs weighted as given",
        }
        return texts[self.kind]

    def rows(self, values: Float[np.ndarray, "N ny ..."]) -> Float[np.ndarray, "N ny ..."]:
        """Return the rows in whitened outputs."""
        return times(self.matrix, values)

    def outputs(self, rows: Float[np.ndarray, "N ny ..."]) -> Float[np.ndarray, "N ny ..."]:
        """Return whitened rows in the outputs' units."""
        return times(np.linalg.inv(self.matrix), rows)

    def whitened(self, covariance: Matrix) -> Matrix:
        """Return a covariance (ny, ny) of the outputs in whitened outputs."""
        return self.matrix @ covariance @ self.matrix.T

    def covariance(self, whitened: Matrix) -> Matrix:
        """Return a covariance of whitened outputs in the outputs' units."""
        inverse = np.linalg.inv(self.matrix)
        return inverse @ whitened @ inverse.T


def times(
    matrix: np.ndarray, values: Float[np.ndarray, "N ny ..."]
) -> Float[np.ndarray, "N ny ..."]:
    """Return every row's outputs times one matrix (ny, ny), or a matrix per row (N, ny, ny)."""
    if matrix.shape[-1] == 1:  # one output: the same number without a sum
        return values * matrix.reshape(-1, *([1] * (values.ndim - 1)))
    return np.einsum("oi,ki...->ko..." if matrix.ndim == 2 else "koi,ki...->ko...", matrix, values)


def check_output_weights(choice: Any, ny: int) -> None:
    """Raise InputError for anything but a known name or one positive weight per output."""
    if isinstance(choice, str):
        check_choice(choice, CHOICES, "`output_weights`")
        return
    expected = (
        f"expected one of {', '.join(CHOICES)}, or {ny} positive weights, one for each output"
    )
    listed = isinstance(choice, Sequence) or (isinstance(choice, np.ndarray) and choice.ndim > 0)
    if not listed or any(isinstance(w, bool | str) for w in choice):
        raise InputError(f"`output_weights` is {show(choice)}; {expected}.")
    try:
        values = np.asarray(choice, dtype=float)
    except (TypeError, ValueError, OverflowError):
        values = np.zeros(0)
    if values.shape != (ny,) or not np.all(np.isfinite(values) & (values > 0)):
        raise InputError(f"`output_weights` is {show(choice)}; {expected}.")
    if values.min() < _SMALLEST * values.max():
        raise InputError(
            f"`output_weights` {show(choice)} differ by more than {_LARGEST:g}; leave the "
            "output out instead."
        )


def weigh_outputs(choice: str | Sequence[float], deviation: Vector) -> OutputWeights:
    """Return W for outputs of these standard deviations (ny,).

    Args:
        choice: "none" for the plain sum of squares, "std" for each output in its standard
            deviation, numbers for the weights of the squared errors. "auto" and "covariance" begin
            with "std".
    """
    if len(deviation) == 1:  # one output: the weight changes nothing, penalties count in its unit
        scale = float(1 / deviation[0])
        return OutputWeights(
            "none" if choice == "none" else "std", np.array([[scale]]), scale, "std"
        )
    if choice in ("auto", "std", "covariance"):
        return OutputWeights("std", np.diag(1 / deviation), 1.0, str(choice))
    given = choice if isinstance(choice, str) else tuple(float(w) for w in choice)
    root = np.ones(len(deviation)) if isinstance(given, str) else np.sqrt(given)
    scale = float(1 / np.sqrt(np.mean((root * deviation) ** 2)))
    return OutputWeights(
        "none" if isinstance(given, str) else "given", np.diag(scale * root), scale, given
    )


def by_covariance(white: Matrix, outputs: Matrix) -> OutputWeights:
    """Return W from a matrix that whitens the errors; `outputs` (ny, ny) is their covariance."""
    scale = float(1 / np.sqrt(np.trace(white @ outputs @ white.T) / len(white)))
    return OutputWeights("covariance", scale * white, scale, "covariance")
