"""The spec file: TOML in, checked declarations out.

The sections [learner], [structure], [structure.measure] and [training] have the keys that the
registered kinds declare. Every error is one line that names the file, the key, what was found and
what was expected.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    ModelWrapValidatorHandler,
    PrivateAttr,
    ValidationError,
    ValidationInfo,
    create_model,
    model_validator,
)

from orthaug._base.errors import InputError, KeyedError, SpecError
from orthaug._base.registry import resolve
from orthaug.commands.baseline_sections import (
    BaselineSection,
    LagsSection,
    Orders,
    PhysicsSection,
    with_lags_in_motion,
)
from orthaug.commands.controller_section import ControllerSection
from orthaug.commands.data_sections import (
    Data,
    EngineSection,
    MotionSection,
    Range,
    SourceSection,
    with_source_in_motion,
)
from orthaug.commands.sections import (
    Count,
    Finite,
    KindSection,
    Positive,
    Section,
    first_message,
    with_kinds,
)
from orthaug.data.channels import Channel
from orthaug.data.expressions import SAMPLING_TIME
from orthaug.data.regressors import Lags
from orthaug.data.tables import check_readable, is_table
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.kinds import CRITERIA, SOLVERS, STRUCTURES, Solver
from orthaug.fitting.noise import ARMA, Innovations, Noise, Order
from orthaug.fitting.rules import check_solver, check_starts, choose_regularizations
from orthaug.fitting.structures import Structure, with_measure
from orthaug.inference.kinds import MEASURES, MeasurePlace
from orthaug.inference.measures import Measure
from orthaug.models.kinds import LEARNERS
from orthaug.models.learners import Learner
from orthaug.physics.baseline import Baseline
from orthaug.physics.integrators import INTEGRATORS
from orthaug.physics.motion import Motion
from orthaug.physics.parameters import PhysicsMap
from orthaug.physics.source_kinds import SOURCES

Regularization = (
    Literal["none", "evidence", "ard"] | Annotated[float, Field(ge=0, allow_inf_nan=False)]
)

# A number as engineers write it: TOML wants a digit on both sides of its point
_BARE_POINT = re.compile(r"(?<=[=\[,\s])[+-]?(?:\.\d+|\d+\.(?!\d))(?=[\s,}\]eE]|$)")
_SECTIONS = {  # of keys that are not in [training]
    "learner": "learner",
    "states": "learner.states",
    "kind": "structure.kind",
}


class SuspectSection(Section):
    """A term that may be missing from the physics."""

    kind: str = "expression"
    on: str | None = None
    width: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    time_constant: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    output: str | None = None
    coefficient: Finite | None = None
    name: str | None = None
    equation: str | None = None
    factor: str | None = None
    unit: str = ""


class DesignSection(Section):
    """An input to design, within limits."""

    samples: Positive
    amplitude: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    minimum: Finite | None = None
    maximum: Finite | None = None
    input: str | None = None
    rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    noise: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    condition: Annotated[float, Field(gt=1, allow_inf_nan=False)] = 1e3
    seed: Count = 0

    @model_validator(mode="after")
    def _check_limits(self) -> DesignSection:
        from orthaug.analysis.design import input_limits  # most specs have no design

        input_limits(self.amplitude, self.minimum, self.maximum)
        return self


class LearnerSection(KindSection):
    """The learned correction."""

    registries = {"kind": LEARNERS}
    kind: str = "mlp"


class MeasureSection(KindSection):
    """The set of regressor points on which physics and learner are made orthogonal."""

    registries = {"kind": MEASURES}
    kind: str = "training"


class StructureSection(KindSection):
    """The structure: how physics and learner share the fitted function."""

    registries = {"kind": STRUCTURES}
    kind: str = "orthogonal"
    measure: MeasureSection = MeasureSection()


class TrainingSection(KindSection):
    """Solver, criterion and regularisation."""

    registries = {"solver": SOLVERS, "focus": CRITERIA}
    solver: str = "levenberg-marquardt"
    focus: str = "auto"
    restarts: Positive = 1
    ensemble: bool = False
    fallback: bool = True
    seed: Annotated[int, Field(ge=0, lt=2**63, strict=True)] = 0
    regularization: (
        Literal["auto"] | Regularization | Annotated[list[Regularization], Field(min_length=1)]
    ) = "auto"
    output_weights: str | list[float] = "auto"

    @model_validator(mode="after")
    def _check(self) -> TrainingSection:
        check_starts(self.restarts, self.seed, ensemble=self.ensemble)
        solver, criterion = (
            self.declared(SOLVERS, self.solver),
            self.declared_criterion(self.chosen_focus()),
        )
        given = self.regularization
        check_solver(solver, criterion, given if isinstance(given, list) else [given])
        return self

    def declared_criterion(self, focus: str, washout: int | None = None) -> Criterion:
        """Return the criterion of a focus, for physics whose free runs have this washout.

        Where the section gives none and segments are as short as the usual washout or shorter, it
        is a quarter of them.
        """
        segment: Any = getattr(self, "segment", "auto")
        short = isinstance(segment, int) and 0 < segment <= getattr(self, "washout", 0)
        own = segment // 4 if short and washout is None else washout
        given = own is None or "washout" in self.model_fields_set
        section = self if given else self.model_copy(update={"washout": own})
        return section.declared(CRITERIA, focus)

    def chosen_focus(self) -> str:
        """Return the focus of training.

        `prediction` where `horizon` asks for more than one step ahead and no focus is written.
        """
        ahead = "focus" not in self.model_fields_set and getattr(self, "horizon", 1) > 1
        return "prediction" if ahead else self.focus


class NoiseSection(Section):
    """The model of the errors' colour one step ahead: orders, or up to which they are chosen."""

    model: Literal["white", "arma", "innovations", "auto"] = "white"
    ar: Count | Literal["auto"] | None = None
    ma: Count | Literal["auto"] | None = None
    largest: Positive = 4

    @property
    def declared(self) -> Noise:
        """The declaration for `estimate`."""
        if self.model == "white":
            return "white"
        if self.model == "innovations":
            return Innovations()
        if self.model == "auto" and self.model_fields_set <= {"model"}:
            return "auto"  # among which noise models depends on the physics
        absent: Order = 1 if self.model == "arma" else "auto"
        ar: Any = absent if self.ar is None else self.ar
        ma: Any = absent if self.ma is None else self.ma
        return ARMA(ar, ma, self.largest)


