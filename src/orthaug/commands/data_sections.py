"""The sections [data], [engine] and [motion] of a spec."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from orthaug._base.checks import check_label
from orthaug._base.errors import InputError
from orthaug._base.memory import available
from orthaug._base.registry import resolve
from orthaug.commands.sections import (
    Count,
    Finite,
    KindSection,
    PhysicalSection,
    Positive,
    Section,
    with_kinds,
)
from orthaug.data.preparation import STEPS
from orthaug.data.record import LONGEST_STEP
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.noise import OF_LAGGED
from orthaug.models.learners import Learner
from orthaug.models.terms import over_states
from orthaug.physics.integrators import INTEGRATORS
from orthaug.physics.motion import HOLDS, MOST_SUBSTEPS, Motion
from orthaug.physics.source_kinds import SOURCES
from orthaug.physics.sources import PhysicsSource
from orthaug.physics.states import Output, State, check_given

if TYPE_CHECKING:
    from orthaug.models.rows import Engine

_PARQUET = ".parquet"
_SHARE = 0.25  # of the memory that is free: what the files may take before they are streamed
_COPIES = 4  # of a file's bytes, in a fit in memory at least
_BESIDE_MOTION = {
    "baseline": "expected one of them, because both are the physics",
    "lags": "expected none, because a motion has states instead; `learner.inputs` declares the "
    "inputs of its learner",
    "physics": "expected none, because the parameters of a motion are physical: "
    "[motion.parameters]",
}
Range = Annotated[list[Count], Field(min_length=2, max_length=2)]
Text = Annotated[str, Field(min_length=1)]


def column_sets(columns: Mapping[str, str | list[str]]) -> list[dict[str, str]]:
    """Return the columns of each experiment that a file has beside each other, by channel.

    A channel with one column has it in all of them.

    Raises:
        ValueError: lists of different lengths, or empty ones.

    Examples:
        >>> column_sets({"u": "force", "y": ["first", "second"]})
        [{'u': 'force', 'y': 'first'}, {'u': 'force', 'y': 'second'}]
    """
    lengths = {name: len(given) for name, given in columns.items() if not isinstance(given, str)}
    if len(set(lengths.values())) > 1:
        named = ", ".join(f"{name} has {count}" for name, count in lengths.items())
        raise ValueError(
            f"`columns` lists different numbers of experiments: {named}. Give each list as many "
            "columns, or one column for all"
        )
    if 0 in lengths.values():
        raise ValueError("a list of `columns` is empty")
    return [
        {name: given if isinstance(given, str) else given[i] for name, given in columns.items()}
        for i in range(next(iter(lengths.values()), 1))
    ]


class PartSection(Section):
    """Files of training or test data.

    Each file is an experiment, and each range of rows, and each set of columns beside each other.
    """

    files: Annotated[list[str], Field(min_length=1)]
    rows: Range | Annotated[list[Range], Field(min_length=1)] | None = None
    every: Positive = 1
    skip: Count = 0
    columns: dict[str, str | list[str]] = {}

    @property
    def column_sets(self) -> list[dict[str, str]]:
        """The columns of each experiment that a file has beside each other, by channel."""
        return column_sets(self.columns)

    @model_validator(mode="after")
    def _sets_of_one_length(self) -> PartSection:
        column_sets(self.columns)
        return self

    @model_validator(mode="before")
    @classmethod
    def _files_alone(cls, given: object) -> Any:
        """Read a file's name, or a list of names, as the table that has nothing else."""
        if isinstance(given, str | list):
            given = {"files": given}
        if isinstance(given, dict) and isinstance(given.get("files"), str):
            given = given | {"files": [given["files"]]}
        return given


class ChannelSection(Section):
    """A channel in files: value = scale * cell + offset of column."""

    column: str = ""
    unit: str = ""
    scale: Finite = 1.0
    offset: Finite = 0.0


