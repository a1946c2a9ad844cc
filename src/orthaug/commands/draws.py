"""Draws of a rehearsal: data of a known truth, the fit of the spec to them, and other choices."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, check_choice, check_count, check_number
from orthaug._base.errors import InputError, TrainingError
from orthaug.analysis.doubts import NOISE_ONLY, doubt
from orthaug.analysis.examination import with_verdict
from orthaug.commands.design import design_for
from orthaug.commands.fit import FitReport, fit_variant
from orthaug.commands.job import AS_DECLARED, PHYSICS_ONLY, Job, Variant
from orthaug.commands.opening import pose_job
from orthaug.commands.parts import FilePart
from orthaug.commands.proposals import apply_change
from orthaug.commands.spec import Spec, spec_model
from orthaug.data.gaps import filled_record
from orthaug.data.record import Experiment, Record
from orthaug.inference.measures import Symmetrized, Training, Uniform
from orthaug.reports.recovery import DECLARED
from orthaug.studies.planted import Planted, System, size_of

GROUPS = ("declared", "usual", "memory")
"""Where planted terms come from: [[suspects]], the catalogue, and one with memory."""
MOST_DRAWS = 10_000
_CHOICE_DRAWS = 4  # draws on which other choices are fitted as well, unless more are asked for
_MOST_ROWS = 50_000  # of the training data: beyond, twice the rows are predicted and not fitted
_WIDEST = 3.0  # of the recorded range of an output: what leaves that is another experiment
_HALVINGS = 8  # of a term that makes the run leave all bounds
_ONE_START = {"training.restarts": 1}  # of other choices, which are many
# Of these a text does not name all parameters that it doubts
_DOUBTS = frozenset({*NOISE_ONLY, "inconsistent", "sensor_noise"})
_ANSWERED = frozenset({"biased"})  # with an interval of its own, which then has to hold the truth


@dataclass(frozen=True)
class Asked:
    """Request for a rehearsal.

    Args:
        draws: data sets that are simulated and fitted.
        seed: of all random numbers, by which the same draw is the same everywhere.
        share: RMS of a planted term over that of the physics in its equation; None for terms as
            large as what the learner found.
        terms: groups of planted terms, of `GROUPS`.
        choices: draws on which other choices are fitted too; None for the first four.

    Raises:
        InputError: numbers out of range, or an unknown group.
    """

    draws: int = 20
    seed: int = 0
    share: float | None = None
    terms: Sequence[str] = GROUPS
    choices: int | None = None

    def __post_init__(self) -> None:
        check_count(self.draws, "draws", most=MOST_DRAWS)
        check_count(self.seed, "seed", 0, most=2**63 - 1)
        check_count(self.compared, "choices", 0, most=MOST_DRAWS)
        if self.share is not None:
            check_number(self.share, "share", positive=True)
        if isinstance(self.terms, str) or not self.terms:
            raise InputError(f"`terms` must be a list, of {', '.join(GROUPS)}; got {self.terms!r}.")
        for group in self.terms:
            check_choice(group, GROUPS, "`terms`")

    @property
    def compared(self) -> int:
        """Number of the first draws on which other choices are fitted."""
        return _CHOICE_DRAWS if self.choices is None else self.choices


@dataclass(frozen=True, eq=False)
class Plan:
    """The truth of a rehearsal, and what varies between draws."""

    job: Job
    fit: Any
    """The fit of the user's data, whose parameters are the truth."""
    system: System
    terms: tuple[tuple[str, Planted], ...]
    """Group and term, in the order in which draws take them."""
    left_out: tuple[tuple[str, str], ...]
    noise: Matrix
    """Root (ny, ny) of the noise covariance."""
    at_output: bool
    """True for noise on the measured outputs, False for noise that enters the equation."""
    designed: Record | None = None
    """The record of the input that [design] asks for, without its outputs."""


