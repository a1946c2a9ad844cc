"""The step of a model, from outside: what a run visits, derivatives there, and runs side by side.

Nothing else of the stability checks knows how a model keeps its past. Here the state is that of the lagged form,
`s_k = (y_{k−1}, …, y_{k−na})`; a small change of it obeys `δs_{k+1} = A_k δs_k` in a free run, and the companion matrix
A_k has `A_{k,i} = ∂g/∂y_{k−i}` in its first ny rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.jax import Array, jax, jnp
from orthaug.analysis.visited import Visited, positive
from orthaug.data.record import Record
from orthaug.data.regressors import lag_matrix
from orthaug.models.dynamics import Numbers
from orthaug.models.lagged import Lagged
from orthaug.models.model import Model
from orthaug.models.response import Response

SIDE_BY_SIDE = 16  # runs of one compiled call
_RUNAWAY = 1e6  # times the largest training output, as in `Model.simulate`: beyond, a free run has diverged
_BATCH = 1024  # rows per compiled call
_NO_DERIVATIVE = 1e100  # a derivative beyond is none


def state_size(model: Model) -> int:
    """How many numbers a free run keeps from one step to the next, na ny; 0 for a model without past outputs."""
    return model.form.memory * len(model.outputs)


def first_row(model: Model) -> int:
    """The first row of an experiment that can be predicted."""
    return model.form.first_row


def in_state(model: Model, per_output: Vector) -> Vector:
    """A number per output (ny,) for every entry of the state (na ny,)."""
    return np.tile(per_output, model.form.memory)


def _fitting(model: Model, record: Record, need_outputs: bool = True) -> Record:
    """The record's channels in the model's order; InputError where an experiment has too few rows."""
    record = model.fitting(record, need_outputs=need_outputs)
    for experiment in record.experiments:
        if len(experiment) <= model.form.first_row:
            name = experiment.source or "the record"
            raise InputError(
                f"{name} has {len(experiment)} rows, too few: the first value is at row {model.form.first_row}."
            )
    return record


def visited_by(model: Model, record: Record, free_run: Response) -> tuple[Visited, Vector, tuple[str, ...]]:
    """Regressors of a free run up to where it diverged; deviations of the measured outputs (ny,); where that was."""
    start, channels = model.form.first_row, replace(record, outputs=model.outputs)
    runs, measured, diverged = [], [], []
    for i, (e, t) in enumerate(zip(record.experiments, free_run.trajectories, strict=True)):
        assert t.measured is not None  # a record without outputs was refused
        outputs = np.concatenate([t.measured[:start], t.model[start:]])
        run = replace(e, outputs=outputs).rows(None, t.diverged[0] + 1 if t.diverged else None)
        runs.append(lag_matrix(run, model.form.layout, channels, start))
        measured.append(t.measured)
        diverged += [f"{t.diverged[1]} at experiment {i}, {e.where(t.diverged[0])}"] if t.diverged else []
    return _numbered(model, runs), positive(np.concatenate(measured).std(axis=0)), tuple(diverged)


def measured_by(model: Model, record: Record, x: Matrix | None = None) -> tuple[Visited, Vector]:
    """Regressors of measured outputs, `x` (N, nx) if they are stacked already; deviations of these outputs (ny,)."""
    record, start = _fitting(model, record), model.form.first_row
    if x is None:
        runs = [lag_matrix(e, model.form.layout, record, start) for e in record.experiments]
    else:
        wanted = sum(len(e) - start for e in record.experiments), len(model.form.layout)
        if np.shape(x) != wanted:
            raise InputError(f"`x` has shape {np.shape(x)}; the usable regressors of the record have {wanted}.")
        runs = np.split(x, np.cumsum([len(e) - start for e in record.experiments])[:-1])
    outputs = np.concatenate([e.outputs for e in record.experiments])
    return _numbered(model, runs), positive(outputs.std(axis=0))


def _numbered(model: Model, runs: Sequence[Matrix]) -> Visited:
    """The regressors of every experiment, from its first usable row on."""
    rows = [np.arange(len(x)) + model.form.first_row for x in runs]
    experiments = [np.full(len(x), i) for i, x in enumerate(runs)]
    names = tuple(map(str, model.form.layout))
    return Visited(names, np.concatenate(runs), np.concatenate(experiments), np.concatenate(rows))


def linearised(model: Model, visited: Visited) -> tuple[Visited, Float[np.ndarray, "m na ny ny"], Vector]:
    """The regressors with finite derivatives, A_{k,i} at [k, i − 1] there, and the spectral radii of A_k (m,)."""
    ny = len(model.outputs)
    jacobians = np.zeros((len(visited), model.form.memory, ny, ny))
    if len(visited):
        slopes = np.concatenate(list(gradients(model, visited.x)))
        for column, (lag, output) in enumerate(model.form.fed_back):
            jacobians[:, lag - 1, :, output] = slopes[:, :, column]
    finite = (np.abs(jacobians) < _NO_DERIVATIVE).all(axis=(1, 2, 3))
    radius = np.abs(np.linalg.eigvals(companions(jacobians[finite]))).max(axis=1, initial=0.0)
    return visited.take(finite), jacobians[finite], radius


def companions(jacobians: Float[np.ndarray, "m na ny ny"]) -> Float[np.ndarray, "m n n"]:
    """A_k of A_{k,i} at [k, i − 1], n = na ny."""
    m, na, ny, _ = jacobians.shape
    shift = np.broadcast_to(np.eye(na * ny)[: (na - 1) * ny], (m, (na - 1) * ny, na * ny))
    return np.concatenate([jacobians.swapaxes(1, 2).reshape(m, ny, na * ny), shift], axis=1)


def physics_at(model: Model, x: Matrix) -> Float[np.ndarray, "m ny nt"]:
    """φ at regressors (m, nx)."""
    return np.asarray(model.form.baseline.phi(x, model.form.layout, model.form.outputs, np))


def gradients(model: Model, x: Matrix, of_phi: bool = False) -> Iterator[Any]:
    """∂g/∂x, or ∂φ/∂x, at regressors (m, nx), in batches that are computed at one shape."""
    width = 1e-3 * positive(x.std(axis=0))  # bears a learner in single precision
    for begin in range(0, len(x), _BATCH):
        rows = x[begin : begin + _BATCH]
        padded = np.concatenate([rows, np.repeat(rows[-1:], _BATCH - len(rows), axis=0)])
        yield np.asarray(_gradient_rows(model.form, model.numbers, padded, width, of_phi))[: len(rows)]


@partial(jax.jit, static_argnames=("form", "of_phi"))
def _gradient_rows(form: Lagged, numbers: Numbers, x: Float[Array, "m nx"], width: Any, of_phi: bool) -> Array:
    """∂g/∂x (m, ny, nx), by differences of `width` (nx,) where a learner has no derivative; or ∂φ/∂x."""

    def g(row: Any) -> Any:
        return form.at(numbers, row).total

    def differences(row: Any) -> Any:
        aside = jnp.diag(width)
        return ((jax.vmap(g)(row + aside) - jax.vmap(g)(row - aside)) / (2 * width[:, None])).T

    if of_phi:
        return jax.vmap(jax.jacfwd(lambda row: form.baseline.phi(row, form.layout, form.outputs, jnp)))(x)
    external = form.bound is not None and not form.bound.differentiable
    return jax.vmap(differences if external else jax.jacrev(g))(x)


def diverging(model: Model, record: Record, factors: Sequence[float]) -> Bool[np.ndarray, "f"]:
    """Whether the free run diverges with the inputs' deviations from their means times each of up to 16 factors.

    The runs start from the measured outputs of each experiment and go side by side.

    Raises:
        InputError: a record that does not fit the model, or has no outputs to start from.
    """
    if not record.outputs:
        raise InputError("the record has no measured outputs to start from; give those of its first rows.")
    record, form = _fitting(model, record), model.form
    mean = np.concatenate([e.inputs for e in record.experiments]).mean(axis=0)
    at = {channel.name: i for i, channel in enumerate(record.inputs)}
    lagged_mean = mean[[at[lag.channel] for lag in form.input_layout]]
    scales = np.concatenate([factors, np.repeat(factors[:1], SIDE_BY_SIDE - len(factors))])
    wild = np.zeros(SIDE_BY_SIDE, dtype=bool)
    for experiment in record.experiments:
        if wild.all():
            break
        inputs = form.inputs(experiment, record)
        state = form.start(experiment.outputs, [form.first_row])[0]
        padded = np.zeros((max(256, 1 << (len(inputs) - 1).bit_length()), inputs.shape[1]))  # few programs
        padded[: len(inputs)] = inputs
        bound = _RUNAWAY * model.largest_output
        run = form, model.numbers, state, padded, len(inputs)
        wild |= np.asarray(_side_by_side(*run, lagged_mean, scales, bound))
    return wild[: len(factors)]


@partial(jax.jit, static_argnames="form")
def _side_by_side(
    form: Lagged,
    numbers: Numbers,
    state: Float[Array, "n0"],
    inputs: Float[Array, "T nu"],
    steps: Any,
    mean: Float[Array, "nu"],
    factors: Float[Array, "f"],
    bound: Float[Array, "ny"],
) -> Bool[Array, "f"]:
    """Whether an output leaves `bound` within `steps` of free runs with the inputs `mean + factor (inputs − mean)`."""
    one = jax.vmap(lambda state, row: form.step(numbers, state, row))

    def going_on(carry: tuple[Any, Any, Any]) -> Any:
        return (carry[0] < steps) & ~carry[2].all()

    def step(carry: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
        k, states, wild = carry
        states, parts = one(states, mean + factors[:, None] * (inputs[k] - mean))
        return k + 1, states, wild | ~(jnp.abs(parts.total) <= bound).all(axis=1)

    states = jnp.broadcast_to(state, (len(factors), *state.shape))
    return jax.lax.while_loop(going_on, step, (0, states, jnp.zeros(len(factors), dtype=bool)))[2]
