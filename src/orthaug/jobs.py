"""What the commands do: a spec in, a result out. Parsing of arguments and printing is the CLI's."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug import __version__
from orthaug.errors import InputError
from orthaug.excitation import Excitation, identifiability
from orthaug.folders import check_replaceable, whole_folder
from orthaug.problem import Problem, check_defined, pose, regressor_of
from orthaug.readers import read_record
from orthaug.record import Record, check_channels, same_step
from orthaug.regressors import largest_lag
from orthaug.spec import Part, Spec, load_spec
from orthaug.structures import Additive, BaselinePenalty, Orthogonal, OrthogonalPenalty, Structure

if TYPE_CHECKING:
    from orthaug.model import Model, Response
    from orthaug.result import Estimate

SCHEMA = 1
Progress = Callable[[int, int, float], None]


@dataclass(frozen=True, eq=False)
class LoadedPart:
    """A part of the data: its record, and how many leading samples of each recording are not scored."""

    name: str
    record: Record
    skip: int
    files: tuple[dict[str, Any], ...]
    gaps: str = ""
    """What was left out around missing samples, in words."""

    def without_short(self, first: int) -> LoadedPart:
        """Without stretches between missing samples that are too short for a row after the first `first`."""
        record = self.record.without_short(first)
        if not record.missing:
            return self
        usable = sum(max(0, len(experiment) - first) for experiment in record.experiments)
        gaps = (
            f"{self.name}: {record.missing} rows have missing cells and are left out with all windows that touch them; "
            f"{usable} usable rows remain, in {len(record.experiments)} stretches."
        )
        return replace(self, record=record, gaps=gaps)

    @property
    def skips(self) -> tuple[int, ...]:
        """How many leading samples of each experiment are not scored."""
        return tuple(max(0, self.skip - experiment.offset) for experiment in self.record.experiments)

    def scored(self, start: int) -> Record:
        """The record without rows that are neither scored nor lags of what is, for a first usable row `start`."""
        kept = tuple(
            e.rows(max(0, skip - start), None) for e, skip in zip(self.record.experiments, self.skips, strict=True)
        )
        return replace(self.record, experiments=kept)


@dataclass(frozen=True, eq=False)
class Job:
    """A spec with its data read and checked: everything before training, without JAX."""

    path: Path
    spec: Spec
    train: LoadedPart
    validation: LoadedPart | None
    tests: tuple[LoadedPart, ...]
    problem: Problem
    warnings: tuple[str, ...]

    @property
    def run_count(self) -> int:
        """How many runs a fit makes: restarts times regularizations."""
        choices = self.spec.training.regularizations(self.validation is not None)
        return self.spec.training.restarts * (len(choices) if isinstance(choices, tuple) else 1)

    @property
    def iterations(self) -> int:
        """Steps of a run at most."""
        training = self.spec.training
        if training.solver == "adam-lbfgs":
            return training.adam_iterations + training.lbfgs_iterations
        free_run = training.focus == "simulation" or training.horizon > 1
        return training.iterations + (training.start_iterations if free_run else 0)

    @property
    def parts(self) -> tuple[LoadedPart, ...]:
        return (self.train, *([self.validation] if self.validation else []), *self.tests)


def open_job(path: Path, *, require_full_rank: bool = True) -> Job:
    """Read the spec and all its data, and pose the problem.

    Raises:
        InputError: anything wrong with spec, files or physics; one line that names it.
    """
    spec = load_spec(path)
    try:
        baseline, learner_inputs = spec.declared_baseline(), spec.learner_inputs()
        check_channels(spec.channels(spec.data.inputs), spec.channels(spec.data.outputs))
        structure_of(spec).penalty(baseline.names, baseline.initial, 1.0)
        baseline.check_channels(spec.data.outputs, spec.data.inputs)
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None
    train = _load(path, spec, spec.data.train, "train")
    validation = _load(path, spec, spec.data.validation, "validation") if spec.data.validation else None
    tests = tuple(_load(path, spec, part, f"tests.{name}") for name, part in spec.data.tests.items())
    lags = spec.lag_orders() if spec.learner.kind != "none" else None
    try:
        layout, _ = regressor_of(baseline, lags, learner_inputs, tuple(spec.data.outputs), tuple(spec.data.inputs))
        train, validation, *tests = (p and p.without_short(largest_lag(layout)) for p in (train, validation, *tests))
        problem = pose(train.record, baseline, lags, learner_inputs, require_full_rank=require_full_rank)
        problem.feature_rows()
        job = Job(path, spec, train, validation, tuple(tests), problem, ())
        for part in job.parts:
            _check_scorable(part, problem.rows.start, train.record.sampling_time)
            check_defined(problem, part.record)
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None
    declared = {"train": spec.data.train, "validation": spec.data.validation}
    declared |= {f"tests.{name}": part for name, part in spec.data.tests.items()}
    warnings = [_thinned(name, part.every) for name, part in declared.items() if part and part.every > 1]
    warnings += [part.gaps for part in job.parts if part.gaps]
    return replace(job, warnings=tuple(warnings))


def _thinned(name: str, every: int) -> str:
    return f"{name}: one row in {every} is kept without a filter; content above the new Nyquist frequency folds back."


def structure_of(spec: Spec, kind: str | None = None) -> Structure:
    """The structure that a spec declares, or another kind with its weight."""
    weight = spec.structure.weight
    known = {
        "additive": Additive(),
        "orthogonal": Orthogonal(),
        "orthogonal-penalty": OrthogonalPenalty(weight),
        "baseline-penalty": BaselinePenalty(weight),
    }
    return known[kind or spec.structure.kind]


def _load(path: Path, spec: Spec, part: Part, name: str) -> LoadedPart:
    """Read a part's files; messages begin with the file that is at fault."""
    unknown = [channel for channel in part.columns if channel not in (*spec.data.inputs, *spec.data.outputs)]
    if unknown:
        raise InputError(f"{path}: 'data.{name}.columns': '{unknown[0]}' is neither an input nor an output.")
    records, files = [], []
    for file in part.files:
        record = read_record(
            path.parent / file,
            inputs=spec.channels(spec.data.inputs),
            outputs=spec.channels(spec.data.outputs),
            sampling_time=spec.data.sampling_time,
            time=spec.data.time,
            rows=part.rows,  # type: ignore[arg-type]  (lists of two, checked by the spec)
            every=part.every,
            columns=part.columns,
            missing=spec.data.missing,
        )
        records.append(record)
        digest = hashlib.sha256((path.parent / file).read_bytes()).hexdigest()
        files.append({"file": file, "sha256": digest, "rows": len(record)})
    return LoadedPart(name, Record.join(records), part.skip, tuple(files))


