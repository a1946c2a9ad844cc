"""Bounds of the free run under growing inputs: the factor from which it leaves them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import check_number
from orthaug._base.errors import InputError
from orthaug._base.jax import Array, jax, jnp, padded_length, quick_jit
from orthaug._base.lines import plural
from orthaug.analysis.visited import MOST_STEPS, usable
from orthaug.data.record import Record
from orthaug.models.dynamics import Dynamics, Numbers
from orthaug.models.model import Model
from orthaug.models.on_records import RUNAWAY
from orthaug.physics.motion import MOST_SUBSTEPS

# Outputs of a stable linear model grow with its inputs, and 10⁶ times the largest is "diverged"
_LARGEST_FACTOR = 1e4
_SIDE_BY_SIDE = 16  # runs of one compiled call
_MARGIN = 1.5  # a factor below is a warning
_WITHIN = 10.0  # times the largest training output: a run there did not grow out of all numbers
_CLOSE = 1.05  # ratio of two factors at which the bisection ends
_FINER, _REFINEMENTS = 4, 3  # times the substeps, and how often: rk4's error falls to 1/256 each

Diverging = Callable[[list[float]], np.ndarray]


@dataclass(frozen=True)
class Divergence:
    """The factor on the inputs from which the free run leaves all bounds; None: nowhere.

    It is searched up to `searched`. With the model's own `substeps` the integrator itself leaves
    them from `coarse` on, and with `finer` ones it does not; None where that is not so. It may be
    `undefined`: not large, but without a value, as the root of a negative number.
    """

    factor: float | None
    searched: float
    coarse: float | None = None
    substeps: int = 0
    finer: int = 0
    undefined: bool = False


def find_divergence(model: Model, record: Record, largest: float = 1024.0) -> Divergence:
    """Return from where on the free run diverges, as far as finer steps confirm it.

    A motion's integrator may leave all bounds where its solution does not: its steps are then too
    long for the states that larger inputs reach. The run is repeated with four times the substeps
    as long as the finding changes. What changes to the last is left out of what is `searched`.

    Raises:
        InputError: as `divergence_scaling`.
    """
    found = _find_confirmed(model, record, largest)
    physics = getattr(model.form, "motion", None) or getattr(model.form, "baseline", None)
    expressions = getattr(physics, "expressions", ())  # none of a form from elsewhere
    if found.factor is None or not any(one.is_partial for one in expressions):
        return found
    fine = _with_substeps(model, found.finer) if found.finer else model
    _, undefined = _run_scaled(fine, _first_rows(fine, record), [found.factor])
    return replace(found, undefined=bool(undefined[0]))


def _find_confirmed(model: Model, record: Record, largest: float) -> Divergence:
    """Return the factor that finer steps confirm, as `find_divergence`."""
    coarse = factor = divergence_scaling(model, record, largest)
    motion = getattr(model.form, "motion", None)
    if factor is None or motion is None or motion.scheme.discrete:
        return Divergence(factor, float(largest))
    own = substeps = model.form.substeps
    growing = _doubling_factors(float(largest))
    for _ in range(_REFINEMENTS):
        if substeps * _FINER > MOST_SUBSTEPS:
            break
        fine = _with_substeps(model, substeps * _FINER)
        diverges = partial(_find_diverging, fine, _first_rows(fine, record))
        still, *wild = diverges([factor, *growing])
        if still:
            return _confirmed(coarse, factor, largest, own, substeps)
        substeps *= _FINER
        changed = _bracket(growing, wild, diverges)
        if changed is None:
            return _confirmed(coarse, None, largest, own, substeps)
        factor = changed
    return _confirmed(coarse, None, factor / _CLOSE, own, substeps)


def _confirmed(
    coarse: float | None, factor: float | None, searched: float, own: int, substeps: int
) -> Divergence:
    """Return a finding, with that of the model's own substeps where finer ones changed it."""
    if substeps == own:
        return Divergence(factor, float(searched))
    return Divergence(factor, float(searched), coarse, own, substeps)


def _with_substeps(model: Model, substeps: int) -> Model:
    """Return a motion's model with other steps of its integrator."""
    return replace(model, form=replace(model.form, substeps=substeps))


