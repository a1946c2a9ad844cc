"""A system with known parameters and a planted term that its physics lacks, simulated.

The parameters are those of a fit and are the truth from there on. The inputs are those of a record;
a term with memory is driven along the run that it takes part in.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector, free_name
from orthaug.analysis.catalogue import Catalogue
from orthaug.analysis.imitation import Alternative, imitation, imitation_before
from orthaug.analysis.suspects import MotionSuspect, Suspect, median_size
from orthaug.data.channels import Channel
from orthaug.data.expressions import SAMPLING_TIME
from orthaug.data.record import Experiment, Record
from orthaug.data.regressors import Features, lag_matrix
from orthaug.inference.splitting import learned_places, slopes_at
from orthaug.models.dynamics import Numbers
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.learners import nothing_learned
from orthaug.models.motion_field import parts_at
from orthaug.models.moving import MotionDynamics
from orthaug.physics.baseline import Baseline, Term, regressor_of
from orthaug.physics.motion import Motion
from orthaug.physics.parameters import PhysicsMap
from orthaug.physics.suspected_motion import SuspectedMotion

_SWEEPS = 50  # of a run and the memory that it drives, until both agree
_AGREED = 1e-9  # of the memory's largest value
_SPANNED = 1e-3  # of a term: where less is left of it beside the physics, it is physics
_LARGEST = 0.5  # of the physics in the same equation: a term that is larger is not what is missing
_UNSEEN = 0.02  # of the physics in the same equation, where no learner says how much is missing
_LAG_ROWS, _MOST_SAMPLES = (
    0.01,
    10.0,
)  # time constant of a lag: of an experiment's rows, samples at most


class Planted(NamedTuple):
    """A suspect, and the coefficient that it has in the truth."""

    suspect: Any
    coefficient: float

    @property
    def name(self) -> str:
        """The suspect's name."""
        return self.suspect.name


class Columns(NamedTuple):
    """A term beside the physics and the learner of its equation, along the fitted run (M rows)."""

    term: Vector
    """For a coefficient of 1."""
    physics: Vector
    learner: Vector
    slopes: Float[np.ndarray, "M nt"]
    """Derivatives of the physics by its parameters."""
    noise: float | None = None
    """Standard deviation of the noise in this equation, where there is some."""


@runtime_checkable
class System(Protocol):
    """The physics of a fit, its parameters taken as true."""

    @property
    def values(self) -> dict[str, float]:
        """The true parameters by name, physical parameters of a map included."""
        ...

    def catalogue(self) -> tuple[Any, ...]:
        """Return the usual suspects, with widths from the data."""
        ...

    def with_memory(self) -> Any | None:
        """Return a suspect with memory; None where the data show none."""
        ...

    def columns(self, suspect: Any) -> Columns:
        """Return a term beside physics and learner.

        Raises:
            InputError: a term without a value on some row.
        """
        ...

    def run(
        self, experiment: Experiment, record: Record, planted: Planted, noise: Matrix
    ) -> Matrix:
        """Return the outputs (N, ny) of the system with the term, from the experiment's start.

        NaN where the run has left all bounds, or where the term's memory does not settle.

        Args:
            noise: (N, ny), which enters the equations of the outputs; a motion adds none.
        """
        ...

    def other_inputs(self) -> tuple[Alternative, ...]:
        """Return other inputs of the learner, with what they leave to the data (F8)."""
        ...


def size_of(columns: Columns, share: float | None = None) -> float | None:
    """Return the coefficient that makes a term as large as what the learner found.

    Beside the physics, so `rms(P⊥F)/rms(P⊥Δ)`, with the sign of their product: this is what the
    data show, while the part within the physics' span is what no one sees. At most half of the
    physics in the same equation. Without a learner as large as the noise in the equation, or 2 % of
    the physics.

    Args:
        share: RMS of the whole term over that of the physics in its equation, instead.

    Returns:
        None for a term that is a combination of the physics on these rows, or zero on them.
    """
    term, physics = _rms(columns.term), _rms(columns.physics)
    if not term > 0:
        return None
    basis = np.linalg.qr(
        columns.slopes / np.maximum(np.linalg.norm(columns.slopes, axis=0), 1e-300)
    )[0]
    beside, learner = (row - basis @ (basis.T @ row) for row in (columns.term, columns.learner))
    if _rms(beside) <= _SPANNED * term:
        return None
    sign = -1.0 if beside @ learner < 0 else 1.0
    if share is not None:
        return sign * share * physics / term
    wanted = _rms(learner) or columns.noise or _UNSEEN * physics
    return sign * min(wanted / _rms(beside), _LARGEST * physics / term)


