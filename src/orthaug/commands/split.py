"""Parameters of a saved model under another measure: `orthaug split`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, get_origin

import numpy as np

from orthaug._base.checks import check_choice
from orthaug._base.errors import InputError, KeyedError, Warning
from orthaug._base.folders import file_digest
from orthaug._base.registry import Key, keys_of, resolve
from orthaug.analysis.fit_findings import parameter_rows
from orthaug.commands.folder import results_beside
from orthaug.commands.run import (
    ModelOnData,
    ReadOptions,
    missing_notes,
    prepared_notes,
    record_for,
    rows_taken,
    trained_reading,
)
from orthaug.data.record import Record
from orthaug.data.tables import check_readable
from orthaug.fitting.estimates import STD_KINDS, WITHHELD
from orthaug.inference.kinds import MEASURES, MeasurePlace
from orthaug.inference.measures import Measure, Support
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.model import Model
from orthaug.models.moving import MotionDynamics
from orthaug.reports.result import SplitResult

_UNKNOWN = Warning("no_statistics", "no standard errors: training left no statistics.")


def open_training(model: Path, data: Sequence[Path], rows: tuple[int, int] | None) -> ModelOnData:
    """Return a model with the files that it was trained on, `rows` of each.

    None for those that its result names.
    """
    from orthaug.models.storage import load

    for path in data:
        check_readable(path)
    loaded, warnings = load(model), _other_files(model, data)
    trained = [trained_reading(model, path) for path in data]
    read, notes = [], []
    for path, own in zip(data, trained, strict=True):
        # Of rows with missing cells none were trained on
        reading = own or ReadOptions("auto", prepare=True)
        taken = rows_taken(reading)
        if rows is None:
            notes += [f"note: {path.name}: {taken}, those of the training."] if taken else []
        elif own and own.rows != [list(rows)]:
            text = (
                f"the model was trained on {taken or 'all rows'} of {path.name}, not on rows "
                f"{rows[0]}:{rows[1]}."
            )
            warnings.append(Warning("other_training_data", text))
        reading = replace(reading, rows=rows or reading.rows)
        read.append(record_for(loaded, path, loaded.outputs, reading))
        notes += missing_notes(loaded, path, read[-1])
    record, (doubts, withheld) = Record.join(read), _standard_errors(model)
    notes = [*prepared_notes(loaded, record), *notes]
    found = (*warnings, *doubts)
    return ModelOnData(loaded, record, data[0], 0, tuple(notes), found, withheld)


def _standard_errors(model: Path) -> tuple[list[Warning], bool]:
    """Return what the model's result says of its standard errors, and whether it withheld them.

    A split has the statistics of white errors of constant variance only.
    """
    for content in results_beside(model):
        with suppress(KeyError, TypeError, AttributeError):
            kind, rows = content.get("standard_errors_by"), content["parameters"]
            if kind is None or kind not in STD_KINDS:
                return [], False
            if kind in WITHHELD:
                text = (
                    "no standard errors: the fit gave none, because "
                    f"{STD_KINDS[kind].partition(': ')[2]}."
                )
                return [Warning("no_statistics", text)], True
            known = [row for row in rows if row.get("std") and row.get("plain_std")]
            ratios = [row["std"] / row["plain_std"] for row in known]
            least = f"{min(ratios):.2g} to {max(ratios):.2g} times as large: " if ratios else ""
            text = (
                "these standard errors are for white errors of constant variance. Those of the "
                f"fit are {least}{STD_KINDS[kind]}. The intervals here do not count that."
            )
            return [Warning("plain_standard_errors", text)], False
    return [], False


def _other_files(model: Path, data: Sequence[Path]) -> list[Warning]:
    """Return a warning where the checksums of the files differ from those in the model's result."""
    for content in results_beside(model):
        with suppress(KeyError, TypeError):
            kept = {file["sha256"]: file["file"] for file in content["data"]["train"]}
            if kept.keys() == set(map(file_digest, data)):
                return []
            text = (
                f"the model was trained on {', '.join(kept.values())}; the checksums in its "
                f"result.json differ from those of {', '.join(path.name for path in data)}. "
                "Give the files that it was trained on: a split over other data is not one of "
                "this fit."
            )
            return [Warning("other_training_data", text)]
    return []


