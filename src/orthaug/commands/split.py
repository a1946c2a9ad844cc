"""Parameters of a saved model under another measure: what `orthaug split` does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug._base.warning import Warning
from orthaug.commands.run import ModelOnData, Reading, record_for
from orthaug.data.record import Record
from orthaug.data.tables import check_readable
from orthaug.inference.measures import Measure, Support
from orthaug.models.model import Model
from orthaug.models.motion_model import MotionModel
from orthaug.reports.result import SplitResult, parameter_rows


def open_training(model: Path, data: Sequence[Path], rows: tuple[int, int] | None) -> ModelOnData:
    """A model with the files that it was trained on, `rows` of each."""
    from orthaug.models.storage import load

    for path in data:
        check_readable(path)
    loaded = load(model)
    reading = Reading("skip", rows, prepare=True)  # of rows with missing cells none were trained on
    records = [record_for(loaded, path, loaded.outputs, reading) for path in data]
    return ModelOnData(loaded, Record.join(records), data[0])


def split_model(opened: ModelOnData, measure: Measure) -> SplitResult:
    """The parameters of a saved model under a measure.

    Raises:
        InputError: a θ at a bound, a measure that does not fit the model, other data than those of its training.
    """
    return _SPLITS[type(opened.model)](opened.model, opened.record, measure)


def _split_lagged(model: Model, record: Record, measure: Measure) -> SplitResult:
    from orthaug.inference.covariance import interval
    from orthaug.inference.splitting import split_under

    parameters = model.form.baseline.parameters
    stands = [p.name for p, value in zip(parameters, model.theta, strict=True) if value in (p.min, p.max)]
    if stands:
        raise InputError(f"{', '.join(stands)} stands at a bound, which a split would leave; fit without the bound.")
    support = Support(model.fitting(record, need_outputs=True), model.form.layout, model.form.used)
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


def _split_motion(model: MotionModel, record: Record, measure: Measure) -> SplitResult:
    from orthaug.fitting.motion_estimation import reopened

    fit = reopened(model, record).split(measure)
    split, (parameters, values) = fit.split_by, fit.model.estimated
    unknown = Warning("no_statistics", "no standard errors: training left no statistics.")
    lacking = fit.std is None and split.slope is not None
    return SplitResult.model_validate(
        {
            "parameters": parameter_rows(parameters, values, fit.std, fit.interval),
            "theta_aux": np.asarray(fit.model.numbers.theta_aux),
            "measure": split.name,
            "measure_detail": {
                "name": split.name,
                "points": len(split.field.x),
                "support": split.support,
                "condition": None,
                "price": None,
            },
            "orthogonality_defect": split.defect,
            "warnings": [*fit.warnings, *([unknown] if lacking else [])],
        }
    )


_SPLITS: dict[type, Callable[[Any, Record, Measure], SplitResult]] = {Model: _split_lagged, MotionModel: _split_motion}
