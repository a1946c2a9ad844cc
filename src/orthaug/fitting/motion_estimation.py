"""Fitting a motion to a record, with a learner beside some of its equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from orthaug._base.checks import check_type
from orthaug._base.progress import SILENT, Tell
from orthaug.data.record import Record
from orthaug.fitting.checkpoints import Checkpoints
from orthaug.fitting.criteria import Criterion, Simulation
from orthaug.fitting.motion_conclusion import conclude_motion
from orthaug.fitting.motion_estimates import MotionEstimate
from orthaug.fitting.motion_task import MotionTask
from orthaug.fitting.rules import check_motion_choices, check_solver, checked_starts, tried
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.solvers.solver import Solver
from orthaug.fitting.structures import Orthogonal, Structure
from orthaug.fitting.training import Choice, planned, train
from orthaug.models.learners import Learner
from orthaug.models.rows import Engine, InMemory
from orthaug.models.tasks import Tasks, runs_on
from orthaug.physics.motion import Motion
from orthaug.physics.motion_problem import MotionProblem, pose_motion

DEFAULT = Simulation(washout=0)
"""The criterion of a motion: its segments start at estimated states, so that none of their steps is left out."""


def pose_for(
    record: Record, motion: Motion, learner: Learner | None, output_weights: str | Sequence[float]
) -> MotionProblem:
    """The problem of a motion with what a learner sees.

    Raises:
        InputError: as `pose_motion`.
    """
    check_type(record, Record, "record", "a Record")
    check_type(learner, Learner | None, "learner", "a learner such as MLP(), or None")
    return pose_motion(record, motion, None if learner is None else learner.inputs, output_weights)


def fit_motion(
    problem: MotionProblem,
    *,
    learner: Learner | None,
    structure: Structure = Orthogonal(),  # noqa: B008  (frozen)
    criterion: Criterion = DEFAULT,
    solver: Solver = LevenbergMarquardt(),  # noqa: B008  (frozen)
    regularization: str | float | Sequence[str | float] = "auto",
    restarts: int = 1,
    seed: int = 0,
    blocks: int = 4,
    fallback: bool = True,
    validation: Record | None = None,
    progress: Tell = SILENT,
    engine: Engine = InMemory(),  # noqa: B008  (frozen)
    checkpoints: Checkpoints | None = None,
) -> MotionEstimate:
    """`estimate` for a motion that is posed already; arguments as there.

    Raises:
        InputError: what a motion cannot be trained with.
    """
    check_motion_choices(problem.motion, learner, structure, criterion, solver)
    validated = validation is not None
    conditions = {"linear": False, "validated": validated, "motion": True}
    choices = tried(regularization, solver, criterion, structure, learner=learner, **conditions)
    restarts, seed = checked_starts(restarts, seed, warm=False, ensemble=False)
    check_solver(solver, criterion, () if learner is None else choices)
    engine = runs_on(engine) if restarts * len(choices) > 1 else engine
    kept = None if isinstance(engine, Tasks) else checkpoints
    task = MotionTask.of(problem, learner, criterion, engine).keeping(kept)
    starts = planned(task.bound, range(seed, seed + restarts), choices)
    chosen = Choice(validation, blocks, fallback)
    return train(task, starts, structure, solver, chosen, progress, conclude_motion, runner=engine)


def without_learner(problem: MotionProblem) -> MotionProblem:
    """The same problem with no state and no output learned."""
    motion = problem.motion
    states = tuple(replace(state, learned=False) for state in motion.states)
    outputs = tuple(replace(output, learned=False) for output in motion.outputs)
    return replace(problem, motion=replace(motion, states=states, outputs=outputs))
