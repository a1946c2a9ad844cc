"""Results of jobs whose physics are equations of motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.errors import InputError, RankError, Warning
from orthaug.analysis.closed_loop import closed_loop
from orthaug.commands.attempt import attempt, attempt_warned
from orthaug.commands.motion_job import MotionJob
from orthaug.commands.scales import describe_scales
from orthaug.reports.result import (
    CheckResult,
    FitResult,
    MeasureResult,
    ParameterResult,
    parameter_rows,
)

if TYPE_CHECKING:
    from orthaug.analysis.input_timing import Trial
    from orthaug.analysis.motion_budget import MotionBudget
    from orthaug.fitting.motion_estimates import MotionEstimate
    from orthaug.models.response import Response
    from orthaug.reports.drawing import Figure

_UNKNOWN = ("physical_parameters", "physical_consistency", "sensitivities", "bias", "missing_lags")
_STIFF = 20  # substeps from which a motion is called stiff for its sampling
_NOT_ANALYSED = Warning(
    "residual_not_analysed",
    "the residual is not analysed: the free run diverged, has too few rows, or leaves rounding "
    "error only.",
)
_NOT_RICH = Warning(
    "rich_inputs_run_away",
    "physics alone diverges under rich inputs, so identifiability is computed for the inputs "
    "of the record.",
)


def check(job: MotionJob) -> CheckResult:
    """Return identifiability, what the learner could imitate, substeps and holds."""
    from orthaug.analysis.absorbed import Waves
    from orthaug.analysis.imitation import imitation_before
    from orthaug.analysis.input_timing import dead_times, try_holds
    from orthaug.analysis.motion_identifiability import identify_ranks, ill_conditioned_alone
    from orthaug.fitting.motion_estimation import without_learner
    from orthaug.fitting.segmented_motion import SegmentedMotion
    from orthaug.inference.motion_split import shared_of_motion
    from orthaug.inference.nearly_shared import shared_warnings
    from orthaug.models.learners import nothing_learned
    from orthaug.models.moving import MotionDynamics

    problem, spec = job.problem, job.spec
    motion, criterion = problem.motion, spec.declared_criterion()
    segmented = SegmentedMotion.of(without_learner(problem), nothing_learned(), criterion)
    identification = identify_ranks(segmented)
    if identification is None:
        wild = "".join(
            f" {warning.text}" for warning in job.warnings if warning.code == "wild_samples"
        )
        scales = describe_scales(problem.record)
        cause = f" {scales[0].upper()}{scales[1:]}" if scales else ""
        remedy = f"it meets a wild sample.{wild}" if wild else f"give others.{cause}"
        raise InputError(
            f"{job.path}: physics alone has no finite free run from its initial values; {remedy}"
        )
    shared, on_rows = None, []
    if spec.declared_learner() is not None and job.structure.shared != "all":
        form = MotionDynamics(
            motion,
            problem.features,
            nothing_learned(),
            problem.record.sampling_time,
            problem.substeps,
        )
        shared = imitation_before(
            form, motion.coordinates.initial, identification.states, identification.inputs
        )
        seen = shared_of_motion(
            form, motion.coordinates.initial, identification.states, identification.inputs
        )
        on_rows = shared_warnings(seen, [str(entry) for entry in form.features])
    posed, waves = (
        (problem, Waves())
        if spec.declared_learner() is not None
        else (without_learner(problem), None)
    )
    trial = try_holds(posed, criterion, spec.declared_solver(), job.structure, waves)
    text, warnings = _about_steps(job, trial)
    warnings += [late.warning for late in dead_times(trial.task, spec.declared_solver())]
    if identification.by_any is None:
        warnings.append(_NOT_RICH)
    return CheckResult.model_validate(
        {
            "data": job.data,
            "parameters": motion.names,
            "regressor": [*motion.names_of_states, *motion.inputs],
            "rows": len(problem.record),
            "excitation": identification.on_data,
            "identifiability": identification.by_any or identification.on_data,
            "shared": shared,
            "bias": _biases(job, trial) if identification.on_data.full_rank else None,
            "motion": {
                "states": motion.names_of_states,
                "integrator": motion.integrator,
                "fastest": problem.fastest,
                "substeps": trial.substeps,
                "rows": trial.rows,
                "holds": trial.holds,
                "best_hold": trial.best,
                "text": text,
            },
            "warnings": [
                *job.warnings,
                *(ill_conditioned_alone(trial.task) if identification.on_data.full_rank else ()),
                *on_rows,
                *warnings,
                *closed_loop(job.train.record),
            ],
        }
    )


def _biases(job: MotionJob, trial: Trial) -> list[dict[str, Any]] | None:
    """Return the bias that each suspect would cause, with physics alone.

    Without suspects in the spec, the usual ones with an effect.

    None where physics alone has no run.
    """
    from orthaug.analysis.motion_bias import linearize_physics

    linearization = linearize_physics(trial.task, job.structure)
    if linearization is None:
        return None
    table = linearization.table(job.suspects or linearization.usual())
    return [entry.as_dict() for entry in table if job.suspects or entry.size]


def refusal(job: MotionJob, result: CheckResult) -> InputError | None:
    """Return an error where the outputs do not identify the parameters, after the report."""
    found = result.excitation
    if found.rank == found.columns:
        return None
    groups = "; ".join(
        f"{group[0]} changes no output"
        if len(group) == 1
        else f"{', '.join(group)} cannot be distinguished"
        for group in found.collinear
    )
    lacking = found.columns - found.rank
    constants = "one of them as a constant" if lacking == 1 else f"{lacking} of them as constants"
    remedy = f"give {constants}"
    if result.identifiability.identifiable:
        remedy += ", or use data that excite them separately"
    return RankError(
        f"the outputs do not determine the parameters (rank {found.rank} of {found.columns}): "
        f"{groups}; {remedy}."
    )


def content(
    job: MotionJob,
    fit: MotionEstimate,
    responses: Mapping[str, tuple[Response, Response]],
    warnings: list[Any],
) -> tuple[MotionEstimate, dict[str, Any]]:
    """Return the fit and the content of its result; warnings are added."""
    from orthaug.analysis.imitation import MotionImitation
    from orthaug.analysis.robustness import robust_free_run
    from orthaug.inference.nearly_shared import shared_warnings
    from orthaug.physics.excitation import Excitation, of_gram

    motion, form = job.problem.motion, fit.model.form
    count, gram = len(motion.names), fit.model.statistics.gram
    found: dict[str, Any] = dict.fromkeys(("budget", "coarse", "parts"))
    fields: dict[str, Any] = dict.fromkeys(
        (*_UNKNOWN, "residuals", "stability", "shared", "measure_detail")
    )
    if fit.status.ok:
        plain = fit
        fit = attempt("the robust covariance", lambda: robust_free_run(plain), warnings, plain)
        found = _analyse(job, fit, responses[job.train.name][1], warnings)
        warnings += closed_loop(job.train.record)
        fields |= {name: found[name] for name in ("residuals", "stability", "bias")}
    budget, coarse, parts = found["budget"], found["coarse"], found["parts"] or ()
    if fit.status.ok and fit.learns:
        seen = [str(entry) for entry in form.features]
        fields["shared"] = MotionImitation.of(seen, fit.shared)
        warnings += shared_warnings(fit.shared, seen)
        fields["measure_detail"] = MeasureResult.of_motion(fit.split_by)
    return fit, fields | {
        "parameters": _parameters(fit, budget),
        "standard_errors": None
        if fit.std is None
        else "plain"
        if fit.plain_covariance is None
        else "robust",
        "standard_errors_by": None if fit.std_kind == "plain" else fit.std_kind,
        "excitation": Excitation(0, count, None, ())
        if gram is None
        else of_gram(gram[:count, :count], motion.names),
        "motion": {
            "states": motion.names_of_states,
            "integrator": motion.integrator,
            "substeps": form.substeps,
            "hold": motion.hold,
            "window": fit.model.window,
            "parts": parts,
            "substep_bias": None if coarse is None else coarse.as_dict(),
        },
    }


def _analyse(
    job: MotionJob, fit: MotionEstimate, free_run: Response, warnings: list[Any]
) -> dict[str, Any]:
    """Return the analyses of a fit; None for one that fails.

    Warnings are added.
    """
    from orthaug.analysis.learned_part import equation_parts
    from orthaug.analysis.motion_bias import suspected_bias
    from orthaug.analysis.motion_budget import declared_budget
    from orthaug.analysis.motion_diagnosis import diagnose_motion
    from orthaug.analysis.motion_modes import motion_stability
    from orthaug.analysis.motion_response import substep_bias

    def biases() -> Any:
        table = suspected_bias(fit, job.suspects) if job.suspects else []
        budget = declared_budget(fit, job.suspects, table)
        warnings.extend(budget.warnings if budget else ())
        listed = {entry.suspect for entry in table}
        usual = [
            cause for cause in (budget.causes if budget else ()) if cause.suspect not in listed
        ]
        return [entry.as_dict() for entry in (*table, *usual)] or None, budget

    points = job.reach(fit.model, job.train.record)[0]
    x, u = np.split(points, [fit.model.form.states], axis=1)
    found = {
        "residuals": attempt_warned(
            "the analysis of the residual",
            lambda: diagnose_motion(fit, free_run),
            warnings,
            _NOT_ANALYSED,
        ),
        "stability": attempt_warned(
            "the analysis of the modes",
            lambda: motion_stability(fit.model, x, u, record=job.train.record),
            warnings,
        ),
        "parts": None,
    }
    if fit.learns:
        found["parts"] = attempt(
            "the size of the learned part", lambda: equation_parts(fit, x, u), warnings, None
        )
    found["coarse"] = attempt_warned(
        "the analysis of the substeps", lambda: substep_bias(fit), warnings
    )
    table, budget = attempt("the bias by suspects", biases, warnings, (None, None))
    return found | {"bias": table, "budget": budget}


def figures(
    job: MotionJob,
    fit: MotionEstimate,
    result: FitResult,
    responses: Mapping[str, tuple[Response, Response]],
) -> dict[str, Figure]:
    """Return the figures of a result by their names."""
    from orthaug.reports import finding_plots, plots
    from orthaug.reports.learned_part import learned_of

    part = job.parts[-1]
    one_step, free = responses[part.name]
    learns = fit.learns
    drawn = {
        "simulation": plots.output_figure(free, f"free run, {part.name}", learns=learns),
        "residual": plots.residual_figure(free, f"free-run residual, {part.name}"),
        "states": plots.states_figure(
            fit.model, part.record, f"states of the free run, {part.name}"
        ),
    }
    if result.bias:
        drawn["bias"] = finding_plots.bias_figure(result.bias)
    drawn["prediction"] = plots.output_figure(one_step, f"one-step prediction, {part.name}")
    if learns:
        drawn["components"] = plots.parts_figure(
            fit.model, part.record, f"physics and learner, {part.name}"
        )
        part = learned_of(fit, job.train.record)
        assert part is not None
        title = f"learned beside the physics, by the {fit.model.measure} measure"
        drawn["learner"] = plots.learner_figure(part, title)
    return drawn


def physics_alone(
    job: MotionJob, fit: MotionEstimate, responses: Mapping[str, tuple[Response, Response]]
) -> Mapping[str, Response]:
    """Return the free run of every part by the model's physics without its learner."""
    return {part: free.physics_alone for part, (_, free) in responses.items()}


