"""The result of an estimation: parameters with intervals, status, model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector, check_choice, check_count, check_type
from orthaug._base.errors import InputError, Warning
from orthaug.data.record import Record
from orthaug.fitting.any_fit import (
    STD_KINDS,
    WITHHELD,
    AnyFit,
    Restart,
    left_out,
    parameter_lines,
)
from orthaug.fitting.block_scores import FreeRunScores
from orthaug.fitting.criteria import Criterion, Prediction
from orthaug.fitting.held_out import Focus, HeldOutErrors
from orthaug.fitting.output_noise import OutputNoise, noise_of
from orthaug.fitting.status import Status
from orthaug.inference.covariance import (
    joint_covariance,
    robust_covariance,
    robust_split_covariance,
    row_influence,
)
from orthaug.inference.influence import hc3, one_step_slopes
from orthaug.inference.learned_terms import learned_terms, term_lines
from orthaug.inference.measures import (
    OF_ROWS,
    Measure,
    Points,
    Support,
    Training,
    weigh_problem,
)
from orthaug.inference.nearly_shared import enlarge_covariance
from orthaug.inference.over_experiments import (
    split_without_each,
)
from orthaug.inference.physical import PhysicalEstimate, profile, solve
from orthaug.inference.splitting import (
    MeasureSplit,
    learner_slope,
    split_by_measure,
    streamed_slope,
)
from orthaug.models.model import Model
from orthaug.models.statistics import Statistics
from orthaug.physics.baseline import check_sampling_constant
from orthaug.physics.excitation import Excitation
from orthaug.physics.parameters import PhysicsMap
from orthaug.physics.problem import Problem
from orthaug.physics.streamed import StreamedProblem

NOT_UNIQUE = "theta_not_unique"
"""The code of the warning that a split under a measure makes untrue."""


@dataclass(frozen=True, eq=False, repr=False)
class Estimate(AnyFit):
    """Result of `estimate`. Print `fit.summary()`; use `fit.model`; read `fit.parameters`."""

    model: Model
    status: Status
    restarts: tuple[Restart, ...]
    excitation: Excitation
    covariance: Matrix | None
    """Cov θ̂ (nθ, nθ); None where θ has no standard error."""
    freedom: float
    """Degrees of freedom of the residual: rows less parameters less effective weights.

    For robust errors on the free run: blocks less one.
    """
    effective_weights: float
    defect: float | None
    """‖QᵀF̃‖ / ‖F‖ over the training rows: how much of the learner the physics could express; None
    without one.
    """
    problem: Problem = field(repr=False)
    criterion: Criterion = Prediction()  # noqa: RUF009  (frozen)
    measure: MeasureSplit | None = None
    """What θ was split under, if not the training measure."""
    at_bound: Mapping[str, float] = field(default_factory=dict)
    """Parameters at a bound, with its value."""
    held_out: HeldOutErrors | None = None
    """By what the run was chosen; None where the lowest training loss chose."""
    focus: Focus | None = None
    """What `Auto` chose, and why; None where the criterion was declared."""
    physics_alone: Any = field(default=None, repr=False)
    """The estimate of physics alone that the learner had to beat; None without a learner."""
    warnings: tuple[Warning, ...] = ()
    plain_covariance: Matrix | None = None
    """Cov θ̂ for white noise, where `covariance` is robust; None where it is not."""
    scores: FreeRunScores | None = field(default=None, repr=False)
    """What robust standard errors of a free run are made of; None one step ahead."""
    std_kind: str = "plain"
    """How the standard errors were made, a key of `STD_KINDS`."""
    plain_statistics: Statistics | None = field(default=None, repr=False)
    """The model's statistics for white noise, where they are robust; None where they are not."""

    def reach(self, record: Record) -> Matrix:
        """Return the regressors (N, nx) of a record in the model's order of channels."""
        own = record is self.problem.record
        return self.problem.rows.x if own else self.model.reach(record)

    @property
    def one_step_theta(self) -> Vector | None:
        """Φ⁺Y (nθ,), the one-step least squares, where θ was trained on another criterion.

        None otherwise.
        """
        if self.criterion.free_run is None:
            return None
        return self.problem.least_squares

    @cached_property
    def noise(self) -> tuple[OutputNoise, ...]:
        """Return the noise model of each output; empty where nobody asked for one."""
        return noise_of(self.model, self.problem)

    def split(self, measure: Measure) -> Estimate:
        """Return the same function with θ, components and intervals under a measure (F2).

        Nothing is trained again.

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
        joint = self.model.statistics.joint(len(self.theta))
        under = split_by_measure(measure, self.model, support, joint)
        if under.covariance is not None:
            training = self.covariance if self.measure is None else None
            training = (
                split_by_measure(Training(), self.model, support, joint).covariance
                if training is None
                else training
            )
            with np.errstate(all="ignore"):
                price = np.sqrt(np.diag(under.covariance) / np.diag(np.asarray(training)))
            under = replace(under, price=price)
        plain = None
        if self.plain_statistics is not None and under.slope is not None:
            plain = self._cov_along(self.plain_statistics, under.slope)
        ensemble = under.covariance is None and self.model.numbers.tilt is not None
        text = "no standard errors after a split: an ensemble has no gradient in its weights."
        unknown = (Warning("no_standard_errors", text),) if ensemble else ()
        numbers = self.model.numbers._replace(theta=under.theta, theta_aux=under.theta_aux)
        return replace(
            self,
            model=replace(
                self.model, numbers=numbers, structure="orthogonal", measure=measure.name
            ),
            covariance=None if self.std_kind in WITHHELD else under.covariance,
            plain_covariance=plain,
            std_kind=self.std_kind if plain is not None or self.std_kind in WITHHELD else "plain",
            defect=under.defect,
            measure=under,
            warnings=(
                *(w for w in self.warnings if w.code != NOT_UNIQUE),
                *under.warnings,
                *unknown,
            ),
        )

    def withheld(self, kind: str, why: Warning) -> Estimate:
        return replace(super().withheld(kind, why), plain_statistics=None)

    def joint_covariance(self, convention: str = "calibrated") -> Matrix:
        """Return Cov (nθ + nw)² of θ̂ and the weights from the raw `[Φ P⊥J]`.

        Convention "paper" for eq:cov_approx / N.
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

    def robust(self, lags: int | None = None, kind: str | None = None) -> Estimate:
        """Return the fit with standard errors of θ that hold for coloured and uneven noise.

        One step ahead they are those of Newey and West, or HC3 for noise that is uneven and white.
        On the free run they are batch means of the scores (`fitting/block_scores.py`). Both these
        hold for predictions too.

        Args:
            lags: of the autocovariances; on the free run steps of a block. By default `⌊4
                (N/100)^(2/9)⌋`, on the free run three times as many as the correlation of the
                errors lasts.
            kind: "newey-west" or "hc3" one step ahead; on the free run "batch-means", or
                "autoregressive" for errors of an autoregressive process; None for the first that
                there is.

        Raises:
            InputError: a fit without standard errors or with a parameter at a bound; errors that
                remember each other for too long; a kind that is not for this criterion.
        """
        if self.model.coloured:
            raise InputError(
                "robust standard errors are for fits without a noise model; its own are those of "
                "white innovations."
            )
        simulates = self.criterion.free_run is not None
        kinds = (
            ("batch-means", "batch-means-uneven", "autoregressive")
            if simulates
            else ("newey-west", "hc3")
        )
        kind = kinds[0] if kind is None else check_choice(kind, kinds, "`kind`")
        if self.covariance is None or self.at_bound or (simulates and self.scores is None):
            raise InputError(
                "robust standard errors need a fit with standard errors and no parameter at a "
                "bound."
            )
        if simulates:
            return replace(self._robust_free_run(lags, kind), std_kind=kind)
        if kind == "hc3":
            return self._hc3()
        residual = self.model.predict(self.problem.record).errors
        used = (self.problem, residual, self.effective_weights, lags)
        if self.measure is None and self.model.shared is None:
            covariance = robust_covariance(*used)
        else:
            slope = self._slope()
            covariance = robust_split_covariance(self.problem, self.model, slope, *used[1:])
        plain = self.covariance if self.plain_covariance is None else self.plain_covariance
        covariance = self._enlarge(covariance, self.model.statistics)
        return replace(self, covariance=covariance, plain_covariance=plain, std_kind=kind)

    def _hc3(self) -> Estimate:
        """Return the fit with each row's own error in place of one noise variance."""
        statistics = self.plain_statistics or self.model.statistics
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
        return replace(
            self,
            model=replace(self.model, statistics=own),
            covariance=self._enlarge(self._cov_along(own, self._slope()), own),
            plain_covariance=self.covariance
            if self.plain_covariance is None
            else self.plain_covariance,
            plain_statistics=statistics,
            std_kind="hc3",
        )

    def _enlarge(self, covariance: Matrix | None, statistics: Statistics) -> Matrix | None:
        """Return Cov θ̂, larger along directions that the learner could nearly imitate."""
        return enlarge_covariance(
            covariance, statistics, None if self.model.shared is None else self.problem.shared
        )

    def _robust_free_run(self, steps: int | None, kind: str) -> Estimate:
        """Return the fit with robust standard errors of its free run.

        From blocks of so many steps, or from the colour of its errors.
        """
        assert self.scores is not None
        statistics = self.model.statistics
        if statistics.gram is None or self.model.numbers.tilt is not None:
            raise InputError(
                "the fit has no statistics for robust standard errors; fit the data again."
            )
        steps = None if steps is None else check_count(steps, "lags")
        used = len(self.theta) + self.effective_weights
        modelled = kind == "autoregressive"
        statistics = self.scores.robust(statistics, self.freedom, used, steps, modelled=modelled)
        return replace(
            self,
            model=replace(self.model, statistics=statistics),
            covariance=self._cov_along(statistics, self._slope()),
            plain_covariance=self.covariance
            if self.plain_covariance is None
            else self.plain_covariance,
            plain_statistics=self.model.statistics
            if self.plain_statistics is None
            else self.plain_statistics,
            freedom=statistics.freedom,
        )

    def _cov_along(self, statistics: Statistics, slope: Matrix) -> Matrix | None:
        """Return Cov of `θ = c + θ_aux(w)` from statistics of (c, w)."""
        joint = statistics.joint(len(self.theta))
        return (
            None if joint is None else joint.of(np.column_stack([np.eye(len(self.theta)), slope]))
        )

    def moves_by(self) -> tuple[Matrix, Vector] | None:
        """Return the derivative [I ∂θ_aux/∂w] of θ by (c, w), and which entries of these move."""
        k = np.column_stack([np.eye(len(self.theta)), self._slope()])
        return k, np.ones(k.shape[1], dtype=bool)

    def _slope(self) -> Matrix:
        """Return ∂θ_aux/∂w under the measure that θ was split under."""
        if self.measure is not None and self.measure.slope is not None:
            return self.measure.slope
        problem = self.problem
        if isinstance(problem, StreamedProblem):
            return streamed_slope(self.model, problem)
        points = Points(problem.rows.x, np.ones(len(problem.rows)))
        unit = np.broadcast_to(problem.weight.matrix, (len(points.x), *problem.weight.matrix.shape))
        return learner_slope(self.model, points, problem.projection, unit, problem.noise)

    def _changes_without_each(self) -> Matrix | None:
        problem, split = self.problem, self.measure
        if self.at_bound or isinstance(problem, StreamedProblem):
            return None
        recordings = problem.record.recordings
        experiments, owner = recordings[-1] + 1, np.repeat(recordings, problem.lengths)
        whole = split is None and self.model.shared is None
        if self.criterion.one_step and (whole or not self.learns):
            return split_without_each(
                problem.projection, None, problem.unexplained, owner, experiments
            )
        free_run = self.criterion.free_run
        changes = (
            self._changes_of_rows(owner, experiments)
            if free_run is None
            else self._changes_of_free_run(free_run)
        )
        measure = Training() if split is None or split.measure is None else split.measure
        if changes is None or not isinstance(measure, OF_ROWS) or not self.learns:
            return changes
        weighed = weigh_problem(measure, problem)
        values = weighed.times(self.model.learner_at(weighed.points.x))
        every = np.tile(owner, len(values) // len(owner))
        found = split_without_each(
            weighed.projection, self.model.shared, values, every, experiments
        )
        return None if found is None else changes + found

    def _changes_of_rows(self, owner: Vector, experiments: int) -> Matrix | None:
        """Return what leaving an experiment out of the training one step ahead changes (E, nθ)."""
        if self.model.statistics.gram is None:
            return None
        problem = self.problem
        errors = self.model.predict(problem.record).errors
        matrix = problem.weight.matrix
        influence = row_influence(problem, self.model, self._slope())
        rows = np.einsum("kto,ko->kt", influence, errors @ (matrix.T @ matrix))
        found = np.stack([rows[owner == e].sum(axis=0) for e in range(experiments)])
        return -found * left_out(experiments)

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

    def lines(self) -> list[str]:
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
            lines.append(f"one step    Φ⁺Y would give {moved}")
        if self.plain_covariance is not None:
            lines.append(f"std         {STD_KINDS[self.std_kind]}")
        if self.model.noise is not None:
            lines.append(f"noise       {'; '.join(each.text for each in self.noise)}")
        lines += ["", *parameter_lines(baseline.parameters, self.theta, self.std, self.interval)]
        return [*lines, *term_lines(learned_terms(self.model))]


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
