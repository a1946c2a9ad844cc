"""The verdict at the top of a page: is the model reliable, for what use, what to do next."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from orthaug._base.lines import first_words, join_words
from orthaug.analysis.budget import SURE_SHARE
from orthaug.analysis.changes import Change
from orthaug.analysis.findings import BiasResult
from orthaug.analysis.fit_findings import Findings, ParameterResult, PartScores
from orthaug.analysis.missing_term import may_be_missing
from orthaug.reports.biases import hang_on_form, is_biased, of_selected_form, size_of_bias
from orthaug.reports.page_blocks import number, percent
from orthaug.reports.result import CompareResult, FitResult, RowResult

_GOOD, _POOR = 0.2, 0.5  # NRMSE of a free run up to which it is close, and from which it is far
_ALIKE = 1.1  # ratio of errors up to which models are called equally good
_COARSE = 0.5  # standard errors that finer integration may move a parameter
_SURE = 0.1  # standard error over value up to which a parameter counts as known
_NAMED = 0.5  # share of the learned part from which its cause is the first advice
_AGREES = 1.0  # standard errors up to which parameters of two results are called the same
_MOST_KEYS = 4  # of settings in a sentence
_MOST_DOUBTS = 3  # in the first sentence
_WORSE = 1.5  # times the error on training data: then 1/5 of a Gaussian error is outside the band
_STOPPED = ("iteration_limit", "no_descent", "stopped")
_UNSTABLE = "unstable_plant"
_SENSOR = "sensor_noise"
_RAN_AWAY = "free_run_diverged"
_NO_FREEDOM = "no_degrees_of_freedom"  # any physics follows so few rows
_COLOURED = "coloured_residual"  # of the free run of a fit that takes it for white
# Of models that are as good as each other these are taken first
_TIED = ("orthogonal", "physics alone")


class PageVerdict(NamedTuple):
    """`level` is good, care or bad.

    The sentences state its reliability, its use, and the next step.
    """

    level: str
    trust: str
    use: str
    then: str

    @property
    def sentences(self) -> tuple[str, str, str]:
        """The three sentences, in the order in which they are read."""
        return self.trust, self.use, self.then


def fit_verdict(result: Findings) -> PageVerdict:
    """Return the verdict of a fit, from its own findings.

    A next step needs a spec: of a fit in Python it is empty.
    """
    if isinstance(result, FitResult):
        held_out = bool(result.data.tests or result.data.validation)
    else:
        held_out = len(result.scores) > 1
    doubts = list(_doubts(result, held_out=held_out))
    error, part = _worst_score(result.scores)
    own, _ = _worst_score({"train": result.scores["train"]} if "train" in result.scores else {})
    if own is not None and own > _POOR >= (error or 0.0):  # a short test hides errors that grow
        error, part = own, "train"
    unstable = _has_warning(result, _UNSTABLE)  # no score of a free run judges it
    bad = (
        any(_has_warning(result, code) for code in (_RAN_AWAY, _NO_FREEDOM))
        or (error is not None and error > _POOR and not unstable)
        or _code(result) == "hurts"
    )
    level = "bad" if bad else "care" if doubts or unstable else "good"
    use = _use_text(result, level)
    opening = {
        "good": "The model is reliable",
        "care": "The model is usable with reservations",
        "bad": "Do not use the model as it is"
        if use.startswith((_SEARCH_ONLY, _MEND_FIRST, _MORE_ROWS))
        else "Do not simulate with the model",
    }[level]
    shown = "" if error is None else f": {_error_text(error, part)}"
    if unstable:
        shown = ": the plant is unstable, so that no free run follows a whole record"
    because = (
        f"{', but ' if level == 'care' else '; '}{join_words(doubts[:_MOST_DOUBTS])}"
        if doubts
        else ""
    )
    causes = (w.text.split(":")[0] for w in result.warnings if w.code == "one_step_only")
    first = next((f"{cause[0].upper()}{cause[1:]}. " for cause in causes), "")
    then = _next_step(result) if isinstance(result, FitResult) else ""
    return PageVerdict(level, f"{first}{opening}{shown}{because}.", use, then)


def compare_verdict(result: CompareResult) -> PageVerdict:
    """Return the verdict of a comparison: which model to use."""
    rows = [row for row in result.comparison if _worst_score(row.scores)[0] is not None]
    if not rows:
        return PageVerdict(
            "bad",
            "No model has a free run that could be scored.",
            "None of them can be used as it is.",
            "Look at the warnings below, and fit again.",
        )
    errors = {row.name: _worst_score(row.scores)[0] or 0.0 for row in rows}
    best = best_row(result)[0]
    row = next(row for row in result.comparison if row.name == best)
    error, part = _worst_score(row.scores)
    held_out = bool(result.data.tests or result.data.validation)
    doubts = list(_doubts(row, held_out=held_out))
    level = (
        "good"
        if error is not None and error <= _GOOD
        else "care"
        if error is None or error <= _POOR
        else "bad"
    )
    level = "care" if level == "good" and doubts else level
    _, *equal = result.equal or [best]
    near = [name for name in errors if name != best and errors[name] <= _ALIKE * (error or 0.0)]
    near = [name for name in near if name not in equal]
    same = [name for name in near if percent(errors[name]) == percent(errors[best])]
    near = [name for name in near if name not in same]
    alike = [*same, *equal]
    least = all(errors[best] <= other for name, other in errors.items() if name not in alike)
    less = f", as {'does' if len(same) == 1 else 'do'} {_quote_names(same)}" if same else ""
    less += (
        (", and no other model has a smaller error" if same else ", the smallest of all models")
        if least
        else ""
    )
    how = f"it has the lowest error on the validation part, and {_error_text(error or 0.0, part)}"
    trust = f"Take “{best}”: {how if result.chosen else _error_text(error or 0.0, part) + less}"
    trust += f"; {_quote_names(equal)} {_verb_for(equal)} equal to it within noise" if equal else ""
    trust += f"; {_quote_names(near)} {_verb_for(near)} as good within 10 %." if near else "."
    if doubts:
        trust = f"{trust[:-1]}. But {join_words(doubts[:_MOST_DOUBTS])}."
    if result.differences is not None:
        return PageVerdict(level, trust, _agreement(result), _settings_text(result))
    alone = errors.get("physics alone")
    use = "This is physics alone: no learner improves on it."
    if best != "physics alone" and alone is not None and error is not None:
        learns = error / alone if alone else 1.0
        use = (
            f"Its error on {part} is {number(learns, 2)} of that of physics alone "
            f"({percent(alone)})"
        )
        use += f", and its learner {_word(row)}." if row.validation else "."
    return PageVerdict(level, trust, use, _after_comparison(result, row))


def best_row(result: CompareResult) -> tuple[str, str]:
    """Return the model to take and the part that says so; "" for both where none has a score."""
    rows = [row for row in result.comparison if _worst_score(row.scores)[0] is not None]
    if not rows:
        return "", ""
    errors = {row.name: _worst_score(row.scores)[0] or 0.0 for row in rows}
    if result.chosen:
        return result.chosen, "validation"
    best = _best_model(rows, errors)
    return best, _worst_score(next(row for row in rows if row.name == best).scores)[1]


def _agreement(result: CompareResult) -> str:
    """Return how far the parameters of saved results are from each other."""
    sizes = [one for one in result.differences or () if one.of_std is not None]
    if not sizes:
        return "No parameter has a standard error, so nothing says how near the parameters are."
    if all(one.value == 0.0 for one in result.differences or ()):
        return "The parameters are the same."
    far = max(sizes, key=lambda one: abs(one.of_std or 0.0))
    row = next(row for row in result.comparison if row.name == far.result)
    unit = next((p.unit for p in row.parameters if p.name == far.name), "")
    shown = f"{number(far.value, 3)} {unit}".rstrip()
    text = (
        f"the largest difference is that of “{far.name}” between “{result.comparison[0].name}” and "
        f"“{far.result}”, {shown} or {number(abs(far.of_std or 0.0), 2)} standard errors"
    )
    if abs(far.of_std or 0.0) <= _AGREES:
        return f"The parameters agree within one standard error: {text}."
    return f"The parameters differ: {text}."


def _settings_text(result: CompareResult) -> str:
    """Return the settings to which a difference between saved results may be due."""
    keys = [f"`{one.key}`" for one in result.settings or ()]
    if not keys:
        return "Their settings are the same."
    shown = first_words(keys, _MOST_KEYS)
    return f"They differ in {shown}; change one at a time to see what makes the difference."


def _best_model(rows: Sequence[RowResult], errors: Mapping[str, float]) -> str:
    """Return the model of the lowest error.

    Among equally good ones, one whose θ has a meaning.
    """
    best = min(errors, key=errors.__getitem__)
    earns = [
        row.name for row in rows if row.validation is None or row.validation.verdict == "helps"
    ]
    tied = [name for name in _TIED if name in earns and errors[name] <= _ALIKE * errors[best]]
    return next(iter(tied), best)


def _after_comparison(result: CompareResult, row: RowResult) -> str:
    if row.residuals is not None and row.residuals.changes:
        return f"An option, not tried here: {_change(row.residuals.changes[0])}."
    if not result.data.tests and not result.data.validation:
        return "Hold out a test part, so that the models can be judged."
    if not result.data.validation:
        return (
            "Hold out a validation part (`[data.validation]`), so that the choice and its test "
            "use different data."
        )
    return (
        f"Fit it alone with `orthaug fit` and structure “{row.name}”, whose report has its "
        "residuals and bias."
    )


def _word(row: RowResult) -> str:
    assert row.validation is not None
    return {"helps": "helps", "no_help": "does not help", "hurts": "hurts"}.get(
        row.validation.verdict, "–"
    )


def _error_text(error: float, part: str) -> str:
    return (
        f"the RMS error of its free run {_place_of(part)} is {percent(error)} of the output's "
        "standard deviation"
    )


def _place_of(part: str) -> str:
    return "on the training data" if part == "train" else f"on {part}"


def _worse(scores: dict[str, PartScores]) -> tuple[float, str] | None:
    """Return the free run's error on a held-out part over that in training, where it is large."""
    found = {}
    trained = scores["train"].simulation.rmse if "train" in scores else None
    for part, score in scores.items():
        held = score.simulation.rmse
        if part != "train" and trained and held:
            ratios = [h / t for h, t in zip(held, trained, strict=True) if h is not None and t]
            found[part] = max(ratios, default=0.0)
    part = max(found, key=found.__getitem__) if found else ""
    return (found[part], part) if found and found[part] > _WORSE else None


