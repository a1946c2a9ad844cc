"""Verdict on a residual: its content, its words, and the warnings for intervals of θ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from orthaug._base.errors import Warning
from orthaug._base.lines import join_words, percent
from orthaug.analysis.changes import WORTH, Change, fall_of
from orthaug.analysis.closed_loop import feedback_in
from orthaug.analysis.input_timing import LateInput
from orthaug.analysis.missing_term import SHAPES, MissingTerm, may_be_missing
from orthaug.analysis.missing_terms import MissingTest
from orthaug.analysis.predictability import Predictable
from orthaug.analysis.quantised_output import QuantisedOutput
from orthaug.analysis.residuals import ResidualTest
from orthaug.fitting.inconsistency import UNDER_FEEDBACK
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.models.response import Response

SHARE = 0.01  # of the residual's variance: what a regressor explains of it counts from there
_SLOW = 0.9  # of a free run's variance: a share by its own past from there on is a drift
_MOST_OF_IT = 0.5  # of the errors' mean square, from which on a term is likely what is missing
_LISTED = 5  # findings that a text lists at most
_TOO_FAST = 0.05  # noise variance / smallest variance among the lagged outputs

_BIASED = (
    "noise on the measured output biases the one-step θ, and its intervals do not cover that bias."
)
_INCONSISTENT = (
    "the one-step residual is coloured: a disturbance of one row is in the lagged outputs of the "
    "next. That biases the one-step θ, and its intervals do not cover that bias."
)
_UNBIASED = (
    'Training on the free run (focus = "simulation") has none, and a noise model ([noise] '
    'model = "auto") takes it into account.'
)
_UNBIASED_IN_LOOP = (
    f'A noise model ([noise] model = "auto") takes it into account. {UNDER_FEEDBACK}'
)
_LEFT = Warning(
    "coloured_residual",
    "what the noise model leaves is still coloured: its orders are too low, or the physics lacks "
    "something. θ may be biased, and its intervals do not cover that bias. Take larger orders, "
    "further lags, or a learner that sees more.",
)
_OFF = (
    "The errors are coloured by enough to make the one-step θ inconsistent (warning "
    "`inconsistent`)."
)
_LITTLE = 0.005  # of a free run's variance: a share by its own past below that is none
_SLIGHT_COLOUR = 0.3  # autocorrelation: larger ones do predict, if they hold over the whole record
_COLOUR = 0.1  # of the residual's variance by its own past: from there on that bias may matter


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """`verdict` is white, equation_noise, sensor_noise or unmodelled.

    `text` says why and what to do.

    `one_step` and `free_run` are the tests of the two residuals per output. `ratio` is the free
    run's RMS error against the one-step error, `noise_in_lags` the share of noise in the least
    excited direction of the lagged outputs. `predictable` is what could be predicted of the error
    that was minimised, per output. `changes` are predicted to lower it, the first of them by most;
    there is none where it is noise. `steps` are the steps of those outputs whose one-step error is
    no larger, None where there are none. `missing` is the test of terms that the equations of a
    motion could lack; None for other models.
    """

    verdict: str
    text: str
    one_step: tuple[ResidualTest, ...]
    free_run: tuple[ResidualTest, ...] | None
    ratio: float | None
    noise_in_lags: float | None
    warnings: tuple[Warning, ...]
    predictable: tuple[Predictable, ...] = ()
    changes: tuple[Change, ...] = ()
    missing: MissingTest | None = None
    late: tuple[LateInput, ...] = ()
    """Inputs of a motion that act later than in its equations."""
    steps: Mapping[str, float] | None = None

    def __repr__(self) -> str:
        return f"Diagnosis({self.verdict}: {self.text})"


@dataclass(frozen=True, eq=False)
class Finding:
    """Findings on a fit's residuals. `ratio` and `noise` are those of `Diagnosis`."""

    fit: LaggedEstimate
    simulated: bool
    one_step: Response
    tests: tuple[ResidualTest, ...]
    white: bool
    free_white: bool
    ratio: float | None
    noise: float | None
    sensor: bool = False
    complete: bool = False
    """True if no test finds anything that matters."""
    free_tests: tuple[ResidualTest, ...] | None = None
    predictable: tuple[Predictable, ...] = ()
    changes: tuple[Change, ...] = ()
    steps: Mapping[str, float] = field(default_factory=dict)
    """Steps of the outputs whose one-step error has their size."""
    limits: str = ""
    """Sentences on samples at a limit; "" without any."""
    inconsistent: Warning | None = None
    """That coloured errors move the one-step θ, by how many standard errors, and what the remedies
    give.
    """

    @cached_property
    def looped(self) -> bool:
        """True if the inputs follow the outputs: disturbances that are fed back bias a free run."""
        return bool(feedback_in(self.fit.problem.record))

    @property
    def unbiased(self) -> str:
        """What has no bias by the colour of the errors, in words."""
        return _UNBIASED_IN_LOOP if self.looped else _UNBIASED

    @property
    def lacks(self) -> bool:
        """True if a change of the model itself is worth making."""
        return any(change.kind != "criterion" for change in self.changes)

    @property
    def own(self) -> tuple[ResidualTest, ...]:
        """The tests of the error that was minimised."""
        return (
            self.free_tests
            if self.fit.criterion.simulates and self.free_tests is not None
            else self.tests
        )

    @property
    def drifts(self) -> bool:
        """True if a free run's error is slow, and white equation noise does not explain it."""
        slow = any(one.own_past > _SLOW for one in self.predictable)
        return self.simulated and slow and not self.white and not self.sensor

    def follows(self, share: float = SHARE) -> tuple[str, ...]:
        """Return inputs that the error surely follows, by more than a share of its variance."""
        inputs = (name for test in self.own for name in test.follows(float(np.sqrt(share))))
        return tuple(
            dict.fromkeys(
                [*inputs, *(name for test in self.own for name in test.curved_over(share))]
            )
        )

    @property
    def what(self) -> str:
        """The error that was minimised."""
        return "error of the free run" if self.own is not self.tests else "one-step residual"


