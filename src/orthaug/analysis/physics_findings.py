"""The findings that depend on the kind of physics: lagged, which is linear in θ, or a motion."""

from __future__ import annotations

from collections.abc import Container, Iterable
from dataclasses import replace
from functools import cache, partial, singledispatch
from typing import Any

import numpy as np

from orthaug._base.errors import Warning
from orthaug._base.lines import percent
from orthaug.analysis.attempt import attempt, attempt_warned
from orthaug.analysis.bias import ResidualStep, bias_table
from orthaug.analysis.budget import Budget, budget_on
from orthaug.analysis.diagnosis import diagnose
from orthaug.analysis.evidence import Evidence
from orthaug.analysis.fit_findings import physical_rows
from orthaug.analysis.form_budget import budget_by_forms, selected_alone
from orthaug.analysis.free_run_bias import linearize_fit
from orthaug.analysis.free_run_equations import substep_bias
from orthaug.analysis.free_run_stability import stability
from orthaug.analysis.imitation import Imitation, MotionImitation, imitation
from orthaug.analysis.learned_part import equation_parts
from orthaug.analysis.measure_bias import LaggedTerms, bias_under, linearization_of
from orthaug.analysis.missing_lags import missing_lags
from orthaug.analysis.motion_modes import motion_stability
from orthaug.analysis.other_solutions import find_other_solution
from orthaug.fitting.elimination import directions
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.inference.measures import WeighedPhysics
from orthaug.inference.nearly_shared import output_warnings, shared_warnings
from orthaug.models.learners import learns
from orthaug.models.response import Response

_SURELY = 5.0  # standard errors of a suspect's coefficient, beside errors that may be coloured
_NOT_ANALYSED = Warning(
    "residual_not_analysed",
    "the residual is not analysed: there are too few rows, or it is rounding error only.",
)
_RUN_NOT_ANALYSED = Warning(
    "residual_not_analysed",
    "the residual is not analysed: the free run diverged, has too few rows, or leaves rounding "
    "error only.",
)


def describe_physics(fit: Estimate) -> dict[str, Any]:
    """Return the section of the findings that only this kind of physics has."""
    noise = {"noise": list(fit.noise)} if fit.status.ok and fit.noise else {}
    if not isinstance(fit, MotionEstimate):
        return noise
    motion, form = fit.problem.motion, fit.model.form
    return {
        "motion": {
            "states": motion.names_of_states,
            "integrator": motion.integrator,
            "substeps": form.substeps,
            "hold": motion.hold,
            "window": fit.model.window,
            "parts": (),
            "substep_bias": None,
        },
        **noise,
    }


@singledispatch
def analyse_physics(
    fit: Estimate,
    evidence: Evidence,
    one_step: Response,
    free_run: Response,
    warnings: list[Warning],
) -> dict[str, Any]:
    """Return the findings on a fit, with the `budget` of its biases; warnings are added.

    Args:
        one_step: prediction of the training data, and `free_run` over them.
    """
    raise NotImplementedError


@singledispatch
def imitable(fit: Estimate, evidence: Evidence) -> tuple[Imitation | None, list[Warning]]:
    """Return what the learner of a fit could imitate, and warnings on what it nearly could.

    None without a learner, or where the structure splits nothing along chosen directions.
    """
    raise NotImplementedError


@imitable.register(LaggedEstimate)
def _(fit: LaggedEstimate, evidence: Evidence) -> tuple[Imitation | None, list[Warning]]:
    return imitable_before(fit.problem, evidence, fit)


@imitable.register(MotionEstimate)
def _(fit: MotionEstimate, evidence: Evidence) -> tuple[Imitation | None, list[Warning]]:
    if not fit.status.ok or not fit.learns:
        return None, []
    seen = [str(entry) for entry in fit.model.form.features]
    found, form = MotionImitation.of(seen, fit.shared), fit.model.form
    if fit.unidentified:
        found = found.beside_collinear([fit.unidentified])
    if form.motion.memory:
        record = fit.problem.record
        first = replace(record, experiments=record.experiments[:1])
        found = found.with_memory(
            form, fit.theta, *np.split(fit.reach(first), [form.states], axis=1)
        )
    warnings = [*shared_warnings(fit.shared, seen), *output_warnings(form.motion)]
    return found, warnings