def _worst_score(
    scores: dict[str, PartScores], kind: str = "simulation"
) -> tuple[float | None, str]:
    """Return the NRMSE of the free run on the held-out part where it is largest, RMS over outputs.

    On the training data where none is held out.

    Args:
        kind: `prediction` for that of one step ahead.
    """
    held_out = {part: score for part, score in scores.items() if part != "train"} or scores
    found = []
    for part, score in held_out.items():
        values = score.kinds[kind].nrmse
        if values is not None and None not in values:
            found.append((float(np.sqrt(np.mean(np.array(values, dtype=float) ** 2))), part))
    return max(found, key=lambda one: one[0], default=(None, ""))


def _code(result: Findings | RowResult) -> str | None:
    """Return the verdict on the learner.

    None without one, or where physics alone was chosen.
    """
    return (
        None
        if result.validation is None or _has_warning(result, "physics_alone")
        else result.validation.verdict
    )


def _has_warning(result: Findings | RowResult, code: str) -> bool:
    return any(warning.code == code for warning in result.warnings)


def is_biased_by_feedback(result: Findings | RowResult) -> bool:
    """Return whether feedback is in the data, and errors that are not white.

    What is fed back biases a free run by its memory: with white errors it has none.
    """
    white = result.residuals is not None and result.residuals.verdict == "white"
    return _has_warning(result, "closed_loop") and not white


