"""The analyses in a result: suspects, residuals, stability, and whether the learner helps."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from orthaug.reports.fields import ByName, Content, Flag, Number, Numbers, WarningResult, Whole
from orthaug.reports.residual_tests import ResidualTestResult


class AlternativeResult(Content):
    """Other learner inputs, and what is determined beside a learner of these."""

    inputs: list[str]
    shared: Whole
    determined: list[str]
    physical: list[str] | None


class SharedResult(Content):
    """What the learner could imitate of the physics: there θ is split off."""

    absent = frozenset({"alternatives", "withdrawn", "doubt"})

    inputs: list[str]
    everything: Flag
    directions: list[ByName]
    determined: list[str]
    physical: list[str] | None
    text: str
    alternatives: list[AlternativeResult] | None = None
    withdrawn: list[str] | None = None
    """Parameters that the fit would determine, were it not for the `doubt`."""
    doubt: str | None = None


class MemoryResult(Content):
    """A term in an equation that predicts what the free run leaves, and the parameters with it."""

    absent = frozenset({"parameters"})

    name: str
    kind: str
    on: str
    scale: Number
    """Time constant [s] of a lag, or width in the unit of `on`."""
    equation: str
    share: Number
    p: Number
    parameters: ByName | None = None


class StructureResult(Content):
    """What the free run leaves beside noise: the best function of a state or an input, and terms with memory."""

    hidden_state: Flag
    static: MemoryResult | None
    memory: list[MemoryResult]


class CertificateResult(Content):
    """Whether some weighting of the points leaves no bias."""

    verdict: str
    direction: ByName | None
    shares: ByName | None
    cosine: Number
    positive: Number
    sentence: str


class BiasResult(Content):
    """The bias of a parameter by what the learner found: estimate less truth, its cause, the cause's share of it."""

    value: Number
    cause: str
    share: Number
    determined: Flag = True
    """Whether the causes that noise cannot tell apart agree enough for an interval to be of use."""


class PhysicalBias(Content):
    """What the guessed coefficient does to a physical parameter."""

    bias: Number
    relative: Number


class ResidualStepResult(Content):
    """What the residual of a motion's free run tells of a term."""

    coefficient: Number
    std: Number
    t: Number
    share: Number
    left: Number


class SuspectResult(Content):
    """What a term that may be missing does to θ."""

    absent = frozenset({"equation", "unit", "residual"})

    name: str
    expression: str
    output: str | None
    coefficient: Number
    bias: ByName
    relative_bias: ByName | None
    expected_bias: ByName | None
    physical_bias: ByName | None
    cosine: Number
    seen: Flag | None
    removed_by: str | None
    explained: Number
    coefficient_found: Number
    certificate: CertificateResult | None
    relative_physical_bias: ByName | None
    size: Number
    expected_physical_bias: dict[str, PhysicalBias] | None
    equation: str | None = None
    unit: str | None = None
    residual: ResidualStepResult | None = None

    @property
    def percent(self) -> dict[str, float | None]:
        """The bias of every θ and physical parameter, in per cent of its value.

        With a guess it is the bias by the guessed coefficient. Without one the term counts as 1 %
        of the outputs' deviation over the measure.
        """
        coefficient = self.coefficient
        if coefficient is None:
            coefficient = 0.01 / self.size if self.size else None
        relative = {**(self.relative_bias or {}), **(self.relative_physical_bias or {})}
        shares = {
            k: None if v is None or coefficient is None else 100 * v * coefficient
            for k, v in relative.items()
        }
        exact = {
            k: 100 * e.relative
            for k, e in (self.expected_physical_bias or {}).items()
            if e.relative
        }
        return shares | exact


class PredictableResult(Content):
    """What could be predicted of an output's error."""

    name: str
    rms: Number
    own_past: Number
    inputs: Number
    functions: Number


class ChangeResult(Content):
    """A change that is predicted to lower an error."""

    kind: str
    what: str
    fall: Number
    of: str
    output: str | None


class MissingTermResult(Content):
    """A term that an equation of a motion could lack."""

    equation: str
    variable: str | None
    shape: str
    coefficient: Number
    share: Number
    expression: str


class MissingResult(Content):
    """The test of terms that the equations of a motion could lack."""

    p: Number
    freedom: list[int]
    share: Number
    terms: list[MissingTermResult]


