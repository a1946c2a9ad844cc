"""An experiment for a spec: what `orthaug design` does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.checks import check_choice
from orthaug._base.errors import InputError
from orthaug._base.folders import whole_file
from orthaug.analysis.design import MOST_SAMPLES, design_input, design_motion_input
from orthaug.analysis.input_search import Design
from orthaug.commands.job import Job
from orthaug.commands.motion_job import MotionJob
from orthaug.commands.suspects import declare_suspects


def design_for(job: Job) -> Design:
    """Return the input that the spec's `[design]` asks for.

    θ is the spec's initial value, or least squares on the training data where none is given; the
    noise, where the spec states none, is what physics alone leaves of these data. The parameters of
    a motion are those of physics alone. Inputs beside the one that is designed are as they were
    recorded.

    Raises:
        InputError: no `[design]` section, limits that cannot be met, suspects without a
            coefficient.
    """
    section = job.spec.design
    if section is None:
        raise InputError(
            f"{job.path}: the section [design] is missing; it needs `samples` and limits, such "
            "as `amplitude`."
        )
    limits = ("samples", "amplitude", "minimum", "maximum", "rate", "condition", "seed")
    asked = {name: getattr(section, name) for name in limits}
    try:
        asked["channel"] = _input(
            section.input, [channel.name for channel in job.problem.record.inputs]
        )
        asked["known_inputs"] = _other_inputs(job, asked["channel"], section.samples)
        asked["sampling_time"] = job.problem.record.sampling_time
        if isinstance(job, MotionJob):
            return _of_motion(job, asked, section.noise)
        return _of_lags(job, asked, section.noise)
    except InputError as error:
        raise InputError(f"{job.path}: design: {error}") from None


def _of_lags(job: Job, asked: dict[str, Any], noise: float | None) -> Design:
    problem = job.problem
    theta = problem.projection.solve(problem.whitened_target)
    residual = problem.weight.outputs(problem.whitened_target - problem.projection.phi @ theta)
    given = problem.baseline.initial
    return design_input(
        problem.baseline,
        outputs=problem.outputs,
        inputs=[channel.name for channel in problem.record.inputs],
        suspects=declare_suspects(job.spec.suspects, problem),
        noise=tuple(residual.std(axis=0)) if noise is None else noise,
        theta=given if np.all(given) else theta,
        **asked,
    )


def _of_motion(job: MotionJob, asked: dict[str, Any], noise: float | None) -> Design:
    from orthaug.fitting.motion_estimation import without_learner
    from orthaug.fitting.motion_task import MotionTask

    spec, motion = job.spec, job.problem.motion
    task = MotionTask.of(without_learner(job.problem), None, spec.declared_criterion())
    solver: Any = spec.declared_solver()
    task = task.prepare(solver, job.structure)
    if task.physics is None:
        raise InputError(
            "physics alone has no finite free run from its initial values; give others."
        )
    left: Any = noise
    if noise is None:
        left = tuple(
            np.sqrt(
                np.sum(task.physics.end.point.errors**2, axis=(0, 1, 3)) / task.plan.segments.count
            )
        )
    p = motion.coordinates.physical(task.physics.end.point.theta)
    own = {"parameters": p, "noise": left, "substeps": task.plan.dynamics.substeps}
    return design_motion_input(motion, suspects=job.suspects, **own, **asked)


def _input(name: str | None, known: list[str]) -> str:
    if name is None and len(known) != 1:
        raise InputError(f"`input` is missing: the one to design, of {', '.join(known) or 'none'}.")
    return known[0] if name is None else check_choice(name, known, "`input`")


def _other_inputs(job: Job, chosen: str, samples: int) -> dict[str, np.ndarray]:
    """Return the other inputs, as in the longest experiment of the training data.

    They are repeated where that ends.
    """
    record = job.problem.record
    longest = max(record.experiments, key=len).inputs
    named = zip((channel.name for channel in record.inputs), longest.T, strict=True)
    return {
        name: np.resize(values, min(samples, MOST_SAMPLES))
        for name, values in named
        if name != chosen
    }


def notes(job: Job) -> list[str]:
    """Return notes on the inputs that are not designed."""
    assert job.spec.design is not None
    others = [c.name for c in job.problem.record.inputs if c.name != job.spec.design.input]
    return (
        [f"note: {', '.join(others)}: as recorded in the training data."]
        if others and job.spec.design.input
        else []
    )


def write(job: Job, design: Design, out: Path, *, force: bool = False) -> None:
    """Write the signal as CSV, `time` and every input, whole or not at all."""
    assert job.spec.design is not None
    names = [channel.name for channel in job.problem.record.inputs]
    chosen, count = job.spec.design.input or names[0], len(design.signal)
    others = _other_inputs(job, chosen, count) | {chosen: design.signal}
    columns = {"time": np.arange(count) * job.problem.record.sampling_time} | {
        name: others[name] for name in names
    }
    table = np.column_stack(list(columns.values()))
    with whole_file(out, force=force) as partial:
        np.savetxt(
            partial, table, fmt="%.17g", delimiter=",", header=",".join(columns), comments=""
        )
