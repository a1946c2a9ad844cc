"""Fits of any physics: errors over experiments, how standard errors were made, tables, text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug._base.lines import fold
from orthaug._base.views import FitView
from orthaug.data.record import Record
from orthaug.data.regressors import Layout
from orthaug.fitting.block_scores import FreeRunScores
from orthaug.fitting.criteria import Simulation
from orthaug.fitting.status import Status
from orthaug.inference.covariance import interval
from orthaug.inference.learned_terms import equation, learned_terms, term_frame
from orthaug.inference.over_experiments import FEWEST, OverExperiments, over_experiments
from orthaug.models.model import Model
from orthaug.models.statistics import half_inverse
from orthaug.physics.parameters import Coordinates

if TYPE_CHECKING:
    import pandas as pd

STD_KINDS = {
    "plain": "for white errors of constant variance",
    "hc3": "robust (HC3), because the variance of the errors is not constant",
    "newey-west": "robust (Newey-West), because the one-step residual is coloured",
    "batch-means": "robust (batch means), because the errors of the free run are coloured",
    "autoregressive": (
        "robust (autoregressive errors), because the errors of the free run are coloured"
    ),
    "batch-means-uneven": (
        "robust (batch means), because the variance of the free run's errors is not constant"
    ),
    "none": "none: the errors of the free run are correlated over too many steps",
    "chosen": "none: the terms were chosen on the rows that were fitted",
}
"""How standard errors were made, in words."""
WITHHELD = ("none", "chosen")
"""The kinds of fits that have none."""


@dataclass(frozen=True)
class Restart:
    """One run from its own initial weights."""

    seed: int
    loss: float | None
    iterations: int
    code: str
    chosen: bool
    regularization: str | float = "none"
    validation: float | None = None
    """Mean squared error where nothing was fitted: on the validation record, or on held-out blocks.
    """
    score: float | None = None
    """Generalised cross-validation, where that chose among the runs."""


class AnyFit(FitView):
    """Fields and methods common to fits of lagged models and of motions."""

    model: Model[Any]
    problem: Any
    status: Status
    covariance: Matrix | None
    plain_covariance: Matrix | None
    freedom: float
    scores: FreeRunScores | None
    warnings: tuple[Warning, ...]

    @property
    def theta(self) -> Vector:
        """θ̂ (nθ,); of a motion the coordinates of p̂ (np,)."""
        return self.model.theta

    @property
    def coordinates(self) -> Coordinates:
        """The parameters, and the map from θ̂ to their values."""
        return self.model.form.coordinates

    @property
    def values(self) -> Vector:
        """The parameters' values: θ̂ (nθ,), or p̂ (np,) of a motion."""
        return np.asarray(self.coordinates.physical(self.theta))

    @property
    def std(self) -> Vector | None:
        """Standard errors of the values, NaN where one has none."""
        return self._std_of(self.covariance)

    @property
    def plain_std(self) -> Vector | None:
        """The standard errors for white noise, where those of `std` are robust.

        None where they are not.
        """
        return self._std_of(self.plain_covariance)

    def _std_of(self, covariance: Matrix | None) -> Vector | None:
        """Return standard errors by the delta method, from a covariance of θ̂."""
        if covariance is None:
            return None
        return np.sqrt(np.diag(covariance)) * np.abs(self.coordinates.slopes(self.theta))

    @property
    def interval(self) -> Matrix | None:
        """95 % intervals of the values (nθ, 2); those of positive parameters are positive."""
        if self.covariance is None:
            return None
        std = np.sqrt(np.diag(self.covariance))
        return self._ends(interval(self.theta, std, max(self.freedom, 1.0)))

    def _ends(self, limits: Matrix) -> Matrix:
        """Return intervals of θ̂ (nθ, 2) as those of the values."""
        return np.stack([self.coordinates.physical(side) for side in limits.T], axis=-1)

    @cached_property
    def parameters(self) -> pd.DataFrame:
        """Table with a row per parameter: unit, initial, value, std, 95 % interval.

        Of a motion also whether a learner could imitate it, `shared`.
        """
        table = parameter_frame(self.coordinates.parameters, self.values, self.std, self.interval)
        return table.assign(**self._more_columns())

    def _more_columns(self) -> dict[str, Any]:
        """Return further columns of `parameters`."""
        return {}

    @property
    def layout(self) -> Layout:
        """Names of the entries of `reach`."""
        return self.problem.layout

    def reach(self, record: Record) -> Matrix:
        """Return the points of a record at which the physics is evaluated, (N, nx)."""
        return self.model.reach(record)

    def __repr__(self) -> str:
        values = zip(self.coordinates.parameters, self.values, strict=True)
        return (
            f"{type(self).__name__}({self.model.structure}, {self.status.code}, loss "
            f"{self.status.loss:.3g}, {', '.join(f'{p.name} = {v:.6g}' for p, v in values)})"
        )

    @property
    def learns(self) -> bool:
        """False where the physics is alone."""
        return self.model.learns

    @cached_property
    def terms(self) -> pd.DataFrame:
        """Table with a row per term of a learner of terms: coefficient, unit, std, 95 % interval.

        Else empty.
        """
        return term_frame(learned_terms(self.model))

    def equation(self, writing: str = "text") -> str:
        """Return the fitted equations with their numbers, where the learner is a sum of terms.

        As "text", "latex", "python".

        Raises:
            InputError: another learner, physics that are Python functions, another writing.
        """
        return equation(self.model, writing)

    @cached_property
    def over_experiments(self) -> OverExperiments | None:
        """Errors of θ̂ for experiments like those fitted, by leaving out one after the other.

        Those of `std` and `interval` hold for the inputs that were applied. None where there are
        fewer than three experiments, or no standard errors.
        """
        if self.covariance is None or self.model.numbers.tilt is not None:
            return None
        if self.problem.record.recordings[-1] + 1 < FEWEST:
            return None
        changes = self._changes_without_each()
        return None if changes is None else self._over_experiments(changes)

    def _changes_without_each(self) -> Matrix | None:
        """Return the changes of θ̂ (E, nθ) where each experiment is left out, to first order."""
        raise NotImplementedError

    def _over_experiments(self, changes: Matrix) -> OverExperiments:
        slopes = self.coordinates.slopes(self.theta)
        found = over_experiments(
            changes, np.asarray(self.covariance), self.freedom, self.theta, slopes
        )
        return replace(found, interval=self._ends(found.interval))

    def moves_by(self) -> tuple[Matrix, Vector] | None:
        """Return the derivative of θ by (c, w), and which entries of these move."""
        raise NotImplementedError

    def _changes_of_free_run(self, free_run: Simulation) -> Matrix | None:
        """Return what leaving an experiment out of the training on the free run changes (E, nθ).

        The points of the split stay.
        """
        statistics, moves = self.model.statistics, self.moves_by()
        if self.scores is None or statistics.gram is None or moves is None:
            return None
        scores = self.scores.by_recording(self.problem.record, free_run.washout)
        if scores is None:
            return None
        k, free = moves
        nt = len(self.theta)
        information = statistics.information(nt)[np.ix_(free, free)]
        half = half_inverse(information, int(free[:nt].sum()))
        return -scores[:, free] @ half @ (half.T @ k[:, free].T) * left_out(len(scores))

    def withheld(self, kind: str, why: Warning) -> Any:
        """Return the fit without standard errors and intervals of θ, terms and predictions.

        A warning says why.
        """
        fit: Any = self
        statistics = replace(fit.model.statistics, middle=None)
        return replace(
            fit,
            model=replace(fit.model, statistics=statistics),
            covariance=None,
            plain_covariance=None,
            std_kind=kind,
            warnings=(*fit.warnings, why),
        )

    def lines(self) -> list[str]:
        """Return the lines of `summary` before its warnings."""
        raise NotImplementedError

    def summary(self) -> str:
        """Return a page of text: status, parameters with their uncertainty, warnings."""
        warnings = (
            ["", *(f"warning: {warning}" for warning in self.warnings)] if self.warnings else []
        )
        return "\n".join(fold([*self.lines(), *warnings]))


