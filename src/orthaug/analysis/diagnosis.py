"""Diagnosis of a fit by its residual: the kind of noise, the right criterion, and useful changes.

Noise in the equation leaves a white one-step residual. Noise on the measured output leaves a
coloured one. It makes one-step least squares inconsistent, and a free run then explains the data as
well as a prediction from measured lags. With many rows every test rejects; so effects are measured,
as shares of variance that could be predicted.

The criterion of a motion is right for white noise on its outputs. Coloured errors of its free run
that follow no input and no state are noise within the motion; errors that do are physics that is
missing, or that the learner does not see. Simple terms, each tried in each equation, show what it
is (`missing_terms`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import singledispatch
from typing import Any

import numpy as np
from jaxtyping import Bool

from orthaug._base.checks import Matrix, check_type, positive
from orthaug._base.errors import InputError, Warning
from orthaug._base.lines import join_words, percent
from orthaug._base.parallel import one_blas_thread
from orthaug.analysis.changes import Change, fall_of, model_changes, own_share
from orthaug.analysis.closed_loop import feedback_in
from orthaug.analysis.exchanged_inputs import exchanged_inputs, misread_inputs
from orthaug.analysis.input_timing import LateInput, find_late_inputs, on_longest
from orthaug.analysis.missing_terms import missing_terms
from orthaug.analysis.predictability import Predictable, from_lags, from_own_past, predictable
from orthaug.analysis.quantised_output import coarse_steps, quantised_output
from orthaug.analysis.residuals import (
    LAGS,
    ROUNDING,
    ResidualTest,
    analyse,
    errors_of,
    measured_of,
    rms_errors,
)
from orthaug.analysis.trained_start import from_trained_start
from orthaug.analysis.verdict_text import (
    SHARE,
    Diagnosis,
    Finding,
    colour_sentence,
    free_run_words,
    words,
)
from orthaug.analysis.wild_rows import wild_rows
from orthaug.data.columns import Column
from orthaug.data.gaps import SATURATED, saturated_outputs
from orthaug.data.record import Record
from orthaug.data.regressors import Lags
from orthaug.fitting.criteria import Simulation
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.estimation import estimate
from orthaug.fitting.inconsistency import inconsistency
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.fitting.motion_task import MotionTask
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Orthogonal
from orthaug.inference.covariance import by_experiment
from orthaug.models.response import Response
from orthaug.physics.problem import Problem

# Of a free run's errors that are noise, beside a start from noisy lags and a fit of finite length
_LITTLE_COLOUR = 0.2
_LITTLE_FOLLOWED = 0.1  # correlation of such errors with an input
_AS_GOOD = 1.05  # free-run error / one-step error up to which measured lags add nothing
_SMALL = 0.05  # of the residual's variance: what could be predicted below that is a small effect
_SLIGHT = 0.01  # of it, by one missing term: less is not worth naming
_SMALL_SIZE = 0.05  # of the output's deviation, beside it
_SMALL_COLOUR = 0.2  # the same of what a free run's own past explains: more is hardly noise
_DRIFTS = 0.5  # of the variance of a free run's error: a straight line
_LINE = 50  # rows, from which on a straight line is one
_LEVEL = 0.01  # of the test of missing terms
# Of the output's deviation: a free run that leaves less has no dead time to look for
_SIZABLE = 0.02
# Of the squared error in rows at an input's limit and the next few: this share, and so many times
# that of the rows
_AT_LIMITS, _OFTENER, _NEXT = 0.5, 2.0, 3
_FEWEST_COMPLETE = 30  # rows with all outputs, to test residuals
_LAGS = 10  # of inputs that may predict the error
_ROWS_PER_LAG = 20
_UNCOUNTED = "Intervals cover noise only: missing physics may have moved the parameters by more."
_MOVED = "Missing physics may have moved the parameters."


def diagnose(
    fit: Estimate,
    *,
    one_step: Response | None = None,
    free_run: Response | None = None,
) -> Diagnosis | None:
    """Analyse the residuals of a fit on its training data; None where they cannot be tested.

    Lagged physics is tested one step ahead and on the free run; a motion on its free run, since its
    states are not measured, with a test of the terms that its equations could lack (`missing`);
    under a noise model of innovations on these.

    Args:
        one_step: the prediction of the training data, if it is there already; likewise their
            `free_run`.

    Raises:
        InputError: an estimate that is not usable.

    Examples:
        >>> import numpy as np
        >>> import orthaug as oa
        >>> u = np.random.default_rng(0).uniform(-1, 1, 300)
        >>> noise = 0.05 * np.random.default_rng(1).normal(size=300)
        >>> record = oa.Record.from_arrays(u, 2 * u + u**3 + noise)
        >>> gain = oa.Baseline.from_terms([oa.Term("gain", "u[k]")])
        >>> diagnose(oa.estimate(record, gain, learner=None)).verdict
        'unmodelled'
    """
    check_type(fit, Estimate, "fit", "an Estimate")
    return _diagnosis(fit, one_step, free_run)


@singledispatch
def _diagnosis(
    fit: Estimate, one_step: Response | None, free_run: Response | None
) -> Diagnosis | None:
    """Return the diagnosis of a kind of physics."""
    raise NotImplementedError


def _states(fit: MotionEstimate) -> list[Matrix]:
    """Return the states (N, nx) of every experiment: of the free run, or of the predictor."""
    record = fit.problem.record
    if fit.model.coloured:
        numbers = fit.model.numbers
        c = np.asarray(numbers.c)
        return fit.segmented.states_by_row(c, numbers.weights, fit.states)
    frame = fit.model.states(record)
    ends = np.cumsum([len(e) for e in record.experiments])[:-1]
    return np.split(frame[list(fit.problem.motion.names_of_states)].to_numpy(), ends)


@_diagnosis.register(MotionEstimate)
def _of_motion(
    fit: MotionEstimate, one_step: Response | None, free_run: Response | None
) -> Diagnosis | None:
    """Return the diagnosis by the free run's errors on the training data.

    None where it ran away, or leaves rounding only.
    """
    if not fit.status.ok:
        raise InputError(f"`fit` has no model: {fit.status.message}.")
    if fit.model.coloured:  # a free run of what process noise moved leaves more than innovations
        free_run = one_step or fit.model.predict(fit.problem.record)
    free_run = fit.model.simulate(fit.problem.record) if free_run is None else free_run
    record, motion = fit.problem.record, fit.problem.motion
    if np.all(rms_errors(free_run) / fit.problem.deviation < ROUNDING):
        return None
    restarted = from_trained_start(fit, free_run)
    free_run = free_run if restarted is None else restarted[0].response
    if any(run.diverged for run in free_run.trajectories):
        return None
    coarse = quantised_output(fit, free_run)
    errors = errors_of(free_run) if coarse is None else coarse.left
    firsts = [run.start for run in free_run.trajectories]
    inputs = [e.inputs[first:] for e, first in zip(record.experiments, firsts, strict=True)]
    along = (restarted and restarted[0].states) or _states(fit)
    states = [own[first:] for own, first in zip(along, firsts, strict=True)]
    if not np.isfinite(np.concatenate(states)).all():
        return None
    if not record.complete:  # tests of several outputs need them on the same rows
        there = [~np.isnan(own).any(axis=1) for own in measured_of(free_run)]
        errors, inputs, states = (
            [own[rows] for own, rows in zip(parts, there, strict=True)]
            for parts in (errors, inputs, states)
        )
        if sum(map(len, errors)) < _FEWEST_COMPLETE:
            return None
    names = ([c.name for c in record.outputs], list(motion.external), list(motion.names_of_states))
    with one_blas_thread():
        tests = analyse(errors, inputs, states, *names, lags=LAGS)
        if (
            not record.complete and coarse is None
        ):  # as scores have it: of all rows with this output
            pairs = zip(tests, rms_errors(free_run), strict=True)
            tests = tuple(replace(test, rms=float(rms)) for test, rms in pairs)
        shares = tuple(_predictable(i, test, errors, inputs) for i, test in enumerate(tests))
        missing = missing_terms(fit) if coarse is None else None
        if coarse is not None and any(test.white is None for test in tests):
            coarse = replace(coarse, whole=True)  # no more than a row here and there is left
            tests = analyse(errors_of(free_run), inputs, states, *names, lags=LAGS)
    if any(test.white is None for test in tests):
        return None
    followed = {test.name: test.follows() for test in tests if test.follows()}
    curved = {test.name: test.curved_over(_SMALL) for test in tests if test.curved_over(_SMALL)}
    lacks = missing if missing is not None and missing.found(_LEVEL, _SMALL) else None
    several = missing if missing is not None and missing.scattered else None
    slight = missing if missing is not None and missing.found(_LEVEL, _SLIGHT) else None
    explained = any(share.inputs > _SMALL for share in shares) or bool(curved)
    explained = explained or lacks is not None or several is not None
    white = all(test.practically_white() for test in tests)
    if coarse is not None and coarse.whole:
        white, explained = True, False
    size = rms_errors(free_run) / fit.problem.deviation
    looked = motion.inputs and motion.source is None  # physics of a file takes minutes for that
    late: tuple[LateInput, ...] = ()
    misread: tuple[Warning, ...] = ()
    if looked and (explained or not white) and np.any(size > _SIZABLE):
        task, solver = _physics_alone(fit)
        misread = misread_inputs(task, solver)
        late = () if misread else find_late_inputs(task, solver)
    explained = explained or bool(late or misread)
    verdict = "unmodelled" if explained else "white" if white else "equation_noise"
    limits = "" if white else _at_limits(record, free_run, errors, inputs, motion.held)
    lacking = (lacks or several, late, coarse, slight, misread, limits, missing)
    text = free_run_words(verdict, fit, tests, shares, followed, curved, *lacking)
    warnings = [restarted[1]] if restarted and restarted[1] else []
    warnings += [*misread, *(one.warning for one in late)]
    warnings += [coarse.warning] if coarse and coarse.warning else []
    slow = not white and not fit.model.coloured and lacks is None  # what is missing may drift
    warnings += find_drift(free_run, "innovations") if slow else []
    wild = wild_rows(free_run, record, free_run=not fit.model.coloured)
    warnings += [one.warning for one in wild]
    if not white:
        given = fit.std is not None and bool(np.isfinite(fit.std).any())
        more = f" {_UNCOUNTED if given else _MOVED}" if explained else ""
        warnings.append(Warning("coloured_residual", colour_sentence(fit) + more))
    found = (verdict, text, (), tests, None, None, tuple(warnings), shares, (), missing)
    return Diagnosis(*found, late=late, steps=coarse.steps if coarse else None)


def _at_limits(
    record: Record,
    response: Response,
    errors: list[Matrix],
    inputs: list[Matrix],
    limited: Sequence[str] = (),
) -> str:
    """Return sentences on samples at a limit, which look like missing terms; "" without any.

    Those of outputs count where the model goes beyond, those of inputs where most of the squared
    error is in the rows at the limit.

    Args:
        record: of the training.
        response: its outputs by the model.
        errors: of the model (N, ny) by experiment.
        inputs: likewise.
        limited: names of outputs whose limits are known.
    """
    whole = record.complete and len(response.model) == len(record)
    ended = saturated_outputs(record, response.model, limited) if whole else []
    if ended:
        rows = join_words([f"{one.output} is {one.rows} of the rows" for one in ended])
        return (
            f"First look at samples at a limit: {rows}, and the model goes beyond. A sensor that "
            "ends there leaves errors that look like missing terms. Mark these samples as missing "
            '(step = "limits" of data.prepare) and fit again before you add a term.'
        )
    scale = positive(np.concatenate(errors).std(axis=0))
    for j, channel in enumerate(record.inputs):
        own = [piece[:, j] for piece in inputs]
        column = Column(channel.name, channel.name, channel.unit, np.concatenate(own))
        ends = [value for value, rows in column.limits if rows >= SATURATED * len(column.values)]
        near = [_after(np.isin(piece, ends)) for piece in own]
        squares = [np.sum((piece / scale) ** 2, axis=1) for piece in errors]
        share = sum(float(s[n].sum()) for s, n in zip(squares, near, strict=True)) / sum(
            float(s.sum()) for s in squares
        )
        if ends and share > max(_AT_LIMITS, _OFTENER * float(np.concatenate(near).mean())):
            values = join_words([f"{end:.6g} {channel.unit}".strip() for end in ends])
            return (
                f"First look at samples at a limit: the rows in which {channel.name} is {values}, "
                f"and the next {_NEXT}, have {percent(share)} of the error's mean square. If its "
                "sensor ends there, the true input was larger. Leave these stretches out and fit "
                "again before you add a term."
            )
    return ""


def _after(there: Bool[np.ndarray, "N"]) -> Bool[np.ndarray, "N"]:
    """Return the rows that are there, and the next few."""
    return np.convolve(there, np.ones(1 + _NEXT))[: len(there)] > 0


def _physics_alone(fit: MotionEstimate) -> tuple[MotionTask, LevenbergMarquardt]:
    """Return the physics trained before the learner on the longest experiment, and by what.

    It runs in the same compiled programs.
    """
    solver, posed = LevenbergMarquardt().within_limit, fit.problem
    posed = posed if fit.learns else posed.without_learner()
    learner = fit.model.form.bound.learner
    known = np.asarray(fit.alone)
    return on_longest(posed, fit.criterion, solver, Orthogonal(), learner, known), solver


def _predictable(
    i: int, test: ResidualTest, errors: list[Matrix], inputs: list[Matrix]
) -> Predictable:
    """Return the predictable shares of an output's error.

    Its own past, lagged inputs and functions of states predict it.
    """
    signal = [piece[:, i] for piece in errors]
    longest = min(_LAGS, min(map(len, signal)) // _ROWS_PER_LAG)
    own = from_own_past(signal, max(longest, 1))
    driven = [
        [u[:, j] for u in inputs] for j in range(inputs[0].shape[1])
    ]  # of each input its experiments
    from_inputs = [from_lags(signal, [one], range(longest + 1)) for one in driven]
    best = max((share.sure for share in from_inputs), default=0.0)
    return Predictable(
        test.name, float(test.rms or 0.0), own.sure, best, float(test.largest_share or 0.0)
    )


@_diagnosis.register(LaggedEstimate)
def _of_lagged(
    fit: LaggedEstimate, one_step: Response | None, free_run: Response | None
) -> Diagnosis | None:
    """Return the diagnosis of lagged physics by its one-step residual and its free run.

    A one-step fit whose residual is coloured is set beside the free run of the physics alone,
    trained on it: that is what sensor noise asks for, and it does not suffer from the bias of the
    fit in question.
    """
    problem, model, simulated = fit.problem, fit.model, fit.criterion.free_run is not None
    one_step = model.predict(problem.record) if one_step is None else one_step
    tests = _tests(problem, one_step)
    if any(test.white is None for test in tests) or np.all(
        rms_errors(one_step) / problem.deviation < ROUNDING
    ):
        return None
    white = all(test.practically_white() for test in tests)
    seen = Finding(
        fit, simulated, one_step, tests, white=white, free_white=True, ratio=None, noise=None
    )
    seen = replace(seen, steps={} if white else _steps(problem, tests))
    if not model.form.states:
        return _conclude(replace(seen, **_effects(fit, one_step, one_step, False)), None)
    free_run = model.simulate(problem.record) if free_run is None else free_run
    skip, restarted = fit.criterion.washout, from_trained_start(fit, free_run)
    free_run = free_run if restarted is None else restarted[0].response
    free_runs = [(free_run, skip)] if not any(t.diverged for t in free_run.trajectories) else []
    free_tests = _tests(problem, free_run, skip) if free_runs else None
    trained = _physics_runs(fit) if not simulated and not white else []
    ratios = [_ratio(run, one_step, first) for run, first in free_runs + trained]
    good = [
        ratio
        for ratio, (run, first) in zip(ratios, free_runs + trained, strict=True)
        if ratio and ratio < _AS_GOOD and _accounts(problem, run, first)
    ]
    sensor = not white and bool(good)
    ratio = min(good) if sensor else ratios[0] if ratios else None
    seen = replace(
        seen,
        sensor=sensor,
        ratio=ratio,
        noise=_noise_in_lags(problem, ratio, one_step) if sensor else None,
        free_white=free_tests is not None and all(test.practically_white() for test in free_tests),
        free_tests=free_tests,
        **_effects(fit, one_step, free_run if free_runs else None, fit.criterion.simulates),
        inconsistent=None
        if sensor or seen.steps
        else _inconsistent(fit, one_step, free_run if free_runs else None),
    )
    if not simulated and not white:
        seen = replace(
            seen, changes=_with_criterion(seen, free_run if free_runs else None, trained)
        )
    found = _conclude(seen, free_run if free_runs else None)
    more = (restarted[1],) if restarted and restarted[1] else ()
    more += exchanged_inputs(problem) if found.verdict == "unmodelled" else ()
    return replace(found, warnings=(*more, *found.warnings))


def _conclude(seen: Finding, free_run: Response | None) -> Diagnosis:
    """Return the verdict and its words."""
    misfit = any(t.follows() or t.curved_over(SHARE) for t in seen.tests) or seen.lacks
    if (
        not seen.fit.criterion.simulates
    ):  # errors along a free run are slow, and look like functions of what is slow
        misfit = misfit or any(one.functions > _SMALL for one in seen.predictable)
    complete = seen.white and not misfit and not seen.follows(_SMALL)
    white = (seen.free_white and seen.white) or not seen.fit.model.form.states
    if seen.sensor:
        verdict = "sensor_noise"
    elif complete or _is_small(seen):
        verdict = "white" if white else "equation_noise"
    else:
        verdict = "unmodelled"
    seen = replace(seen, complete=complete)
    if verdict == "equation_noise" and seen.fit.criterion.simulates and seen.white:
        seen = replace(seen, changes=_toward_prediction(seen))
    record = seen.fit.problem.record
    wild = wild_rows(seen.one_step, record)
    if not wild and free_run is not None:
        wild = wild_rows(free_run, record, free_run=True)
    if wild:  # a larger learner would follow them
        seen = replace(
            seen, changes=tuple(change for change in seen.changes if change.kind != "learner")
        )
    if verdict != "white" and not seen.steps:
        minimised = free_run if seen.own is not seen.tests and free_run else seen.one_step
        firsts = [run.start for run in minimised.trajectories]
        inputs = [e.inputs[first:] for e, first in zip(record.experiments, firsts, strict=True)]
        seen = replace(seen, limits=_at_limits(record, minimised, errors_of(minimised), inputs))
    text, warnings = words(verdict, seen)
    described = seen.fit.model.coloured or (white and complete)
    drift = () if described or free_run is None else find_drift(free_run, "auto")
    warnings = (*(one.warning for one in wild), *drift, *warnings)
    tested = seen.tests, seen.free_tests, seen.ratio, seen.noise
    return Diagnosis(
        verdict, text, *tested, warnings, seen.predictable, seen.changes, steps=seen.steps or None
    )


def _inconsistent(
    fit: LaggedEstimate, one_step: Response, free_run: Response | None
) -> Warning | None:
    """Return the warning that coloured errors move the one-step θ.

    None where they do not, as far as is seen.
    """
    with one_blas_thread():
        found = inconsistency(fit, one_step, free_run)
    if found is None or not found.found:
        return None
    return found.warning(looped=bool(feedback_in(fit.problem.record)))


def _steps(problem: Problem, tests: tuple[ResidualTest, ...]) -> dict[str, float]:
    """Return the steps of outputs that are recorded in steps as large as the one-step error."""
    steps = coarse_steps(problem.record, np.array([test.rms or np.nan for test in tests]))
    return {test.name: float(step) for test, step in zip(tests, steps, strict=True) if step}


def _is_small(seen: Finding) -> bool:
    """Return whether what could be predicted is a small effect: no change is worth making."""
    if seen.lacks or not seen.predictable or seen.drifts or seen.follows(_SMALL):
        return False
    shares = [one.largest(own_past=not seen.simulated) for one in seen.predictable]
    unit = zip(seen.predictable, seen.fit.problem.deviation, strict=True)
    rms = np.array([one.rms / deviation for one, deviation in unit])
    colour = np.array([one.own_past for one in seen.predictable])
    small = bool(
        np.all(np.sqrt(shares) * rms < _SMALL_SIZE)
        and np.all(np.sqrt(colour) * rms < _SMALL_COLOUR)
    )
    return max(shares) < _SMALL and small


def _effects(
    fit: LaggedEstimate, one_step: Response, free_run: Response | None, simulates: bool
) -> dict:
    """Return the predictable shares of the minimised error, and the changes that would use them."""
    response, skip = (free_run, fit.criterion.washout) if simulates else (one_step, 0)
    several = fit.criterion.free_run is not None and not fit.criterion.simulates
    if response is None or several:  # it ran away, or is the error of some steps ahead
        return {}
    with one_blas_thread():
        shares = predictable(fit.problem, response, skip, simulates=simulates)
    squares = [
        (one.rms / deviation) ** 2
        for one, deviation in zip(shares, fit.problem.deviation, strict=True)
    ]
    functions = (
        0.0 if simulates else float(np.average([one.functions for one in shares], weights=squares))
    )
    known: dict[str, Any] = {
        "simulates": simulates,
        "skip": skip,
        "one_step": one_step,
        "functions": functions,
    }
    return {"predictable": shares, "changes": model_changes(fit, response, **known)}


def _with_criterion(
    seen: Finding, free_run: Response | None, trained: list[tuple[Response, int]]
) -> tuple[Change, ...]:
    """Return the changes of a one-step fit, with the change of criterion.

    It comes first where noise is on the sensor, else only if there is no other. Under feedback it
    is no remedy.
    """
    if not trained or seen.looped:
        return seen.changes
    (run, skip), unit = trained[0], seen.fit.problem.deviation
    after = float(np.mean((rms_errors(run, skip) / unit) ** 2))
    before = (
        np.inf if free_run is None else float(np.mean((rms_errors(free_run, skip) / unit) ** 2))
    )
    share = 1 - after / before
    change = (Change("criterion", "simulation", fall_of(share), "simulation"),)
    if seen.sensor:
        return change + seen.changes
    return seen.changes or (change if share >= _SMALL else ())


def _toward_prediction(seen: Finding) -> tuple[Change, ...]:
    """Return one step ahead instead of the free run, where its θ would predict better."""
    share = own_share(seen.fit, seen.one_step)
    if share.value < _SMALL or not share.sure:
        return ()
    return (Change("criterion", "prediction", fall_of(share.value), "prediction"),)


def _accounts(problem: Problem, free_run: Response, skip: int) -> bool:
    """Return whether a free run's errors look like sensor noise: white, unrelated to inputs."""
    tests = _tests(problem, free_run, skip)
    return all(
        test.practically_white(_LITTLE_COLOUR) and not test.follows(_LITTLE_FOLLOWED)
        for test in tests
    )


