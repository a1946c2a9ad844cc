"""Physics that is linear in θ on lagged signals, in a job: posed, trained, analysed."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from orthaug._base.errors import InputError, Warning
from orthaug._base.lines import plural
from orthaug.analysis.evidence import Evidence
from orthaug.analysis.physics_findings import bias_before, imitable_before
from orthaug.analysis.suspects import Suspect
from orthaug.commands.job import Job, JobPhysics, Variant, selected_form
from orthaug.commands.parts import FilePart
from orthaug.commands.spec import Spec
from orthaug.commands.suspects import declared_suspects
from orthaug.data.expressions import SAMPLING_TIME
from orthaug.data.record import Record
from orthaug.data.regressors import Lags, largest_lag
from orthaug.data.sources import RecordSource
from orthaug.fitting.independent_terms import independent_terms
from orthaug.fitting.kinds import STRUCTURES
from orthaug.inference.measures import Measure, WeighedPhysics, weigh_problem
from orthaug.physics import ill_conditioned
from orthaug.physics.baseline import Baseline, regressor_of
from orthaug.physics.excitation import identifiability, require_rank
from orthaug.physics.parameters import PhysicsMap, with_initial
from orthaug.physics.problem import Problem, check_defined, pose
from orthaug.physics.streamed import pose_streamed
from orthaug.reports.result import CheckResult

if TYPE_CHECKING:
    from orthaug.analysis.design import Design
    from orthaug.analysis.findings import SuspectResult
    from orthaug.fitting.lagged_estimate import LaggedEstimate
    from orthaug.models.response import Response
    from orthaug.models.rows import Engine
    from orthaug.reports.drawing import Figure
    from orthaug.studies.planted import System

_ROWS = 20_000  # of the residual that are looked at
_SPANNED = 1e-9  # of a term's squares: what is left of it beside the physics where it is physics


@dataclass(frozen=True, eq=False)
class LaggedPhysics(JobPhysics[Problem, "LaggedEstimate"]):
    """A baseline, what its learner sees, and the physical parameters behind θ."""

    baseline: Baseline
    map: PhysicsMap | None = None
    lags: Lags | None = None
    learner_inputs: tuple[str, ...] | None = None
    weighed: WeighedPhysics | None = None
    """The physics over the points of the job's measure."""
    suspects: tuple[Suspect, ...] = ()

    section: ClassVar[str] = "baseline"
    runs_in_check: ClassVar[bool] = False
    most_trials: ClassVar[int] = 3

    @classmethod
    def declare(cls, spec: Spec, step: float | None) -> Self:
        baseline, learner_inputs = spec.declared_baseline(), spec.learner_inputs()
        physics = None if step is None else spec.physics_map(step)
        if physics is not None:
            baseline = with_initial(physics, baseline)
        baseline.check_initial()
        spec.declared_structure().penalty(baseline.names, baseline.initial, 1.0)
        baseline.check_channels(spec.data.outputs, spec.data.inputs)
        lags = spec.lag_orders() if spec.declared_learner() is not None else None
        return cls(baseline, physics, lags, learner_inputs)

    @property
    def structures(self) -> tuple[str, ...]:
        """Kinds of structure that can be trained."""
        return tuple(STRUCTURES)

    @property
    def declared_units(self) -> dict[str, str]:
        """Units of the parameters and fixed terms, as declared, by their names."""
        units: dict[str, str] = {}
        for term in self.baseline.terms:
            units[term.parameter] = term.unit or units.get(term.parameter, "")
        return units

    def names_taken(self, spec: Spec) -> set[str]:
        physical = spec.physics.parameters if spec.physics is not None else {}
        terms = {term.parameter for term in self.baseline.terms}
        return terms | {name for name, _ in self.baseline.constants} | set(physical)

    def with_term(
        self, job: Job, name: str, expression: str, place: str | None, initial: float
    ) -> tuple[dict[str, Any], str] | None:
        """Return the change of a spec that adds a term of an output, and where that is, in words.

        None where the spec has the term already.
        """
        spec, terms = job.spec, job.declaration["baseline"]["terms"]
        several = len(spec.data.outputs) > 1 and place is not None
        if any(_is_same(term, expression, place) for term in terms):
            return None
        output = {"output": place} if several else {}
        term = {"parameter": name, "regressor": expression, **output, **selected_form(expression)}
        change: dict[str, object] = {"baseline.terms": [*terms, term]}
        if spec.physics is not None:
            change[f"physics.parameters.{name}"] = {"initial": initial or 1.0}
            change[f"physics.theta.{name}"] = name
        return change, f"in the physics{f' of {place}' if several else ''}"

    def with_delays(self, job: Job) -> Iterator[tuple[dict[str, Any], str]]:
        """Yield changes of a spec by which an input acts from its first significant lag on.

        With words. Where the spec has it act earlier.
        """
        from orthaug.selection.first_orders import first_significant_lag

        record = job.train.record
        for number, name in enumerate(job.spec.data.inputs):
            declared = [lag.lag for lag in job.problem.layout if lag.channel == name]
            found = first_significant_lag(record, number) if declared else None
            if found is not None and found > min(declared):
                late = found - min(declared)
                yield (
                    _delayed(job, name, late),
                    (f"{name} {plural(late, 'sample')} later, from {name}[k-{found}] on,"),
                )

    def explained_residual(
        self, fit: LaggedEstimate
    ) -> Callable[[SuspectResult], tuple[float, float]] | None:
        """Return a function that gives the share of the one-step residual that a suspect explains.

        With its coefficient. Both are beside the physics: the part of the suspect that the physics
        spans is removed. Signals are scaled by the deviations of the outputs.

        None with a learner, whose part the table of suspects explains.
        """
        if fit.learns or not len(fit.theta):
            return None
        problem, unit = fit.problem, fit.problem.deviation
        rows = slice(None, None, 1 + len(problem.rows.x) // _ROWS)
        x = problem.rows.x[rows]
        phi = problem.phi(x)
        phi = phi / unit[:, None]
        basis = np.linalg.qr(phi.reshape(-1, phi.shape[2]))[0]
        whole = (fit.model.predict(problem.record).errors[rows] / unit).ravel()
        error = whole - basis @ (basis.T @ whole)
        constants = {SAMPLING_TIME: problem.record.sampling_time} | dict(problem.baseline.constants)

        def explained(entry: SuspectResult) -> tuple[float, float]:
            suspect = Suspect(entry.name, entry.expression, entry.output, constants=constants)
            column = (suspect.values(x, problem.layout, problem.outputs) / unit).ravel()
            rest = column - basis @ (basis.T @ column)
            along, size = float(rest @ error), float(rest @ rest)
            if not size > _SPANNED * float(column @ column):
                return 0.0, 0.0
            return along**2 / size / max(float(error @ error), np.finfo(float).tiny), along / size

        return explained

    def rows_needed(self, spec: Spec) -> tuple[int, int]:
        channels = tuple(spec.data.outputs), tuple(spec.data.inputs)
        layout, _ = regressor_of(self.baseline, self.lags, self.learner_inputs, *channels)
        return largest_lag(layout), 0

    def pose(self, spec: Spec, record: Record, **options: object) -> Problem:
        return self._posing(spec)(record, **options)

    def _posing(self, spec: Spec) -> Callable[..., Problem]:
        """Return a function that poses the problem on a record; it can be sent to a process."""
        posed = (self.baseline, self.lags, self.learner_inputs)
        return partial(_pose, posed=posed, output_weights=spec.training.output_weights)

    def pose_part(
        self, spec: Spec, train: FilePart, kind: str, engine: Engine, *, require_full_rank: bool
    ) -> tuple[Problem, tuple[Warning, ...]]:
        # On a cluster they are its tasks
        several = spec.runs(linear=self.baseline.linear) > 1 and train.source is None
        if kind in ("memory", "devices") or spec.brought or (kind == "dask" and several):
            problem = self.pose(spec, train.record, require_full_rank=require_full_rank)
        else:
            first = self.rows_needed(spec)[0]
            problem = pose_streamed(
                train.source or RecordSource(train.record, first, spec.engine.partition_rows),
                train.record,
                engine.passes,
                self.baseline,
                self.lags,
                self.learner_inputs,
                output_weights=spec.training.output_weights,
                require_full_rank=require_full_rank,
            )
        learner, left_out = spec.declared_learner(), ()
        if learner is not None and problem.excitation.full_rank:
            problem, _, left_out = independent_terms(problem, learner)
        problem.feature_rows()
        return problem, left_out

    def under(self, measure: Measure, spec: Spec, problem: Problem) -> Self:
        weighed = weigh_problem(measure, problem)
        if problem.excitation.full_rank and not weighed.excitation.full_rank:
            groups = "; ".join(", ".join(group) for group in weighed.excitation.collinear)
            raise InputError(
                f"under the {measure.name} measure the physics cannot distinguish {groups}; "
                "widen or move it."
            )
        suspects = declared_suspects(spec.suspects, problem, weighed)
        return replace(self, weighed=weighed, suspects=suspects)

    def check_record(self, problem: Problem, record: Record) -> None:
        check_defined(problem, record)

    def train(self, problem: Problem, **options: object) -> LaggedEstimate:
        return _train(problem, **options)

    def fold_training(
        self, job: Job, variant: Variant
    ) -> tuple[Callable[[Record], Problem], Callable[..., LaggedEstimate]]:
        """Return functions that pose a variant on a fold, and train it.

        They can be sent to another process. A fold is small: its rows are in memory.
        """
        physics = replace(self, lags=None, learner_inputs=None) if variant.physics_only else self
        return physics._posing(job.spec), _train

    def runner(self, engine: Engine) -> Engine:
        from orthaug.models.tasks import runs_on

        return runs_on(engine)

    def check(self, job: Job) -> tuple[dict[str, Any], list[Warning]]:
        """Return excitation, identifiability, and bias by suspects, and warnings on these."""
        problem, evidence = job.problem, job.evidence
        shared, warnings = imitable_before(problem, evidence)
        found = {
            "excitation": problem.excitation,
            "identifiability": identifiability(
                problem.baseline, problem.layout, problem.outputs, problem.rows.x
            ),
            "shared": shared and shared.beside_collinear(problem.excitation.collinear),
            "bias": self._bias(evidence) if problem.excitation.full_rank else None,
        }
        return found, [*ill_conditioned.of_physics(problem), *warnings]

    def refusal(self, job: Job, result: CheckResult) -> InputError | None:
        try:
            require_rank(job.problem.excitation, job.problem.samples)
        except InputError as error:
            return error
        return None

    def figures(
        self,
        job: Job,
        fit: LaggedEstimate,
        responses: Mapping[str, tuple[Response, Response]],
    ) -> dict[str, Figure]:
        from orthaug.reports import plots

        one_step, _ = responses[job.parts[-1].name]
        where = f"{job.parts[-1].name}, {fit.model.structure}"
        drawn = {"residual": plots.residual_figure(one_step, f"one-step residual, {where}")}
        if fit.learns:
            drawn["components"] = plots.components_figure(
                one_step, f"parts of the one-step prediction, {where}"
            )
        return drawn

    def run_alone(self, fit: LaggedEstimate, record: Record, free_run: Response) -> Response:
        """Return the free run by the model's physics without its learner, trained beside it."""
        return fit.model.physics_only.simulate(record)

    def design(self, job: Job, asked: dict[str, Any], noise: float | None) -> Design:
        """Return the input that is asked for, by θ of the spec or least squares."""
        from orthaug.analysis.design import design_input

        problem = job.problem
        theta = problem.projection.solve(problem.whitened_target)
        residual = problem.weight.outputs(problem.whitened_target - problem.projection.phi @ theta)
        given = problem.baseline.initial
        return design_input(
            problem.baseline,
            outputs=problem.outputs,
            inputs=[channel.name for channel in problem.record.inputs],
            suspects=self.suspects,
            noise=tuple(residual.std(axis=0)) if noise is None else noise,
            theta=given if np.all(given) else theta,
            **asked,
        )

    def system(self, fit: LaggedEstimate) -> System:
        from orthaug.studies.planted import LaggedSystem

        return LaggedSystem(fit, self.map)

    def _bias(self, evidence: Evidence) -> list[dict[str, object]]:
        """Return the table of suspects before training, under the spec's measure."""
        assert self.weighed is not None
        return bias_before(evidence, self.weighed)


def _is_same(term: Mapping[str, object], expression: str, place: str | None) -> bool:
    """Return whether a term of a spec is an expression of the same output."""
    one, other = ("".join(str(text).split()) for text in (term["regressor"], expression))
    return one == other and (place is None or term.get("output") in (None, place))


def _pose(record: Record, posed: Any, **options: object) -> Problem:
    return pose(record, *posed, **options)


def _train(problem: Problem, **options: object) -> LaggedEstimate:
    from orthaug.fitting.estimation import fit

    return fit(problem, **options)


def _delayed(job: Job, name: str, late: int) -> dict[str, object]:
    """Return the change of a spec in which all lags of an input are larger by `late`."""
    declaration = job.declaration
    read = re.compile(rf"(?<![\w.]){re.escape(name)}\[k(?:-(\d+))?\]")

    def later(text: object) -> Any:
        if not isinstance(text, str):
            return text
        return read.sub(lambda found: f"{name}[k-{int(found[1] or 0) + late}]", text)

    terms = [
        {**term, "regressor": later(term["regressor"])} for term in declaration["baseline"]["terms"]
    ]
    change: dict[str, object] = {"baseline.terms": terms}
    if "inputs" in declaration.get("learner", {}):
        change["learner.inputs"] = [later(text) for text in declaration["learner"]["inputs"]]
    if "suspects" in declaration:
        change["suspects"] = [
            {key: later(value) for key, value in suspect.items()}
            for suspect in declaration["suspects"]
        ]
    if "lags" in declaration:
        nk = declaration["lags"].get("nk", 1)
        each = nk if isinstance(nk, list) else [nk] * len(job.spec.data.inputs)
        pairs = zip(job.spec.data.inputs, each, strict=True)
        change["lags.nk"] = [first + late * (own == name) for own, first in pairs]
    return change
