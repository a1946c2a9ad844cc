"""Equations of motion, in a job: posed, trained, analysed."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from orthaug._base.errors import InputError, KeyedError, RankError, Warning
from orthaug.analysis.memory import derivative_of, next_of
from orthaug.analysis.suspects import MotionSuspect
from orthaug.commands.job import (
    MISSING_STATE,
    Job,
    JobPhysics,
    Variant,
    declared_output,
    selected_form,
)
from orthaug.commands.spec import Spec, spec_error
from orthaug.commands.suspects import declared_terms
from orthaug.data.expressions import FUNCTIONS
from orthaug.data.record import Record
from orthaug.data.scales import describe_scales
from orthaug.fitting.rules import check_motion_choices, check_solver, choose_regularizations
from orthaug.inference.measures import Measure, Support
from orthaug.physics.learner_states import LearnerStates
from orthaug.physics.motion import HOLDS, Motion
from orthaug.physics.parameters import time_unit
from orthaug.physics.problem import MotionProblem, pose_motion
from orthaug.physics.shared_forces import shared_forces
from orthaug.reports.result import CheckResult

if TYPE_CHECKING:
    from orthaug.analysis.design import Design
    from orthaug.analysis.findings import LateInputResult, MemoryResult
    from orthaug.analysis.input_timing import Trial
    from orthaug.fitting.motion_estimate import MotionEstimate
    from orthaug.models.response import Response
    from orthaug.reports.drawing import Figure
    from orthaug.studies.planted import System

_STIFF = 20  # substeps from which a motion is called stiff for its sampling
_NOT_RICH = Warning(
    "rich_inputs_run_away",
    "physics alone diverges under rich inputs, so identifiability is computed for the inputs "
    "of the record.",
)


@dataclass(frozen=True, eq=False)
class MotionPhysics(JobPhysics[MotionProblem, "MotionEstimate"]):
    """Equations of motion, and the terms that they may lack."""

    motion: Motion
    suspects: tuple[MotionSuspect, ...] = ()

    section: ClassVar[str] = "motion"
    runs_in_check: ClassVar[bool] = True
    most_trials: ClassVar[int] = 2

    @classmethod
    def declare(cls, spec: Spec, step: float | None) -> Self:
        assert spec.motion is not None
        try:
            motion = spec.declared_motion()
            motion.check_channels(spec.data.inputs, spec.data.outputs)
        except InputError as error:
            text = str(error)
            where = "motion" if spec.motion.source is None else "physics.source"
            own = text.startswith("controller:")
            text = text if own else f"{where}: {text.removeprefix('motion.')}"
            raise InputError(text) from None
        try:
            learner, structure = spec.declared_learner(), spec.declared_structure()
            solver, criterion = spec.declared_solver(), spec.declared_criterion()
            check_motion_choices(motion, learner, structure, criterion, solver)
            given, validated = spec.training.regularization, spec.data.validation is not None
            conditions = {"linear": False, "validated": validated, "learner": learner}
            choices = choose_regularizations(given, solver, criterion, structure, **conditions)
            check_solver(solver, criterion, choices)
        except KeyedError as error:
            raise spec_error(error) from None
        return cls(motion)

    @property
    def declared_units(self) -> dict[str, str]:
        """Units of the parameters, as declared, by their names."""
        return {parameter.name: parameter.unit for parameter in self.motion.parameters}

    @property
    def files(self) -> tuple[Path, ...]:
        return () if self.motion.source is None else self.motion.source.files

    def names_taken(self, spec: Spec) -> set[str]:
        motion, controller = self.motion, spec.controller
        others = {name for name, _ in (*motion.definitions, *motion.constants)}
        taken = {*motion.names_of_states, *motion.names, *others}
        if controller is not None:
            taken |= {*controller.outputs, *controller.states, *controller.parameters}
            taken |= {*controller.define, *controller.constants}
        return taken

    def with_term(
        self, job: Job, name: str, expression: str, place: str | None, initial: float
    ) -> tuple[dict[str, Any], str] | None:
        """Return the change of a spec that adds a term of an equation, and where that is, in words.

        A term of an input acts as that does, wherever it is. None where the equation has the term
        already.
        """
        if (found := self._added_term(job, name, expression, place)) is None:
            return None
        change, where = found
        parameter = {"initial": initial} | selected_form(expression)
        return change | {f"motion.parameters.{name}": parameter}, where

    def _added_term(
        self, job: Job, name: str, expression: str, place: str | None
    ) -> tuple[dict[str, Any], str] | None:
        """Return the equations with a term, and where it is."""
        from orthaug.physics.suspected_motion import equations_of, usual_places

        motion, added = self.motion, f"{name}*({expression})"
        if motion.functions is not None or not _reads_only(motion, expression):
            return None
        varying = (*motion.names_of_states, *motion.inputs)
        if place is None:
            places = usual_places(motion)
            place = equations_of(motion)[places[0]] if len(places) == 1 else None
        of_output = {output.name for output in motion.outputs} - {*motion.names_of_states}
        if place in of_output:
            now = declared_output(job, str(place))
            own = now["expression"]
            if _has_term(own, expression, varying):
                return None
            change = {f"motion.outputs.{place}": now | {"expression": f"{own} + {added}"}}
            return change, f"in the equation of the output {place}"
        if place in motion.inputs:
            return self._in_place_of_input(job, place, f"({place} + {added})"), (
                f"beside the input {place}"
            )
        for force in shared_forces(motion):
            if place == str(force):
                own = partial(force.with_added, added=added, constants=dict(motion.constants))
                change = self._rewritten(job, own)
                return change, f"beside every {place}"
        if place not in motion.names_of_states:
            return None
        key = motion.equation_key
        own = str(job.declaration["motion"]["states"][place][key])
        if _has_term(own, expression, varying):
            return None
        return {f"motion.states.{place}.{key}": f"{own} + {added}"}, f"in the equation of {place}"

    def _in_place_of_input(self, job: Job, name: str, expression: str) -> dict[str, Any]:
        """Return the change that gives an input another value."""
        word = re.compile(rf"\b{re.escape(name)}\b")
        return self._rewritten(job, lambda text: word.sub(lambda _: expression, text))

    def _rewritten(self, job: Job, rewrite: Callable[[str], str]) -> dict[str, Any]:
        """Return the change that rewrites equations and definitions.

        An output that has what changes, such as an acceleration, is no exception.
        """
        key, declared = self.motion.equation_key, job.declaration["motion"]
        states, defined = declared["states"], declared.get("define", {})
        outputs = {output: declared_output(job, output) for output in declared["outputs"]}
        texts = {f"motion.states.{state}.{key}": str(own[key]) for state, own in states.items()}
        texts |= {f"motion.define.{own}": str(text) for own, text in defined.items()}
        change: dict[str, Any] = {
            path: new for path, text in texts.items() if (new := rewrite(text)) != text
        }
        for output, own in outputs.items():
            if (new := rewrite(own["expression"])) != own["expression"]:
                change[f"motion.outputs.{output}"] = own | {"expression": new}
        return change

    def with_lag(
        self, job: Job, late: LateInputResult, name: str
    ) -> tuple[dict[str, Any], str] | None:
        motion, states = self.motion, job.declaration.get("motion", {}).get("states")
        state = f"{late.input}_late"
        if not states or motion.functions is not None:
            return None
        if state in {*self.names_taken(job.spec), *motion.inputs}:
            return None
        change = self._in_place_of_input(job, late.input, state)
        moving = self._moving("lag", late.input, None, state, name)
        change |= {
            f"motion.states.{state}": {
                motion.equation_key: moving,
                "start": _first_of(job, late.input),
            },
            f"motion.parameters.{name}": {"initial": late.time_constant, "min": 0},
        }
        return change, f"a lag of {late.input} (the state {state}, time constant {name})"

    def _moving(self, kind: str, on: str, moves: str | None, state: str, scale: str) -> str | None:
        """Return the equation of a state with memory, as the equations of the motion are given."""
        of = next_of if self.motion.scheme.discrete else derivative_of
        return of(kind, on, moves, state, scale)

    def with_state(
        self, job: Job, missing: MemoryResult, names: tuple[str, str, str]
    ) -> tuple[dict[str, Any], str] | None:
        motion, states = self.motion, job.declaration.get("motion", {}).get("states")
        if not states or motion.functions is not None:
            return None
        if motion.definitions or missing.equation not in states or missing.scale is None:
            return None
        key, (state, scale, size) = motion.equation_key, names
        moves = str(states[missing.on][key]) if missing.on in states else None
        moving = self._moving(missing.kind, missing.on, moves, state, scale)
        if moving is None:
            return None
        own = states[missing.equation][key]
        change: dict[str, Any] = {
            f"motion.states.{missing.equation}.{key}": f"{own} + {size}*{state}",
            f"motion.states.{state}": {key: moving, "start": _rest_of(job, missing)},
            f"motion.parameters.{scale}": {"initial": float(f"{missing.scale:.3g}"), "min": 0},
            f"motion.parameters.{size}": {"initial": 0.0},
        }
        place = f"in the equation of {missing.equation}"
        left = f"{state} after a sample" if motion.scheme.discrete else f"d{state}/dt"
        return change, f"{MISSING_STATE} {state} ({left} = {moving}) {place}"

    def other_holds(self, spec: Spec) -> tuple[str, ...]:
        if not self.motion.driving or self.motion.scheme.discrete:
            return ()
        return tuple(hold for hold in HOLDS if hold != self.motion.hold)

    def with_initials(self, job: Job, fit: MotionEstimate) -> dict[str, Any]:
        found = dict(zip(fit.problem.names, fit.values, strict=True))
        declared = job.declaration.get("motion", {}).get("parameters", {})
        return {
            f"motion.parameters.{name}.initial": float(f"{found[name]:.6g}")
            for name, own in declared.items()
            if isinstance(own, dict) and name in found and np.isfinite(found[name])
        }

    def settled(self, fit: MotionEstimate) -> dict[str, Any]:
        """Return integrator and substeps of a fit, as a change of the spec: a search costs most.

        With given substeps the integrator is no longer chosen, so it is given, too.
        """
        form = fit.model.form
        if form.motion.scheme.discrete:
            return {}
        return {"motion.integrator": form.motion.integrator, "motion.substeps": form.substeps}

    def rows_needed(self, spec: Spec) -> tuple[int, int]:
        """Return the rows before the first one with a prediction, and the fewest of a stretch.

        So many determine the initial state of a run.
        """
        return 0, len(self.motion.states) + 1

    def runs_through_gaps(self, spec: Spec) -> bool:
        return spec.noise.model == "white"

    def pose(self, spec: Spec, record: Record, **options: Any) -> MotionProblem:
        learner, weights = spec.declared_learner(), spec.training.output_weights
        inputs = spec.learner_inputs() if learner is not None else None
        return pose_motion(
            record, self.motion, inputs, weights, LearnerStates.of(learner), **options
        )

    def under(self, measure: Measure, spec: Spec, problem: MotionProblem) -> Self:
        """Return the physics with the suspects of the spec; the measure is tried.

        It is tried on the guessed states, so that wrong names and limits are found before training.
        """
        rows = len(problem.record)  # a measure may weigh each of them
        x, u = (np.resize(part.T, (rows, len(part))) for part in problem.guessed_points)
        measure.points(Support.of_motion(problem.motion, x, u))
        return replace(self, suspects=declared_terms(spec.suspects, problem))

    def train(self, problem: MotionProblem, **options: Any) -> MotionEstimate:
        from orthaug.fitting.estimation import fit

        return fit(problem, **options)

    def fold_training(
        self, job: Job, variant: Variant
    ) -> tuple[Callable[[Record], MotionProblem], Callable[..., MotionEstimate]]:
        """Return functions that pose a variant on a fold by the sizes of all rows, and train it."""
        return job.problem.on, self.train

    def slow_note(self, job: Job) -> str:
        from orthaug.analysis.input_timing import rows_of_trials

        problem = job.problem
        if problem.substeps < _STIFF:
            return ""
        return (
            f"note: about {problem.substeps} substeps in a sample make every run slow, and the "
            f"check makes hundreds of runs; they are over {rows_of_trials(problem)} rows."
        )

    def check(self, job: Job) -> tuple[dict[str, Any], list[Warning]]:
        from orthaug.analysis.absorbed import Waves
        from orthaug.analysis.exchanged_inputs import misread_inputs
        from orthaug.analysis.imitation import imitation_before
        from orthaug.analysis.input_timing import find_late_inputs, try_holds
        from orthaug.analysis.motion_identifiability import identify_ranks, ill_conditioned_alone
        from orthaug.analysis.other_solutions import find_other_solution
        from orthaug.analysis.trained_start import unstable_warning
        from orthaug.fitting.motion_task import restart_warnings
        from orthaug.fitting.segmented_motion import SegmentedMotion
        from orthaug.inference.nearly_shared import output_warnings, shared_warnings
        from orthaug.inference.splitting import shared_of_motion
        from orthaug.models.learners import nothing_learned
        from orthaug.models.moving import MotionDynamics

        problem, spec = job.problem, job.spec
        solver: Any = spec.declared_solver()
        motion, criterion, structure = problem.motion, spec.declared_criterion(), job.structure
        segmented = SegmentedMotion.of(problem.without_learner(), nothing_learned(), criterion)
        identification = identify_ranks(segmented)
        if identification is None:
            of_data = {
                code: "".join(f" {one.text}" for one in job.warnings if one.code == code)
                for code in ("wild_samples", "time_unit")
            }
            scales = describe_scales(problem.record)
            cause = f" {scales[0].upper()}{scales[1:]}" if scales else ""
            other = f"{problem.grows}." if problem.grows else f"give others.{cause}"
            wild, times = of_data["wild_samples"], of_data["time_unit"]
            remedy = f"it meets a wild sample.{wild}" if wild else f"{other}{times}"
            raise InputError(
                f"{job.path}: physics alone has no finite free run from its initial values; "
                f"{remedy}"
            )
        learns, full_rank = spec.declared_learner() is not None, identification.on_data.full_rank
        shared, on_rows = None, []
        if learns and structure.shared != "all":
            nothing, step = nothing_learned(), problem.record.sampling_time
            form = MotionDynamics(motion, problem.features, nothing, step, problem.substeps)
            run = (motion.coordinates.initial, identification.states, identification.inputs)
            shared = imitation_before(form, *run, segmented.segments.steps)
            seen = [str(entry) for entry in form.features]
            on_rows = shared_warnings(shared_of_motion(form, *run), seen)
            on_rows += output_warnings(motion)
        posed, waves = (problem, Waves()) if learns else (problem.without_learner(), None)
        trial = try_holds(posed, criterion, solver, structure, waves)
        text, warnings = _about_steps(problem, trial)
        misread = misread_inputs(trial.task, solver)
        late = () if misread else find_late_inputs(trial.task, solver)
        warnings += [*misread, *(one.warning for one in late)]
        warnings += restart_warnings(trial.task.physics)
        if segment := problem.steps_to_leave():
            warnings.append(unstable_warning(segment, problem.record.sampling_time))
        if full_rank and trial.task.physics is not None:  # else there are others anyway
            q = trial.task.physics.end.point.theta
            other = find_other_solution(trial.task.plan, solver, q)
            warnings += other.warnings if other else ()
        if identification.by_any is None:
            warnings.append(_NOT_RICH)
        found = {
            "excitation": identification.on_data,
            "identifiability": identification.by_any or identification.on_data,
            "shared": shared and shared.beside_collinear(identification.on_data.collinear),
            "bias": self._bias_of_physics(job, trial) if full_rank else None,
            "motion": {
                "states": motion.names_of_states,
                "integrator": motion.integrator,
                "fastest": problem.fastest,
                "substeps": trial.substeps,
                "rows": trial.rows,
                "holds": trial.holds,
                "best_hold": trial.best,
                "text": text,
            },
        }
        ill = ill_conditioned_alone(trial.task) if full_rank else ()
        return found, [*ill, *on_rows, *warnings]

    def refusal(self, job: Job, result: CheckResult) -> InputError | None:
        found = result.excitation
        if found.rank == found.columns:
            return None
        groups = "; ".join(
            f"{group[0]} changes no output"
            if len(group) == 1
            else f"{', '.join(group)} cannot be distinguished"
            for group in found.collinear
        )
        lacking = found.columns - found.rank
        constants = (
            "one of them as a constant" if lacking == 1 else f"{lacking} of them as constants"
        )
        remedy = f"give {constants}"
        if result.identifiability.identifiable:
            remedy += ", or use data that excite them separately"
        return RankError(
            f"the outputs do not determine the parameters (rank {found.rank} of {found.columns}): "
            f"{groups}; {remedy}."
        )

    def figures(
        self,
        job: Job,
        fit: MotionEstimate,
        responses: Mapping[str, tuple[Response, Response]],
    ) -> dict[str, Figure]:
        from orthaug.reports import plots
        from orthaug.reports.learned_part import learned_of

        part, model = job.parts[-1], fit.model
        free = responses[part.name][1]
        drawn = {
            "residual": plots.residual_figure(free, f"free-run residual, {part.name}"),
            "states": plots.states_figure(
                model, part.record, f"states of the free run, {part.name}"
            ),
        }
        if fit.learns:
            drawn["simulation"] = plots.output_figure(free, f"free run, {part.name}", learns=True)
            drawn["components"] = plots.parts_figure(
                model, part.record, f"physics and learner, {part.name}"
            )
            learned = learned_of(fit, job.train.record)
            assert learned is not None
            title = f"learned beside the physics, by the {model.measure} measure"
            drawn["learner"] = plots.learner_figure(learned, title)
        return drawn

    def run_alone(self, fit: MotionEstimate, record: Record, free_run: Response) -> Response:
        """Return the free run by the model's physics without its learner, from the same start."""
        return free_run.physics_alone

    def design(self, job: Job, asked: dict[str, Any], noise: float | None) -> Design:
        """Return the input that is asked for, by the parameters of physics alone."""
        from orthaug.analysis.design import design_motion_input
        from orthaug.fitting.motion_task import MotionTask

        spec, motion = job.spec, job.problem.motion
        task = MotionTask.of(job.problem.without_learner(), None, spec.declared_criterion())
        solver: Any = spec.declared_solver()
        task = task.prepare(solver, job.structure)
        if task.physics is None:
            raise InputError(
                "physics alone has no finite free run from its initial values; give others."
            )
        left: Any = noise
        point = task.physics.end.point
        if noise is None:
            squares = np.sum(point.errors**2, axis=(0, 1, 3))
            left = tuple(np.sqrt(squares / task.plan.segments.count))
        p = motion.coordinates.physical(point.theta)
        own = {"parameters": p, "noise": left, "substeps": task.plan.dynamics.substeps}
        return design_motion_input(motion, suspects=self.suspects, **own, **asked)

    def system(self, fit: MotionEstimate) -> System:
        from orthaug.studies.planted import MotionSystem

        return MotionSystem(fit, self.motion.sampled(fit.problem.record.sampling_time))

    def _bias_of_physics(self, job: Job, trial: Trial) -> list[dict[str, Any]] | None:
        """Return the bias that each suspect would cause, with physics alone.

        Without suspects in the spec, the usual ones with an effect.

        None where physics alone has no run.
        """
        from orthaug.analysis.bias import bias_table
        from orthaug.analysis.free_run_bias import linearize_physics

        terms = linearize_physics(trial.task, job.structure)
        if terms is None:
            return None
        table = bias_table(terms, self.suspects or terms.usual())
        return [entry.as_dict() for entry in table if self.suspects or entry.size]


