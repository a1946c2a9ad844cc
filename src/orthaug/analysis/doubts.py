"""Causes of error that the intervals of a fit do not count: missing structure or a missing state.

Every fit is tested, for either kind of physics, with a learner or without one.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import replace
from functools import reduce
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from orthaug._base.errors import Warning, visible
from orthaug._base.lines import first_words, percent
from orthaug._base.progress import Stage
from orthaug.analysis.attempt import attempt
from orthaug.analysis.findings import MemoryResult, SharedResult, StructureResult
from orthaug.analysis.fit_findings import Findings, ParameterResult
from orthaug.inference.nearly_shared import output_warnings
from orthaug.physics.problem import Problem

if TYPE_CHECKING:
    from orthaug.analysis.family_tests import FamilyTest
    from orthaug.analysis.hidden_state import StructureTest
    from orthaug.analysis.parameter_changes import ParameterDrift
    from orthaug.data.record import Record

E = TypeVar("E", bound=Any)
F = TypeVar("F", bound=Findings)
"""An `Examination`."""

_LISTED = 3  # parameters, and terms with memory
NOISE_ONLY = (
    *("unexplained", "parameter_drift", "parameter_depends", "parameter_by_experiment"),
    *("quantised_output", "explains_nothing"),
    *("few_frequencies", "little_left", "output_without_learner", "hidden_state"),
)
"""Codes of warnings that leave intervals of noise alone."""
_SURE_TERM = 0.01  # probability of no missing term, below which the best is named
_FAR = 3.0  # times its value, by which no linear step moves a parameter credibly
_NAMED = 12  # parameters in a warning
_MOSTLY = 0.5  # of the error, which a simple term explains: memory is then judged beside it
_LITTLE_BESIDE = 0.5  # of that share, which memory must predict
_LEFT = 0.05  # of the residual's variance, that functions of the regressors predict
_ONLY = "The 95 % intervals count noise only. "
_SEARCH = (
    "Search for its terms with `[[suspects]]` or `orthaug explain`. Write them into the physics, "
    "or let the learner see what they depend on."
)
_LEARN = (
    "Fit with a learner that sees what the missing terms may depend on; `orthaug explain` then "
    "names them."
)
_ELSEWHERE = (
    "The learner that was tried does not lower the error on held-out rows: let it see other "
    "signals, or add it to other equations or outputs. Or search for missing terms with "
    "`[[suspects]]`."
)
_REMEDIES = (_SEARCH, _LEARN, _ELSEWHERE)
_OWN_PAST = 0.5  # of the residual's variance, at least, in a disturbance with a memory
_OTHER_CAUSES = {"hidden_state", "late_rows"}  # alike: what explains nearly all refutes the others
_UNRELATED = 0.1  # of that: what inputs and functions may predict by chance
_DETERMINED = re.compile(
    r"( The data determine | Of the physical parameters they determine )[^.]*\."
    r"|: the data determine [^.]*"
)


def doubt(made: E) -> E:
    """Return an examination with the warnings `unexplained` and `hidden_state`.

    Its intervals are marked with what they count.
    """
    fit, result = made.fit, made.result
    if not fit.status.ok:
        return made
    Stage.DOUBTS.enter()
    failed: list[Any] = []
    test = attempt(
        "the search for a hidden state",
        lambda: _structure_test(fit),
        failed,
        None,
    )
    unmodelled = result.residuals is not None and result.residuals.verdict == "unmodelled"
    if test is not None and test.is_far and fit.model.coloured and not unmodelled:
        test = None  # disturbances add up along a free run, which innovations do not show
    left = _static_share(result) if unmodelled else 0.0
    known = {warning.code for warning in result.warnings}
    warnings: list[Warning] = list(failed)
    if (unmodelled or (test is not None and test.found)) and "unexplained" not in known:
        warnings.append(
            Warning(
                code="unexplained",
                text=_unexplained_text(test, left, fit, result) + _withdrawal(fit, result, left),
            )
        )
    hidden = test is not None and test.has_memory and (left <= _LEFT or test.exceeds(left))
    if test is not None and test.state is not None and _named_share(result) > _MOSTLY:
        hidden = hidden and test.state.share > _LITTLE_BESIDE * _named_share(result)
    drift = None if test is None else test.drift
    hidden = hidden and not (drift and (drift.each or drift.on))
    if test is not None and hidden:
        warnings.append(Warning(code="hidden_state", text=_hidden_state(fit, test)))
    if test is not None and test.drift is not None and not hidden:
        # What is far from the data, or lacks a term that is known, needs no changing parameter
        explained = test.is_far or _named_share(result) > _MOSTLY
        # Between experiments that differ, what follows a signal is whatever differs with it
        explained = explained and (unmodelled or test.found)
        if "differs_between_experiments" in known and test.drift.follows is not None:
            explained = True
        if not explained:
            warnings += _drifting(fit, test.drift)
    found: dict[str, Any] = {"warnings": [*result.warnings, *warnings]}
    if test is not None and test.found:
        found["unexplained"] = _structure(fit, test, hidden=hidden)
    if any(warning.code in NOISE_ONLY for warning in found["warnings"]):
        found |= {
            name: _noise_only(getattr(result, name), withdrawn=left > _LEFT)
            for name in ("parameters", "physical_parameters")
        }
    reason = _reason(result, test, left, unmodelled)
    if result.shared is not None and reason:
        found["shared"] = _withdraw(result.shared, reason)
    return replace(made, result=result.changed(**found))


def _is_slow(fit: Any, test: StructureTest | None) -> bool:
    """Return whether functions follow a free run's errors only because both are slow.

    Of lagged physics: filtered until noise in them is white, the errors show no such function.
    """
    if not fit.criterion.simulates or not isinstance(fit.problem, Problem):
        return False
    return test is not None and test.static is None


def _static_share(result: Findings) -> float:
    """Return the share of the residual's variance that functions of the regressors still predict.

    Causes that explain what the learner holds say nothing of what it does not hold; nor is memory
    missing where a function of one row is.
    """
    shares = (
        [one.functions for one in result.residuals.predictable or ()] if result.residuals else []
    )
    return max(shares, default=0.0)


def _named_share(result: Findings) -> float:
    """Return the share of a free run's error that the best simple missing term explains."""
    missing = result.residuals.missing if result.residuals is not None else None
    return max((term.share or 0.0 for term in missing.terms), default=0.0) if missing else 0.0