def _check_scorable(part: LoadedPart, start: int, sampling_time: float) -> None:
    if not same_step(part.record.sampling_time, sampling_time):
        raise InputError(
            f"data.{part.name}: sampled every {part.record.sampling_time:g} s, the training data every "
            f"{sampling_time:g} s; one model has one sampling time."
        )
    for experiment, skip in zip(part.record.experiments, part.skips, strict=True):
        first = max(start, skip)
        if len(experiment) <= first:
            raise InputError(
                f"{experiment.source}: data.{part.name} has {len(experiment)} rows, too few; the first {first} are "
                f"lags or skipped, so at least {first + 1} are needed."
            )


def check_report(job: Job) -> dict[str, Any]:
    """What `orthaug check` tells: excitation on the data, identifiability of the physics; nothing is trained."""
    problem = job.problem
    found = identifiability(problem.baseline, problem.layout, problem.outputs, problem.rows.x)
    return {
        "schema": SCHEMA,
        "orthaug": __version__,
        "data": data_of(job),
        "parameters": list(problem.baseline.names),
        "regressor": [str(lag) for lag in problem.layout],
        "rows": len(problem.rows),
        "excitation": _excitation(problem.excitation) | {"collinear": [list(g) for g in problem.excitation.collinear]},
        "identifiability": {
            "identifiable": found.full_rank,
            "rank": found.rank,
            "columns": found.columns,
            "inseparable": [list(group) for group in found.collinear],
        },
        "bias": None,
        "warnings": list(job.warnings),
    }


