"""`Estimate`, the result of an estimation of any physics: values, errors, tables, text.

What θ is under a measure, and how it follows the fitted numbers, depends on the physics:
`lagged_estimate`, where it is linear in θ, and `motion_estimate`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from jaxtyping import Bool

from orthaug._base.checks import Matrix, Vector, check_choice, check_count
from orthaug._base.errors import InputError, Warning
from orthaug._base.lines import INTERVAL_HEAD, estimate_rows, fold, table
from orthaug._base.views import FitView
from orthaug.data.record import Record
from orthaug.data.regressors import Layout
from orthaug.fitting.block_scores import FreeRunScores
from orthaug.fitting.criteria import Criterion, Prediction
from orthaug.fitting.held_out import Focus, HeldOutErrors
from orthaug.fitting.output_noise import OutputNoise, noise_of
from orthaug.fitting.setup import TrainingSetup
from orthaug.fitting.status import Status
from orthaug.inference.covariance import interval
from orthaug.inference.learned_terms import equation, learned_terms, term_frame, term_lines
from orthaug.inference.measures import Measure
from orthaug.inference.over_experiments import (
    FEWEST,
    OverExperiments,
    over_experiments,
    split_without_each,
)
from orthaug.inference.splitting import MeasureSplit
from orthaug.models.model import Model
from orthaug.models.response import Response
from orthaug.models.statistics import JointCovariance, Statistics, half_inverse
from orthaug.physics.excitation import Excitation
from orthaug.physics.parameters import Coordinates
from orthaug.physics.projection import Projection

if TYPE_CHECKING:
    import pandas as pd

    from orthaug.physics.baseline import Parameter
    from orthaug.physics.parameters import PhysicalParameter

STD_KINDS = {
    "plain": "for white errors of constant variance",
    "hc3": "robust (HC3), for errors of varying size",
    "newey-west": "robust (Newey-West), for coloured errors one step ahead",
    "batch-means": "robust (batch means), for coloured errors of the free run",
    "autoregressive": "robust (autoregressive errors), for coloured errors of the free run",
    "batch-means-uneven": "robust (batch means), for errors of the free run of varying size",
    "none": "none: the errors are correlated over too many steps",
    "chosen": "none: the terms were chosen on the rows that were fitted",
}
"""How standard errors were made, in words."""
_COUNTED = (
    "The intervals count noise only. `fit.diagnose()` tests whether something is missing from the "
    "model."
)
WITHHELD = ("none", "chosen")
"""The kinds of fits that have none."""
_FOR_THE_LIBRARY = {
    *(
        "alone",
        "coordinates",
        "free_covariance",
        "judged_record",
        "restarts_at",
        "layout",
        "lines",
        "moved_by",
        "moves_by",
        "theta_slope",
        "plain_statistics",
        "reach",
        "robust_kinds",
    ),
    *("scores", "segmented", "slope", "states", "withheld"),
}
"""Attributes of fits that completion does not list: other parts of the library read them."""


@dataclass(frozen=True)
class Restart:
    """One run from its own initial weights."""

    seed: int
    loss: float | None
    iterations: int
    code: str
    chosen: bool
    regularization: str | float = "none"
    validation: float | None = None
    """Mean squared error where nothing was fitted: on the validation record, or on held-out blocks.
    """
    score: float | None = None
    """Generalised cross-validation, where that chose among the runs."""


ROBUST_FREE_RUN = ("batch-means", "batch-means-uneven", "autoregressive")
"""Robust standard errors of a free run, the default first."""

Fit = TypeVar("Fit", bound="Estimate")


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Estimate(FitView):
    """Result of `estimate`. Print `fit.summary()`; use `fit.model`; read `fit.parameters`."""

    model: Model[Any]
    status: Status
    restarts: tuple[Restart, ...]
    covariance: Matrix | None
    """Cov θ̂ (nθ, nθ), of a motion that of the parameters' coordinates; NaN where one has no
    standard error, None where none has.
    """
    freedom: float
    """Degrees of freedom of the residual: rows less parameters less effective weights.

    For robust errors on the free run: blocks less one.
    """
    effective_weights: float
    defect: float | None
    """How much of the learner the physics could express: ‖QᵀF̃‖ / ‖F‖ over the measure's points;
    None without one.
    """
    problem: Any = field(repr=False)
    split_by: MeasureSplit | None = field(default=None, repr=False)
    """θ under the measure that it was split under; None of lagged physics split over their rows."""
    criterion: Criterion = Prediction()  # noqa: RUF009  (frozen)
    at_bound: Mapping[str, float] = field(default_factory=dict)
    """Parameters at a bound, with its value."""
    held_out: HeldOutErrors | None = None
    """By what the run was chosen; None where the lowest training loss chose."""
    focus: Focus | None = None
    """What `Auto` chose, and why; None where the criterion was declared."""
    physics_alone: Estimate | None = field(default=None, repr=False)
    """The estimate of physics alone that the learner had to beat; None without a learner."""
    warnings: tuple[Warning, ...] = ()
    plain_covariance: Matrix | None = None
    """Cov θ̂ for white noise, where `covariance` is robust; None where it is not."""
    scores: FreeRunScores | None = field(default=None, repr=False)
    """What robust standard errors of a free run are made of; None one step ahead."""
    std_kind: str = "plain"
    """How the standard errors were made, a key of `STD_KINDS`."""
    plain_statistics: Statistics | None = field(default=None, repr=False)
    """The model's statistics for white noise, where they are robust; None where they are not."""
    setup: TrainingSetup | None = field(default=None, repr=False)
    """Its problem as it was given and the options of training; None of a model that was split."""

    _of_split: ClassVar[tuple[str, ...]] = ("measure_beyond_data",)
    """Codes of warnings that another split makes anew."""

    def __dir__(self) -> list[str]:
        """Return the public names, which completion lists."""
        names = set(super().__dir__()) - _FOR_THE_LIBRARY
        return sorted(name for name in names if not name.startswith("_"))

    def predict(self, record: Record, horizon: int = 1) -> Response:
        """Predict each row of a record some steps ahead, as `model.predict` does.

        Args:
            record: inputs and outputs, measured.
            horizon: samples ahead, 1 or more.

        Raises:
            InputError: a record without outputs, other channels, a horizon below 1, too few rows.
        """
        return self.model.predict(record, horizon)

    def simulate(self, record: Record, initial: str | Any = "measured") -> Response:
        """Simulate the free run on a record, as `model.simulate` does.

        Args:
            record: inputs, and outputs where they are measured.
            initial: "measured" (from the record), "zero", or an array (rows, ny) of the outputs
                that determine the start.

        Raises:
            InputError: other channels, too few rows, or initial values that are not there.
        """
        return self.model.simulate(record, initial)

    @property
    def judged_record(self) -> Record:
        """The training data in experiments over which a free run is judged.

        Those of an unstable plant are its segments.
        """
        return self.problem.record

    @property
    def excitation(self) -> Excitation:
        """Rank and condition of the parameters in what they were fitted to."""
        raise NotImplementedError

    @property
    def one_step_theta(self) -> Vector | None:
        """θ (nθ,) of physics alone by least squares one step ahead, where the fit has another.

        None otherwise, and of a motion.
        """
        return None

    @cached_property
    def noise(self) -> tuple[OutputNoise, ...]:
        """Return the noise model of each output; empty where nobody asked for one."""
        return noise_of(self.model, self.problem)

    def split(self, measure: Measure) -> Estimate:
        """Return the same function with θ, components and intervals under a measure.

        Nothing is trained again: θ is the least-squares fit of the physics to the function over
        the measure's points.

        Raises:
            InputError: a measure that does not fit the model, or a θ that cannot be split.
        """
        raise NotImplementedError

    @property
    def robust_kinds(self) -> tuple[str, ...]:
        """Robust standard errors that there are for its criterion, the default first."""
        return ROBUST_FREE_RUN

    def robust(self: Fit, lags: int | None = None, kind: str | None = None) -> Fit:
        """Return the fit with standard errors of θ that hold for coloured and uneven noise.

        One step ahead they are those of Newey and West, or HC3 for noise that is uneven and white.
        On the free run they are batch means of the scores (`fitting/block_scores.py`). Both these
        hold for predictions too.

        Args:
            lags: of the autocovariances; on the free run steps of a block. By default `⌊4
                (N/100)^(2/9)⌋`, on the free run three times as many as the correlation of the
                errors lasts.
            kind: "newey-west" or "hc3" one step ahead; on the free run "batch-means",
                "batch-means-uneven" where the errors are white and of uneven size, or
                "autoregressive" for errors of an autoregressive process; None for the first that
                there is.

        Raises:
            InputError: a fit without standard errors or statistics; errors that remember each
                other for too long; a kind that is not for this criterion.
        """
        kinds = self.robust_kinds
        kind = kinds[0] if kind is None else check_choice(kind, kinds, "`kind`")
        self._check_not_withheld()
        statistics = self._white_statistics
        if (
            self.scores is None
            or self.covariance is None
            or statistics.gram is None
            or self.model.numbers.tilt is not None
        ):
            raise InputError(
                "the fit has no statistics for robust standard errors; fit the data again."
            )
        steps = None if lags is None else check_count(lags, "lags")
        used = len(self.theta) + self.effective_weights
        modelled = kind == "autoregressive"
        moving = np.array([name not in self.at_bound for name in self.problem.names], dtype=bool)
        own = self.scores.robust(statistics, self.freedom, used, steps, moving, modelled=modelled)
        return replace(self._with_statistics(own, kind), freedom=own.freedom)._renewed()

    def _check_not_withheld(self) -> None:
        """Raise InputError where the errors allow no standard errors of any kind."""
        if self.std_kind == "none":
            raise InputError(
                "no kind of standard errors holds for this fit: its errors are correlated over too "
                "much of the record, as its warning says. Use a longer record, or physics with "
                "smaller errors."
            )

    def _with_statistics(self: Fit, statistics: Statistics, kind: str) -> Fit:
        """Return the fit with statistics for robust errors, beside those for white noise."""
        return replace(
            self,
            model=replace(self.model, statistics=statistics),
            plain_covariance=self._white_covariance,
            plain_statistics=self._white_statistics,
            std_kind=kind,
        )

    @property
    def _white_covariance(self) -> Matrix | None:
        """Cov θ̂ for white noise; None where there are no standard errors."""
        return self.covariance if self.plain_covariance is None else self.plain_covariance

    @property
    def _white_statistics(self) -> Statistics:
        """The model's statistics for white noise."""
        return self.model.statistics if self.plain_statistics is None else self.plain_statistics

    def _renewed(self: Fit) -> Fit:
        """Return the fit with the covariance of θ̂ that follows from the model's statistics."""
        return replace(self, covariance=self._covariance_by(self.model.statistics))

    def _with_split(self: Fit, split: MeasureSplit, warnings: Sequence[Warning] = ()) -> Fit:
        """Return the fit with θ, standard errors and warnings of a split."""
        numbers = self.model.numbers._replace(theta=split.theta, theta_aux=split.theta_aux)
        kept = (w for w in self.warnings if w.code not in self._of_split)
        made = replace(
            self,
            model=replace(self.model, numbers=numbers, measure=split.name),
            split_by=split,
            defect=split.defect,
            warnings=(*kept, *split.warnings, *warnings),
        )
        covariance, plain = made._covariance_by(self.model.statistics), self.plain_covariance
        if plain is not None:
            plain = made._covariance_by(self._white_statistics)
        if self.std_kind in WITHHELD:
            covariance = None
        return replace(made, covariance=covariance, plain_covariance=plain)

    def _covariance_by(self, statistics: Statistics) -> Matrix | None:
        """Return Cov θ̂ = K Cov(c, w) Kᵀ by statistics of (c, w)."""
        made = self.free_covariance(statistics)
        slope = None if made is None else self.theta_slope
        if made is None or slope is None:
            return None
        joint, moves = made
        return joint.of(slope[:, moves])

    def free_covariance(
        self, statistics: Statistics | None = None
    ) -> tuple[JointCovariance, Bool[np.ndarray, "n"]] | None:
        """Return Cov (c, w) of the entries that are not at a bound, and a mask of these.

        None without statistics, by default the model's.
        """
        statistics = self.model.statistics if statistics is None else statistics
        if statistics.gram is None:
            return None
        count = len(self.theta)
        moves = self._moving(len(statistics.gram))
        joint = statistics.among(moves, count).joint(int(moves[:count].sum()))
        return None if joint is None else (joint, moves)

    def _moving(self, count: int) -> Bool[np.ndarray, "n"]:
        """Return a mask of those of the `count` entries of (c, w) that are unknowns."""
        return np.ones(count, dtype=bool)

    @property
    def theta_slope(self) -> Matrix | None:
        """∂θ/∂(c, w) (nθ, nθ + nw) under the measure; None where that is not known."""
        return None if self.split_by is None else self.split_by.slope

    @property
    def theta(self) -> Vector:
        """θ̂ (nθ,); of a motion the coordinates of p̂ (np,)."""
        return self.model.theta

    @property
    def coordinates(self) -> Coordinates:
        """The parameters, and the map from θ̂ to their values."""
        return self.model.form.coordinates

    @property
    def values(self) -> Vector:
        """The parameters' values: θ̂ (nθ,), or p̂ (np,) of a motion."""
        return np.asarray(self.coordinates.physical(self.theta))

    @property
    def std(self) -> Vector | None:
        """Standard errors of the values, NaN where one has none."""
        return self._std_of(self.covariance)

    @property
    def known_std(self) -> Vector:
        """The standard errors, NaN for all where there are none."""
        return np.full(len(self.values), np.nan) if self.std is None else self.std

    @property
    def plain_std(self) -> Vector | None:
        """The standard errors for white noise, where those of `std` are robust.

        None where they are not.
        """
        return self._std_of(self.plain_covariance)

    def _std_of(self, covariance: Matrix | None) -> Vector | None:
        """Return standard errors by the delta method, from a covariance of θ̂."""
        if covariance is None:
            return None
        return np.sqrt(np.diag(covariance)) * np.abs(self.coordinates.slopes(self.theta))

    @property
    def interval(self) -> Matrix | None:
        """95 % intervals of the values (nθ, 2); those of positive parameters are positive."""
        if self.covariance is None:
            return None
        std = np.sqrt(np.diag(self.covariance))
        return self._ends(interval(self.theta, std, max(self.freedom, 1.0)))

    def _ends(self, limits: Matrix) -> Matrix:
        """Return intervals of θ̂ (nθ, 2) as those of the values."""
        return np.stack([self.coordinates.physical(side) for side in limits.T], axis=-1)

    @cached_property
    def parameters(self) -> pd.DataFrame:
        """Table with a row per parameter: unit, initial, value, std, 95 % interval.

        Of a motion also whether a learner could imitate it, `shared`.
        """
        table = parameter_frame(self.coordinates.parameters, self.values, self.std, self.interval)
        return table.assign(**self._more_columns())

    def _more_columns(self) -> dict[str, object]:
        """Return further columns of `parameters`."""
        return {}

    @property
    def layout(self) -> Layout:
        """Names of the entries of `reach`."""
        return self.problem.layout

    def reach(self, record: Record) -> Matrix:
        """Return the points of a record at which the physics is evaluated, (N, nx)."""
        return self.model.reach(record)

    def __repr__(self) -> str:
        values = zip(self.coordinates.parameters, self.values, strict=True)
        return (
            f"Estimate({self.model.structure}, {self.status.code}, loss "
            f"{self.status.loss:.3g}, {', '.join(f'{p.name} = {v:.6g}' for p, v in values)})"
        )

    @property
    def learns(self) -> bool:
        """False where the physics is alone."""
        return self.model.learns

    @cached_property
    def terms(self) -> pd.DataFrame:
        """Table with a row per term of a learner of terms: coefficient, unit, std, 95 % interval.

        Else empty.
        """
        return term_frame(learned_terms(self.model))

    def equation(self, writing: str = "text") -> str:
        """Return the fitted equations with their numbers, where the learner is a sum of terms.

        As "text", "latex", "python".

        Raises:
            InputError: another learner, physics that are Python functions, another writing.
        """
        return equation(self.model, writing)

    @cached_property
    def over_experiments(self) -> OverExperiments | None:
        """Errors of θ̂ for experiments like those fitted, by leaving out one after the other.

        Those of `std` and `interval` hold for the inputs that were applied. None where there are
        fewer than three experiments, or no standard errors.
        """
        if self.covariance is None or self.model.numbers.tilt is not None:
            return None
        if self.problem.record.recordings[-1] + 1 < FEWEST:
            return None
        changes = self._changes_without_each()
        return None if changes is None else self._over_experiments(changes)

    def _changes_without_each(self) -> Matrix | None:
        """Return the changes of θ̂ (E, nθ) where each experiment is left out, to first order.

        The training changes, and so do the points of the split where these are training rows.
        """
        changes = self._changes_of_training()
        rows = None if changes is None or not self.learns else self._rows_of_split()
        if changes is None or rows is None:
            return changes
        projection, directions, values, owner = rows
        every = np.tile(owner, len(values) // len(owner))
        found = split_without_each(projection, directions, values, every, len(changes))
        return None if found is None else changes + found

    def _changes_of_training(self) -> Matrix | None:
        """Return `_changes_without_each` while the points of the split stay, on the free run."""
        statistics, moves = self.model.statistics, self.moves_by()
        free_run = self.criterion.free_run
        assert free_run is not None, "training one step ahead has its own"
        if self.scores is None or statistics.gram is None or moves is None:
            return None
        scores = self.scores.by_recording(self.problem.record, free_run.washout)
        if scores is None:
            return None
        k, free = moves
        nt = int(free[: len(self.theta)].sum())
        half = half_inverse(statistics.among(free, len(self.theta)).information(nt), nt)
        return -scores[:, free] @ half @ (half.T @ k[:, free].T) * left_out(len(scores))

    def _rows_of_split(self) -> tuple[Projection, Matrix | None, Matrix, Vector] | None:
        """Return the points of the split, where these are training rows; None where they are not.

        They are the physics there, the directions it is split along (None for all), the learner
        (N, ny), and the experiment that each training row is of.
        """
        raise NotImplementedError

    def _over_experiments(self, changes: Matrix) -> OverExperiments:
        slopes = self.coordinates.slopes(self.theta)
        found = over_experiments(
            changes, np.asarray(self.covariance), self.freedom, self.theta, slopes
        )
        return replace(found, interval=self._ends(found.interval))

    def moves_by(self) -> tuple[Matrix, Bool[np.ndarray, "n"]] | None:
        """Return ∂θ/∂(c, w), and which entries of (c, w) move; None where that is not known."""
        made = self.free_covariance()
        slope = None if made is None else self.theta_slope
        return None if made is None or slope is None else (slope, made[1])

    def withheld(self: Fit, kind: str, why: Warning) -> Fit:
        """Return the fit without standard errors and intervals of θ, terms and predictions.

        A warning says why.
        """
        statistics = replace(self.model.statistics, middle=None)
        return replace(
            self,
            model=replace(self.model, statistics=statistics),
            covariance=None,
            plain_covariance=None,
            plain_statistics=None,
            std_kind=kind,
            warnings=(*self.warnings, why),
        )

    def _heading(self) -> list[str]:
        """Return the lines of `summary` on physics, learner, data and split."""
        raise NotImplementedError

    def lines(self, interval_head: str = INTERVAL_HEAD) -> list[str]:
        """Return the lines of `summary` before its warnings; intervals have the given head."""
        heading = self._heading()
        if self.plain_covariance is not None:
            heading.append(f"std         {STD_KINDS[self.std_kind]}")
        if self.model.noise is not None:
            heading.append(f"noise       {'; '.join(each.text for each in self.noise)}")
        rows = parameter_lines(
            self.coordinates.parameters, self.values, self.std, self.interval, interval_head
        )
        return [*heading, "", *rows, *term_lines(learned_terms(self.model), interval_head)]

    def summary(self) -> str:
        """Return a page of text: status, parameters with their uncertainty, warnings."""
        warnings = (
            ["", *(f"warning: {warning}" for warning in self.warnings)] if self.warnings else []
        )
        counted = ["", _COUNTED] if self.interval is not None else []
        return "\n".join(fold([*self.lines(), *counted, *warnings]))


def left_out(experiments: int) -> float:
    """Return by how much more θ̂ changes where an experiment is left out than by its own score."""
    return experiments / (experiments - 1)


def parameter_frame(
    parameters: Sequence[Parameter | PhysicalParameter],
    values: Vector,
    std: Vector | None,
    ci: Matrix | None,
) -> pd.DataFrame:
    """Return a table with a row per parameter: unit, initial, value, std, 95 % interval.

    NaN where there is none.
    """
    import pandas as pd

    from orthaug._base.frames import EstimateFrame

    nothing = np.full(len(parameters), np.nan)
    ci = np.stack([nothing, nothing], axis=-1) if ci is None else ci
    return EstimateFrame(
        {
            "unit": [p.unit for p in parameters],
            "initial": [p.initial for p in parameters],
            "value": values,
            "std": nothing if std is None else std,
            "ci95_low": ci[:, 0],
            "ci95_high": ci[:, 1],
        },
        index=pd.Index([p.name for p in parameters], name="parameter"),
    )


def parameter_lines(
    parameters: Sequence[Parameter | PhysicalParameter],
    values: Vector,
    std: Vector | None,
    ci: Matrix | None,
    interval_head: str = INTERVAL_HEAD,
) -> list[str]:
    """Return the parameters as lines of text, a heading first; a dash for no interval."""
    rows = [
        (value, None, None)
        if std is None or ci is None or not np.isfinite(std[i])
        else (value, std[i], ci[i].tolist())
        for i, value in enumerate(values)
    ]
    cells = estimate_rows(rows)
    head = ["parameter", "value", "std", interval_head, "initial", "unit"]
    rows = [
        [p.name, *own, f"{p.initial:.5g}", p.unit] for p, own in zip(parameters, cells, strict=True)
    ]
    return table([head, *rows], drop=["initial"])