def left_out(experiments: int) -> float:
    """Return by how much more θ̂ changes where an experiment is left out than by its own score."""
    return experiments / (experiments - 1)


def parameter_frame(
    parameters: Sequence[Any], values: Vector, std: Vector | None, ci: Matrix | None
) -> pd.DataFrame:
    """Return a table with a row per parameter: unit, initial, value, std, 95 % interval.

    NaN where there is none.
    """
    import pandas as pd

    nothing = np.full(len(parameters), np.nan)
    ci = np.stack([nothing, nothing], axis=-1) if ci is None else ci
    return pd.DataFrame(
        {
            "unit": [p.unit for p in parameters],
            "initial": [p.initial for p in parameters],
            "value": values,
            "std": nothing if std is None else std,
            "ci95_low": ci[:, 0],
            "ci95_high": ci[:, 1],
        },
        index=pd.Index([p.name for p in parameters], name="parameter"),
    )


def parameter_lines(
    parameters: Sequence[Any], values: Vector, std: Vector | None, ci: Matrix | None
) -> list[str]:
    """Return the parameters as lines of text, a heading first; a dash for no interval."""
    width = max([9, *(len(p.name) for p in parameters)])
    lines = [
        f"{'parameter':<{width}}  {'value':>14}  {'std':>11}  {'95 % interval':^29}  "
        f"{'initial':>11}  unit"
    ]
    for i, parameter in enumerate(parameters):
        spread, reach = f"{'–':>11}", f"{'–':^29}"
        if std is not None and ci is not None and np.isfinite(std[i]):
            spread, reach = f"{std[i]:11.4g}", f"[{ci[i, 0]:13.7g}, {ci[i, 1]:13.7g}]"
        lines.append(
            f"{parameter.name:<{width}}  {values[i]:14.8g}  {spread}  {reach}  "
            f"{parameter.initial:11.5g}  {parameter.unit}".rstrip()
        )
    return lines
