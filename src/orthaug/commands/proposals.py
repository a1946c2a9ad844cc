"""Changes of a spec that its result suggests: terms for the physics, lags, other learners, holds, another focus.

Nothing here says that a change helps: `advice` refits each. None is what the spec has already.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from orthaug.analysis.suspects import Suspect
from orthaug.commands.job import Job
from orthaug.data.expressions import SAMPLING_TIME
from orthaug.fitting.kinds import CRITERIA
from orthaug.physics.motion import HOLDS
from orthaug.reports.findings import ChangeResult, SuspectResult
from orthaug.reports.result import FitResult

_SHAPES = {"linear": "{}", "jump": "sign({})", "absolute": "abs({})", "square": "{}**2", "cube": "{}**3"}
_TERMS = 3  # suspected terms that are proposed
_LITTLE = 0.05  # of what was learned or left: what explains less is not proposed
_ROWS = 20_000  # of the residual that are looked at
_SPANNED = 1e-9  # of a term's squares: what is left of it beside the physics where it is physics
_WIDER = 2  # times the neurons
_ZONE = "dead_zone"


@dataclass(frozen=True, eq=False)
class Proposal:
    """A change of a spec: `words` that go on from "with", and the new values by their keys."""

    words: str
    change: dict[str, Any]
    learns: bool = False
    """Whether it is about a learner, which physics alone would not show."""
    refocuses: bool = False
    positive: str | None = None
    """A parameter that has to be positive, as the size of a dead zone."""

    def accepts(self, fit: Any) -> bool:
        """Whether a fit of the changed spec is what the words say."""
        if self.positive is None:
            return True
        return bool(fit.parameters.loc[self.positive, "value"] > 0)


def proposals(job: Job, result: FitResult, fit: Any) -> list[Proposal]:
    """Return what the findings of a fit suggest, the likeliest first, each once."""
    if result.residuals is not None and result.residuals.verdict == "white" and not result.residuals.changes:
        return _once(list(_suspected_terms(job, result, fit)) if _biased(result) else [])
    found = [
        *_missing_terms(job, result),
        *_suspected_terms(job, result, fit),
        *_predicted_changes(job, result, fit),
        *_learner_for_equation(job, result, fit),
        *_holds(job, result),
    ]
    return _once(sorted(found, key=lambda proposal: proposal.learns))  # a learner takes longest


def _once(found: list[Proposal]) -> list[Proposal]:
    return list({proposal.words: proposal for proposal in reversed(found)}.values())[::-1]


def _biased(result: FitResult) -> bool:
    return any(row.bias is not None for row in (*result.parameters, *(result.physical_parameters or ())))


def _missing_terms(job: Job, result: FitResult) -> Iterator[Proposal]:
    """Terms that the free run of a motion asks for."""
    test = result.residuals.missing if result.residuals is not None else None
    if test is None or result.residuals is None or result.residuals.verdict != "unmodelled":
        return
    for term in test.terms[:_TERMS]:
        text = "1" if term.variable is None else _SHAPES[term.shape].format(term.variable)
        words = "a constant" if term.variable is None else ""
        yield from _term(job, text, term.equation, term.coefficient, words)


def _suspected_terms(job: Job, result: FitResult, fit: Any) -> Iterator[Proposal]:
    """The suspects that explain most of what the learner found, or of what the physics leaves."""
    plain = job.spec.motion is None and fit.model.form.bound is None and len(fit.theta) > 0
    left = _residual_columns(fit) if plain else None
    found = []
    for entry in result.bias or ():
        share, size = entry.explained, entry.coefficient_found
        if entry.residual is not None:
            share, size = entry.residual.share, entry.residual.coefficient
        elif left is not None:
            share, size = _residual_share(fit, entry, *left)
        positive = entry.name.startswith(_ZONE)
        if (share or 0.0) > _LITTLE and not (positive and (size or 0.0) < 0):  # that would be no dead zone
            found.append((share or 0.0, entry, size, positive))
    for _, entry, size, positive in sorted(found, key=lambda one: -one[0])[:_TERMS]:
        where = entry.output if job.spec.motion is None else entry.equation
        yield from _term(job, entry.expression, where, size or entry.coefficient, "", positive=positive)


def _residual_columns(fit: Any) -> tuple[np.ndarray, np.ndarray]:
    """An orthonormal basis of the physics (N ny, nθ) and the one-step residual beside it (N ny,), in deviations."""
    problem = fit.problem
    x, unit = problem.rows.x[:: _every(fit)], problem.deviation
    phi = np.asarray(problem.baseline.phi(x, problem.layout, problem.outputs, np)) / unit[:, None]
    basis = np.linalg.qr(phi.reshape(-1, phi.shape[2]))[0]
    runs = fit.model.predict(problem.record).trajectories
    error = np.concatenate([(run.measured - run.model)[problem.rows.start :] for run in runs])[:: _every(fit)] / unit
    return basis, error.ravel() - basis @ (basis.T @ error.ravel())


def _every(fit: Any) -> int:
    """Of so many rows one is looked at."""
    return 1 + len(fit.problem.rows.x) // _ROWS


def _residual_share(fit: Any, entry: SuspectResult, basis: np.ndarray, error: np.ndarray) -> tuple[float, float]:
    """The share of the one-step residual that a suspect explains beside the physics, and its coefficient."""
    problem = fit.problem
    constants = {SAMPLING_TIME: problem.record.sampling_time} | dict(problem.baseline.constants)
    suspect = Suspect(entry.name, entry.expression, entry.output, constants=constants)
    column = suspect.values(problem.rows.x[:: _every(fit)], problem.layout, problem.outputs) / problem.deviation
    rest = column.ravel() - basis @ (basis.T @ column.ravel())
    along, size = float(rest @ error), float(rest @ rest)
    if not size > _SPANNED * float(column.ravel() @ column.ravel()):
        return 0.0, 0.0
    return along**2 / size / max(float(error @ error), np.finfo(float).tiny), along / size


def _term(
    job: Job, expression: str, equation: str | None, size: float | None, words: str, *, positive: bool = False
) -> Iterator[Proposal]:
    """The proposal of a term with its size as a parameter; nothing where the spec has the term."""
    spec, declared = job.spec, job.declaration
    name, initial = _new_name(job), float(size or 0.0)
    if spec.motion is not None:
        equation = _equation(job, equation)
        if equation is None:
            return
        places = declared["motion"]["states"]
        key = "next" if spec.motion.integrator == "discrete" else "derivative"
        own = str(places[equation][key])
        if f"*{_squeezed(expression)}" in _squeezed(own):
            return
        change: dict[str, Any] = {
            f"motion.states.{equation}.{key}": f"{own} + {name}*({expression})",
            f"motion.parameters.{name}": {"initial": initial},
        }
        where = f"in the equation of {equation}"
    else:
        terms = declared["baseline"]["terms"]
        several = len(spec.data.outputs) > 1
        if any(_same(str(term["regressor"]), expression, term.get("output"), equation) for term in terms):
            return
        own_output = {"output": equation} if several and equation is not None else {}
        change = {"baseline.terms": [*terms, {"parameter": name, "regressor": expression, **own_output}]}
        if spec.physics is not None:
            change[f"physics.parameters.{name}"] = {"initial": initial or 1.0}
            change[f"physics.theta.{name}"] = name
        where = f"in the physics{f' of {equation}' if several and equation is not None else ''}"
    what = words or f"the term {expression}"
    yield Proposal(f"{what} {where}", change, positive=name if positive else None)


def _equation(job: Job, equation: str | None) -> str | None:
    """The state whose equation a term goes to; None for a term of an output."""
    from orthaug.analysis.motion_suspects import equations_of, usual_places

    motion = job.problem.motion
    if equation is None:
        places = usual_places(motion)
        equation = equations_of(motion)[places[0]] if len(places) == 1 else None
    return equation if equation in motion.names_of_states else None


def _new_name(job: Job) -> str:
    """A parameter that the spec does not have."""
    spec, number = job.spec, 1
    taken = set(spec.data.inputs) | set(spec.data.outputs)
    if spec.motion is not None:
        taken |= {*spec.motion.states, *spec.motion.parameters, *spec.motion.define, *spec.motion.constants}
    elif spec.baseline is not None:
        taken |= {term.parameter for term in spec.baseline.terms} | set(spec.baseline.constants)
        taken |= set(spec.physics.parameters) if spec.physics is not None else set()
    while (name := f"size{number if number > 1 else ''}") in taken:
        number += 1
    return name


def _squeezed(text: str) -> str:
    return "".join(text.split())


def _same(one: str, other: str, output: str | None, equation: str | None) -> bool:
    return _squeezed(one) == _squeezed(other) and (output is None or equation is None or output == equation)


def _predicted_changes(job: Job, result: FitResult, fit: Any) -> Iterator[Proposal]:
    """The changes that the residual of lagged physics predicts a gain of."""
    for change in result.residuals.changes if result.residuals is not None else ():
        if change.kind in ("input_lag", "output_lag", "offset"):
            yield from _term(job, change.what, change.output, None, _lag_words(change))
        elif change.kind == "learner":
            yield from _learner(job, result, fit)
        elif change.kind == "criterion" and not _compared(result) and change.what != CRITERIA.kind_of(fit.criterion):
            yield Proposal(f'focus = "{change.what}"', {"training.focus": change.what}, refocuses=True)


def _compared(result: FitResult) -> bool:
    """Whether both criteria were tried by the fit itself."""
    return result.focus is not None and bool(result.focus.candidates)


def _lag_words(change: ChangeResult) -> str:
    return "an offset" if change.kind == "offset" else f"the further lag {change.what}"


def _learner(job: Job, result: FitResult, fit: Any) -> Iterator[Proposal]:
    """A learner where none was tried, one that sees more, one of more neurons."""
    from orthaug.physics.shared import seen

    spec, problem, bound = job.spec, job.problem, fit.model.form.bound
    if spec.motion is not None:
        return
    if spec.declared_learner() is None:
        yield Proposal("a learner", {"learner": {"kind": "mlp"}}, learns=True)
        return
    if bound is None:  # it was tried, and physics alone was better
        return
    visible = seen(problem.features, problem.layout, problem.rows.x, lambda rows: rows)
    hidden = [str(lag) for lag, one in zip(problem.layout, visible, strict=True) if not one]
    now = spec.learner_inputs()
    if hidden and now is not None:
        yield Proposal(
            f"a learner that also sees {', '.join(hidden)}", {"learner.inputs": [*now, *hidden]}, learns=True
        )
    wild = any(warning.code == "wild_rows" for warning in result.warnings)
    widths = getattr(bound.learner, "hidden", None)
    if not hidden and widths and not wild:
        wider = [_WIDER * width for width in widths]
        yield Proposal(f"a learner of {' and '.join(map(str, wider))} neurons", {"learner.hidden": wider}, learns=True)


def _learner_for_equation(job: Job, result: FitResult, fit: Any) -> Iterator[Proposal]:
    """A learner in the equation of a motion that lacks something, or one that sees what it lacks a function of."""
    test = result.residuals.missing if result.residuals is not None else None
    if job.spec.motion is None or test is None or not test.terms or result.residuals is None:
        return
    best = test.terms[0]
    if result.residuals.verdict != "unmodelled" or best.variable is None:
        return
    if job.spec.declared_learner() is None:
        change = {f"motion.states.{best.equation}.learned": True, "learner": {"inputs": [best.variable]}}
        words = f"a learner that sees {best.variable} in the equation of {best.equation}"
        yield Proposal(words, change, learns=True)
        return
    now = job.spec.learner_inputs()
    learned = {job.problem.motion.names_of_states[i] for i in job.problem.motion.learned[0]}
    if fit.model.form.bound is None or now is None or best.equation not in learned or _reads(now, best.variable):
        return
    change = {"learner.inputs": [*now, best.variable]}
    yield Proposal(f"a learner that also sees {best.variable}", change, learns=True)


def _reads(inputs: tuple[str, ...], variable: str) -> bool:
    return any(_squeezed(text) == variable for text in inputs)


def _holds(job: Job, result: FitResult) -> Iterator[Proposal]:
    """The holds of its inputs that a motion does not have."""
    motion = job.spec.motion
    if motion is None or not job.spec.data.inputs or motion.integrator == "discrete":
        return
    if result.residuals is None or result.residuals.verdict != "unmodelled":
        return
    for hold in HOLDS:
        if hold != motion.hold:
            yield Proposal(f'hold = "{hold}"', {"motion.hold": hold})
