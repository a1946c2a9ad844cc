"""Result of an observer along a record: outputs, states, bands, and tests of the innovations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.special

from orthaug._base.checks import Matrix, Vector
from orthaug.data.channels import Channel
from orthaug.fitting.whiteness import LjungBox, ljung_box
from orthaug.models.response import BAND

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Consistency:
    """Consistency of the innovations with the filter's own covariance.

    `nis` is the mean of `νᵀS⁻¹ν` per output that was measured: 1 for a filter that knows its noise.
    `expected` is the interval that holds it in 95 % of records where that is so (χ², Bar-Shalom
    2001). `whiteness` is the test of Ljung and Box on each output's normalised innovations; None
    where there are too few, or with gaps.
    """

    nis: float
    expected: tuple[float, float]
    whiteness: tuple[LjungBox | None, ...]

    @property
    def consistent(self) -> bool:
        return self.expected[0] <= self.nis <= self.expected[1]


@dataclass(frozen=True, eq=False)
class ObserverRun:
    """An observer along one experiment of N rows; NaN on rows before `start`.

    `predicted` (N, ny) are the outputs as the rows before predict them, `spread` (N, ny, ny) the
    covariance of measured less predicted ones. `outputs` (N, ny) are estimates without the sensors'
    noise, with the row's own measurement; `outputs_std` their standard deviations. `states` (N, n),
    `states_std` are those of a motion at the row; a lagged model's are what goes into the next
    row's step. `square` (N,) is `νᵀS⁻¹ν`, `count` (N,) how many outputs were measured.
    """

    measured: Matrix
    predicted: Matrix
    spread: Any
    outputs: Matrix
    outputs_std: Matrix
    states: Matrix
    states_std: Matrix
    square: Vector
    start: int
    start_time: float

    @property
    def count(self) -> np.ndarray:
        return np.isfinite(self.measured).sum(axis=1)

    @property
    def predicted_std(self) -> Matrix:
        """(N, ny), of measured less predicted outputs."""
        return np.sqrt(np.diagonal(self.spread, axis1=1, axis2=2))

    @property
    def innovations(self) -> Matrix:
        """Measured less predicted outputs (N, ny), NaN where nothing was measured."""
        return self.measured - self.predicted


@dataclass(frozen=True, eq=False)
class Observations:
    """An observer along every experiment of a record."""

    experiments: tuple[ObserverRun, ...]
    outputs: tuple[Channel, ...]
    state_names: tuple[str, ...]
    """Of a motion; a lagged model's states are its outputs."""
    sampling_time: float
    settled: int
    """Rows of each experiment that determine where it started."""

    def __repr__(self) -> str:
        rows = sum(len(one.square) for one in self.experiments)
        return f"Observations({', '.join(c.name for c in self.outputs)}, {rows} samples)"

    def consistency(self, skip: int | None = None) -> Consistency:
        """Return the test of whiteness and size of innovations, after `skip` rows (`settled`)."""
        skip = self.settled if skip is None else skip
        pieces = [(one, slice(max(one.start, skip), None)) for one in self.experiments]
        total = float(sum(np.sum(one.square[rows]) for one, rows in pieces))
        count = int(sum(np.sum(one.count[rows]) for one, rows in pieces))
        if not count:
            return Consistency(float("nan"), (0.0, float("inf")), ())
        ends = [float(scipy.special.chdtri(count, p)) / count for p in (0.975, 0.025)]
        whole = all((one.count[rows] == one.measured.shape[1]).all() for one, rows in pieces)
        normal = [(one.innovations / one.predicted_std)[rows] for one, rows in pieces]
        tests = [
            ljung_box([n[:, i] for n in normal if len(n)]) if whole else None
            for i in range(len(self.outputs))
        ]
        return Consistency(total / count, (ends[0], ends[1]), tuple(tests))

    def to_frame(self, experiment: int = 0) -> pd.DataFrame:
        """Return `time` and, per output, measured and estimated values with the 95 % band.

        The same of a motion's states.
        """
        import pandas as pd

        one = self.experiments[experiment]
        columns: dict[str, object] = {
            "time": one.start_time + np.arange(len(one.square)) * self.sampling_time
        }
        for i, channel in enumerate(self.outputs):
            columns[channel.name] = one.measured[:, i]
            columns |= _band_columns(
                f"{channel.name}_model", one.outputs[:, i], one.outputs_std[:, i]
            )
        for i, name in enumerate(self.state_names):
            columns |= _band_columns(f"state:{name}", one.states[:, i], one.states_std[:, i])
        return pd.DataFrame(columns)


def _band_columns(name: str, value: Vector, std: Vector) -> dict[str, Vector]:
    return {name: value, f"{name}_low": value - BAND * std, f"{name}_high": value + BAND * std}