def run_fit(job: Job, progress: Progress | None = None, *, kind: str | None = None, alone: bool = False) -> Estimate:
    """Train as the spec says; with another `kind` of structure, or the physics `alone`."""
    from orthaug.criteria import Prediction, Simulation
    from orthaug.estimation import estimate
    from orthaug.learners import MLP
    from orthaug.solvers import AdamLBFGS, LevenbergMarquardt

    spec, training = job.spec, job.spec.training
    learner = None
    if spec.learner.kind == "mlp" and not alone:
        learner = MLP(tuple(spec.learner.hidden), spec.learner.activation, spec.learner_inputs())
    if training.solver == "adam-lbfgs":
        solver = AdamLBFGS(training.adam_iterations, training.lbfgs_iterations, training.learning_rate)
    else:
        solver = LevenbergMarquardt(training.iterations)
    return estimate(
        job.train.record,
        job.problem.baseline,
        lags=spec.lag_orders() if learner is not None else None,
        learner=learner,
        structure=Orthogonal() if alone else structure_of(spec, kind),
        criterion=Simulation(training.segment, training.washout, training.start_iterations)
        if training.focus == "simulation"
        else Prediction(training.horizon),
        solver=solver,
        regularization=training.regularizations(job.validation is not None),
        restarts=training.restarts,
        seed=training.seed,
        validation=job.validation.scored(job.problem.rows.start) if job.validation else None,
        progress=progress,
    )


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fit with its scores on every part, and the content of result.json."""

    job: Job
    fit: Estimate
    result: dict[str, Any]
    responses: tuple[Response, Response] | None
    """One-step prediction and free run of the last part."""


def fit_job(job: Job, progress: Progress | None = None, *, kind: str | None = None, alone: bool = False) -> Fitted:
    """Train, score every part, and put the result together; the arguments as in `run_fit`."""
    fit = run_fit(job, progress, kind=kind, alone=alone)
    warnings = [*job.warnings, *fit.warnings]
    scores, responses = {}, None
    if fit.status.ok:
        for part in job.parts:
            scores[part.name], responses = score_part(fit.model, part, warnings)
    spec = job.spec.model_dump(mode="json", exclude_unset=True)
    status = fit.status
    result = {
        "schema": SCHEMA,
        "orthaug": __version__,
        "spec": spec,
        "data": data_of(job),
        "status": {
            "code": status.code,
            "message": status.message,
            "iterations": status.iterations,
            "seconds": status.seconds,
            "loss": status.loss,
        },
        "restarts": [asdict(restart) for restart in fit.restarts],
        "parameters": _parameters(fit),
        "physical_parameters": None,
        "structure": fit.model.structure,
        "measure": job.spec.structure.measure.kind if fit.model.structure == "orthogonal" else None,
        "orthogonality_defect": fit.defect,
        "excitation": _excitation(fit.excitation),
        "scores": scores,
        "bias": None,
        "residuals": None,
        "validation": None,
        "warnings": warnings,
    }
    return Fitted(job, fit, plain(result), responses)


def is_result(folder: Path) -> bool:
    """Whether a folder holds a result that orthaug wrote."""
    try:
        content = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and "schema" in content and "orthaug" in content


def check_output(folder: Path) -> None:
    """Raise InputError early where the result could not be written."""
    check_replaceable(folder, is_result)


def check_inputs_kept(job: Job, folder: Path) -> None:
    """Raise InputError where the result would take the place of a file that the job reads."""
    files = [job.path, *(job.path.parent / entry["file"] for part in job.parts for entry in part.files)]
    for file in files:
        if file.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{folder}: holds {file.name}, which this fit reads; give another folder.")


def write_result(fitted: Fitted, folder: Path) -> None:
    """result.json, model/ and figures/, whole or not at all; without a model where training failed."""
    with whole_folder(folder, is_result) as partial:
        fill_result(fitted, partial)


def fill_result(fitted: Fitted, folder: Path) -> None:
    """Write the files of a result into an existing folder."""
    from orthaug import plots, storage

    text = json.dumps(fitted.result, indent=1, ensure_ascii=False, allow_nan=False)
    (folder / "result.json").write_text(text + "\n", encoding="utf-8")
    if not fitted.fit.status.ok:
        return
    (folder / "model").mkdir()
    storage.write(fitted.fit.model, folder / "model")
    (folder / "figures").mkdir()
    assert fitted.responses is not None
    one_step, free = fitted.responses
    where = f"{fitted.job.parts[-1].name}, {fitted.fit.model.structure}"
    drawn = {
        "prediction": plots.output_figure(one_step, f"one-step prediction, {where}"),
        "simulation": plots.output_figure(free, f"free run, {where}"),
        "residual": plots.residual_figure(one_step, f"one-step residual, {where}"),
    }
    if fitted.fit.model.form.bound is not None:
        drawn["components"] = plots.components_figure(one_step, f"parts of the one-step prediction, {where}")
    for name, figure in drawn.items():
        plots.save(figure, folder / "figures" / f"{name}.png")


def plain(value: Any) -> Any:
    """The same with None for every number that is not finite: JSON has no NaN."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