def plan_for(job: Job, asked: Asked) -> Plan:
    """Return the truth and the terms of a rehearsal.

    Raises:
        InputError, TrainingError: as `rehearse`.
    """
    if job.train.source is not None:
        raise InputError(
            f"{job.path}: a rehearsal simulates the rows in memory, and these remain in their "
            'files; set engine.kind = "memory".'
        )
    fit = job.run()
    if not fit.status.ok:
        raise TrainingError(f"{fit.status.message.removesuffix('.')}. There is no estimate to use.")
    system, at_output = job.physics.system(fit), fit.criterion.simulates
    plan = Plan(job, fit, system, (), (), _noise_root(fit, at_output), at_output, _designed(job))
    planted, left_out = [], []
    for group, suspect in _suspects(job, system, asked.terms):
        found = _plant(plan, suspect, asked.share)
        if isinstance(found, str):
            left_out.append((suspect.name, found))
        else:
            planted.append((group, found))
    if not planted:
        reasons = "; ".join(f"{name}: {why}" for name, why in left_out) or "there are none"
        raise InputError(f"{job.path}: no term can be planted ({reasons}). Give [[suspects]].")
    return replace(plan, terms=tuple(planted), left_out=tuple(left_out))


def _noise_root(fit: Any, at_output: bool) -> Matrix:
    """Return the root of the covariance of what the fit leaves, per degree of freedom."""
    record = fit.problem.record
    response = fit.model.simulate(record) if at_output else fit.model.predict(record)
    errors = response.errors
    errors = errors[np.isfinite(errors).all(axis=1)]
    count = len(errors)
    if not count:
        raise TrainingError("the free run of the fit has no finite error to take the noise from.")
    freedom = min(max(fit.freedom, 1.0), float(count))
    covariance = errors.T @ errors / count * (count / freedom if freedom > 0.1 * count else 1.0)
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def _suspects(job: Job, system: System, groups: Sequence[str]) -> Iterator[tuple[str, Any]]:
    """Yield group and suspect, each expression once: declared, with memory, and usual ones."""
    seen: set[str] = set()
    memory = system.with_memory() if "memory" in groups else None
    for group, found in (
        ("declared", job.physics.suspects if "declared" in groups else ()),
        ("memory", () if memory is None else (memory,)),
        ("usual", system.catalogue() if "usual" in groups else ()),
    ):
        for suspect in found:
            key = f"{suspect.expression}|{suspect.equation or suspect.output}|{suspect.memory}"
            if key not in seen:
                seen.add(key)
                yield group, suspect


def _plant(plan: Plan, suspect: Any, share: float | None) -> Planted | str:
    """Return the term with its size; the reason where it cannot be planted.

    The size is halved until the run stays within three times the recorded range.
    """
    try:
        size = size_of(plan.system.columns(suspect), share)
    except InputError as error:
        return str(error).removesuffix(".")
    if share is None and suspect.coefficient is not None:
        size = suspect.coefficient
    if size is None:
        return "zero on these rows, or a combination of the physics there"
    record, planted = plan.job.train.record, Planted(suspect, size)
    measured = np.concatenate([e.outputs for e in filled_record(record).experiments])
    middle, reach = (measured.max(axis=0) + measured.min(axis=0)) / 2, np.ptp(measured, axis=0)
    for _ in range(_HALVINGS):
        quiet = [np.zeros_like(e.outputs) for e in record.experiments]
        ran = np.concatenate(
            [
                plan.system.run(e, record, planted, noise)
                for e, noise in zip(record.experiments, quiet, strict=True)
            ]
        )
        if np.isfinite(ran).all() and np.all(np.abs(ran - middle) <= _WIDEST * reach):
            return planted
        planted = planted._replace(coefficient=planted.coefficient / 2)
    return "the system with it leaves three times the range of the recorded outputs"


def _designed(job: Job) -> Record | None:
    """Return a record of the input that the spec's [design] asks for; None without one."""
    section, record = job.spec.design, job.train.record
    if section is None:
        return None
    signal = np.asarray(design_for(job).signal)
    names = [channel.name for channel in record.inputs]
    longest = max(filled_record(record).experiments, key=len)
    inputs = np.resize(longest.inputs, (len(signal), len(names)))
    inputs[:, names.index(section.input or names[0])] = signal
    outputs = np.resize(longest.outputs, (len(signal), longest.outputs.shape[1]))
    return replace(record, experiments=(Experiment(inputs, outputs, "the designed input"),))