class DiagnosisResult(Content):
    """What the residuals say about the noise, and which change would help."""

    absent = frozenset({"steps"})

    verdict: str
    text: str
    one_step: list[ResidualTestResult]
    free_run: list[ResidualTestResult] | None
    free_run_to_one_step: Number = Field(validation_alias="ratio")
    noise_in_lags: Number
    predictable: list[PredictableResult]
    changes: list[ChangeResult]
    missing: MissingResult | None = None
    steps: ByName | None = None


class LagResult(Content):
    """The residual against a lag that the learner does not see."""

    lag: str
    p: Number
    share: Number


class MissingLagsResult(Content):
    """Whether what the physics lacks is a function of what the learner sees."""

    level: Number
    tests: list[LagResult]
    missing: list[LagResult]
    text: str


class PlaceResult(Content):
    """A point of the data or beside them."""

    experiment: int | None
    row: int | None
    where: str
    regressor: ByName


class FeedbackResult(Content):
    """The local spectral radius along the free run."""

    largest: Number
    median: Number
    share_above_one: Number
    worst: PlaceResult | None
    steps: Whole
    skipped: Whole
    diverged: list[str]


class ContractionResult(Content):
    """The best norm in which the sampled points contract."""

    rate: Number
    bound: Number
    share: Number
    samples: Whole
    overshoot: Number
    metric: list[Numbers]
    worst: PlaceResult


class LipschitzResult(Content):
    """The largest gradients of the one-step predictor."""

    gradient: Number
    gradient_scaled: Number
    worst: PlaceResult | None
    phi: Number
    phi_scaled: Number
    phi_worst: PlaceResult | None
    weights: Number
    weights_scaled: Number
    weights_worst: PlaceResult | None
    rows: Whole
    weights_rows: Whole


class ModesResult(Content):
    """Eigenvalues of a linearised motion along the free run [1/s]."""

    points: Whole
    rightmost: Number
    median: Number
    growing: Number
    slowest: Number
    fastest: Number
    worst: ByName
    integrators: Whole = 0


class StabilityResult(Content):
    """Evidence on the free run."""

    absent = frozenset({"modes", "radius_beyond"})

    feedback: FeedbackResult | None
    contraction: ContractionResult | None
    diverges_at: Number
    searched: Number
    lipschitz: LipschitzResult | None
    modes: ModesResult | None = None
    radius_beyond: Number = None
    warnings: list[WarningResult]
    text: str


class TrialResult(Content):
    """Free-run errors on data that were not fitted."""

    where: str
    physics_alone: Number = Field(validation_alias="alone")
    model: Number


class RatioResult(Content):
    """Error with the learner over that of physics alone, with its 95 % interval."""

    value: Number
    low: Number
    high: Number


class ExtrapolationResult(Content):
    """How far a part leaves the training data."""

    part: str
    regressor: str = Field(validation_alias="lag")
    training: Numbers
    found: Numbers = Field(validation_alias="reach")
    share: Number


class ValidationResult(Content):
    """Whether the learner earns its place."""

    verdict: str = Field(validation_alias="code")
    text: str
    ratio: RatioResult | None = None
    trials: list[TrialResult]
    extrapolation: list[ExtrapolationResult]


class HoldResult(Content):
    """What physics alone leaves under a hold, in deviations of the outputs."""

    hold: str
    residual: Number
    declared: Flag
    parameters: ByName | None


class AdviceResult(Content):
    """A change of the spec that was tried and bettered the free run where nothing was fitted.

    `change` has the new values by their keys, `before` and `after` the RMS errors in standard
    deviations of the training output; `before` is None where the model as it is diverges.
    """

    change: dict[str, Any]
    text: str
    before: Number
    after: Number


class AdviceTrialsResult(Content):
    """How many changes of the spec were tried, and how many were left out to spare time."""

    text: str
    tried: Whole
    not_tried: Whole


class MotionCheckResult(Content):
    """What can be said of a motion before training."""

    states: list[str]
    integrator: str
    fastest: Number
    substeps: Whole | None
    rows: Whole
    holds: list[HoldResult]
    best_hold: str | None
    text: str


class EquationPartsResult(Content):
    """RMS of what physics and learner add to a learned equation or output along the training run, in its unit."""

    equation: str
    unit: str
    physics: Number
    learner: Number
    share: Number


class MotionFitResult(Content):
    """How a fitted motion is integrated, and the rows that a prediction starts from.

    `substep_bias`: the parameters less what a fit with twice the substeps would give.
    """

    states: list[str]
    integrator: str
    substeps: Whole
    hold: str
    window: Whole
    parts: list[EquationPartsResult] = []
    substep_bias: ByName | None = None