def imitable_before(
    problem: Any, evidence: Evidence, fit: LaggedEstimate | None = None
) -> tuple[Imitation | None, list[Warning]]:
    """Return what a learner beside lagged physics could imitate, as `imitable`.

    Args:
        fit: None before training, with the effect of other learner inputs.
    """
    structure = evidence.structure
    if not learns(evidence.learner) or not structure.projects or structure.shared == "all":
        return None, []
    if not problem.baseline.names or not problem.features.entries:
        return None, []
    held = tuple(fit.at_bound) if fit else ()
    found = imitation(problem, evidence.map, others=fit is None, held=held)
    if fit is not None and not (fit.status.ok and fit.learns):
        return found, []
    seen = [str(entry) for entry in problem.features.entries]
    return found, shared_warnings(problem.shared, seen)


def bias_before(evidence: Evidence, weighed: WeighedPhysics) -> list[dict[str, Any]]:
    """Return the bias of lagged physics by every suspect before training, under a measure.

    It includes the usual suspects, since it shows which measure removes a bias.
    """
    problem = evidence.problem
    if not problem.baseline.names:
        return []
    along = directions(evidence.structure, problem) if learns(evidence.learner) else None
    terms = LaggedTerms(weighed, problem, problem.least_squares, evidence.map, None, along)
    return bias_under(terms, evidence.suspects, certify_usual=True)


@analyse_physics.register(LaggedEstimate)
def _of_lagged(
    fit: LaggedEstimate,
    evidence: Evidence,
    one_step: Response,
    free_run: Response,
    warnings: list[Warning],
) -> dict[str, Any]:
    problem, terms = fit.problem, cache(partial(_terms, fit, evidence))
    suspects = evidence.suspects
    found = {
        **_physical(fit, evidence, warnings),
        "bias": attempt(
            "the bias by suspects",
            lambda: bias_under(terms(), suspects, certify_usual=False) if problem.names else [],
            warnings,
            None,
        ),
        "measure_detail": fit.measure,
        "stability": attempt_warned(
            "the analysis of the free run's sensitivity",
            lambda: stability(fit.model, problem.record, response=free_run, x=problem.rows.x),
            warnings,
        ),
        "residuals": attempt_warned(
            "the analysis of the residual",
            lambda: diagnose(fit, one_step=one_step, free_run=free_run),
            warnings,
            _NOT_ANALYSED,
        ),
        "missing_lags": attempt_warned(
            "the search for missing lags", lambda: missing_lags(fit, one_step), warnings
        ),
        "budget": attempt_warned(
            "the bias that the learner implies",
            lambda: budget_on(terms(), suspects) if _splits(fit) else budget_by_forms(terms()),
            warnings,
        ),
    }
    warnings += selected_alone(fit)
    found["bias"] = _with_causes(found["bias"], found["budget"])
    return found


def _with_causes(
    table: list[dict[str, Any]] | None, budget: Budget | None
) -> list[dict[str, Any]] | None:
    """Return a table of suspects with the causes in the budget that it lacks."""
    listed = {entry["name"] for entry in table or ()}
    causes = [cause.as_dict() for cause in (budget.causes if budget else ())]
    added = [cause for cause in causes if cause["name"] not in listed]
    return [*(table or ()), *added] if added else table


def _physical(fit: LaggedEstimate, evidence: Evidence, warnings: list[Warning]) -> dict[str, Any]:
    """Return the physical parameters of θ̂ and their findings, where there is a map to them."""
    if evidence.map is None:
        return {}
    physical, profiles, slopes = fit.physical(evidence.map), None, None
    warnings += physical.warnings
    if evidence.profiles and physical.covariance is not None:
        profiles = {name: fit.physical_profile(evidence.map, name) for name in physical.names}
    if physical.sensitivities is not None:  # ∂ln p / ∂ln θ by name
        slopes = {
            name: dict(zip(evidence.map.theta_names, row, strict=True))
            for name, row in zip(physical.names, physical.sensitivities, strict=True)
        }
    return {
        "physical_parameters": physical_rows(physical, profiles),
        "physical_consistency": physical.consistency,
        "sensitivities": slopes,
    }