class ChosenOnSection(Section):
    """The rows that `orthaug select` chose terms on, which it writes."""

    files: Annotated[list[str], Field(min_length=1)]
    rows: Range | Annotated[list[Range], Field(min_length=1)] | None = None


class SelectionSection(Section):
    """Limits of `orthaug select`: the largest orders, terms at most, widths, blocks held out."""

    na: Count | None = None
    nb: Orders | None = None
    nk: Orders | None = None
    terms: Count | None = None
    hidden: Annotated[list[Positive], Field(min_length=1)] | None = None
    blocks: Annotated[int, Field(ge=2, strict=True)] = 5
    halves: Literal["auto"] | bool = "auto"
    collinear: Annotated[float, Field(ge=0, lt=1)] = 0.05
    level: Annotated[float, Field(gt=0, le=1)] = 0.05
    chosen_on: ChosenOnSection | None = None


class ValidationSection(Section):
    """Blocked cross-validation; absent: 4 blocks, for a verdict only where no part is held out."""

    blocks: Annotated[int, Field(ge=0, strict=True)] | None = None


class Spec(Section):
    """A whole spec file; absent sections take their defaults."""

    data: Data
    lags: LagsSection | None = None
    baseline: BaselineSection | None = None
    physics: PhysicsSection | None = None
    motion: MotionSection | None = None
    controller: ControllerSection | None = None
    suspects: list[SuspectSection] = []
    design: DesignSection | None = None
    learner: LearnerSection = LearnerSection()
    structure: StructureSection = StructureSection()
    training: TrainingSection = TrainingSection()
    noise: NoiseSection = NoiseSection()
    validation: ValidationSection = ValidationSection()
    selection: SelectionSection = SelectionSection()
    engine: EngineSection = EngineSection()
    _folder: Path = PrivateAttr(default=Path())
    _moved_lags: bool = PrivateAttr(default=False)

    @model_validator(mode="wrap")
    @classmethod
    def _move_physics(cls, content: Any, handler: ModelWrapValidatorHandler[Spec]) -> Spec:
        given = with_source_in_motion(content)
        moved = with_lags_in_motion(given)
        spec = handler(moved)
        spec._moved_lags = moved is not given
        return spec

    @model_validator(mode="after")
    def _place(self, info: ValidationInfo) -> Spec:
        self._folder = (info.context or {}).get("folder", Path())
        return self

    @property
    def moved_lags(self) -> bool:
        """True if the motion takes the place of lagged physics in the file."""
        return self._moved_lags

    @property
    def folder(self) -> Path:
        """The folder from which the spec names files."""
        return self._folder

    @model_validator(mode="after")
    def _one_physics(self) -> Spec:
        if self.motion is None and self.baseline is None:
            raise ValueError(
                "the key 'baseline' is missing; expected [[baseline.terms]], or a [motion] instead"
            )
        physics = self.declared_physics
        physics.check_beside(self)
        for i, section in enumerate(self.suspects):
            for key in sorted(section.model_fields_set & physics.foreign_keys.keys()):
                raise ValueError(f"`suspects[{i}].{key}`: found {physics.foreign_keys[key]}")
        return self

    @model_validator(mode="after")
    def _blocks_are_several(self) -> Spec:
        if self.validation.blocks == 1:
            raise ValueError(
                "`validation.blocks`: found 1; expected 2 or more, or 0 for no cross-validation"
            )
        return self

    @model_validator(mode="after")
    def _choices_need_validation(self) -> Spec:
        several = isinstance(self.training.regularization, list)
        if several and self.data.validation is None and self.validation.blocks == 0:
            raise ValueError(
                "`training.regularization` is a list; expected [data.validation] or "
                "`validation.blocks` to choose by"
            )
        return self

    @model_validator(mode="after")
    def _noise_fits(self) -> Spec:
        if self.noise.model != "white":
            self.declared_physics.check_noise(self, f"`noise.model`: found {self.noise.model}")
        return self

    @property
    def declared_physics(self) -> BaselineSection | MotionSection:
        """The section that declares the physics: there is one of the two."""
        section = self.motion or self.baseline
        assert section is not None
        return section

    def channels(self, names: list[str]) -> tuple[Channel, ...]:
        """Return the named channels with unit, column, scale and offset."""
        given = self.data.channels
        return tuple(
            Channel(name, **(given[name].model_dump() if name in given else {})) for name in names
        )

    def lag_orders(self) -> Lags | None:
        """Return the learner's orders; None for the raw lags that the baseline uses."""
        return None if self.lags is None else self.lags.declared

    def declared_baseline(self) -> Baseline:
        """Return the baseline as declared."""
        assert self.baseline is not None, "a motion has no baseline"
        return self.baseline.declared

    def declared_motion(self) -> Motion:
        """Return the motion, in the loop of its controller where there is one.

        Raises:
            InputError: what cannot be declared.
        """
        assert self.motion is not None, "lagged physics have no motion"
        inputs, outputs = self.data.inputs, self.data.outputs
        if self.controller is None:
            return self.motion.motion_of(inputs, outputs, self.folder)
        return self.controller.around(self.motion, inputs, outputs, self.folder)

    def physics_map(self, sampling_time: float) -> PhysicsMap | None:
        """Return the physical parameters and their map to θ, if the spec has one.

        `Ts` in it is the sampling time [s].
        """
        if self.physics is None or self.baseline is None:
            return None
        return self.physics.declared({SAMPLING_TIME: sampling_time} | self.baseline.constants)

    def declared_learner(self) -> Learner | None:
        """Return the learner; None for physics alone, as of a motion with no learned part."""
        section = self.declared_physics
        if not section.learns and "learner" not in self.model_fields_set:
            return None
        learner = resolve(self.learner.declared(LEARNERS, self.learner.kind))
        return section.over(learner, self) if hasattr(learner, "over") else learner

    def learner_inputs(self) -> tuple[str, ...] | None:
        """Return the learner's inputs; None for all lags."""
        return getattr(self.declared_learner(), "inputs", None)

    def declared_structure(
        self, kind: str | None = None, measure: Measure | None = None
    ) -> Structure:
        """Return the declared structure, or another kind with the same keys.

        It has a measure where it splits θ.
        """
        structure = resolve(self.structure.declared(STRUCTURES, kind or self.structure.kind))
        return structure if measure is None else with_measure(structure, measure)

    def declared_measure(self, place: MeasurePlace) -> Measure:
        """Return the measure, with its data read from files."""
        section = self.structure.measure
        return resolve(section.declared(MEASURES, section.kind), place)

    def declared_criterion(self) -> Criterion:
        """Return the criterion."""
        return self.declared_physics.criterion(self.training)

    def declared_solver(self) -> Solver:
        """Return the solver."""
        return resolve(self.training.declared(SOLVERS, self.training.solver))

    def engine_kind(self, files: Sequence[Path]) -> str:
        """Return the kind of engine that sums over the rows of these files.

        Raises:
            InputError: rows that are not in memory, for training by free runs over them.
        """
        if not self.brought:
            return self.engine.chosen(files)
        if self.engine.kind == "stream":
            what = (
                self.declared_physics.reads_all_rows or "`training.segment` = 0, whole experiments,"
            )
            raise InputError(
                f"`engine.kind`: found stream; expected memory, devices or dask: {what} reads "
                "its rows into memory, which dask then shares among its workers."
            )
        return "memory" if self.engine.kind == "auto" else self.engine.kind

    @property
    def brought(self) -> bool:
        """True if training reads all rows into memory."""
        free_run = self.declared_criterion().free_run
        whole = free_run is not None and not free_run.steps
        coloured = self.noise.model != "white"
        return bool(self.declared_physics.reads_all_rows) or whole or coloured

    def regularizations(
        self, *, linear: bool, validated: bool, kind: str | None = None
    ) -> tuple[str | float, ...]:
        """Return the regularizations that every start is run with, in a structure."""
        return choose_regularizations(
            self.training.regularization,
            self.declared_solver(),
            self.declared_criterion(),
            self.declared_structure(kind),
            linear=linear,
            validated=validated,
            by_evidence=self.declared_physics.by_evidence,
            learner=self.declared_learner(),
        )

    def runs(self, *, linear: bool) -> int:
        """Return the number of runs in a fit: restarts times regularizations."""
        validated = self.data.validation is not None
        return self.training.restarts * len(
            self.regularizations(linear=linear, validated=validated)
        )


