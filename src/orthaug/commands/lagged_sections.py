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
from orthaug.models.learners import Learner
from orthaug.models.terms import over_lags
from orthaug.physics.baseline import Baseline, Term
from orthaug.physics.lagged_motion import motion_of_lags
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

    What reads lags, the learner's inputs and suspects, reads the motion's states then. An input
    with a present sample, u[k], comes a row earlier by a step of preparation. Sections that cannot
    be read stay, for their own checks to name the fault.

    Raises:
        InputError: physics that no motion can be.
    """
    learner = content.get("learner") if isinstance(content, Mapping) else None
    if not isinstance(learner, Mapping) or not learner.get("states"):
        return content
    if "motion" in content or "baseline" not in content:
        return content
    data: Any = content.get("data")
    suspects = content.get("suspects", [])
    try:
        baseline = BaselineSection.model_validate(content["baseline"]).declared
        lags = LagsSection.model_validate(content["lags"]).declared if "lags" in content else None
        physics = None
        if "physics" in content:
            section = PhysicsSection.model_validate(content["physics"])
            physics = section.declared({SAMPLING_TIME: 1.0} | dict(baseline.constants))
        read = [suspect["on"] for suspect in suspects if "on" in suspect]
        channels = data["outputs"], data.get("inputs", [])
    except (KeyError, TypeError, AttributeError, ValidationError):
        return content
    found = motion_of_lags(
        baseline, lags, learner.get("inputs"), *channels, physics=physics, further=read
    )
    places = {"output": "equation"}
    moved = [
        {
            places.get(key, key): found.named(value) if key == "on" else value
            for key, value in suspect.items()
        }
        for suspect in suspects
    ]
    kept = {name: own for name, own in content.items() if name not in _LAGGED}
    kept["motion"] = motion_section(found.motion).unwrap()
    kept["learner"] = {**learner, "inputs": list(found.learner_inputs)}
    steps = [{"step": "shift", "channel": name, "samples": -1} for name in found.advanced]
    if steps:
        kept["data"] = {**data, "prepare": [*data.get("prepare", []), *steps]}
    return kept | ({"suspects": moved} if moved else {})
