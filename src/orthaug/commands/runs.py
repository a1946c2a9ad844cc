"""Saved models on data files: what `orthaug simulate` and `orthaug predict` do."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug import __version__
from orthaug._base.errors import InputError
from orthaug._base.folders import whole_file
from orthaug.data.readers import read_record
from orthaug.data.record import Record
from orthaug.data.tables import check_readable, has_column
from orthaug.inference.measures import Measure, Support

if TYPE_CHECKING:
    from orthaug.models.model import Model
    from orthaug.models.response import Response


@dataclass(frozen=True, eq=False)
class Run:
    """A model with the record it is to run on."""

    model: Model
    record: Record
    source: Path


def open_run(model: Path, data: Path, *, need_outputs: bool = False) -> Run:
    """Load a model and read its channels from a file; outputs only where the file has them, unless needed.

    Raises:
        InputError: no model, no file, missing columns.
    """
    check_readable(data)
    from orthaug.models.storage import load

    loaded = load(model)
    held = [c for c in loaded.outputs if has_column(data, c.file_column)]
    if need_outputs or not loaded.inputs or len(held) == len(loaded.outputs):
        held = list(loaded.outputs)
    elif held:
        missing = [c.name for c in loaded.outputs if c not in held]
        raise InputError(f"{data}: has some of the model's outputs but not {', '.join(missing)}; give all or none.")
    step = None if loaded.time_column else loaded.sampling_time
    record = read_record(data, inputs=loaded.inputs, outputs=held, sampling_time=step, time=loaded.time_column)
    return Run(loaded, record, data)


def read_initial(initial: str | None, run: Run) -> str | Any:
    """The `initial` of `Model.simulate`: measured where the data have outputs, zero otherwise, or a CSV's rows."""
    if initial is None:
        return "measured" if run.record.outputs else "zero"
    if initial in ("measured", "zero"):
        if initial == "measured" and not run.record.outputs:
            raise InputError(f"{run.source}: has no measured outputs to start from; use --initial zero or a CSV.")
        return initial
    if not Path(initial).suffix and "/" not in initial:
        raise InputError(f"--initial: found '{initial}'; expected measured, zero, or a CSV file of the first outputs.")
    record = read_record(initial, outputs=run.model.outputs, sampling_time=run.model.sampling_time)
    try:
        run.model.check_initial(record.experiments[0].outputs)
    except InputError as error:
        raise InputError(f"{initial}: {error}") from None
    return record.experiments[0].outputs


def with_initial(run: Run, initial: str | Any) -> Record:
    """The record with the outputs of its first rows replaced, for predictions that start from others."""
    if isinstance(initial, str) and initial == "measured":
        return run.record
    start, experiment = run.model.form.first_row, run.record.experiments[0]
    outputs = experiment.outputs.copy()
    rows = np.zeros((start, outputs.shape[1])) if isinstance(initial, str) else initial[:start]
    outputs[start - len(rows) : start] = rows
    return replace(run.record, experiments=(replace(experiment, outputs=outputs),))


def open_training(model: Path, data: Sequence[Path], rows: tuple[int, int] | None) -> Run:
    """A model with the files that it was trained on, `rows` of each."""
    from orthaug.models.storage import load

    for path in data:
        check_readable(path)
    loaded = load(model)
    step = None if loaded.time_column else loaded.sampling_time
    inputs, outputs, time = loaded.inputs, loaded.outputs, loaded.time_column
    records = [
        read_record(path, inputs=inputs, outputs=outputs, sampling_time=step, time=time, rows=rows) for path in data
    ]
    return Run(loaded, Record.join(records), data[0])


def read_rows(text: str | None) -> tuple[int, int] | None:
    """`A:B` as a half-open range of rows."""
    if text is None:
        return None
    start, _, stop = text.partition(":")
    if not (start.isdecimal() and stop.isdecimal() and text.isascii()):
        raise InputError(f"--rows: found '{text}'; expected a half-open range of rows such as 0:1000.")
    return int(start), int(stop)