def _withdrawal(fit: Any, result: Findings, left: float) -> str:
    """Return a sentence on the intervals with bias that are not given; empty for none."""
    rows = [*(result.parameters or ()), *(result.physical_parameters or ())]
    names = [row.name for row in rows if row.bias is not None]
    if left <= _LEFT or not names:
        return ""
    lacks = "The learner holds only a part of what the physics lacks"
    if not fit.learns:
        lacks = "The physics still lacks something whose bias is not known"
    return f" {lacks}, so no interval with its bias is given for {first_words(names, _NAMED)}."


def _noise_only(
    rows: list[ParameterResult] | None, *, withdrawn: bool
) -> list[ParameterResult] | None:
    """Return the parameters with their intervals marked as those of noise alone.

    `withdrawn` takes the intervals with bias away.
    """
    if rows is None:
        return None
    found = [
        row.model_copy(update={"ci95_counts": "noise only"}) if row.ci95 is not None else row
        for row in rows
    ]
    if not withdrawn:
        return found
    return [
        row
        if row.bias is None
        else row.model_copy(
            update={
                "ci95_with_bias": None,
                "bias": row.bias.model_copy(update={"determined": False}),
            }
        )
        for row in found
    ]


def _unexplained_text(test: StructureTest | None, left: float, fit: Any, result: Findings) -> str:
    given = _has_intervals(result)
    only = _ONLY if given else ""
    slow = _is_slow(fit, test)
    if left > _LEFT and not slow:
        what = f"the model's error contains more than noise: {_functions_text(left)}"
    elif test is None or not test.found:
        what = _more_than_noise(result)
        if _is_disturbance(fit, result, slow=slow):
            kind = "innovations" if result.motion is not None else "auto"
            return (
                f"{what}, and neither the inputs nor functions of the regressors predict it: a "
                f"disturbance with a memory of its own is likely. {only}Describe it by "
                f'`noise.model` = "{kind}"; if physics with memory is missing instead, such as a '
                "hysteresis, that does not make the intervals right."
            )
    elif test.is_far:
        what = (
            f"the free run errs by {percent(test.off)} of the output's deviation, and more than "
            "noise: it is too far from the data to say what is missing"
        )
    else:
        best = test.likeliest
        name = f"a further lag of {best.on}" if test.is_a_lag(best) else best.name
        term = _term_of(result, best) if best is test.static else ""
        what = (
            f"the model's error contains more than noise: {name} in {best.equation}{term} predicts "
            f"{percent(best.share)} of the free run's error on held-out rows, beyond what its "
            "own past predicts"
        )
    moved = (
        "The 95 % intervals count noise only; missing physics may have moved the parameters by "
        "more."
        if given
        else "Missing physics may have moved the parameters."
    )
    return f"{what}. {moved} {_remedy(fit, result)}"