def _has_noise_model(result: Findings | RowResult) -> bool:
    """Return whether the noise was modelled; rows of a comparison do not say."""
    return bool(getattr(result, "noise", None))


def _doubts(result: Findings | RowResult, *, held_out: bool) -> Iterator[str]:
    """Yield the objections to the model, the gravest first."""
    runaway = [w.text.split(":")[0] for w in result.warnings if w.code == _RAN_AWAY]
    if runaway:
        yield f"its free run diverges on {join_words(runaway)}"
    if _has_warning(result, _NO_FREEDOM):
        yield "its training data have no more rows than it has unknowns"
    if _code(result) == "hurts":
        yield "its learner makes the free run worse than physics alone"
    if not held_out and not (result.validation and result.validation.trials):
        yield "it was not tested on held-out data"
    if (result.status if isinstance(result, RowResult) else result.status.code) in _STOPPED:
        yield "training stopped before it converged"
    if _has_warning(result, "spectral_radius_above_one"):
        yield (
            "its stability is not proved, because the local spectral radius exceeds 1 on a "
            "part of its free run"
        )
    formed = [row for row in hang_on_form(_rows(result)) if is_biased(row)]
    if formed or of_selected_form(result):
        names = list(dict.fromkeys([row.name for row in formed] + of_selected_form(result)))
        yield (
            f"{join_words(names)} hang{'s' if len(names) == 1 else ''} on the form of a term that "
            f"was selected from the data{size_of_bias(formed) if formed else ''}"
        )
    biased = [row.name for row in _rows(result) if is_biased(row) and row not in formed]
    if biased:
        guessed = any(
            row.bias and (row.bias.share or 0.0) < SURE_SHARE
            for row in _rows(result)
            if row.name in biased
        )
        probably = guessed and getattr(result, "motion", None) is None
        size = size_of_bias([row for row in _rows(result) if row.name in biased])
        verb = "is" if len(biased) == 1 else "are"
        yield f"{join_words(biased)} {verb} {'probably ' * probably}biased{size}"
    if result.residuals is not None and not _noise_alone(result):
        coarse = list(result.residuals.steps or {})
        yield {
            "unmodelled": f"its error is no larger than the steps in which {join_words(coarse)} "
            f"{'is' if len(coarse) == 1 else 'are'} recorded"
            if coarse
            else "its residual contains more than noise",
            _SENSOR: "noise on the measured output biases its one-step estimates",
        }[result.residuals.verdict]
    error, _ = _worst_score(result.scores)
    if error is not None and error > _GOOD:
        if result.residuals is None:
            yield "its residual could not be tested"
        elif result.residuals.verdict == "equation_noise" and _has_warning(result, _COLOURED):
            yield "its errors are large and correlated with their past"
    if _may_lack_terms(result):
        assert result.residuals is not None and result.residuals.missing is not None
        lacking = result.residuals.missing
        yield (
            f"terms that its equations may lack explain {percent(lacking.share or 0.0)} of its "
            f"error (p = {number(lacking.p or 0.0, 2)})"
        )
    coarse = _moved_by_integrator(result)
    if coarse:
        yield f"more substeps of its integrator would move {join_words(coarse)}"
    untested = (text for code, text in _UNTESTED.items() if _has_warning(result, code))
    yield from dict.fromkeys(untested)
    if is_biased_by_feedback(result):
        yield "its data were probably recorded under feedback, " + (
            "where a noise model needs complete physics and enough orders"
            if _has_noise_model(result)
            else "which biases the estimates"
        )
    worse = _worse(result.scores)
    if worse is not None:
        times = number(worse[0], 2)
        yield f"its error on {worse[1]} is {times} times that on the training data"
    if result.validation is not None and result.validation.extrapolation:
        left = dict.fromkeys(entry.part for entry in result.validation.extrapolation)
        yield (
            f"{join_words(list(left))} {'leaves' if len(left) == 1 else 'leave'} the range of the "
            "training data"
        )