def _rms(values: Vector) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0


def _settle(
    run: Callable[[Vector], Matrix], drive: Callable[[Matrix], Vector], rows: int
) -> Matrix:
    """Return the run (N, ·) in which a memory's state (N,) and what drives it agree.

    Both are causal, so that repeated sweeps find it; NaN where they do not.
    """
    state = np.zeros(rows)
    for _ in range(_SWEEPS):
        found = run(state)
        if not np.isfinite(found).all():
            return np.full_like(found, np.nan)
        following = drive(found)
        if np.max(np.abs(following - state)) <= _AGREED * np.max(np.abs(following), initial=1e-300):
            return found
        state = following
    return np.full_like(run(state), np.nan)


@dataclass(frozen=True, eq=False)
class LaggedSystem:
    """Physics on lagged signals with known θ.

    Args:
        fit: an `Estimate`.
        map: from physical parameters to θ; the true θ is then that of the estimated ones.
    """

    fit: Any
    map: PhysicsMap | None = None

    @property
    def theta(self) -> Vector:
        """The true θ (nθ,)."""
        if self.map is None:
            return np.asarray(self.fit.theta)
        mapped = dict(zip(self.map.theta_names, self.map.theta(self._physical), strict=True))
        return np.array([mapped[name] for name in self.fit.problem.baseline.names])

    @property
    def _physical(self) -> Vector:
        assert self.map is not None
        return np.asarray(self.fit.physical(self.map).value, dtype=float)

    @property
    def values(self) -> dict[str, float]:
        own = zip(self.fit.problem.baseline.names, self.theta, strict=True)
        found = {name: float(value) for name, value in own}
        if self.map is not None:
            physical = zip(self.map.names, self._physical, strict=True)
            found |= {name: float(value) for name, value in physical}
        return found

    def catalogue(self) -> tuple[Suspect, ...]:
        return Catalogue.of_problem(self.fit.problem).usual()

    def with_memory(self) -> Suspect | None:
        """Return hysteresis of the last step of the first output, or of the first input."""
        problem = self.fit.problem
        for argument in Catalogue.of_problem(problem).arguments[::-1]:
            width = median_size(argument.values)
            moves = any(name in argument.text for name in problem.outputs)
            if width is not None and moves:
                return self._memory(argument.text)
        argument = Catalogue.of_problem(problem).arguments[0]
        return self._memory(argument.text)

    def _memory(self, on: str) -> Suspect:
        problem = self.fit.problem
        step = problem.record.sampling_time
        constants = {SAMPLING_TIME: step} | dict(problem.baseline.constants)
        seconds = _time_constant(max(problem.lengths), step)
        own: dict[str, Any] = {"time_constant": seconds, "output": problem.outputs[0]}
        return Suspect.of(
            "lag", on, constants=constants, name=f"lag of {on}, {seconds:.3g} s", **own
        )

    def columns(self, suspect: Suspect) -> Columns:
        fit, problem = self.fit, self.fit.problem
        x, layout, outputs = problem.rows.x, problem.layout, problem.outputs
        i, parts = suspect.column_of(outputs), fit.model.parts_at(x)
        sampled = suspect.sampled(problem.record.sampling_time)
        term = sampled.values(x, layout, outputs, problem.lengths)[:, i]
        slopes = np.asarray(problem.baseline.phi(x, layout, outputs, np))[:, i]
        noise = fit.model.statistics.noise
        std = None if noise is None else float(np.sqrt(noise[i, i]))
        return Columns(term, parts.baseline[:, i], parts.learner[:, i], slopes, std)

    def run(
        self, experiment: Experiment, record: Record, planted: Planted, noise: Matrix
    ) -> Matrix:
        form, theta, added = self._form(planted)
        suspect = planted.suspect.sampled(record.sampling_time)
        channels = (*record.inputs, *(Channel(name) for name in added))
        numbers = Numbers(
            theta, np.zeros_like(theta), *[np.zeros(0)] * 3, gain=np.ones(noise.shape[1])
        )
        first = form.first_row

        def outputs_for(state: Vector | None) -> Matrix:
            more = noise if state is None else np.column_stack([noise, state])
            driven = replace(experiment, inputs=np.column_stack([experiment.inputs, more]))
            start = form.start(experiment.outputs, [first])[0]
            with np.errstate(all="ignore"):
                rows = form.inputs(driven, replace(record, inputs=channels, experiments=(driven,)))
                total = form.run(numbers, start, rows).parts.total
            return np.concatenate([experiment.outputs[:first], np.asarray(total)])

        def state_of(outputs: Matrix) -> Vector:
            ran, problem = replace(experiment, outputs=outputs), self.fit.problem
            x = lag_matrix(ran, problem.layout, problem.record, problem.first_row)
            state = suspect.form(x, problem.layout, [len(x)])
            return np.concatenate([np.full(problem.first_row, state[0]), state])

        if suspect.memory is None:
            return outputs_for(None)
        return _settle(outputs_for, state_of, len(experiment))

    def _form(self, planted: Planted) -> tuple[LaggedDynamics, Vector, list[str]]:
        """Return the dynamics with term and noise as inputs, their θ, and names of these inputs."""
        problem = self.fit.problem
        baseline, suspect = problem.baseline, planted.suspect
        outputs, inputs = problem.outputs, tuple(c.name for c in problem.record.inputs)
        taken = {*outputs, *inputs, *baseline.names, *(name for name, _ in baseline.constants)}
        names = [free_name(f"noise_{i + 1}", taken) for i in range(len(outputs))]
        signal = [] if suspect.memory is None else [free_name("memory", taken)]
        text = f"{signal[0]}[k]" if signal else suspect.expression
        place = outputs[suspect.column_of(outputs)]
        terms = [
            *baseline.terms,
            Term(free_name("planted", taken), text, output=place),
            *(
                Term(free_name(f"entering_{i + 1}", taken), f"{name}[k]", output=output)
                for i, (name, output) in enumerate(zip(names, outputs, strict=True))
            ),
        ]
        constants = {SAMPLING_TIME: problem.record.sampling_time} | dict(baseline.constants)
        whole = Baseline.from_terms(terms, constants | dict(suspect.constants))
        read = (*inputs, *names, *signal)
        layout, _ = regressor_of(whole, None, None, outputs, read)
        form = LaggedDynamics(whole, Features(()), layout, outputs, nothing_learned(len(outputs)))
        theta = np.concatenate([self.theta, [planted.coefficient], np.ones(len(outputs))])
        return form, theta, [*names, *signal]

    def other_inputs(self) -> tuple[Alternative, ...]:
        return imitation(self.fit.problem, self.map).alternatives