def score_part(model: Model, part: LoadedPart, warnings: list[str]) -> tuple[dict[str, Any], tuple[Response, Response]]:
    """Scores of a part and the responses they come from; what does not exist is None, with a sentence in `warnings`."""
    responses = model.predict(part.record), model.simulate(part.record)
    found = {}
    for kind, response in zip(("prediction", "simulation"), responses, strict=True):
        runaway = next((t.diverged for t in response.trajectories if t.diverged), None)
        scored = response.scores(part.skips)
        found[kind] = scored.as_dict()
        if runaway is not None:
            step, output = runaway
            found[kind] = {"rmse": None, "nrmse": None, "fit": None}
            warnings.append(
                f"{part.name}: the free run diverged in output '{output}' at step {step}; no simulation scores."
            )
        elif np.isnan(scored.rmse).any():
            warnings.append(f"{part.name}: the {kind} is not finite on some rows; no scores.")
        elif np.isnan(scored.nrmse).any():
            warnings.append(
                f"{part.name}: an output is constant over the scored samples; no NRMSE and FIT of its {kind}."
            )
    return found, responses


def data_of(job: Job) -> dict[str, Any]:
    """The files of each part, as result.json lists them."""
    return {
        "train": list(job.train.files),
        **({"validation": list(job.validation.files)} if job.validation else {}),
        **({"tests": {part.name.removeprefix("tests."): list(part.files) for part in job.tests}} if job.tests else {}),
    }


def _excitation(found: Excitation) -> dict[str, Any]:
    return {"rank": found.rank, "columns": found.columns, "condition": found.condition}


def _parameters(fit: Estimate) -> list[dict[str, Any]]:
    std, ci = fit.std, fit.interval
    return [
        {
            "name": p.name,
            "unit": p.unit,
            "initial": p.initial,
            "value": float(fit.theta[i]) if fit.status.ok else None,
            "std": None if std is None else float(std[i]),
            "ci95": None if ci is None or np.isnan(ci[i]).any() else [float(v) for v in ci[i]],
        }
        for i, p in enumerate(fit.problem.baseline.parameters)
    ]
