"""Changes of a spec that the findings of a fit suggest, in the order in which they are tried."""

from __future__ import annotations

import ast
import math
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from orthaug._base.errors import InputError
from orthaug._base.lines import join_words, plural
from orthaug.analysis.changes import Change
from orthaug.analysis.closed_loop import exchanged_with_output
from orthaug.analysis.findings import LateInputResult
from orthaug.analysis.input_timing import is_stepped, sort_holds
from orthaug.analysis.wild_rows import wild_row_mendings
from orthaug.commands.job import MISSING_STATE, Job, declared_output
from orthaug.commands.opening import job_of_change
from orthaug.commands.parts import training_unit_faults
from orthaug.commands.spec import spec_model
from orthaug.data.preparation import STEPS
from orthaug.data.steps import Shift
from orthaug.data.wild import mendings
from orthaug.fitting.kinds import CRITERIA
from orthaug.physics.differences import Difference, difference_of
from orthaug.physics.motion import HOLDS, Motion
from orthaug.reports.result import FitResult

if TYPE_CHECKING:
    from orthaug.fitting.estimates import Estimate

_OTHER_NOISE = (
    "It was not tried: it mends the parameters and their intervals, and its free run may be worse."
)
_OTHER_OUTPUT = "It was not tried, because errors of another output cannot be compared."
_OTHER_UNIT = "It was not tried, because errors in another unit cannot be compared."
IN_PLACE = "in place of the learner"
_TERMS = 3  # suspected terms that are proposed
_MOST = 0.5  # of the learner: what explains more may take its place, as a trial shows
_LITTLE = 0.05  # of what was learned or left: what explains less is not proposed
_WIDER = 2  # times the neurons
_ZONE = "dead_zone"
_NETWORK = "mlp"
_NEURONS = 8  # of a network that is proposed


@dataclass(frozen=True, eq=False)
class Proposal:
    """A change of a spec: `words` that go on from "with", and the new values by their keys."""

    words: str
    change: dict[str, Any]
    learns: bool = False
    """True if the change is about a learner: a fit of physics alone would not show its effect."""
    refocuses: bool = False
    positive: str | None = None
    """A parameter that has to be positive, such as the size of a dead zone."""
    step: Any = None
    """Step of preparation that the change adds: the rows of the trial have the others already."""
    mends: bool = False
    """True if the step leaves out samples: on the others the present model is judged, too."""
    untried: str = ""
    """Why a free run would not show its effect, as a sentence; empty of what is tried."""
    restarts: bool = False
    """True if it changes initial values alone."""
    replaces: bool = False
    """True if a term takes the learner's place: its parameters are then the physics' alone, so that
    it is advised where it does as well."""
    narrows: bool = False
    """True if the learner sees less: fewer rows may determine it then."""
    ahead: tuple[float, float] | None = None
    """What errors' past does not predict of them, without the change and with it, where that shows
    it: beside slow disturbances its gain in a free run is hidden."""

    def accepts(self, fit: Any) -> bool:
        """Return whether the result of a changed spec agrees with the words of the proposal."""
        if self.positive is None:
            return True
        return bool(fit.parameters.loc[self.positive, "value"] > 0)


def apply_change(declaration: dict[str, object], change: dict[str, Any]) -> dict[str, Any]:
    """Return a declaration with the values of a change; dots in a key separate its levels."""
    found = deepcopy(declaration)
    for key, value in change.items():
        *path, last = key.split(".")
        place = found
        for part in path:
            place = place.setdefault(part, {})
            if not isinstance(place, dict):
                raise InputError(f"'{key}': '{part}' is no table.")
        place[last] = value
    return found


def changed_job(job: Job, change: dict[str, Any]) -> Job:
    """Return the job of a changed spec on the same data.

    Raises:
        InputError: the change is not possible; ValueError likewise.
    """
    declared = apply_change(job.declaration, change)
    context = {"folder": job.path.parent}
    return job_of_change(job, spec_model().model_validate(declared, context=context))


