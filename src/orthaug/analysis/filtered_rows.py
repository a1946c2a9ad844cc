"""Rows of a free run's errors and of what moves them, filtered until noise in them is white."""

from __future__ import annotations

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.columns import span
from orthaug._base.filters import autoregression, moving_sum
from orthaug.analysis.output_response import LinearRun
from orthaug.fitting.whiteness import whitening_filter

_FILLINGS, _SEED = 3, 20261125  # of what the columns explain with noise, and their key
RANK = 1e-9
"""Singular value over the largest of columns that responses of a run are independent from."""
_MOST_USED = 0.9  # of the rows, by columns


def error_scale(runs: list[LinearRun]) -> Vector:
    """Return the root mean square of each output's errors, 1 where it is 0."""
    scale = np.sqrt(np.mean(np.concatenate([run.error for run in runs]) ** 2, axis=0))
    return np.where(scale > 0, scale, 1.0)


def stacked_rows(
    runs: list[LinearRun], columns: list[np.ndarray], scale: Vector
) -> list[np.ndarray]:
    """Return columns and errors of every run (T, ny, k + 1), in units of each output's errors."""
    joined = zip(columns, runs, strict=True)
    return [
        np.concatenate([one, run.error[..., None]], axis=2) / scale[:, None] for one, run in joined
    ]


def error_colours(
    runs: list[LinearRun], base: list[np.ndarray]
) -> tuple[list[np.ndarray], list[Vector]]:
    """Return columns and errors, and the autoregression of each output's remaining errors.

    What the columns explain of the errors is noise, too, and mostly of the frequencies of the
    inputs. Without it the errors would seem to have hardly any there, and the filter would enlarge
    what is there until it looks like structure. So noise of the colour found takes its place.
    """
    pieces = stacked_rows(runs, base, error_scale(runs))
    flat, lengths = np.concatenate(pieces), np.cumsum([len(piece) for piece in pieces])[:-1]
    n, ny = flat.shape[:2]
    q = span(flat[..., :-1].reshape(n * ny, -1), RANK)
    target = flat[..., -1].reshape(-1)
    rest = target - q @ (q.T @ target)
    colours, shown = [np.ones(1)] * ny, float(np.sqrt(1 - min(q.shape[1] / (n * ny), _MOST_USED)))
    drawn = np.random.default_rng(_SEED).standard_normal((n, ny))
    for _ in range(_FILLINGS):
        sizes = rest.reshape(n, ny).std(axis=0) / shown
        noise = np.stack([autoregression(a, drawn[:, o]) for o, a in enumerate(colours)], axis=1)
        noise = (noise / noise.std(axis=0) * sizes).reshape(-1)
        whole = np.split((rest + q @ (q.T @ noise)).reshape(n, ny), lengths)
        found = [whitening_filter([piece[:, o] for piece in whole]) for o in range(ny)]
        colours = [np.ones(1) if a is None else a for a in found]
    return pieces, colours


def filter_rows(piece: np.ndarray, colours: list[Vector]) -> Matrix:
    """Return columns and errors (T, ny, k), filtered by the autoregression of each output."""
    memory = max(map(len, colours)) - 1
    rows = np.stack([moving_sum(a, piece[:, o])[memory:] for o, a in enumerate(colours)], axis=1)
    return rows.reshape(-1, piece.shape[2])
