"""Where a motion may start: states as they are declared, from what is measured about a row.

An output and its derivative are those of a local polynomial (Savitzky and Golay 1964). What nothing is said of starts
at zero. Training and simulation go on from there: a start is an unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from jaxtyping import Float, Int

from orthaug._base.checks import Matrix
from orthaug.physics.motion import Motion

_ROWS = 9  # of a local polynomial
_DEGREE = 2


def guess(
    motion: Motion, outputs: Matrix, rows: Sequence[int] | Int[np.ndarray, "r"], sampling_time: float
) -> Float[np.ndarray, "r n0"]:
    """The states at some rows, made of the outputs (N, ny) that were measured about them."""
    rows = np.asarray(rows, dtype=int)
    width = min(_ROWS, len(outputs))
    begin = np.clip(rows - width // 2, 0, len(outputs) - width)
    level = np.zeros((2, len(rows), outputs.shape[1]))
    if width:
        there = outputs[begin[:, None] + np.arange(width)]
        fitted = _polynomials(width)[rows - begin] @ there  # (r, degree + 1, ny)
        level[: fitted.shape[1]] = np.moveaxis(fitted[:, :2], 1, 0)
    names = [output.name for output in motion.outputs]
    states = np.zeros((len(rows), len(motion.states)))
    for i, state in enumerate(motion.states):
        source = state.from_output
        if source is not None:
            states[:, i] = level[source[1], :, names.index(source[0])] / sampling_time ** source[1]
        elif state.start is not None:
            states[:, i] = float(state.start)
    return states


@cache
def _polynomials(width: int) -> Float[np.ndarray, "width degree+1 width"]:
    """What gives the coefficients of a local polynomial about each of its rows from the values of all."""
    offset = np.arange(width)[None, :] - np.arange(width)[:, None]
    return np.linalg.pinv(offset[..., None] ** np.arange(min(_DEGREE, width - 1) + 1))
