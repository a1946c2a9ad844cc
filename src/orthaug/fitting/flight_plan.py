"""The course of a lagged model: its problem laid out in segments, beside its rows laid out for one step."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from orthaug.data.regressors import Features
from orthaug.fitting.course import Course, Layout
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.elimination import eliminate
from orthaug.fitting.initial_states import InitialStates
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.segment_sums import SegmentSums
from orthaug.fitting.segments import lay_segments
from orthaug.fitting.structured_objective import StructuredObjective
from orthaug.fitting.structures import Structure
from orthaug.models.lagged import Lagged
from orthaug.models.learners import Bound
from orthaug.physics.problem import Problem


def lagged(task: OneStepTask) -> Lagged:
    """The dynamics of a problem and its learner."""
    problem = task.problem
    return Lagged(problem.baseline, problem.features, problem.layout, problem.outputs, task.bound)


def declared(task: OneStepTask, criterion: Criterion) -> dict[str, Any]:
    """What a plan has of its task and its criterion, wherever the segments are."""
    problem = task.problem
    return {
        "record": problem.record,
        "criterion": criterion,
        "flown": criterion.flown,
        "rms": task.rms,
        "deviation": problem.deviation,
        "output_weights": problem.weight.choice,
        "scaling": task.scaling,
        "unit": task.unit,
        "task": task,
    }


@dataclass(frozen=True, eq=False, kw_only=True)
class FlightPlan(Course):
    """A problem laid out in segments, beside its rows laid out for one step."""

    dynamics: Lagged
    task: OneStepTask

    @classmethod
    def of(cls, task: OneStepTask, criterion: Criterion) -> FlightPlan:
        """Lay the problem's record out as a criterion of several steps declares.

        Raises:
            InputError: nothing would be scored.
        """
        dynamics, record, sums = lagged(task), task.problem.record, SegmentSums.of(task.engine)
        laid = Layout.of(record, dynamics, criterion, shares=task.engine.shares)
        return cls(**laid._asdict(), **declared(task, criterion), dynamics=dynamics, sums=sums)

    @property
    def problem(self) -> Problem:
        return self.task.problem

    @property
    def bound(self) -> Bound | None:
        return self.task.bound

    @cached_property
    def alone(self) -> FlightPlan:
        """The same rows and segments without a learner."""
        alone, task = replace(self.dynamics, features=Features(()), bound=None), self.task.alone
        return replace(self, task=task, dynamics=alone, scaling=task.scaling, unit=task.unit)

    @property
    def lengthens(self) -> bool:
        """Whether whole experiments can be segments to train on."""
        return True

    def over(self, segment: int) -> FlightPlan:
        """The same over segments of another length; 0 for whole experiments."""
        washout = min(self.flown.washout, segment // 2) if segment else self.flown.washout
        flown = replace(self.flown, segment=segment, washout=washout)
        segments = lay_segments(self.record, self.dynamics, segment, washout, shares=self.shares)
        return replace(self, segments=segments, flown=flown)

    def objective(self, structure: Structure) -> StructuredObjective:
        """The criterion as a function of θ and the weights."""
        start, elimination = np.asarray(self.segments.start), eliminate(structure, self.problem)
        free = elimination.projects and not elimination.bounded and self.bound is not None  # the unknown is c
        return StructuredObjective(
            dynamics=self.dynamics,
            numbers=self.numbers,
            segments=self.segments,
            initial=InitialStates(start, start.size > 0 and self.flown.estimates_pasts),
            weight=self.problem.weight.matrix / self.rms,
            rms=self.rms,
            deviation=self.problem.deviation,
            physics=len(self.problem.baseline.names),
            bounds=None if free else (elimination.lower, elimination.upper),
            colour=self.colour,
            sums=self.sums,
            task=self.task,
            elimination=elimination,
        )
