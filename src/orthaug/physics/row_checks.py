"""Checks of rows: their values are finite, move, and are of sizes that can be squared."""

from __future__ import annotations

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug.data.record import Record
from orthaug.data.regressors import Features, Layout, UsableRows
from orthaug.physics.baseline import Baseline
from orthaug.physics.moments import Extent

# Size of outputs and regressors whose squares still add up; 1 / _LARGEST is the smallest
_LARGEST = 1e120


def feature_rows(features: Features, rows: UsableRows, layout: Layout, record: Record) -> Matrix:
    """Return the learner's features (N, nz) of some rows; InputError where one is not finite."""
    with np.errstate(all="ignore"):
        z = np.asarray(features.evaluate(rows.x, layout, np))
    for j, entry in enumerate(features.entries):
        _check_finite(z[:, j], f"the learner input {entry}", rows, record)
    return z


def check_moving(extent: Extent, record: Record, layout: Layout) -> None:
    """Raise InputError for a channel of the model that is constant.

    `extent` is that of outputs, then inputs.
    """
    used = {lag.channel for lag in layout} | {channel.name for channel in record.outputs}
    for channel, low, high in zip(record.channels, *extent, strict=True):
        if channel.name in used and low == high:
            raise InputError(
                f"channel '{channel.name}' is constant ({low:g}) over all training data; "
                "nothing can be learned from it. Remove it, or use data in which it moves."
            )


def check_sizes(deviation: Vector, moved: Vector) -> None:
    """Raise InputError for outputs whose squares double precision cannot represent.

    `moved` is the range of each output (ny,).
    """
    moves = moved > 0
    if not np.all(np.isfinite(deviation)) or np.any(
        moves & ((deviation > _LARGEST) | (deviation < 1 / _LARGEST))
    ):
        raise InputError(
            f"the outputs move by {np.max(moved):.3g}, too large or too small for double precision "
            "arithmetic; scale them (`scale` of the channel)."
        )


def check_physics(
    phi: np.ndarray, known: np.ndarray, baseline: Baseline, rows: UsableRows, record: Record
) -> None:
    """Raise InputError where Φ (N, ny, nθ), the fixed terms (N, ny) or their squares overflow."""
    for j, name in enumerate(baseline.names):
        texts = (
            ", ".join(t.regressor for t in baseline.terms if t.parameter == name)
            or "the baseline function"
        )
        _check_finite(phi[:, :, j], f"the regressor of {name} ({texts})", rows, record)
        size = np.abs(phi[:, :, j]).max()
        if size > _LARGEST or 0 < size < 1 / _LARGEST:
            raise InputError(
                f"the regressor of {name} ({texts}) is of size {size:.3g}, beyond double "
                "precision arithmetic; scale its channels (`scale`)."
            )
    _check_finite(known, "the sum of the fixed terms", rows, record)


def _check_finite(values: np.ndarray, what: str, rows: UsableRows, record: Record) -> None:
    bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
    if not bad.size:
        return
    row = int(bad[0])
    for experiment in record.experiments:
        usable = len(experiment) - rows.start
        if row < usable:
            raise InputError(f"{experiment.where(row + rows.start)}: {what} is not finite there.")
        row -= usable