def _moved_by_integrator(result: Findings | RowResult) -> list[str]:
    """Return the parameters that twice the substeps would move by half a standard error or more."""
    motion = getattr(result, "motion", None)
    moved = {} if motion is None else motion.substep_bias or {}
    return [
        row.name
        for row in _rows(result)
        if row.std and abs(moved.get(row.name) or 0.0) > _COARSE * row.std
    ]


def _rows(result: Findings | RowResult) -> list[ParameterResult]:
    physical = None if isinstance(result, RowResult) else result.physical_parameters
    return [*result.parameters, *(physical or [])]


_SEARCH_ONLY = "Use it only to search for missing physics"
_MORE_ROWS = "Give more rows, or physics with fewer parameters, and fit again."
_MEND_FIRST = "Mend the data first, as the warnings say, and fit again."
# What is wrong with data looks like missing physics, which a search would then find
_DEFECTS = (
    *("exchanged_columns", "held_output", "reset_output", "rows_twice", "saturated_output"),
    *("equation_units", "unit_mismatch", "wild_rows", "wild_samples", "wrapped_angle"),
)
_UNTESTED = {
    "explains_nothing": "its free run explains nothing of an output",
    "quantised_output": "the steps of an output move its parameters",
    "little_left": "a parameter rests on little of its regressor beside the learner",
    "output_without_learner": "an output has parameters of a learned equation, but no learner",
    "few_frequencies": "its input has too few frequencies to test the physics",
    "local_minimum": "training from other initial values explains its data better",
    "poor_start": "its training probably ended in a local minimum",
    "several_solutions": "other values of its parameters explain its data as well",
    "parameter_drift": "a parameter seems to change over its record",
    "parameter_depends": "a parameter seems to depend on a signal",
    "parameter_by_experiment": "its parameters differ between the experiments",
    "differs_between_experiments": "its parameters differ between the experiments",
    "reset_output": "an output goes on elsewhere within its record",
    "wrapped_angle": "an angle wraps in its record",
    "held_output": "a sensor is slower than the rows of its data",
    "exchanged_columns": "an input and an output may be exchanged",
    "saturated_output": "an output is recorded at an end of its range",
    "equation_units": "its equations and its data are in different units",
    "wild_rows": "a few rows, which may be wrong, decide its parameters",
    "short_for_noise": "its record is too short to distinguish noise from disturbances that last",
}
"""Doubts by warnings that no test of the residual sees."""