def _remedy(fit: Any, result: Findings) -> str:
    """Return what to do about missing terms: another thing where a learner did not find them."""
    if fit.learns:
        return _SEARCH
    if not any(warning.code == "physics_alone" for warning in result.warnings):
        return _LEARN
    motion = None if fit.setup is None else getattr(fit.setup.problem, "motion", None)
    outputs = () if motion is None else output_warnings(motion)
    return " ".join([*(one.text for one in outputs), _ELSEWHERE])


def _term_of(result: Findings, family: FamilyTest) -> str:
    """Return the missing term that a function of one variable is, in brackets; or nothing."""
    missing = result.residuals.missing if result.residuals is not None else None
    if missing is None or not missing.terms or (missing.p or 0.0) > _SURE_TERM:
        return ""
    best = missing.terms[0]
    same = (best.equation, best.variable) == (family.equation, family.on)
    return f" ({best.expression}, most likely)" if same else ""


def with_found_change(
    fit: Any, result: F, found: str, *, nearly_all: bool = False, causes: Collection[str] = ()
) -> F:
    """Return the findings after a change that lowers the error to below a half.

    One that took what is left for a disturbance refers to the change instead. Where the change
    explains nearly all, it is the remedy, and other causes are not.

    Args:
        found: the change and its gain, as a sentence.
        causes: codes of the warnings whose cause the change mends.
    """
    left = _static_share(result)
    if left > _LEFT or result.unexplained is not None or not _is_disturbance(fit, result):
        return _with_remedy(result, found, causes) if nearly_all else result
    only = _ONLY if _has_intervals(result) else ""
    text = (
        f"{_more_than_noise(result)}, and physics that is missing is its likely cause. {found} "
        f"{only}Make that change, and fit again."
    )
    warnings = [
        Warning("unexplained", text) if warning.code == "unexplained" else warning
        for warning in result.warnings
    ]
    return result.changed(warnings=warnings)


def _with_remedy(result: F, found: str, causes: Collection[str]) -> F:
    """Return the findings with a change as the remedy, and without causes that it does not mend."""
    done = f"{found} Make that change, and fit again."
    refuted = _OTHER_CAUSES - set(causes)
    others = [one for one in result.warnings if one.code not in refuted]
    warnings = [
        Warning(one.code, reduce(lambda text, old: text.replace(old, done), _REMEDIES, one.text))
        if one.code == "unexplained"
        else one
        for one in others
    ]
    structure = result.unexplained
    if structure is not None and "hidden_state" in refuted:
        structure = structure.model_copy(update={"hidden_state": False})
    return result.changed(warnings=warnings, unexplained=structure)


def _more_than_noise(result: Findings) -> str:
    verdict = " (its verdict is `unmodelled`)" if result.residuals else ""
    return f"the residual contains more than noise{verdict}"


def _has_intervals(result: Findings) -> bool:
    rows = (*(result.parameters or ()), *(result.physical_parameters or ()))
    return any(row.ci95 is not None for row in rows)


def _is_disturbance(fit: Any, result: Findings, *, slow: bool = False) -> bool:
    """Return whether the residual follows from its own past alone, without a noise model of it.

    Args:
        slow: whether functions follow it only because both are slow.
    """
    shares = (result.residuals.predictable if result.residuals else None) or ()
    return (
        not fit.model.coloured
        and any(one.own_past > _OWN_PAST for one in shares)
        and all(
            max(one.inputs, 0.0 if slow else one.functions) < _UNRELATED * one.own_past
            for one in shares
        )
    )