def simulated(plan: Plan, planted: Planted, record: Record, rng: np.random.Generator) -> Record:
    """Return a record with the outputs of the true system and its noise.

    Raises:
        InputError: a run that leaves all bounds.
    """
    experiments = []
    for experiment in record.experiments:
        noise = rng.normal(size=experiment.outputs.shape) @ plan.noise.T
        entering = np.zeros_like(noise) if plan.at_output else noise
        outputs = plan.system.run(experiment, record, planted, entering)
        if not np.isfinite(outputs).all():
            raise InputError(f"the run with {planted.name} leaves all bounds under this noise.")
        outputs = outputs + noise if plan.at_output else outputs
        outputs = np.where(np.isnan(experiment.outputs), np.nan, outputs)
        experiments.append(replace(experiment, outputs=outputs))
    return replace(record, experiments=tuple(experiments))


def simulated_job(
    plan: Plan, planted: Planted, key: Sequence[int], *, train: Record | None = None, times: int = 1
) -> Job:
    """Return the user's job on simulated data: every part by the same truth.

    Args:
        key: of the random numbers; each part and repetition has its own.
        train: other inputs of the training data.
        times: how often each training experiment is recorded.
    """
    job = plan.job

    def part(number: int, given: FilePart, record: Record, repeated: int = 1) -> FilePart:
        drawn = [
            simulated(plan, planted, record, np.random.default_rng([*key, number, i]))
            for i in range(repeated)
        ]
        whole = drawn[0] if repeated == 1 else Record.join(drawn)
        return replace(given, record=whole, warnings=())

    held_out = [part(1 + i, one, one.record) for i, one in enumerate(job.parts[1:])]
    validation = held_out.pop(0) if job.validation is not None else None
    first = part(0, job.train, train or job.train.record, times)
    parts = (first, validation, tuple(held_out))
    return pose_job(job.path, job.spec, job.physics, parts)


def outcome_of(plan: Plan, seed: int, draw: int, *, choices: bool) -> dict[str, object]:
    """Return what a draw gives: the declared fit and, if asked, every other choice."""
    number = draw % len(plan.terms)
    planted = plan.terms[number][1]
    job = simulated_job(plan, planted, (seed, draw))
    report = doubt(with_verdict(fit_variant(job, AS_DECLARED)))
    rows = [_declared_row(report)]
    if choices and report.fit.status.ok:
        for kind, name, make in _choices(plan, job, report.fit, planted, (seed, draw)):
            fit = _attempt(make)
            if fit is not None:
                rows.append({"kind": kind, "name": name, "parameters": _values(plan.job, fit)})
    return {"term": number, "rows": rows}


def _attempt(make: Callable[[], Any]) -> Any:
    """Return a fit; None where the choice cannot be made on these data, or training failed."""
    try:
        fit = make()
    except (InputError, TrainingError, ValueError, ArithmeticError):
        return None
    return fit if fit.status.ok else None


def _declared_row(report: FitReport) -> dict[str, Any]:
    """Return the outcome of the fit as the spec says, with all intervals that it shows."""
    result, found = report.result, {}
    if report.fit.status.ok:
        for row in (*result.parameters, *(result.physical_parameters or ())):
            found[row.name] = {
                "value": row.value,
                "std": row.std,
                "ci95": row.ci95,
                "with_bias": row.ci95_with_bias,
                "profile": row.profile95,
                "warned": bool(row.ci95_counts) or _is_doubted(row.name, result.warnings),
            }
    codes = sorted({warning.code for warning in result.warnings})
    verdict = None if result.validation is None else result.validation.verdict
    own = {"parameters": found, "warnings": codes, "verdict": verdict}
    return {"kind": DECLARED, "name": "as the spec says"} | own


def _is_doubted(name: str, warnings: Sequence[Any]) -> bool:
    """Return whether a warning doubts a parameter, beyond those with an interval of their own."""
    word = re.compile(rf"(?<!\w){re.escape(name)}(?!\w)")
    return any(
        warning.code in _DOUBTS or (warning.code not in _ANSWERED and word.search(warning.text))
        for warning in warnings
    )


