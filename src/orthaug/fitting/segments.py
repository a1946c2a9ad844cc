"""The free-run criterion: error of the model's own outputs over segments, with its sensitivities.

A segment starts from its past, the outputs before its first step, and then lives on its own outputs; its first steps,
the washout, are not scored. With `G_k = ∂g/∂(c, w)` and `A_{k,i} = ∂g/∂ŷ_{k−i}` the sensitivities of the free run obey
`S_k = G_k + Σ_i A_{k,i} S_{k−i}`, and those in the past the same without G. One scan carries outputs, sensitivities and
the Gram matrix of `[S r]` together, so that nothing of size N × n_w ever exists.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from orthaug._base.jax import jax, jnp
from orthaug.data.record import Record
from orthaug.data.regressors import lag_matrix
from orthaug.models.predictor import Form, Numbers, parts, push, regressor
from orthaug.models.rows import gram

_CHUNK = 256  # segments that run side by side


class Segments(NamedTuple):
    """Segments of T steps in chunks of m, the segment as the last axis; steps that are not scored may be padding."""

    past: Float[Any, "k na ny m"]
    """Measured outputs before the first step, newest first."""
    inputs: Float[Any, "k T nu m"]
    """Lagged inputs of every step."""
    target: Float[Any, "k T ny m"]
    scored: Bool[Any, "k T m"]

    @property
    def count(self) -> int:
        """Number of scored steps."""
        return int(np.sum(np.asarray(self.scored)))


def lay_segments(record: Record, form: Form, segment: int, washout: int) -> Segments:
    """Segments of `segment` steps, 0 for whole experiments; each begins where the washout of the next one would.

    So every usable row is scored once, except the first `washout` of each experiment.
    """
    usable = [len(experiment) - form.start for experiment in record.experiments]
    steps = min(segment, max(usable)) if segment else max(usable)
    washout = min(washout, steps - 1)
    pieces = []
    for experiment, rows in zip(record.experiments, usable, strict=True):
        inputs = lag_matrix(experiment, form.input_layout, record, form.start)
        begins = [b for b in range(0, rows, steps - washout) if b == 0 or b + washout < rows]
        for begin in begins:
            pieces.append(_segment(experiment.outputs, inputs, begin, steps, washout, form))
    count = len(pieces)
    chunks = -(-count // _CHUNK)
    width = -(-count // chunks)
    width += -width % 8 if width > 8 else 0  # about as many segments run by the same program
    nothing = Segments(*(np.zeros_like(part) for part in pieces[0]))
    pieces += [nothing] * (chunks * width - count)
    stacked = (np.stack(part, axis=-1) for part in zip(*pieces, strict=True))
    cut = (np.moveaxis(part.reshape(*part.shape[:-1], chunks, width), -2, 0) for part in stacked)
    return Segments(*(jnp.asarray(part) for part in cut))


def _segment(outputs: Any, inputs: Any, begin: int, steps: int, washout: int, form: Form) -> Segments:
    """One segment, its end repeated where the experiment is shorter."""
    rows = np.arange(begin, begin + steps)
    there = np.minimum(rows, len(inputs) - 1)
    first = form.start + begin
    past = outputs[first - form.memory : first][::-1]
    scored = (rows < len(inputs)) & (rows >= begin + washout)
    return Segments(past, inputs[there], outputs[form.start + there], scored)


@partial(jax.jit, static_argnames="form")
def respond(
    form: Form, numbers: Numbers, segments: Segments, past: Float[Array, "k na ny m"]
) -> Float[Array, "k T ny m"]:
    """Free run of every segment from its past."""
    one = jax.vmap(partial(_step, form, numbers), in_axes=-1, out_axes=-1)

    def step(past: Any, inputs: Any) -> tuple[Any, Any]:
        value = one(past, inputs)
        return push(past, value), value

    return jax.lax.map(lambda chunk: jax.lax.scan(step, *chunk)[1], (past, segments.inputs))


def _step(form: Form, numbers: Numbers, past: Any, inputs: Any) -> Any:
    found = parts(form, numbers, regressor(form, past, inputs))
    return found.baseline + found.learner


class Sensitivity(NamedTuple):
    """Gram matrices over the scored steps; columns are the pasts' entries (n0), then c and w (n), then the error."""

    shared: Float[Array, "n+1 n+1"]
    """Of `[S_c S_w r]`, over all segments."""
    own: Float[Array, "k n0 n0+n+1 m"]
    """Of the past's sensitivities with all columns, of every segment by itself."""