def _use_text(result: Findings, level: str) -> str:
    rows, other = _rows(result), [*_moved_by_integrator(result), *of_selected_form(result)]
    sure = [row.name for row in rows if _is_known(row) and row.name not in other]
    untested = any(_has_warning(result, code) for code in _UNTESTED)
    untested = untested or (bool(of_selected_form(result)) and not hang_on_form(rows))
    doubted = untested or is_biased_by_feedback(result) or _may_lack_terms(result)
    imitable = getattr(result, "shared", None)  # of results of older versions there is none
    unclear = imitable.withdrawn or [] if imitable is not None else []
    clear = [name for name in sure if name not in unclear]
    known = clear if _noise_alone(result) and not doubted else []
    shared = [row.name for row in rows if row.shared]
    bare = [row.name for row in rows if row.std is None and not row.shared]
    rest = [row.name for row in rows if row.name not in (*sure, *shared, *bare)]
    others = list(dict.fromkeys(rest))  # θ may have the name of a physical parameter
    ahead, part = _worst_score(result.scores, "prediction")
    predicts = ahead is not None and ahead <= (_GOOD if level == "bad" else _POOR)
    if _has_warning(result, _NO_FREEDOM):
        return _MORE_ROWS
    useless = level == "bad" and (ahead is None or ahead > _POOR or not (known and predicts))
    if useless and any(_has_warning(result, code) for code in _DEFECTS):
        return _MEND_FIRST
    if level == "bad" and ahead is not None and ahead > _POOR:
        return (
            f"{_SEARCH_ONLY}: the RMS error of its one-step "
            f"prediction {_place_of(part)} is {percent(ahead)} of the output's standard deviation, "
            "too."
        )
    # A noise model is there to predict; without one any slow output is predicted well by its past
    if level == "bad" and not (predicts and (known or _has_noise_model(result))):
        return f"{_SEARCH_ONLY}."
    if level == "bad" or _has_warning(result, _UNSTABLE):
        text = "predict the next sample"
    else:
        text = f"simulate{' and predict' if predicts else ''} within the range of its training data"
    text += f" and to read {join_words(known)} as physics" if known else ""
    if unread := [name for name in sure if name not in known]:
        cover = "interval does" if len(unread) == 1 else "intervals do"
        text += f". Do not read {join_words(unread)} as physics yet: "
        if not _noise_alone(result) or _may_lack_terms(result):
            text += f"the {cover} not include what the residual still contains"
        elif doubted or imitable is None or not imitable.doubt:
            text += f"the {cover} not include what the warning names"
        else:
            text += imitable.doubt
    if bare:
        have = "has no interval" if len(bare) == 1 else "have no intervals"
        text += f". {join_words(bare)} {have}, which would say how close to physics that is"
    if others:
        text += f". {join_words(others)} {_verb_for(others)} too uncertain or too biased to be "
        text += "read as physics"
    if shared:
        does = f"imitate {'it' if len(shared) == 1 else 'them'}"
        does = "make up for other values" if _has_warning(result, "not_identified") else does
        text += f". The data alone do not determine {join_words(shared)}, because the learner could"
        text += f" {does}"
        if _code(result) == "no_help" and _noise_alone(result):
            text += (
                '. The learner does not help: without it (`learner.kind = "none"`) the data '
                f"determine {join_words(shared)}, if no physics is missing"
            )
    return f"Use it to {text}."


