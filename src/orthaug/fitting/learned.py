"""Results of training under any criterion, from which an estimate is concluded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug._base.jax import AnyArray
from orthaug._base.progress import RunProgress, Watch, quiet
from orthaug.data.record import Record
from orthaug.fitting.block_scores import FreeRunScores
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.elimination import Fixed
from orthaug.fitting.kinds import Solver
from orthaug.fitting.solvers.limit import Tail
from orthaug.fitting.status import Ending
from orthaug.fitting.structures import Structure
from orthaug.models.learners import Bound, Scaling
from orthaug.physics.problem import Problem


class ErrorStatistics(NamedTuple):
    """Statistics of the errors of a fit, and of the θ that follows from them."""

    noise: Matrix | None
    """Covariance (ny, ny) of the errors, in the outputs' units."""
    covariance: Matrix | None
    """Cov θ̂ (nθ, nθ)."""
    freedom: float
    mean_square: float
    """Of the errors, each output in its standard deviation."""
    fixed: Fixed


@dataclass(frozen=True, eq=False)
class TrainedLearner:
    """A trained learner: its weights, and the results of its run."""

    bound: Bound
    weights: Vector
    scaling: Scaling
    unit: Vector
    ending: Ending = Ending.EXACT
    iterations: int = 0
    seconds: float = 0.0
    effective: float = 0.0
    gram: Matrix | None = None
    ridge: float | Vector = 0.0
    """Of the weights, all or each (nw,), in the units of `gram`."""
    middle: Callable[[Matrix], Matrix] | None = None
    """ΣψᵀΣ_eψ in the units of `gram`, for the noise covariance (ny, ny) of whitened outputs."""
    coefficients: Vector | None = None
    """c = θ − θ_aux (nθ,), if it was an unknown of training; None where θ is solved."""
    fixed: Fixed | None = None
    """What stood at a bound, where θ is solved; None where that is not known."""
    errors: ErrorStatistics | None = None
    """Of a free run; None where they are those of the one-step residual."""
    scores: FreeRunScores | None = None
    """Of a free run; None where they are those of the one-step residual."""
    tilt: Matrix | None = None
    """(members, nθ) of an ensemble, whose weights are (members, nw)."""
    tail: Tail | None = None
    """The last steps of its run; None for what was solved."""
    elsewhere: bool = False
    """True if it is a function from another toolbox."""


class PlannedRun(NamedTuple):
    """One run to be made: its seed, initial weights and regularization."""

    seed: int
    weights: AnyArray
    regularization: str | float


@runtime_checkable
class FinishedRun(Protocol):
    """A run as it ended: `TrainingRun` and `FreeRunFit`."""

    @property
    def ending(self) -> Ending: ...

    @property
    def iterations(self) -> int: ...

    @property
    def seconds(self) -> float: ...

    @property
    def effective(self) -> float:
        """Effective number of weights."""
        ...


@runtime_checkable
class Task(Protocol):
    """A problem prepared for training on one criterion; `OneStepTask` and `FreeRunTask`."""

    @property
    def problem(self) -> Problem: ...

    @property
    def bound(self) -> Bound: ...

    @property
    def criterion(self) -> Criterion: ...

    @property
    def start_loss(self) -> float | None:
        """Loss of physics alone, in the units of `loss`; None where it cannot be computed."""
        ...

    @property
    def seconds(self) -> float:
        """Seconds that were spent before the first run."""
        ...

    @property
    def warnings(self) -> tuple[Warning, ...]:
        """Warnings about physics alone."""
        ...

    @property
    def rows_task(self) -> Any:
        """The rows prepared for one step, to sum over (`OneStepTask`)."""
        ...

    def on(self, record: Record) -> Task:
        """Return the task on another record."""
        ...

    def after(self, runs: Sequence[Any]) -> Task:
        """Return the task for further runs; what none of `runs` needed is not tried again."""
        ...

    def physics_alone(self) -> tuple[Any, TrainedLearner]:
        """Return the task without a learner, and the residual of physics alone."""
        ...

    def prepare(self, solver: Solver, structure: Structure, progress: RunProgress = quiet) -> Task:
        """Return the task with physics alone trained: all runs start from it."""
        ...

    def run(
        self,
        solver: Solver,
        w: Any,
        structure: Structure,
        regularization: str | float = "none",
        progress: RunProgress = quiet,
        watched: Watch | None = None,
    ) -> FinishedRun:
        """Return one run from the weights `w`; arguments as in `estimate`.

        `watched` may follow it, as a run that has not ended.
        """
        ...

    def refined(self, run: Any, solver: Solver, structure: Structure) -> tuple[Task, Any]:
        """Return the task integrated as finely as a run's errors ask for, and the run on it."""
        ...

    def loss(self, run: Any) -> float:
        """Return the figure that runs are compared by.

        A mean of squared errors, each output in its standard deviation.
        """
        ...

    def learned(self, run: Any) -> TrainedLearner:
        """Return the learner as a run left it."""
        ...

    def conclude(
        self, structure: Structure, learned: TrainedLearner, *, briefly: bool = False
    ) -> Any:
        """Return the estimate of what a run learned; `briefly` only what a free run needs."""
        ...

    def median(self, members: list[TrainedLearner], best: int) -> TrainedLearner:
        """Return several members as one, the median of their predictions (`ensemble`)."""
        ...