def _physics_runs(fit: LaggedEstimate) -> list[tuple[Response, int]]:
    """Return the free run of the physics alone, trained on the free run; with the rows to skip."""
    problem, criterion = fit.problem, Simulation()
    longest = max(len(e) for e in problem.record.experiments) - fit.model.form.first_row
    if longest <= 2 * criterion.washout:
        criterion = Simulation(segment=0, washout=0)
    physics = estimate(
        problem.record, problem.baseline, lags=_lags_of(fit), learner=None, criterion=criterion
    )
    if not physics.status.ok:
        return []
    run = physics.model.simulate(problem.record)
    return [] if any(t.diverged for t in run.trajectories) else [(run, criterion.washout)]


def _lags_of(fit: LaggedEstimate) -> Lags | None:
    """Return the lags that a baseline function needs; terms know their own."""
    if fit.problem.baseline.function is None:
        return None
    layout, outputs = fit.problem.layout, fit.problem.outputs
    reach = {
        name: [lag.lag for lag in layout if lag.channel == name]
        for name in dict.fromkeys(c for c, _ in layout)
    }
    inputs = [c.name for c in fit.problem.record.inputs]
    return Lags(
        na=[len(reach.get(name, [])) for name in outputs],
        nb=[len(reach.get(name, [])) for name in inputs],
        nk=[min(reach.get(name, [0])) for name in inputs],
    )


