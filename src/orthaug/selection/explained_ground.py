"""What is to be explained: a learner's output over data, beside the directions of the physics that it shares.

Of a lagged model over the rows of a record, of a motion over the states and inputs of its free run there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.jax import jax
from orthaug.data.expressions import SAMPLING_TIME, Expression, parse, parse_named
from orthaug.data.record import Record
from orthaug.data.regressors import lag_matrix, stack_rows
from orthaug.inference.motion_split import shared_of_motion, slopes_at
from orthaug.models.model import Model
from orthaug.models.motion_model import MotionModel
from orthaug.models.motion_parts import labels_of, parts_at
from orthaug.models.statistics import JointCovariance
from orthaug.physics.baseline import Baseline, Parameter
from orthaug.physics.motion import Motion
from orthaug.physics.parameters import PhysicalParameter

MOST_CELLS = 10_000
"""Values of the learner that are looked at: a smooth function needs no more, and candidates are kept beside them."""
FEWEST = 20  # of them
MOST_WEIGHTS = 2000  # of a learner whose tangent is looked at
_WITHIN = 1e-9  # of a feature's half width: the largest of training is no extrapolation


class Tangent(NamedTuple):
    """The learner's derivatives by its weights w over the points, whitened, and what training left of the weights."""

    jacobian: Float[np.ndarray, "R nw"]
    weights: Vector
    ridge: float | Vector
    joint: JointCovariance | None


@dataclass(frozen=True, eq=False)
class Ground:
    """The learner over M points in nl outputs or equations (`places`: name and unit).

    `target` is the learner in their units, `slopes` the physics' derivatives along the directions that are shared;
    `weight` (nl, nl) whitens a row. `outside` is the share of the points beyond the training data.
    """

    target: Float[np.ndarray, "M nl"]
    slopes: Float[np.ndarray, "M nl s"]
    weight: Matrix
    places: tuple[tuple[str, str], ...]
    signals: tuple[str, ...]
    """What the learner sees, as expressions, and rates of change that follow from it."""
    seen: int
    """How many of the signals the learner sees as they stand."""
    units: dict[str, str]
    parse: Callable[[str], Expression]
    evaluate: Callable[[Expression], Any]
    moved: Callable[[Vector], Vector]
    """The parameters when the physics moves by (s,) along the shared directions."""
    parameters: Sequence[Parameter] | Sequence[PhysicalParameter]
    values: Vector
    physics: Baseline | Motion
    tangent: Tangent | None
    """None of an opaque learner, and of one with very many weights."""
    outside: float

    def column(self, expression: Expression, place: int) -> Vector:
        """A term with coefficient 1, whitened, all points and places below each other (M·nl,)."""
        with np.errstate(all="ignore"):
            values = np.broadcast_to(np.asarray(self.evaluate(expression), dtype=float), (len(self.target),))
        return (values[:, None] * self.weight[:, place]).ravel()

    def whitened(self, values: Float[np.ndarray, "M nl *k"]) -> np.ndarray:
        """Values with all points and places below each other (M·nl, …)."""
        white = np.einsum("oi,mi...->mo...", self.weight, values)
        return white.reshape(white.shape[0] * white.shape[1], *white.shape[2:])


def ground_of(model: Model | MotionModel, record: Record) -> Ground:
    """The learner of a model over a record.

    Raises:
        InputError: a model without a learner, other channels, too few rows, or none with a value.
    """
    if model.form.bound is None:
        raise InputError("the model is physics alone: it has no learner that could be explained.")
    ground = _of_motion(model, record) if isinstance(model, MotionModel) else _of_lagged(model, record)
    if len(ground.target) < FEWEST:
        raise InputError(
            f"the learner has a value at {len(ground.target)} rows of the data; at least {FEWEST} are needed."
        )
    return ground


