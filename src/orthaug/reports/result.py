"""Content of result.json, and of other commands' JSON; text, page and plots read it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from orthaug import __version__
from orthaug.physics.baseline import Parameter
from orthaug.physics.parameters import PhysicalParameter
from orthaug.reports.fields import (
    ByName,
    Content,
    Flag,
    IntervalsResult,
    Number,
    Numbers,
    WarningResult,
    Whole,
)
from orthaug.reports.findings import (
    AdviceResult,
    AdviceTrialsResult,
    BiasResult,
    DiagnosisResult,
    MissingLagsResult,
    MotionCheckResult,
    MotionFitResult,
    SharedResult,
    StabilityResult,
    StructureResult,
    SuspectResult,
    ValidationResult,
)
from orthaug.reports.residual_tests import RunningTestResult

if TYPE_CHECKING:
    from orthaug.analysis.budget import ParameterBias
    from orthaug.analysis.input_search import Design
    from orthaug.inference.motion_split import MotionSplit
    from orthaug.inference.physical import PhysicalEstimate

SCHEMA = 2


class ResultHeader(Content):
    """The fields that every result begins with."""

    schema_number: Literal[2] = Field(
        SCHEMA, validation_alias="schema", serialization_alias="schema"
    )
    orthaug: str = __version__


class FileResult(Content):
    """A data file that was read."""

    file: str
    sha256: str
    rows: int


class PreparedResult(Content):
    """A step of preparation: `samples` marked as missing or reconstructed in all training files."""

    step: str
    options: dict[str, Any]
    samples: Whole
    text: str


class DataResult(Content):
    """The files of each part, and the steps of preparation common to all parts."""

    absent: ClassVar = frozenset({"validation", "tests", "prepare"})

    train: list[FileResult]
    validation: list[FileResult] | None = None
    tests: dict[str, list[FileResult]] | None = None
    prepare: list[PreparedResult] | None = None

    @property
    def parts(self) -> dict[str, list[FileResult]]:
        """Files of every part, by its name."""
        held_out = {} if self.validation is None else {"validation": self.validation}
        return {"train": self.train, **held_out, **(self.tests or {})}


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
        {"derived_unit", "one_step", "profile95", "plain_std", "shared", "ci95_counts"}
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
    shared: Flag | None = None
    bias: BiasResult | None = None
    ci95_with_bias: Numbers | None = None

    @property
    def shown_unit(self) -> str:
        """Unit of the spec, or in brackets the one that follows from those of the channels."""
        return self.unit or (f"({self.derived_unit})" if self.derived_unit else "–")

    def with_bias(self, shared: bool | None, bias: ParameterBias | None) -> ParameterResult:
        """Return the parameter with its bias, and with whether the learner could imitate it."""
        found: dict[str, object] = {"shared": shared}
        if bias is not None:
            interval = None if bias.ci95 is None else list(bias.ci95)
            found |= {"bias": BiasResult.model_validate(bias), "ci95_with_bias": interval}
        return self.model_copy(update=found)


class ConsistencyResult(Content):
    """Test of whether θ̂ obeys the relations that the physics fixes among θ."""

    chi2: Number
    df: Whole
    p: Number
    text: str


class MeasureResult(Content):
    """The measure that θ was split under."""

    kind: str = Field(validation_alias="name")
    points: Whole
    support: Number
    condition: Number
    std_over_training: Numbers | None = Field(validation_alias="price")

    @classmethod
    def of_motion(cls, split: MotionSplit) -> MeasureResult:
        """Return the measure of a motion, which has neither a condition of Φ nor a price."""
        own = {"name": split.name, "points": len(split.field.x), "support": split.support}
        return cls.model_validate({**own, "condition": None, "price": None})


class OutputWeightsResult(Content):
    """Weights of the outputs against each other: errors e count as ‖matrix · e‖²."""

    kind: str
    matrix: list[Numbers]


class ExcitationResult(Content):
    """Excitation: how well the data identify the parameters."""

    rank: Whole
    columns: Whole
    condition: Number


class GroupedExcitation(ExcitationResult):
    """Excitation, with the groups of parameters that the data do not separate."""

    collinear: list[list[str]]


class IdentifiabilityResult(Content):
    """Identifiability: whether any data could separate the parameters."""

    identifiable: Flag = Field(validation_alias="full_rank")
    rank: Whole
    columns: Whole
    inseparable: list[list[str]] = Field(validation_alias="collinear")


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


class TermResult(Content):
    """A term of a learner of terms."""

    term: str
    added_to: str
    coefficient: Number
    unit: str | None
    largest: Number
    std: Number
    ci95: Numbers | None


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


class CoefficientResult(Content):
    """A coefficient of a noise model."""

    name: str
    value: Number
    std: Number
    ci95: Numbers | None


class NoiseResult(Content):
    """The noise model `D(q) v = C(q) e` of an output, and its innovations e."""

    output: str
    model: str
    ar: Whole
    ma: Whole
    coefficients: list[CoefficientResult]
    innovations_std: Number = Field(validation_alias="std")
    white_p: Number
    text: str


class FitResult(ResultHeader):
    """The result of `orthaug fit`."""

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

    spec: dict[str, Any]
    data: DataResult
    status: StatusResult
    restarts: list[RestartResult]
    parameters: list[ParameterResult]
    standard_errors: str | None
    standard_errors_by: str | None = None
    """Kind of the standard errors, a key of `fitting.any_fit.STD_KINDS`; None for white noise.
    """
    physical_parameters: list[ParameterResult] | None
    over_experiments: OverExperimentsResult | None = None
    """Only of three experiments or more: intervals that hold for others like them."""
    physical_consistency: ConsistencyResult | None
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
    terms: list[TermResult] | None = None
    equation: EquationResult | None = None
    intervals: IntervalsResult | None = None
    """Where those of chosen terms come from; None where the spec says no rows that chose."""
    advice: list[AdviceResult] = []
    advice_trials: AdviceTrialsResult | None = None
    warnings: list[WarningResult]

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


class CheckResult(ResultHeader):
    """The result of `orthaug check`."""

    absent: ClassVar = frozenset({"motion"})

    data: DataResult
    parameters: list[str]
    regressor: list[str]
    rows: Whole
    excitation: GroupedExcitation
    identifiability: IdentifiabilityResult
    shared: SharedResult | None
    bias: list[SuspectResult] | None
    motion: MotionCheckResult | None = None
    warnings: list[WarningResult]


class RowResult(Content):
    """One model in a comparison."""

    name: str
    status: str
    seconds: Number
    weights: Whole
    parameters: list[ParameterResult]
    orthogonality_defect: Number
    scores: dict[str, PartScores]
    residuals: DiagnosisResult | None
    warnings: list[WarningResult]
    learner_to_physics: Number
    validation: ValidationResult | None


class CompareResult(ResultHeader):
    """The result of `orthaug compare`."""

    spec: dict[str, Any]
    data: DataResult
    comparison: list[RowResult]
    chosen: str | None
    left_out: dict[str, str]
    warnings: list[WarningResult]


class SplitResult(ResultHeader):
    """The result of `orthaug split`."""

    parameters: list[ParameterResult]
    theta_aux: Numbers
    measure: str
    measure_detail: MeasureResult
    orthogonality_defect: Number
    warnings: list[WarningResult]


class CandidateResult(Content):
    """A signal that was tried."""

    name: str
    cost: Number
    bias: Number
    std: Number
    condition: Number


class DesignResult(Content):
    """The result of `orthaug design`."""

    kind: str
    relative_error: Number
    condition: Number
    cost: Number
    bias: ByName
    std: ByName
    samples: Whole
    candidates: list[CandidateResult]

    @classmethod
    def of(cls, design: Design) -> DesignResult:
        """Return the content of a design, without its signal."""
        by_name = {
            key: dict(zip(design.names, getattr(design, key), strict=True))
            for key in ("bias", "std")
        }
        return cls.model_validate({**vars(design), **by_name, "samples": len(design.signal)})


def parameter_rows(
    parameters: Sequence[Parameter | PhysicalParameter],
    values: Any,
    std: Any = None,
    interval: Any = None,
    one_step: Any = None,
    plain_std: Any = None,
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
