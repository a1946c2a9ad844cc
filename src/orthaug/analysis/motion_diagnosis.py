"""Diagnosis of a motion by its free run: noise, or errors that a state or an input explains.

The criterion of a motion is right for white noise on its outputs. Coloured errors that follow no
input and no state are noise within the motion; errors that do are physics that is missing, or that
the learner does not see. Simple terms, each tried in each equation, show what it is
(`missing_terms`).
"""

from __future__ import annotations

import numpy as np

from orthaug._base.errors import Warning
from orthaug._base.lines import percent
from orthaug._base.parallel import one_blas_thread
from orthaug.analysis.input_timing import DeadTime, dead_times, on_longest
from orthaug.analysis.missing_terms import MissingTest, missing_terms
from orthaug.analysis.predictability import Predictable, from_lags, from_own_past
from orthaug.analysis.residuals import LAGS, ROUNDING, ResidualTest, analyse, errors_of, rms_errors
from orthaug.analysis.verdict_text import Diagnosis
from orthaug.fitting.motion_estimates import MotionEstimate
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Orthogonal
from orthaug.models.response import Response

_LEVEL = 0.01  # of the test of missing terms
_SMALL = 0.05  # of the error's variance: effects of inputs and states below that are small
# Of the output's deviation: a free run that leaves less has no dead time to look for
_SIZABLE = 0.02
_LITTLE = 0.005  # of the error's variance: a share by its own past below that is none
_LAGS = 10  # of inputs that may predict the error
_ROWS_PER_LAG = 20
_MOST_ROWS = 20_000  # at which the error is set beside states