def _of_lagged(model: Model, record: Record) -> Ground:
    form, numbers = model.form, model.numbers
    if form.states and not record.outputs:
        names = ", ".join(channel.name for channel in model.outputs)
        raise InputError(f"the data have no {names}: the learner is evaluated at measured outputs.")
    record = model.fitting(record, need_outputs=bool(form.states))
    x = (
        stack_rows(record, form.layout).x
        if record.outputs
        else np.concatenate([lag_matrix(e, form.layout, record, form.first_row) for e in record.experiments])
    )
    x = x[:: max(1, -(-len(x) * len(form.outputs) // MOST_CELLS))]
    with np.errstate(all="ignore"):
        target = model.learner_at(x) if len(x) else np.zeros((0, len(form.outputs)))
        phi = np.asarray(form.baseline.phi(x, form.layout, form.outputs, np))
        z = np.asarray(form.features.evaluate(x, form.layout, np))
    finite = np.isfinite(target).all(axis=1) & np.isfinite(phi).all(axis=(1, 2)) & np.isfinite(z).all(axis=1)
    x, target, phi, z = x[finite], target[finite], phi[finite], z[finite]
    constants = {SAMPLING_TIME: model.sampling_time} | dict(form.baseline.constants)
    for entry in form.features.entries:
        constants |= dict(entry.constants)
    columns = {lag: x[:, j] for j, lag in enumerate(form.layout)}
    own = tuple(dict.fromkeys(str(entry) for entry in form.features.entries))
    c = model.theta - model.theta_aux
    return Ground(
        target=target,
        slopes=phi,
        weight=np.asarray(model.weight),
        places=tuple((channel.name, channel.unit) for channel in model.outputs),
        signals=(*own, *_rates_of_change(form.outputs, own)),
        seen=len(own),
        units={channel.name: channel.unit for channel in (*model.outputs, *model.inputs)} | {SAMPLING_TIME: "s"},
        parse=lambda text: parse(text, constants),
        evaluate=lambda expression: expression.evaluate(columns, np),
        moved=lambda along: c + along,
        parameters=form.baseline.parameters,
        values=model.theta,
        physics=form.baseline,
        tangent=_tangent(model, z, np.asarray(model.weight)),
        outside=_beyond(model, z),
    )


def _of_motion(model: MotionModel, record: Record) -> Ground:
    form, numbers, motion = model.form, model.numbers, model.form.motion
    record = model.fitting(record, need_outputs=False)
    states = model.states(record, initial="measured" if record.outputs else "zero")
    x = states[list(motion.names_of_states)].to_numpy()
    u = np.concatenate([experiment.inputs for experiment in record.experiments])
    every = max(1, -(-len(x) * len(labels_of(form)) // MOST_CELLS))
    x, u = x[::every], u[::every]
    with np.errstate(all="ignore"):
        physics, target = parts_at(form, numbers, x, u)
        z = np.asarray(form.seen(x.T, u.T, np)).T
        slopes = np.asarray(slopes_at(form, model.theta, x, u))
    learned = [*motion.learned[0], *(len(motion.states) + i for i in motion.learned[1])]
    slopes = slopes[:, learned]
    finite = np.isfinite(physics + target).all(axis=1) & np.isfinite(slopes).all(axis=(1, 2))
    finite &= np.isfinite(z).all(axis=1)
    x, u, z, target, slopes, physics = (part[finite] for part in (x, u, z, target, slopes, physics))
    basis = shared_of_motion(form, model.theta, x, u).basis if len(x) else np.zeros((len(model.theta), 0))
    size = np.std(physics + target, axis=0) if len(x) else np.ones(len(learned))
    weight = np.diag(1 / np.where(size > 0, size, 1.0))
    coordinates = motion.coordinates
    known = motion.values(x.T, u.T, coordinates.physical(model.theta), np)
    own = tuple(dict.fromkeys(str(entry) for entry in form.features))
    low, high = coordinates.bounds
    units = {channel.name: channel.unit for channel in (*model.outputs, *model.inputs)}
    units |= {parameter.name: parameter.unit for parameter in motion.parameters}
    return Ground(
        target=target,
        slopes=slopes @ basis,
        weight=weight,
        places=_places(model),
        signals=own,
        seen=len(own),
        units=units | {state.name: state.unit for state in motion.states} | {SAMPLING_TIME: "s"},
        parse=lambda text: parse_named(text, motion.known, "the term"),
        evaluate=lambda expression: expression.value(known, np),
        moved=lambda along: np.asarray(coordinates.physical(np.clip(model.theta + basis @ along, low, high))),
        parameters=coordinates.parameters,
        values=np.asarray(coordinates.physical(model.theta)),
        physics=motion,
        tangent=_tangent(model, z, weight),
        outside=_beyond(model, z),
    )


def _places(model: MotionModel) -> tuple[tuple[str, str], ...]:
    """Name and unit of every learned equation, by its state, and of every learned output."""
    motion = model.form.motion
    states, outputs = motion.learned
    names = [motion.states[i].name for i in states] + [motion.outputs[i].name for i in outputs]
    units = [unit for _, unit in labels_of(model.form)][: len(states)] + [model.outputs[i].unit for i in outputs]
    return tuple(zip(names, units, strict=True))


def _rates_of_change(outputs: Sequence[str], seen: Sequence[str]) -> list[str]:
    """The velocity of each output of which the learner sees two lags, one after the other."""
    found = []
    for name in outputs:
        lags = [lag for lag in range(1, len(seen) + 2) if f"{name}[k-{lag}]" in seen]
        pair = next((lag for lag in lags if lag + 1 in lags), None)
        if pair is not None:
            found.append(f"({name}[k-{pair}] - {name}[k-{pair + 1}])/{SAMPLING_TIME}")
    return found


def _beyond(model: Any, z: Matrix) -> float:
    """Share of the points at which a feature lies outside those of training."""
    if not model.form.bound.differentiable or not len(z):
        return 0.0
    scaled = (z - np.asarray(model.numbers.centre)) / np.asarray(model.numbers.halfwidth)
    return float(np.mean((np.abs(scaled) > 1 + _WITHIN).any(axis=1)))


def _tangent(model: Any, z: Matrix, weight: Matrix) -> Tangent | None:
    """The learner's derivatives at its features z (M, nz)."""
    bound, numbers, statistics = model.form.bound, model.numbers, model.statistics
    if not bound.differentiable or numbers.tilt is not None or not 0 < bound.size <= MOST_WEIGHTS:
        return None
    w, gain = np.asarray(numbers.weights), weight * np.asarray(numbers.gain)
    scaled = (z - np.asarray(numbers.centre)) / np.asarray(numbers.halfwidth)
    slopes = jax.jit(jax.vmap(jax.jacrev(bound.values), in_axes=(None, 0)))(w, scaled)
    jacobian = np.einsum("oi,miw->mow", gain, np.asarray(slopes)).reshape(-1, len(w))
    ridge: Any = np.asarray(statistics.ridge)
    if statistics.gram is not None:  # over other rows, of which there may be more or fewer
        there = float(np.trace(statistics.gram[len(model.theta) :, len(model.theta) :]))
        ridge = ridge * (float(np.sum(jacobian**2)) / there if there > 0 else 1.0)
    return Tangent(jacobian, w, ridge, statistics.joint(len(model.theta)))
