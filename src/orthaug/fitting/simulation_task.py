"""Runs on the free-run criterion that start from physics alone, of any dynamics.

Every run starts where physics alone ended, with a learner that is silent there. Only what lowers
the loss is accepted, so that no run ends above physics alone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug._base.progress import RunProgress, Watch, quiet
from orthaug.fitting.block_scores import FreeRunScores
from orthaug.fitting.checkpoints import Checkpoints
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.initial_states import Start
from orthaug.fitting.learned import ErrorStatistics, TrainedLearner
from orthaug.fitting.objective import FreeRunObjective
from orthaug.fitting.rules import ridge_of
from orthaug.fitting.segmented_problem import FreeRunFit, SegmentedProblem
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.solvers.minimize import LEARNED, Descent
from orthaug.fitting.status import Ending
from orthaug.fitting.structures import Structure
from orthaug.inference.covariance import theta_block
from orthaug.models.learners import Bound, remembers

_LOOKED_AT = 8  # iterates of a run that ended above physics alone
NOTICEABLE = 0.1
"""Of −2 log L: two steps that gain less end a look for more."""
_CLEARLY = 4.0  # −2 log L for each weight: what more weights must gain


class StartPoint(NamedTuple):
    """A possible start of a run: p, the segments' states, the loss, a silent learner or not."""

    p: Vector
    states: np.ndarray
    loss: float
    silent: bool

    @classmethod
    def of(
        cls, objective: FreeRunObjective, p: Vector, states: np.ndarray, *, silent: bool = False
    ) -> StartPoint:
        """Return the start at p and these states, with its loss; infinite where it runs away."""
        loss = objective.evaluate(p, Start(states)).loss
        return cls(p, states, loss if np.isfinite(loss) else np.inf, silent)


def _lowers_loss(free_fit: FreeRunFit, first_loss: float) -> bool:
    """Return whether the weights lowered the loss.

    If not, evidence may have found too early that none are needed.
    """
    return bool(free_fit.end.point.loss < LEARNED * first_loss)


# Self is nothing that run-time checks of annotations can read
Task = TypeVar("Task", bound="SimulationTask")