def words(verdict: str, seen: Finding) -> tuple[str, tuple[Warning, ...]]:
    """Return the text of a verdict, and its warnings."""
    text, warnings = {
        "white": _white,
        "equation_noise": _equation_noise,
        "sensor_noise": _sensor_noise,
        "unmodelled": _unmodelled_text,
    }[verdict](seen)
    if (
        verdict == "unmodelled"
        and _inconsistent(seen)
        and (seen.lacks or seen.inconsistent is None)
    ):
        warnings = (
            *warnings,
            _LEFT
            if seen.fit.model.coloured
            else Warning("coloured_residual", f"{_INCONSISTENT} {seen.unbiased}"),
        )  # where the physics lacks something, a model of the colour gives no θ
    elif verdict != "sensor_noise" and seen.inconsistent is not None:
        return f"{text} {_OFF}", (*warnings, seen.inconsistent)
    plain = seen.fit.std is not None and seen.fit.plain_covariance is None
    if plain and not warnings and not (seen.free_white if seen.simulated else seen.white):
        warnings = (
            (_LEFT,)
            if seen.fit.model.coloured
            else (
                _colour_warning(
                    "errors of the free run are" if seen.simulated else "one-step residual is"
                ),
            )
        )
    return text, warnings


def _inconsistent(seen: Finding) -> bool:
    """Return whether a coloured disturbance enters one-step θ through lagged outputs."""
    if (
        seen.simulated
        or seen.white
        or seen.steps
        or not seen.fit.model.form.states
        or seen.fit.std is None
    ):
        return False
    return any(one.own_past > _COLOUR for one in seen.predictable)