def spec_error(error: KeyedError) -> InputError:
    """Return an error in one key of a declaration in the words of a spec."""
    return SpecError(f"'{_SECTIONS.get(error.key, f'training.{error.key}')}'{error.words}.")


def spec_model() -> type[Spec]:
    """`Spec` with the keys of every kind that is registered now, or installed.

    Raises:
        InputError: a package with a kind that cannot be loaded.
    """
    return _spec_model(
        tuple(
            tuple(registry.discover().items())
            for registry in (
                LEARNERS,
                MEASURES,
                STRUCTURES,
                SOLVERS,
                CRITERIA,
                INTEGRATORS,
                SOURCES,
            )
        )
    )


@lru_cache(maxsize=8)
def _spec_model(registered: object) -> type[Spec]:
    measure = with_kinds(MeasureSection)
    structure = with_kinds(StructureSection, measure=(measure, measure()))
    sections = {
        "learner": with_kinds(LearnerSection),
        "structure": structure,
        "training": with_kinds(TrainingSection),
    }
    fields: dict[str, Any] = {name: (section, section()) for name, section in sections.items()}
    source = (with_kinds(SourceSection) | None, None)
    fields["motion"] = (with_kinds(MotionSection, source=source) | None, None)
    return create_model("Spec", __base__=Spec, **fields)


