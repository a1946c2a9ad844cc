"""Changes of a model that would lower its error, and by how much.

They are further lags, an offset, and a learner's functions.

A change adds columns h to the prediction. One step ahead the residual is regressed on them beside
the physics' own; of a free run on what they become there, `S_k = h_k + Σ_i A_{k,i} S_{k−i}`, the
sensitivity to their coefficient. The share of the error's variance that they explain on rows they
were not fitted to is what the change is predicted to gain.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.lines import percent
from orthaug._base.parallel import one_blas_thread
from orthaug.analysis.feedback import transitions
from orthaug.analysis.predictability import BlockSums, Share, SimpleFunctions
from orthaug.analysis.residuals import rms_errors
from orthaug.data.expressions import Lag
from orthaug.data.record import Experiment, Record
from orthaug.data.regressors import Layout, lag_matrix
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.models.response import Response, Trajectory
from orthaug.physics.shared import seen_columns

WORTH = 0.05  # of the error's variance: what explains less is no change worth making
_INPUTS_FURTHER, _OUTPUTS_FURTHER = 10, 4  # lags beyond the largest of the model that are tried
_ROWS = 20_000  # that are looked at, spread over the record in stretches
_STRETCHES = 8
_ROWS_PER_COLUMN = 5
# Error of a free run, in the output's deviation, beyond which sensitivities along it say little
_FAR = 0.3
_SURE = 3.0  # standard errors that a gain must exceed, for it is the largest of many
_SIMPLER = 0.8  # of the gain of a learner, with which a single lag is as good


@dataclass(frozen=True)
class Change:
    """A change of a model, and the share `fall` by which the RMS error is predicted to fall.

    `kind` is criterion, input_lag, output_lag, offset or learner, `what` names it, `of` whose error
    falls: prediction or simulation. `output` is the one whose physics lacks the term; None for one
    output, or for all.
    """

    kind: str
    what: str
    fall: float
    of: str
    output: str | None = None

    @property
    def name(self) -> str:
        """The change, to go on from "with"."""
        where = f" of {self.output}" if self.output else ""
        place = f"in the physics{where} (or the learner)"
        return {
            "criterion": f'focus = "{self.what}"',
            "input_lag": f"the further input lag {self.what} {place}",
            "output_lag": f"the further output lag {self.what} {place}",
            "offset": f"an offset in the physics{where}",
            "learner": self.what,
        }[self.kind]

    @property
    def gains(self) -> bool:
        """True if the error is predicted to fall by enough to name the change."""
        return self.fall >= fall_of(WORTH)

    @property
    def prediction(self) -> str:
        """Predicted gain, as a clause."""
        if self.kind == "criterion" and not self.gains:
            return (
                "the parameters would not have this bias; the error of its free run is not "
                "predicted to fall"
            )
        error = (
            "its error one step ahead" if self.of == "prediction" else "the error of its free run"
        )
        return f"{error} is predicted to fall by {percent(self.fall)}"

    def __str__(self) -> str:
        return f"with {self.name} {self.prediction}"


def fall_of(share: float) -> float:
    """Return the relative fall of an RMS error when a share of its square is gone."""
    return 1.0 - float(np.sqrt(1.0 - min(max(share, 0.0), 1.0)))


def model_changes(
    fit: LaggedEstimate,
    response: Response,
    *,
    simulates: bool,
    skip: int = 0,
    one_step: Response | None = None,
    functions: float = 0.0,
) -> tuple[Change, ...]:
    """Return the best change of each kind that is worth making, the best one first.

    Args:
        response: of the training data, whose errors are to be explained: the prediction, or with
            `simulates` the free run.
        skip: its leading rows that do not count.
        one_step: the prediction, for a free run that is far from what was measured; None to go
            along it all the same.
        functions: what functions of the regressor are known to explain of the errors one step
            ahead.
    """
    off = float(np.max(rms_errors(response, skip) / fit.problem.deviation))
    with one_blas_thread():
        found: tuple[Change, ...] = ()
        if simulates and one_step is not None and off > _FAR:
            found = Candidates(fit, one_step, True, skip, measured=True).changes()
        return found or Candidates(fit, response, simulates, skip).changes(functions)


def own_share(fit: LaggedEstimate, one_step: Response) -> Share:
    """Return the share of the one-step residual that the physics' own columns explain.

    It is zero where the columns were fitted to that residual.
    """
    with one_blas_thread():
        candidates = Candidates(fit, one_step, False, 0, own=True)
        return (
            candidates.sums.share(range(candidates.base)) if candidates.usable else Share(0.0, 0.0)
        )


@dataclass(frozen=True, eq=False)
class Candidates:
    """Columns that a model might be given, over the rows of a response.

    With `own` there are only those of the physics.
    """

    fit: LaggedEstimate
    response: Response
    simulates: bool
    skip: int
    own: bool = False
    measured: bool = False
    """True if sensitivities are those along the measured outputs; the response is then the
    prediction.
    """

    @property
    def base(self) -> int:
        """Number of columns of the physics, its offsets included."""
        return len(self.fit.theta) + len(self.fit.problem.outputs)

    @cached_property
    def lags(self) -> tuple[Lag, ...]:
        """All lags that are tried, from those of the model on."""
        problem = self.fit.problem
        shortest = max(len(e) for e in problem.record.experiments) // 20
        inputs = [channel.name for channel in problem.record.inputs]
        highest = {name: 0 for name in (*problem.outputs, *inputs)}
        for lag in problem.layout:
            highest[lag.channel] = max(highest[lag.channel], lag.lag)
        own = [
            Lag(n, i)
            for n in problem.outputs
            for i in range(1, highest[n] + 1 + min(_OUTPUTS_FURTHER, shortest))
        ]
        return (
            *own,
            *(
                Lag(n, i)
                for n in inputs
                for i in range(highest[n] + 1 + min(_INPUTS_FURTHER, shortest))
            ),
        )

    @property
    def first(self) -> int:
        """The first row with all of them."""
        return max([self.fit.model.form.first_row, *(lag.lag for lag in self.lags)])

    @cached_property
    def stretches(self) -> list[tuple[Experiment, Trajectory, int, int]]:
        """Rows that are looked at, from the second number on.

        Sensitivities are carried along from the first number on.
        """
        problem, first = self.fit.problem, self.first
        most = _ROWS // len(problem.outputs)
        total = sum(max(len(e) - first, 0) for e in problem.record.experiments)
        found = []
        for experiment, run in zip(
            problem.record.experiments, self.response.trajectories, strict=True
        ):
            rows = len(experiment) - first
            count = 1 if total <= most else max(round(_STRETCHES * rows / total), 1)
            length = min(rows, rows // count, most * rows // total // count + 1) if rows > 0 else 0
            for begin in (
                np.linspace(first, len(experiment) - length, count).astype(int) if length else ()
            ):
                skipped = max(self.skip - (first - run.start), 0) if begin == first else self.skip
                if length > skipped:
                    found.append(
                        (experiment.rows(begin - first, begin + length), run, int(begin), skipped)
                    )
        return found

    @cached_property
    def usable(self) -> bool:
        """True if there are enough rows for all columns."""
        rows = sum(len(e) - self.first - skipped for e, _, _, skipped in self.stretches)
        return rows * len(self.fit.problem.outputs) >= _ROWS_PER_COLUMN * max(self._width, 8)

    @property
    def _width(self) -> int:
        outputs = len(self.fit.problem.outputs)
        return self.base + (0 if self.own else outputs * (len(self.lags) + len(self.functions)))

    @cached_property
    def functions(self) -> SimpleFunctions:
        problem = self.fit.problem
        if not self.unread:
            return SimpleFunctions.of(problem.layout, problem.rows.x)
        rows = [self._regressor(e, problem.record) for e in problem.record.experiments]
        return SimpleFunctions.of((*problem.layout, *self.unread), np.concatenate(rows))

    @cached_property
    def unread(self) -> Layout:
        """Inputs that nothing of the model reads, of a record in memory."""
        return () if self.fit.problem.streamed else self.fit.problem.unread_lags

    def _regressor(self, piece: Experiment, record: Record) -> Matrix:
        """Return what functions may depend on: the regressor, and inputs that nothing reads."""
        return lag_matrix(piece, (*self.fit.problem.layout, *self.unread), record, self.first)

    @cached_property
    def sums(self) -> BlockSums:
        """Block sums of all rows, each output in its deviation."""
        columns, targets = zip(*(self._rows(*stretch) for stretch in self.stretches), strict=True)
        return BlockSums.of(np.concatenate(columns), np.concatenate(targets))

    def _rows(
        self, piece: Experiment, run: Trajectory, begin: int, skip: int
    ) -> tuple[Matrix, Vector]:
        """Return columns (rows · ny, width) and errors of one stretch."""
        problem, record, first = self.fit.problem, self.fit.problem.record, self.first
        there = slice(begin, begin + len(piece) - first)
        error = (piece.outputs[first:] - run.model[there])[:, :, None]
        if self.simulates and not self.measured:
            assert run.measured is not None
            ran = np.where(np.isfinite(run.model), run.model, run.measured)[
                begin - first : there.stop
            ]
            piece = Experiment(piece.inputs, ran)
        columns = self._columns(piece, record)
        if self.measured:
            carried = self._carry_through(np.concatenate([columns, error], axis=2), piece, record)
            columns, error = carried[:, :, :-1], carried[:, :, -1:]
        elif self.simulates:
            columns = self._carry_through(columns, piece, record)
        error, scaled = (
            error[skip:, :, 0] / problem.deviation,
            columns[skip:] / problem.deviation[:, None],
        )
        return scaled.reshape(-1, columns.shape[2]), error.reshape(-1)

    def _columns(self, piece: Experiment, record: Record) -> Float[np.ndarray, "N ny m"]:
        """Return columns of physics and offsets, unless `own` also lags and functions.

        Each of the latter is there for every output.
        """
        problem = self.fit.problem
        x = self._regressor(piece, record)
        phi = problem.phi(x[:, : len(problem.layout)])
        each = np.eye(len(problem.outputs))
        parts = [phi, np.broadcast_to(each, (len(x), *each.shape))]
        if not self.own:
            new = np.column_stack(
                [lag_matrix(piece, self.lags, record, self.first) - self._centre, self.functions(x)]
            )
            parts.append(np.einsum("km,oi->koim", new, each).reshape(len(x), len(each), -1))
        with np.errstate(all="ignore"):
            return np.nan_to_num(np.concatenate(parts, axis=2))

    @cached_property
    def _centre(self) -> Vector:
        """Mean of each lag's channel."""
        record = self.fit.problem.record
        names = [*record.outputs, *record.inputs]
        stacked = np.concatenate(
            [np.column_stack([e.outputs, e.inputs]) for e in record.experiments]
        )
        means = {
            channel.name: float(mean)
            for channel, mean in zip(names, stacked.mean(axis=0), strict=True)
        }
        return np.array([means[lag.channel] for lag in self.lags])

    def _carry_through(self, columns: np.ndarray, piece: Experiment, record: Record) -> np.ndarray:
        """Return the columns carried through the free run, from a start independent of them."""
        form, first, ny = self.fit.model.form, self.first, columns.shape[1]
        states = form.start(piece.outputs, np.arange(first, len(piece)))
        inputs = form.inputs(piece, record)[first - form.first_row :]
        feedback = np.nan_to_num(transitions(self.fit.model, states, inputs)[:, :ny])
        carried, past = np.empty_like(columns), np.zeros((form.states, columns.shape[2]))
        for k, (a, own) in enumerate(zip(feedback, columns, strict=True)):
            carried[k] = own + a @ past
            past = np.concatenate([carried[k], past[:-ny]])
        return carried

    def changes(self, functions: float = 0.0) -> tuple[Change, ...]:
        """Return the best of each kind that is worth making, the best one first.

        See `model_changes`.
        """
        if not self.usable or not np.isfinite(self.sums.grams).all():
            return ()
        problem, of = self.fit.problem, "simulation" if self.simulates else "prediction"
        nt, outputs, base = len(self.fit.theta), problem.outputs, range(self.base)
        width = len(self.lags) + len(self.functions)
        found: list[tuple[float, Change]] = []

        def add(
            share: Share, kind: str, what: str, output: str | None = None, weight: float = 1.0
        ) -> None:
            if share.value >= WORTH and share.value > _SURE * share.error:
                found.append(
                    (
                        weight * fall_of(share.value),
                        Change(kind, what, fall_of(share.value), of, output),
                    )
                )

        for o, output in enumerate(outputs):
            own = output if len(outputs) > 1 else None
            add(self.sums.share([nt + o], range(nt)), "offset", "1", own)
            for j, lag in enumerate(self.lags):
                kind = "output_lag" if lag.channel in outputs else "input_lag"
                if (
                    self.measured and kind == "output_lag"
                ):  # it may be about noise, which a free run does not feed back
                    continue
                add(self.sums.share([self.base + o * width + j], base), kind, str(lag), own)
        learned = [
            self.base + o * width + len(self.lags) + j
            for o in range(len(outputs))
            for j in range(len(self.functions))
        ]
        shares = (self.sums.share(learned, base), Share(functions, 0.0))
        add(max(shares, key=lambda share: share.value), "learner", self._learner(), weight=_SIMPLER)
        best: dict[str, Change] = {}
        for _, change in sorted(found, key=lambda entry: -entry[0]):
            best.setdefault(change.kind, change)
        return tuple(best.values())

    def _learner(self) -> str:
        """Return a clause on the inputs that a learner could be given."""
        model, problem = self.fit.model, self.fit.problem
        if not model.learns:
            seen = ", ".join(map(str, self.unread))
            tried = self.fit.setup is not None and self.fit.setup.learns
            other = "another learner than the one that was tried" if tried else "a learner"
            return f"a learner that also sees {seen}" if seen else other
        visible = seen_columns(problem.features, problem.layout, problem.rows.x, lambda rows: rows)
        hidden = [str(lag) for lag, one in zip(problem.layout, visible, strict=True) if not one]
        hidden += map(str, self.unread)
        return (
            f"a learner that also sees {', '.join(hidden)}"
            if hidden
            else "a learner of more neurons"
        )