def _splits(fit: LaggedEstimate) -> bool:
    """Return whether θ of a fit was split from its learner."""
    return fit.model.structure == "orthogonal" and fit.learns


def _terms(fit: LaggedEstimate, evidence: Evidence) -> LaggedTerms:
    """Return the physics under the declared measure.

    The rows are weighed by the errors of the fit, or filtered by its noise model, where it has one.
    """
    own = fit.problem.weight.kind != evidence.problem.weight.kind or fit.problem.noise is not None
    problem = fit.problem if own else evidence.problem
    return linearization_of(fit, evidence.measure, evidence.map, problem)


@analyse_physics.register(MotionEstimate)
def _of_motion(
    fit: MotionEstimate,
    evidence: Evidence,
    one_step: Response,
    free_run: Response,
    warnings: list[Warning],
) -> dict[str, Any]:
    record, judged = fit.problem.record, fit.judged_record
    x, u = np.split(fit.reach(judged), [fit.model.form.states], axis=1)
    bounded = record if judged is record else None  # no run of an unstable plant is bounded
    found: dict[str, Any] = {
        "residuals": attempt_warned(
            "the analysis of the residual",
            lambda: diagnose(fit, one_step=one_step, free_run=free_run),
            warnings,
            _RUN_NOT_ANALYSED,
        ),
        "stability": attempt_warned(
            "the analysis of the modes",
            lambda: motion_stability(fit.model, x, u, record=bounded),
            warnings,
        ),
    }
    parts = None
    if fit.learns:
        parts = attempt(
            "the size of the learned part", lambda: equation_parts(fit, x, u), warnings, None
        )
        found["measure_detail"] = fit.split_by
    # what is not identified has other solutions anyway
    if fit.alone is not None and not fit.model.coloured and not fit.unidentified:
        alone, solver = fit.alone, LevenbergMarquardt().within_limit
        attempt_warned(
            "the search for other solutions",
            lambda: find_other_solution(fit.segmented, solver, alone),
            warnings,
        )
    coarse = attempt_warned("the analysis of the substeps", lambda: substep_bias(fit), warnings)
    found["motion"] = describe_physics(fit)["motion"] | {
        "parts": parts or (),
        "substep_bias": None if coarse is None else coarse.as_dict(),
    }
    table, budget = attempt(
        "the bias by suspects", lambda: _biases(fit, evidence.suspects), warnings, (None, None)
    )
    warnings += budget.warnings if budget else ()
    warnings += selected_alone(fit, forecasts=fit.model.coloured)
    warnings += _found_suspects(table or (), {one.name for one in evidence.suspects})
    return found | {"bias": table, "budget": budget}


def _found_suspects(table: Iterable[dict[str, Any]], declared: Container[str]) -> list[Warning]:
    """Return a warning for each declared suspect that a free run's residual surely contains."""
    found = []
    for entry in table:
        step: ResidualStep | None = entry["residual"]
        if step is None or entry["name"] not in declared or abs(step.t or 0.0) < _SURELY:
            continue
        unit = f" {entry['unit']}" if entry["unit"] else ""
        std = f" (std {step.std:.2g})" if step.std is not None else ""
        size = f"{step.coefficient:.3g}{unit}{std}"
        text = (
            f"the suspect {entry['name']} is in the residual of the free run: a linear step gives "
            f"it the coefficient {size}, and lowers the squared error by {percent(step.share)}. A "
            "large term is found better by a refit: write it into the physics."
        )
        found.append(Warning("suspect_found", text))
    return found


def _biases(
    fit: MotionEstimate, suspects: tuple[Any, ...]
) -> tuple[list[dict[str, Any]] | None, Any]:
    """Return the table of suspects and of the causes in the budget, and the budget."""
    terms = linearize_fit(fit)
    if terms is None:
        return None, None
    table = bias_table(terms, suspects)
    budget = budget_on(terms, suspects, table) or budget_by_forms(terms)
    return _with_causes([entry.as_dict() for entry in table], budget) or None, budget