class PrepareSection(KindSection):
    """A step of preparation that every part of the data goes through."""

    registries = {"step": STEPS}
    step: str


class Data(Section):
    """Channels, sampling time and parts."""

    sampling_time: Annotated[float, Field(gt=0, le=LONGEST_STEP, allow_inf_nan=False)] | None = None
    time: Annotated[str, Field(min_length=1)] | None = None
    experiment: Annotated[str, Field(min_length=1)] | None = None
    inputs: list[str] = []
    outputs: Annotated[list[str], Field(min_length=1)]
    missing: Literal["error", "skip", "keep"] = "error"
    train: PartSection
    validation: PartSection | None = None
    tests: dict[str, PartSection] = {}
    channels: dict[str, ChannelSection] = {}
    prepare: list[with_kinds(PrepareSection)] = []  # type: ignore[valid-type]

    @property
    def steps(self) -> tuple[Any, ...]:
        """The steps of preparation, as declared."""
        return tuple(section.declared(STEPS, section.step) for section in self.prepare)

    @property
    def step(self) -> float | None:
        """Seconds between the rows kept for training; None where the data determine it."""
        if self.time or any(section.step in ("decimate", "resample") for section in self.prepare):
            return None
        return (self.sampling_time or 1.0) * self.train.every

    @model_validator(mode="after")
    def _one_time(self) -> Data:
        if self.sampling_time is not None and self.time is not None:
            raise ValueError("`sampling_time` and `time` are both given; expected one of them")
        for name in self.channels:
            if name not in (*self.inputs, *self.outputs):
                raise ValueError(self._no_channel(name))
        for name in self.tests:
            check_label(name, "the name of a test")
            if name in ("train", "validation"):
                raise ValueError(
                    f"`tests.{name}` has the name of another part of the data; expected "
                    "another name"
                )
        return self

    def _no_channel(self, name: str) -> str:
        """Return a message on a section of `channels` that names no channel."""
        known = (*self.inputs, *self.outputs)
        open_names = [other for other in known if other not in self.channels]
        close = difflib.get_close_matches(name, open_names, n=1)
        if not close:
            return (
                f"`channels.{name}` is neither an input nor an output; expected one of "
                f"{', '.join(known)}"
            )
        kind = "inputs" if close[0] in self.inputs else "outputs"
        return (
            f"`channels.{name}` is neither an input nor an output, and `{kind}` has "
            f"'{close[0]}', which `channels` does not have; expected the same name in both, so "
            "one of them is misspelt"
        )


class EngineSection(Section):
    """The engine that sums over the rows."""

    kind: Literal["auto", "memory", "stream", "devices", "dask"] = "auto"
    scheduler: str | None = None
    workers: Positive | None = None
    devices: Positive | None = None
    partition_rows: Positive = 1_000_000
    checkpoint: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 10.0

    def chosen(self, files: Sequence[Path]) -> str:
        """Return the kind of engine; "auto" streams Parquet files that are too large for memory."""
        if self.kind != "auto":
            return self.kind
        parquet = all(file.suffix.lower() == _PARQUET for file in files)
        try:
            size = sum(file.stat().st_size for file in files)
        except OSError:  # reading them will report it
            return "memory"
        return "stream" if parquet and _COPIES * size > _SHARE * available() else "memory"


def engine_of(section: EngineSection, kind: str) -> Engine:
    """Return the engine of a kind.

    Raises:
        InputError: one that is not installed, or cannot be reached.
    """
    if kind == "dask":
        from orthaug.models.cluster import Dask, connect

        return Dask(connect(section.scheduler, section.workers))
    if kind == "devices":
        from orthaug.models import hosts
        from orthaug.models.devices import Devices

        hosts.join()
        if hosts.several() and section.devices is not None:
            raise InputError(
                f"`engine.devices`: found {section.devices}; over several hosts all devices "
                "are used."
            )
        return Devices(section.devices)
    from orthaug.models.rows import InMemory
    from orthaug.models.streaming import Stream

    return Stream() if kind == "stream" else InMemory()


