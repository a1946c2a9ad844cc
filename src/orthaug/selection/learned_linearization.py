"""Linearization of a learner's output over data, beside the physics' own parameters.

For a lagged model the data are the rows of a record; for a motion the states and inputs of its free
run, where the output counts by its effect on the outputs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.jax import Array, jax, jnp
from orthaug._base.lines import plural
from orthaug.data.expressions import SAMPLING_TIME, Expression, parse, parse_named
from orthaug.data.record import Record
from orthaug.data.regressors import lag_matrix, stack_rows
from orthaug.inference.splitting import slopes_at
from orthaug.models.dynamics import Numbers
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.model import Model
from orthaug.models.motion_field import labels_of, parts_at
from orthaug.models.moving import MotionDynamics
from orthaug.models.statistics import JointCovariance
from orthaug.physics.baseline import Baseline, Parameter
from orthaug.physics.motion import Motion
from orthaug.physics.parameters import PhysicalParameter

MOST_CELLS = 10_000
"""Values of the learner that are looked at: a smooth function needs no more, and candidates are
kept beside them.
"""
FEWEST = 20  # of them
MOST_WEIGHTS = 2000  # of a learner whose tangent is looked at


class Tangent(NamedTuple):
    """Derivatives by the learner's weights w, whitened, and the covariance of w after training."""

    jacobian: Float[np.ndarray, "R nw"]
    weights: Vector
    ridge: float | Vector
    joint: JointCovariance | None


@dataclass(frozen=True, eq=False)
class LearnedLinearization:
    """The learner over M points in nl outputs or equations (`places`: name and unit).

    `target` is the learner in their units, `physics_moves` what the parameters, and starts of runs,
    do to what is fitted. `weight` (nl, nl) whitens a row of a lagged model. `outside` is the share
    of the points beyond the training data.
    """

    target: Float[np.ndarray, "M nl"]
    physics_moves: Float[np.ndarray, "R s"]
    weight: Matrix
    response: Response | None
    """From the points to what was fitted, of a motion; None where that is the same."""
    places: tuple[tuple[str, str], ...]
    signals: tuple[str, ...]
    """What the learner sees, as expressions, and rates of change that follow from it."""
    seen: int
    """Number of signals that the learner sees as they are."""
    units: dict[str, str]
    parse: Callable[[str], Expression]
    evaluate: Callable[[Expression], Any]
    moved: Callable[[Vector], Vector]
    """The parameters when the physics moves by (s,) along the shared directions."""
    parameters: Sequence[Parameter | PhysicalParameter]
    values: Vector
    physics: Baseline | Motion
    tangent: Tangent | None
    """None of an opaque learner, and of one with very many weights."""
    outside: float

    def column(self, expression: Expression, place: int) -> Vector:
        """Return a term with coefficient 1, whitened, all points and places stacked (M·nl,)."""
        with np.errstate(all="ignore"):
            values = np.broadcast_to(
                np.asarray(self.evaluate(expression), dtype=float), (len(self.target),)
            )
        return (values[:, None] * self.weight[:, place]).ravel()

    def fitted_values(self, columns: Float[np.ndarray, "P *k"]) -> np.ndarray:
        """Return the effect of columns over the points on the fitted values (R, …)."""
        return columns if self.response is None else self.response.forward(columns)

    @property
    def learner(self) -> Vector:
        """The learner over the points, whitened (M·nl,)."""
        return np.einsum("oi,mi->mo", self.weight, self.target).ravel()


NO_LEARNER = (
    "the model is physics alone: it has no learner that could be explained. Fit it with a learner "
    "that sees what the missing terms may depend on."
)


def signals_seen(model: Model) -> tuple[str, ...]:
    """Return what a learner sees, as expressions."""
    features = model.form.features
    return tuple(dict.fromkeys(map(str, getattr(features, "entries", features))))


def linearization_of(model: Model, record: Record) -> LearnedLinearization:
    """Return the learner of a model over a record.

    Raises:
        InputError: a model without a learner, other channels, too few rows, or none with a value.
    """
    if not model.learns:
        raise InputError(NO_LEARNER)
    linearization = _OF_FORM[type(model.form)](model, record)
    if len(linearization.target) < FEWEST:
        raise InputError(
            f"the learner has a value at {plural(len(linearization.target), 'row')} of the data; "
            f"at least {FEWEST} are needed."
        )
    return linearization


