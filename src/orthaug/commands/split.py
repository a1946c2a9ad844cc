"""θ of a saved model under another measure: what `orthaug split` does."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from orthaug._base.errors import InputError
from orthaug._base.warning import Warning
from orthaug.commands.run import ModelOnData
from orthaug.data.readers import read_record
from orthaug.data.record import Record
from orthaug.data.tables import check_readable
from orthaug.inference.measures import Measure, Support
from orthaug.reports.result import SplitResult, parameter_rows


def open_training(model: Path, data: Sequence[Path], rows: tuple[int, int] | None) -> ModelOnData:
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
    return ModelOnData(loaded, Record.join(records), data[0])


def read_rows(text: str | None) -> tuple[int, int] | None:
    """`A:B` as a half-open range of rows."""
    if text is None:
        return None
    start, _, stop = text.partition(":")
    if not (start.isdecimal() and stop.isdecimal() and text.isascii()):
        raise InputError(f"--rows: found '{text}'; expected a half-open range of rows such as 0:1000.")
    return int(start), int(stop)


def split_model(opened: ModelOnData, measure: Measure) -> SplitResult:
    """θ of a saved model under a measure.

    Raises:
        InputError: a θ that stands at a bound, a measure that does not fit the model.
    """
    from orthaug.inference.covariance import interval
    from orthaug.inference.splitting import split_under

    model = opened.model
    parameters = model.form.baseline.parameters
    stands = [p.name for p, value in zip(parameters, model.theta, strict=True) if value in (p.min, p.max)]
    if stands:
        raise InputError(f"{', '.join(stands)} stands at a bound, which a split would leave; fit without the bound.")
    support = Support(opened.model.fitting(opened.record, need_outputs=True), model.form.layout, model.form.used)
    under = split_under(measure, model, support, model.statistics.joint(len(model.theta)))
    std = None if under.covariance is None else np.sqrt(np.diag(under.covariance))
    ci = None if std is None else interval(under.theta, std, model.statistics.freedom)
    unknown = Warning("no_statistics", "no standard errors: training left no statistics.")
    return SplitResult.model_validate(
        {
            "parameters": parameter_rows(parameters, under.theta, std, ci),
            "theta_aux": under.theta_aux,
            "measure": measure.name,
            "measure_detail": under,
            "orthogonality_defect": under.defect,
            "warnings": [*under.warnings, *([] if std is not None else [unknown])],
        }
    )