def _white(seen: Finding) -> tuple[str, tuple[Warning, ...]]:
    if seen.complete and seen.inconsistent is not None:
        return "The one-step residual is slightly coloured, but enough to move θ.", ()
    if seen.complete:
        so = "the intervals hold" if not seen.fit.learns else "the tests find only noise"
        return (
            f"The one-step residual is white: {so}, and no criterion is better than this one.",
            (),
        )
    return _small_residual_text(seen), ()


def _equation_noise(seen: Finding) -> tuple[str, tuple[Warning, ...]]:
    if not seen.complete and not (seen.simulated and seen.white):
        return _small_residual_text(seen), ()
    asked = ""
    if seen.simulated:
        asked = " The one-step criterion is the more precise one here."
        asked += f" {_sentence(seen.changes[0])}" if seen.changes else ""
    if seen.inconsistent is not None:
        return (
            "The one-step residual is nearly white, the free run's is not: the noise enters "
            "the equation.",
            (),
        )
    return (
        "The one-step residual is white, the free run's is not: the noise enters the "
        f"equation.{asked}",
        (),
    )


def _sensor_noise(seen: Finding) -> tuple[str, tuple[Warning, ...]]:
    colour = max((t.largest_acf or 0.0) for t in seen.tests)
    closer = (
        "as close"
        if seen.ratio is None or seen.ratio > 0.95
        else f"{1 / seen.ratio:.1f} times closer"
    )
    own = "the free run is" if seen.simulated else "the physics trained on the free run comes"
    how = (
        f"its autocorrelation reaches {colour:.2f} in magnitude, and {own} {closer} to the "
        "outputs without measured lags"
    )
    text = f"The one-step residual is coloured: {how}. That is noise on the measured output"
    if seen.simulated:
        more = f" {_sentence(seen.changes[0])}" if seen.changes else ""
        return f"{text}: the simulation criterion is the right one.{more}", ()
    text += ". One-step estimates of θ are then inconsistent"
    text += "" if seen.looped else ', those of focus = "simulation" are not'
    if not seen.looped and seen.changes and seen.changes[0].kind == "criterion":
        fall = seen.changes[0].fall
        text += (
            f"; that focus is predicted to lower the error of the free run by {percent(fall)}"
            if seen.changes[0].gains
            else "; that focus is not predicted to lower the error of the free run"
        )
    if seen.noise is not None and seen.noise > _TOO_FAST:
        text += (
            f". The noise is {100 * seen.noise:.0f} % of the least variance among the lagged "
            "outputs: the sampling is too fast for one-step estimation"
        )
    steps = f" {_quantisation_text(seen)}" if seen.steps else ""
    biased = Warning("sensor_noise", f"{_BIASED} {seen.unbiased}")
    return f"{text}.{steps}", (biased,) if seen.fit.std is not None else ()


def _unmodelled_text(seen: Finding) -> tuple[str, tuple[Warning, ...]]:
    findings = [
        f"its autocorrelation reaches {max((t.largest_acf or 0.0) for t in seen.own):.2f} in "
        "magnitude"
    ]
    for test in seen.own:
        findings += [f"the residual of {test.name} still follows {name}" for name in test.follows()]
        findings += [
            f"the residual of {test.name} depends nonlinearly on {name}"
            for name in test.curved_over(SHARE)
        ]
    findings = [*findings[:_LISTED], *(["and more"] if len(findings) > _LISTED else [])]
    opening = f"The {seen.what}, {_size(seen)}, contains more than noise: {'; '.join(findings)}."
    advice = "" if seen.steps and not seen.changes else _advice(seen, _cause(seen))
    parts = (opening, seen.limits, _shares(seen), _quantisation_text(seen), advice)
    return " ".join(part for part in parts if part), ()