def _of_lagged(model: Model[LaggedDynamics], record: Record) -> LearnedLinearization:
    form = model.form
    if form.states and not record.outputs:
        names = ", ".join(channel.name for channel in model.outputs)
        raise InputError(f"the data have no {names}: the learner is evaluated at measured outputs.")
    record = model.fitting(record, need_outputs=bool(form.states))
    x = (
        stack_rows(record, form.layout).x
        if record.outputs
        else np.concatenate(
            [lag_matrix(e, form.layout, record, form.first_row) for e in record.experiments]
        )
    )
    x = x[:: max(1, -(-len(x) * len(form.outputs) // MOST_CELLS))]
    with np.errstate(all="ignore"):
        target = model.learner_at(x) if len(x) else np.zeros((0, len(form.outputs)))
        phi = np.asarray(form.phi(x, np))
        z = form.features_of(x)
    finite = (
        np.isfinite(target).all(axis=1)
        & np.isfinite(phi).all(axis=(1, 2))
        & np.isfinite(z).all(axis=1)
    )
    x, target, phi, z = x[finite], target[finite], phi[finite], z[finite]
    constants = {SAMPLING_TIME: model.sampling_time} | dict(form.baseline.constants)
    for entry in form.features.entries:
        constants |= dict(entry.constants)
    columns = {lag: x[:, j] for j, lag in enumerate(form.layout)}
    own = signals_seen(model)
    c = model.theta - model.theta_aux
    return LearnedLinearization(
        target=target,
        physics_moves=_stack(np.einsum("oi,mit->mot", model.weight, phi)),
        weight=np.asarray(model.weight),
        response=None,
        places=tuple((channel.name, channel.unit) for channel in model.outputs),
        signals=(*own, *_rates_of_change(form.outputs, own)),
        seen=len(own),
        units=model.units | {SAMPLING_TIME: "s"},
        parse=lambda text: parse(text, constants),
        evaluate=lambda expression: expression.evaluate(columns, np),
        moved=lambda along: c + along,
        parameters=form.baseline.parameters,
        values=model.theta,
        physics=form.baseline,
        tangent=_tangent(model, z, np.asarray(model.weight), None),
        outside=_share_beyond(model, z),
    )


def _of_motion(model: Model[MotionDynamics], record: Record) -> LearnedLinearization:
    form, numbers, motion = model.form, model.numbers, model.form.motion
    record = model.fitting(record, need_outputs=False)
    run = _Run.of(model, record)
    x, u = run.x, run.u
    target = parts_at(form, numbers, x, u)[1] if len(x) else np.zeros((0, len(_places(model))))
    learned = [*motion.learned[0], *(len(motion.states) + i for i in motion.learned[1])]
    linear = MotionResponse.of(form, numbers, x, u, run.rows, run.begins, np.asarray(model.weight))
    response = Response(linear, tuple(learned), len(motion.states) + len(motion.outputs))
    slopes = np.nan_to_num(np.asarray(slopes_at(form, model.theta, x, u)))
    coordinates, count = motion.coordinates, len(model.theta)
    known = motion.values(x.T, u.T, coordinates.physical(model.theta), np)
    own = signals_seen(model)
    z = form.features_at(x, u)
    units = model.units | {parameter.name: parameter.unit for parameter in motion.parameters}
    return LearnedLinearization(
        target=target,
        physics_moves=np.concatenate([linear.forward(slopes), linear.starts()], axis=1),
        weight=np.eye(len(learned)),
        response=response,
        places=_places(model),
        signals=own,
        seen=len(own),
        units=units | {state.name: state.unit for state in motion.states} | {SAMPLING_TIME: "s"},
        parse=lambda text: parse_named(text, motion.known, "the term"),
        evaluate=lambda expression: expression.value(known, np),
        moved=lambda along: _move_parameters(motion, model.theta, along[:count], x, u),
        parameters=coordinates.parameters,
        values=np.asarray(coordinates.physical(model.theta)),
        physics=motion,
        tangent=_tangent(model, z, np.eye(len(learned)), response),
        outside=_share_beyond(model, z),
    )


@dataclass(frozen=True, eq=False)
class MotionResponse:
    """Tangent system along a free run: from terms at M points to whitened outputs.

    Terms are those in all equations and outputs.

    `s_{k+1} = A_k s_k + h/2 (A_k t_k + t_{k+1})`, `y_k = C_k s_k + o_k` for terms t in the
    equations and o in the outputs, h the sampling time; A, `steps`, and C, `outputs`, are
    derivatives of the fitted motion. A segment of training starts anew, from a state that was
    estimated beside everything else: `begins` (M,) marks where.
    """

    steps: Float[np.ndarray, "M nx nx"]
    outputs: Float[np.ndarray, "M ny nx"]
    begins: Float[np.ndarray, "M"]
    weight: Matrix
    half: float
    """h/2; 0 of a discrete motion, where a term acts on the next state."""
    entries: Float[np.ndarray, "M nx nx"]
    """How terms in the equations enter the rates."""

    @classmethod
    def of(
        cls,
        form: MotionDynamics,
        numbers: Numbers,
        x: Matrix,
        u: Matrix,
        rows: Matrix,
        begins: np.ndarray,
        weight: Matrix,
    ) -> MotionResponse:
        """Return the system along states x (M, nx) and inputs u (M, nu), with the steps' rows."""
        steps, outputs = (np.asarray(part) for part in _derivatives(form, numbers, x, u, rows))
        half = 0.0 if form.motion.scheme.discrete else form.sampling_time / 2
        entries = form.motion.mass.entries(x, np.asarray(form.parameters(numbers)))
        steps, outputs = np.nan_to_num(steps), weight @ np.nan_to_num(outputs)
        return cls(steps, outputs, begins, weight, half, np.nan_to_num(entries))

    def forward(self, terms: Float[np.ndarray, "M n k"]) -> Float[np.ndarray, "R k"]:
        """Return outputs for terms in all equations and then all outputs (n = nx + ny)."""
        count, nx, _ = self.steps.shape
        moved, direct = (
            self.entries @ terms[:, :nx],
            np.einsum("oi,mik->mok", self.weight, terms[:, nx:]),
        )
        s, found = np.zeros((nx, terms.shape[2])), np.zeros_like(direct)
        for k in range(count):
            if self.begins[k]:
                s = np.zeros_like(s)
            elif self.half:
                s = self.steps[k - 1] @ (s + self.half * moved[k - 1]) + self.half * moved[k]
            else:
                s = self.steps[k - 1] @ s + moved[k - 1]
            found[k] = self.outputs[k] @ s + direct[k]
        return found.reshape(-1, terms.shape[2])

    def adjoint(self, values: Float[np.ndarray, "R k"]) -> Float[np.ndarray, "M n k"]:
        """Return the transpose of `forward`."""
        count, nx, _ = self.steps.shape
        w = values.reshape(count, -1, values.shape[1])
        direct = np.einsum("oi,mok->mik", self.weight, w)
        found = np.zeros((count, nx, w.shape[2]))
        back = np.zeros(found.shape[1:])  # what the state does from the next row on
        for k in range(count - 1, -1, -1):
            along = self.steps[k].T @ back
            here = self.outputs[k].T @ w[k] + along
            found[k] = self.half * along if self.half else back
            if self.begins[k]:
                back = np.zeros_like(back)
            else:
                found[k] += self.half * here
                back = here
        return np.concatenate([self.entries.swapaxes(1, 2) @ found, direct], axis=1)

    def starts(self) -> Float[np.ndarray, "R s"]:
        """Return the effect of the states at the beginning of each segment."""
        count, nx, _ = self.steps.shape
        places = np.flatnonzero(self.begins)
        found = np.zeros((count, self.outputs.shape[1], nx * len(places)))
        for i, begin in enumerate(places):
            end, s = (places[i + 1] if i + 1 < len(places) else count), np.eye(nx)
            for k in range(begin, end):
                found[k, :, i * nx : (i + 1) * nx] = self.outputs[k] @ s
                s = self.steps[k] @ s
        return found.reshape(-1, found.shape[2])


@partial(jax.jit, static_argnames="form")
def _derivatives(
    form: MotionDynamics, numbers: Numbers, x: Array, u: Array, rows: Array
) -> tuple[Array, Array]:
    """Return ∂(next state)/∂x and ∂y/∂x at points."""
    numbers = form.prepare(numbers)
    steps = jax.vmap(lambda x, row: jax.jacfwd(lambda s: form.step(numbers, s, row)[0])(x))(x, rows)
    return steps, jax.vmap(lambda x, u: jax.jacfwd(lambda s: form.observed(numbers, s, u))(x))(x, u)


@dataclass(frozen=True, eq=False)
class Response:
    """A motion's linear map, for terms in learned equations and outputs only."""

    linear: MotionResponse
    learned: tuple[int, ...]
    equations: int

    def forward(self, columns: Float[np.ndarray, "P *k"]) -> np.ndarray:
        """Return whitened outputs for columns over all points and places."""
        single = columns.ndim == 1
        table = columns.reshape(-1, len(self.learned), 1 if single else columns.shape[1])
        terms = np.zeros((len(table), self.equations, table.shape[2]))
        terms[:, list(self.learned)] = table
        found = self.linear.forward(terms)
        return found[:, 0] if single else found

    def adjoint(self, values: Float[np.ndarray, "R k"]) -> Float[np.ndarray, "P k"]:
        """Return the transpose."""
        return _stack(self.linear.adjoint(values)[:, list(self.learned)])


_OF_FORM: dict[type, Callable[[Any, Record], LearnedLinearization]] = {
    LaggedDynamics: _of_lagged,
    MotionDynamics: _of_motion,
}


class _Run(NamedTuple):
    """States, inputs, and the rows that steps read, along free runs where they have values.

    Where segments begin.
    """

    x: Matrix
    u: Matrix
    rows: Matrix
    begins: np.ndarray

    @classmethod
    def of(cls, model: Model[MotionDynamics], record: Record) -> _Run:
        """Return the run of a record, of a long one over its first rows."""
        states = model.states(record, initial="measured" if record.outputs else "zero")
        states = states[list(model.form.motion.names_of_states)].to_numpy()
        length = model.trained.segment if model.trained is not None else 0
        left, begin, pieces = MOST_CELLS // len(model.outputs), 0, []
        for experiment in record.experiments:
            x = states[begin : begin + len(experiment)]
            begin += len(experiment)
            whole = len(x) if np.isfinite(x).all() else int(np.argmin(np.isfinite(x).all(axis=1)))
            whole = min(whole, left)
            left -= whole
            rows = model.form.inputs(experiment, record)[:whole]
            starts = np.arange(whole) % (length or max(whole, 1)) == 0
            read = model.form.at_samples(model.numbers, x[:whole], rows)
            pieces.append((x[:whole], read, rows, starts))
        return cls(*(np.concatenate(part) for part in zip(*pieces, strict=True)))


def _stack(values: Float[np.ndarray, "M n *k"]) -> np.ndarray:
    """Return all points and places below each other."""
    return values.reshape(values.shape[0] * values.shape[1], *values.shape[2:])


def _places(model: Model[MotionDynamics]) -> tuple[tuple[str, str], ...]:
    """Return name and unit of every learned equation, by its state, and of every learned output."""
    motion = model.form.motion
    states, outputs = motion.learned
    forces = [motion.mass.label(i) for i in states]
    names = [
        *(
            motion.states[i].name if force is None else force[0]
            for i, force in zip(states, forces, strict=True)
        ),
        *(motion.outputs[i].name for i in outputs),
    ]
    units = [unit for _, unit in labels_of(model.form)][: len(states)] + [
        model.outputs[i].unit for i in outputs
    ]
    return tuple(zip(names, units, strict=True))


def _move_parameters(motion: Motion, q: Vector, along: Vector, x: Matrix, u: Matrix) -> Vector:
    """Return the parameters after a step of their coordinates q (np,), along a straight line.

    A step of logarithms where that would end at a zero that the equations divide by.
    """
    coordinates = motion.coordinates
    low, high = ([getattr(p, end) for p in motion.parameters] for end in ("min", "max"))
    p = np.clip(coordinates.physical(q) + coordinates.slopes(q) * along, low, high)
    if np.isfinite(jax.vmap(lambda x, u: motion.rates(x, u, p, jnp))(x, u)).all():
        return p
    return np.asarray(coordinates.physical(np.clip(q + along, *coordinates.bounds)))


def _rates_of_change(outputs: Sequence[str], seen: Sequence[str]) -> list[str]:
    """Return the velocity of each output of which the learner reads two successive lags."""
    found = []
    for name in outputs:
        lags = [lag for lag in range(1, len(seen) + 2) if f"{name}[k-{lag}]" in seen]
        pair = next((lag for lag in lags if lag + 1 in lags), None)
        if pair is not None:
            found.append(f"({name}[k-{pair}] - {name}[k-{pair + 1}])/{SAMPLING_TIME}")
    return found


def _share_beyond(model: Model, z: Matrix) -> float:
    """Return the share of the points with a feature outside its training range."""
    if not model.form.bound.differentiable or not len(z):
        return 0.0
    return float(np.mean(model.beyond(z)))


def _tangent(model: Model, z: Matrix, weight: Matrix, response: Response | None) -> Tangent | None:
    """Return the learner's derivatives at its features z (M, nz)."""
    bound, numbers, statistics = model.form.bound, model.numbers, model.statistics
    if not bound.differentiable or numbers.tilt is not None or not 0 < bound.size <= MOST_WEIGHTS:
        return None
    w, gain = np.asarray(numbers.weights), weight * np.asarray(numbers.gain)
    scaled = (z - np.asarray(numbers.centre)) / np.asarray(numbers.halfwidth)
    slopes = jax.jit(jax.vmap(jax.jacrev(bound.values), in_axes=(None, 0)))(w, scaled)
    jacobian = np.einsum("oi,miw->mow", gain, np.asarray(slopes)).reshape(-1, len(w))
    jacobian = jacobian if response is None else response.forward(jacobian)
    ridge: Any = np.asarray(statistics.ridge)
    if statistics.gram is not None:  # over other rows, of which there may be more or fewer
        there = float(np.trace(statistics.gram[len(model.theta) :, len(model.theta) :]))
        ridge = ridge * (float(np.sum(jacobian**2)) / there if there > 0 else 1.0)
    return Tangent(jacobian, w, ridge, statistics.joint(len(model.theta)))