def _about_steps(problem: MotionProblem, trial: Trial) -> tuple[str, list[Warning]]:
    """Return a text on the errors of integrator and hold in the outputs, and warnings."""
    motion, warnings = problem.motion, []
    step = problem.record.sampling_time
    units = [parameter.unit for parameter in motion.parameters]
    unit = time_unit(units, problem.record.time_column)
    if motion.scheme.discrete:
        return "The equations give the state one sample later: nothing is integrated.", warnings
    if trial.substeps is None:
        sentences = (
            "physics alone has no finite free run from its initial values, so substeps and "
            "holds were not tried."
        )
        return "", [Warning("physics_runs_away", sentences)]
    sentences = [
        f"The fastest mode of the initial physics is {problem.fastest:.3g} 1/{unit}, sampled every "
        f"{step:g} {unit}; {trial.substeps} substep{'s' * (trial.substeps > 1)} of "
        f"{motion.integrator} in a sample"
        + (
            " are as declared."
            if motion.substeps is not None
            else ": twice as many change the outputs by less than 1 % of the residual."
        )
    ]
    if trial.substeps >= _STIFF:
        undeclared = replace(motion, integrator="auto", substeps=None)
        remedy = (
            '`integrator = "exact"` needs far fewer.'
            if replace(problem, motion=undeclared).integrator == "exact" != motion.integrator
            else "Where its fastest state settles within a sample, write that state's equilibrium "
            "into the other equations instead."
        )
        text = (
            f"the motion is stiff for its sampling: {trial.substeps} substeps in a sample make "
            f"every run slow. {remedy}"
        )
        warnings.append(Warning("stiff", text))
    if len(trial.holds) > 1:
        shown = ", ".join(
            f"{held.hold} {'no run' if held.residual is None else f'{held.residual:.4g}'}"
            for held in trial.holds
        )
        sentences.append(
            "Residual of physics alone for each hold of the inputs, in deviations of the "
            f"output: {shown}."
        )
        if trial.best is None:
            sentences.append("No hold explains the data clearly better than the declared one.")
        else:
            text = (
                f'the data are explained better by hold = "{trial.best}" than by the '
                f'declared "{motion.hold}".'
            )
            warnings.append(Warning("other_hold", text))
    return " ".join(sentences), warnings