def _may_lack_terms(result: Findings | RowResult) -> bool:
    """Return whether terms explain most of a coloured error, which is less than sure."""
    found = result.residuals
    if found is None or found.verdict != "equation_noise" or found.missing is None:
        return False
    return may_be_missing(found.missing.p, found.missing.share)


def _noise_alone(result: Findings | RowResult) -> bool:
    """Return whether the residual shows nothing that would bias the parameters.

    Noise on the sensor biases those of one step ahead, which a warning says.
    """
    verdict = None if result.residuals is None else result.residuals.verdict
    return verdict != "unmodelled" and (verdict != _SENSOR or not _has_warning(result, _SENSOR))


def _is_known(row: ParameterResult) -> bool:
    """Return whether a parameter may be read as physics."""
    sure = row.std is not None and row.value is not None and 0 < row.std <= _SURE * abs(row.value)
    return sure and not row.shared and not is_biased(row)


def _quote_names(names: list[str]) -> str:
    return join_words([f"“{name}”" for name in names])


def _verb_for(names: list[str]) -> str:
    return "is" if len(names) == 1 else "are"


def _next_step(result: FitResult) -> str:
    """Return the first thing to do: a change that lowered the free run's error in a trial.

    Otherwise an option, named as one.
    """
    if result.advice:
        return result.advice[0].text
    if _has_warning(result, _NO_FREEDOM):
        return "First record more rows."
    option = _option(result)
    if option is not None:
        return f"An option, not tried here: {option}."
    if result.advice_trials is not None and result.advice_trials.tried:
        text = (
            "None of the changes that were tried improves the free run; export the model "
            "(`orthaug export`), or design the"
        )
        return f"{text} next experiment."
    return (
        "No further change is predicted to help; export the model (`orthaug export`) or design "
        "the next experiment."
    )


