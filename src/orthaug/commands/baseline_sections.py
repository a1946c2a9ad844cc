"""Sections of a spec for lagged physics, and the motion that takes their place."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import Field, ValidationError

from orthaug._base.registry import resolve
from orthaug.commands.sections import Count, Finite, PhysicalSection, Section
from orthaug.commands.written_motion import motion_section
from orthaug.data.expressions import SAMPLING_TIME
from orthaug.data.regressors import Lags
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.noise import OF_MOTIONS
from orthaug.models.kinds import LEARNERS
from orthaug.models.learners import Learner
from orthaug.models.terms import over_lags
from orthaug.physics.baseline import Baseline, Term
from orthaug.physics.lags_as_states import LaggedMotion, motion_of_lags
from orthaug.physics.parameters import PhysicsMap

Orders = Count | list[Count]
_LAGGED = ("baseline", "lags", "physics")  # sections that a motion has instead


class LagsSection(Section):
    """The learner's regressor, by orders as in MATLAB."""

    na: Orders = 0
    nb: Orders = 0
    nk: Orders = 1

    @property
    def declared(self) -> Lags:
        """The declaration."""
        orders = (self.na, self.nb, self.nk)
        return Lags(*(tuple(v) if isinstance(v, list) else v for v in orders))


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
    selected: bool | None = None

    @property
    def declared(self) -> Term:
        """The declaration."""
        return Term(**{**self.model_dump(), "regressor": str(self.regressor)})


class BaselineSection(Section):
    """The physics."""

    learns: ClassVar[bool] = True
    reads_all_rows: ClassVar[str] = ""
    by_evidence: ClassVar[bool] = False
    takes_uneven_rows: ClassVar[bool] = False
    foreign_keys: ClassVar[Mapping[str, str]] = dict.fromkeys(
        ("equation", "factor", "unit"), "without [motion], which it belongs to"
    )
    terms: Annotated[list[TermSection], Field(min_length=1)]
    constants: dict[str, Finite] = {}

    @property
    def declared(self) -> Baseline:
        """The declaration."""
        return Baseline.from_terms([term.declared for term in self.terms], self.constants)

    def over(self, learner: Any, spec: Any) -> Learner:
        """Return a learner of terms over the lags of a spec."""
        channels = tuple(spec.data.outputs), tuple(spec.data.inputs)
        return over_lags(learner, spec.declared_baseline(), spec.lag_orders(), *channels)

    def criterion(self, training: Any) -> Criterion:
        """Return the criterion of a spec."""
        return resolve(training.declared_criterion(training.chosen_focus()))

    def check_beside(self, spec: Any) -> None:
        """Raise ValueError for what a spec cannot have beside these physics."""
        if spec.controller is not None:
            raise ValueError(
                "`controller`: found beside [baseline]; expected a [motion]: write the terms as "
                'one with `integrator` = "discrete", or leave it out and estimate one step '
                'ahead with `noise.model` = "arma"'
            )
        if spec.data.missing == "keep":
            raise ValueError(
                '`data.missing`: found "keep"; lagged physics needs the outputs of every row. '
                'Leave rows out by "skip", or state the physics as a [motion]'
            )

    def check_noise(self, spec: Any, found: str) -> None:
        """Raise ValueError for a noise model that a spec cannot have, which was `found`."""
        if spec.noise.model == "innovations":
            raise ValueError(f"`noise.model` = innovations {OF_MOTIONS}")
        if spec.declared_criterion().free_run is not None:
            raise ValueError(
                f"{found}, but training is not one step ahead; expected `training.focus` "
                "prediction with a `horizon` of 1, or white noise"
            )
        if not spec.declared_solver().gauss_newton or spec.declared_structure().from_initial:
            raise ValueError(
                f"{found}; expected solver levenberg-marquardt and a solved θ with it, or white "
                "noise"
            )
        if spec.training.ensemble:
            raise ValueError(f"{found}; expected `training.ensemble` = false with it")
        if spec.engine.kind not in ("auto", "memory"):
            raise ValueError(
                f"{found} beside `engine.kind` = {spec.engine.kind}; expected memory, because the "
                "filter of a noise model needs all rows in their order"
            )