def _tests(problem: Problem, response: Response, skip: int = 0) -> tuple[ResidualTest, ...]:
    """Return the tests of measured minus model on every usable row after the first `skip`."""
    record, start = problem.record, problem.rows.start
    residuals, inputs = [], []
    for experiment, trajectory in zip(record.experiments, response.trajectories, strict=True):
        residuals.append((experiment.outputs - trajectory.model)[start:][skip:])
        inputs.append(experiment.inputs[start:][skip:])
    regressors = [x[skip:] for x in by_experiment(problem, problem.rows.x)]
    names = (
        [c.name for c in record.outputs],
        [c.name for c in record.inputs],
        [str(lag) for lag in problem.layout],
    )
    with one_blas_thread():
        return analyse(residuals, inputs, regressors, *names, lags=LAGS)


def _ratio(free_run: Response, one_step: Response, skip: int) -> float | None:
    """Return the free run's RMS error over the one-step error, the geometric mean over outputs."""
    free, one = rms_errors(free_run, skip), rms_errors(one_step, skip)
    if not (np.isfinite(free).all() and np.all(one > 0) and np.all(free > 0)):
        return None
    return float(np.exp(np.mean(np.log(free / one))))


def _noise_in_lags(problem: Problem, ratio: float | None, one_step: Response) -> float | None:
    """Return the noise variance over the least variance of lagged outputs beside other regressors.

    It is the share by which one-step least squares shrinks what it estimates in that direction.
    """
    own = [j for j, lag in enumerate(problem.layout) if lag.channel in problem.outputs]
    others = [j for j in range(len(problem.layout)) if j not in own]
    noise = (rms_errors(one_step) * (ratio or 1.0)) ** 2
    channel = [problem.outputs.index(problem.layout[j].channel) for j in own]
    x = problem.rows.x - problem.rows.x.mean(axis=0)
    lagged = x[:, own] / np.sqrt(noise[channel])
    rest = x[:, others]
    if others:
        lagged = lagged - rest @ np.linalg.lstsq(rest, lagged, rcond=None)[0]
    smallest = float(np.linalg.eigvalsh(lagged.T @ lagged / len(lagged)).min())
    return 1.0 / smallest if smallest > 1.0 else 1.0


