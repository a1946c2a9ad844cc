"""The findings of a fit: what `orthaug fit` says of it, declared once for memory and for JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, PrivateAttr

from orthaug._base.checks import Matrix, Vector
from orthaug._base.content import ByName, Content, Flag, Number, Numbers, Whole
from orthaug._base.errors import Warning
from orthaug._base.views import MAKERS
from orthaug.analysis.findings import (
    BiasResult,
    DiagnosisResult,
    MissingLagsResult,
    MotionFitResult,
    SharedResult,
    StabilityResult,
    StructureResult,
    SuspectResult,
    ValidationResult,
)
from orthaug.analysis.residual_tests import RunningTestResult
from orthaug.fitting.output_noise import Coefficient
from orthaug.inference.chosen_terms import Intervals
from orthaug.inference.learned_terms import LearnedTerm
from orthaug.inference.physical import Consistency
from orthaug.physics.baseline import Parameter
from orthaug.physics.parameters import PhysicalParameter

if TYPE_CHECKING:
    from orthaug.analysis.budget import ParameterBias
    from orthaug.inference.physical import PhysicalEstimate


class StatusResult(Content):
    """The status: how training ended."""

    code: str
    message: str
    iterations: Whole
    seconds: Number
    loss: Number
    start_loss: Number


class RestartResult(Content):
    """One run from its own initial weights."""

    absent: ClassVar = frozenset({"score"})

    seed: Whole
    loss: Number
    iterations: Whole
    code: str
    chosen: Flag
    regularization: str | float
    validation: Number
    score: Number = None


class ParameterResult(Content):
    """A parameter with its interval."""

    absent: ClassVar = frozenset(
        {"derived_unit", "one_step", "profile95", "plain_std", "shared", "ci95_counts", "selected"}
    )

    name: str
    unit: str
    derived_unit: str | None = None
    """The unit implied by those of the channels, where the spec gives none."""
    initial: Number
    value: Number
    one_step: Number = None
    std: Number = None
    plain_std: Number = None
    ci95: Numbers | None = None
    ci95_counts: Literal["noise only"] | None = None
    """What the interval counts, where the residual shows more than noise."""
    profile95: Numbers | None = None
    selected: Flag | None = None
    """True of the coefficient of a term whose form was selected from the data."""
    shared: Flag | None = None
    bias: BiasResult | None = None
    ci95_with_bias: Numbers | None = None

    @property
    def shown_unit(self) -> str:
        """Unit of the spec, or in brackets the one that follows from those of the channels."""
        return self.unit or (f"({self.derived_unit})" if self.derived_unit else "–")

    @property
    def errors_of_bias(self) -> float:
        """The size of its bias in standard errors."""
        return abs(self.bias.value or 0.0) / self.std if self.bias and self.std else 0.0

    @property
    def share_of_bias(self) -> float | None:
        """Its bias over its value; None of a value that may be 0."""
        if self.bias is None or not self.value or abs(self.value) <= (self.std or 0.0):
            return None
        return (self.bias.value or 0.0) / self.value

    def with_bias(self, shared: bool | None, bias: ParameterBias | None) -> ParameterResult:
        """Return the parameter with its bias, and with whether the learner could imitate it."""
        found: dict[str, object] = {"shared": shared}
        if bias is not None:
            interval = None if bias.ci95 is None else list(bias.ci95)
            found |= {"bias": BiasResult.model_validate(bias), "ci95_with_bias": interval}
        return self.model_copy(update=found)


class MeasureResult(Content):
    """The measure that θ was split under."""

    kind: str = Field(validation_alias="name")
    points: Whole
    support: Number
    condition: Number
    std_over_training: Numbers | None = Field(validation_alias="price")


class OutputWeightsResult(Content):
    """Weights of the outputs against each other: errors e count as ‖matrix · e‖²."""

    kind: str
    matrix: list[Numbers]


class ExcitationResult(Content):
    """Excitation: how well the data identify the parameters."""

    rank: Whole
    columns: Whole
    condition: Number


def _where_any(values: Any) -> Any:
    """Return None instead of a list where no output has a score."""
    return None if isinstance(values, np.ndarray) and np.isnan(values).all() else values


Score = Annotated[Numbers | None, BeforeValidator(_where_any)]


class ScoreResult(Content):
    """One number per output; None where there is none."""

    rmse: Score = None
    nrmse: Score = None
    fit: Score = None


class PartScores(Content):
    """The scores of a part."""

    prediction: ScoreResult
    simulation: ScoreResult
    residual: list[RunningTestResult] | None = None
    """Tests of the one-step residual over all rows of a part that is too long to keep in memory."""

    @property
    def kinds(self) -> dict[str, ScoreResult]:
        """Scores by horizon: one step ahead, and the free run."""
        return {"prediction": self.prediction, "simulation": self.simulation}


class EquationResult(Content):
    """The fitted equations, one a line."""

    text: str
    latex: str


class FocusCandidateResult(Content):
    """A model whose free run was compared on validation data.

    `error` in standard deviations of the output.
    """

    focus: str
    learner: Flag
    error: Number


class FocusResult(Content):
    """The criterion that the data chose, one step ahead or free run, and the reason."""

    chosen: str
    text: str
    candidates: list[FocusCandidateResult]


class PhysicsAloneResult(Content):
    """The physics without a learner beside the model."""

    scores: dict[str, PartScores]


class ParameterOverExperiments(Content):
    """A parameter's interval for experiments like those that were fitted."""

    name: str
    std: Number
    ci95: Numbers
    ratio: Number
    """`std` over that of the applied inputs."""