def mending_proposals(job: Job, result: FitResult, fit: Estimate) -> list[Proposal]:
    """Return the changes that warnings on the record name as their remedies.

    What the record shows wrongly looks like missing physics, so these come before all others.
    """
    record, found = job.train.record, []
    known = {(warning.code, warning.text) for warning in result.warnings}
    codes = {code for code, _ in known}
    motion = job.physics.section == "motion"
    if "exchanged_columns" in codes:
        found += _exchange(job)
    if "unit_mismatch" in codes:
        found += _conversions(job)
    in_memory = job.train.source is None
    wrong = [one for one in mendings(record) if tuple(one.warning) in known] if in_memory else []
    wrong += wild_row_mendings(fit) if in_memory and "wild_rows" in codes else []
    for mending in wrong:
        name, output = mending.step["step"], mending.output
        if name == "repeats" and not motion:
            continue
        steps = [*job.declaration["data"].get("prepare", []), mending.step]
        change: dict[str, Any] = {"data.prepare": steps}
        step = STEPS.declare(name, {k: v for k, v in mending.step.items() if k != "step"})
        if name == "unwrap":
            words = f'{output} unwrapped (step = "unwrap" of data.prepare)'
            found.append(Proposal(words, change, step=step, untried=_OTHER_OUTPUT))
            continue
        change |= {"data.missing": "keep"} if motion else {}
        ends = [f"{mending.step[key]:.6g}" for key in ("low", "high") if key in mending.step]
        which = {"repeats": "repeats", "outliers": "wrong samples"}.get(
            name, f"samples at {join_words(ends)}"
        )
        how = f'step = "{name}" of data.prepare'
        if "threshold" in mending.step:
            how += f" with threshold = {mending.step['threshold']:g}"
        words = f"{which} of {output} marked as missing ({how})"
        found.append(Proposal(words, change, step=step, mends=True))
    return found


def _exchange(job: Job) -> Iterator[Proposal]:
    """Yield the columns of the only output and of an input that seems to be its cause exchanged."""
    record = job.train.record
    name, output = exchanged_with_output(record), record.outputs[0]
    given = next((channel for channel in record.inputs if channel.name == name), None)
    if given is not None:
        change = {
            f"data.channels.{name}.column": output.file_column,
            f"data.channels.{output.name}.column": given.file_column,
        }
        words = f"the columns of {name} and {output.name} exchanged"
        yield Proposal(words, change, untried=_OTHER_OUTPUT)


def _conversions(job: Job) -> Iterator[Proposal]:
    """Yield the scales and offsets by which columns have the units of their channels."""
    change: dict[str, Any] = {}
    words = []
    for fault in training_unit_faults(job.path, job.spec):
        if fault.right is not None:
            key = f"data.channels.{fault.channel}"
            change[f"{key}.scale"] = float(f"{fault.right.scale:.6g}")
            words.append(f"scale = {fault.right.scale:.6g} of {fault.channel}")
            if fault.right.offset:
                change[f"{key}.offset"] = float(f"{fault.right.offset:.6g}")
                words[-1] += f" and its offset = {fault.right.offset:.6g}"
    if change:
        yield Proposal(f"{join_words(words)} (data.channels)", change, untried=_OTHER_UNIT)


def noise_model_proposals(fit: Estimate, result: FitResult) -> list[Proposal]:
    """Return a noise model where θ is inconsistent and training on the free run is no better."""
    compared = fit.focus is not None and fit.focus.tried("simulation")
    if not compared or all(warning.code != "inconsistent" for warning in result.warnings):
        return []
    words = 'a noise model (`noise.model` = "auto")'
    return [Proposal(words, {"noise.model": "auto"}, untried=_OTHER_NOISE)]


