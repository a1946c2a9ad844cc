"""An experiment for a spec: what `orthaug design` does."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from orthaug._base.checks import check_choice
from orthaug._base.errors import InputError
from orthaug._base.folders import whole_file
from orthaug.analysis.design import Design, design_input
from orthaug.commands.job import Job
from orthaug.commands.suspects import declared


def design_for(job: Job) -> Design:
    """The input that the spec's `[design]` asks for.

    θ is the spec's initial value, or least squares on the training data where none is given; the noise, where the spec
    states none, is what physics alone leaves of these data.

    Raises:
        InputError: no `[design]` section, limits that cannot be met, suspects without a coefficient.
    """
    section, problem = job.spec.design, job.problem
    if job.spec.motion is not None:
        raise InputError(f"{job.path}: experiments are designed on lagged signals; a [motion] has no design.")
    if section is None:
        raise InputError(
            f"{job.path}: the section [design] is missing; it needs `samples` and limits, such as `amplitude`."
        )
    theta = problem.projection.solve(problem.whitened_target)
    residual = problem.weight.outputs(problem.whitened_target - problem.projection.phi @ theta)
    given = problem.baseline.initial
    try:
        return design_input(
            problem.baseline,
            outputs=problem.outputs,
            inputs=[channel.name for channel in problem.record.inputs],
            sampling_time=problem.record.sampling_time,
            samples=section.samples,
            amplitude=section.amplitude,
            minimum=section.minimum,
            maximum=section.maximum,
            rate=section.rate,
            suspects=declared(job.spec.suspects, problem),
            noise=tuple(residual.std(axis=0)) if section.noise is None else section.noise,
            theta=given if np.all(given) else theta,
            condition=section.condition,
            channel=_input(section.input, [channel.name for channel in problem.record.inputs]),
            seed=section.seed,
        )
    except InputError as error:
        raise InputError(f"{job.path}: design: {error}") from None


def _input(name: str | None, known: list[str]) -> str | None:
    return None if name is None else check_choice(name, known, "`input`")


def write(job: Job, design: Design, out: Path, *, force: bool = False) -> None:
    """The signal as CSV, `time` and every input, whole or not at all."""
    assert job.spec.design is not None
    names = [channel.name for channel in job.problem.record.inputs]
    chosen = job.spec.design.input or names[0]
    time = np.arange(len(design.signal)) * job.problem.record.sampling_time
    columns = {"time": time} | {name: design.signal if name == chosen else 0.0 * design.signal for name in names}
    table = np.column_stack(list(columns.values()))
    with whole_file(out, force=force) as partial:
        np.savetxt(partial, table, fmt="%.17g", delimiter=",", header=",".join(columns), comments="")