def split(run: Run, measure: Measure) -> dict[str, Any]:
    """θ of a saved model under a measure, as JSON content."""
    from orthaug.commands.outcome import SCHEMA, plain
    from orthaug.inference.covariance import interval
    from orthaug.inference.splitting import split_under

    model = run.model
    parameters = model.form.baseline.parameters
    stands = [p.name for p, value in zip(parameters, model.theta, strict=True) if value in (p.min, p.max)]
    if stands:
        raise InputError(f"{', '.join(stands)} stands at a bound, which a split would leave; fit without the bound.")
    support = Support(run.model.fitting(run.record, need_outputs=True), model.form.layout, model.form.used)
    found = split_under(measure, model, support, model.statistics.joint(len(model.theta)))
    std = None if found.covariance is None else np.sqrt(np.diag(found.covariance))
    ci = None if std is None else interval(found.theta, std, model.statistics.freedom)
    parameters = [
        {
            "name": parameter.name,
            "unit": parameter.unit,
            "initial": parameter.initial,
            "value": float(found.theta[i]),
            "std": None if std is None else float(std[i]),
            "ci95": None if ci is None else [float(limit) for limit in ci[i]],
        }
        for i, parameter in enumerate(model.form.baseline.parameters)
    ]
    content = {
        "schema": SCHEMA,
        "orthaug": __version__,
        "parameters": parameters,
        "theta_aux": [float(value) for value in found.theta_aux],
        "measure": measure.name,
        "measure_detail": found.as_dict(),
        "orthogonality_defect": found.defect,
        "warnings": [
            *found.warnings,
            *([] if std is not None else ["no standard errors: training left no statistics."]),
        ],
    }
    return plain(content)


def split_text(found: dict[str, Any]) -> str:
    """The content of `split` for a reader."""
    detail = found["measure_detail"]
    support = f"{100 * detail['support']:.0f} % of it within reach of the data"
    lines = [f"measure     {found['measure']}, {detail['points']} points, {support}"]
    width = max([9, *(len(parameter["name"]) for parameter in found["parameters"])])
    lines.append(f"{'parameter':<{width}}  {'value':>14}  {'std':>11}  {'95 % interval':^29}  unit")
    for parameter in found["parameters"]:
        std, ci = parameter["std"], parameter["ci95"]
        spread = f"{std:11.4g}" if std is not None else f"{'–':>11}"
        reach = f"[{ci[0]:13.7g}, {ci[1]:13.7g}]" if ci is not None else f"{'–':^29}"
        name = f"{parameter['name']:<{width}}"
        lines.append(f"{name}  {parameter['value']:14.8g}  {spread}  {reach}  {parameter['unit']}".rstrip())
    return "\n".join([*lines, *(f"warning: {text}" for text in found["warnings"])])


def warnings(response: Response) -> list[str]:
    """What the reader of a response must know."""
    return [
        f"the free run diverged in output '{t.diverged[1]}' at step {t.diverged[0]}; it has no values from there on."
        for t in response.trajectories
        if t.diverged
    ]


def check_output(out: Path | None, *read: Path) -> None:
    """Raise InputError early where a file could not be written, or is one of those that are read."""
    if out is None:
        return
    try:
        if any(file.exists() and out.exists() and out.samefile(file) for file in read):
            raise InputError(f"{out}: is read by this run; give another name.")
        if out.is_dir() or not out.name:
            raise InputError(f"{out}: is a folder; expected the name of a CSV file.")
        if not out.absolute().parent.is_dir():
            raise InputError(f"{out}: cannot be written; there is no folder {out.parent}.")
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}).") from None


def write_csv(response: Response, out: Path | None) -> None:
    """One row per data row, empty cells where there is no value; to a file (whole or not at all) or standard output."""
    frame = response.to_frame()
    if out is None:
        frame.to_csv(sys.stdout, index=False)
        return
    with whole_file(out) as partial:
        frame.to_csv(partial, index=False)