def proposals(job: Job, result: FitResult, fit: Estimate) -> list[Proposal]:
    """Return what the findings of a fit suggest, the likeliest first, each once."""
    if (
        result.residuals is not None
        and result.residuals.verdict == "white"
        and not result.residuals.changes
    ):
        biased = _is_biased(result)
        kinds = (_in_place_of_learner, _suspected_terms) if biased else ()
        return _unique_proposals([one for kind in kinds for one in kind(job, result, fit)])
    late = list(_late_inputs(job, result))
    if any(proposal.ahead for proposal in late):  # beside it other causes are mistaken
        return _unique_proposals([proposal for proposal in late if proposal.ahead])
    states = list(_missing_states(job, result))
    first, then = (states, late) if states and _state_explains_more(result) else (late, states)
    first = [*_without_headings(job), *first]
    likely, holds = _holds(job, result)
    found = [
        *first,
        *(Proposal(words, change) for change, words in job.physics.with_delays(job)),
        *then,
        *likely,
        *_missing_terms(job, result),
        *_in_place_of_learner(job, result, fit),
        *_suspected_terms(job, result, fit),
        *_predicted_changes(job, result, fit),
        *_learner_for_equation(job, result, fit),
        *holds,
    ]
    # A learner takes longest
    return _unique_proposals(
        sorted(found, key=lambda proposal: proposal.learns and proposal not in first)
    )


def _unique_proposals(found: list[Proposal]) -> list[Proposal]:
    """Return the proposals in their order, each at the first of its places."""
    first: dict[str, Proposal] = {}
    for proposal in found:
        first.setdefault(proposal.words, proposal)
    return list(first.values())


def _is_biased(result: FitResult) -> bool:
    return any(
        row.bias is not None for row in (*result.parameters, *(result.physical_parameters or ()))
    )


def _late_inputs(job: Job, result: FitResult) -> Iterator[Proposal]:
    """Yield a lag or a shift of each input that acts late: the better, and both where alike."""
    for late in result.residuals.late if result.residuals is not None else ():
        kinds = (_lag, _delay) if late.by_lag else (_delay, _lag)
        for kind in kinds if late.alike else kinds[:1]:
            after = late.lagged if kind is _lag else late.delayed
            shown = (float(late.declared or 0.0), float(after or 0.0)) if late.ahead else None
            yield from (replace(proposal, ahead=shown) for proposal in kind(job, late))


def _lag(job: Job, late: LateInputResult) -> Iterator[Proposal]:
    """Yield a state for an input, if the physics can have one."""
    made = job.physics.with_lag(job, late, _new_name(job, "T"))
    if made is not None:
        change, words = made
        yield Proposal(words, change)


def _delay(job: Job, late: LateInputResult) -> Iterator[Proposal]:
    """Yield a shift of an input in the preparation of the data."""
    step = Shift(late.input, late.delay)
    steps = [dict(one) for one in job.declaration["data"].get("prepare", [])]
    if steps and steps[-1]["step"] == "shift" and steps[-1]["channel"] == late.input:
        steps[-1]["samples"] = round(steps[-1]["samples"] + late.delay, 10)
    else:
        steps.append({"step": "shift", "channel": late.input, "samples": late.delay})
    moved = f"{plural(abs(late.delay), 'sample')} {'later' if late.delay > 0 else 'earlier'}"
    words = f'{late.input} {moved} (step = "shift" of data.prepare)'
    yield Proposal(words, {"data.prepare": steps}, step=step)


def _missing_states(job: Job, result: FitResult) -> Iterator[Proposal]:
    """Yield the state whose lack the free run's error shows most clearly.

    A lag of an input that acts late is proposed as that.
    """
    found = result.unexplained
    late = {one.input for one in result.residuals.late} if result.residuals is not None else set()
    names = _new_name(job, "z"), _new_name(job, "T"), _new_name(job)
    for missing in found.memory if found is not None and found.hidden_state else ():
        if missing.kind == "lag" and missing.on in late:
            return
        made = job.physics.with_state(job, missing, names)
        if made is not None:
            change, words = made
            yield Proposal(words, change)
        else:
            yield from _remembering_learner(job)
        return


