"""An experiment for a spec: what `orthaug design` does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.checks import check_choice
from orthaug._base.errors import InputError
from orthaug._base.folders import whole_file
from orthaug.analysis.design import Design, design_input
from orthaug.commands.jobs import Job
from orthaug.commands.suspects import declared


def design(job: Job) -> Design:
    """The input that the spec's `[design]` asks for.

    θ is the spec's initial value, or least squares on the training data where none is given; the noise, where the spec
    states none, is what physics alone leaves of these data.

    Raises:
        InputError: no `[design]` section, limits that cannot be met, suspects without a coefficient.
    """
    section, problem = job.spec.design, job.problem
    if section is None:
        raise InputError(f"{job.path}: the section [design] is missing; it needs `samples` and `amplitude`.")
    theta = problem.projection.solve(problem.whitened_target)
    residual = problem.target - np.einsum("kit,t->ki", problem.projection.phi, theta) / problem.weight
    given = problem.baseline.initial
    try:
        return design_input(
            problem.baseline,
            outputs=problem.outputs,
            inputs=[channel.name for channel in problem.record.inputs],
            sampling_time=problem.record.sampling_time,
            samples=section.samples,
            amplitude=section.amplitude,
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


def write(job: Job, found: Design, out: Path) -> None:
    """The signal as CSV, `time` and every input, whole or not at all."""
    assert job.spec.design is not None
    names = [channel.name for channel in job.problem.record.inputs]
    chosen = job.spec.design.input or names[0]
    time = np.arange(len(found.signal)) * job.problem.record.sampling_time
    columns = {"time": time} | {name: found.signal if name == chosen else 0.0 * found.signal for name in names}
    table = np.column_stack(list(columns.values()))
    with whole_file(out) as partial:
        np.savetxt(partial, table, fmt="%.17g", delimiter=",", header=",".join(columns), comments="")


def text(found: Design, shown: int = 8) -> str:
    """The design and what else was tried."""
    content: dict[str, Any] = found.as_dict()
    lines = [
        f"input       {content['kind']}",
        f"predicted   relative error of θ {found.relative_error:.4g}, condition {found.condition:.3g}",
        "",
        f"{'parameter':<12}  {'bias':>12}  {'std':>12}",
        *(f"{n:<12}  {b:12.4g}  {s:12.4g}" for n, b, s in zip(found.names, found.bias, found.std, strict=True)),
        "",
        "what was tried, relative errors of θ:",
    ]
    rows: list[tuple[str, ...]] = [("signal", "error", "bias", "std", "condition")]
    for one in found.candidates[:shown]:
        rows.append((one.name, *(f"{v:.4g}" for v in (np.sqrt(one.cost), one.bias, one.std, one.condition))))
    widths = [max(len(row[i]) for row in rows) for i in range(5)]
    lines += ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join(lines)