def _quantisation_text(seen: Finding) -> str:
    """Return sentences on an output's quantisation that colours the one-step residual."""
    if not seen.steps:
        return ""
    units = {c.name: f" {c.unit}".rstrip() for c in seen.fit.problem.record.outputs}
    each = {
        test.name: f"{test.name} is measured in steps of {seen.steps[test.name]:.3g}"
        f"{units[test.name]}, and the one-step residual ({test.rms:.2g}{units[test.name]}) is no "
        "larger"
        for test in seen.tests
        if test.name in seen.steps
    }
    trained = (
        "" if seen.simulated or seen.looped else 'training on the free run (focus = "simulation"), '
    )
    return (
        f"{'; '.join(each.values())}: these steps make it coloured, as noise on the output "
        f"does, and bias one-step estimates of θ. Remedies: {trained}fewer samples (`decimate` "
        "of data.prepare), or a finer measurement."
    )


def _cause(seen: Finding) -> str:
    """Return likely causes of a residual that none of the tried changes lowers, and remedies."""
    followed = [name for test in seen.own for name in (*test.follows(), *test.curved_over(SHARE))]
    if followed:
        return (
            f"the effect of {join_words(followed[:_LISTED])} has a form that was not tried, or "
            "dynamics beyond the lags; test a form by your own `[[suspects]]`"
        )
    if seen.drifts:
        return (
            "the error drifts, which no white noise explains. An unrecorded disturbance would, or "
            "slow dynamics that the physics lacks: record the disturbance as an input"
        )
    return (
        "its autocorrelation is that of a disturbance, or of sensor noise, which neither "
        "criterion describes. Its own past predicts it; an unrecorded input may do so, too"
    )


def _small_residual_text(seen: Finding) -> str:
    """Return sentences on a residual that the tests reject but hardly anything predicts."""
    colour = (
        " Its autocorrelation is that of the noise." if seen.simulated and not seen.white else ""
    )
    followed = seen.follows()
    shown = (
        f"mostly noise, but still follows {join_words(followed)}"
        if followed
        else "noise by all tests"
    )
    advice = _advice(
        seen, "what it follows is a small effect" if followed else "it is the noise floor"
    )
    return f"The {seen.what}, {_size(seen)}, is {shown}. {_shares(seen)}{colour} {advice}"


def _size(seen: Finding) -> str:
    share = max(
        (t.rms or 0.0) / d for t, d in zip(seen.own, seen.fit.problem.deviation, strict=True)
    )
    return f"{percent(share)} of the output's deviation"


def _shares(seen: Finding) -> str:
    """Return the predictable shares, of the output with the largest one.

    Among equal ones it is the one that follows something.
    """
    if not seen.predictable:
        return ""
    named = {test.name for test in seen.own if test.follows() or test.curved_over(SHARE)}
    one = max(seen.predictable, key=lambda entry: (entry.largest(), entry.name in named))
    of = f" of {one.name}" if len(seen.predictable) > 1 else ""
    unit = next((c.unit for c in seen.fit.problem.record.outputs if c.name == one.name), "")
    size = float(np.sqrt(one.largest())) * one.rms
    past, driven, curved = (percent(share) for share in (one.own_past, one.inputs, one.functions))
    return (
        f"The predictable share of its variance{of} is {past} from its own past, {driven} from "
        f"the inputs, {curved} from functions of the regressors: "
        f"{size:.2g}{f' {unit}' if unit else ''} at most."
    )


def _advice(seen: Finding, otherwise: str) -> str:
    """Return the change that is predicted to help most.

    Where none helps, say so, and what follows.
    """
    if seen.changes:
        return _sentence(seen.changes[0])
    if not seen.predictable:
        return "Try more lags, other learner inputs or more neurons."
    limit = 100 * fall_of(WORTH)
    return (
        "No further lag, offset or learner is predicted to lower it by "
        f"{percent(limit / 100)}: {otherwise}."
    )


def _sentence(change: Change) -> str:
    text = str(change)
    return f"{text[0].upper()}{text[1:]}."


