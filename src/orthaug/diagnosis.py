"""What the residual says about the noise, and which criterion the data ask for (DESIGN F7).

Noise in the equation leaves a white one-step residual. Noise on the measured output leaves a coloured one, makes
one-step least squares inconsistent, and lets a free run explain the data as well as a prediction from measured lags.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orthaug._arrays import Vector
from orthaug.model import Response
from orthaug.parallel import one_blas_thread
from orthaug.problem import Problem
from orthaug.regressors import stack_rows
from orthaug.residuals import ResidualTest, analyse
from orthaug.result import Estimate

LAGS = 25  # as MATLAB's `resid`
_PRACTICALLY_WHITE = 0.05  # correlations below this are no matter, however sure a long record makes them
_AS_GOOD = 1.05  # free-run error / one-step error up to which the measured lags add nothing
_INSTRUMENT_STEPS = 5
_TOO_FAST = 0.05  # noise variance / smallest variance among the lagged outputs

_COLOURED = (
    "standard errors of θ are those of a white residual, but the {what} is coloured: take them for a rough guide."
)


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """`verdict` is white, equation_noise, sensor_noise or unmodelled; `text` says why and what to do.

    `one_step` and `free_run` are the tests of the two residuals per output. `ratio` is the free run's RMS error against
    the one-step error, `noise_in_lags` the share of noise in the least excited direction of the lagged outputs.
    """

    verdict: str
    text: str
    one_step: tuple[ResidualTest, ...]
    free_run: tuple[ResidualTest, ...] | None
    ratio: float | None
    noise_in_lags: float | None
    warnings: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        return {
            "verdict": self.verdict,
            "text": self.text,
            "one_step": [test.as_dict() for test in self.one_step],
            "free_run": None if self.free_run is None else [test.as_dict() for test in self.free_run],
            "free_run_to_one_step": self.ratio,
            "noise_in_lags": self.noise_in_lags,
        }


def diagnose(fit: Estimate) -> Diagnosis:
    """Analyse the residuals of a fit on its training record."""
    problem, model, simulated = fit.problem, fit.model, fit.criterion.flown is not None
    one_step = model.predict(problem.record)
    free_run = model.simulate(problem.record)
    tests = _tests(problem, one_step)
    white = all(_is_white(test) for test in tests)
    if not model.form.memory:
        return _static(fit, tests, white)
    free_tests = _tests(problem, free_run) if not any(t.diverged for t in free_run.trajectories) else None
    ratio = _ratio(free_run, one_step)
    if not simulated and not white:
        ratio = min((r for r in (ratio, _instrumental_ratio(fit, one_step)) if r is not None), default=None)
    sensor = not white and ratio is not None and ratio < _AS_GOOD
    noise = _noise_in_lags(problem, ratio, one_step) if sensor else None
    free_white = free_tests is not None and all(_is_white(test) for test in free_tests)
    verdict = ("white" if free_white else "equation_noise") if white else "sensor_noise" if sensor else "unmodelled"
    text, warnings = _words(verdict, fit, tests, ratio, noise, simulated)
    if fit.std is not None and not warnings and not (free_white if simulated else white):
        warnings = (_COLOURED.format(what="errors of the free run" if simulated else "one-step residual"),)
    return Diagnosis(verdict, text, tests, free_tests, ratio, noise, warnings)


def _static(fit: Estimate, tests: tuple[ResidualTest, ...], white: bool) -> Diagnosis:
    verdict = "white" if white else "unmodelled"
    text, warnings = _words(verdict, fit, tests, None, None, False)
    if fit.std is not None and not white:
        warnings = (_COLOURED.format(what="one-step residual"),)
    return Diagnosis(verdict, text, tests, None, None, None, warnings)


def _is_white(test: ResidualTest) -> bool:
    """White by Ljung-Box, or with correlations too small to matter."""
    small = test.largest_acf is None or test.largest_acf < _PRACTICALLY_WHITE
    return test.white is not False or small


def _tests(problem: Problem, response: Response) -> tuple[ResidualTest, ...]:
    """The tests of measured minus model on every usable row."""
    record, layout = problem.record, problem.layout
    residuals, inputs, regressors = [], [], []
    for experiment, trajectory in zip(record.experiments, response.trajectories, strict=True):
        first = trajectory.start
        residuals.append((experiment.outputs - trajectory.model)[first:])
        inputs.append(experiment.inputs[first:])
        alone = replace(record, experiments=(experiment,))
        regressors.append(stack_rows(alone, layout).x)
    names = ([c.name for c in record.outputs], [c.name for c in record.inputs], [str(lag) for lag in layout])
    with one_blas_thread():
        return analyse(residuals, inputs, regressors, *names, lags=LAGS)


def _errors(response: Response) -> Vector:
    """RMS error of every output over the rows with a value."""
    pieces = [(t.measured - t.model)[t.start :] for t in response.trajectories]  # type: ignore[operator]
    with np.errstate(all="ignore"):
        return np.sqrt(np.mean(np.concatenate(pieces) ** 2, axis=0))


def _ratio(free_run: Response, one_step: Response) -> float | None:
    """Geometric mean over outputs of the free run's RMS error against the one-step error."""
    free, one = _errors(free_run), _errors(one_step)
    if not (np.isfinite(free).all() and np.all(one > 0) and np.all(free > 0)):
        return None
    return float(np.exp(np.mean(np.log(free / one))))