def _first_rows(model: Model, record: Record) -> Record:
    """Return the first rows of each experiment, as many as are searched."""
    rows = max(MOST_STEPS // len(record.experiments), model.form.first_row + 1)
    return replace(record, experiments=tuple(e.rows(None, rows) for e in record.experiments))


def divergence_scaling(model: Model, record: Record, largest: float = 1024.0) -> float | None:
    """Return the factor on the inputs from which the free run leaves all bounds.

    The bounds are 10⁶ times the largest training output.

    It scales each input's deviation from its mean over the record; the measured outputs that the
    run starts from stay. Doubled until a run diverges, then bisected to 5 %; what is returned did
    diverge, and others below it may. Of longer records 20000 rows are used, the first of each
    experiment. None where no run up to `largest` diverges, as without a state; at most 1 where the
    record's own run does, and 0 where it does with its inputs at their means.

    Raises:
        InputError: a record that does not fit the model, or a `largest` that is not above 1 and at
            most 10⁴.
    """
    if not 1 < check_number(largest, "largest", positive=True) <= _LARGEST_FACTOR:
        raise InputError(
            f"`largest` must be a factor above 1 and at most {_LARGEST_FACTOR:g}; got {largest!r}."
        )
    if not model.form.states:
        return None
    diverges = partial(_find_diverging, model, _first_rows(model, record))
    growing = _doubling_factors(float(largest))
    return _bracket(growing, diverges(growing), diverges)


def describe_divergence(found: Divergence, driven: bool) -> tuple[str, str]:
    """Return what a search for divergence has found, as a sentence or two.

    The second text is the code of a warning, or empty.

    A model that is not `driven`, by inputs, has none to scale: its own run leaves the bounds or
    does not.
    """
    factor = found.factor
    if not driven:
        stays = "remains bounded" if factor is None else "diverges without inputs"
        return (
            f"The free run {stays}; it has no inputs that could be larger.",
            "small_margin" if factor is not None else "",
        )
    stays, times = (
        ("remains bounded", found.searched)
        if factor is None
        else ("meets a term that has no value, as the root of a negative number,", factor)
        if found.undefined
        else ("exceeds the training outputs a million times", factor)
    )
    text = (
        f"The free run {stays} with the inputs' deviations from their means {times:.4g} times "
        "as large."
    )
    if found.undefined:
        text += " Where the physics has such a term, sqrt(max(x, 0)) has a value everywhere."
    if found.coarse is not None:
        text += (
            f" That holds for {found.finer} substeps of the integrator. With "
            f"{plural(found.substeps, 'substep')}, as fitted, the integrator itself diverges from "
            f"{found.coarse:.4g} times on. For inputs that large give `substeps` = {found.finer} "
            "in [motion]."
        )
    least = min(one for one in (factor, found.coarse, _MARGIN) if one is not None)
    return text, "small_margin" if least < _MARGIN else ""


def _doubling_factors(largest: float) -> list[float]:
    """Return the factors 1, 2, 4, …, `largest`."""
    factors = [1.0]
    while factors[-1] < largest:
        factors.append(min(2 * factors[-1], largest))
    return factors


def _bracket(
    growing: Sequence[float], wild: Sequence[bool] | np.ndarray, diverges: Diverging
) -> float | None:
    """Return the factor from which a run diverges, by which of the growing ones it does."""
    if not any(wild):
        return None
    high = int(np.argmax(wild))
    return _bisect(growing[high - 1], growing[high], diverges) if high else _below_one(diverges)


def _below_one(diverges: Diverging) -> float:
    """Return the factor below 1 from which the run diverges.

    The run diverges with the record's own inputs. Below 10⁻⁴ the factor is the last one tried, or
    0.
    """
    falling = [1.0]
    while falling[-1] >= 1 / _LARGEST_FACTOR:
        falling.append(falling[-1] / 2)
    *wild, at_rest = diverges([*falling[1:], 0.0])
    if all(wild):
        return 0.0 if at_rest else falling[-1]
    low = wild.index(False) + 1
    return _bisect(falling[low], falling[low - 1], diverges)


def _bisect(low: float, high: float, diverges: Diverging) -> float:
    """Return the lowest factor that is known to diverge once `low` and `high` are close.

    Every middle is tried at once.
    """
    middles = _middles(low, high)
    if not middles:
        return high
    wild = dict(zip(middles, diverges(middles), strict=True))
    while high > _CLOSE * low:
        middle = _middle(low, high)
        low, high = (low, middle) if wild[middle] else (middle, high)
    return high


def _middles(low: float, high: float) -> list[float]:
    """Return all factors that a bisection of an interval can reach: 15 or fewer.

    The upper end is at most double the lower one.
    """
    if not high > _CLOSE * low:
        return []
    middle = _middle(low, high)
    return [middle, *_middles(low, middle), *_middles(middle, high)]


def _middle(low: float, high: float) -> float:
    return float(np.sqrt(low * high))


def _find_diverging(
    model: Model, record: Record, factors: Sequence[float]
) -> Bool[np.ndarray, "f"]:
    """Return whether the free run diverges with its inputs scaled by each of up to 16 factors.

    Raises:
        InputError: as `_run_scaled`.
    """
    return _run_scaled(model, record, factors)[0]


def _run_scaled(
    model: Model, record: Record, factors: Sequence[float]
) -> tuple[Bool[np.ndarray, "f"], Bool[np.ndarray, "f"]]:
    """Return whether the free run diverges with scaled inputs, and whether it has no value there.

    A factor, of up to 16, scales the inputs' deviations from their means. The runs start from the
    measured outputs of each experiment and go side by side.

    Raises:
        InputError: a record that does not fit the model, or has no outputs to start from.
    """
    if not record.outputs:
        raise InputError(
            "the record has no measured outputs to start from; give those of its first rows."
        )
    form: Dynamics = model.form
    record = usable(model, record)
    mean = np.concatenate([e.inputs for e in record.experiments]).mean(axis=0)
    scales = np.concatenate([factors, np.repeat(factors[:1], _SIDE_BY_SIDE - len(factors))])
    wild, undefined = np.zeros((2, _SIDE_BY_SIDE), dtype=bool)
    for experiment in record.experiments:
        if wild.all():
            break
        inputs = form.inputs(experiment, record)
        resting = form.inputs(
            replace(experiment, inputs=np.tile(mean, (len(experiment), 1))), record
        )
        padded = np.zeros((2, padded_length(len(inputs)), inputs.shape[1]))
        padded[:, : len(inputs)] = resting, inputs
        state, bound = (
            form.start(experiment.outputs, [form.first_row])[0],
            RUNAWAY * model.largest_output,
        )
        own, lost = _side_by_side(form, model.numbers, state, *padded, len(inputs), scales, bound)
        undefined |= ~wild & np.asarray(lost)
        wild |= np.asarray(own)
    return wild[: len(factors)], undefined[: len(factors)]


@partial(quick_jit, static_argnames="form")
def _side_by_side(
    form: Dynamics,
    numbers: Numbers,
    state: Float[Array, "n0"],
    resting: Float[Array, "T nu"],
    inputs: Float[Array, "T nu"],
    steps: Array,
    factors: Float[Array, "f"],
    bound: Float[Array, "ny"],
) -> tuple[Bool[Array, "f"], Bool[Array, "f"]]:
    """Return whether an output leaves `bound` within `steps` of each scaled free run.

    The second are those that leave it for no number, from outputs that were not large.
    The inputs of a run are `resting + factor (inputs − resting)`.
    """
    one = jax.vmap(lambda state, row: form.step(numbers, state, row))
    near = bound * (_WITHIN / RUNAWAY)

    def is_unfinished(carry: tuple[Any, ...]) -> Array:
        return (carry[0] < steps) & ~carry[2].all()

    def step(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        k, states, wild, small, undefined = carry
        states, parts = one(states, resting[k] + factors[:, None] * (inputs[k] - resting[k]))
        y = parts.total
        lost = ~wild & small & jnp.isnan(y).any(axis=1)
        wild = wild | ~(jnp.abs(y) <= bound).all(axis=1)
        return k + 1, states, wild, (jnp.abs(y) <= near).all(axis=1), undefined | lost

    states = jnp.broadcast_to(state, (len(factors), *state.shape))
    none = jnp.zeros(len(factors), dtype=bool)
    _, _, wild, _, undefined = jax.lax.while_loop(
        is_unfinished, step, (0, states, none, ~none, none)
    )
    return wild, undefined
