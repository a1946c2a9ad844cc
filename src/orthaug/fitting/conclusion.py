"""From what training left to an estimate: θ split from the learner, statistics, warnings."""

from __future__ import annotations

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.learned import FreeStatistics, Learned
from orthaug.fitting.solvers.levenberg_marquardt import SPANNED
from orthaug.fitting.status import Status
from orthaug.fitting.structures import Fixed, Split, Structure, split
from orthaug.inference.covariance import degrees_of_freedom, noise_covariance, theta_covariance
from orthaug.models.learners import Scaling
from orthaug.models.model import Model
from orthaug.models.predictor import Form, Numbers
from orthaug.physics.excitation import ILL_CONDITIONED
from orthaug.physics.problem import Problem


def nothing_learned(problem: Problem) -> Learned:
    """Physics alone."""
    nothing, zeros = np.zeros(0), np.zeros(len(problem.outputs))
    phi = problem.projection.phi
    return Learned(
        bound=None,
        weights=nothing,
        scaling=Scaling(nothing, nothing),
        unit=zeros,
        values=np.zeros_like(problem.target),
        gram=np.tensordot(phi, phi, axes=([0, 1], [0, 1])),
        middle=lambda noise: np.einsum("kit,ij,kjs->ts", phi, noise, phi, optimize=True),
    )


def conclude(problem: Problem, structure: Structure, learned: Learned, status: Status) -> Estimate:
    """Solve θ, split it from the learner, and attach statistics."""
    projection, weight = problem.projection, problem.weight
    whitened = learned.values * weight
    usable = status.code != "non_finite"
    if learned.elsewhere:  # c = 0: all of the function is the learner's
        aux = projection.solve(whitened)
        theta, theta_aux, fixed = Split(aux, aux, {})
    else:
        there = whitened if usable else np.zeros_like(whitened)
        held = learned.free.fixed if learned.free else None
        theta, theta_aux, fixed = split(structure, problem, there, learned.coefficients, held)
    found = learned.free or _one_step_statistics(problem, learned, theta - theta_aux, fixed)
    noise = found.noise if usable else None
    known = noise is not None and _unique(structure, learned) and not learned.elsewhere
    form = Form(problem.baseline, problem.features, problem.layout, problem.outputs, learned.bound)
    numbers = Numbers(
        theta, theta_aux, learned.weights, learned.scaling.centre, learned.scaling.halfwidth, learned.unit, learned.tilt
    )
    record = problem.record
    return Estimate(
        model=Model(
            form=form,
            numbers=numbers,
            outputs=record.outputs,
            inputs=record.inputs,
            sampling_time=record.sampling_time,
            time_column=record.time_column,
            structure=structure.name,
            largest_output=np.max([np.abs(e.outputs).max(axis=0) for e in record.experiments], axis=0),
            weight=problem.weight,
            gram=learned.gram,
            ridge=learned.ridge,
            freedom=found.freedom,
            middle=_middle(learned, noise, weight),
            noise=noise,
        ),
        status=Status(status.code, status.iterations, status.seconds, found.mean_square),
        restarts=(),
        excitation=problem.excitation,
        covariance=found.covariance if known else None,
        freedom=found.freedom,
        effective_weights=learned.effective,
        defect=_defect(problem, whitened, theta_aux),
        problem=problem,
        at_bound={problem.baseline.names[i]: value for i, value in fixed.items()},
        warnings=tuple(_warnings(problem, structure, learned, noise, fixed)),
    )


def _one_step_statistics(problem: Problem, learned: Learned, c: Vector, fixed: Fixed) -> FreeStatistics:
    """The statistics of the one-step residual, in the form of those of a free run."""
    projection, weight = problem.projection, problem.weight
    residual = problem.whitened_target - learned.values * weight - projection.phi @ c
    freedom = degrees_of_freedom(projection, learned.effective) + len(fixed) / len(weight)
    noise = noise_covariance(residual / weight, freedom) if np.isfinite(residual).all() else None
    covariance = None if noise is None else theta_covariance(projection, weight, noise, fixed)
    return FreeStatistics(noise, covariance, float(freedom.min()), float(np.mean(residual**2)), fixed)


def _middle(learned: Learned, noise: Matrix | None, weight: Vector) -> Matrix | None:
    """ΣψᵀΣ_eψ in whitened outputs, for the intervals of later splits and of predictions."""
    if noise is None or learned.gram is None:
        return None
    whitened = noise * np.outer(weight, weight)
    if len(weight) == 1:
        return whitened[0, 0] * learned.gram
    return None if learned.middle is None else learned.middle(whitened)


def _unique(structure: Structure, learned: Learned) -> bool:
    """Whether the data alone determine θ."""
    return structure.projects or (learned.bound is None and structure.identifies)


def _defect(problem: Problem, whitened: np.ndarray, theta_aux: Vector) -> float | None:
    """‖QᵀF̃‖ / ‖F‖ with F̃ = F − Φ θ_aux as the model computes it (eq:orth_property); None for F = 0."""
    size = np.linalg.norm(whitened)
    if not 0 < size < np.inf:
        return None
    return float(np.linalg.norm(problem.projection.coordinates(whitened - problem.projection.phi @ theta_aux)) / size)


def _warnings(
    problem: Problem, structure: Structure, learned: Learned, noise: Matrix | None, fixed: Fixed
) -> list[str]:
    found = []
    condition = problem.excitation.condition
    if condition is not None and condition > ILL_CONDITIONED:
        found.append(
            f"the physics is ill-conditioned on the data (condition {condition:.1e} of the scaled columns): "
            "θ is determined, but small changes of the data move it far."
        )
    if learned.code == SPANNED:
        found.append(
            "the learner lies in the span of the physics (P⊥J = 0): there is nothing for it to learn that the "
            "physics does not express already. Give it another form or other inputs, or leave it out."
        )
    if learned.free is not None and not np.isfinite(learned.free.mean_square):
        found.append(
            "the free run diverges over whole experiments of the training data, so it has no loss; train with longer "
            "segments, or bound what makes it run away."
        )
    if learned.elsewhere:
        found.append("no standard errors: the function was trained elsewhere.")
    elif not _unique(structure, learned):
        found.append(
            f"θ of the {structure.name} structure is not unique (it depends on the learner's start or on the "
            "penalty), so it has no standard error; use the orthogonal structure for parameters."
        )
    elif noise is None:
        found.append(
            f"no standard errors: {len(problem.rows)} rows leave no degrees of freedom for "
            f"{len(problem.baseline.names)} parameters and {learned.effective:.1f} effective weights; "
            "use more data or a smaller learner."
        )
    if fixed:
        names = ", ".join(f"{problem.baseline.names[i]} = {value:g}" for i, value in fixed.items())
        found.append(
            f"at a bound: {names}. What stands at a bound has no standard error, and those of the others hold "
            "with it fixed there; data that contradict a bound contradict the physics or the bound."
        )
    return found