def _colour_warning(what: str) -> Warning:
    text = (
        f"standard errors of θ assume a white residual, but the {what} coloured: they are "
        "only a rough guide."
    )
    return Warning("coloured_residual", text)


_BY_INNOVATIONS = (
    ' If it is disturbances, `noise.model` = "innovations" gives right intervals; where physics is '
    "missing, it does not."
)


def free_run_words(
    verdict: str,
    fit: MotionEstimate,
    tests: tuple[ResidualTest, ...],
    shares: tuple,
    followed: dict,
    curved: dict,
    lacks: MissingTest | None,
    late: tuple[LateInput, ...],
    coarse: QuantisedOutput | None = None,
    slight: MissingTest | None = None,
    misread: tuple[Warning, ...] = (),
    limits: str = "",
    unsure: MissingTest | None = None,
) -> str:
    """Return the verdict on a motion's free run in words, with its reason.

    Args:
        slight: terms that surely explain a little of it.
        misread: what the record shows of inputs that are read wrongly.
        coarse: the steps of the outputs, where these are most of the error.
        limits: sentences on samples at a limit, which come first.
        unsure: the test of missing terms, whatever it says.
    """
    units = {c.name: c.unit for c in fit.problem.record.outputs}
    sizes = ", ".join(f"{s.rms:.3g} {units[s.name]}".strip() + f" of {s.name}" for s in shares)
    modelled = fit.model.coloured
    subject = "The error one step ahead" if modelled else "The free run's error"
    if coarse is not None:
        steps = join_words([f"{name} in steps" for name in coarse.steps])
        if coarse.whole:
            return f"The free run's error is that of recording {steps}: hardly more is left."
        share = percent(coarse.share)
        subject = f"{share} of the free run's error is that of recording {steps}. The rest"
    if verdict == "white" and modelled:
        noise = "is white: the gain of the predictor accounts for process noise and sensor noise."
        return f"{subject} ({sizes}) {noise}{small_effects(tests, shares)}"
    if verdict == "white":
        noise = "is white: noise on the outputs, which the training assumes."
        return f"{subject} ({sizes}) {noise}{small_effects(tests, shares)}"
    before = f"{limits} " if limits else ""
    more = f"{subject} ({sizes}) contains more than noise"
    if verdict == "equation_noise":
        learner = "that the learner does not see" if fit.learns else "(a learner would show which)"
        inputs = fit.problem.motion.inputs
        colour = describe_colour(tests, shares)
        remedy = "" if modelled or fit.problem.motion.held else _BY_INNOVATIONS
        fed = "sensor noise that the controller feeds back, " if fit.problem.motion.held else ""
        no_term = (
            f"{'no input, ' if inputs else ''}no state at the same instant and no simple missing "
            "term behind it. "
        )
        cause = "Its cause is"
        if slight is not None:
            best = slight.terms[0]
            named = f"{best}"
            no_term = (
                f"{'no input and ' if inputs else ''}no state at the same instant behind it. "
                f"{named[:1].upper()}{named[1:]}. This would explain "
                f"{percent(best.share)} of its mean square: little, but it may move parameters. "
            )
            cause = "The cause of the rest is"
        elif unsure is not None and may_be_missing(unsure.p, unsure.share):
            no_term = (
                f"{'no input and ' if inputs else ''}no state at the same instant behind it. Terms "
                f"that the equations may lack explain {percent(unsure.share)} of it together, "
                f"though not surely (p = {unsure.p:.2g}). "
            )
        return (
            f"{subject} ({sizes}) is coloured ({colour}). {before}The tests of the residual "
            f"find {no_term}{cause} {fed}disturbances, or physics missing in an equation "
            f"{learner}.{remedy}"
        )
    if misread:
        return f"{more}. {_after(limits, 'Most likely')} an input is misread: {misread[0].text}"
    if late:
        acts = f"{late[0].input} acts {late[0].manner}: {late[0].gain}."
        return f"{more}. {_after(limits, 'Most likely')} {acts}"
    if lacks is not None:
        named = _name_terms(lacks, fit)
        held = fit.problem.motion.held
        if held and not lacks.scattered and lacks.terms[0].shape == SHAPES[0]:
            named += (
                " A wrong constant of the controller may look the same: compare its output with "
                f"measured {join_words(held)}."
            )
        return f"{more}. {_after(limits, named)}"
    what = [f"{name} follows {', '.join(given)}" for name, given in followed.items()]
    what += [f"{name} varies with {', '.join(given)}" for name, given in curved.items()]
    what = what or [f"{100 * max(s.inputs for s in shares):.0f} % follows from the inputs"]
    held = "Physics is missing" + (
        ", or inputs move differently between samples" if fit.problem.motion.inputs else ""
    )
    return f"{more}: {'; '.join(what)}. {limits or f'{held}.'}"