def diagnose_motion(fit: MotionEstimate, free_run: Response) -> Diagnosis | None:
    """Return the diagnosis by the free run's errors on the training data.

    None where it ran away, or leaves rounding only.

    Args:
        free_run: of the training data.
    """
    record, motion = fit.problem.record, fit.problem.motion
    if any(run.diverged for run in free_run.trajectories):
        return None
    if np.all(rms_errors(free_run) / fit.problem.deviation < ROUNDING):
        return None
    errors, every = errors_of(free_run), -(-len(record) // _MOST_ROWS)
    inputs = [e.inputs for e in record.experiments]
    frame = fit.model.states(record)
    ends = np.cumsum([len(e) for e in record.experiments])[:-1]
    states = np.split(frame[list(motion.names_of_states)].to_numpy(), ends)
    if not np.isfinite(np.concatenate(states)).all():
        return None
    names = ([c.name for c in record.outputs], list(motion.inputs), list(motion.names_of_states))
    with one_blas_thread():
        tests = analyse(errors, inputs, states, *names, lags=LAGS)
        shares = tuple(_predictable(i, test, errors, inputs, every) for i, test in enumerate(tests))
        missing = missing_terms(fit)
    if any(test.white is None for test in tests):
        return None
    followed = {test.name: test.follows() for test in tests if test.follows()}
    curved = {test.name: test.curved_over(_SMALL) for test in tests if test.curved_over(_SMALL)}
    lacks = missing if missing is not None and missing.found(_LEVEL, _SMALL) else None
    explained = any(share.inputs > _SMALL for share in shares) or bool(curved) or lacks is not None
    white = all(test.practically_white() for test in tests)
    size = rms_errors(free_run) / fit.problem.deviation
    late = (
        _dead_times(fit)
        if motion.inputs and (explained or not white) and np.any(size > _SIZABLE)
        else ()
    )
    verdict = "unmodelled" if explained or late else "white" if white else "equation_noise"
    text = _words(verdict, fit, tests, shares, followed, curved, lacks, late)
    warnings = [one.warning for one in late]
    warnings += (
        []
        if white
        else [
            Warning("coloured_residual", _colour_sentence(fit) + (_UNCOUNTED if explained else ""))
        ]
    )
    return Diagnosis(verdict, text, (), tests, None, None, tuple(warnings), shares, (), missing)


def _dead_times(fit: MotionEstimate) -> tuple[DeadTime, ...]:
    """Return the inputs that act later, by the physics trained before the learner.

    It runs in the same compiled programs.
    """
    solver, posed = LevenbergMarquardt().within_limit, fit.problem
    posed = posed if fit.learns else posed.without_learner()
    learner = fit.model.form.bound.learner
    return dead_times(on_longest(posed, fit.criterion, solver, Orthogonal(), learner), solver)


def _colour_sentence(fit: MotionEstimate) -> str:
    """Return a sentence on coloured errors, and on the standard errors that follow."""
    text = "the errors of the free run are coloured: judge the model by held-out errors"
    if fit.std is None or fit.plain_covariance is not None:
        return f"{text}."
    return (
        f"{text}. The rows are too few for robust standard errors: those given assume white errors "
        "and are a rough guide."
    )


_UNCOUNTED = " Intervals cover noise only: missing physics may have moved the parameters by more."


def _predictable(i: int, test: ResidualTest, errors: list, inputs: list, every: int) -> Predictable:
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


def _words(
    verdict: str,
    fit: MotionEstimate,
    tests: tuple[ResidualTest, ...],
    shares: tuple,
    followed: dict,
    curved: dict,
    lacks: MissingTest | None,
    late: tuple[DeadTime, ...],
) -> str:
    units = {c.name: c.unit for c in fit.problem.record.outputs}
    sizes = ", ".join(f"{s.rms:.3g} {units[s.name]}".strip() + f" of {s.name}" for s in shares)
    if verdict == "white":
        noise = "is white: noise on the outputs, which the training assumes."
        return f"The free run's error ({sizes}) {noise}{_traces(tests, shares)}"
    if verdict == "equation_noise":
        learner = "that the learner does not see" if fit.learns else "(a learner would show which)"
        no_input = "no input, " if fit.problem.motion.inputs else ""
        return (
            f"The free run's error ({sizes}) is coloured ({_colour(tests, shares)}). It follows "
            f"{no_input}no state at the same instant, and no simple missing term. Its cause is "
            f"disturbances, or physics missing in an equation {learner}."
        )
    if late:
        return (
            f"The free run's error ({sizes}) contains more than noise. Most likely "
            f"{late[0].input} acts later than in the equations: {late[0].gain}."
        )
    if lacks is not None:
        return f"The free run's error ({sizes}) contains more than noise. {_name_terms(lacks)}"
    what = [f"{name} follows {', '.join(given)}" for name, given in followed.items()]
    what += [f"{name} varies with {', '.join(given)}" for name, given in curved.items()]
    what = what or [f"{100 * max(s.inputs for s in shares):.0f} % follows from the inputs"]
    held = "Physics is missing" + (
        ", or inputs move differently between samples" if fit.problem.motion.inputs else ""
    )
    return f"The free run's error ({sizes}) contains more than noise: {'; '.join(what)}. {held}."


def _traces(tests: tuple[ResidualTest, ...], shares: tuple[Predictable, ...]) -> str:
    """Return a sentence on significant effects that are too small to matter."""
    effects = [
        f"{test.name} follows {', '.join(test.correlated_inputs)}"
        for test in tests
        if test.correlated_inputs
    ]
    effects += [
        f"{test.name} varies with {', '.join(over)}"
        for test in tests
        if (over := test.curved_over(0.0))
    ]
    if not effects:
        return ""
    most = max(share.largest(own_past=False) for share in shares)
    return (
        f" Tests still detect small effects ({'; '.join(effects)}): {percent(most)} of its "
        "mean square at most."
    )


def _colour(tests: tuple[ResidualTest, ...], shares: tuple[Predictable, ...]) -> str:
    """Return for each coloured output its largest autocorrelation and its predictable share."""
    clauses = []
    for test, share in zip(tests, shares, strict=True):
        if not test.practically_white():
            past = f", and {percent(share.own_past)} of it follows from its own past"
            past = (
                past if share.own_past > _LITTLE else ", too little to predict it from its own past"
            )
            clauses.append(
                f"{test.name} has autocorrelations of up to {test.largest_acf:.2f} in "
                f"magnitude{past}"
            )
    return "; ".join(clauses)


def _name_terms(lacks: MissingTest) -> str:
    """Return the terms that are most likely missing."""
    best, *others = lacks.terms
    text = f"Most likely {best} would explain {percent(best.share)} of its mean square"
    if others:
        text += (
            ", as would "
            f"{' or '.join(f'{term.expression} in that of {term.equation}' for term in others[:2])}"
        )
    return f"{text}."