class PhysicsSection(Section):
    """Physical parameters, and the expressions of θ in them."""

    parameters: Annotated[dict[str, PhysicalSection], Field(min_length=1)]
    theta: Annotated[dict[str, str], Field(min_length=1)]
    profile: bool = False

    def declared(self, constants: Mapping[str, float]) -> PhysicsMap:
        """Return the physical parameters and their map to θ, with constants by their names."""
        parameters = [section.declared(name) for name, section in self.parameters.items()]
        return PhysicsMap.of(parameters, self.theta, constants)


def with_lags_in_motion(content: Any) -> Any:
    """Return the content of a spec, with a motion for lagged physics beside a learner with states.

    What reads lags, the learner's inputs, suspects and the box of a measure, reads the motion's
    states then. An input with a present sample, u[k], comes a row earlier by a step of preparation.
    Sections that cannot be read stay, for their own checks to name the fault.

    Raises:
        InputError: physics that no motion can be.
        ValueError: keys that such physics does not have.
    """
    learner = content.get("learner") if isinstance(content, Mapping) else None
    if not isinstance(learner, Mapping) or not _remembers(learner):
        return content
    if "motion" in content or "baseline" not in content:
        return content
    data, suspects = content.get("data"), content.get("suspects", [])
    if not isinstance(data, Mapping) or not isinstance(suspects, list):
        return content
    lists = data.get("outputs"), data.get("inputs", []), learner.get("inputs", [])
    steps = data.get("prepare", [])
    tables = all(isinstance(one, Mapping) for one in suspects) and isinstance(steps, list)
    if not tables or not all(_is_list_of_text(one) for one in lists):
        return content
    try:
        baseline = BaselineSection.model_validate(content["baseline"]).declared
        lags = LagsSection.model_validate(content["lags"]).declared if "lags" in content else None
        physics = None
        if "physics" in content:
            section = PhysicsSection.model_validate(content["physics"])
            physics = section.declared({SAMPLING_TIME: 1.0} | dict(baseline.constants))
            if section.profile:
                raise ValueError(
                    "`physics.profile`: found true beside `learner.states`; expected false, for "
                    "the motion that is fitted then has no profile"
                )
    except ValidationError:
        return content
    for i, suspect in enumerate(suspects):
        for key in sorted(suspect.keys() & BaselineSection.foreign_keys.keys()):
            raise ValueError(f"`suspects[{i}].{key}`: found {BaselineSection.foreign_keys[key]}")
    found = motion_of_lags(
        baseline,
        lags,
        learner.get("inputs"),
        data["outputs"],
        data.get("inputs", []),
        physics=physics,
        further=[suspect["on"] for suspect in suspects if "on" in suspect],
    )
    kept = {name: own for name, own in content.items() if name not in _LAGGED}
    kept["motion"] = motion_section(found.motion).unwrap()
    kept["learner"] = {**learner, "inputs": list(found.learner_inputs)}
    if suspects:
        kept["suspects"] = [_moved_suspect(suspect, found) for suspect in suspects]
    structure = content.get("structure")
    measure = structure.get("measure") if isinstance(structure, Mapping) else None
    if isinstance(measure, Mapping) and isinstance(box := measure.get("box"), Mapping):
        moved = {found.named(text): limits for text, limits in box.items()}
        kept["structure"] = {**structure, "measure": {**measure, "box": moved}}  # type: ignore[dict-item]
    if found.advanced:
        shifts = [{"step": "shift", "channel": name, "samples": -1} for name in found.advanced]
        kept["data"] = {**data, "prepare": [*steps, *shifts]}
    return kept


def _remembers(learner: Mapping[str, Any]) -> bool:
    """Return whether a section declares states of a kind of learner that can have them."""
    kind = learner.get("kind", "mlp")
    known = isinstance(kind, str) and kind in LEARNERS
    return bool(learner.get("states")) and known and hasattr(LEARNERS[kind], "states")


def _is_list_of_text(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(one, str) for one in value)


def _moved_suspect(suspect: Mapping[str, Any], found: LaggedMotion) -> dict[str, Any]:
    """Return a suspect on states, in the equation of the output that it was in."""
    moved = {"equation" if key == "output" else key: value for key, value in suspect.items()}
    return moved | ({"on": found.named(suspect["on"])} if "on" in suspect else {})