def _after(limits: str, text: str) -> str:
    """Return a sentence behind those on samples at a limit, if there are any."""
    return f"{limits} Otherwise {text[:1].lower()}{text[1:]}" if limits else text


def small_effects(tests: tuple[ResidualTest, ...], shares: tuple[Predictable, ...]) -> str:
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


def describe_colour(tests: tuple[ResidualTest, ...], shares: tuple[Predictable, ...]) -> str:
    """Return for each coloured output its largest autocorrelation and its predictable share."""
    clauses = []
    for test, share in zip(tests, shares, strict=True):
        if not test.practically_white():
            if share.own_past > _LITTLE:
                past = f", and {percent(share.own_past)} of it follows from its own past"
            elif (test.largest_acf or 0.0) < _SLIGHT_COLOUR:
                past = ", too little to predict it from its own past"
            else:  # as after a start that is off: where it was, nothing of the rest says how
                past = ", though its own past does not surely predict it over the whole record"
            clauses.append(
                f"{test.name} has autocorrelations of up to {test.largest_acf:.2f} in "
                f"magnitude{past}"
            )
    return "; ".join(clauses)


def _name_terms(lacks: MissingTest, fit: MotionEstimate) -> str:
    """Return the terms that are most likely missing, or the equations where many explain a part."""
    best, *others = lacks.terms
    if lacks.scattered:
        places = dict.fromkeys(term.place.removeprefix("the equation of ") for term in lacks.terms)
        equations = ", ".join(places)
        return (
            f"Simple terms of states and inputs explain {percent(lacks.share)} of it together, and "
            f"no single one does: a force of another form is missing, most likely in the equation "
            f"of {equations}."
        )
    text = f"{best} would explain {percent(best.share)} of its mean square"
    if best.share < _MOST_OF_IT:
        text = f"No simple term explains half of it. The nearest: {text}"
    else:
        text = f"Most likely {text}"
    if others:
        text += (
            f", as would {' or '.join(f'{term.expression} {_that(term)}' for term in others[:2])}"
        )
    at_once = best.output is not None and best.shape == "linear"
    if at_once and best.variable in fit.problem.motion.external:
        text += (
            f". If {best.variable} cannot act at once, its rows may be logged late: then advance "
            f'it by step = "shift" of data.prepare, by a sample or a part of one'
        )
    return f"{text}."


def _that(term: MissingTerm) -> str:
    return term.where.replace("the equation", "that", 1)


def colour_sentence(fit: MotionEstimate) -> str:
    """Return a sentence on coloured errors, and on the standard errors that follow."""
    errors = "one step ahead" if fit.model.coloured else "of the free run"
    text = f"the errors {errors} are coloured: judge the model by held-out errors"
    given = fit.std is not None and bool(np.isfinite(fit.std).any())
    if not given or fit.plain_covariance is not None:
        return f"{text}."
    return (
        f"{text}. There are no robust standard errors of them: those given assume white errors and "
        "are a rough guide."
    )
