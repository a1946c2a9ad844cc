"""A process that answers questions of the page: columns of a file, a first spec, a check.

A question is a line of JSON on standard input, its answer one on standard output: `refused` where
there is none, and `last` where the process ends with it.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.errors import InputError
from orthaug.commands import init as starting
from orthaug.commands.app.spec_text import with_value
from orthaug.commands.job import PHYSICS_ONLY, Job, Variant
from orthaug.commands.job_result import check as check_job
from orthaug.commands.opening import open_job
from orthaug.data.channels import Channel
from orthaug.data.columns import Column
from orthaug.data.record import check_step
from orthaug.data.survey import Survey

if TYPE_CHECKING:
    from orthaug.models.response import Response

MOST = 3000
"""Points of a curve that are drawn."""
_KEPT = 600e6  # bytes that a process may have held to go on
_PARTS, _STRETCH = 4, 300  # parts of the data, and rows of each, whose free runs are drawn
_SEGMENTS, _START_ROWS, _START_ITERATIONS = (10, 80), 600, 40  # of start values
_DRAWN = 12  # columns of a file whose curves are


def main() -> None:
    """Answer questions until the standard input ends.

    Also end after a question that took much memory, which the process would keep.
    """
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints is no answer
    asked: queue.Queue[str] = queue.Queue()
    threading.Thread(target=_listen, args=(asked,), daemon=True).start()
    while True:
        answer = _answer(json.loads(asked.get()))
        answer["last"] = peak() > _KEPT
        answers.write(json.dumps(answer) + "\n")
        answers.flush()
        if answer["last"]:
            return


def _listen(asked: queue.Queue[str]) -> None:
    """Read questions, also while one is answered; end the process where there are no more."""
    for line in sys.stdin:
        asked.put(line)
    os._exit(0)


def _answer(given: dict[str, Any]) -> dict[str, object]:
    try:
        return QUESTIONS[given.pop("question")](**given)
    except InputError as error:
        return {"refused": str(error)}
    except MemoryError:
        return {
            "refused": "there is not enough memory to look at these data; take fewer rows, or "
            "every n-th."
        }
    except OSError as error:
        return {
            "refused": f"{error.filename or 'a file'}: cannot be read ({error.strerror or error})."
        }
    except Exception as error:  # a page shows no traceback
        return {
            "refused": f"this could not be computed: {type(error).__name__}: "
            f"{' '.join(str(error).split())[:300]}"
        }


def peak() -> float:
    """Return the peak memory of this process in bytes; 0 where the system does not report it."""
    try:
        import resource
    except ImportError:
        return 0.0
    unit = 1 if sys.platform == "darwin" else 1024
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * unit


def look(
    path: str, out: str, inputs: str | None, outputs: str | None, step: float | None
) -> dict[str, object]:
    """Return the columns of a file, their curves, and a first spec where its channels are known.

    Args:
        out: the path that the spec will have.
        inputs: columns of the inputs, separated by commas; None for those that the names show.
        outputs: the same of the outputs.
        step: sampling time in s where the user gave it.
    """
    found = starting.look(Path(path))
    answer: dict[str, object] = {
        "columns": [_column(found, column) for column in found.columns],
        "rows": max(column.filled for column in found.columns),
        "timed": _time_text(found),
        "step": found.clock.step,
        "spec": None,
        "account": "",
        "open": "",
        "guess": "",
    }
    try:
        given = None if step is None else check_step(step)
        roles = starting.assign(found, inputs, outputs, given)
        if roles is not None:
            answer |= {
                "inputs": [c.header for c in roles.inputs],
                "outputs": [c.header for c in roles.outputs],
                "guess": roles.reason,  # which a person is to confirm before there is a spec
            }
        if roles is not None and not roles.reason:
            draft = starting.draft(found, roles, Path(out))
            answer |= {"spec": draft.spec, "account": draft.account}
    except InputError as error:
        answer["open"] = str(error).removeprefix(f"{path}: ")
    return answer | {"curves": _curves(found)}


def _time_text(found: Survey) -> str:
    """Return a sentence on the column that gives the time; empty where none does."""
    clock = found.clock
    if clock.column is None or clock.step is None:
        return ""
    if not clock.instants:
        return f"{clock.column.header} gives the sampling time, {clock.step:g} s."
    return (
        f"{clock.column.header} gives the instants, "
        f"{'every' if clock.even else 'mostly every'} {clock.step:g} s."
    )


def _column(found: Survey, column: Column) -> dict[str, Any]:
    usable = column in found.signals
    described = (
        starting.as_seen(column, spikes=column.kind != "input") if usable else found.why_not(column)
    )
    head = column.name + (f" = column '{column.header}'" if column.header != column.name else "")
    own = {
        "header": column.header,
        "kind": column.proposed,
        "usable": usable,
        "timed": column is found.clock.column,
    }
    return own | {"description": described.removeprefix(f"{head}: ")}


def _curves(found: Survey) -> dict[str, object]:
    step = found.clock.step or 1.0
    curves = {}
    for column in found.signals[:_DRAWN]:
        values = column.values[: column.filled]
        time = found.clock.seconds[: len(values)] if found.clock.seconds is not None else None
        untimed = time is None or len(time) < len(values) or not np.isfinite(time).all()
        if untimed:
            time = step * np.arange(len(values))
        assert time is not None
        untimed = untimed and found.clock.step is None
        curves[column.header] = {**thin_curve(time, values), "untimed": untimed}
    return curves


def examine(path: str, whole: bool) -> dict[str, object]:
    """Return the findings of `orthaug check` for a spec, and its prepared training data.

    Args:
        whole: run equations of motion too; without, `check` is None for them, since that takes its
            time.
    """
    job = open_job(Path(path), require_full_rank=False)
    runs = job.physics.runs_in_check
    answer: dict[str, object] = {"check": None, "refusal": None, "bias": []}
    if whole or not runs:
        if runs:
            from orthaug._base.jax import keep_programs

            keep_programs()
        result = check_job(job)
        refused = job.physics.refusal(job, result)
        bias = [
            {"name": one.name, "removed_by": one.removed_by, "percent": one.percent}
            for one in result.bias or ()
        ]
        answer = {"check": json.loads(result.to_json()), "bias": bias}
        answer["refusal"] = None if refused is None else str(refused)
    return answer | {
        "rows": {part.name: len(part.record) for part in job.parts},
        "files": [os.path.abspath(job.path.parent / entry.file) for entry in job.train.files],
        "step": job.train.record.sampling_time,
        "units": _units(job),
        "prepared": [done.text for done in job.train.record.prepared],
        "curves": _prepared_curves(job),
    }


def example(folder: str) -> dict[str, object]:
    """Write the records of the built-in example into a folder; return its spec."""
    from orthaug.commands import demo
    from orthaug.studies.synthetic import mass_spring_damper

    demo.write_records(mass_spring_damper(), Path(folder))
    return {"spec": demo.SPEC}


def verdict(path: str, kind: str) -> dict[str, Any]:
    """Return the verdict that the report of a result begins with: `level`, and three `sentences`.

    Args:
        kind: fit or compare, of which `path` is the result.json.
    """
    from orthaug.reports.page_verdict import compare_verdict, fit_verdict
    from orthaug.reports.result import CompareResult, FitResult

    text = Path(path).read_text(encoding="utf-8")
    if kind == "fit":
        found = fit_verdict(FitResult.from_json(text))
    else:
        found = compare_verdict(CompareResult.from_json(text))
    return {"level": found.level, "sentences": found.sentences}


def starts(path: str) -> dict[str, object]:
    """Return initial values for the parameters of a motion, by name.

    The physics alone is fitted to the first rows in segments that lengthen: short ones find
    parameters that are far from where they begin.
    """
    from orthaug._base.jax import keep_programs
    from orthaug.fitting.criteria import Simulation

    keep_programs()
    place = Path(path)
    spec = with_value(place.read_text("utf-8"), ("training", "iterations"), _START_ITERATIONS)
    values: dict[str, float] = {}
    for segment in _SEGMENTS:
        place.write_text(spec, encoding="utf-8")
        job = open_job(place, require_full_rank=False)
        longest = max(job.train.record.experiments, key=len)
        record = replace(job.train.record, experiments=(longest,)).rows(0, _START_ROWS)
        fit = replace(job, problem=job.problem.on(record)).run(
            Variant(PHYSICS_ONLY, criterion=Simulation(min(segment, len(record) - 1), 0))
        )
        for name, value in zip(fit.problem.names, fit.values, strict=True):
            if np.isfinite(value):
                values[name] = float(f"{value:.6g}")
                path_of = ("motion", "parameters", name, "initial")
                spec = with_value(spec, path_of, values[name])
    return {"values": values}


def free_runs(path: str, models: dict[str, str]) -> dict[str, object]:
    """Return measured outputs and the free runs of saved models, by part and output of a spec.

    Of each part it is the stretch on which the first model errs most.
    """
    from orthaug.models.storage import load

    job, loaded = open_job(Path(path), require_full_rank=False), []
    for name, folder in models.items():
        loaded.append((name, load(Path(folder))))
    rows = []
    for part in job.parts[:_PARTS]:
        ran = {name: model.simulate(part.record) for name, model in loaded}
        rows += _stretch(part.name, ran)
    return {"rows": rows}


def _stretch(part: str, ran: Mapping[str, Response]) -> list[dict[str, object]]:
    """Return for each output the curves of the worst stretch of one experiment."""
    from orthaug.reports.page_runs import worst_window

    first = next(iter(ran.values()))
    errors = [np.square(np.nan_to_num(t.errors)).sum() for t in first.trajectories]
    worst = int(np.argmax(np.nan_to_num(errors)))
    measured, model = first.trajectories[worst].measured, first.trajectories[worst].model
    assert measured is not None
    begin = worst_window(measured, model, _STRETCH) if len(model) > _STRETCH else 0
    own = slice(begin, begin + _STRETCH)
    time = first.trajectories[worst].time(first.sampling_time)[own]
    known = {"measured": measured}
    known |= {name: response.trajectories[worst].model for name, response in ran.items()}
    return [
        {
            "label": channel.label,
            "part": part,
            "curves": [
                {"name": name, "x": _plain(time), "y": _plain(values[own, j])}
                for name, values in known.items()
            ],
        }
        for j, channel in enumerate(first.outputs)
    ]


def _units(job: Job) -> list[tuple[str, str, str | None]]:
    """Return for each parameter its name, the unit in the spec and the one its regressor implies.

    The last is None where the regressor implies none.
    """
    derived = job.problem.derived_units
    return [(name, unit, derived.get(name)) for name, unit in job.physics.declared_units.items()]


def _prepared_curves(job: Job) -> dict[str, object]:
    """Return the curves by channel of the training data, with gaps between experiments."""
    record = job.train.record
    channels: Sequence[Channel] = (*record.inputs, *record.outputs)
    curves = {}
    for j, channel in enumerate(channels):
        x: list[float | None] = []
        y: list[float | None] = []
        for e in record.experiments:
            values = np.hstack([e.inputs, e.outputs])[:, j]
            share = max(8, MOST * len(e) // max(len(record), 1))
            curve = thin_curve(e.instants(record.sampling_time), values, share)
            x, y = [*x, *curve["x"], None], [*y, *curve["y"], None]
        curves[channel.name] = {
            "x": x[:-1],
            "y": y[:-1],
            "unit": channel.unit,
            "column": channel.file_column,
        }
    return curves


def thin_curve(time: Vector, values: Vector, most: int = MOST) -> dict[str, list[float | None]]:
    """Return a curve of at most about `most` points: minimum and maximum of each stretch, in order.

    Examples:
        >>> thin_curve(np.arange(6.0), np.array([0.0, 5.0, 1.0, 2.0, -1.0, 0.0]), 4)
        {'x': [0.0, 1.0, 3.0, 4.0], 'y': [0.0, 5.0, 2.0, -1.0]}
    """
    if len(values) > most:
        edges = np.linspace(0, len(values), most // 2 + 1).astype(int)
        there = np.where(np.isfinite(values), values, np.nan)
        kept = []
        for a, b in zip(edges[:-1], edges[1:], strict=True):
            piece = there[a:b]
            known = np.isfinite(piece).any()
            kept += (
                sorted({a + int(np.nanargmin(piece)), a + int(np.nanargmax(piece))})
                if known
                else [a]
            )
        time, values = time[kept], values[kept]
    return {"x": _plain(time), "y": _plain(values)}


def _plain(values: Vector) -> list[float | None]:
    return [float(f"{v:.7g}") if np.isfinite(v) else None for v in values]


QUESTIONS: dict[str, Callable[..., dict[str, object]]] = {
    "look": look,
    "examine": examine,
    "example": example,
    "free_runs": free_runs,
    "starts": starts,
    "verdict": verdict,
}

if __name__ == "__main__":
    main()
