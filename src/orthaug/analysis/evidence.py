"""Evidence that a fit is judged by, beside itself: parts of the data, and declarations."""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from orthaug._base.checks import check_count, check_type
from orthaug._base.errors import InputError, Warning
from orthaug._base.lines import join_words
from orthaug.analysis.suspects import (
    MotionSuspect,
    Suspect,
    check_motion_suspects,
    suspect_columns,
)
from orthaug.analysis.wild_rows import fit_without
from orthaug.data.part import Part
from orthaug.data.preparation import warnings_of
from orthaug.data.record import Record
from orthaug.data.units import time_of_rate
from orthaug.data.wild import data_warnings
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.fit_plans import check_blocks
from orthaug.fitting.independent_terms import independent_terms
from orthaug.fitting.kinds import STRUCTURES
from orthaug.fitting.noise import Noise, noise_of_motion
from orthaug.fitting.structures import Structure
from orthaug.inference.measures import Measure, Training
from orthaug.models.learners import Learner, declared
from orthaug.models.rows import InMemory
from orthaug.models.tasks import runs_on
from orthaug.physics.parameters import PhysicsMap, time_unit
from orthaug.physics.problem import MotionProblem, PosedProblem, Problem

if TYPE_CHECKING:
    from orthaug._base.parallel import Threads
    from orthaug.models.rows import Engine