def _reads_only(motion: Motion, expression: str) -> bool:
    """Return whether an expression reads no name that the motion lacks: a state of the learner."""
    names = set(re.findall(r"(?<![\w.])[A-Za-z_]\w*", expression))
    defined = {name for name, _ in motion.definitions}
    return names <= {*motion.known, *defined, *FUNCTIONS}


def _has_term(equation: str, expression: str, varying: Sequence[str]) -> bool:
    """Return whether an equation has a constant times an expression.

    `i*x` and `x**2` are not in `q*i*x**2`, whose i is among the `varying` states and inputs.
    """
    term = re.escape("".join(expression.split()))
    factor = rf"(?!(?:{'|'.join(map(re.escape, varying))})\b)[\w.]+"
    constant = rf"(?:\)|(?<![\w.*]){factor})(?:\*{factor})*"
    whole = rf"{constant}\*(?:{term}|\({term}\))(?![\w.*(])"
    return re.search(whole, "".join(equation.split())) is not None


def _first_of(job: Job, name: str) -> float:
    """Return the first value of an input."""
    record = job.train.record
    place = [channel.name for channel in record.inputs].index(name)
    return float(record.experiments[0].inputs[0, place])


def _rest_of(job: Job, missing: MemoryResult) -> float | str:
    """Return the start of a state with memory: a lag begins at its signal, hysteresis at 0."""
    if missing.kind != "lag":
        return 0.0
    own = job.declaration["motion"]["states"].get(missing.on)
    return _first_of(job, missing.on) if own is None else own.get("start", 0.0)