@partial(jax.jit, static_argnames="form")
def sensitivity(
    form: Form,
    numbers: Numbers,
    segments: Segments,
    past: Float[Array, "k na ny m"],
    weight: Float[Array, "ny ny"],
) -> Sensitivity:
    """Gram matrices of the sensitivities `∂ŷ/∂(past, c, w)` and the error, rows multiplied by `weight`."""
    explicit = jax.vmap(partial(_derivatives, form, numbers), in_axes=-1, out_axes=-1)
    _, na, ny, width = segments.past.shape
    n0, n = na * ny, len(form.baseline.names) + (form.bound.size if form.bound else 0)
    first = jnp.broadcast_to(jnp.eye(n0, n0 + n).reshape(na, ny, n0 + n, 1), (na, ny, n0 + n, width))

    def step(carry: tuple[Any, ...], row: tuple[Any, ...]) -> tuple[Any, None]:
        past, slopes, shared, own = carry
        inputs, target, scored = row
        value, slope, feedback = explicit(past, inputs)  # (ny, m), (ny, n, m), (ny, lags, m)
        slope = jnp.pad(slope, ((0, 0), (n0, 0), (0, 0)))
        for i, (lag, output) in enumerate(form.fed_back):
            slope = slope + feedback[:, i, None] * slopes[lag - 1][output]
        columns = jnp.where(scored, jnp.concatenate([slope, (target - value)[:, None]], axis=1), 0.0)
        columns = jnp.einsum("oi,inm->onm", weight, columns) if ny > 1 else weight[0, 0] * columns
        shared = shared + sum(gram(one[n0:]) for one in columns)
        own = own + sum(one[:n0, None] * one[None] for one in columns)
        return (push(past, value), (slope, *slopes[:-1]) if na else slopes, shared, own), None

    def one_chunk(total: Any, chunk: tuple[Any, ...]) -> tuple[Any, Any]:
        past, inputs, target, scored = chunk
        start = (past, tuple(first), jnp.zeros((n + 1, n + 1)), jnp.zeros((n0, n0 + n + 1, width)))
        _, _, shared, own = jax.lax.scan(step, start, (inputs, target, scored))[0]
        return total + shared, own

    rows = (past, segments.inputs, segments.target, segments.scored)
    return Sensitivity(*jax.lax.scan(one_chunk, jnp.zeros((n + 1, n + 1)), rows))


def _derivatives(form: Form, numbers: Numbers, past: Any, inputs: Any) -> tuple[Any, Any, Any]:
    """Value (ny,), ∂g/∂(c, w) (ny, n) and ∂g/∂ŷ of every lag that is fed back (ny, lags), at one step."""
    leaves = [] if form.bound is None else form.bound.leaves(numbers.weights)

    def predict(c: Any, leaves: list[Any], past: Any) -> Any:
        return _step(form, numbers._replace(theta=c, weights=leaves), past, inputs)

    value, pullback = jax.vjp(predict, numbers.theta, leaves, past)
    slopes, feedback = [], []
    for seed in jnp.eye(len(form.outputs)):
        to_c, to_leaves, to_past = pullback(seed)
        slopes.append(jnp.concatenate([to_c, *(jnp.ravel(leaf) for leaf in to_leaves)]))
        feedback.append(jnp.stack([to_past[lag - 1, output] for lag, output in form.fed_back] or [jnp.zeros(())]))
    # a kink without a derivative, such as sqrt(max(y, 0)) at 0, counts as flat
    slope, back = (jnp.where(jnp.isfinite(d), d, 0.0) for d in (jnp.stack(slopes), jnp.stack(feedback)))
    return value, slope, back