def _option(result: FitResult) -> str | None:
    """Return a change that may help and was not tried, as the middle of a sentence."""
    if _code(result) == "hurts":
        return (
            'physics alone (`learner.kind = "none"`), or a learner of other inputs or fewer neurons'
        )
    if is_biased_by_feedback(result):
        return (
            "data with the reference recorded and the loop simulated (`controller`), with larger "
            "motions of the reference, or without the controller"
        )
    predicted = None if result.advice_trials is not None else _predicted_change(result)
    if predicted is not None:
        return predicted
    if not result.data.tests and not result.data.validation:
        return "a test part (`[data.tests.NAME]`), held out to judge the model on"
    if result.status.code == "stopped":
        return "training to the end, because it was stopped on request"
    if result.status.code == "iteration_limit":
        return "more iterations (`training.iterations`), because training ended at their limit"
    if result.validation is not None and result.validation.extrapolation:
        entry = result.validation.extrapolation[0]
        low, high = entry.found
        return (
            f"training data that reach {entry.regressor} from {number(low, 3)} to {number(high, 3)}"
        )
    if _has_warning(result, _RAN_AWAY):
        return "data over the range that the free run leaves"
    if _is_undecided(result):
        return (
            "the learner (`training.fallback = false`), because cross-validation does not "
            "decide whether it helps"
        )
    if result.residuals is not None and result.residuals.steps:
        steps = join_words(list(result.residuals.steps))
        return (
            f"fewer samples, or a finer measurement, because the steps of {steps} are as large as "
            "the error"
        )
    if not _noise_alone(result):
        return (
            "a physical term for what the residual still depends on (residual tests; "
            "`[[suspects]]` tests a form)"
        )
    worse = _worse(result.scores)
    return (
        None
        if worse is None
        else f"more training data like {worse[1]}, on which the error is larger"
    )


def _predicted_change(result: FitResult) -> str | None:
    """Return the change with the largest predicted gain, where none was tried."""
    causes = [row.bias for row in _rows(result) if is_biased(row) and row.bias and row.bias.share]
    cause = max(causes, key=lambda bias: bias.share or 0.0, default=None)
    missing = (
        result.residuals.missing.terms if result.residuals and result.residuals.missing else []
    )
    if missing and result.residuals is not None and result.residuals.verdict == "unmodelled":
        return f"the term {missing[0].expression} {missing[0].where}"
    if cause is not None and (cause.share or 0.0) > _NAMED:
        return _cause_option(cause, result.learns)
    tried = result.validation is not None and _code(result) != "helps"
    changes = (
        [c for c in result.residuals.changes if c.kind != "learner" or not tried]
        if result.residuals
        else []
    )
    if changes:
        return _change(changes[0])
    return None if cause is None else _cause_option(cause, result.learns)


def _cause_option(cause: BiasResult, learned: bool) -> str:
    """Return a term that explains the learned part or the residual, for the physics."""
    looks = "looks most like it" if (cause.share or 0.0) < SURE_SHARE and learned else "is that"
    what = "what was learned" if learned else "what the free run leaves"
    return f"“{cause.cause}” in the physics, because {percent(cause.share)} of {what} {looks}"


def _is_undecided(result: Findings) -> bool:
    """Return whether physics alone was handed over although the learner may help."""
    ratio = None if result.validation is None else result.validation.ratio
    return (
        _has_warning(result, "physics_alone")
        and ratio is not None
        and (ratio.value or 1.0) < 1 < (ratio.high or 0.0)
    )


def _change(change: object) -> str:
    """Return a change with its predicted gain, as the middle of a sentence."""
    text = {key: getattr(change, key) for key in ("kind", "what", "fall", "of", "output")}
    predicted = Change(**{**text, "fall": text["fall"] or 0.0})
    return f"{predicted.name}, with which {predicted.prediction}"
