"""Records of fitted models: match channels and rows, and cut a run that left all bounds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Generic, TypeVar, cast

import numpy as np
from jaxtyping import Bool

from orthaug._base.checks import Matrix, Vector, check_type
from orthaug._base.errors import InputError, show
from orthaug._base.lines import plural
from orthaug.data.channels import Channel
from orthaug.data.preparation import steps_again
from orthaug.data.record import Experiment, Preparation, Record, same_step
from orthaug.models.dynamics import Dynamics, Numbers, Parts
from orthaug.models.learners import Scaling
from orthaug.models.response import Trajectory
from orthaug.physics.innovations import InnovationsModel
from orthaug.physics.noise import NoiseModel

RUNAWAY = 1e6  # times the largest training output: a free run beyond this has diverged

WITHIN = 1e-9  # of a feature's half width: the largest of training is no extrapolation


Form = TypeVar("Form", bound=Dynamics)
# Self is nothing that run-time checks of annotations can read
Own = TypeVar("Own", bound="RecordModel[Any]")


class RecordModel(Generic[Form]):
    """A model of some channels at a sampling time."""

    form: Form
    numbers: Numbers
    outputs: tuple[Channel, ...]
    inputs: tuple[Channel, ...]
    sampling_time: float
    largest_output: Vector
    deviation: Vector
    weight: Matrix
    prepared: tuple[Preparation, ...]
    noise: NoiseModel | InnovationsModel | None

    @property
    def coloured(self) -> bool:
        """True if a noise model forecasts errors."""
        return self.noise is not None and not self.noise.white

    @property
    def learns(self) -> bool:
        """False where the physics is alone."""
        return self.form.learns

    @property
    def physics_only(self: Own) -> Own:
        """The model without its learner."""
        form, whole = self.form.physics_only, cast(Any, self)
        gain = np.ones(form.bound.ny)
        return replace(whole, form=form, numbers=self.numbers.physics_only._replace(gain=gain))

    alone = physics_only
    """Earlier name of `physics_only`."""

    @property
    def preparation(self) -> tuple[Any, ...]:
        """Preparation of the training data, for `prepare` and `read_record` of other data."""
        return steps_again(
            self.prepared, [c.name for c in (*self.inputs, *self.outputs)], self.sampling_time
        )[0]

    @property
    def scaling(self) -> Scaling:
        """Scaling of the learner's features, which is part of the learner."""
        return Scaling(np.asarray(self.numbers.centre), np.asarray(self.numbers.halfwidth))

    @property
    def reached(self) -> Scaling:
        """Range of the learner's features in training."""
        return self.scaling

    def beyond(self, features: Matrix) -> Bool[np.ndarray, "N"]:
        """Return where a feature of the learner (N, nz) is outside its range in training."""
        return ~(np.abs(self.reached(features)) <= 1 + WITHIN).all(axis=1)

    def bounded(self, parts: Parts, experiment: Experiment, measured: Matrix | None) -> Trajectory:
        """Return a free run cut where it left all bounds."""
        whole = trajectory(parts, experiment, measured, self.form.first_row)
        with np.errstate(all="ignore"):
            wild = ~(np.abs(whole.model[self.form.first_row :]) <= RUNAWAY * self.largest_output)
        if not wild.any():
            return whole
        step = int(np.argmax(wild.any(axis=1)))
        output = self.outputs[int(np.argmax(wild[step]))].name
        cut = Parts(
            *(np.where(np.arange(len(part))[:, None] < step, part, np.nan) for part in parts)
        )
        bounded = trajectory(cut, experiment, measured, self.form.first_row)
        return replace(bounded, diverged=(step + self.form.first_row, output))

    def check_rows(self, experiment: Experiment, first: int) -> None:
        """Raise InputError where an experiment ends before the row `first`."""
        if len(experiment) <= first:
            name = experiment.source or "the record"
            raise InputError(
                f"{name} has {plural(len(experiment), 'row')}, too few: the first value is at row "
                f"{show(first)}."
            )

    def _describe_wanted(self, with_outputs: bool) -> str:
        """Describe a record of the model's channels in Python."""
        given = {
            "u": ("inputs", self.inputs),
            "y": ("outputs", self.outputs if with_outputs or not self.inputs else ()),
        }
        arrays = [f"{name}={name}" for name, (_, channels) in given.items() if channels]
        names = [
            f"{kind}={[c.name for c in channels]}" for kind, channels in given.values() if channels
        ]
        arguments = ", ".join([*arrays, *names, f"sampling_time={self.sampling_time:g}"])
        return f"a Record, such as Record.from_arrays({arguments})"

    def fitting(self, record: Record, *, need_outputs: bool, gaps: bool = False) -> Record:
        """Return the record's channels in the model's order, by name.

        Raises:
            InputError: a channel is missing, the sampling time differs by more than 0.1 %, or
                outputs are missing samples and `gaps` are not allowed.
        """
        check_type(record, Record, "record", self._describe_wanted(need_outputs))
        if not self.form.steps_unevenly:
            record.check_even("a model in lagged values")
        if record.even and not same_step(record.sampling_time, self.sampling_time):
            raise InputError(
                f"the record is sampled every {record.sampling_time:g} s, the model every "
                f"{self.sampling_time:g} s; resample the record."
            )
        with_outputs = need_outputs or bool(record.outputs)
        names = {kind: [c.name for c in getattr(record, kind)] for kind in ("inputs", "outputs")}
        wanted = {"inputs": self.inputs, "outputs": self.outputs if with_outputs else ()}
        for kind, channels in wanted.items():
            missing = [c.name for c in channels if c.name not in names[kind]]
            if missing:
                there = ", ".join(names[kind]) or "none"
                raise InputError(
                    f"the record lacks the {kind[:-1]} {', '.join(missing)} of the model; it "
                    f"has {there}."
                )
        order = {
            kind: [names[kind].index(c.name) for c in channels] for kind, channels in wanted.items()
        }
        experiments = tuple(
            replace(e, inputs=e.inputs[:, order["inputs"]], outputs=e.outputs[:, order["outputs"]])
            for e in record.experiments
        )
        fitting = Record(self.inputs, wanted["outputs"], record.sampling_time, experiments)
        if not (gaps or self.form.takes_gaps and not self.coloured):
            fitting.check_measured()
        return fitting


def trajectory(
    parts: Parts, experiment: Experiment, measured: Matrix | None, first: int
) -> Trajectory:
    """Return parts from a row on as a trajectory of the whole experiment."""

    def pad_rows(values: Matrix) -> Matrix:
        padded = np.full((len(experiment), values.shape[1]), np.nan)
        padded[first:] = values
        return padded

    return Trajectory(
        pad_rows(parts.baseline),
        pad_rows(parts.learner),
        pad_rows(parts.raw),
        measured,
        first,
        experiment.start_time,
        steps=experiment.steps,
    )
