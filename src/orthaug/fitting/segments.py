"""Free runs over segments, with their sensitivities.

A segment starts from a state and then lives on its own outputs. Its first steps, the washout, are
not scored. One scan carries states, sensitivities and the Gram matrix of `[S r]`, so that nothing
of size N × nw ever exists.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from orthaug._base.checks import Matrix
from orthaug._base.jax import AnyArray, Array, jax, jnp, quick_jit
from orthaug.data.record import Experiment, Record
from orthaug.models.dynamics import AutodiffDynamics, Dynamics, Numbers
from orthaug.models.rows import gram

CHUNK = 256  # segments that run side by side
_BLOCK = 1 << 17  # numbers: slopes that are known at once
_FEWEST = 8  # steps for which that pays
SHORT = 4096  # steps of all segments: a run takes milliseconds then, and to compile one a second
_LANES = 4  # segments side by side: fewer take as long, and have the same programs


class Segments(NamedTuple):
    """Segments of T steps in chunks of m; the last axis counts segments.

    Steps that are not scored may be padding. An output that was not measured at a scored step is
    NaN in `target`, and its error is 0.
    """

    start: Float[AnyArray, "k n0 m"]
    """The state before the first step, as it was measured."""
    inputs: Float[AnyArray, "k T nu m"]
    target: Float[AnyArray, "k T ny m"]
    scored: Bool[AnyArray, "k T m"]

    @property
    def count(self) -> int:
        """Number of scored steps."""
        return int(np.sum(np.asarray(self.scored)))

    @property
    def measured(self) -> Bool[np.ndarray, "k T ny m"]:
        """The outputs that were measured at scored steps."""
        return np.asarray(self.scored)[:, :, None] & ~np.isnan(np.asarray(self.target))

    @property
    def complete(self) -> Bool[np.ndarray, "k T m"]:
        """The scored steps at which every output was measured."""
        return np.asarray(self.measured.all(axis=2))

    @property
    def observations(self) -> Int[np.ndarray, "ny"]:
        """Number of scored steps at which each output was measured."""
        return self.measured.sum(axis=(0, 1, 3))

    @property
    def steps(self) -> int:
        """T."""
        return self.scored.shape[1]


def build_segments(
    record: Record,
    dynamics: Dynamics,
    segment: int,
    washout: int,
    like: Segments | None = None,
    shares: int = 1,
    longest: int = 0,
    lanes: int = _LANES,
) -> Segments:
    """Return segments of `segment` steps; 0 for whole experiments.

    The number of chunks is a multiple of `shares`. Small data are padded to `lanes` segments side
    by side, where that costs little, and whole experiments to `longest` steps.

    With `like` they are padded to its shape where they are fewer or shorter, so that the same
    programs run over them.

    The scored steps of a segment begin where those of the segment before it end. So every usable
    row is scored once, except the first `washout` of each experiment.
    """
    usable = [len(experiment) - dynamics.first_row for experiment in record.experiments]
    longest = max(*usable, longest, 0 if like is None else like.steps)
    steps = min(segment, longest) if segment else longest
    washout = min(washout, steps - 1)
    pieces = []
    for experiment, rows in zip(record.experiments, usable, strict=True):
        inputs = dynamics.inputs(experiment, record)
        begins = begins_of(rows, steps, washout)
        pieces += [
            segment_of(experiment, inputs, begin, steps, washout, dynamics) for begin in begins
        ]
    count = len(pieces)
    chunks = -(-count // (CHUNK * shares)) * shares
    width = -(-count // chunks)
    if steps * max(width, lanes) <= SHORT and width <= max(8, lanes):
        width = max(lanes, 1 << (width - 1).bit_length())  # others beside them cost nothing
    elif width > 8:  # about as many segments run by the same program
        width += -width % 8
    if like is not None and chunks * width <= like.scored.shape[0] * like.scored.shape[2]:
        chunks, width = like.scored.shape[0], like.scored.shape[2]
    nothing = Segments(*(np.zeros_like(part) for part in pieces[0]))
    pieces += [nothing] * (chunks * width - count)
    stacked = (np.stack(part, axis=-1) for part in zip(*pieces, strict=True))
    cut = (np.moveaxis(part.reshape(*part.shape[:-1], chunks, width), -2, 0) for part in stacked)
    return Segments(*map(jax.device_put, cut))


def packed(errors: Float[np.ndarray, "k T ny m"], segments: Segments) -> np.ndarray:
    """Return errors with those of measured outputs first, then zeros.

    Neighbours are then neighbours among what was measured. Where nothing is missing, they stay.
    """
    if not np.isnan(np.asarray(segments.target)).any():
        return errors
    order = np.argsort(~segments.measured, axis=1, kind="stable")
    return np.take_along_axis(errors, order, axis=1)


def few_lanes(steps: int) -> int:
    """Return how many segments of so many steps always run side by side; 0 for whole experiments.

    Records share the programs of short segments then.
    """
    return _LANES if not steps else max(_LANES, 1 << max(SHORT // steps, 1).bit_length() - 1)


def begins_of(rows: int, steps: int, washout: int) -> list[int]:
    """Return the first rows of the segments of an experiment."""
    return [
        begin for begin in range(0, rows, steps - washout) if begin == 0 or begin + washout < rows
    ]


def segment_of(
    experiment: Experiment, inputs: Matrix, begin: int, steps: int, washout: int, dynamics: Dynamics
) -> Segments:
    """Return one segment. Where the experiment is shorter, its last row is repeated."""
    rows = np.arange(begin, begin + steps)
    there = np.minimum(rows, len(inputs) - 1)
    first = dynamics.first_row + begin
    scored = (rows < len(inputs)) & (rows >= begin + washout)
    start = dynamics.start(experiment.outputs, [first])[0]
    return Segments(start, inputs[there], experiment.outputs[dynamics.first_row + there], scored)


@partial(jax.jit, static_argnames="dynamics")
def respond(
    dynamics: Dynamics, numbers: Numbers, segments: Segments, states: Float[Array, "k n0 m"]
) -> Float[Array, "k T ny m"]:
    """Return outputs of every segment from its state."""
    numbers = dynamics.prepare(numbers)
    return jax.lax.map(
        lambda chunk: chunk_response(dynamics, numbers, *chunk), (states, segments.inputs)
    )


def chunk_response(
    dynamics: Dynamics, numbers: Numbers, states: Array, inputs: Any
) -> Float[Array, "T ny m"]:
    """Return outputs of the segments of one chunk, of prepared numbers."""
    side_by_side = jax.vmap(partial(dynamics.step, numbers), in_axes=-1, out_axes=-1)

    def step(state: Array, inputs: Array) -> tuple[Any, Any]:
        state, parts = side_by_side(state, inputs)
        return state, parts.total

    return jax.lax.scan(step, states, inputs)[1]


class Sensitivity(NamedTuple):
    """Gram matrices over the scored steps.

    Columns: the entries of the start (n0), then c and w (n), then the error.
    """

    shared: Float[Array, "n+1 n+1"]
    """Of `[S_c S_w r]`, over all segments."""
    own: Float[Array, "k n0 n0+n+1 m"]
    """Of the columns of the start with all columns, for every segment by itself."""


@partial(jax.jit, static_argnames="dynamics")
def sensitivity(
    dynamics: Dynamics,
    numbers: Numbers,
    segments: Segments,
    states: Float[Array, "k n0 m"],
    weight: Float[Array, "ny ny"],
) -> Sensitivity:
    """Return Gram matrices of the sensitivities `∂ŷ/∂(start, c, w)` and the error.

    Rows are multiplied by `weight`.
    """
    numbers = dynamics.prepare(numbers)
    n = dynamics.unknowns

    def one_chunk(total: Array, chunk: tuple[AnyArray, ...]) -> tuple[Any, Any]:
        shared, own = chunk_sensitivity(dynamics, numbers, chunk, weight)
        return total + shared, own

    rows = (states, segments.inputs, segments.target, segments.scored)
    return Sensitivity(*jax.lax.scan(one_chunk, jnp.zeros((n + 1, n + 1)), rows))


def slopes_per_number(dynamics: Dynamics) -> int:
    """Return how many slopes a step computes for each number of its row, about."""
    return dynamics.unknowns * getattr(dynamics, "substeps", 1)


@partial(quick_jit, work=slopes_per_number, static_argnames="dynamics")
def sensitivity_once(dynamics: Dynamics, *given: Any) -> Sensitivity:
    """Return `sensitivity` of dynamics for which it is called once: its compilation counts."""
    return sensitivity(dynamics, *given)


def chunk_sensitivity(
    dynamics: Dynamics, numbers: Numbers, chunk: tuple[AnyArray, ...], weight: Any
) -> Sensitivity:
    """Return the Gram matrices of one chunk (states, inputs, target, scored)."""
    state, *rows = chunk
    n0, width = state.shape
    n = dynamics.unknowns
    at_once = steps_at_once(dynamics, width)
    blocks = isinstance(dynamics, AutodiffDynamics) and at_once >= _FEWEST
    advance = partial(_by_blocks, at_once) if blocks else _step_by_step
    nothing = (jnp.zeros((n + 1, n + 1)), jnp.zeros((n0, n0 + n + 1, width)))
    return Sensitivity(
        *advance(dynamics, numbers, (state, dynamics.first_slopes(width), *nothing), rows, weight)
    )


def steps_at_once(dynamics: Dynamics, width: int) -> int:
    """Return the steps of so many segments whose slopes are held at once; 0 without states."""
    n0 = dynamics.states
    rows = width * (n0 + len(dynamics.outputs)) * (n0 + dynamics.unknowns)
    return _BLOCK // rows if n0 else 0


def _columns(scored: Array, slope: Array, target: Array, value: Array, weight: Array) -> Array:
    """Return derivatives and error of scored steps side by side (ny, n0 + n + 1, …).

    Both are 0 where the output was not measured. Rows are multiplied by `weight`.
    """
    there = (scored & ~jnp.isnan(target))[:, None]
    columns = jnp.where(there, jnp.concatenate([slope, (target - value)[:, None]], axis=1), 0.0)
    return (
        jnp.einsum("oi,in...->on...", weight, columns)
        if len(weight) > 1
        else weight[0, 0] * columns
    )


def _step_by_step(
    dynamics: Dynamics, numbers: Numbers, carry: Any, rows: Any, weight: Array
) -> tuple[Any, Any]:
    """Return Gram matrices of one chunk, for dynamics that can carry derivatives.

    The columns of a block of steps are multiplied at once.
    """
    n0, width = dynamics.states, carry[0].shape[-1]
    size = _BLOCK // (width * len(dynamics.outputs) * (n0 + dynamics.unknowns + 1))

    def step(carry: tuple[Any, ...], row: tuple[Any, ...]) -> tuple[Any, Any]:
        state, slopes = carry
        inputs, target, scored = row
        state, slopes, value, slope = dynamics.tangents(numbers, state, slopes, inputs)
        return (state, slopes), _columns(scored, slope, target, value, weight)

    def block(carry: tuple[Any, ...], rows: tuple[object, ...]) -> tuple[Any, None]:
        *running, shared, own = carry
        running, columns = jax.lax.scan(step, tuple(running), rows)
        columns = jnp.moveaxis(columns, 0, -2)  # (ny, n0 + n + 1, size, width)
        shared, own = _with_sums(shared, own, columns, n0)
        return (*running, shared, own), None

    return jax.lax.scan(block, carry, cut_steps(rows, max(size, 1)))[0][2:]


def _with_sums(shared: Array, own: Array, columns: Array, n0: int) -> tuple[Array, Array]:
    """Return the Gram matrices with columns (ny, n0 + n + 1, steps, width) of further steps."""
    for output in columns:
        shared = shared + gram(output[n0:].reshape(len(shared), -1))
        own = own + (output[:n0, None] * output[None]).sum(axis=-2)
    return shared, own


def cut_steps(rows: Any, most: int, padding: str = "constant") -> tuple[Array, ...]:
    """Return rows (T, …) in blocks of at most so many steps, the last one padded.

    Args:
        padding: "constant", zeros, or "edge", the last row again.
    """
    steps = len(rows[0])
    count = -(-steps // most)
    size = -(-steps // count)
    padded = (
        jnp.pad(part, ((0, count * size - steps), *((0, 0),) * (part.ndim - 1)), padding)
        for part in rows
    )
    return tuple(part.reshape(count, size, *part.shape[1:]) for part in padded)


def _by_blocks(
    most: int, dynamics: Any, numbers: Numbers, carry: Any, rows: Any, weight: Array
) -> tuple[Any, Any]:
    """Return Gram matrices of one chunk, a block of steps at a time.

    A block is run first, then differentiated at all its points, which are then known.

    Only the product of the slopes has to go from step to step. A block is bounded, so nothing has
    the size of the data.
    """
    n0, width = dynamics.states, carry[0].shape[-1]
    side_by_side = jax.vmap(lambda state, row: dynamics.step(numbers, state, row)[0], -1, -1)

    def block(carry: tuple[Any, ...], rows: tuple[Any, ...]) -> tuple[Any, None]:
        state, slopes, shared, own = carry
        inputs, target, scored = rows
        size = len(inputs)
        state, states = jax.lax.scan(
            lambda state, row: (side_by_side(state, row), state), state, inputs
        )
        steps = dynamics.local(numbers, flatten_steps(states), flatten_steps(inputs))
        value, to_state, to_unknowns = (
            part.reshape(*part.shape[:-1], size, width) for part in steps
        )
        own_slopes = jnp.pad(to_unknowns, ((0, 0), (n0, 0), (0, 0), (0, 0)))
        by_step = (jnp.moveaxis(part[:n0], -2, 0) for part in (to_state, own_slopes))

        def follow(slopes: Array, row: tuple[Array, ...]) -> tuple[Array, Array]:
            to_state, beside = row
            return sum(to_state[:, i, None] * slopes[None, i] for i in range(n0)) + beside, slopes

        slopes, before = jax.lax.scan(follow, slopes, tuple(by_step))
        before = jnp.moveaxis(before, 0, -2)  # (n0, n0 + n, size, width)
        slope = sum(to_state[n0:, i, None] * before[None, i] for i in range(n0)) + own_slopes[n0:]
        columns = _columns(scored, slope, jnp.moveaxis(target, 0, -2), value[n0:], weight)
        return (state, slopes, *_with_sums(shared, own, columns, n0)), None

    return jax.lax.scan(block, carry, cut_steps(rows, most))[0][2:]


def flatten_steps(part: Float[Array, "T n m"]) -> Float[Array, "n T*m"]:
    """Return steps of segments side by side."""
    steps, n, m = part.shape
    return jnp.moveaxis(part, 0, 1).reshape(n, steps * m)  # n = 0 of a motion without inputs


@partial(quick_jit, static_argnames=("dynamics", "blocks"))
def block_scores(
    dynamics: Dynamics,
    numbers: Numbers,
    segments: Segments,
    states: Float[Array, "k n0 m"],
    weight: Float[Array, "ny ny"],
    place: Int[Array, "T"],
    blocks: int,
) -> Float[Array, "k blocks n0+n m"]:
    """Return `Σ sᵀe` over the scored steps of every block.

    s are the sensitivities to (start, c, w), rows times `weight`.

    Args:
        place: the block of each step, the same in every segment.
    """
    numbers = dynamics.prepare(numbers)
    _, n0, width = segments.start.shape
    n = dynamics.unknowns

    def step(carry: tuple[Any, ...], row: tuple[Any, ...]) -> tuple[Any, None]:
        state, slopes, sums = carry
        inputs, target, scored, block = row
        state, slopes, value, slope = dynamics.tangents(numbers, state, slopes, inputs)
        columns = _columns(scored, slope, target, value, weight)
        return (
            state,
            slopes,
            sums.at[block].add(jnp.sum(columns[:, :-1] * columns[:, -1:], axis=0)),
        ), None

    def one_chunk(chunk: tuple[AnyArray, ...]) -> Array:
        state, *rows = chunk
        start = (state, dynamics.first_slopes(width), jnp.zeros((blocks, n0 + n, width)))
        return jax.lax.scan(step, start, (*rows, place))[0][2]

    return jax.lax.map(one_chunk, (states, segments.inputs, segments.target, segments.scored))