def _time_constant(rows: int, step: float) -> float:
    """Return the time constant [s] of a lag that a stretch of so many rows shows."""
    return float(f"{step * float(np.clip(_LAG_ROWS * rows, 1.0, _MOST_SAMPLES)):.3g}")


@dataclass(frozen=True, eq=False)
class MotionSystem:
    """Equations of motion with known parameters.

    Args:
        fit: a `MotionEstimate`.
        motion: the motion as declared, without states of a learner.
    """

    fit: Any
    motion: Motion

    @property
    def values(self) -> dict[str, float]:
        return {name: float(v) for name, v in zip(self.motion.names, self.fit.values, strict=True)}

    def _points(self) -> list[tuple[Matrix, Matrix]]:
        """Return states and inputs along the fitted run of every experiment."""
        found, record, form = [], self.fit.problem.record, self.fit.model.form
        for experiment in record.experiments:
            run, inputs = self.fit.model.free_run(experiment, record)
            states = np.asarray(run.states)
            found.append(
                (states, np.asarray(form.at_samples(self.fit.model.numbers, states, inputs)))
            )
        return found

    def _catalogue(self) -> Catalogue:
        x, u = (np.concatenate(parts) for parts in zip(*self._points(), strict=True))
        there = np.isfinite(x).all(axis=1)
        seen = [entry.text for entry in self.fit.problem.features]
        motion = self.fit.problem.motion
        return Catalogue.of_motion(motion, np.asarray(self.fit.values), x[there], u[there], seen)

    def catalogue(self) -> tuple[MotionSuspect, ...]:
        own = self.motion.known
        found = self._catalogue().usual()
        return tuple(
            one
            for one in found
            if all(name in own for name in one.parsed(self.fit.problem.motion).names)
        )

    def with_memory(self) -> MotionSuspect | None:
        """Return a lag of the first state that a learned equation may depend on."""
        catalogue = self._catalogue()
        arguments = [a for a in catalogue.arguments if a.text in self.motion.names_of_states]
        if not arguments or not catalogue.places:
            return None
        record, on = self.fit.problem.record, arguments[-1].text
        seconds = _time_constant(max(map(len, record.experiments)), record.sampling_time)
        own: dict[str, Any] = {"time_constant": seconds, "equation": catalogue.places[0]}
        return MotionSuspect.of("lag", on, name=f"lag of {on}, {seconds:.3g} s", **own)

    def columns(self, suspect: MotionSuspect) -> Columns:
        model, motion = self.fit.model, self.fit.problem.motion
        form, p, place = model.form, np.asarray(self.fit.values), suspect.place(motion)
        points = self._points()
        x, u = (np.concatenate(parts) for parts in zip(*points, strict=True))
        term = suspect.term(motion)
        if term.signal is None:
            values = suspect.values(motion, p, x, u)
        else:
            step = self.fit.problem.record.sampling_time
            signals = [term.signal.along(motion, p, *point, step) for point in points]
            factor = term.expression.value(motion.values(x.T, u.T, p, np), np)
            values = np.concatenate(signals) * np.broadcast_to(factor, len(x))
        slopes = np.asarray(slopes_at(form.physics_only, self.fit.theta, x, u))[:, place]
        rates = np.asarray(motion.mass.balance(motion.rates(x.T, u.T, p, np), x.T, p))
        both = np.concatenate([rates, motion.observed(x.T, u.T, p, np)])
        physics, learner, places = both[place], np.zeros(len(x)), learned_places(motion)
        if place in places and form.learns:
            learner = parts_at(form, model.numbers, x, u)[1][:, places.index(place)]
        kept = np.isfinite(np.column_stack([values, physics, learner, slopes])).all(axis=1)
        return Columns(values[kept], physics[kept], learner[kept], slopes[kept])

    def run(
        self, experiment: Experiment, record: Record, planted: Planted, noise: Matrix
    ) -> Matrix:
        motion, step = self.motion, record.sampling_time
        term = planted.suspect.term(motion)
        suspected = SuspectedMotion.of(motion, [term])
        form = MotionDynamics(suspected, (), nothing_learned(), step, self.fit.model.form.substeps)
        p = np.append(np.asarray(self.fit.values), planted.coefficient)
        q = suspected.coordinates.of(p)
        numbers = Numbers(q, np.zeros_like(q), *[np.zeros(0)] * 3, gain=np.ones(noise.shape[1]))
        start = self.fit.model.first_state(experiment, record)[: len(motion.states)]

        def ran(signal: Vector | None) -> Any:
            more = (
                experiment.inputs
                if signal is None
                else np.column_stack([experiment.inputs, signal])
            )
            with np.errstate(all="ignore"):
                return form.run(
                    numbers, start, form.inputs(replace(experiment, inputs=more), record)
                )

        if term.signal is None:
            return np.asarray(ran(None).parts.total)
        signal = term.signal
        without = replace(form, motion=motion)
        own = numbers._replace(theta=q[:-1], theta_aux=np.zeros_like(q[:-1]))
        rows = without.inputs(experiment, record)

        def drive(states: Matrix) -> Vector:
            inputs = without.at_samples(own, states, rows)
            return signal.along(motion, p[:-1], states, inputs, step)

        agreed: list[Vector] = []

        def states_for(state: Vector) -> Matrix:
            agreed[:] = [state]
            return np.asarray(ran(state).states)

        settled = _settle(states_for, drive, len(experiment))
        total = np.asarray(ran(agreed[0]).parts.total)
        return total if np.isfinite(settled).all() else np.full_like(total, np.nan)

    def other_inputs(self) -> tuple[Alternative, ...]:
        points: Sequence[tuple[Matrix, Matrix]] = self._points()
        x, u = (np.concatenate(parts) for parts in zip(*points, strict=True))
        together = len(points[0][0])
        found = imitation_before(self.fit.model.form, self.fit.theta, x, u, together)
        return found.alternatives
