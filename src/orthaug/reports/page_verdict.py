"""The verdict that a page begins with, in three sentences: is the model to be trusted, for what, what comes next."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from orthaug.analysis.changes import Change
from orthaug.reports.page_blocks import number, percent
from orthaug.reports.result import CompareResult, FitResult, ParameterResult, PartScores, RowResult

_GOOD, _POOR = 0.2, 0.5  # NRMSE of a free run up to which it is close, and from which it is far
_ALIKE = 1.1  # ratio of errors up to which models are told to be as good as each other
_SURE = 0.1  # standard error over value up to which a parameter is told to be known
_STOPPED = ("iteration_limit", "no_descent", "stopped")
_RAN_AWAY = ("free_run_diverged",)


class PageVerdict(NamedTuple):
    """`level` is good, care or bad; the sentences say whether to trust the model, for what, and what to do next."""

    level: str
    trust: str
    use: str
    then: str

    @property
    def sentences(self) -> tuple[str, str, str]:
        """In the order in which they are read."""
        return self.trust, self.use, self.then


def fit_verdict(result: FitResult) -> PageVerdict:
    """Of a fit, from its own findings."""
    doubts = list(_doubts(result))
    error, part = _worst(result.scores)
    bad = _ran_away(result) or (error is not None and error > _POOR) or _code(result) == "hurts"
    level = "bad" if bad else "care" if doubts else "good"
    opening = {
        "good": "The model is to be trusted",
        "care": "The model is to be trusted with care",
        "bad": "Do not trust the model as it is",
    }[level]
    shown = "" if error is None else f": {_told_error(error, part)}"
    because = f"{', but ' if level == 'care' else '; '}{_joined(doubts[:3])}" if doubts else ""
    return PageVerdict(level, f"{opening}{shown}{because}.", _use(result, level), _then(result))


def compare_verdict(result: CompareResult) -> PageVerdict:
    """Of a comparison: which model to take."""
    rows = [row for row in result.comparison if _worst(row.scores)[0] is not None]
    if not rows:
        return PageVerdict(
            "bad",
            "No model has a free run that could be scored.",
            "None of them is of use as it is.",
            "Look at the warnings below, and fit again.",
        )
    errors = {row.name: _worst(row.scores)[0] or 0.0 for row in rows}
    best = result.chosen or min(errors, key=errors.__getitem__)
    row = next(row for row in result.comparison if row.name == best)
    error, part = _worst(row.scores)
    level = "good" if error is not None and error <= _GOOD else "care" if error is None or error <= _POOR else "bad"
    near = [name for name in errors if name != best and errors[name] <= _ALIKE * (error or 0.0)]
    how = f"it has the lowest error on the validation part, and {_told_error(error or 0.0, part)}"
    trust = f"Take “{best}”: {how if result.chosen else _told_error(error or 0.0, part) + ', less than of any other'}"
    trust += f"; {_joined([f'“{name}”' for name in near])} {_is(near)} as good within 10 %." if near else "."
    alone = errors.get("physics alone")
    use = "It is the physics alone: no learner earns its place beside it."
    if best != "physics alone" and alone is not None and error is not None:
        learns = error / alone if alone else 1.0
        use = f"Its error on {part} is {number(learns, 2)} of that of physics alone ({percent(alone)})"
        use += f", and its learner {_word(row)}." if row.validation else "."
    return PageVerdict(level, trust, use, _after_comparison(result, row))


def _after_comparison(result: CompareResult, row: RowResult) -> str:
    if row.residuals is not None and row.residuals.changes:
        return f"{_change(row.residuals.changes[0])}."
    if not result.data.tests and not result.data.validation:
        return "Hold out a test part, on which the models can be judged."
    if not result.data.validation:
        return "Hold out a validation part (`[data.validation]`), so that the choice is not made on what judges it."
    return f"Fit it alone with `orthaug fit` and structure “{row.name}”, whose report has its residuals and bias."


def _word(row: RowResult) -> str:
    assert row.validation is not None
    return {"helps": "helps", "no_help": "does not help", "hurts": "hurts"}.get(row.validation.verdict, "–")


def _told_error(error: float, part: str) -> str:
    which = "on the training data" if part == "train" else f"on {part}"
    return f"{which} its free run leaves {percent(error)} of the output's deviation"


def _worst(scores: dict[str, PartScores]) -> tuple[float | None, str]:
    """NRMSE of the free run on the held-out part where it is largest, RMS over outputs; of training if none is."""
    held_out = {part: score for part, score in scores.items() if part != "train"} or scores
    found = {}
    for part, score in held_out.items():
        values = score.simulation.nrmse
        if values is not None and None not in values:
            found[part] = float(np.sqrt(np.mean(np.square(np.array(values, dtype=float)))))
    part = max(found, key=found.__getitem__) if found else ""
    return (found[part], part) if found else (None, "")


def _code(result: FitResult) -> str | None:
    return None if result.validation is None else result.validation.verdict


def _ran_away(result: FitResult) -> bool:
    return any(warning.code in _RAN_AWAY for warning in result.warnings)


def _doubts(result: FitResult) -> Iterator[str]:
    """What speaks against the model, the gravest first."""
    runaway = [w.text.split(":")[0] for w in result.warnings if w.code in _RAN_AWAY]
    if runaway:
        yield f"its free run diverges on {_joined(runaway)}"
    if _code(result) == "hurts":
        yield "its learner makes the free run worse than physics alone"
    if not result.data.tests and not result.data.validation and not (result.validation and result.validation.trials):
        yield "it was never tried on data that it was not fitted to"
    if result.status.code in _STOPPED:
        yield "training stopped before it converged"
    biased = [row.name for row in _rows(result) if _biased(row)]
    if biased:
        one = len(biased) == 1
        carry = "carries a bias larger than its standard error" if one else "carry biases larger than their errors"
        yield f"the estimate{'' if one else 's'} of {_joined(biased)} {carry}"
    if result.residuals is not None and result.residuals.verdict in ("unmodelled", "sensor_noise"):
        yield {
            "unmodelled": "its residual is not noise alone",
            "sensor_noise": "noise on the measured output biases its one-step estimates",
        }[result.residuals.verdict]
    if result.validation is not None and result.validation.extrapolation:
        left = dict.fromkeys(entry.part for entry in result.validation.extrapolation)
        yield f"{_joined(list(left))} {'leaves' if len(left) == 1 else 'leave'} the range of the training data"


def _rows(result: FitResult) -> list[ParameterResult]:
    return [*result.parameters, *(result.physical_parameters or [])]


def _biased(row: ParameterResult) -> bool:
    return row.bias is not None and bool(row.std) and abs(row.bias.value or 0.0) > (row.std or 0.0)


def _use(result: FitResult, level: str) -> str:
    rows = _rows(result)
    known = [row.name for row in rows if _known(row)]
    shared = [row.name for row in rows if row.shared]
    others = [row.name for row in rows if row.name not in (*known, *shared)]
    if level == "bad" and not known:
        return "Use it for nothing but to look for what is missing."
    told = "predict the next sample" if level == "bad" else "simulate and predict within the range of its training data"
    told += f" and to read {_joined(known)} as physics" if known else ""
    told += f"; {_joined(others)} {_is(others)} too uncertain or biased for that" if others else ""
    if shared:
        told += f"; {_joined(shared)} {_is(shared)} what the physics nearest to the data has, for the learner could"
        told += f" imitate {'it' if len(shared) == 1 else 'them'}"
    return f"Use it to {told}."


def _known(row: ParameterResult) -> bool:
    """Whether a parameter may be read as physics."""
    sure = row.std is not None and row.value is not None and 0 < row.std <= _SURE * abs(row.value)
    return sure and not row.shared and not _biased(row)


def _is(names: list[str]) -> str:
    return "is" if len(names) == 1 else "are"


def _then(result: FitResult) -> str:
    """The first thing to do."""
    cause = next((row.bias for row in _rows(result) if _biased(row) and row.bias), None)
    missing = result.residuals.missing.terms if result.residuals and result.residuals.missing else []
    significant = result.residuals is not None and result.residuals.verdict == "unmodelled"
    if _code(result) == "hurts":
        return 'Take physics alone (`learner.kind = "none"`), or give the learner other inputs or fewer neurons.'
    if missing and significant:
        return f"Add {missing[0].expression} to the equation of {missing[0].equation}."
    if result.residuals is not None and result.residuals.changes:
        return f"{_change(result.residuals.changes[0])}."
    if cause is not None:
        return f"Add “{cause.cause}” to the physics, for it explains {percent(cause.share)} of what was learned."
    if _ran_away(result):
        return 'Train on the free run (`focus = "simulation"`), or record data over the range that it leaves.'
    if not result.data.tests and not result.data.validation:
        return "Hold out a test part (`[data.tests.NAME]`), on which the model can be judged."
    if result.status.code == "stopped":
        return "Train it to the end, for it was stopped on request."
    if result.status.code == "iteration_limit":
        return "Give training more iterations (`training.iterations`)."
    if result.validation is not None and result.validation.extrapolation:
        entry = result.validation.extrapolation[0]
        low, high = entry.found
        return f"Record training data that reach {entry.regressor} from {number(low, 3)} to {number(high, 3)}."
    return "Nothing further is predicted to help; export it (`orthaug export`) or design the next experiment."


def _change(change: object) -> str:
    """A change that is predicted to help, as the beginning of a sentence."""
    told = {key: getattr(change, key) for key in ("kind", "what", "fall", "of", "output")}
    text = str(Change(**{**told, "fall": told["fall"] or 0.0}))
    return text[0].upper() + text[1:]


def _joined(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