def find_drift(response: Response, kind: str) -> tuple[Warning, ...]:
    """Return a warning for each output whose free-run error is mostly a straight line over time.

    Args:
        kind: the noise model that describes slow disturbances of such a fit.
    """
    found = []
    for j, output in enumerate(response.outputs):
        squares, lines, ends = 0.0, 0.0, (0.0, 0.0)
        for piece in (piece[:, j] for piece in errors_of(response) if len(piece) > _LINE):
            there = ~np.isnan(piece)
            if there.sum() <= _LINE:
                continue
            time, error = np.linspace(-1.0, 1.0, len(piece))[there], piece[there]
            time = time if there.all() else time - time.mean()
            slope = float(time @ error / (time @ time))
            squares += float(np.sum((error - error.mean()) ** 2))
            lines += slope**2 * float(time @ time)
            ends = max(ends, (error.mean() - slope, error.mean() + slope), key=np.ptp)
        if lines > _DRIFTS * squares > 0:
            unit = f" {output.unit}" if output.unit else ""
            text = (
                f"the error of the free run of {output.name} drifts: a straight line over time "
                f"makes up {percent(lines / squares)} of its variance, from {ends[0]:.3g} to "
                f"{ends[1]:.3g}{unit}. A sensor or a load may change slowly: describe it by "
                f'`noise.model` = "{kind}", or measure what causes it. It may bias the parameters.'
            )
            found.append(Warning("drift", text))
    return tuple(found)
