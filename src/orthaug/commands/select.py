"""Selection of the structure of a spec: what `orthaug select` does."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomlkit

from orthaug._base.errors import InputError
from orthaug._base.folders import whole_folder
from orthaug.commands.chosen_rows import parts_of, split_rows
from orthaug.commands.data_sections import EngineSection, engine_of
from orthaug.commands.folder import relative, save_json
from orthaug.commands.job import Job
from orthaug.commands.opening import open_spec
from orthaug.commands.spec import LearnerSection, Spec, load_spec
from orthaug.data.regressors import Lags
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.kinds import CRITERIA
from orthaug.models.kinds import LEARNERS
from orthaug.models.learners import MLP, Learner
from orthaug.models.terms import Terms
from orthaug.reports.selection import SelectResult
from orthaug.selection.parts import CONDITIONAL, Parts

if TYPE_CHECKING:
    from orthaug.selection.choice import Selection
    from orthaug.selection.kept_physics import Shift
    from orthaug.selection.selecting import OnStage

_DEGREE = 3  # of the terms to search where a spec has no [learner]


@dataclass(frozen=True, eq=False)
class SelectionReport:
    """A job, its selected structure, and the result that is written."""

    job: Job
    selection: Selection
    result: SelectResult
    spec: str
    """The spec with the selection, for its folder."""


def open_select(path: Path) -> tuple[Job, Spec]:
    """Return the job of a spec's physics alone, and the spec as it was given.

    Raises:
        InputError: a motion, and anything wrong with spec, files or physics.
    """
    spec = load_spec(path)
    if spec.motion is not None:
        raise InputError(
            f"{path}: structure is selected for lagged signals; for a motion declare a learner "
            'of terms (kind = "terms"), or a network, and run `orthaug explain` on it. For lagged '
            "physics leave `learner.states` out."
        )
    if spec.engine.kind not in ("auto", "memory", "dask"):
        raise InputError(
            f"{path}: `engine.kind`: found {spec.engine.kind}; expected memory, or dask, to select."
        )
    parts = {
        "learner": LearnerSection(kind="none"),
        "lags": None,
        "engine": EngineSection(kind="memory"),
    }
    alone = spec.model_copy(update=parts)
    return open_spec(path, alone), spec


def select_for(job: Job, spec: Spec, folder: Path, report_model: OnStage) -> SelectionReport:
    """Select the structure, and write the choice into the spec.

    Args:
        folder: of the new spec; its paths are relative to that.
        report_model: called with the stage and each model that was judged.

    Raises:
        InputError: data or physics that selection does not support.
    """
    from orthaug.selection.selecting import MOST, WIDTHS, lagged_rows, select

    section, began = spec.selection, time.monotonic()
    options: dict[str, Any] = {
        "learner": _learner(spec),
        "lags": _largest_orders(spec),
        "criterion": _criterion(spec),
        "widths": section.hidden or WIDTHS,
        "most": MOST if section.terms is None else section.terms,
        "blocks": section.blocks,
        "collinear": section.collinear,
        "level": section.level,
    }
    halves = None if section.halves == "auto" else section.halves
    network = isinstance(options["learner"], MLP)
    lags = lagged_rows(job.problem, options["lags"])
    parts = parts_of(job, job.problem.baseline, lags, halves, network=network)
    options["engine"] = engine_of(spec.engine, "dask") if spec.engine.kind == "dask" else None
    try:
        selection = select(
            job.train.record, job.problem.baseline, **options, halves=parts, progress=report_model
        )
    except InputError as error:
        raise InputError(f"{job.path}: {error}") from None
    result = _result(job, selection, time.monotonic() - began)
    return SelectionReport(job, selection, result, _new_spec(job, folder, selection, parts))


def steps_at_most(terms: int | None) -> int:
    """Return the largest number of models on the path of terms, forward."""
    from orthaug.selection.selecting import MOST
    from orthaug.selection.term_path import steps

    return steps(MOST if terms is None else terms)


def write_selected(selected: SelectionReport, folder: Path, *, force: bool = False) -> None:
    """Write result.json, spec.toml, table.csv and the figure, whole or not at all."""
    from orthaug.reports.drawing import save
    from orthaug.reports.plots import selection_figure

    with whole_folder(folder, force=force) as partial:
        save_json(selected.result, partial)
        (partial / "spec.toml").write_text(selected.spec, encoding="utf-8")
        selected.selection.table.to_csv(partial / "table.csv", index=False)
        (partial / "figures").mkdir()
        unit = selected.job.train.record.outputs[0].unit
        save(selection_figure(selected.result, unit), partial / "figures" / "selection.png")


def _learner(spec: Spec) -> Learner | None:
    """Return the learner to search: the declared one, or terms where none is declared."""
    if "learner" not in spec.model_fields_set:
        return Terms(degree=_DEGREE)
    declared = spec.learner.declared(LEARNERS, spec.learner.kind)
    return declared.resolve(None) if hasattr(declared, "resolve") else declared


def _largest_orders(spec: Spec) -> Lags | None:
    """Return the largest orders: of [selection], or of [lags]."""
    section, lags = spec.selection, spec.lags
    if section.na is None and section.nb is None and section.nk is None:
        return spec.lag_orders()
    from orthaug.selection.selecting import LARGEST

    first = (section.na, lags.na if lags else None, LARGEST[0])
    second = (section.nb, lags.nb if lags else None, LARGEST[1])
    third = (section.nk, lags.nk if lags else None, 1)
    chosen = [next(n for n in each if n is not None) for each in (first, second, third)]
    return Lags(*(tuple(n) if isinstance(n, list) else n for n in chosen))


def _criterion(spec: Spec) -> Criterion:
    """Return the declared criterion; the free run where the spec has none."""
    focus = "simulation" if spec.training.focus == "auto" else spec.training.focus
    return spec.training.declared_criterion(focus)


def _result(job: Job, selection: Selection, seconds: float) -> SelectResult:
    orders, test, learner = selection.orders.chosen, selection.nonlinearity, selection.learner
    shares, physics, confirmed = selection.shares, selection.physics, selection.confirmed
    rates = {} if selection.terms is None else selection.terms.rates()
    terms = learner.terms if isinstance(learner, Terms) else ()
    content = {
        "data": job.data,
        "orders": {"na": orders.na, "nb": list(orders.nb), "nk": list(orders.nk)},
        "delays": selection.delays,
        "nonlinearity": None
        if test is None
        else {
            "p": test.p,
            "regressors": test.regressors,
            "matter": list(test.matter),
            "text": str(test),
        },
        "learner": _learner_section(learner),
        "focus": CRITERIA.kind_of(selection.criterion),
        "terms": [
            {
                "term": t,
                "chosen": shares.get(t),
                "left": physics and physics.left.get(t),
                "rate": rates.get(t),
                "p": confirmed[t].p if t in confirmed else None,
                "q": confirmed[t].q if t in confirmed else None,
                "rivals": list(selection.rivals.get(t, ())),
            }
            for t in terms
        ]
        or None,
        "intervals": selection.intervals,
        "level": selection.level,
        "physics": physics and [_shift_entry(shift) for shift in physics.shifts],
        "condition": physics and physics.condition,
        "models": selection.table.to_dict("records"),
        "seconds": seconds,
        "stopped": selection.stopped,
        "warnings": list(selection.notes),
    }
    return SelectResult.model_validate(content)


def _shift_entry(shift: Shift) -> dict[str, object]:
    own = {
        "parameter": shift.parameter,
        "unit": shift.unit,
        "left": shift.left,
        "moved": shift.moved,
    }
    values = {
        "before": shift.before,
        "before_std": shift.before_std,
        "after": shift.after,
        "after_std": shift.after_std,
    }
    return own | values


def _learner_section(learner: Learner | None) -> dict[str, object] | None:
    """Return the section [learner] of a choice."""
    if learner is None:
        return None
    if isinstance(learner, Terms):
        return {"kind": "terms", "terms": list(learner.terms)}
    seen = {} if learner.inputs is None else {"inputs": list(learner.inputs)}
    return {"kind": "mlp", "hidden": list(learner.hidden), "activation": learner.activation} | seen  # type: ignore[attr-defined]


def _new_spec(job: Job, folder: Path, selection: Selection, parts: Parts) -> str:
    """Return the spec with the choice in it.

    Comments and order are kept, paths made relative to the new folder.
    """
    path = job.path
    document: Any = tomlkit.parse(path.read_text(encoding="utf-8-sig"))
    _rebase(document, path.parent, folder)
    learner, orders = (
        _learner_section(selection.learner),
        selection.reach or selection.orders.chosen,
    )
    document["lags"] = tomlkit.item({"na": orders.na, "nb": list(orders.nb), "nk": list(orders.nk)})
    document["learner"] = tomlkit.item(learner or {"kind": "none"})
    if learner is not None and "terms" in learner:
        document["learner"]["terms"].multiline(True)
    training = document.setdefault("training", tomlkit.table())
    training["focus"] = CRITERIA.kind_of(selection.criterion)
    if (
        learner is None or learner["kind"] == "terms"
    ):  # linear in its weights: one start, and no prior
        training["regularization"] = "none"
        training["restarts"] = 1
        training["fallback"] = False  # physics alone was judged beside it
    elif training.get("regularization") is None:
        training["regularization"] = "evidence"
    _say_rows(document, job, folder, selection, parts)
    head = f"# Selected by orthaug from {path.name}: {orders}. The other models are in table.csv.\n"
    return head + tomlkit.dumps(document)


def _say_rows(document: Any, job: Job, folder: Path, selection: Selection, parts: Parts) -> None:
    """Write which rows chose the terms, and have the others fitted."""
    section = document.setdefault("selection", tomlkit.table())
    section.pop("chosen_on", None)
    if selection.learner is None or parts.intervals is CONDITIONAL:
        return
    chosen, fitted = (
        {**one.declared, "files": _relative_files(folder, job, one.files)}
        for one in split_rows(job, parts)
    )
    if parts.fitted is not parts.chooses:
        document["data"]["train"].update(fitted)
    table = tomlkit.inline_table()
    table.update(chosen)
    section["chosen_on"] = table
    section["chosen_on"].comment("where `data.train` has rows of these, a fit has no intervals")


def _relative_files(folder: Path, job: Job, files: Sequence[str]) -> list[str]:
    """Return files of the job's spec as seen from another folder."""
    old = job.path.parent
    return [file if Path(file).is_absolute() else relative(old / file, folder) for file in files]


def _rebase(table: Any, old: Path, new: Path) -> None:
    """Rewrite every list `files` relative to another folder."""
    for key, value in table.items():
        if isinstance(value, dict):
            _rebase(value, old, new)
        elif key == "files" and isinstance(value, list):
            table[key] = [
                file if Path(file).is_absolute() else relative(old / file, new) for file in value
            ]