def _parameters(fit: MotionEstimate, budget: MotionBudget | None) -> list[ParameterResult]:
    """Return the parameters with intervals, whether the learner could imitate them, and biases."""
    motion = fit.problem.motion
    values = fit.values if fit.status.ok else np.full(len(motion.names), np.nan)
    rows = parameter_rows(motion.parameters, values, fit.std, fit.interval, plain_std=fit.plain_std)
    learns = fit.learns and fit.status.ok
    imitable = [row.name not in fit.shared.untouched if learns else None for row in rows]
    biases = [budget.of(row.name) if budget else None for row in rows]
    return [
        row.with_bias(shared, bias)
        for row, shared, bias in zip(rows, imitable, biases, strict=True)
    ]


def _about_steps(job: MotionJob, trial: Trial) -> tuple[str, list[Warning]]:
    """Return a text on the errors of integrator and hold in the outputs, and warnings."""
    motion, problem, warnings = job.problem.motion, job.problem, []
    step = problem.record.sampling_time
    if motion.scheme.discrete:
        return "The equations give the state one sample later: nothing is integrated.", warnings
    if trial.substeps is None:
        sentences = (
            "physics alone has no finite free run from its initial values, so substeps and "
            "holds were not tried."
        )
        return "", [Warning("physics_runs_away", sentences)]
    sentences = [
        f"The fastest mode of the initial physics is {problem.fastest:.3g} 1/s, sampled every "
        f"{step:g} s; {trial.substeps} substep{'s' * (trial.substeps > 1)} of "
        f"{motion.integrator} in a sample"
        + (
            " are as declared."
            if motion.substeps is not None
            else ": twice as many change the outputs by less than 1 % of the residual."
        )
    ]
    if trial.substeps >= _STIFF:
        text = (
            f"the motion is stiff for its sampling: {trial.substeps} substeps; "
            '`integrator = "exact"` may need fewer.'
        )
        warnings.append(Warning("stiff", text))
    if len(trial.holds) > 1:
        shown = ", ".join(
            f"{held.hold} {'no run' if held.residual is None else f'{held.residual:.4g}'}"
            for held in trial.holds
        )
        sentences.append(
            "Residual of physics alone for each hold of the inputs, in deviations of the "
            f"output: {shown}."
        )
        if trial.best is None:
            sentences.append("No hold explains the data clearly better than the declared one.")
        else:
            text = (
                f'the data are explained better by hold = "{trial.best}" than by the '
                f'declared "{motion.hold}".'
            )
            warnings.append(Warning("other_hold", text))
    return " ".join(sentences), warnings