def read_measure(kind: str, given: Mapping[str, Sequence[str]], opened: ModelOnData) -> Measure:
    """Return the measure of a kind from the values `given` for each option.

    The registry says which kind takes which.

    Raises:
        InputError: an unknown kind, an option of another kind or without what it needs, files that
            do not fit.
    """
    check_choice(kind, MEASURES, "--measure")
    values = {}
    for option, texts in given.items():
        owned = MEASURES.kind_with(option)
        if not texts or owned is None:
            continue
        owner, key = owned
        if owner != kind:
            raise InputError(f"--{option}: belongs to --measure {owner}; found --measure {kind}.")
        values[key.name] = _read(key, option, texts)
    form = opened.model.form
    place = MeasurePlace(Path(), [str(lag) for lag in form.used], opened.record, form.first_row)
    try:
        return resolve(MEASURES.declare(kind, values), place)
    except KeyedError as error:
        key = keys_of(MEASURES[kind]).get(error.key)
        raise InputError(f"--{(key.option if key else None) or error.key}{error.words}.") from None


def _read(key: Key, option: str, texts: Sequence[str]) -> Any:
    """Return the value of a key: for a mapping limits by raw lag, otherwise the texts."""
    if get_origin(key.type) is not Mapping:
        return tuple(texts)
    limits: dict[str, tuple[float, float]] = {}
    for text in texts:
        lag, equals, both = text.partition("=")
        try:
            low, high = (float(limit) for limit in both.split(":"))
        except ValueError:
            equals = ""
        if not equals:
            raise InputError(
                f"--{option}: found '{text}'; expected a raw lag and its limits, such as "
                "'u[k]=-0.6:0.6'."
            )
        if lag.strip() in limits:
            raise InputError(f"--{option}: {lag.strip()} is given twice.")
        limits[lag.strip()] = (low, high)
    return limits


def split_model(opened: ModelOnData, measure: Measure) -> SplitResult:
    """Return the parameters of a saved model under a measure.

    Raises:
        InputError: a θ at a bound, a measure that does not fit the model, other data than those of
            its training.
    """
    found = _SPLITS[type(opened.model.form)](opened.model, opened.record, measure, opened.warnings)
    if not opened.withheld:
        return found
    rows = [
        row.model_copy(update={"std": None, "ci95": None, "plain_std": None})
        for row in found.parameters
    ]
    return found.model_copy(update={"parameters": rows})


def _split_lagged(
    model: Model[LaggedDynamics], record: Record, measure: Measure, warnings: Sequence[Warning]
) -> SplitResult:
    from orthaug.inference.covariance import interval
    from orthaug.inference.splitting import split_by_measure

    parameters = model.form.baseline.parameters
    bounded = [
        p.name for p, value in zip(parameters, model.theta, strict=True) if value in (p.min, p.max)
    ]
    if bounded:
        raise InputError(
            f"{', '.join(bounded)} is at a bound, which a split does not impose; fit without the "
            "bound, or with `fixed = true` there."
        )
    support = Support(model.fitting(record, need_outputs=True), model.form.layout, model.form.used)
    under, joint = (
        split_by_measure(measure, model, support),
        model.statistics.joint(len(parameters)),
    )
    std = None if joint is None or under.slope is None else np.sqrt(np.diag(joint.of(under.slope)))
    ci = None if std is None else interval(under.theta, std, model.statistics.freedom)
    return SplitResult.model_validate(
        {
            "parameters": parameter_rows(parameters, under.theta, std, ci),
            "theta_aux": under.theta_aux,
            "measure": measure.name,
            "measure_detail": under,
            "orthogonality_defect": under.defect,
            "warnings": [*warnings, *under.warnings, *([] if std is not None else [_UNKNOWN])],
        }
    )


def _split_motion(
    model: Model[MotionDynamics], record: Record, measure: Measure, warnings: Sequence[Warning]
) -> SplitResult:
    from orthaug.fitting.conclusion import reopen_estimate

    fit = reopen_estimate(model, record).split(measure)
    split, (parameters, values) = fit.split_by, fit.model.estimated
    lacking = fit.std is None and split.slope is not None
    return SplitResult.model_validate(
        {
            "parameters": parameter_rows(parameters, values, fit.std, fit.interval),
            "theta_aux": np.asarray(fit.model.numbers.theta_aux),
            "measure": split.name,
            "measure_detail": split,
            "orthogonality_defect": split.defect,
            "warnings": [*warnings, *fit.warnings, *([_UNKNOWN] if lacking else [])],
        }
    )


_SPLITS: dict[type, Callable[..., SplitResult]] = {
    LaggedDynamics: _split_lagged,
    MotionDynamics: _split_motion,
}
