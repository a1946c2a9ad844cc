"""The analyses in a result: suspects, residuals, stability, and whether the learner helps."""

from __future__ import annotations

import math
from typing import Any

from pydantic import Field

from orthaug._base.content import ByName, Content, Flag, Number, Numbers, Whole
from orthaug._base.errors import Warning
from orthaug.analysis.bias import ResidualStep
from orthaug.analysis.changes import Change
from orthaug.analysis.imitation import Alternative
from orthaug.analysis.input_timing import HoldTrial
from orthaug.analysis.learned_part import EquationParts
from orthaug.analysis.lipschitz import Lipschitz
from orthaug.analysis.missing_lags import LagTest
from orthaug.analysis.missing_term import Placed
from orthaug.analysis.motion_modes import Modes
from orthaug.analysis.predictability import Predictable
from orthaug.analysis.residual_tests import ResidualTestResult
from orthaug.analysis.visited import RunPoint


class SharedResult(Content):
    """Physics that the learner could imitate: θ is split off along these directions."""

    absent = frozenset({"alternatives", "withdrawn", "doubt"})

    inputs: list[str]
    everything: Flag
    directions: list[ByName]
    determined: list[str]
    physical: list[str] | None
    text: str
    alternatives: list[Alternative] | None = None
    withdrawn: list[str] | None = None
    """Parameters that the fit would determine without the `doubt`."""
    doubt: str | None = None


class MemoryResult(Content):
    """A term in an equation that predicts the free run's residual, and the parameters with it."""

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
    """Structure in the free run's residual: a function of a signal, and terms with memory."""

    hidden_state: Flag
    static: MemoryResult | None
    memory: list[MemoryResult]


class CertificateResult(Content):
    """Test of whether some weighting of the points leaves no bias."""

    verdict: str
    direction: ByName | None
    shares: ByName | None
    cosine: Number
    positive: Number
    sentence: str


class BiasResult(Content):
    """The bias of a parameter by the learned part: estimate less truth, its cause and share.

    Without a share the cause is another form of a term whose form was selected from the data.
    """

    value: Number
    cause: str
    share: Number
    determined: Flag = True
    """True if the causes that noise cannot distinguish agree enough for a useful interval."""


class PhysicalBias(Content):
    """The change of a physical parameter by the guessed coefficient."""

    bias: Number
    relative: Number


NO_GUESS = 0.01  # of the outputs' standard deviation: a term without a guess of its size
_AT_ZERO = 1e5  # times a value: a bias by which it is next to zero, and per cent mean nothing


class SuspectResult(Content):
    """The change of θ by a term that may be missing."""

    absent = frozenset({"equation", "unit", "residual", "memory"})

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
    residual: ResidualStep | None = None
    memory: str | None = None
    """What the expression drives, in words; None of a term without memory."""

    @property
    def percent(self) -> dict[str, float | None]:
        """Bias of every θ and physical parameter, in per cent of its value.

        With a guess it is the bias by the guessed coefficient. Without one the RMS of the term
        counts as `NO_GUESS` of the outputs' standard deviation, with the sign that the learner
        shows, so that the bias has the sign of a budget's. None of a value that is next to zero.
        """
        coefficient = self.coefficient
        if coefficient is None and self.size:
            coefficient = math.copysign(NO_GUESS / self.size, self.coefficient_found or 1.0)
        relative = {**(self.relative_bias or {}), **(self.relative_physical_bias or {})}
        shares = {
            k: None
            if v is None or coefficient is None or abs(v * coefficient) > _AT_ZERO
            else 100 * v * coefficient + 0.0  # no -0
            for k, v in relative.items()
        }
        exact = {
            k: 100 * e.relative
            for k, e in (self.expected_physical_bias or {}).items()
            if e.relative
        }
        return shares | exact


class MissingTermResult(Placed, Content):
    """A term that an equation of a motion may lack.

    `equation` is None of one of an `output`, and of one that acts as the input or force `beside`.
    """

    absent = frozenset({"beside", "saturates"})

    equation: str | None
    output: str | None = None
    beside: str | None = None
    saturates: Number | None = None
    """The size at which the variable, an input, seems to saturate."""
    variable: str | None
    shape: str
    coefficient: Number
    share: Number
    expression: str
    term: str = "1"
    """The expression without its coefficient."""
    variables: list[str] = []
    """The states and inputs that it depends on."""


