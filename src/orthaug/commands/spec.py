"""The spec file: TOML in, checked declarations out (the contract's section "Spec file").

Every error is one line that names the file, the key, what was found and what was expected.
"""

from __future__ import annotations

import json
import math
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from orthaug._base.checks import nearest
from orthaug._base.errors import InputError
from orthaug.data.record import Channel
from orthaug.data.regressors import Lags
from orthaug.data.tables import check_readable
from orthaug.physics.baseline import Baseline, Term
from orthaug.physics.parameters import PhysicalParameter, PhysicsMap

Count = Annotated[int, Field(ge=0, strict=True)]
Positive = Annotated[int, Field(ge=1, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Orders = Count | list[Count]
Regularization = Literal["none", "evidence"] | Annotated[float, Field(ge=0, allow_inf_nan=False)]
Range = Annotated[list[Count], Field(min_length=2, max_length=2)]


class Section(BaseModel):
    """A table of the spec; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Part(Section):
    """Files of training or test data; each file, and each row range, is an experiment."""

    files: Annotated[list[str], Field(min_length=1)]
    rows: Range | Annotated[list[Range], Field(min_length=1)] | None = None
    every: Positive = 1
    skip: Count = 0
    columns: dict[str, str] = {}


class ChannelSection(Section):
    """How files hold a channel: value = scale * cell + offset of column."""

    column: str = ""
    unit: str = ""
    scale: Finite = 1.0
    offset: Finite = 0.0


class Data(Section):
    """Channels, sampling time and parts."""

    sampling_time: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    time: Annotated[str, Field(min_length=1)] | None = None
    inputs: list[str] = []
    outputs: Annotated[list[str], Field(min_length=1)]
    missing: Literal["error", "skip"] = "error"
    train: Part
    validation: Part | None = None
    tests: dict[str, Part] = {}
    channels: dict[str, ChannelSection] = {}

    @model_validator(mode="after")
    def _one_time(self) -> Data:
        if self.sampling_time is not None and self.time is not None:
            raise ValueError("`sampling_time` and `time` are both given; expected one of them")
        for name in self.channels:
            if name not in (*self.inputs, *self.outputs):
                known = ", ".join((*self.inputs, *self.outputs))
                raise ValueError(f"`channels.{name}` is neither an input nor an output; expected one of {known}")
        return self


class LagsSection(Section):
    """The learner's regressor, as MATLAB means the orders."""

    na: Orders = 0
    nb: Orders = 0
    nk: Orders = 1


class TermSection(Section):
    """One column of φ."""

    parameter: Annotated[str, Field(min_length=1)]
    regressor: str | float
    initial: Finite | None = None
    unit: str | None = None
    output: str | None = None
    fixed: bool = False
    min: Finite | None = None
    max: Finite | None = None


class BaselineSection(Section):
    """The physics."""

    terms: Annotated[list[TermSection], Field(min_length=1)]
    constants: dict[str, Finite] = {}


class PhysicalSection(Section):
    """One physical parameter."""

    initial: Finite
    unit: str = ""
    min: Finite | None = None
    max: Finite | None = None


class PhysicsSection(Section):
    """What θ is made of."""

    parameters: Annotated[dict[str, PhysicalSection], Field(min_length=1)]
    theta: Annotated[dict[str, str], Field(min_length=1)]
    profile: bool = False


class SuspectSection(Section):
    """A term that may be missing from the physics."""

    kind: str = "expression"
    on: str | None = None
    width: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    output: str | None = None
    coefficient: Finite | None = None
    name: str | None = None


class DesignSection(Section):
    """An input to design, within limits."""

    samples: Positive
    amplitude: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    input: str | None = None
    rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    noise: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    condition: Annotated[float, Field(gt=1, allow_inf_nan=False)] = 1e3
    seed: Count = 0


class LearnerSection(Section):
    """The learned correction."""

    kind: Literal["mlp", "none"] = "mlp"
    hidden: list[Positive] = [16]
    activation: Literal["tanh", "relu", "gelu", "sigmoid", "silu", "elu", "softplus", "identity"] = "tanh"
    inputs: list[str] | None = None


class MeasureSection(Section):
    """The set of regressor points on which physics and learner are made orthogonal."""

    kind: Literal["training", "symmetrized", "uniform", "samples"] = "training"
    box: dict[str, Annotated[list[Finite], Field(min_length=2, max_length=2)]] = {}
    files: list[str] = []
    rows: Range | list[Range] | None = None
    every: Positive = 1


class StructureSection(Section):
    """How physics and learner share the fitted function."""

    kind: Literal["additive", "orthogonal", "orthogonal-penalty", "baseline-penalty"] = "orthogonal"
    weight: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1.0
    measure: MeasureSection = MeasureSection()


class TrainingSection(Section):
    """Solver, criterion and regularisation."""

    solver: Literal["levenberg-marquardt", "adam-lbfgs"] = "levenberg-marquardt"
    iterations: Positive = 300
    adam_iterations: Count = 500
    lbfgs_iterations: Count = 1000
    learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1e-3
    focus: Literal["prediction", "simulation"] = "prediction"
    horizon: Positive = 1
    segment: Count = 512
    washout: Count = 40
    start_iterations: Count = 20
    restarts: Positive = 1
    ensemble: bool = False
    seed: Annotated[int, Field(ge=0, lt=2**63, strict=True)] = 0
    regularization: Regularization | Annotated[list[Regularization], Field(min_length=1)] | None = None

    def regularizations(self, validated: bool) -> str | float | tuple[str | float, ...]:
        """What to try: by default none, or with a validation part to choose by, none and evidence."""
        if self.regularization is None:
            return ("none", "evidence") if validated and self.solver == "levenberg-marquardt" else "none"
        return tuple(self.regularization) if isinstance(self.regularization, list) else self.regularization


class ValidationSection(Section):
    """Blocked cross-validation; absent: 4 blocks in `compare`, and in `fit` where no part is held out."""

    blocks: Annotated[int, Field(ge=0, strict=True)] | None = None


class Spec(Section):
    """A whole spec file; absent sections take their defaults."""

    data: Data
    lags: LagsSection | None = None
    baseline: BaselineSection
    physics: PhysicsSection | None = None
    suspects: list[SuspectSection] = []
    design: DesignSection | None = None
    learner: LearnerSection = LearnerSection()
    structure: StructureSection = StructureSection()
    training: TrainingSection = TrainingSection()
    validation: ValidationSection = ValidationSection()

    @model_validator(mode="after")
    def _seeds_fit(self) -> Spec:
        if self.training.seed + self.training.restarts >= 2**63:
            raise ValueError(
                f"`training.seed`: found {self.training.seed}; expected seeds below 2**63 for all restarts"
            )
        return self

    @model_validator(mode="after")
    def _free_run_scores_something(self) -> Spec:
        training = self.training
        if training.focus == "simulation" and 0 < training.segment <= training.washout:
            raise ValueError(
                f"`training.washout`: found {training.washout}; expected less than the segment, {training.segment}"
            )
        if (training.focus == "simulation" or training.horizon > 1) and training.solver == "adam-lbfgs":
            raise ValueError("`training.solver` = adam-lbfgs trains one step ahead; expected levenberg-marquardt here")
        return self

    @model_validator(mode="after")
    def _ensembles_have_members(self) -> Spec:
        if self.training.ensemble and self.training.restarts < 2:
            raise ValueError(f"`training.restarts`: found {self.training.restarts}; expected 2 or more for an ensemble")
        return self

    @model_validator(mode="after")
    def _samples_have_files(self) -> Spec:
        measure = self.structure.measure
        if measure.kind == "samples" and not measure.files:
            raise ValueError("`structure.measure.files` is missing; expected the files that hold the samples")
        return self

    @model_validator(mode="after")
    def _blocks_are_several(self) -> Spec:
        if self.validation.blocks == 1:
            raise ValueError("`validation.blocks`: found 1; expected 2 or more, or 0 for no cross-validation")
        return self

    @model_validator(mode="after")
    def _choices_need_validation(self) -> Spec:
        if isinstance(self.training.regularization, list) and self.data.validation is None:
            raise ValueError("`training.regularization` is a list; expected [data.validation] to choose by")
        if self.training.solver == "adam-lbfgs" and "evidence" in _as_list(self.training.regularization):
            raise ValueError("`training.regularization` = evidence; expected solver levenberg-marquardt with it")
        return self

    def channels(self, names: list[str]) -> tuple[Channel, ...]:
        """The named channels with unit, column, scale and offset."""
        given = self.data.channels
        return tuple(Channel(name, **(given[name].model_dump() if name in given else {})) for name in names)

    def lag_orders(self) -> Lags | None:
        """The learner's orders; None for the raw lags that the baseline uses."""
        if self.lags is None:
            return None
        return Lags(*(tuple(v) if isinstance(v, list) else v for v in (self.lags.na, self.lags.nb, self.lags.nk)))

    def declared_baseline(self) -> Baseline:
        """The baseline as declared."""
        terms = [
            Term(t.parameter, str(t.regressor), t.initial, t.unit, t.output, t.fixed, t.min, t.max)
            for t in self.baseline.terms
        ]
        return Baseline.from_terms(terms, self.baseline.constants)

    def physics_map(self) -> PhysicsMap | None:
        """The physical parameters and their map to θ, if the spec has one."""
        if self.physics is None:
            return None
        limits = {"min": -math.inf, "max": math.inf}
        parameters = [
            PhysicalParameter(
                name, p.initial, p.unit, *(limits[k] if v is None else v for k, v in (("min", p.min), ("max", p.max)))
            )
            for name, p in self.physics.parameters.items()
        ]
        return PhysicsMap.of(parameters, self.physics.theta, self.baseline.constants)

    def learner_inputs(self) -> tuple[str, ...] | None:
        """What the learner sees; None for all lags."""
        return tuple(self.learner.inputs) if self.learner.inputs is not None and self.learner.kind != "none" else None


def _as_list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def load_spec(path: Path) -> Spec:
    """Read and check a spec file.

    Raises:
        InputError: no such file, broken TOML, unknown or missing keys, or values of the wrong kind.
    """
    check_readable(path)
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: broken TOML: {' '.join(str(error).split())}.") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; expected TOML in UTF-8.") from None
    try:
        return Spec.model_validate(content)
    except ValidationError as error:
        message = _first_message(error, content)
        raise InputError(f"{path}: {message}{'' if message.endswith('?') else '.'}") from None


def _first_message(error: ValidationError, content: dict[str, Any]) -> str:
    """The first error as `key: found …; expected …`."""
    errors = error.errors()
    # of a union every branch complains: what was meant is the branch whose type fits, there the deepest complaint
    fitting = [e for e in errors if not e["type"].endswith("_type")]
    first = max(fitting or errors[:1], key=lambda e: len(e["loc"]))
    key = _key(first["loc"], content)
    kind, found = first["type"], first["input"]
    if kind == "extra_forbidden":
        *parents, name = [part for part in first["loc"] if isinstance(part, str | int)]
        known = _known_keys(parents)
        return f"unknown key '{key}'{nearest(str(name), known) or ', known are ' + ', '.join(known)}"
    if kind == "missing":
        return f"the key '{key}' is missing"
    if kind == "value_error":
        return (
            f"'{key}': {first['msg'].removeprefix('Value error, ')}"
            if key
            else first["msg"].removeprefix("Value error, ")
        )
    same_key = [e["msg"] for e in errors if _key(e["loc"], content) == key]
    expected = " or ".join(dict.fromkeys(_plain(m) for m in same_key))
    return f"'{key}': found {_shown(found)}; expected {expected}"


def _shown(value: Any) -> str:
    """A value as the file writes it, cut where it is long."""
    text = json.dumps(value, default=str, ensure_ascii=False).replace("Infinity", "inf").replace("NaN", "nan")
    return text if len(text) <= 80 else text[:77] + "…"


def _plain(message: str) -> str:
    """Pydantic's words in those of TOML."""
    if "at least 1 item" in message or "at least 1 character" in message:
        return "at least one entry" if "item" in message else "some text"
    if "after validation" in message:
        return "two numbers, [start, stop]"
    message = message.removeprefix("Input should be ").replace("a valid ", "a ").replace("a integer", "an integer")
    return "a table" if "dictionary" in message else message


def _key(location: tuple[Any, ...], content: Any) -> str:
    """The key's path in the file; pydantic's names of union branches are not part of it."""
    text = ""
    for i, part in enumerate(location):
        if isinstance(part, int):
            text += f"[{part}]"
            content = content[part] if isinstance(content, list) and part < len(content) else None
        elif isinstance(content, dict) and (part in content or i == len(location) - 1):
            text += f".{part}" if text else part
            content = content.get(part)
    return text


def _known_keys(parents: list[Any]) -> list[str]:
    """The keys of the section at a path such as ["data", "tests", "steps"]."""
    model: Any = Spec
    for part in parents:
        if isinstance(part, int) or not isinstance(model, type):
            continue
        field = model.model_fields.get(part)
        model = _section_of(field.annotation) if field else model
    return list(model.model_fields) if isinstance(model, type) else []


def _section_of(annotation: Any) -> Any:
    """The Section class inside an annotation such as `dict[str, Part] | None`."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return annotation
    for inner in getattr(annotation, "__args__", ()):
        found = _section_of(inner)
        if found is not None:
            return found
    return None
