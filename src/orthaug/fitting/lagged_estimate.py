"""The result of an estimation of lagged physics, which is linear in θ: splits, errors, tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from orthaug._base.checks import Matrix, Vector, check_choice, check_type
from orthaug._base.errors import InputError, Warning
from orthaug._base.views import MAKERS
from orthaug.data.record import Record
from orthaug.fitting.estimates import ROBUST_FREE_RUN, Estimate, left_out
from orthaug.inference.covariance import (
    joint_covariance,
    robust_covariance,
    robust_split_covariance,
    row_influence,
)
from orthaug.inference.influence import hc3, one_step_slopes
from orthaug.inference.measures import (
    OF_ROWS,
    Measure,
    Points,
    Support,
    Training,
    weigh_problem,
)
from orthaug.inference.nearly_shared import enlarge_covariance
from orthaug.inference.over_experiments import split_without_each
from orthaug.inference.physical import PhysicalEstimate, profile, solve
from orthaug.inference.splitting import (
    MeasureSplit,
    learner_slope,
    split_by_measure,
    streamed_slope,
)
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.model import Model
from orthaug.models.statistics import Statistics
from orthaug.physics.baseline import check_sampling_constant
from orthaug.physics.excitation import Excitation
from orthaug.physics.parameters import PhysicsMap
from orthaug.physics.problem import Problem
from orthaug.physics.projection import Projection
from orthaug.physics.streamed import StreamedProblem

NOT_UNIQUE = "theta_not_unique"
"""The code of the warning that a split under a measure makes untrue."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class LaggedEstimate(Estimate):
    """An `Estimate` of physics that is linear in θ over rows of lags."""

    model: Model[LaggedDynamics]
    problem: Problem = field(repr=False)

    _of_split: ClassVar[tuple[str, ...]] = (*Estimate._of_split, NOT_UNIQUE)

    @property
    def measure(self) -> MeasureSplit | None:
        """What θ was split under, if not the training measure."""
        return self.split_by

    @property
    def robust_kinds(self) -> tuple[str, ...]:
        """Robust standard errors that there are for its criterion, the default first.

        None where a parameter is at a bound, or where a noise model has its own.
        """
        if self.at_bound or self.model.coloured:
            return ()
        return ("newey-west", "hc3") if self.criterion.free_run is None else ROBUST_FREE_RUN

    @property
    def excitation(self) -> Excitation:
        """Rank and condition of the physics over the rows."""
        return self.problem.excitation

    def reach(self, record: Record) -> Matrix:
        """Return the regressors (N, nx) of a record in the model's order of channels."""
        own = record is self.problem.record
        return self.problem.rows.x if own else self.model.reach(record)

    @property
    def one_step_theta(self) -> Vector | None:
        """θ (nθ,) of physics alone by least squares one step ahead, where the fit has another.

        None otherwise.
        """
        if self.criterion.free_run is None:
            return None
        return self.problem.least_squares

    def split(self, measure: Measure) -> LaggedEstimate:
        """Return the same function with θ, components and intervals under a measure.

        Nothing is trained again: θ is the least-squares fit of the physics to the function over
        the measure's points.

        Raises:
            InputError: a measure that does not fit the model, or a θ at a bound.
        """
        check_type(measure, Measure, "measure", "a measure such as Uniform()")
        if self.at_bound:
            raise InputError(
                f"{', '.join(self.at_bound)} at a bound: a split under the {measure.name} "
                "measure has no bounds. Drop the bounds, keep the training measure, or set "
                "`fixed = true` there."
            )
        support = Support(
            self.problem.record, self.problem.layout, self.model.form.used, self.problem.rows.x
        )
        under = split_by_measure(measure, self.model, support)
        price = self._price(under, support)
        text = "no standard errors after a split: an ensemble has no gradient in its weights."
        ensemble = under.slope is None and self.model.numbers.tilt is not None
        unknown = (Warning("no_standard_errors", text),) if ensemble else ()
        coloured, plain = self.std_kind == "newey-west", self
        if coloured:  # whose lags depend on the rows' influence, and are found anew
            plain = replace(self, plain_covariance=None, std_kind="plain")
        made = plain._with_split(replace(under, price=price), unknown)
        made = replace(made, model=replace(made.model, structure="orthogonal"))
        return MAKERS["intervals"](made) if coloured and made.covariance is not None else made

    def _price(self, under: MeasureSplit, support: Support) -> Vector | None:
        """Return the standard errors of a split over those under the training measure."""
        joint = self.model.statistics.joint(len(self.theta))
        if joint is None or under.slope is None:
            return None
        white = self.split_by is None and self.plain_covariance is None
        training = self.covariance if white else None
        if training is None:
            slope = split_by_measure(Training(), self.model, support).slope
            assert slope is not None  # as of the other split
            training = joint.of(slope)
        with np.errstate(all="ignore"):
            return np.sqrt(np.diag(joint.of(under.slope)) / np.diag(training))

    def joint_covariance(self, convention: str = "calibrated") -> Matrix:
        """Return Cov (nθ + nw)² of θ̂ and the weights from the raw `[Φ P⊥J]`.

        Convention "paper" for the paper's covariance (`eq:cov_approx`) divided by N.
        """
        if self.criterion.free_run is not None or (
            self.model.statistics.gram is None and self.model.numbers.tilt is None
        ):
            raise InputError("the joint covariance needs a one-step fit with its own statistics.")
        if self.model.coloured:
            raise InputError(
                "the joint covariance of θ̂ and weights is for white noise; `covariance` is that of "
                "θ̂ with the noise model."
            )
        return joint_covariance(self.problem, self.model, convention)

    def robust(self, lags: int | None = None, kind: str | None = None) -> LaggedEstimate:
        if self.model.coloured:
            raise InputError(
                "robust standard errors are for fits without a noise model; its own are those of "
                "white innovations."
            )
        simulates = self.criterion.free_run is not None
        self._check_not_withheld()
        if self.covariance is None or self.at_bound or (simulates and self.scores is None):
            raise InputError(
                "robust standard errors need a fit with standard errors and no parameter at a "
                "bound."
            )
        if simulates:
            return super().robust(lags, kind)
        kinds = self.robust_kinds
        kind = kinds[0] if kind is None else check_choice(kind, kinds, "`kind`")
        if kind == "hc3":
            return self._hc3()
        residual = self.model.predict(self.problem.record).errors
        used = (self.problem, residual, self.effective_weights, lags)
        if self.measure is None and self.model.shared is None:
            covariance = robust_covariance(*used)
        else:
            slope = self.theta_slope
            covariance = robust_split_covariance(self.problem, self.model, slope, *used[1:])
        covariance = self._enlarge(covariance, self.model.statistics)
        plain = self._white_covariance
        return replace(self, covariance=covariance, plain_covariance=plain, std_kind=kind)

    def _hc3(self) -> LaggedEstimate:
        """Return the fit with each row's own error in place of one noise variance."""
        statistics = self._white_statistics
        if (
            statistics.gram is None
            or self.model.numbers.tilt is not None
            or isinstance(self.problem, StreamedProblem)
        ):
            raise InputError(
                "the fit has no statistics for robust standard errors; fit the data again."
            )
        residual = self.model.predict(self.problem.record).errors
        slopes, share = (
            one_step_slopes(self.problem, self.model),
            self.problem.count / len(self.problem.rows),
        )
        own = hc3(
            statistics, slopes, residual @ self.problem.weight.matrix.T, len(self.theta), share
        )
        covariance = self._enlarge(super()._covariance_by(own), own)
        return replace(self._with_statistics(own, "hc3"), covariance=covariance)

    def _enlarge(self, covariance: Matrix | None, statistics: Statistics) -> Matrix | None:
        """Return Cov θ̂, larger along directions that the learner could nearly imitate."""
        return enlarge_covariance(
            covariance, statistics, None if self.model.shared is None else self.problem.shared
        )

    def _covariance_by(self, statistics: Statistics) -> Matrix | None:
        if self.model.numbers.tilt is not None:  # an ensemble has no gradient in its weights
            return None
        covariance = super()._covariance_by(statistics)
        return self._enlarge(covariance, statistics) if self.split_by is None else covariance

    @property
    def theta_slope(self) -> Matrix:
        """[I, ∂θ_aux/∂w], by which θ follows (c, w) under the measure."""
        known = super().theta_slope
        if known is not None:
            return known
        return np.column_stack([np.eye(len(self.theta)), self._learner_slope()])

    def _learner_slope(self) -> Matrix:
        """Return ∂θ_aux/∂w under the training measure."""
        problem = self.problem
        if isinstance(problem, StreamedProblem):
            return streamed_slope(self.model, problem)
        points = Points(problem.rows.x, np.ones(len(problem.rows)))
        unit = np.broadcast_to(problem.weight.matrix, (len(points.x), *problem.weight.matrix.shape))
        return learner_slope(self.model, points, problem.projection, unit, problem.noise)

    def _changes_of_training(self) -> Matrix | None:
        problem = self.problem
        if self.at_bound or isinstance(problem, StreamedProblem):
            return None
        if self.criterion.free_run is not None:
            return super()._changes_of_training()
        owner, experiments = self._owner, problem.record.recordings[-1] + 1
        if self._solved:
            return split_without_each(
                problem.projection, None, problem.unexplained, owner, experiments
            )
        if self.model.statistics.gram is None:
            return None
        errors = self.model.predict(problem.record).errors
        matrix = problem.weight.matrix
        influence = row_influence(problem, self.model, self.theta_slope)
        rows = np.einsum("kto,ko->kt", influence, errors @ (matrix.T @ matrix))
        found = np.stack([rows[owner == e].sum(axis=0) for e in range(experiments)])
        return -found * left_out(experiments)

    def _rows_of_split(self) -> tuple[Projection, Matrix | None, Matrix, Vector] | None:
        split = self.measure
        measure = Training() if split is None or split.measure is None else split.measure
        if self._solved or not isinstance(measure, OF_ROWS):
            return None
        weighed = weigh_problem(measure, self.problem)
        values = weighed.times(self.model.learner_at(weighed.points.x))
        return weighed.projection, self.model.shared, values, self._owner

    @property
    def _solved(self) -> bool:
        """True if θ̂ is Φ⁺Y, whatever the learner."""
        whole = self.measure is None and self.model.shared is None
        return self.criterion.one_step and (whole or not self.learns)

    @property
    def _owner(self) -> Vector:
        """The number of the experiment of each row (N,)."""
        return np.repeat(self.problem.record.recordings, self.problem.lengths)

    def physical(self, physics: PhysicsMap) -> PhysicalEstimate:
        """Return the physical parameters of θ̂, with intervals by the delta method."""
        order, covariance = self._in_order_of(physics)
        return solve(physics, self.theta[order], covariance, freedom=max(self.freedom, 1.0))

    def physical_profile(self, physics: PhysicsMap, name: str) -> tuple[float, float]:
        """Return the 95 % profile-likelihood interval of one physical parameter.

        A side without limit is infinite.
        """
        order, covariance = self._in_order_of(physics)
        if covariance is None:
            raise InputError("θ has no standard errors, so physical parameters have no profile.")
        return profile(physics, self.theta[order], covariance, name, freedom=max(self.freedom, 1.0))

    def _in_order_of(self, physics: PhysicsMap) -> tuple[list[int], Matrix | None]:
        order = order_of(physics, self.problem.baseline.names, self.problem.record.sampling_time)
        return order, None if self.covariance is None else self.covariance[np.ix_(order, order)]

    def _heading(self) -> list[str]:
        baseline, learner = self.problem.baseline, str(self.model.form.bound)
        if self.learns:
            learner += f", {self.effective_weights:.1f} effective"
        lines = [
            f"structure   {self.model.structure}",
            f"learner     {learner}",
            f"data        {self.problem.record!r}, {self.problem.count} usable rows",
            *self.status.lines,
        ]
        if self.defect is not None:
            weight = self.problem.weight
            lines.append(
                f"orthogonal  ‖QᵀF̃‖/‖F‖ = {self.defect:.1e}"
                + ("" if weight.one_output else f", {weight}")
            )
        condition = self.excitation.condition
        lines.append(
            f"excitation  rank {self.excitation.rank} of {self.excitation.columns}"
            + (f", condition {condition:.3g}" if condition else "")
        )
        if self.measure is not None:
            lines.append(f"measure     {self.measure}")
        one_step = self.one_step_theta
        if one_step is not None:
            moved = ", ".join(
                f"{name} {value:.6g}" for name, value in zip(baseline.names, one_step, strict=True)
            )
            lines.append(f"one step    physics alone, fitted one step ahead, has {moved}")
        return lines


def order_of(physics: PhysicsMap, names: Sequence[str], sampling_time: float) -> list[int]:
    """Return the places among `names` of the θ that the physics gives.

    Raises:
        InputError: no PhysicsMap, a θ that is not among them, a constant `Ts` that is not the
            sampling time.
    """
    check_type(physics, PhysicsMap, "physics", "a PhysicsMap, such as PhysicsMap.of(…)")
    check_sampling_constant(physics.constants, sampling_time)
    missing = [name for name in physics.theta_names if name not in names]
    if missing:
        raise InputError(
            f"the physics gives {', '.join(missing)}, which the baseline does not have."
        )
    return [names.index(name) for name in physics.theta_names]
