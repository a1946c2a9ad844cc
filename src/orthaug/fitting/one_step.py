"""Training one step ahead: the learner scaled, rows prepared, one run of a solver (F1, F5)."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError, Warning
from orthaug._base.jax import Array, jnp
from orthaug._base.progress import RunProgress, Watch, quiet
from orthaug.data.record import Record
from orthaug.data.regressors import Features
from orthaug.data.sources import RecordSource, witness
from orthaug.fitting.checkpoints import Checkpoints
from orthaug.fitting.conclusion import conclude
from orthaug.fitting.criteria import Criterion, Prediction
from orthaug.fitting.elimination import Elimination, Fixed, eliminate, split_theta
from orthaug.fitting.kinds import Solver
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.learned import TrainedLearner
from orthaug.fitting.normal_equations import Hold, OneStep, SummedOneStep, linearise
from orthaug.fitting.paper_criterion import JointOneStep, PaperCriterion, Physics
from orthaug.fitting.rules import check_joint, ridge_of
from orthaug.fitting.solvers import compiled
from orthaug.fitting.solvers.adam_lbfgs import GradientRun
from orthaug.fitting.solvers.limit import noticeable_in
from orthaug.fitting.structures import Additive, Orthogonal, Structure
from orthaug.fitting.training_rows import TrainingRows
from orthaug.fitting.unfinished import noticeable_fall
from orthaug.models.learners import Bound, Learner, Scaling, nothing_learned
from orthaug.models.rows import Engine, InMemory, Overlap, filtered_rows
from orthaug.models.terms import scaling_of
from orthaug.physics.problem import Problem
from orthaug.physics.streamed import StreamedProblem

MANY_ROWS, FEW_ROWS = 1_000_000, 200_000
"""From how many rows on runs begin where runs over few of them ended; the table is in
docs/decisions/many_rows.md.
"""
OUTPUT_UNIT = 10.0
"""The learner's output unit in standard deviations of the baseline's residual: the table is in
docs/decisions/output_unit.md.
"""


@dataclass(frozen=True, eq=False)
class OneStepTask(TrainingRows):
    """Training on prepared rows, with physics alone on them and checkpoints of runs."""

    criterion: Criterion = Prediction()  # noqa: RUF009  (frozen)
    physics_loss: float | None = None
    checkpoints: Checkpoints | None = None
    few: OneStepTask | None = None
    """The same on some of very many rows, in memory: a run begins where one over them ended."""

    @classmethod
    def of(
        cls,
        problem: Problem,
        learner: Learner | None,
        scaling: Scaling | None = None,
        unit: Vector | None = None,
        engine: Engine = InMemory(),  # noqa: B008  (frozen)
    ) -> OneStepTask:
        """Scale the features to [-1, 1] and the learner's output to the residual of the physics.

        Unless both scalings are given.
        """
        bound = Bound.of(learner, len(problem.features.entries), len(problem.outputs))
        learns = bound.learns
        streamed = isinstance(problem, StreamedProblem)
        z = problem.feature_range if streamed else problem.feature_rows()
        whitened, spread = problem.unexplained_sizes(centred=learns)
        rms = float(np.sqrt(np.mean(whitened**2)))
        scaling = scaling_of(bound.learner, z) if scaling is None else scaling
        unit = np.asarray(OUTPUT_UNIT * spread if unit is None else unit) * learns
        gain = problem.weight.matrix * unit / rms
        if isinstance(problem, StreamedProblem):
            row_builder = problem.row_builder(scaling.centre, scaling.halfwidth, rms, gain)
            return cls(
                problem, bound, scaling, unit, rms, engine, engine.draw(problem.source, row_builder)
            )
        e, q = problem.unexplained / rms, problem.projection.q
        if problem.noise is not None:
            weight = problem.weight.matrix / rms
            rows: Any = filtered_rows(scaling(z), q, e, unit, problem.noise, weight)
        else:
            rows = engine.build_rows(scaling(z), q, e, np.broadcast_to(gain, (*e.shape, len(e.T))))
        return cls(problem, bound, scaling, unit, rms, engine, rows)

    @property
    def start_loss(self) -> float:
        """Loss of physics alone, in the units of `loss`: of least squares before `prepare`."""
        if self.physics_loss is not None:
            return self.physics_loss
        return self.problem.unexplained_moments.square / self.problem.samples

    @property
    def seconds(self) -> float:
        """Seconds that physics alone took."""
        return 0.0

    @property
    def warnings(self) -> tuple[Warning, ...]:
        """No warnings: least squares has none."""
        return ()

    @property
    def rows_task(self) -> OneStepTask:
        return self

    @property
    def physics_only(self) -> OneStepTask:
        """The task without a learner."""
        problem, scaling = (
            replace(self.problem, features=Features(())),
            Scaling(np.zeros(0), np.ones(0)),
        )
        bound = nothing_learned(len(problem.outputs))
        unit = np.zeros_like(self.unit)
        return replace(self, problem=problem, bound=bound, scaling=scaling, unit=unit)

    def physics_alone(self) -> tuple[OneStepTask, TrainedLearner]:
        """Return the task without a learner, and least squares on its rows."""
        return self.physics_only, self.physics_only.physics_learned()

    def on(self, record: Record) -> OneStepTask:
        """Return the task on another record."""
        return OneStepTask.of(self.problem.on(record), self.bound.learner, engine=self.engine)

    def after(self, runs: Sequence[Any]) -> OneStepTask:
        """Return the task itself: runs one step ahead try nothing more."""
        return self

    def prepare(
        self, solver: Solver, structure: Structure, progress: RunProgress = quiet
    ) -> OneStepTask:
        """Return the task with the loss of physics alone under the structure's rows and bounds.

        It is solved (F1).
        """
        problem, elimination = self.problem, eliminate(structure, self.problem)
        nothing = np.zeros_like(problem.target_coordinates)
        theta = elimination.theta(nothing, elimination.active(nothing))
        missed = problem.target_coordinates - problem.projection.to_coordinates @ theta
        loss = float(problem.unexplained_moments.square + missed @ missed) / problem.samples
        begins = self.bound.learns and solver.gauss_newton and not structure.from_initial
        few = self._train_on_subsample() if begins and problem.count >= MANY_ROWS else None
        return replace(self, physics_loss=loss, few=few and few.prepare(solver, structure))

    def _train_on_subsample(self) -> OneStepTask | None:
        """Return the end of training on a subsample of the rows, weights in the same units.

        None where it lacks what the physics needs.
        """
        problem = self.problem
        source = (
            problem.source
            if isinstance(problem, StreamedProblem)
            else RecordSource(problem.record, 0)
        )
        with suppress(InputError):
            return OneStepTask.of(
                problem.on(witness(source, FEW_ROWS)), self.bound.learner, self.scaling, self.unit
            )
        return None

    def run(
        self,
        solver: Solver,
        w: Any,
        structure: Structure | None = None,
        regularization: str | float = "none",
        progress: RunProgress = quiet,
        watched: Watch | None = None,
    ) -> compiled.TrainingRun:
        """Return one run from the weights `w`.

        The arguments as in `estimate`, `structure` None for no penalty. It is compiled whole, so
        that nothing is there to be `watched`.

        Over very many rows its iterations are those over all of them, its seconds those over the
        few as well.
        """
        structure = Orthogonal() if structure is None else structure
        if self.few is not None:
            first = self.few.run(
                solver, w, structure, regularization, lambda iteration, loss: progress(0, loss)
            )
            w = first.w if first.ending.usable else w
            own = replace(self, few=None).run(solver, w, structure, regularization, progress)
            return own._replace(seconds=first.seconds + own.seconds)
        elimination = eliminate(structure, self.problem)
        run = self._run_inside(solver, w, structure, elimination, regularization, progress)
        plain = not (structure.from_initial or len(elimination.rows.target))
        if not (
            plain and solver.gauss_newton and solver.iterations and self._is_above_physics(run)
        ):
            return run
        # Its runs end below physics alone
        silent = self.bound.silent(np.asarray(w))
        w = w if silent is None else jnp.asarray(silent)
        run = self._run_inside(solver, w, structure, elimination, regularization, progress)
        if (
            elimination.bounded and silent is not None and self._is_above_physics(run)
        ):  # the bounds of another active set
            return self._run_inside(
                solver.at_most(0), w, structure, elimination, regularization, progress
            )
        return run

    def _is_above_physics(self, run: compiled.TrainingRun) -> bool:
        """Return whether a run ended above physics alone."""
        return run.ending.usable and self.loss(run) > self.start_loss

    def _run_inside(
        self,
        solver: Solver,
        w: Array,
        structure: Structure,
        elimination: Elimination,
        regularization: str | float,
        progress: RunProgress,
    ) -> compiled.TrainingRun:
        """Return one run with θ inside its bounds, by an active set.

        Bounds reach into training (F1).

        Entries at a bound are known terms: they are fixed there from the first step on, as if they
        were `fixed`. Where others are at a bound at the end, the run is made again.
        """

        def report(iteration: int, loss: float) -> None:
            progress(iteration, self.mean_square(loss))

        runs: list[compiled.TrainingRun] = []

        def share(fixed: Fixed) -> Vector | None:
            """Return QᵀF at the end of a run with these fixed; None where the run failed."""
            runs.append(
                self._run_held(solver, w, structure, elimination, fixed, regularization, report)
            )
            reach = elimination.bounded and not elimination.decoupled
            return self.coordinates(runs[-1]) if reach and runs[-1].ending.usable else None

        fixed = elimination.settle(share)
        held = bool(elimination.hold(fixed)[0].any())
        known = None if elimination.decoupled else fixed
        return runs[-1]._replace(seconds=sum(run.seconds for run in runs), held=held, fixed=known)

    def coordinates(self, run: compiled.TrainingRun) -> Vector:
        """Return QᵀF (nθ,) in whitened outputs, at the end of a run."""
        return np.asarray(run.normal.overlap.values) * self.rms

    def _run_held(
        self,
        solver: Solver,
        w: Array,
        structure: Structure,
        elimination: Elimination,
        fixed: Fixed,
        regularization: str | float,
        progress: RunProgress,
    ) -> compiled.TrainingRun:
        matrix, target = elimination.hold(fixed)
        hold = Hold(matrix, target / self.rms)
        ridge, evidence = ridge_of(regularization)
        if solver.gauss_newton and not structure.from_initial:
            options: dict[str, object] = {
                "ridge": ridge,
                "evidence": evidence,
                "progress": progress,
            }
            options["noticeable"] = noticeable_fall(
                structure, elimination.decoupled, self.problem.samples
            )
            if regularization == "ard":
                options["groups"] = self.bound.groups()
            if self.checkpoints is not None:
                options["kept"] = self.checkpoints.of_run(
                    np.asarray(w), regularization, structure.name, *hold
                )
            return self._least_squares(solver, w, hold, options)
        check_joint(solver, ridge, evidence, resident=self.engine.resident)
        physics = Physics.of(
            self.problem, elimination, fixed, ridge, self.rms, solved=structure.projects
        )
        if solver.gauss_newton:
            end = self._joint_least_squares(solver, w, physics, progress)
        else:
            joint = PaperCriterion(self.bound, structure.projects)
            end = solver.minimize(joint, w, self.rows, physics, progress=progress)
        normal = linearise(OneStep(self.bound), end.w, (self.rows, hold), self._no_overlap)
        coordinates = np.asarray(physics.start + physics.basis @ end.v) * self.rms
        coefficients = (
            None if structure.projects else self.problem.projection.from_coordinates(coordinates)
        )
        effective = float(compiled.effective_weights(normal, ridge))
        return compiled.TrainingRun(
            end.w, normal, ridge, effective, end.iterations, end.ending, end.seconds, coefficients
        )

    def _joint_least_squares(
        self, solver: Solver, w: Any, physics: Physics, progress: RunProgress
    ) -> GradientRun:
        """Run Levenberg-Marquardt over θ, from θ⁰, and the weights together."""
        nt = len(physics.outputs)
        nothing = Overlap(np.zeros((nt, nt + self.bound.size)), np.zeros(nt))
        unknowns = np.concatenate([np.zeros(nt), w])
        options: dict[str, Any] = {"samples": self.problem.samples, "progress": progress}
        options["noticeable"] = noticeable_in(self.problem.samples)
        end = solver.minimize(
            JointOneStep(self.bound), unknowns, (self.rows, physics), nothing, **options
        )
        return GradientRun(end.w[:nt], end.w[nt:], end.iterations, end.ending, end.seconds)

    def _least_squares(
        self, solver: Any, w: Any, hold: Hold, options: dict[str, Any]
    ) -> compiled.TrainingRun:
        """Run Levenberg-Marquardt, compiled whole for rows in memory, else driven by the host."""
        samples = self.problem.samples - len(self.problem.baseline.names)
        if self.engine.resident:
            criterion, arguments = OneStep(self.bound), (self.rows, hold)
            return solver.minimize(
                criterion, w, arguments, self._no_overlap, samples=samples, **options
            )
        summed = SummedOneStep(self.engine, self.bound, self.rows, hold)
        return solver.drive(summed, jnp.asarray(w), self._no_overlap, samples=samples, **options)

    def refined(
        self, run: compiled.TrainingRun, solver: Solver, structure: Structure
    ) -> tuple[OneStepTask, compiled.TrainingRun]:
        """Return the task and its run as they are: nothing is integrated."""
        return self, run

    def loss(self, run: compiled.TrainingRun) -> float:
        """Return the mean of squared errors of a run, each output in its standard deviation."""
        return self.mean_square(run.normal.loss)

    def learned(self, run: compiled.TrainingRun) -> TrainedLearner:
        """Return the learner as a run left it."""
        return TrainedLearner(
            bound=self.bound,
            weights=np.asarray(run.w),
            scaling=self.scaling,
            unit=self.unit,
            ending=run.ending,
            iterations=run.iterations,
            seconds=run.seconds,
            effective=run.effective,
            gram=self.gram(run),
            ridge=run.ridge * self.rms**2,
            middle=lambda noise: self.middle(run.w, noise),
            coefficients=run.coefficients,
            fixed=None if run.coefficients is not None else run.fixed,
            tail=run.tail,
        )

    def physics_learned(self) -> TrainedLearner:
        """Return the result of physics alone, which is solved and not trained."""
        change = self.problem.projection.to_coordinates
        none = np.zeros(0)
        return TrainedLearner(
            bound=nothing_learned(len(self.problem.outputs)),
            weights=none,
            scaling=self.scaling,
            unit=self.unit,
            gram=change.T @ change,
            middle=lambda noise: self.middle(none, noise),
        )

    def conclude(
        self, structure: Structure, learned: TrainedLearner, *, briefly: bool = False
    ) -> LaggedEstimate:
        """Return the estimate of what a run learned."""
        return conclude(self, structure, learned)

    def median(self, members: list[TrainedLearner], best: int) -> TrainedLearner:
        """Return the median `g = φ c̄ + median_i(f_i + φ (c_i − c̄))` of several runs (F2).

        Each run has its own c_i.

        The median is one function of the regressor again, and split like any other. It lacks some
        statistics: those are taken from the `best` member.
        """
        coefficients = [
            split_theta(
                Additive(), self.problem, self.share(member).coordinates, fixed=member.fixed or {}
            ).theta
            if member.coefficients is None
            else member.coefficients
            for member in members
        ]
        centre = np.mean(coefficients, axis=0)
        return replace(
            members[best],
            weights=np.stack([member.weights for member in members]),
            tilt=np.array(coefficients) - centre,
            effective=float(np.mean([member.effective for member in members])),
            gram=None,
            fixed=None,
            coefficients=centre if members[best].coefficients is not None else None,
        )

    def gram(self, run: compiled.TrainingRun) -> Matrix:
        """Return the Gram matrix of `[Φ J]` in whitened outputs, from the run's last pass.

        Of a held run without the hold.
        """
        normal = run.normal
        if run.held:
            nt = len(normal.overlap.values)
            free = Hold(np.zeros((nt, nt)), np.zeros(nt))
            normal = SummedOneStep(self.engine, self.bound, self.rows, free)(
                np.asarray(run.w), normal.overlap
            )
        overlap = np.asarray(normal.overlap.jacobian) * self.rms
        to_phi = self.problem.projection.to_coordinates
        inner = np.asarray(normal.hessian) * self.rms**2 + overlap.T @ overlap
        cross = to_phi.T @ overlap
        return np.block([[to_phi.T @ to_phi, cross], [cross.T, inner]])
