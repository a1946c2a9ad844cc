"""An experiment for a spec: what `orthaug design` does."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from orthaug._base.checks import check_choice
from orthaug._base.errors import InputError
from orthaug._base.folders import whole_file
from orthaug.analysis.design import MOST_SAMPLES
from orthaug.analysis.input_search import Design
from orthaug.commands.job import Job


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
        return job.physics.design(job, asked, section.noise)
    except InputError as error:
        raise InputError(f"{job.path}: design: {error}") from None


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
    """Return notes on the inputs that are not designed, and on noise that nobody gave."""
    assert job.spec.design is not None
    others = [c.name for c in job.problem.record.inputs if c.name != job.spec.design.input]
    found = []
    if others and job.spec.design.input:
        found.append(f"note: {', '.join(others)}: as recorded in the training data.")
    if job.spec.design.noise is None and job.spec.declared_learner() is not None:
        found.append(
            "note: std is for noise as large as what physics alone leaves of the training data. "
            "What the learner takes up of that is no noise: give `noise` in [design]."
        )
    return found


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