def _refuse_data(path: Path) -> None:
    """Raise SpecError for a data file in the place of a spec."""
    if is_table(path):
        raise SpecError(
            f"{path}: found a data file; expected a spec (TOML). `orthaug init {path}` writes a "
            "first one for these data."
        )


def _bare_point(text: str) -> str:
    """Return a sentence on the first number that begins or ends with its point; empty for none."""
    for line in text.splitlines():
        found = _BARE_POINT.search(re.sub(r"\"[^\"]*\"|'[^']*'|#.*", "", line))
        if found is not None:
            whole = re.sub(r"^([+-]?)\.", r"\g<1>0.", found[0])
            whole += "0" * whole.endswith(".")
            return (
                f" TOML numbers have a digit on both sides of the point: {whole}, not {found[0]}."
            )
    return ""


def load_spec(path: Path) -> Spec:
    """Read and check a spec file.

    Raises:
        InputError: no such file, broken TOML, unknown or missing keys, or values of the wrong kind.
    """
    check_readable(path)
    text = ""
    try:
        text = path.read_text(encoding="utf-8-sig")
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        _refuse_data(path)
        raise SpecError(
            f"{path}: broken TOML: {' '.join(str(error).split())}.{_bare_point(text)}"
        ) from None
    except UnicodeDecodeError:
        _refuse_data(path)
        raise SpecError(f"{path}: not a text file; expected TOML in UTF-8.") from None
    except RecursionError:
        raise SpecError(f"{path}: broken TOML: tables or lists are nested too deeply.") from None
    except OSError as error:
        raise SpecError(f"{path}: cannot be read ({error.strerror}).") from None
    except ValueError as error:  # a whole number of thousands of digits
        raise SpecError(f"{path}: broken TOML: {str(error).split(';')[0]}.") from None
    model = spec_model()
    try:
        return model.model_validate(content, context={"folder": path.parent})
    except ValidationError as error:
        with suppress(ValueError):
            content = with_source_in_motion(content)
        message = first_message(error, content, model)
        message = message.replace("motion.source", "physics.source")
        raise SpecError(f"{path}: {message}{'' if message.endswith('?') else '.'}") from None
    except RecursionError:
        raise SpecError(f"{path}: tables or lists are nested too deeply.") from None
