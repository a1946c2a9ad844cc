"""Setup of an estimate: its problem and the options of training, by which it is made again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from orthaug.data.record import Record
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.structures import Orthogonal, Structure, with_measure
from orthaug.inference.measures import Training
from orthaug.models.learners import Learner, learns

FOLD_ITERATIONS = 60  # enough to see whether a learner helps, on every block of cross-validation
_OF_ONE_RUN = ("progress", "checkpoints", "initial")  # no part of how a fit is made again


@dataclass(frozen=True, eq=False)
class TrainingSetup:
    """A problem and the options that it was trained with."""

    train: Callable[..., Any]
    problem: Any
    options: Mapping[str, Any]
    standard_errors: str = "auto"
    """Those that were asked for: as for `estimate`."""

    @classmethod
    def of(
        cls, train: Callable[..., object], problem: Any, options: Mapping[str, object]
    ) -> TrainingSetup:
        """Return the setup of a fit, without the options that belong to one run."""
        kept = {name: value for name, value in options.items() if name not in _OF_ONE_RUN}
        return cls(train, problem, kept)

    @property
    def learner(self) -> Learner | None:
        """The learner that was asked for, whether or not the fit kept it."""
        return self.options["learner"]

    @property
    def learns(self) -> bool:
        """True if a learner was asked for."""
        return learns(self.learner)

    @property
    def structure(self) -> Structure:
        """The structure that was asked for."""
        return self.options["structure"]

    @property
    def criterion(self) -> Criterion:
        """The criterion that was asked for; `Auto` is not yet decided."""
        return self.options["criterion"]

    @property
    def noise(self) -> Any:
        """The noise model that was asked for."""
        return self.options["noise"]

    def fit_physics(self, criterion: Criterion) -> Any:
        """Return the fit of the physics alone to the same record, by a criterion."""
        options = self._options(learner=None, structure=Orthogonal(), criterion=criterion)
        return self.train(self.problem.physics_alone(), **options)

    def fold_fit(self, criterion: Criterion, *, physics_only: bool = False) -> Callable[..., Any]:
        """Return a function that fits a fold of the record, from one start, by few iterations.

        It can be sent to another process. Predictions score it, on which no measure has an effect.
        """
        options = self._options(
            learner=None if physics_only else self.learner,
            structure=Orthogonal() if physics_only else with_measure(self.structure, Training()),
            criterion=criterion,
        )
        options.pop("engine", None)  # a fold is small: its rows are in memory
        problem = self.problem.physics_alone() if physics_only else self.problem
        return partial(
            fit_fold, pose=problem.poser, train=self.train, options=quick_options(options)
        )

    def _options(self, **changes: object) -> dict[str, Any]:
        """Return the options with changes; an ensemble is of full fits only."""
        changes |= {"ensemble": False} if "ensemble" in self.options else {}
        return {**self.options, **changes}


def quick_options(options: Mapping[str, Any]) -> dict[str, object]:
    """Return the options of a fit to a part of the rows: one start, few iterations, no choice."""
    given = options["regularization"]
    return {
        **options,
        "restarts": 1,
        "solver": options["solver"].at_most(FOLD_ITERATIONS),
        "regularization": given[0] if isinstance(given, list | tuple) else given,
        "blocks": 0,
        "validation": None,
    }


def fit_fold(
    fold: Record,
    pose: Callable[[Record], object],
    train: Callable[..., object],
    options: Mapping[str, object],
) -> Any:
    """Return the fit to a fold; a function of the module, so that it can be sent to a process."""
    return train(pose(fold), **options)
