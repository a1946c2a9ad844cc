"""A model's response along a record, and scores of how it follows the measured outputs.

Every response carries its horizon.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.lines import plural
from orthaug.data.channels import Channel
from orthaug.data.record import instants_of

if TYPE_CHECKING:
    import pandas as pd


_FEW = 3  # outputs whose sizes are shown
BAND = 1.959963984540054  # standard deviations: 95 % of a normal distribution


@dataclass(frozen=True, eq=False)
class Scores:
    """Root-mean-square error and fit of each output.

    `rmse` is in the output's unit, `nrmse` = RMSE / std(y), `fit` = 100 (1 − NRMSE) in %, not
    clipped.

    Entries are NaN where a score does not exist (a run that diverged, an output that does not
    move).
    """

    rmse: Vector
    nrmse: Vector
    fit: Vector
    samples: int

    def __repr__(self) -> str:
        kinds = (
            (name, [f"{value:.6g}" for value in getattr(self, name)])
            for name in ("rmse", "nrmse", "fit")
        )
        scores = ", ".join(f"{name} = {' | '.join(values)}" for name, values in kinds)
        return f"Scores({scores} %, {self.samples} samples)"


def scores(measured: Matrix, model: Matrix) -> Scores:
    """Return RMSE, NRMSE and FIT of each column.

    NRMSE has the population standard deviation of the scored samples.

    Args:
        measured: (N, ny); what is NaN is not scored.
        model: (N, ny), in the same units.

    Examples:
        >>> scores(np.array([[0.0], [1.0], [2.0]]), np.array([[0.0], [1.0], [1.0]])).rmse
        array([0.57735027])
    """
    with np.errstate(all="ignore"):
        there = np.isfinite(measured)  # what is missing is not scored
        scored = True if there.all() else there
        rmse = np.sqrt(np.mean((measured - model) ** 2, axis=0, where=scored))
        deviation = measured.std(axis=0, where=scored)
    return scores_of(rmse, deviation, int(np.count_nonzero(there.any(axis=1))))


def scores_of(rmse: Vector, deviation: Vector, samples: int) -> Scores:
    """Return scores from the RMSE and the standard deviation of each output (ny,)."""
    rmse = np.where(np.isfinite(rmse), rmse, np.nan)
    moves = (deviation > 0) & np.isfinite(deviation)
    nrmse = np.where(moves, rmse / np.where(moves, deviation, 1.0), np.nan)
    return Scores(rmse, nrmse, 100 * (1 - nrmse), samples)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A model along one experiment.

    Arrays (N, ny) are NaN on rows without a value (the first lags).

    `baseline + learner` is the model's output. `learner_before` is f, before θ_aux moved its share
    in the physics to θ. `diverged` is the row and output at which a free run left all bounds; None
    where it did not. `outside` (N,) marks the rows of a free run on which the learner's features
    lie outside those of training: there it extrapolates. None without a learner, and where the
    features of training are not known. `whole` (N, ny) is the model's output where its parts may
    lack a value: a motion whose physics alone runs away; None where it is their sum. `std` (N, ny)
    is the standard deviation of measured less model where an observer predicts.
    """

    baseline: Matrix
    learner: Matrix
    learner_before: Matrix
    measured: Matrix | None
    start: int
    start_time: float = 0.0
    diverged: tuple[int, str] | None = None
    outside: Bool[np.ndarray, "N"] | None = None
    whole: Matrix | None = None
    std: Matrix | None = None
    steps: Vector | None = None
    """Seconds (N,) from each row to the next, where they are uneven."""
    chosen: Bool[np.ndarray, "N"] | None = None
    """The rows that are predicted, and scored, where some are left out to save time."""

    def time(self, sampling_time: float) -> Vector:
        """Return the instants (N,) of the rows in s, the first of them 0."""
        return instants_of(len(self.baseline), sampling_time, self.steps)

    def __repr__(self) -> str:
        samples, outputs = self.baseline.shape
        measured = "" if self.measured is not None else ", not measured"
        ended = (
            ""
            if self.diverged is None
            else f", diverged in {self.diverged[1]} at row {self.diverged[0]}"
        )
        return (
            f"Trajectory({samples} samples of {outputs} "
            f"output{'s' * (outputs > 1)}{measured}{ended})"
        )

    @property
    def model(self) -> Matrix:
        return self.baseline + self.learner if self.whole is None else self.whole

    @property
    def scored(self) -> Matrix:
        """What is measured, NaN where the model was not run (N, ny)."""
        assert self.measured is not None, "of a record with measured outputs"
        if self.chosen is None:
            return self.measured
        return np.where(self.chosen[:, None], self.measured, np.nan)

    @property
    def errors(self) -> Matrix:
        """Measured less model on the rows with a value (N − start, ny)."""
        assert self.measured is not None, "of a record with measured outputs"
        return (self.measured - self.model)[self.start :]


