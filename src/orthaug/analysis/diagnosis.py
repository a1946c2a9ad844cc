"""What the residual says about the noise, and which criterion the data ask for.

Noise in the equation leaves a white one-step residual. Noise on the measured output leaves a coloured one. It makes
one-step least squares inconsistent, and a free run then explains the data as well as a prediction from measured lags.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.errors import InputError
from orthaug._base.parallel import one_blas_thread
from orthaug._base.warning import Warning
from orthaug.analysis.correlation import autocorrelation
from orthaug.analysis.residuals import ResidualTest, analyse
from orthaug.analysis.whiteness import ROWS_PER_LAG, ljung_box
from orthaug.data.regressors import Lags
from orthaug.fitting.criteria import Simulation
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.estimation import estimate
from orthaug.models.response import Response
from orthaug.physics.problem import Problem

LAGS = 25  # as MATLAB's `resid`
_PRACTICALLY_WHITE = 0.05  # correlations below this are no matter, however sure a long record makes them
_LITTLE_COLOUR = 0.2  # of a free run's errors that are noise, beside a start from noisy lags and a fit of finite length
_AS_GOOD = 1.05  # free-run error / one-step error up to which measured lags add nothing
_TOLD = 5  # findings that a text lists at most
_SHARE = 0.01  # of the residual's variance: what a regressor explains of it counts from there
_FEWEST_ROWS, _ROWS_PER_TERM = 100, 10  # rows that a sum of autocovariances needs, in all and for each of its lags
_FEWEST_BLOCKS = 20  # of which the variance of a sum can be told: its standard error is then a third of it
_MEMORIES = 3  # times as many lags as the residual's correlation lasts: Bartlett's weights fade
_LEVEL = 0.01  # of the test whether a residual is white
_ROUNDING = 1e-14  # of the output's deviation: a residual that says nothing
_TOO_FAST = 0.05  # noise variance / smallest variance among the lagged outputs

_BIASED = Warning(
    "sensor_noise",
    "noise on the measured output biases the one-step θ, and its intervals do not cover that bias: "
    'train with focus = "simulation".',
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
    warnings: tuple[Warning, ...]

    def __repr__(self) -> str:
        return f"Diagnosis({self.verdict}: {self.text})"


def diagnose(fit: Estimate, *, one_step: Response | None = None, free_run: Response | None = None) -> Diagnosis | None:
    """Analyse the residuals of a fit on its training data; None where they cannot be tested.

    A one-step fit whose residual is coloured is set beside the free run of the physics alone, trained on it: that is
    what sensor noise asks for, and it does not suffer from the bias of the fit in question.

    Args:
        one_step: the prediction of the training data, if it is there already; likewise their `free_run`.
    """
    problem, model, simulated = fit.problem, fit.model, fit.criterion.flown is not None
    one_step = model.predict(problem.record) if one_step is None else one_step
    tests = _tests(problem, one_step)
    if any(test.white is None for test in tests) or np.all(_errors(one_step) / problem.deviation < _ROUNDING):
        return None
    white = all(_is_white(test, _PRACTICALLY_WHITE) for test in tests)
    complete = white and not any(_misfits(test) for test in tests)
    if not model.form.states:
        return _static(fit, tests, white, complete)
    free_run = model.simulate(problem.record) if free_run is None else free_run
    skip = fit.criterion.washout
    flown = [(free_run, skip)] if not any(t.diverged for t in free_run.trajectories) else []
    free_tests = _tests(problem, free_run, skip) if flown else None
    if not simulated and not white:
        flown += _physics_flown(fit)
    ratios = [_ratio(run, one_step, first) for run, first in flown]
    good = [
        ratio
        for ratio, (run, first) in zip(ratios, flown, strict=True)
        if ratio and ratio < _AS_GOOD and _accounts(problem, run, first)
    ]
    sensor = not white and bool(good)
    ratio = min(good) if sensor else ratios[0] if ratios else None
    noise = _noise_in_lags(problem, ratio, one_step) if sensor else None
    free_white = free_tests is not None and all(_is_white(test, _PRACTICALLY_WHITE) for test in free_tests)
    verdict = ("white" if free_white else "equation_noise") if complete else "sensor_noise" if sensor else "unmodelled"
    text, warnings = _words(verdict, fit, tests, ratio, noise, simulated)
    robust = fit.plain_covariance is not None
    if fit.std is not None and not warnings and not robust and not (free_white if simulated else white):
        warnings = (_coloured("errors of the free run are" if simulated else "one-step residual is"),)
    return Diagnosis(verdict, text, tests, free_tests, ratio, noise, warnings)


def robust_where_coloured(fit: Estimate, response: Response) -> Estimate:
    """The fit with robust standard errors, where it leaves a coloured residual: Newey and West, or batch means.

    `response` is the prediction of the training rows. Few rows, or ones that remember each other for long, leave the
    plain errors: their robust ones would be too small.
    """
    if not fit.status.ok or fit.covariance is None or fit.at_bound:
        return fit
    lags = _memory(fit, response) if fit.criterion.flown is None else _block(fit)
    if lags is None or len(fit.problem.rows) < max(_FEWEST_ROWS, _ROWS_PER_TERM * lags):
        return fit
    try:
        return fit.robust(lags)
    except InputError:  # an ensemble, or a fit without statistics
        return fit


def _memory(fit: Estimate, response: Response) -> int | None:
    """Lags for the one-step residual; None where it is white, or rounding."""
    memory = 0
    if np.all(_errors(response) / fit.problem.deviation < _ROUNDING):
        return None
    for i in range(len(fit.problem.outputs)):
        pieces = [(t.measured - t.model)[t.start :, i] for t in response.trajectories]  # type: ignore[operator]
        if _is_coloured(pieces):
            rows = sum(map(len, pieces))
            acf = np.asarray(autocorrelation(pieces, rows // ROWS_PER_LAG))
            quiet = np.abs(acf) < 2 / np.sqrt(rows)
            memory = max(memory, int(np.argmax(np.append(quiet, True))))
    return _MEMORIES * memory or None


def _block(fit: Estimate) -> int | None:
    """Steps of a block for the errors of the free run; None where these are white, or leave too few blocks."""
    if fit.scores is None:
        return None
    errors = fit.scores.errors()  # (ny, segments, steps), 0 where a step is not scored
    size = np.sqrt(np.sum(errors**2, axis=(1, 2)) / max(fit.scores.segments.count, 1))
    if not np.isfinite(size).all() or np.all(size / fit.problem.deviation < _ROUNDING):
        return None
    if not any(_is_coloured([one[one != 0] for one in output]) for output in errors):
        return None
    steps = fit.scores.block()
    if steps is None or steps > fit.scores.longest or fit.scores.segments.count < _FEWEST_BLOCKS * steps:
        return None
    return steps


def _is_coloured(pieces: list[Vector]) -> bool:
    """Whether Ljung-Box rejects a white residual and a correlation is large enough to matter."""
    box, acf = ljung_box(pieces, LAGS), autocorrelation(pieces, sum(map(len, pieces)) // ROWS_PER_LAG)
    return box is not None and acf is not None and box.p < _LEVEL and np.abs(acf[1:]).max() >= _PRACTICALLY_WHITE


def _static(fit: Estimate, tests: tuple[ResidualTest, ...], white: bool, complete: bool) -> Diagnosis:
    """The diagnosis of a model without past outputs."""
    verdict = "white" if complete else "unmodelled"
    text, warnings = _words(verdict, fit, tests, None, None, False)
    if fit.std is not None and fit.plain_covariance is None and not white:
        warnings = (_coloured("one-step residual is"),)
    return Diagnosis(verdict, text, tests, None, None, None, warnings)


def _coloured(what: str) -> Warning:
    told = f"standard errors of θ are those of a white residual, but the {what} coloured: take them for a rough guide."
    return Warning("coloured_residual", told)


def _is_white(test: ResidualTest, small: float) -> bool:
    """White by Ljung-Box, or with correlations too small to matter."""
    return test.white is not False or test.largest_acf is None or test.largest_acf < small


def _follows(test: ResidualTest, small: float) -> list[str]:
    """Inputs that the residual follows, surely and by enough to matter."""
    return [name for name in test.correlated_inputs if (t := test.cross[name]) and abs(t.largest) > small]


def _misfits(test: ResidualTest) -> list[str]:
    """Inputs and regressors that the residual still follows."""
    curved = [name for name in test.curved_regressors if (t := test.regressors[name]) and t.share > _SHARE]
    return _follows(test, _PRACTICALLY_WHITE) + curved


def _accounts(problem: Problem, free_run: Response, skip: int) -> bool:
    """Whether the errors of a free run look like noise on a sensor: white enough, and not following the inputs."""
    tests = _tests(problem, free_run, skip)
    return all(_is_white(test, _LITTLE_COLOUR) and not _follows(test, 2 * _PRACTICALLY_WHITE) for test in tests)


def _physics_flown(fit: Estimate) -> list[tuple[Response, int]]:
    """The free run of the physics alone, trained on the free run; with the rows to skip."""
    problem, criterion = fit.problem, Simulation()
    longest = max(len(e) for e in problem.record.experiments) - fit.model.form.first_row
    if longest <= 2 * criterion.washout:
        criterion = Simulation(segment=0, washout=0)
    physics = estimate(problem.record, problem.baseline, lags=_lags_of(fit), learner=None, criterion=criterion)
    if not physics.status.ok:
        return []
    run = physics.model.simulate(problem.record)
    return [] if any(t.diverged for t in run.trajectories) else [(run, criterion.washout)]


def _lags_of(fit: Estimate) -> Lags | None:
    """The lags that a baseline function needs; terms know their own."""
    if fit.problem.baseline.function is None:
        return None
    layout, outputs = fit.problem.layout, fit.problem.outputs
    reach = {name: [lag.lag for lag in layout if lag.channel == name] for name in dict.fromkeys(c for c, _ in layout)}
    inputs = [c.name for c in fit.problem.record.inputs]
    return Lags(
        na=[len(reach.get(name, [])) for name in outputs],
        nb=[len(reach.get(name, [])) for name in inputs],
        nk=[min(reach.get(name, [0])) for name in inputs],
    )


def _tests(problem: Problem, response: Response, skip: int = 0) -> tuple[ResidualTest, ...]:
    """The tests of measured minus model on every usable row of the problem after the first `skip`."""
    record, start = problem.record, problem.rows.start
    ends = np.cumsum([len(experiment) - start for experiment in record.experiments])
    residuals, inputs = [], []
    for experiment, trajectory in zip(record.experiments, response.trajectories, strict=True):
        residuals.append((experiment.outputs - trajectory.model)[start:][skip:])
        inputs.append(experiment.inputs[start:][skip:])
    regressors = [x[skip:] for x in np.split(problem.rows.x, ends[:-1])]
    names = ([c.name for c in record.outputs], [c.name for c in record.inputs], [str(lag) for lag in problem.layout])
    with one_blas_thread():
        return analyse(residuals, inputs, regressors, *names, lags=LAGS)


def _errors(response: Response, skip: int = 0) -> Vector:
    """RMS error of every output over the rows with a value, without the first `skip` of them."""
    pieces = [(t.measured - t.model)[t.start :][skip:] for t in response.trajectories]  # type: ignore[operator]
    with np.errstate(all="ignore"):
        return np.sqrt(np.mean(np.concatenate(pieces) ** 2, axis=0))


def _ratio(free_run: Response, one_step: Response, skip: int) -> float | None:
    """Geometric mean over outputs of the free run's RMS error against the one-step error."""
    free, one = _errors(free_run, skip), _errors(one_step, skip)
    if not (np.isfinite(free).all() and np.all(one > 0) and np.all(free > 0)):
        return None
    return float(np.exp(np.mean(np.log(free / one))))


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
) -> tuple[str, tuple[Warning, ...]]:
    """The text of a verdict, and the warnings that intervals of θ must carry."""
    if verdict == "white":
        return "The one-step residual is white: the intervals hold, and no criterion is better than this one.", ()
    if verdict == "equation_noise":
        asked = " The one-step criterion is the more precise one here." if simulated else ""
        return f"The one-step residual is white, the free run's is not: the noise enters the equation.{asked}", ()
    colour = max((t.largest_acf or 0.0) for t in tests)
    if verdict == "sensor_noise":
        closer = "as close" if ratio is None or ratio > 0.95 else f"{1 / ratio:.1f} times closer"
        own = "the free run is" if simulated else "the physics trained on the free run comes"
        how = f"its largest autocorrelation is {colour:.2f}, and {own} {closer} without measured lags"
        text = f"The one-step residual is coloured: {how}. That is noise on the measured output"
        if simulated:
            return f"{text}, which the simulation criterion suits.", ()
        text += '. One-step estimates of θ are then inconsistent: train with focus = "simulation"'
        if noise is not None and noise > _TOO_FAST:
            text += (
                f". The noise is {100 * noise:.0f} % of what tells the lagged outputs apart: the sampling is too fast "
                "for one-step estimation"
            )
        return f"{text}.", (_BIASED,) if fit.std is not None else ()
    told = [f"its largest autocorrelation is {colour:.2f}"]
    for test in tests:
        told += [f"the residual of {test.name} still follows {name}" for name in test.correlated_inputs]
        told += [f"the residual of {test.name} is curved over {name}" for name in test.curved_regressors]
    told = [*told[:_TOLD], *(["and more"] if len(told) > _TOLD else [])]
    share = max((t.rms or 0.0) / d for t, d in zip(tests, fit.problem.deviation, strict=True))
    text = (
        f"The one-step residual, {100 * share:.2g} % of the output's deviation, is not noise alone: {'; '.join(told)}. "
        "Dynamics or nonlinearity are missing, or the noise is coloured. Try more lags, other learner inputs or neurons"
    )
    return f"{text}.", ()