class OverExperimentsResult(Content):
    """Intervals for experiments like those that were fitted, from their own differences."""

    experiments: Whole
    parameters: list[ParameterOverExperiments]
    physical_parameters: list[ParameterOverExperiments] | None = None


class NoiseResult(Content):
    """The noise model `D(q) v = C(q) e` of an output, and its innovations e.

    Of a motion the coefficients are the output's column of the gain K of its predictor, and there
    are no orders.
    """

    output: str
    model: str
    ar: Whole | None
    ma: Whole | None
    coefficients: list[Coefficient]
    innovations_std: Number = Field(validation_alias="std")
    white_p: Number
    text: str


class Findings(Content):
    """Everything that is found on a fit: parameters, scores, tests, verdicts and warnings."""

    absent: ClassVar = frozenset(
        {
            "motion",
            "terms",
            "equation",
            "unexplained",
            "standard_errors_by",
            "intervals",
            "over_experiments",
            "noise",
        }
    )

    status: StatusResult
    restarts: list[RestartResult]
    parameters: list[ParameterResult]
    standard_errors: str | None
    standard_errors_by: str | None = None
    """Kind of the standard errors, a key of `fitting.estimates.STD_KINDS`; None for white noise.
    """
    physical_parameters: list[ParameterResult] | None
    over_experiments: OverExperimentsResult | None = None
    """Only of three experiments or more: intervals that hold for others like them."""
    physical_consistency: Consistency | None
    sensitivities: dict[str, ByName] | None
    noise: list[NoiseResult] | None = None
    """Of every output, where a noise model was asked for."""
    structure: str
    measure: str | None
    measure_detail: MeasureResult | None
    orthogonality_defect: Number
    output_weights: OutputWeightsResult | None
    shared: SharedResult | None
    excitation: ExcitationResult
    scores: dict[str, PartScores]
    focus: FocusResult | None = None
    physics_alone: PhysicsAloneResult | None = None
    bias: list[SuspectResult] | None
    residuals: DiagnosisResult | None
    unexplained: StructureResult | None = None
    missing_lags: MissingLagsResult | None
    stability: StabilityResult | None
    validation: ValidationResult | None
    motion: MotionFitResult | None = None
    terms: list[LearnedTerm] | None = None
    equation: EquationResult | None = None
    intervals: Intervals | None = None
    """Where those of chosen terms come from; None where the spec says no rows that chose."""
    warnings: list[Warning]

    _fit: Any = PrivateAttr(default=None)

    def about(self, fit: object) -> Self:
        """Return the findings with their `Estimate`, so that they can be printed and shown."""
        found = self.model_copy()
        found._fit = fit
        return found

    @property
    def fit(self) -> Any:
        """The `Estimate` with the standard errors of the findings; None if they were read."""
        return self._fit

    @property
    def verdict(self) -> str:
        """Whether the model is reliable, and what it is good for, in two sentences or more."""
        return MAKERS["verdict"](self)

    def __str__(self) -> str:
        return repr(self) if self._fit is None else MAKERS["findings"](self._fit, self, html=False)

    def __repr__(self) -> str:
        residual = "not analysed" if self.residuals is None else self.residuals.verdict
        learner = "" if self.validation is None else f", learner {self.validation.verdict}"
        codes = ", ".join(dict.fromkeys(warning.code for warning in self.warnings)) or "none"
        return f"Findings({self.status.code}, residual {residual}{learner}, warnings: {codes})"

    def _repr_html_(self) -> str | None:
        return None if self._fit is None else MAKERS["findings"](self._fit, self, html=True)

    def changed(self, **fields: object) -> Self:
        """Return the findings with other fields, checked."""
        return type(self).model_validate({**dict(self), **fields})

    @property
    def noise_only(self) -> bool:
        """True if the intervals count noise only, although the residual shows more than that."""
        return any(row.ci95_counts for row in (*self.parameters, *(self.physical_parameters or ())))

    @property
    def learns(self) -> bool:
        """True if the biases are due to a learned part.

        Without one, those of a motion are due to the residual of the free run.
        """
        return self.motion is None or self.shared is not None


def parameter_rows(
    parameters: Sequence[Parameter | PhysicalParameter],
    values: Vector,
    std: Vector | None = None,
    interval: Matrix | None = None,
    one_step: Vector | None = None,
    plain_std: Vector | None = None,
) -> list[ParameterResult]:
    """Return θ as results list it; a parameter at a bound has no interval."""
    return [
        ParameterResult.model_validate(
            {
                "name": parameter.name,
                "unit": parameter.unit,
                "initial": parameter.initial,
                "value": values[i],
                "one_step": None if one_step is None else one_step[i],
                "std": None if std is None else std[i],
                "plain_std": None if plain_std is None else plain_std[i],
                "ci95": None if interval is None or np.isnan(interval[i]).any() else interval[i],
                "selected": parameter.selected or None,
            }
        )
        for i, parameter in enumerate(parameters)
    ]


def physical_rows(
    estimate: PhysicalEstimate, profiles: dict[str, tuple[float, float]] | None = None
) -> list[ParameterResult]:
    """Return the physical parameters as results list them, with their profile intervals."""
    columns = (
        estimate.names,
        estimate.units,
        estimate.initial,
        estimate.value,
        estimate.std,
        estimate.ci95,
    )
    keys = ("name", "unit", "initial", "value", "std", "ci95")
    rows = [dict(zip(keys, row, strict=True)) for row in zip(*columns, strict=True)]
    return [
        ParameterResult.model_validate(row | {"profile95": (profiles or {}).get(row["name"])})
        for row in rows
    ]
