"""A motion that is trained on from an earlier model: its parameters, weights and scaling."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.errors import InputError
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.motion_task import MotionTask
from orthaug.fitting.segment_sums import SegmentSums
from orthaug.fitting.segmented_motion import SegmentedMotion
from orthaug.fitting.segmented_problem import FreeRunFit
from orthaug.fitting.simulation_task import StartPoint
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Structure
from orthaug.models.learners import Scaling
from orthaug.models.model import Model
from orthaug.models.moving import MotionDynamics
from orthaug.models.rows import Engine
from orthaug.physics.motion import Motion
from orthaug.physics.problem import MotionProblem

_SETTLING = 200  # iterations of the starts, which no step of the descent damps


def with_its_memory(model: Model[Any], motion: Motion) -> Motion:
    """Return the motion with the states that the learner of a model remembers by."""
    states = () if model.form.separates else model.form.motion.states
    return replace(motion, states=(*motion.states, *(s for s in states if s.memory)))


def check_initial_motion(model: Model[Any], motion: Motion) -> None:
    """Raise InputError for a model that the training of a motion cannot go on from."""
    if model.form.separates:
        raise InputError("`initial` is a lagged model, which has no states; fit anew.")
    if not model.learns:
        raise InputError(
            "`initial` is physics alone and has no weights to start from; give its values as "
            "the `initial` of the parameters instead."
        )
    theirs = model.form.motion
    if theirs.names != motion.names or theirs.names_of_states != motion.names_of_states:
        raise InputError(
            f"`initial` has the states {', '.join(theirs.names_of_states)} and the parameters "
            f"{', '.join(theirs.names) or 'none'}, the motion "
            f"{', '.join(motion.names_of_states)} and {', '.join(motion.names) or 'none'}; fit "
            "anew."
        )
    if theirs.learned != motion.learned:
        raise InputError(
            "`initial` has its learner in other equations than the motion; set `learned` alike, "
            "or fit anew."
        )


@dataclass(frozen=True, eq=False)
class WarmMotionTask(MotionTask):
    """A motion in segments, whose runs may begin at an earlier model."""

    begun: Vector = field(kw_only=True)
    """The parameters' coordinates of that model, beside its learner."""

    @classmethod
    def from_model(
        cls,
        problem: MotionProblem,
        model: Model[MotionDynamics],
        criterion: Criterion,
        engine: Engine,
    ) -> WarmMotionTask:
        """Return the task with the learner of a model, in its scaling.

        Raises:
            InputError: nothing would be scored.
        """
        form, numbers = model.form, model.numbers
        plan = SegmentedMotion.of(problem, form.bound, criterion, sums=SegmentSums.of(engine))
        plan = replace(
            plan,
            scaling=Scaling(np.asarray(numbers.centre), np.asarray(numbers.halfwidth)),
            unit=np.asarray(numbers.gain),
        )
        coordinates = problem.motion.coordinates
        beside = form.coordinates.physical(model.theta - model.theta_aux)
        return cls(plan, begun=np.clip(coordinates.of(beside), *coordinates.bounds))

    def scaled(self, plan: SegmentedMotion, physics: FreeRunFit) -> SegmentedMotion:
        """Return the problem as it is: the weights hold in the scaling of their own training."""
        return plan

    def places(
        self,
        objective: Any,
        solver: LevenbergMarquardt,
        w: Vector,
        structure: Structure,
        regularization: str | float,
    ) -> list[StartPoint]:
        """Return the start at physics alone with a silent learner, and that at the model."""
        places = super().places(objective, solver, w, structure, regularization)
        states = self.plan.settle(self.begun, w, iterations=_SETTLING)
        return [*places, StartPoint.of(objective, np.concatenate([self.begun, w]), states)]