def _values(job: Job, fit: Any) -> dict[str, object]:
    """Return the parameters of a fit, physical ones of a map included."""
    intervals = fit.interval
    found = {}
    for i, name in enumerate(fit.problem.names):
        limits = None if intervals is None else [float(end) for end in intervals[i]]
        if limits is not None and not np.isfinite(limits).all():
            limits = None
        found[name] = {"value": float(fit.values[i]), "ci95": limits}
    if job.physics.map is not None:
        physical = fit.physical(job.physics.map)
        for name, value, pair in zip(physical.names, physical.value, physical.ci95, strict=True):
            ends = None if pair is None else [float(end) for end in pair]
            ends = ends if ends is not None and np.isfinite(ends).all() else None
            found[name] = {"value": float(value), "ci95": ends}
    return found


Choice = tuple[str, str, Callable[[], Any]]


def count_choices(plan: Plan) -> int:
    """Return how many other choices there are beside the fit of the user's data."""
    return sum(1 for _ in _choices(plan, plan.job, plan.fit, plan.terms[0][1], (0, 0)))


def _choices(
    plan: Plan, job: Job, fit: Any, planted: Planted, key: tuple[int, int]
) -> Iterator[Choice]:
    """Yield kind and name of every other choice, and what fits it."""
    criterion, spec = fit.criterion, job.spec
    job = replace(job, spec=_changed(job, _ONE_START))
    learns = spec.declared_learner() is not None  # else there is no structure to choose
    if learns:
        yield "structure", PHYSICS_ONLY, lambda: job.run(Variant(PHYSICS_ONLY, criterion=criterion))
    for kind in job.physics.structures if learns else ():
        if kind != spec.structure.kind and job.refusal(Variant(kind)) is None:
            yield "structure", kind, lambda k=kind: job.run(Variant(k, criterion=criterion))
    declared = spec.declared_structure()
    if learns and declared.projects and _shares_some(job, fit):
        other = "all" if declared.shared == "auto" else "auto"
        words = "orthogonal to all of θ" if other == "all" else "orthogonal along shared directions"
        yield "structure", words, lambda: _run_changed(job, {"structure.shared": other}, criterion)
    if declared.projects and fit.learns:
        for measure in (Training(), Symmetrized(), Uniform()):
            if measure.name != job.measure.name:
                yield "measure", measure.name, lambda m=measure: fit.split(m)
    for other in plan.system.other_inputs() if learns and not _is_of_terms(job) else ():
        change = {"learner.inputs": list(other.inputs)}
        names = ", ".join(other.inputs)
        yield "inputs", names, lambda c=change: _run_changed(job, c, criterion)
    if plan.job.problem.count <= _MOST_ROWS:
        yield (
            "rows",
            "twice the rows",
            lambda: _fit_from_one_start(simulated_job(plan, planted, key, times=2), criterion),
        )
    if plan.designed is not None:
        new = plan.designed
        yield (
            "input",
            "the designed input",
            lambda: simulated_job(plan, planted, key, train=new).run(),
        )


def _fit_from_one_start(job: Job, criterion: Any) -> Any:
    """Return the fit of a job from one start."""
    return replace(job, spec=_changed(job, _ONE_START)).run(Variant(criterion=criterion))


def _is_of_terms(job: Job) -> bool:
    """Return whether the learner is a sum of terms, which has no inputs of its own to choose."""
    return bool(getattr(getattr(job.problem, "features", None), "linear", False))


def _shares_some(job: Job, fit: Any) -> bool:
    """Return whether the learner could imitate some, and not all, directions of θ."""
    shared = fit.shared if hasattr(fit, "shared") else job.problem.shared
    return not shared.all


def _changed(job: Job, change: dict[str, Any]) -> Spec:
    """Return the spec of a job with some other values."""
    return spec_model().model_validate(apply_change(job.declaration, change))


def _run_changed(job: Job, change: dict[str, Any], criterion: Any) -> Any:
    """Return the fit of a changed spec to the same data."""
    spec = _changed(job, change)
    parts = (job.train, job.validation, job.tests)
    changed = pose_job(
        job.path, spec, job.physics.declare(spec, job.train.record.sampling_time), parts
    )
    return changed.run(Variant(criterion=criterion))