@dataclass(frozen=True, eq=False)
class Response:
    """Trajectories of every experiment of a record.

    `horizon` in steps, None for a free run (simulation).
    """

    trajectories: tuple[Trajectory, ...]
    horizon: int | None
    outputs: tuple[Channel, ...]
    sampling_time: float

    @property
    def model(self) -> Matrix:
        """The model's output (N, ny), experiments one after another."""
        return np.concatenate([t.model for t in self.trajectories])

    @property
    def errors(self) -> Matrix:
        """Measured less model on the rows with a value, experiments one after another."""
        return np.concatenate([t.errors for t in self.trajectories])

    def __repr__(self) -> str:
        kind = "simulation" if self.horizon is None else f"{self.horizon}-step prediction"
        head = f"{plural(len(self.trajectories), 'experiment')}, {len(self.model)} samples"
        names = ", ".join(channel.label for channel in self.outputs)
        sizes = "; ".join(self._sizes(i) for i in range(min(len(self.outputs), _FEW)))
        more = "; …" if len(self.outputs) > _FEW else ""
        return f"Response({kind} of {names}, {head}; root mean squares: {sizes}{more})"

    def _sizes(self, i: int) -> str:
        """Return the root mean squares of an output's parts, and of what is measured and missed."""
        parts = {"physics": [t.baseline for t in self.trajectories]}
        if any(np.nansum(np.abs(t.learner)) > 0 for t in self.trajectories):
            parts["learner"] = [t.learner for t in self.trajectories]
        measured = [t.measured for t in self.trajectories if t.measured is not None]
        if len(measured) == len(self.trajectories):
            parts |= {"measured": measured, "error": [t.errors for t in self.trajectories]}
        sizes = []
        for name, values in parts.items():
            own = np.concatenate(values)[:, i]
            own = own[np.isfinite(own)]
            size = f"{np.sqrt(np.mean(own**2)):.4g}" if len(own) else "–"
            sizes.append(f"{name} {size} {self.outputs[i].unit}".rstrip())
        return f"{self.outputs[i].name} {', '.join(sizes)}"

    def scores(self, skip: int | tuple[int, ...] = 0) -> Scores:
        """Return scores over all experiments, without the first `skip` samples of each.

        A tuple has one number per experiment.

        Raises:
            InputError: no measured outputs, or no sample left to score.
        """
        skips = (
            (skip,) * len(self.trajectories) if isinstance(skip, int | np.integer) else tuple(skip)
        )
        if len(skips) != len(self.trajectories):
            raise InputError(
                f"`skip` has {len(skips)} numbers for {len(self.trajectories)} experiments."
            )
        measured, model = [], []
        for trajectory, first in zip(self.trajectories, skips, strict=True):
            if trajectory.measured is None:
                raise InputError("the record has no measured outputs to compare with.")
            rows = slice(max(trajectory.start, first), None)
            measured.append(trajectory.scored[rows])
            model.append(trajectory.model[rows])
        if not sum(len(m) for m in measured):
            raise InputError(f"no samples are left to score after the first {max(skips)}.")
        return scores(np.concatenate(measured), np.concatenate(model))

    @property
    def physics_alone(self) -> Response:
        """Response of the physics alone, for the free run of a motion.

        For other responses it is the physics' part.
        """
        found = []
        for t in self.trajectories:
            lost = np.isnan(t.baseline) & ~np.isnan(t.model)
            row = int(np.argmax(lost.any(axis=1)))
            diverged = (row, self.outputs[int(np.argmax(lost[row]))].name) if lost.any() else None
            nothing = np.zeros_like(t.baseline)
            found.append(
                replace(t, learner=nothing, learner_before=nothing, diverged=diverged, whole=None)
            )
        return replace(self, trajectories=tuple(found))

    def to_frame(self, experiment: int = 0) -> pd.DataFrame:
        """Return a table with `time` and, per output, measured, model, baseline and learner.

        A free run also has `extrapolates`.

        Of an observer's prediction also the 95 % band of what is measured.
        """
        import pandas as pd

        trajectory = self.trajectories[experiment]
        columns: dict[str, object] = {
            "time": trajectory.start_time + trajectory.time(self.sampling_time)
        }
        for i, channel in enumerate(self.outputs):
            if trajectory.measured is not None:
                columns[channel.name] = trajectory.measured[:, i]
            columns[f"{channel.name}_model"] = trajectory.model[:, i]
            if trajectory.std is not None:
                columns[f"{channel.name}_model_low"] = (
                    trajectory.model[:, i] - BAND * trajectory.std[:, i]
                )
                columns[f"{channel.name}_model_high"] = (
                    trajectory.model[:, i] + BAND * trajectory.std[:, i]
                )
            columns[f"{channel.name}_baseline"] = trajectory.baseline[:, i]
            columns[f"{channel.name}_learner"] = trajectory.learner[:, i]
        if trajectory.outside is not None:
            flags = pd.array(trajectory.outside, dtype="Int64")
            flags[: trajectory.start] = pd.NA
            columns["extrapolates"] = flags
        return pd.DataFrame(columns)