def _remembering_learner(job: Job) -> Iterator[Proposal]:
    """Yield a learner with a state of its own, for physics that cannot have the missing one."""
    declared = job.declaration.get("learner", {})
    if declared.get("states"):
        return
    change: dict[str, Any] = {"learner.states": 1}
    words = f"{MISSING_STATE} in the learner (learner.states = 1)"
    lagged = job.physics.section != "motion"
    if declared.get("kind", _NETWORK) != _NETWORK:
        if not lagged:  # where to add a network is not known
            return
        change = {"learner": {"kind": _NETWORK, "hidden": [_NEURONS], "states": 1}}
        words = f"{MISSING_STATE} in a network of {_NEURONS} neurons (learner.states = 1)"
    elif job.spec.declared_learner() is None:
        return
    present = [lag.channel for lag in job.problem.layout if lag.lag == 0] if lagged else []
    if len(present) > 1:  # a trial prepares its rows by one step
        return
    step = Shift(present[0], -1) if present else None
    yield Proposal(words, change, learns=True, refocuses=True, step=step)


def _state_explains_more(result: FitResult) -> bool:
    """Return whether a missing state explains more of the free run's error than a late input."""
    memory = result.unexplained.memory if result.unexplained is not None else []
    late = result.residuals.late if result.residuals is not None else []
    left = [
        min(float(one.delayed or 0.0), float(one.lagged or 0.0)) / float(one.declared or math.inf)
        for one in late
    ]
    return bool(memory) and 1 - float(memory[0].share or 0.0) < min(left, default=math.inf) ** 2


def _missing_terms(job: Job, result: FitResult) -> Iterator[Proposal]:
    """Yield the terms that the free run of a motion lacks."""
    test = result.residuals.missing if result.residuals is not None else None
    if test is None or result.residuals is None or result.residuals.verdict != "unmodelled":
        return
    for term in test.terms[:_TERMS]:
        place = term.equation or term.output or term.beside
        note = ""
        if term.saturates is not None:
            note = f" (the input {term.variable} saturates at a size of {term.saturates:.3g})"
        yield from _term(job, term.term, place, term.coefficient, note=note)


def _suspected_terms(job: Job, result: FitResult, fit: Any) -> Iterator[Proposal]:
    """Yield the suspects that explain most of the learned part, or of the physics' residual."""
    left, found = job.physics.explained_residual(fit), []
    for entry in result.bias or ():
        if entry.memory is not None:  # no expression of one row is that term
            continue
        share, size = entry.explained, entry.coefficient_found
        if entry.residual is not None:
            share, size = entry.residual.share, entry.residual.coefficient
        elif left is not None:
            share, size = left(entry)
        positive = entry.name.startswith(_ZONE)
        if (share or 0.0) > _LITTLE and not (
            positive and (size or 0.0) < 0
        ):  # that would be no dead zone
            found.append((share or 0.0, entry, size, positive))
    for _, entry, size, positive in sorted(found, key=lambda one: -one[0])[:_TERMS]:
        place, size = entry.equation or entry.output, size or entry.coefficient
        yield from _term(job, entry.expression, place, size, positive=positive)


def _in_place_of_learner(job: Job, result: FitResult, fit: Estimate) -> Iterator[Proposal]:
    """Yield the terms that explain most of the learner together, with no learner beside them."""
    biases = [row.bias for row in result.parameters if row.bias is not None]
    causes = {bias.cause for bias in biases if (bias.share or 0.0) > _MOST}
    causes |= {name for cause in causes for name in cause.split(" and ")}  # of several equations
    change: dict[str, Any] = {}
    words = []
    for entry in result.bias or () if fit.learns else ():
        if entry.name in causes and entry.memory is None:
            place, size = entry.equation or entry.output, entry.coefficient_found
            beside = changed_job(job, change) if change else job
            for term in _term(beside, entry.expression, place, size):
                change |= term.change
                words.append(term.words)
    if words:
        change |= {"learner.kind": "none"}
        yield Proposal(f"{join_words(words)} {IN_PLACE}", change, replaces=True)


def _term(
    job: Job,
    expression: str,
    place: str | None,
    size: float | None,
    words: str = "",
    *,
    positive: bool = False,
    note: str = "",
) -> Iterator[Proposal]:
    """Yield the proposal to add a term, with its coefficient as a new parameter.

    Yields nothing where the spec has the term already.
    """
    name = _new_name(job)
    made = job.physics.with_term(job, name, expression, place, float(size or 0.0))
    if made is not None:
        change, where = made
        what = words or ("a constant" if expression == "1" else f"the term {expression}")
        yield Proposal(f"{what} {where}{note}", change, positive=name if positive else None)