class StateSection(Section):
    """A state: its equation, where it starts, whether a learner is added to the equation."""

    derivative: Text | Finite | None = None
    next: Text | Finite | None = None
    start: Finite | Text | None = None
    learned: bool = False
    unit: str = ""


class OutputSection(Section):
    """An output as an expression of the states, and whether a learner is added to it."""

    expression: Text
    learned: bool = False


class SourceSection(KindSection):
    """Physics from a file or a package: `[physics.source]`."""

    registries = {"kind": SOURCES}
    kind: str

    def declared_source(self) -> PhysicsSource:
        """Return the source as declared."""
        return self.declared(SOURCES, self.kind)


class MotionSection(KindSection):
    """Equations of motion: states, outputs, parameters, and how they are integrated."""

    registries = {"integrator": INTEGRATORS}
    reads_all_rows: ClassVar[str] = "a motion"
    by_evidence: ClassVar[bool] = True
    takes_uneven_rows: ClassVar[bool] = True
    foreign_keys: ClassVar[Mapping[str, str]] = {"output": "beside [motion]; expected `equation`"}
    integrator: str = "auto"
    substeps: Literal["auto"] | Annotated[int, Field(ge=1, le=MOST_SUBSTEPS, strict=True)] = "auto"
    hold: Literal[HOLDS] = "zero-order"  # type: ignore[valid-type]
    states: Annotated[dict[str, StateSection], Field(min_length=1)] = {}
    outputs: Annotated[dict[str, Text | OutputSection], Field(min_length=1)] = {}
    parameters: Annotated[dict[str, PhysicalSection], Field(min_length=1)] = {}
    define: dict[str, Text] = {}
    constants: dict[str, Finite] = {}
    source: SourceSection | None = None

    @model_validator(mode="after")
    def _check_equations(self) -> MotionSection:
        """Check that each state has the equation that its integrator reads."""
        for name in ("states", "outputs", "parameters", "define", "constants"):
            if self.source is not None and name in self.model_fields_set:
                raise ValueError(
                    f"`{name}`: found beside [physics.source]; expected none, because the source "
                    "has its own"
                )
        discrete = self.discrete
        own, other = ("next", "derivative") if discrete else ("derivative", "next")
        kind = "a discrete motion" if discrete else f'`integrator = "{self.integrator}"`'
        for name, state in self.states.items():
            if getattr(state, other) is not None:
                raise ValueError(f"`states.{name}` has the key `{other}`; {kind} reads `{own}`")
            if getattr(state, own) is None:
                raise ValueError(f"`states.{name}` has no `{own}`; expected its equation")
        return self

    @property
    def discrete(self) -> bool:
        """True if the equations give the next state."""
        return bool(INTEGRATORS[self.integrator].discrete)

    @property
    def learns(self) -> bool:
        """True if a learner is added to any equation or output."""
        if self.source is not None:
            return self.source.declared_source().learns
        outputs = (
            output.learned for output in self.outputs.values() if not isinstance(output, str)
        )
        return any(state.learned for state in self.states.values()) or any(outputs)

    def over(self, learner: Any, spec: Any) -> Learner:
        """Return a learner of terms over the states and inputs of a spec."""
        return over_states(learner, spec.declared_motion())

    def criterion(self, training: Any) -> Criterion:
        """Return the criterion of a spec.

        A motion is trained on its free run, from starts that are estimated: without a washout.
        """
        focus = "simulation" if training.focus == "auto" else training.focus
        return resolve(training.declared_criterion(focus, washout=0))

    def check_beside(self, spec: Any) -> None:
        """Raise ValueError for what a spec cannot have beside these physics."""
        for name in ("states", "outputs", "parameters"):
            if self.source is None and name not in self.model_fields_set:
                raise ValueError(f"the key 'motion.{name}' is missing")
        for name, expected in _BESIDE_MOTION.items():
            if name in spec.model_fields_set:
                raise ValueError(f"`{name}`: found beside [motion]; {expected}")
        if spec.data.missing == "keep":
            self._check_missing(spec)
        if spec.training.ensemble:
            raise ValueError(
                "`training.ensemble`: a motion, or a learner with `states`, has none, because "
                "medians of runs follow no equations"
            )

    def _check_missing(self, spec: Any) -> None:
        """Raise ValueError for what reads the outputs of every row."""
        if spec.noise.model != "white":
            raise ValueError(
                '`data.missing`: found "keep"; a predictor of `noise.model` needs every row: '
                '"white"'
            )
        if spec.engine.kind not in ("auto", "memory"):
            raise ValueError(
                '`data.missing`: found "keep"; rows must be in memory for it: `engine.kind` = '
                '"memory"'
            )

    def check_noise(self, spec: Any, found: str) -> None:
        """Raise ValueError for a noise model that a spec cannot have, which was `found`."""
        if spec.noise.model == "arma" or spec.noise.model_fields_set - {"model"}:
            what = "" if spec.noise.model == "arma" else "; `ar`, `ma` and `largest` are of `arma`"
            beside = f"{found} beside [motion] or `learner.states`{what}"
            raise ValueError(f"{beside}: `noise.model` = arma {OF_LAGGED}")
        if spec.controller is not None:
            raise ValueError(
                f"{found} beside [controller]; expected white, or no controller: the predictor "
                "follows the measured outputs, so give the plant's own input"
            )
        if spec.engine.kind not in ("auto", "memory"):
            raise ValueError(
                f"{found} beside `engine.kind` = {spec.engine.kind}; expected memory, where a "
                "predictor follows the outputs"
            )

    def motion_of(self, inputs: Sequence[str], outputs: Sequence[str], folder: Path) -> Motion:
        """Return the motion, with its channels in the order of the data.

        Args:
            inputs, outputs: names of the channels.
            folder: of the spec, from which it names the file of a source.

        Raises:
            InputError: names and expressions that cannot be, and what else `Motion.from_equations`
                refuses.
        """
        substeps = None if self.substeps == "auto" else self.substeps
        if self.source is not None:
            source = replace(
                self.source.declared_source().in_folder(folder),
                integrator=self.integrator,
                substeps=substeps,
                hold=self.hold,
            )
            return source.build(inputs, outputs)
        given = {
            name: OutputSection(expression=o) if isinstance(o, str) else o
            for name, o in self.outputs.items()
        }
        check_given(given, outputs)  # before states, which start from outputs
        states = []
        for name, state in self.states.items():
            equation = state.next if self.discrete else state.derivative
            states.append(State(name, str(equation), state.start, state.learned, state.unit))
        return Motion.from_equations(
            states=states,
            outputs=[
                Output(name, given[name].expression, given[name].learned)
                for name in outputs
                if name in given
            ],
            parameters=[section.declared(name) for name, section in self.parameters.items()],
            inputs=inputs,
            constants=self.constants,
            define=self.define,
            integrator=self.integrator,
            substeps=substeps,
            hold=self.hold,
        )


def with_source_in_motion(content: Any) -> Any:
    """Return the content of a spec with `[physics.source]` in `[motion]`, where other code has it.

    Raises:
        ValueError: a source beside other physics.
    """
    physics = content.get("physics") if isinstance(content, Mapping) else None
    if not isinstance(physics, Mapping) or "source" not in physics:
        return content
    beside = next((key for key in physics if key != "source"), None)
    if beside is not None:
        raise ValueError(
            f"`physics.{beside}`: found beside [physics.source]; expected none, because the source "
            "has parameters of its own"
        )
    motion = content.get("motion", {})
    if not isinstance(motion, Mapping):
        return content
    others = {name: section for name, section in content.items() if name != "physics"}
    return others | {"motion": {**motion, "source": physics["source"]}}