DEFAULT_BLOCKS = 4
"""Blocks of cross-validation where no part is held out."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Evidence:
    """The data and declarations by which a fit is judged."""

    parts: tuple[Part, ...]
    """Training data first; the parts of tests have names that begin with "tests."."""
    problem: Any
    """The problem as it was posed, whatever the fit made of it."""
    learner: Learner | None
    """The learner that was asked for, also where the fit left it out."""
    structure: Structure
    criterion: Criterion
    measure: Measure = Training()  # noqa: RUF009  (frozen)
    noise: Noise = "white"
    """The noise model that was asked for."""
    suspects: tuple[Any, ...] = ()
    map: PhysicsMap | None = None
    """From physical parameters to θ."""
    profiles: bool = False
    """True if physical parameters get profile intervals, too."""
    blocks: int | None = None
    """Blocks of cross-validation; None for none beside held-out parts, else `DEFAULT_BLOCKS`."""
    runner: Threads | Engine = InMemory()  # noqa: RUF009  (frozen)
    """Makes the fits of cross-validation."""
    warnings: tuple[Warning, ...] = ()
    """Warnings on the data and on what was left out before training."""

    @classmethod
    def of(
        cls,
        fit: Estimate,
        *,
        validation: Record | None = None,
        tests: Record | Mapping[str, Record] | None = None,
        suspects: Sequence[Suspect] | Sequence[MotionSuspect] = (),
        physics: PhysicsMap | None = None,
        profiles: bool = False,
        blocks: int | None = None,
        skip: int = 0,
    ) -> Self:
        """Return what a fit in memory can be judged by; arguments as of `Estimate.diagnose`.

        Raises:
            InputError: records or suspects that do not fit the model.
        """
        check_type(physics, PhysicsMap | None, "physics", "a PhysicsMap, or None")
        blocks = None if blocks is None else check_blocks(blocks)
        setup, problem = fit.setup, _problem_of(fit)
        learner = fit.model.form.bound.learner if fit.learns else None
        structure, own = STRUCTURES[fit.model.structure](), getattr(fit, "measure", None)
        measure = getattr(own, "measure", None) or (Training() if setup is None else None)
        if setup is not None:
            learner, structure = setup.learner, setup.structure
            validation = setup.options["validation"] if validation is None else validation
        engine = InMemory() if setup is None else setup.options.get("engine", InMemory())
        record = fit.problem.record
        return cls(
            parts=_parts_of(fit, validation, tests, check_count(skip, "skip", least=0)),
            problem=problem,
            learner=learner,
            structure=structure,
            criterion=fit.criterion if setup is None else setup.criterion,
            measure=structure.measure if measure is None else measure,
            noise="white" if setup is None else setup.noise,
            suspects=_checked_suspects(suspects, problem),
            map=physics,
            profiles=profiles,
            blocks=blocks,
            runner=runs_on(engine),
            warnings=(
                *warnings_of(record.prepared, [channel.name for channel in record.channels]),
                *sample_warnings(problem),
            ),
        )

    @property
    def train(self) -> Part:
        """The training data."""
        return self.parts[0]

    @property
    def held_out(self) -> tuple[Part, ...]:
        """The parts that were not fitted."""
        return self.parts[1:]

    @property
    def wanted_blocks(self) -> int:
        """Number of blocks of cross-validation: by default none beside held-out parts."""
        return (0 if self.held_out else DEFAULT_BLOCKS) if self.blocks is None else self.blocks

    def method(self, criterion: Criterion | None = None) -> str:
        """Return the method of estimation, as `closed_loop` names it.

        Args:
            criterion: that was chosen, by default the declared one.
        """
        if not isinstance(self.problem, Problem):
            if noise_of_motion(self.noise) == "innovations":
                return "noise"
            return "loop" if self.problem.set_by_controller else "motion"
        if self.noise != "white":
            return "noise"
        return "direct" if (criterion or self.criterion).free_run is None else "free run"


def sample_warnings(problem: PosedProblem) -> list[Warning]:
    """Return warnings on training samples that are no measurements.

    Of physics that is linear in θ they say what a fit without them gives. Inputs that nothing of
    the model reads are said, too.
    """
    effect = partial(fit_without, problem) if isinstance(problem, Problem) else None
    wild = data_warnings(problem.record, effect, limited=problem.set_by_controller)
    return [*_unread(problem), *_other_times(problem), *_other_rates(problem), *wild]


def _unread(problem: PosedProblem) -> list[Warning]:
    """Return a warning on inputs that are recorded for nothing."""
    if not problem.unread:
        return []
    names, one = join_words(problem.unread), len(problem.unread) == 1
    text = (
        f"{names} {'is an input' if one else 'are inputs'} of the data, but neither the physics "
        f"nor the learner reads {'it' if one else 'them'}. Give {'it' if one else 'them'} to the "
        f"learner, or remove {'it' if one else 'them'} from `data.inputs`."
    )
    return [Warning("unread_input", text)]


def _other_times(problem: PosedProblem) -> list[Warning]:
    """Return a warning on parameters whose units have another time than the equations."""
    names, column = problem.other_time_units, problem.record.time_column
    if not names:
        return []
    text = (
        f"equations are per second, because the instants of column '{column}' are read in "
        f"seconds. But the units of {join_words(names)} have another time, which is not converted: "
        "the values are those with s. Give these units with s."
    )
    return [Warning("time_unit", text)]


def _other_rates(problem: PosedProblem) -> list[Warning]:
    """Return a warning on each input per hour, say, that derivatives per second read.

    Equations with a factor that converts are left to the user.
    """
    column = problem.record.time_column
    if not isinstance(problem, MotionProblem) or time_unit(["1/h"], column) != "s":
        return []
    motion = problem.motion
    if motion.functions is not None or motion.source is not None or motion.scheme.discrete:
        return []
    read = {name for state in motion.equations for name in motion.names_in(motion.equations[state])}
    numbers = [float(value) for _, value in motion.constants]
    for expression in motion.expressions:
        nodes = [one for one in ast.walk(expression.tree) if isinstance(one, ast.Constant)]
        numbers += [float(one.value) for one in nodes if isinstance(one.value, (int, float))]
    return [
        Warning(
            "time_unit",
            f"The input '{channel.name}' is in {channel.unit}, but equations are per second, "
            f"because the instants of column '{column}' are read in seconds. This is not "
            f"converted, and parameters absorb the factor. Give `data.channels.{channel.name}` "
            f"`scale = {channel.scale / seconds:.6g}` and its unit with s.",
        )
        for channel in problem.record.inputs
        if channel.name in read
        and (seconds := time_of_rate(channel.unit)) is not None
        and not any(np.isclose(number, (seconds, 1 / seconds)).any() for number in numbers)
        and not np.isclose(channel.scale * seconds, 1.0, rtol=1e-3)
    ]


def _problem_of(fit: Estimate) -> Any:
    """Return the problem of a fit with its learner, also where physics alone was kept."""
    setup = fit.setup
    if setup is None or fit.learns or not isinstance(setup.problem, Problem):
        return fit.problem if setup is None or fit.learns else setup.problem
    return independent_terms(setup.problem, declared(setup.learner))[0]


def _parts_of(
    fit: Estimate,
    validation: Record | None,
    tests: Record | Mapping[str, Record] | None,
    skip: int,
) -> tuple[Part, ...]:
    check_type(validation, Record | None, "validation", "a Record, or None")
    named = {"test": tests} if isinstance(tests, Record) else tests or {}
    if not isinstance(named, Mapping) or not all(isinstance(one, Record) for one in named.values()):
        raise InputError("`tests` must be records by their names, such as {'steps': record}.")
    records = {} if validation is None else {"validation": validation}
    records |= {f"tests.{name}": record for name, record in named.items()}
    held_out = (
        Part(name, fit.model.fitting(record, need_outputs=True), skip)
        for name, record in records.items()
    )
    return (Part("train", fit.problem.record), *held_out)


def _checked_suspects(suspects: Sequence[Any], problem: Any) -> tuple[Any, ...]:
    lagged, suspects = isinstance(problem, Problem), tuple(suspects)
    kind, words = (Suspect, "Suspects") if lagged else (MotionSuspect, "MotionSuspects")
    for suspect in suspects:
        check_type(suspect, kind, "suspects", f"a list of {words}")
    if lagged:
        suspect_columns(suspects, problem.rows.x, problem.layout, problem.outputs, problem.lengths)
    else:
        check_motion_suspects(suspects, problem)
    return suspects