def _functions_text(left: float) -> str:
    return f"functions of the regressors predict {percent(left)} of the residual's variance"


def _hidden_state(fit: Any, test: StructureTest) -> str:
    assert test.state is not None
    best = test.state
    others = [
        one.name
        for one in test.families
        if one.sure and one is not best and one.share > 0.8 * best.share
    ]
    beside = f" ({', '.join(others[: _LISTED - 1])} nearly as much)" if others else ""
    remedy = (
        f"{fit.problem.new_state}. Or let the learner see lags or a filtered copy of that signal"
    )
    driven = best.on in {channel.name for channel in fit.problem.record.inputs}
    noisy = (
        f" Noise on the recorded {best.on}, or a value held otherwise between samples, looks alike."
        if driven
        else ""
    )
    return (
        f"a state is missing: {best.name} in {best.equation} predicts {percent(best.share)} of "
        f"the free run's error on held-out rows{beside}, beyond what its own past predicts. No "
        f"function of the model's own states "
        f"predicts it.{_movement_text(fit, best)}{noisy} Remedy: {remedy}."
    )


def _structure_test(fit: Any) -> StructureTest | None:
    """Return the test of a fit's free run over its training data, or the segments of these."""
    from orthaug.analysis.hidden_state import structure_test  # slow to import

    record = fit.judged_record
    return structure_test(fit.model, record, by_experiment=record is fit.problem.record)


def _drifting(fit: Any, drift: ParameterDrift) -> list[Warning]:
    """Return a warning of a parameter that changes over the record; none without finite values."""
    names, now = fit.problem.names, np.asarray(fit.theta, dtype=float)
    if len(names) != len(now):
        return []
    name, place = names[drift.place], np.arange(len(now)) == drift.place
    moves = drift.each or (drift.begin, drift.end, *(() if drift.turn is None else (drift.turn,)))
    ends = [
        float(fit.problem.values_at(now + np.where(place, moved, 0.0))[drift.place])
        for moved in moves
    ]
    if not np.isfinite(ends).all():
        return []
    beyond = "on held-out rows, beyond what its own past explains"
    share = f"which explains {percent(drift.share)} of the free run's error {beyond}"
    if drift.each:
        values = zip(ends, _names_of_experiments(fit.problem.record), strict=True)
        listed = ", ".join(f"{value:.3g} in {where}" for value, where in values)
        text = (
            f"{name} seems to differ between experiments: {name} is about {listed}, {share}. A "
            "load or a setting that differs? Give it as a constant input column, or fit the "
            "experiments on their own."
        )
        return [Warning("parameter_by_experiment", text)]
    if drift.follows is not None:
        what = drift.follows
        text = (
            f"a state is missing that changes {name}: with a {what.name}, {name} goes from "
            f"{ends[0]:.3g} where it is smallest to {ends[1]:.3g} where it is largest, {share}. A "
            "part that heats up acts so. Its value here is a mean. Remedy: a motion with that "
            f"state, dz/dt = ({what.on} - z)/{what.scale:.3g}, and {name} as a function of z."
        )
        return [Warning("hidden_state", text)]
    if drift.on:
        values = zip((ends[0], ends[2], ends[1]), drift.at, strict=True)
        listed = ", ".join(f"{value:.3g} where that is {at:.3g}" for value, at in values)
        text = (
            f"{name} seems to depend on {drift.on}: {name} is about {listed}, {share}. Its value "
            f"is a mean. Write {name} as a function of {drift.on} into the physics."
        )
        return [Warning("parameter_depends", text)]
    between = "" if drift.turn is None else f"over {ends[2]:.3g} in between "
    text = (
        f"{name} seems to change over the record: from {ends[0]:.3g} at its begin {between}to "
        f"{ends[1]:.3g} at its end, {share}. Its value is a mean, and its interval is that of a "
        "constant. Record what it depends on, such as a temperature, and write that into the "
        "physics; or fit the begin and the end on their own."
    )
    return [Warning("parameter_drift", text)]


