"""Content of result.json, and of other commands' JSON; text, page and plots read it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from orthaug import __version__
from orthaug._base.content import ByName, Content, Flag, Number, Numbers, Whole
from orthaug._base.errors import Warning
from orthaug.analysis.findings import (
    AdviceResult,
    AdviceTrialsResult,
    DiagnosisResult,
    MotionCheckResult,
    SharedResult,
    SuspectResult,
    ValidationResult,
)
from orthaug.analysis.fit_findings import (
    ExcitationResult,
    Findings,
    MeasureResult,
    ParameterResult,
    PartScores,
)
from orthaug.reports.failure import ErrorResult

if TYPE_CHECKING:
    from orthaug.analysis.input_search import Design

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


class GroupedExcitation(ExcitationResult):
    """Excitation, with the groups of parameters that the data do not separate."""

    collinear: list[list[str]]


class IdentifiabilityResult(Content):
    """Identifiability: whether any data could separate the parameters."""

    identifiable: Flag = Field(validation_alias="full_rank")
    rank: Whole
    columns: Whole
    inseparable: list[list[str]] = Field(validation_alias="collinear")


class Declared(ResultHeader):
    """The fields of a result that say what was asked: the spec and its data."""

    spec: dict[str, Any]
    data: DataResult


class FitResult(Findings, Declared):
    """The result of `orthaug fit`: the findings on the fit of a spec, and advice on the spec."""

    absent: ClassVar = Findings.absent | {"error"}

    advice: list[AdviceResult] = []
    advice_trials: AdviceTrialsResult | None = None
    error: ErrorResult | None = None
    """Only as printed by `--json` where training failed."""


class CheckResult(ResultHeader):
    """The result of `orthaug check`."""

    absent: ClassVar = frozenset({"motion", "error"})

    data: DataResult
    parameters: list[str]
    regressor: list[str]
    rows: Whole
    excitation: GroupedExcitation
    identifiability: IdentifiabilityResult
    shared: SharedResult | None
    bias: list[SuspectResult] | None
    motion: MotionCheckResult | None = None
    warnings: list[Warning]
    error: ErrorResult | None = None
    """Only of parameters that the data do not determine."""


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
    warnings: list[Warning]
    learner_to_physics: Number
    validation: ValidationResult | None


class DifferenceResult(Content):
    """The difference of a parameter: that of a saved result less that of the first one."""

    name: str
    result: str
    """The name of the other row."""
    value: Number
    of_std: Number
    """The difference over the larger of both standard errors; None where there is none."""


class SettingResult(Content):
    """A key of the spec in which saved results differ, with its value by the name of the row."""

    key: str
    values: dict[str, Any]
    """None where the spec does not have the key, and its default holds."""


class CompareResult(ResultHeader):
    """The result of `orthaug compare`: of a spec, or of saved results.

    Of saved results `spec` is that of the first one, and `data` are the parts that all have.
    """

    absent: ClassVar = frozenset({"differences", "settings", "equal"})

    spec: dict[str, Any]
    data: DataResult
    comparison: list[RowResult]
    chosen: str | None
    left_out: dict[str, str]
    differences: list[DifferenceResult] | None = None
    """Of every parameter that a saved result shares with the first one."""
    settings: list[SettingResult] | None = None
    equal: list[str] | None = None
    """Rows whose held-out error differs from that of the best one by chance alone, and the best
    one first; None where there are none.
    """
    warnings: list[Warning]


class SplitResult(ResultHeader):
    """The result of `orthaug split`."""

    parameters: list[ParameterResult]
    theta_aux: Numbers
    measure: str
    measure_detail: MeasureResult
    orthogonality_defect: Number
    warnings: list[Warning]


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