@dataclass(frozen=True, eq=False)
class SimulationTask(ABC):
    """A problem in segments, and the run of physics alone on it.

    The run is None before `prepare`, and where no run of physics alone is finite.
    """

    plan: Any
    """The `SegmentedProblem`."""
    physics: FreeRunFit | None = None
    doubts_evidence: bool = True
    """Whether a run without a prior looks for what evidence may have missed."""

    def after(self: Task, runs: Sequence[FreeRunFit]) -> Task:
        """Return the task for further runs: evidence is doubted where it failed one of `runs`."""
        return replace(self, doubts_evidence=any(run.begun_anew for run in runs))

    @abstractmethod
    def train_physics_only(
        self, solver: LevenbergMarquardt, structure: Structure, progress: RunProgress
    ) -> tuple[Any, FreeRunFit | None]:
        """Return the problem and physics alone trained on it; None where no run is finite."""

    def scaled(self, plan: SegmentedProblem, physics: FreeRunFit) -> SegmentedProblem:
        """Return the problem with its learner scaled by the run of physics alone."""
        return plan

    @abstractmethod
    def places(
        self,
        objective: Any,
        solver: LevenbergMarquardt,
        w: Vector,
        structure: Structure,
        regularization: str | float,
    ) -> list[StartPoint]:
        """Return possible starts of a run from the weights w; arguments as in `estimate`."""

    def prepare(
        self: Task, solver: LevenbergMarquardt, structure: Structure, progress: RunProgress = quiet
    ) -> Task:
        """Return the task with physics alone trained.

        Its errors are then the unit of the criterion, in which a ridge counts. Where it runs away
        over whole experiments, runs are compared over segments.
        """
        plan, physics = self.train_physics_only(solver, structure, self.plan.reporting(progress))
        if physics is None:
            return self
        rms = plan.rms * float(np.sqrt(physics.end.point.misfit / plan.residuals))
        plan = replace(plan, rms=max(rms, 1e-10 * plan.rms))
        if not np.isfinite(physics.mean_square):
            plan, point = replace(plan, whole=plan.segments), physics.end.point
            physics = physics._replace(mean_square=plan.physics_only.mean_square(point.c, point.w))
        return replace(self, plan=self.scaled(plan, physics), physics=physics)

    def with_checkpoints(self: Task, checkpoints: Checkpoints | None) -> Task:
        """Return the task with checkpoints of its descents."""
        return replace(self, plan=replace(self.plan, checkpoints=checkpoints))

    @property
    def problem(self) -> Any:
        """The estimation problem, with its record."""
        return self.plan.problem

    @property
    def bound(self) -> Bound:
        return self.plan.bound

    @property
    def criterion(self) -> Criterion:
        return self.plan.criterion

    @property
    def start_loss(self) -> float | None:
        """Loss of physics alone, in the units of `loss`; None where no run of it is finite."""
        return None if self.physics is None else self.physics.mean_square

    @property
    def seconds(self) -> float:
        """Seconds that physics alone took."""
        return 0.0 if self.physics is None else self.physics.seconds

    @property
    def warnings(self) -> tuple[Warning, ...]:
        """A warning where runs cannot be compared over whole experiments."""
        if self.physics is None or self.plan.whole is not self.plan.segments:
            return ()
        if not self.criterion.simulates or not self.plan.free_run.steps:
            return ()
        text = (
            "the free run of physics alone diverges over whole experiments of the training "
            "data, so `loss` is that of its segments. Bound the parameters that make it "
            "diverge, or use predictions at most a segment ahead."
        )
        return (Warning("free_run_diverges", text),)

    def run(
        self,
        solver: LevenbergMarquardt,
        w: Any,
        structure: Structure,
        regularization: str | float = "none",
        progress: RunProgress = quiet,
        watched: Watch | None = None,
    ) -> FreeRunFit:
        """Return one run from the weights `w`; a silent learner and physics alone are tried too.

        The arguments as in `estimate`; `watched` follows the run.

        An earlier model is gone on from where it is better than physics alone. A learner that
        cannot be silenced starts with its weights, from the best θ for them.
        """
        plan, physics = self.plan, self.physics
        if not self.bound.learns and physics is not None:
            return physics
        objective, w = plan.objective(structure), np.asarray(w)
        ridge, evidence = ridge_of(regularization)
        places = self.places(objective, solver, w, structure, regularization)
        best = min(places, key=lambda place: place.loss)
        ceiling = min((place.loss for place in places if place.silent), default=np.inf)
        if evidence and np.isfinite(
            best.loss
        ):  # one prior deviation of the weights for one of what is left
            ridge = best.loss / plan.residuals

        report = plan.reporting(progress)
        options: dict[str, Any] = {"ridge": ridge, "evidence": evidence, "evidence_settled": True}
        kept: dict[str, Any] = {"ceiling": ceiling, "watched": watched}
        first = None
        # The weights of a memory are needed only when others have grown: too late for evidence
        if not (evidence and remembers(self.bound.learner)):
            first = plan.descend(objective, best.p, solver, report, best.states, **kept, **options)
            if not (evidence and self.doubts_evidence) or first.ending is Ending.STOPPED:
                return self._below_physics(first)
        looking = solver.within_limit.until(NOTICEABLE / plan.residuals)
        free = plan.descend(objective, best.p, looking, report, best.states, **kept)
        if not _lowers_loss(free, best.loss):
            return self._below_physics(free if first is None else first)
        settled = first if first is not None and _lowers_loss(first, best.loss) else None
        if settled is not None and not self._is_clearly_better(free, settled):
            return self._below_physics(settled)
        point, options = free.end.point, options | {"evidence_settled": False}
        again = plan.descend(objective, point.p, solver, report, point.states, **kept, **options)
        if settled is not None and not self._is_clearly_better(again, settled):
            return self._below_physics(settled)
        chosen = again if _lowers_loss(again, best.loss) else free if first is None else first
        if chosen is not free:
            spent = {
                "iterations": free.iterations + chosen.iterations,
                "seconds": free.seconds + chosen.seconds,
            }
            chosen = chosen._replace(**spent, begun_anew=settled is not None)
        return self._below_physics(chosen)

    def refined(
        self: Task, run: FreeRunFit, solver: LevenbergMarquardt, structure: Structure
    ) -> tuple[Task, FreeRunFit]:
        """Return the task and its run as they are: nothing is integrated."""
        return self, run

    def _is_clearly_better(self, one: FreeRunFit, by_evidence: FreeRunFit) -> bool:
        """Return whether a run explains more than its weights would explain of noise.

        Evidence that begins at a silent learner may settle with a few weights although others
        explain far more. Of white noise each further weight takes one from −2 log L.
        """
        if not one.ending.usable or not by_evidence.ending.usable:
            return False
        gain = self.plan.residuals * np.log(by_evidence.mean_square / one.mean_square)
        more = max(1.0, one.effective - by_evidence.effective)
        return bool(gain > _CLEARLY * more)

    def _below_physics(self, free_fit: FreeRunFit) -> FreeRunFit:
        """Return the run, or its best iterate, so that it is not above physics alone.

        The comparison is over whole experiments.
        """
        physics = self.physics
        if physics is None or free_fit.mean_square <= physics.mean_square or not free_fit.end.path:
            return free_fit
        objective, end, plan = free_fit.objective, free_fit.end, self.plan
        looked = np.unique(np.linspace(0, len(end.path) - 1, _LOOKED_AT).astype(int))
        losses = [plan.mean_square(*objective.place(end.path[i])[1:]) for i in looked]
        if not np.isfinite(losses).any():
            return free_fit
        best = int(np.nanargmin(losses))
        point = objective.evaluate(end.path[looked[best]], Start(objective.initial.measured))
        return free_fit._replace(
            end=end._replace(point=point, linear=objective.linearise(point)),
            mean_square=min(losses[best], physics.mean_square),  # its own start differs by rounding
        )

    def loss(self, run: FreeRunFit) -> float:
        """Return the run's `mean_square`."""
        return run.mean_square

    def learned(self, run: FreeRunFit) -> TrainedLearner:
        """Return the learner as a run left it, with the statistics of its errors."""
        end, objective = run.end, run.objective
        linear, rms = end.linear, objective.rms
        gram = None if linear is None else linear.information * rms**2

        def middle(noise: Matrix) -> Matrix:
            """Return ΣψᵀΣ_eψ of the rows of `gram`, white where `weight` made them so."""
            assert gram is not None
            # Of errors in whitened outputs
            change = objective.weight @ np.linalg.inv(self.problem.weight.matrix)
            white = change @ noise @ change.T * rms**2
            return gram * float(np.trace(white)) / len(white)

        return TrainedLearner(
            bound=self.bound,
            weights=end.point.w,
            scaling=self.plan.scaling,
            unit=self.plan.unit,
            ending=end.ending,
            iterations=run.iterations,
            seconds=run.seconds,
            effective=end.effective,
            gram=gram,
            ridge=end.ridge * rms**2,
            middle=middle,
            coefficients=end.point.c,
            errors=self._errors(run),
            scores=self._scores(run),
            tail=end.tail,
        )

    def _errors(self, run: FreeRunFit) -> ErrorStatistics:
        """Return noise covariance of the free run, and Cov θ̂ from its sensitivities."""
        end, objective = run.end, run.objective
        theta, nt = end.point.theta, objective.physics
        freedom = float(self.plan.observations.mean())
        freedom -= (nt + end.effective) / len(objective.weight)
        noise = self.plan.noise(objective, end)
        held = () if objective.bounds is None else zip(theta, *objective.bounds, strict=True)
        at_bound = {i: float(value) for i, (value, *ends) in enumerate(held) if value in ends}
        covariance = None
        if noise is not None and end.linear is not None:
            covariance = self._covariance(objective, end, noise, tuple(at_bound))
        return ErrorStatistics(noise, covariance, freedom, run.mean_square, at_bound)

    def _scores(self, run: FreeRunFit) -> FreeRunScores | None:
        """Return the scores for robust standard errors; None for a run without an end."""
        if run.end.linear is None or not run.end.ending.usable:
            return None
        objective, point, slope = self.plan.end_in_memory(run.objective, run.end)
        rows = objective.start_rows
        missed = np.moveaxis(objective.initial.measured - point.states, -1, 1)
        return FreeRunScores(
            dynamics=objective.dynamics,
            numbers=self.plan.numbers(point.c, point.w),
            segments=objective.segments,
            states=point.states,
            weight=objective.weight,
            unit=objective.rms**2,
            slope=slope,
            pull=missed @ (rows.T @ rows) if objective.initial.free else None,
            share=self.plan.segments.count / objective.segments.count,
        )

    def _covariance(
        self, objective: FreeRunObjective, end: Descent, noise: Matrix, at_bound: tuple[int, ...]
    ) -> Matrix | None:
        assert end.linear is not None
        information = objective.theta_information(end.linear, end.point.w)
        white = objective.weight @ noise @ objective.weight.T
        return (
            theta_block(information, end.ridge, objective.physics, at_bound)
            * float(np.trace(white))
            / len(white)
        )