def _new_name(job: Job, word: str = "size") -> str:
    """Return a name for a parameter that the spec does not use."""
    spec, number = job.spec, 1
    taken = {*spec.data.inputs, *spec.data.outputs, *job.physics.names_taken(spec)}
    while (name := f"{word}{number if number > 1 else ''}") in taken:
        number += 1
    return name


def _predicted_changes(job: Job, result: FitResult, fit: Any) -> Iterator[Proposal]:
    """Yield the changes of lagged physics for which its residual predicts a gain."""
    for change in result.residuals.changes if result.residuals is not None else ():
        if change.kind in ("input_lag", "output_lag", "offset"):
            yield from _term(job, change.what, change.output, None, _lag_words(change))
        elif change.kind == "learner":
            yield from _learner(job, result, fit)
        elif (
            change.kind == "criterion"
            and not _has_compared_criteria(result)
            and change.what != CRITERIA.kind_of(fit.criterion)
        ):
            yield Proposal(
                f'focus = "{change.what}"', {"training.focus": change.what}, refocuses=True
            )


def _has_compared_criteria(result: FitResult) -> bool:
    """Return whether the fit itself has already tried both criteria."""
    return result.focus is not None and bool(result.focus.candidates)


def _lag_words(change: Change) -> str:
    return "an offset" if change.kind == "offset" else f"the further lag {change.what}"


def _learner(job: Job, result: FitResult, fit: Any) -> Iterator[Proposal]:
    """Yield a learner where none was tried, one that sees more, one of more neurons."""
    from orthaug.physics.shared import seen_columns

    spec, problem, bound = job.spec, job.problem, fit.model.form.bound
    unread = [str(lag) for lag in problem.unread_lags]
    if unread:
        now = spec.learner_inputs() or [str(lag) for lag in problem.layout]
        new = {"learner.inputs": [*now, *unread]}
        change = {"learner": {"kind": _NETWORK}} if spec.declared_learner() is None else {}
        words = f"a learner that also sees {join_words(unread)}"
        yield Proposal(words, change | new, learns=True)
    if spec.declared_learner() is None:
        yield Proposal("a learner", {"learner": {"kind": _NETWORK}}, learns=True)
        return
    if not bound.learns:  # it was tried, and physics alone was better
        return
    visible = seen_columns(problem.features, problem.layout, problem.rows.x, lambda rows: rows)
    hidden = [str(lag) for lag, one in zip(problem.layout, visible, strict=True) if not one]
    now = spec.learner_inputs()
    if hidden and now is not None:
        yield Proposal(
            f"a learner that also sees {', '.join(hidden)}",
            {"learner.inputs": [*now, *hidden]},
            learns=True,
        )
    wild = any(warning.code == "wild_rows" for warning in result.warnings)
    widths = getattr(bound.learner, "hidden", None)
    if not hidden and widths and not wild:
        wider = [_WIDER * width for width in widths]
        yield Proposal(
            f"a learner of {' and '.join(map(str, wider))} neurons",
            {"learner.hidden": wider},
            learns=True,
        )


def _without_headings(job: Job) -> Iterator[Proposal]:
    """Yield a learner that does not see the states of a motion that no equation reads.

    A heading, or the position of what no spring holds, does not come back to where it was: what is
    learned of it over some rows holds for no others. Of a motor and its load on an elastic shaft
    equations read the difference alone, and so may the learner.
    """
    problem = job.problem
    network = job.declaration.get("learner", {}).get("kind", _NETWORK) == _NETWORK
    if job.physics.section != "motion" or job.spec.declared_learner() is None or not network:
        return
    motion = problem.motion
    if motion.functions is not None:
        return
    read = motion.names_in(*motion.equations.values())
    seen = [feature.text for feature in problem.features]
    unread = [name for name in seen if name in motion.names_of_states and name not in read]
    apart = [one for one in _free_differences(motion) if one.names <= set(seen)]
    replaced = {name for one in apart for name in one.names}
    kept = [str(one) for one in apart]
    kept += [text for text in seen if text not in unread and text not in replaced]
    if not kept:
        return
    words = []
    if unread:
        reads = f"no equation reads {'it' if len(unread) == 1 else 'them'}"
        words.append(f"does not see {join_words(unread)} ({reads})")
    if apart:
        reads = f"equations read only their difference{'s' * (len(apart) > 1)}"
        names = join_words([name for name in seen if name in replaced])
        words.append(f"sees {join_words(kept[: len(apart)])} in place of {names} ({reads})")
    if words:
        change = {"learner.inputs": kept}
        yield Proposal(f"a learner that {join_words(words)}", change, learns=True, narrows=True)


