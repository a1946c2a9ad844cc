"""How well a model's output follows the measured one. The horizon always stands beside the number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthaug._arrays import Matrix, Vector


@dataclass(frozen=True, eq=False)
class Scores:
    """Per output: `rmse` in the output's unit, `nrmse` = RMSE / std(y), `fit` = 100 (1 − NRMSE) in %, not clipped.

    Entries are NaN where a score does not exist (a run that diverged, an output that does not move);
    `as_dict` turns them into None.
    """

    rmse: Vector
    nrmse: Vector
    fit: Vector
    samples: int

    def as_dict(self) -> dict[str, list[float | None] | None]:
        """Plain lists for JSON; None instead of a list where no output has a score."""
        entries = {"rmse": self.rmse, "nrmse": self.nrmse, "fit": self.fit}
        return {
            key: None if np.isnan(values).all() else [None if np.isnan(v) else float(v) for v in values]
            for key, values in entries.items()
        }


def scores(measured: Matrix, model: Matrix) -> Scores:
    """RMSE, NRMSE (population standard deviation of the scored samples) and FIT of each column, (N, ny)."""
    with np.errstate(all="ignore"):
        rmse = np.sqrt(np.mean((measured - model) ** 2, axis=0))
        deviation = measured.std(axis=0)
    rmse = np.where(np.isfinite(rmse), rmse, np.nan)
    moves = (deviation > 0) & np.isfinite(deviation)
    nrmse = np.where(moves, rmse / np.where(moves, deviation, 1.0), np.nan)
    return Scores(rmse, nrmse, 100 * (1 - nrmse), len(measured))