def _names_of_experiments(record: Record) -> list[str]:
    """Return the files of experiments, or their numbers where a file has several."""
    first = [record.recordings.index(i) for i in range(record.recordings[-1] + 1)]
    files = [visible(PurePath(record.experiments[i].source).name) for i in first]
    if all(files) and len(set(files)) == len(files):
        return files
    return [f"experiment {i + 1}" for i in range(len(first))]


def _movement_text(fit: Any, best: FamilyTest) -> str:
    """Return a sentence on how much a term moves the parameters."""
    values = _values_with(fit, best)
    if not values:
        return ""
    now = _current_values(fit)
    moves = sorted(
        values, key=lambda name: -abs(values[name] - now[name]) / max(abs(now[name]), 1e-300)
    )
    listed = ", ".join(
        f"{name} {values[name]:.4g} instead of {now[name]:.4g}" for name in moves[:_LISTED]
    )
    return f" With it the fit gives {listed}."


def _current_values(fit: Any) -> dict[str, float]:
    return dict(zip(fit.problem.names, map(float, fit.values), strict=True))


def _values_with(fit: Any, best: FamilyTest) -> dict[str, float]:
    """Return the parameters of a fit with an additional term.

    None of them where one linear step goes too far to be an estimate: as far in the other direction
    it would be noticed of the logarithm of one that falls to nothing.
    """
    now, moves = _current_values(fit), np.array(best.moves)
    if len(moves) != len(now):
        return {}
    size = np.abs(list(now.values()))
    with np.errstate(over="ignore"):
        steps = [fit.problem.values_at(np.asarray(fit.theta) + sign * moves) for sign in (1, -1)]
    far = [np.abs(step)[size > 0] > _FAR * size[size > 0] for step in steps]
    if np.any(far) or not np.isfinite(steps).all():
        return {}
    return dict(zip(now, map(float, steps[0]), strict=True))


def _structure(fit: Any, test: StructureTest, *, hidden: bool) -> StructureResult:
    sure = [one for one in test.families if one.sure]
    return StructureResult(
        hidden_state=hidden,
        static=None if test.static is None else memory_result(test.static),
        memory=[memory_result(one, _values_with(fit, one)) for one in sure],
    )


def memory_result(one: FamilyTest, parameters: dict[str, float] | None = None) -> MemoryResult:
    """Return a family of terms as results list it."""
    scale = None if one.term is None else one.term.scale
    own = {
        "name": one.name,
        "kind": one.kind,
        "on": one.on,
        "scale": scale,
        "equation": one.equation,
    }
    return MemoryResult.model_validate(
        {**own, "share": one.share, "p": one.p, "parameters": parameters or None}
    )


def _reason(result: Findings, test: StructureTest | None, left: float, unmodelled: bool) -> str:
    """Return the reason why the fit determines no parameter; empty where it determines some."""
    if left > _LEFT:
        return _functions_text(left)
    if test is not None and test.found:
        best = max(
            (one for one in (test.static, test.memory) if one is not None),
            key=lambda one: one.share,
        )
        return (
            f"what the model leaves is no function of what the learner sees ({best.name} "
            "predicts it)"
        )
    if unmodelled:
        return "the residual contains more than noise"
    stopped = {"not_converged", "stopped"} & {warning.code for warning in result.warnings}
    if stopped:
        return "training had not converged"
    if result.status.code == "iteration_limit":
        return "training ended at its limit of iterations, though its loss hardly fell any more"
    return ""


def _withdraw(shared: SharedResult, reason: str) -> SharedResult:
    """Return what the learner could imitate, with no parameter determined by the fit."""
    lost = [*shared.determined, *(shared.physical or [])]
    if not lost:
        return shared
    text = _DETERMINED.sub("", shared.text).rstrip(".")
    named = ", ".join(lost)
    text = (
        f"{text}. The data would determine {named} with such a learner. That is in doubt here: "
        f"{reason}."
    )
    physical = None if shared.physical is None else []
    update = {
        "text": text,
        "determined": [],
        "physical": physical,
        "withdrawn": lost,
        "doubt": reason,
    }
    return shared.model_copy(update=update)