def _free_differences(motion: Motion) -> list[Difference]:
    """Return the differences of states that equations read in no other way.

    None of a state that is compared with an input, which holds it.
    """
    trees = [one.tree for one in motion.equations.values()]
    trees += [one.tree for _, one in motion.definitions]
    every = motion.differences
    held = {name for tree in trees for name in _names_by_themselves(tree, motion)}
    held |= {*motion.visible} - {*motion.visible_states}
    while joined := {name for one in every if held & one.names for name in one.names} - held:
        held |= joined
    return [one for one in every if not held & one.names]


def _names_by_themselves(node: ast.AST, motion: Motion) -> Iterator[str]:
    """Yield the names in an expression that are in none of the motion's differences."""
    found = difference_of(node, dict(motion.constants))
    if found is not None and any(found.sides == one.sides for one in motion.differences):
        return
    if isinstance(node, ast.Name):
        yield node.id
    for child in ast.iter_child_nodes(node):
        yield from _names_by_themselves(child, motion)


def _learner_for_equation(job: Job, result: FitResult, fit: Any) -> Iterator[Proposal]:
    """Yield proposals of a learner in the equation of a motion that lacks something.

    Where there is one already, it is given the signals that the missing part depends on.
    """
    test = result.residuals.missing if result.residuals is not None else None
    if test is None or not test.terms or result.residuals is None:
        return
    best = test.terms[0]
    if result.residuals.verdict != "unmodelled" or best.variable is None:
        return
    if job.spec.declared_learner() is None:
        if best.beside is not None:  # of several equations that have the input
            return
        if best.equation is None:
            own = declared_output(job, str(best.output))
            learned = {f"motion.outputs.{best.output}": own | {"learned": True}}
        else:
            learned = {f"motion.states.{best.equation}.learned": True}
        change = {**learned, "learner": {"inputs": list(best.variables)}}
        seen = join_words(best.variables)
        words = f"a learner that sees {seen} in {best.place}"
        yield Proposal(words, change, learns=True)
        return
    now = job.spec.learner_inputs()
    learned = {job.problem.motion.names_of_states[i] for i in job.problem.motion.learned[0]}
    if not fit.learns or now is None or best.equation not in learned:
        return
    new = [name for name in best.variables if not _reads(now, name)]
    if new:
        change = {"learner.inputs": [*now, *new]}
        yield Proposal(f"a learner that also sees {join_words(new)}", change, learns=True)


def _reads(inputs: tuple[str, ...], variable: str) -> bool:
    return any("".join(text.split()) == variable for text in inputs)


def _holds(job: Job, result: FitResult) -> tuple[list[Proposal], list[Proposal]]:
    """Return the hold that the inputs themselves follow best, if it is another, and all others.

    None where an input is recorded in steps: another hold would only fit better by chance.
    """
    if result.residuals is None or result.residuals.verdict != "unmodelled":
        return [], []
    holds, likely = job.physics.other_holds(job.spec), 0
    if holds and job.train.source is None:
        record = job.train.record
        if is_stepped(record):
            holds = tuple(hold for hold in holds if hold == "zero-order")
        else:
            ranked = sort_holds(record, HOLDS)
            holds = tuple(hold for hold in ranked if hold in holds)
            likely = int(ranked[0] in holds)
    found = [Proposal(f'hold = "{hold}"', {"motion.hold": hold}) for hold in holds]
    return found[:likely], found[likely:]