class MissingResult(Content):
    """The test of terms that the equations of a motion may lack."""

    p: Number
    freedom: list[int]
    share: Number
    terms: list[MissingTermResult]


class LateInputResult(Content):
    """An input that acts later or earlier than in the equations, with what each way leaves."""

    input: str
    delay: int | float
    """Samples, such as 2 or 2.4; negative of an input that acts earlier than recorded."""
    delayed: Number
    time_constant: Number
    """Of a first-order lag, in s."""
    lagged: Number
    declared: Number
    by_lag: bool
    alike: bool
    ahead: bool = False
    """True if what is left is what the errors' own past does not predict."""


class DiagnosisResult(Content):
    """Diagnosis of the residuals: the kind of noise, and the change that would help."""

    absent = frozenset({"steps"})

    verdict: str
    text: str
    one_step: list[ResidualTestResult]
    free_run: list[ResidualTestResult] | None
    free_run_to_one_step: Number = Field(validation_alias="ratio")
    noise_in_lags: Number
    predictable: list[Predictable]
    changes: list[Change]
    missing: MissingResult | None = None
    late: list[LateInputResult] = []
    steps: ByName | None = None


class MissingLagsResult(Content):
    """Test of whether the missing physics is a function of the learner's inputs."""

    level: Number
    tests: list[LagTest]
    missing: list[LagTest]
    text: str


class FeedbackResult(Content):
    """The local spectral radius along the free run."""

    largest: Number
    median: Number
    share_above_one: Number
    worst: RunPoint | None
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
    worst: RunPoint


class StabilityResult(Content):
    """Evidence on the free run."""

    absent = frozenset({"modes", "radius_beyond"})

    feedback: FeedbackResult | None
    contraction: ContractionResult | None
    diverges_at: Number
    searched: Number
    lipschitz: Lipschitz | None
    modes: Modes | None = None
    radius_beyond: Number = None
    warnings: list[Warning]
    text: str


class TrialResult(Content):
    """Free-run errors on validation data."""

    where: str
    physics_alone: Number = Field(validation_alias="alone")
    model: Number


class RatioResult(Content):
    """Error with the learner over that of physics alone, with its 95 % interval."""

    value: Number
    low: Number
    high: Number


class ExtrapolationResult(Content):
    """Distance of a part from the training data."""

    part: str
    regressor: str = Field(validation_alias="lag")
    training: Numbers
    found: Numbers = Field(validation_alias="reach")
    share: Number


class ValidationResult(Content):
    """Verdict on the learner: is it useful?"""

    verdict: str = Field(validation_alias="code")
    text: str
    ratio: RatioResult | None = None
    trials: list[TrialResult]
    extrapolation: list[ExtrapolationResult]


class AdviceResult(Content):
    """A change of the spec that lowered the free run's validation error in a trial.

    `change` has the new values by their keys, `before` and `after` the RMS errors in standard
    deviations of the training output; `before` is None where the model as it is diverges.
    Both are None of a change that comes first but cannot be tried.
    """

    change: dict[str, Any]
    text: str
    before: Number
    after: Number


class AdviceTrialsResult(Content):
    """Number of changes of the spec that were tried, and of those left out to save time."""

    text: str
    tried: Whole
    not_tried: Whole


class MotionCheckResult(Content):
    """Findings on a motion before training."""

    states: list[str]
    integrator: str
    fastest: Number
    substeps: Whole | None
    rows: Whole
    holds: list[HoldTrial]
    best_hold: str | None
    text: str


class MotionFitResult(Content):
    """Integration of a fitted motion, and the rows that a prediction starts from.

    `substep_bias`: the parameters less what a fit with twice the substeps would give.
    """

    states: list[str]
    integrator: str
    substeps: Whole
    hold: str
    window: Whole
    parts: list[EquationParts] = []
    substep_bias: ByName | None = None

    @property
    def discrete(self) -> bool:
        """True if the equations give the next state, and nothing was integrated."""
        return self.integrator == "discrete"
