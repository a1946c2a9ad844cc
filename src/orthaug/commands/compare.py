"""Physics alone and every structure on the same data and seeds: what `orthaug compare` does."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from orthaug import __version__
from orthaug._base.errors import InputError
from orthaug._base.folders import whole_folder
from orthaug.analysis.validation import Verdict, dominance
from orthaug.commands.jobs import Job, Progress, structure_of
from orthaug.commands.outcome import (
    DEFAULT_BLOCKS,
    SCHEMA,
    Fitted,
    cross_validated,
    data_of,
    fit_job,
    is_result,
    judge_fit,
    plain,
    score_part,
)
from orthaug.data.record import same_step
from orthaug.fitting.kinds import STRUCTURES
from orthaug.models import storage
from orthaug.models.model import Model
from orthaug.reports import plots

ALONE = "physics alone"


@dataclass(frozen=True, eq=False)
class Comparison:
    """One entry per way of modelling: the fitted ones, and models that were saved earlier."""

    job: Job
    fitted: dict[str, Fitted]
    verdicts: dict[str, Verdict]
    result: dict[str, Any]


def compared() -> tuple[str, ...]:
    """What is fitted: physics alone, and every structure that is registered."""
    return ALONE, *STRUCTURES


def compare(job: Job, saved: Sequence[Path] = (), progress: Progress | None = None) -> Comparison:
    """Fit every structure as the spec trains, score each on every part, and put saved models beside them.

    A structure that the spec does not allow (a baseline penalty with an initial value of 0) is left out with
    the reason. With a validation part the structure of the lowest one-step error there is marked as chosen.
    """
    models = {str(path): _matching(path, job) for path in saved}
    kinds = (ALONE,) if job.spec.declared_learner() is None else compared()
    fitted, left_out = {}, {}
    for number, kind in enumerate(kinds):
        try:
            structure_of(job.spec, "orthogonal" if kind == ALONE else kind).penalty(
                job.problem.baseline.names, job.problem.baseline.initial, 1.0
            )
        except InputError as error:
            left_out[kind] = str(error)
            continue
        told = _offset(progress, number, job)
        fitted[kind] = fit_job(job, told, kind=kind, alone=kind == ALONE, judged=False)
    verdicts = _verdicts(job, fitted)
    rows = [_row(kind, one, verdicts.get(kind)) for kind, one in fitted.items()]
    rows += [_saved_row(name, model, job) for name, model in models.items()]
    chosen = _chosen(rows) if job.validation else None
    result = {
        "schema": SCHEMA,
        "orthaug": __version__,
        "spec": job.spec.model_dump(mode="json", exclude_unset=True),
        "data": data_of(job),
        "comparison": rows,
        "chosen": chosen,
        "left_out": left_out,
        "warnings": list(job.warnings),
    }
    return Comparison(job, fitted, verdicts, plain(result))


def _verdicts(job: Job, fitted: dict[str, Fitted]) -> dict[str, Verdict]:
    """Whether the learner earns its place in each structure, by blocked cross-validation and the held-out parts."""
    alone = fitted[ALONE].fit
    kinds = [kind for kind, one in fitted.items() if kind != ALONE and one.fit.status.ok]
    if not kinds or not alone.status.ok:
        return {}
    blocks = DEFAULT_BLOCKS if job.spec.validation.blocks is None else job.spec.validation.blocks
    trials = cross_validated(job, blocks, kinds) if blocks else {kind: [] for kind in kinds}
    found = {kind: judge_fit(job, fitted[kind].fit, trials[kind], alone.model) for kind in kinds}
    return {kind: verdict for kind, verdict in found.items() if verdict is not None}


def write(found: Comparison, folder: Path) -> None:
    """result.json, models/ and figures/, whole or not at all."""
    with whole_folder(folder, is_result) as partial:
        text = json.dumps(found.result, indent=1, ensure_ascii=False, allow_nan=False)
        (partial / "result.json").write_text(text + "\n", encoding="utf-8")
        for kind, one in found.fitted.items():
            if one.fit.status.ok:
                place = partial / "models" / kind.replace(" ", "-")
                place.mkdir(parents=True)
                storage.write(one.fit.model, place)
        (partial / "figures").mkdir()
        plots.save(plots.comparison_figure(found.result["comparison"]), partial / "figures" / "comparison.png")


def text(found: Comparison) -> str:
    """Two tables: parameters with standard errors, and scores on every part."""
    rows = found.result["comparison"]
    names = [parameter["name"] for parameter in rows[0]["parameters"]]
    first = [["structure", *names, "‖QᵀF̃‖/‖F‖", "‖F̃‖/‖Φθ̂‖", "weights", "time [s]"]]
    for row in rows:
        defect = row["orthogonality_defect"]
        first.append(
            [
                row["name"] + (" *" if row["name"] == found.result["chosen"] else ""),
                *(_value(parameter) for parameter in row["parameters"]),
                "–" if defect is None else f"{defect:.1e}",
                "–" if row["learner_to_physics"] is None else f"{row['learner_to_physics']:.2g}",
                str(row["weights"]),
                "–" if row["seconds"] is None else f"{row['seconds']:.2f}",
            ]
        )
    second = [["structure", "part", "one-step NRMSE", "free-run NRMSE", "free-run FIT %"]]
    for row in rows:
        for part, scores in row["scores"].items():
            cells = (scores["prediction"]["nrmse"], scores["simulation"]["nrmse"], scores["simulation"]["fit"])
            second.append([row["name"], part, *(_numbers(cell) for cell in cells)])
    lines = [*_table(first), "", *_table(second)]
    if found.result["chosen"]:
        lines += ["", "* lowest one-step error on the validation part"]
    told = [f"{row['name']}: {row['residuals']['text']}" for row in rows if row["residuals"] is not None]
    lines += ["", *told] if told else []
    told = [f"{kind}: {verdict.summary}" for kind, verdict in found.verdicts.items()]
    beyond = dict.fromkeys(f"{e}." for verdict in found.verdicts.values() for e in verdict.extrapolation)
    lines += ["", *told, *beyond] if told else []
    lines.append("")
    lines += [f"left out: {kind}: {why}" for kind, why in found.result["left_out"].items()]
    common = found.result["warnings"]
    lines += [f"warning: {text}" for text in common]
    lines += [f"warning: {row['name']}: {text}" for row in rows for text in row["warnings"] if text not in common]
    return "\n".join(lines).rstrip()


def _matching(path: Path, job: Job) -> Model:
    model = storage.load(path)
    record = job.problem.record
    lacking = [c.name for c in model.inputs if c.name not in [own.name for own in record.inputs]]
    if lacking:
        found = ", ".join(c.name for c in record.inputs) or "none"
        raise InputError(f"{path}: uses the input {', '.join(lacking)}; the spec has {found}.")
    if not same_step(model.sampling_time, record.sampling_time):
        raise InputError(
            f"{path}: sampled every {model.sampling_time:g} s, the spec's data every {record.sampling_time:g} s."
        )
    wanted = [c.name for c in record.outputs]
    if [c.name for c in model.outputs] != wanted:
        raise InputError(
            f"{path}: its outputs are {', '.join(c.name for c in model.outputs)}; expected {', '.join(wanted)}."
        )
    return model


def _offset(progress: Progress | None, number: int, job: Job) -> Progress | None:
    if progress is None:
        return None
    runs = job.run_count
    return lambda run, iteration, loss: progress(number * runs + run, iteration, loss)


def _row(kind: str, one: Fitted, verdict: Verdict | None) -> dict[str, Any]:
    keys = ("parameters", "orthogonality_defect", "scores", "residuals", "warnings")
    status = one.result["status"]
    weights = one.fit.model.form.bound.size if one.fit.model.form.bound else 0
    kept = {key: one.result[key] for key in keys}
    return {"name": kind, "status": status["code"], "seconds": status["seconds"], "weights": weights, **kept} | {
        "learner_to_physics": dominance(one.fit) if one.fit.status.ok else None,
        "validation": None if verdict is None else verdict.as_dict(),
    }


def _saved_row(name: str, model: Model, job: Job) -> dict[str, Any]:
    warnings: list[str] = []
    return {
        "name": name,
        "status": "saved",
        "seconds": None,
        "weights": model.form.bound.size if model.form.bound else 0,
        "parameters": [
            {"name": p.name, "unit": p.unit, "initial": p.initial, "value": float(value), "std": None, "ci95": None}
            for p, value in zip(model.form.baseline.parameters, model.theta, strict=True)
        ],
        "orthogonality_defect": None,
        "learner_to_physics": None,
        "residuals": None,
        "validation": None,
        "scores": {part.name: score_part(model, part, warnings)[0] for part in job.parts},
        "warnings": warnings,
    }


def _chosen(rows: list[dict[str, Any]]) -> str | None:
    errors = {}
    for row in rows:
        nrmse = row["scores"].get("validation", {}).get("prediction", {}).get("nrmse")
        if nrmse is not None and None not in nrmse:
            errors[row["name"]] = float(np.mean(np.square(nrmse)))
    return min(errors, key=errors.__getitem__) if errors else None


def _value(parameter: dict[str, Any]) -> str:
    if parameter["value"] is None:
        return "–"
    spread = f" ± {parameter['std']:.2g}" if parameter["std"] is not None else ""
    return f"{parameter['value']:.6g}{spread}"


def _numbers(cell: list[float | None] | None) -> str:
    return "–" if cell is None else ", ".join("–" if v is None else f"{v:.4g}" for v in cell)


def _table(rows: list[list[str]]) -> list[str]:
    """Rows of cells as lines; rows of other models may have other parameters."""
    width = max(len(row) for row in rows)
    rows = [row + [""] * (width - len(row)) for row in rows]
    widths = [max(len(row[i]) for row in rows) for i in range(width)]
    return ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
