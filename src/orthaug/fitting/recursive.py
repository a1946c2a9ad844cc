"""Recursive estimation of θ with the learner fixed: intervals and an alarm.

With f and θ_aux fixed, the fitted model is linear in θ: `y − known − (f − φθ_aux) = φθ + e`. Over
the training rows its least-squares solution is the fit's θ, whatever the structure's split: `Φ⁺(Y −
F) + θ_aux = c + θ_aux` (F1, F2). New rows go on from there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.checks import (
    Matrix,
    Vector,
    check_choice,
    check_count,
    check_number,
    check_type,
    is_number,
)
from orthaug._base.errors import InputError, show
from orthaug._base.jax import jax
from orthaug._base.lines import percent
from orthaug.data.record import Record
from orthaug.fitting import recursive_storage
from orthaug.fitting.estimates import parameter_frame, parameter_lines
from orthaug.fitting.lagged_estimate import LaggedEstimate, order_of
from orthaug.fitting.recursion import EstimateHistory, covariances
from orthaug.fitting.recursive_rows import (
    RegressorStream,
    WhitenedRows,
    begin,
    joined_rows,
    training_rows,
    whitened_rows,
)
from orthaug.fitting.residual_band import ResidualMonitor
from orthaug.inference.covariance import interval
from orthaug.inference.physical import PhysicalEstimate, solve
from orthaug.models.learners import Learner
from orthaug.models.model import Model
from orthaug.models.statistics import Statistics
from orthaug.physics.baseline import Baseline
from orthaug.physics.parameters import PhysicsMap

if TYPE_CHECKING:
    import pandas as pd

QUIET = 1e6
"""Rows between false alarms."""
_LEAST_FACTOR = 0.3  # of forgetting: a memory of one row


@dataclass(frozen=True)
class Alarm:
    """An alarm: residuals left their band at `row` of all rows, `time` [s] after the first."""

    row: int
    time: float

    def __str__(self) -> str:
        return f"the residual left its band at {self.time:g} s (row {self.row})"


class Recursive:
    """A fitted model whose θ is updated by new rows, the learner fixed.

    Args:
        fit: of `estimate`, one step ahead, or a saved model.
        training: the record that a saved model was trained on; an `Estimate` knows it.
        forgetting: λ in (0, 1], the weight of a row against the next one; 1 (default) forgets
            nothing.
        memory: the same in seconds, `λ = exp(−Ts / memory)`.
        start: "fit" begins with the training rows, at most as many as one memory holds; "empty"
            without them.
        quiet: rows between false alarms, at least on average, while nothing changes.

    Raises:
        InputError: a motion, a fit of the free run, a θ that is not the least squares of its rows
            (a bound, a penalty).

    Examples:
        >>> import numpy as np
        >>> from orthaug.fitting.estimation import estimate
        >>> from orthaug.physics.baseline import Term
        >>> u = np.sin(np.arange(300.0) ** 1.1)
        >>> noise = 0.1 * np.cos(37 * np.arange(300.0) ** 1.3)
        >>> record = Record.from_arrays(u, 2 * u + noise)
        >>> fit = estimate(record, Baseline.from_terms([Term("gain", "u[k]")]), learner=None)
        >>> online = Recursive(fit, memory=50)
        >>> alarms = online.update(u=u[:200], y=2.4 * u[:200] + noise[:200])
        >>> f"{online.theta[0]:.1f}"
        '2.4'
    """

    def __init__(
        self,
        fit: LaggedEstimate | Model,
        *,
        training: Record | None = None,
        forgetting: float | None = None,
        memory: float | None = None,
        start: str = "fit",
        quiet: float = QUIET,
    ) -> None:
        check_choice(start, ("fit", "empty"), "`start`")
        if check_number(quiet, "quiet", positive=True) < 1:
            raise InputError(f"`quiet` must be 1 row or more; got {show(quiet)}.")
        began = training_rows(fit, training)
        factor = forgetting_factor(forgetting, memory, began.model.sampling_time)
        recursion, reference, inflation = begin(began, factor, quiet, empty=start == "empty")
        self._set(began.model, recursion, ResidualMonitor(reference), inflation, began.used)

    def _set(
        self,
        model: Model,
        recursion: Any,
        watch: ResidualMonitor,
        inflation: Matrix | None,
        used: float,
    ) -> None:
        self._fitted, self._recursion, self._watch = model, recursion, watch
        self._inflation, self._used = inflation, used
        self._numbers = jax.device_put(model.numbers)
        self._lagging = RegressorStream(model)
        self._tail = self._lagging.nothing
        self._rows_kept = EstimateHistory(len(model.outputs), len(model.theta))
        self.rows = self.outside = 0
        self.alarms: tuple[Alarm, ...] = ()

    @classmethod
    def load(
        cls, folder: str | Path, *, baseline: Baseline | None = None, learner: Learner | None = None
    ) -> Recursive:
        """Return the estimate that `save` wrote, to go on from there.

        Args:
            baseline, learner: the Python callables again, where the model had such.

        Raises:
            InputError: no saved state there; a file that is cut, altered, or from a newer version.
        """
        kept = recursive_storage.load(folder, baseline, learner)
        one = cls.__new__(cls)
        one._set(kept.model, kept.recursion, kept.watch, kept.inflation, kept.used)
        one._tail, one._rows_kept, one.rows = kept.tail, kept.kept_rows, kept.rows
        one.outside = kept.outside
        one.alarms = tuple(Alarm(int(row), row * kept.model.sampling_time) for row in kept.alarms)
        return one

    def save(self, folder: str | Path, *, force: bool = False) -> None:
        """Write model and state to a folder of its own, JSON and safetensors, whole or not at all.

        Raises:
            InputError: the folder cannot be written, or holds something else.
        """
        recursive_storage.save(self._stored_state(), folder, force=force)

    def fill(self, folder: Path) -> None:
        """Write the files of `save` into an existing folder."""
        recursive_storage.write(self._stored_state(), folder)

    def _stored_state(self) -> recursive_storage.RecursiveState:
        alarms = np.array([alarm.row for alarm in self.alarms], dtype=float)
        state = (
            self._fitted,
            self._recursion,
            self._watch,
            self._inflation,
            self._used,
            self._tail,
            self._rows_kept,
        )
        return recursive_storage.RecursiveState(*state, self.rows, self.outside, alarms)

    def update(
        self, record: Record | None = None, *, u: Any = None, y: Any = None, gap: bool = False
    ) -> Sequence[Alarm]:
        """Update θ by new rows, one or many, that follow on the last ones.

        Args:
            record: with the model's channels. Every experiment after the first begins after a gap.
                Rows with missing samples that were left out of a recording count all the same.
            u, y: instead of a record inputs and outputs, one row or many; NaN is a missing sample.
                Rows that read one are left out.
            gap: whether these rows do not follow on the last ones: then the first lags are history
                only.

        Returns:
            The alarms that these rows raised.

        Raises:
            InputError: other channels or sampling time, values that are infinite; nothing is
                changed then.
        """
        check_type(gap, bool, "gap", "true or false")
        begins: list[bool] = []
        prepared = []
        tail = self._tail
        lost, parts = self._parts(record, u, y)
        for i, rows in enumerate(parts):
            begins.append(gap or i > 0)
            x, complete, tail = self._lagging.regressors(
                self._lagging.nothing if begins[-1] else tail, rows
            )
            prepared.append(self._whiten(x, complete, rows))
        alarms = []
        for begun, left_out, (used, whitened, count) in zip(begins, lost, prepared, strict=True):
            if begun:
                self._watch.gap()
            self.rows += left_out
            alarms += self._follow(used, whitened)
            self.rows += count
        at_end = 0 if record is None else max(record.missing - sum(lost), 0)
        if at_end:  # what comes next does not follow on the last row that is there
            tail = self._lagging.nothing
            self._watch.gap()
            self.rows += at_end
        self._tail = tail
        self.alarms = (*self.alarms, *alarms)
        return alarms

    def _parts(self, record: Record | None, u: Any, y: Any) -> tuple[list[int], list[Matrix]]:
        """Return rows (n, ny + nu) without gaps among them, and how many were lost before each."""
        model = self._fitted
        if record is None:
            return [0], [joined_rows(u, y, len(model.inputs), len(model.outputs))]
        if u is not None or y is not None:
            raise InputError("give either a record, or `u` and `y`.")
        record = model.fitting(record, need_outputs=True)
        rows = [np.concatenate([e.outputs, e.inputs], axis=1) for e in record.experiments]
        return record.lost_rows, rows

    def _whiten(
        self, x: Matrix, complete: Any, rows: Matrix
    ) -> tuple[Any, WhitenedRows | None, int]:
        """Return the usable rows and their least-squares problem in θ."""
        used = np.flatnonzero(complete)
        if not len(used):
            return used, None, len(rows)
        y = rows[used, : len(self._fitted.outputs)]
        return used, whitened_rows(self._fitted, x[used], y, self._numbers), len(rows)

    def _follow(self, used: Any, whitened: WhitenedRows | None) -> list[Alarm]:
        recursion, watch, kept_rows = self._recursion, self._watch, self._rows_kept
        alarms: list[Alarm] = []
        if whitened is None:
            return alarms
        for i, (k, phi, target, inside) in enumerate(zip(used, *whitened, strict=True)):
            if i and k != used[i - 1] + 1:
                watch.gap()
            row = self.rows + int(k)
            error, spread = recursion.update(phi, target)
            if not inside:
                watch.skip()
                self.outside += 1
            elif watch.step(error, spread):
                alarms.append(Alarm(row, row * self._fitted.sampling_time))
            if row % kept_rows.stride == 0:
                kept_rows.add(kept_rows.line(row, watch.level, self._freedom, error, recursion))
        return alarms

    @property
    def _freedom(self) -> float:
        """Degrees of freedom of s²: effective rows less those used by parameters and learner.

        The learner's count as long as its training rows do.
        """
        recursion = self._recursion
        used = self._used * recursion.oldest
        return max(
            recursion.effective_rows * len(self._fitted.outputs) - len(self.theta) - used, 1.0
        )

    @property
    def theta(self) -> Vector:
        """θ now (nθ,)."""
        return self._recursion.theta

    @property
    def covariance(self) -> Matrix | None:
        """Cov θ now (nθ, nθ): of noise, the learner fixed.

        None where the fit has none or the rows do not determine θ.
        """
        recursion = self._recursion
        if self._inflation is None or not recursion.determined:
            return None
        level, determined = np.array([recursion.level]), np.array([True])
        return covariances(
            recursion.factor_now[None], recursion.squared[None], level, determined, self._inflation
        )[0]

    @property
    def std(self) -> Vector | None:
        """Standard errors of θ now (nθ,)."""
        covariance = self.covariance
        return None if covariance is None else np.sqrt(np.diag(covariance))

    @property
    def interval(self) -> Matrix | None:
        """95 % intervals of θ now (nθ, 2)."""
        std = self.std
        return None if std is None else interval(self.theta, std, self._freedom)

    @property
    def alarmed(self) -> bool:
        """True while the residual is out of its band."""
        return self.alarm_level > 1

    @property
    def alarm_level(self) -> float:
        """The largest sum over its limit: above 1 the residual is out of its band."""
        return self._watch.level

    @property
    def fitted(self) -> Model:
        """The model as it was fitted."""
        return self._fitted

    @property
    def forgetting(self) -> float:
        """λ."""
        return self._recursion.forgetting

    @property
    def effective_rows(self) -> float:
        """The number of equally weighted rows with the same information."""
        return self._recursion.effective_rows

    @property
    def model(self) -> Model:
        """The fitted model with θ of now, to simulate and predict with.

        Its statistics were those of training.
        """
        numbers = self._fitted.numbers._replace(theta=self.theta)
        return replace(self._fitted, numbers=numbers, statistics=Statistics())

    @property
    def parameters(self) -> pd.DataFrame:
        """Table with a row per parameter: unit, initial, value now, std, and the 95 % interval."""
        return parameter_frame(
            self._fitted.form.baseline.parameters, self.theta, self.std, self.interval
        )

    @property
    def history(self) -> pd.DataFrame:
        """A row per row that was used.

        Time [s], residual of each output, each θ with its interval, alarm level.

        `alarm` is the largest sum over its limit: above 1 the residual is out of its band. Of more
        than 10 000 rows every second one is kept, every fourth, and so on.
        """
        import pandas as pd

        kept_rows, model = self._rows_kept, self._fitted
        rows = kept_rows.rows
        residual = kept_rows.residual @ np.linalg.inv(model.weight).T
        ci = kept_rows.intervals(self._inflation)
        columns: dict[str, Any] = {"time": rows[:, 0] * model.sampling_time}
        columns |= {f"residual_{c.name}": residual[:, i] for i, c in enumerate(model.outputs)}
        for i, name in enumerate(model.form.baseline.names):
            columns |= {
                name: kept_rows.theta[:, i],
                f"{name}_low": ci[:, i, 0],
                f"{name}_high": ci[:, i, 1],
            }
        columns["alarm"] = kept_rows.alarm
        return pd.DataFrame(columns, index=pd.Index(rows[:, 0].astype(int), name="row"))

    def physical(self, physics: PhysicsMap) -> PhysicalEstimate:
        """Return the physical parameters of the present θ, with intervals (delta method)."""
        order = self._in_order_of(physics)
        covariance = self.covariance
        covariance = None if covariance is None else covariance[np.ix_(order, order)]
        return solve(physics, self.theta[order], covariance, freedom=self._freedom)

    def physical_history(self, physics: PhysicsMap, points: int = 100) -> pd.DataFrame:
        """Return the physical parameters at some instants of `history` and at the last.

        Args:
            points: how many, at most.
        """
        import pandas as pd

        order, kept_rows = self._in_order_of(physics), self._rows_kept
        rows, theta, spread = (
            kept_rows.rows,
            kept_rows.theta,
            kept_rows.covariances(self._inflation),
        )
        places = (
            np.linspace(len(rows) - 1, 0, check_count(points, "points"))
            if len(rows)
            else np.zeros(0)
        )
        chosen = np.unique(places.round().astype(int))
        lines = []
        for k in chosen:
            known = np.isfinite(spread[k]).all()
            covariance = spread[k][np.ix_(order, order)] if known else None
            at = solve(physics, theta[k][order], covariance, freedom=rows[k, 3])
            ends = [(np.nan, np.nan) if ci is None else ci for ci in at.ci95]
            line: dict[str, Any] = {"time": rows[k, 0] * self._fitted.sampling_time}
            for name, value, (low, high) in zip(at.names, at.value, ends, strict=True):
                line |= {name: value, f"{name}_low": low, f"{name}_high": high}
            lines.append(line)
        return pd.DataFrame(lines, index=pd.Index(rows[chosen, 0].astype(int), name="row"))

    def _in_order_of(self, physics: PhysicsMap) -> list[int]:
        return order_of(physics, self._fitted.form.baseline.names, self._fitted.sampling_time)

    def __repr__(self) -> str:
        names = self._fitted.form.baseline.names
        values = ", ".join(f"{n} = {v:.6g}" for n, v in zip(names, self.theta, strict=True))
        return (
            f"Recursive({self.rows} rows, forgetting {self.forgetting:g}, {len(self.alarms)} "
            f"alarms, {values})"
        )

    def summary(self) -> str:
        """Return a page of text: rows, memory, parameters, alarms."""
        step = self._fitted.sampling_time
        memory = (
            "everything" if self.forgetting == 1 else f"{-step / math.log(self.forgetting):.4g} s"
        )
        alarms = "; ".join(map(str, self.alarms)) or "none"
        lines = [
            f"rows        {self.rows}, {self.rows * step:g} s",
            f"memory      {memory} (forgetting {self.forgetting:.8g}), equivalent to "
            f"{self.effective_rows:.0f} rows",
            f"alarms      {alarms}{' (still raised)' if self.alarmed else ''}",
        ]
        if self.outside:
            lines.append(f"outside     {outside_text(self.outside, self.rows)}")
        if self.std is None:
            lines.append(
                "intervals   none: the fit has no standard errors, or the rows do not determine "
                "θ yet"
            )
        rows = parameter_lines(
            self._fitted.form.baseline.parameters, self.theta, self.std, self.interval
        )
        return "\n".join([*lines, "", *rows])


def outside_text(outside: int, rows: int) -> str:
    """Return a sentence on the number of rows on which the learner extrapolates."""
    share = f"{percent(outside / rows)} of the rows"
    return (
        f"the learner's inputs leave their training range on {share}: it extrapolates there, "
        "without an alarm"
    )


def forgetting_factor(forgetting: Any, memory: Any, sampling_time: float) -> float:
    """Return λ from either a factor or a memory.

    Raises:
        InputError: both given, or values that are none.
    """
    if forgetting is not None and memory is not None:
        raise InputError("give `forgetting` or `memory`, not both: forgetting = exp(-Ts / memory).")
    if memory is not None:
        seconds = check_number(memory, "memory", positive=True)
        if seconds < sampling_time:
            raise InputError(
                f"`memory` must be at least one sampling time, {sampling_time:g} s; got "
                f"{show(memory)}."
            )
        return math.exp(-sampling_time / seconds)
    if forgetting is None:
        return 1.0
    if not is_number(forgetting) or not _LEAST_FACTOR <= forgetting <= 1:
        raise InputError(
            f"`forgetting` must lie between {_LEAST_FACTOR:g} and 1; got {show(forgetting)}."
        )
    return float(forgetting)