def _instrumental_ratio(fit: Estimate, one_step: Response) -> float | None:
    """The same for physics estimated with instruments from its own free run, which sensor noise does not bias.

    `c = (ZᵀΦ)⁻¹ Zᵀ(Y − F)` with Z = φ of the simulated lags (Söderström and Stoica, Instrumental
    Variable Methods, 1983), repeated with the free run that this c gives; the learner stays as it is.
    """
    problem, model = fit.problem, fit.model
    phi = problem.projection.phi
    learner = np.concatenate([t.learner_before[t.start :] for t in one_step.trajectories])
    target = problem.whitened_target - learner * problem.weight
    best: list[float] = []
    for _ in range(_INSTRUMENT_STEPS):
        free_run = model.simulate(problem.record)
        if any(t.diverged for t in free_run.trajectories):
            break
        ratio = _ratio(free_run, one_step)
        best += [ratio] if ratio is not None else []
        instruments = _instruments(problem, free_run)
        matrix = np.tensordot(instruments, phi, axes=([0, 1], [0, 1]))
        right = np.tensordot(instruments, target, axes=([0, 1], [0, 1]))
        scale = np.sqrt(np.abs(np.outer(np.diag(matrix), np.diag(matrix))))
        if not np.all(scale > 0) or np.linalg.cond(matrix / scale) > 1e12:
            break
        c = np.linalg.solve(matrix, right)
        if not np.isfinite(c).all():
            break
        model = replace(model, numbers=model.numbers._replace(theta=c + fit.model.theta_aux))
    return min(best, default=None)


def _instruments(problem: Problem, free_run: Response) -> Any:
    """φ (N, ny, nθ), whitened, with the lagged outputs of the free run."""
    experiments = []
    for experiment, trajectory in zip(problem.record.experiments, free_run.trajectories, strict=True):
        outputs = np.where(np.isfinite(trajectory.model), trajectory.model, experiment.outputs)
        experiments.append(replace(experiment, outputs=outputs))
    x = stack_rows(replace(problem.record, experiments=tuple(experiments)), problem.layout).x
    with np.errstate(all="ignore"):
        phi = np.asarray(problem.baseline.phi(x, problem.layout, problem.outputs, np)) * problem.weight[:, None]
    return np.where(np.isfinite(phi), phi, 0.0)


def _noise_in_lags(problem: Problem, ratio: float | None, one_step: Response) -> float | None:
    """Noise variance against the smallest variance among the lagged outputs that the other regressors do not explain.

    It is the share by which one-step least squares shrinks what it estimates in that direction.
    """
    own = [j for j, lag in enumerate(problem.layout) if lag.channel in problem.outputs]
    others = [j for j in range(len(problem.layout)) if j not in own]
    noise = (_errors(one_step) * (ratio or 1.0)) ** 2
    channel = [problem.outputs.index(problem.layout[j].channel) for j in own]
    x = problem.rows.x - problem.rows.x.mean(axis=0)
    lagged = x[:, own] / np.sqrt(noise[channel])
    rest = x[:, others]
    if others:
        lagged = lagged - rest @ np.linalg.lstsq(rest, lagged, rcond=None)[0]
    smallest = float(np.linalg.eigvalsh(lagged.T @ lagged / len(lagged)).min())
    return 1.0 / smallest if smallest > 1.0 else 1.0


def _words(
    verdict: str,
    fit: Estimate,
    tests: Sequence[ResidualTest],
    ratio: float | None,
    noise: float | None,
    simulated: bool,
) -> tuple[str, tuple[str, ...]]:
    """The text of a verdict, and the warnings that intervals of θ must carry."""
    if verdict == "white":
        return "The one-step residual is white: the intervals hold, and no criterion is better than this one.", ()
    if verdict == "equation_noise":
        asked = " The one-step criterion is the more precise one here." if simulated else ""
        return f"The one-step residual is white, the free run's is not: the noise enters the equation.{asked}", ()
    colour = max((t.largest_acf or 0.0) for t in tests)
    if verdict == "sensor_noise":
        found = f"its largest autocorrelation is {colour:.2f}, and a free run comes as close (error ratio {ratio:.2f})"
        text = f"The one-step residual is coloured: {found}. That is noise on the measured output"
        if simulated:
            return f"{text}, which the simulation criterion suits.", ()
        text += '. One-step estimates of θ are then inconsistent: train with focus = "simulation"'
        if noise is not None and noise > _TOO_FAST:
            text += (
                f". The noise is {100 * noise:.0f} % of what tells the lagged outputs apart: the sampling is too fast "
                "for one-step estimation"
            )
        warning = "noise on the measured output biases the one-step θ, and its intervals do not cover that bias: "
        return f"{text}.", (f'{warning}train with focus = "simulation".',) if fit.std is not None else ()
    told = [f"its largest autocorrelation is {colour:.2f}"]
    for test in tests:
        told += [f"{test.name} still follows {name}" for name in test.correlated_inputs]
        told += [f"{test.name} is curved over {name}" for name in test.curved_regressors]
    share = max((t.rms or 0.0) * w for t, w in zip(tests, fit.problem.weight, strict=True))
    text = (
        f"The one-step residual, {100 * share:.2g} % of the output's deviation, is not white: {', '.join(told)}. "
        "Dynamics or nonlinearity are missing, or the noise is coloured. Try more lags, other learner inputs or neurons"
    )
    return f"{text}.", ()
