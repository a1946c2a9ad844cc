"""Test for structure in a free run's errors that noise does not explain, and for hidden states.

The errors of the free run are regressed on how the outputs follow, to first order, the parameters,
the starts and any function of what a learner sees (`output_response`). What is added to that are
simple functions of a state or an input, and terms with memory of it (`memory`). Run and inputs are
no function of the noise: noise of any colour, on the sensor or in the equation, is no reason to
find one. Rows and columns are filtered by the autoregression of the errors beside the model
(Cochrane and Orcutt 1949), so that what remains of noise is white. A family of terms counts where
its F-test rejects at the level divided by the number of families and it predicts blocks of rows
that it was not fitted to.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.special

from orthaug._base.checks import Matrix, Vector
from orthaug._base.columns import least_squares, span
from orthaug.analysis.filtered_rows import (
    RANK,
    error_colours,
    error_scale,
    filter_rows,
    stacked_rows,
)
from orthaug.analysis.memory import KINDS, MemoryTerm, memory_terms
from orthaug.analysis.output_response import LinearRun, linear_runs
from orthaug.analysis.predictability import BlockSums, Share
from orthaug.data.record import Record
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.model import Model
from orthaug.models.moving import MotionDynamics

_MOST_ROWS = 6000
_VARIABLES, _EQUATIONS = 6, 3  # looked at, at most
_LEVEL = 0.01
_ROWS_PER_COLUMN = 4
_ROUNDING = 1e-7  # of the outputs' deviation: errors below that are rounding and the integrator's
_OWN = 1e-3  # of a column's size: what is left of it beside the model, so that it is one of its own
# Quantiles about which a function of a learner's feature bends
_CENTRES = (0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95)
_STATIC, _DRIFT = 5, "drift"
_MULTIPLIED = 8  # features, of which products of pairs are taken
_LEAST_LAG = 3.0  # samples: a faster state is a lag that is missing
# Of the filtered errors' square, by which memory predicts more than functions of one row
_CLEARLY = 0.1
_MUCH = 1.5  # times what functions of one row predict, with which memory is the cause beside them
_NEARLY = 0.8  # of the best family's share
# Error of the run over the outputs' deviation, from which on the run's states are not the system's
_FAR = 0.5
# Steps, shorter ones, and the fall of the squares that ends them
_SETTLING, _HALVINGS, _SETTLED = (8, 4, 0.01)


@dataclass(frozen=True)
class FamilyTest:
    """A family of terms in one equation, and the `share` of the errors that it predicts.

    The share is of the filtered errors' square, on held-out blocks.

    `error` is the standard error of the share, `p` that of the F-test, times the number of
    families. `moves` is by how much each parameter moves once the best `term` is fitted beside it,
    in the coordinates that are estimated.
    """

    equation: str
    on: str
    kind: str
    share: float
    error: float
    p: float
    term: MemoryTerm | None = None
    moves: tuple[float, ...] = ()

    @property
    def name(self) -> str:
        """Name of the family, in words."""
        return f"a function of {self.on}" if self.term is None else f"a {self.term.name}"

    def is_short(self, least: float) -> bool:
        """Return whether it is a lag of a time constant below a least one, in s."""
        return self.kind == "lag" and self.term is not None and self.term.scale < least

    @property
    def sure(self) -> bool:
        """True if the family is surely present."""
        return self.p < _LEVEL and self.share > 2 * self.error


@dataclass(frozen=True)
class ParameterDrift:
    """A parameter, by its place, that seems to change over the record.

    `share` of the errors is what a curve of the second degree over time predicts; `begin` and
    `end` are by how much its value there differs from the model's, in the coordinate that is
    estimated.
    """

    place: int
    share: float
    begin: float
    end: float


@dataclass(frozen=True)
class StructureTest:
    """Structure beside noise in the errors of a free run.

    `static` is the best family of functions of a state or an input, `memory` the best with memory,
    each beside what the model has; `hidden` the best with memory beside all static ones, too. None
    where none is sure.
    """

    static: FamilyTest | None
    memory: FamilyTest | None
    hidden: FamilyTest | None
    families: tuple[FamilyTest, ...]
    """All with memory, the largest share first."""
    step: float = 0.0
    """Sampling time of the model."""
    off: float = 0.0
    """Error of the free run over the outputs' deviation, the largest of all outputs."""

    @property
    def is_far(self) -> bool:
        """True if the run is too far from the data to say what its error is a function of."""
        return self.off > _FAR

    @property
    def found(self) -> bool:
        """True if there is any structure."""
        return self.static is not None or self.memory is not None

    drift: ParameterDrift | None = None
    """The parameter that changes over the record, if that predicts more than any term."""
    delayed: tuple[str, ...] = ()
    """Signals whose short memory is a lag or a delay that is missing, and no state."""

    def is_a_lag(self, one: FamilyTest) -> bool:
        """Return whether a family forgets within a few samples, as a further lag does."""
        return one.on in self.delayed and one.is_short(_LEAST_LAG * self.step)

    @property
    def state(self) -> FamilyTest | None:
        """The family with memory that shows a hidden state; None where it shows a missing lag.

        Where an input seems to act a sample or two late and memory of a state predicts nearly as
        much, it is the state.
        """
        if self.memory is None or not self.is_a_lag(self.memory):
            return self.memory
        near = _NEARLY * self.memory.share
        others = (one for one in self.families if one.on not in self.delayed and one.sure)
        return next((one for one in others if one.share >= near), None)

    @property
    def has_memory(self) -> bool:
        """True if a hidden state is the likely cause.

        Memory is sure beside static terms, and predicts clearly more.

        Play and hysteresis of a position follow the sign of its speed, so they replace
        friction that is not quite right; a lag of a sample or two is a lag that the physics has too
        few of. A run far from the data has other states than the system: a function of these would
        pass for memory.
        """
        if self.hidden is None or self.state is None or self.is_far:
            return False
        if self.state is self.memory and self.is_a_lag(self.hidden):
            return False
        return self.static is None or self.state.share >= self.static.share + _CLEARLY

    def exceeds(self, share: float) -> bool:
        """Return whether memory predicts much more than functions of one row, and than a share."""
        static = 0.0 if self.static is None else self.static.share
        return self.state is not None and self.state.share > _MUCH * max(static, share)


@dataclass(frozen=True)
class _Family:
    equation: str
    on: str
    kind: str
    terms: tuple[MemoryTerm | None, ...]


def structure_test(model: Model, record: Record) -> StructureTest | None:
    """Test what the free run of a model leaves of its training data.

    None where the run leaves all bounds or has no slopes, or there are too few rows.
    """
    fitted = linear_runs(model, record, _MOST_ROWS, np.asarray(model.numbers.theta, dtype=float))
    if fitted is None:
        return None
    error = np.sqrt(np.mean(np.concatenate([run.error for run in fitted]) ** 2, axis=0))
    off = float((error / model.deviation).max())
    theta, runs = _fit_physics(model, record, fitted)
    whole = np.concatenate([run.error for run in runs])
    if np.all(whole.std(axis=0) < _ROUNDING * model.deviation):
        return None
    moved = theta - np.asarray(model.numbers.theta)
    found = _test_families(runs, _base_columns(model, runs), *_added_columns(model, runs), moved)
    if found is None:
        return None
    delayed = tuple(_equations(model).delayed(runs[0]))
    return replace(found, step=float(model.sampling_time), off=off, delayed=delayed)


def _fit_physics(
    model: Model, record: Record, runs: list[LinearRun]
) -> tuple[Vector, list[LinearRun]]:
    """Return parameters of the physics with the least filtered free-run errors, and the runs.

    They are found by Gauss-Newton steps from the model's own `runs`.

    Noise on the sensor, or coloured noise, biases what was fitted one step ahead: its run is then
    far from the data even though nothing is missing.
    """
    theta = np.asarray(model.numbers.theta, dtype=float)
    for _ in range(_SETTLING):
        base = _base_columns(model, runs)
        pieces, colours = error_colours(runs, base)
        rows, nt = np.concatenate([filter_rows(piece, colours) for piece in pieces]), len(theta)
        step, before = (
            _step_beside(rows[:, :nt], rows[:, nt:-1], rows[:, -1]),
            _residual_sum(rows[:, nt:-1], rows[:, -1]),
        )
        scale, trial, after = error_scale(runs), None, np.inf
        for _ in range(_HALVINGS):
            trial, after = linear_runs(model, record, _MOST_ROWS, theta + step), np.inf
            if trial is not None:
                beside = [one[..., nt:] for one in _base_columns(model, trial)]
                moved = np.concatenate(
                    [filter_rows(piece, colours) for piece in stacked_rows(trial, beside, scale)]
                )
                after = _residual_sum(moved[:, :-1], moved[:, -1])
            if after < before:
                break
            step = step / 4
        if trial is None or not after < before:
            break
        theta, runs = theta + step, trial
        if after > (1 - _SETTLED) * before:
            break
    return theta, runs


def _step_beside(columns: Matrix, others: Matrix, target: Vector) -> Vector:
    """Return the coefficients of columns beside others, 0 along what the others replace.

    A parameter that the learner imitates would drift far for nothing, to where the run is no longer
    linear in what compensates it.
    """
    size = np.linalg.norm(columns, axis=0)
    size = np.where(size > 0, size, 1.0)
    q = span(others, RANK)
    rest = columns / size
    rest = rest - q @ (q.T @ rest)
    left, values, right = np.linalg.svd(rest, full_matrices=False)
    kept = values > _OWN
    return right[kept].T @ ((left[:, kept].T @ target) / values[kept]) / size


def _residual_sum(columns: Matrix, target: Vector) -> float:
    """Return the sum of squares that columns leave."""
    q = span(columns, RANK)
    rest = target - q @ (q.T @ target)
    return float(rest @ rest)


def _signals(model: Model, run: LinearRun) -> dict[str, Vector]:
    """Return the signals that terms may depend on, as far as they move."""
    moving = {
        name: row
        for name, row in _equations(model).signals(run).items()
        if np.isfinite(row).all() and np.ptp(row) > 0
    }
    return dict(list(moving.items())[:_VARIABLES])


def _lags_read(model: Any, run: LinearRun) -> Matrix:
    """Return the lags along the run that the learner's features read, (T, n)."""
    form = model.form
    x = form.regressor(run.states.T, run.rows.T, np)
    return np.asarray(x)[[form.layout.index(lag) for lag in form.features.lags]].T


@dataclass(frozen=True)
class _OfOutputs:
    """The equations of a lagged model: its outputs."""

    form: LaggedDynamics

    def signals(self, run: LinearRun) -> dict[str, Vector]:
        """Return each channel of the regressor, and its velocity."""
        form, found = self.form, {}
        x, layout = form.regressor(run.states.T, run.rows.T, np), form.layout
        for channel in dict.fromkeys(lag.channel for lag in layout):
            lags = sorted(lag for lag in layout if lag.channel == channel)
            first, *others = (x[layout.index(lag)] for lag in lags)
            found[str(lags[0])] = first
            if others and channel in form.outputs:
                found[f"{lags[0]} - {lags[1]}"] = first - others[0]
        return found

    def delayed(self, run: LinearRun) -> list[str]:
        """Return the signals of which the physics may read too few lags: all."""
        return list(self.signals(run))

    @property
    def doubted(self) -> tuple[tuple[int, str], ...]:
        """Place and name of the equations that may lack a term."""
        return tuple(enumerate(self.form.outputs))[:_EQUATIONS]

    @property
    def learned(self) -> list[int]:
        """Places of the equations to which a function of the learner's inputs may be added."""
        return [place for place, _ in self.doubted]

    def enter(
        self, run: LinearRun, place: int, columns: Matrix, step: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return by what signals (T, k) that are added to an equation move state and outputs."""
        (t, k), n0, ny = columns.shape, run.states.shape[1], run.error.shape[1]
        into_state, into_output = np.zeros((t, n0, k)), np.zeros((t, ny, k))
        into_output[:, place] = columns
        if n0:
            into_state[:, place] = columns
        return into_state, into_output


@dataclass(frozen=True)
class _OfStates:
    """The equations of a motion: those of its states."""

    form: MotionDynamics

    def signals(self, run: LinearRun) -> dict[str, Vector]:
        """Return states and inputs, and what the learner sees beside them."""
        form = self.form
        names = (*form.motion.names_of_states, *form.motion.inputs)
        found = dict(zip(names, np.concatenate([run.states, run.rows], axis=1).T, strict=True))
        seen = zip(form.features, form.features_at(run.states, run.rows).T, strict=False)
        return found | {str(entry): row for entry, row in seen if str(entry) not in found}

    def delayed(self, run: LinearRun) -> list[str]:
        """Return the signals that may act late: inputs. States have no lags."""
        return list(self.form.motion.inputs)

    @property
    def doubted(self) -> tuple[tuple[int, str], ...]:
        """Place and name of the equations with a parameter or the learner."""
        motion = self.form.motion
        names, places = motion.names_of_states, set(motion.learned[0])
        places |= {
            i
            for i, name in enumerate(names)
            if motion.functions is not None or motion.parameters_in(name)
        }
        return tuple((i, names[i]) for i in sorted(places))[:_EQUATIONS]

    @property
    def learned(self) -> list[int]:
        return list(self.form.motion.learned[0])

    def enter(
        self, run: LinearRun, place: int, columns: Matrix, step: float
    ) -> tuple[np.ndarray, np.ndarray]:
        (t, k), n0, ny = columns.shape, run.states.shape[1], run.error.shape[1]
        into_state, into_output = np.zeros((t, n0, k)), np.zeros((t, ny, k))
        if self.form.motion.scheme.discrete:
            into_state[:, place] = columns
        else:
            half = step / 2
            into_state += half * run.to_state[:, :, place, None] * columns[:, None]
            into_state[:, place] += half * np.concatenate([columns[1:], columns[-1:]])
        return into_state, into_output


_EQUATIONS_OF: dict[type, Callable[[Any], _OfOutputs | _OfStates]] = {
    LaggedDynamics: _OfOutputs,
    MotionDynamics: _OfStates,
}


def _equations(model: Model) -> _OfOutputs | _OfStates:
    """Return the equations of a model to which terms may be added."""
    return _EQUATIONS_OF[type(model.form)](model.form)


def _respond(model: Model, run: LinearRun, place: int, columns: Matrix) -> np.ndarray:
    """Compute how the outputs follow signals (T, k) that are added to an equation, (T, ny, k)."""
    entering = _equations(model).enter(run, place, columns, model.sampling_time)
    return run.respond(*entering, np.zeros((run.states.shape[1], columns.shape[1])))


def _base_columns(model: Model, runs: list[LinearRun]) -> list[np.ndarray]:
    """Return the model's own columns of every run (T, ny, k).

    They are starts, parameters, and functions of the learner's inputs.
    """
    learned = _learned_functions(model, runs)
    places, found = _equations(model).learned, []
    for j, (run, functions) in enumerate(zip(runs, learned, strict=True)):
        starts = run.starts()
        own = np.zeros((*starts.shape[:2], starts.shape[2] * len(runs)))
        own[..., j * starts.shape[2] : (j + 1) * starts.shape[2]] = starts
        moved = [_respond(model, run, place, functions) for place in places if functions.size]
        found.append(np.concatenate([run.parameters(), own, *moved], axis=2))
    return found


def _learned_functions(model: Model, runs: list[LinearRun]) -> list[Matrix]:
    """Return functions (T, k) of what the learner sees along every run, k = 0 without a learner.

    Many terms are functions of few lags: they are taken as they are, beside bends of these lags.
    """
    features = [model.form.features_at(run.states, run.rows) for run in runs]
    count = features[0].shape[1]
    if count > _MULTIPLIED and getattr(model.form.features, "linear", False):
        lags = [_lags_read(model, run) for run in runs]
        bends = _bends(np.concatenate(lags))
        pairs = zip(lags, features, strict=True)
        return [np.concatenate([bends(x), terms], axis=1) for x, terms in pairs]
    if not count:
        return features
    bends = _bends(np.concatenate(features))
    return [bends(z) for z in features]


def _bends(z: Matrix):
    """Return a flexible function of features: their bends at quantiles, and products of pairs.

    Products are those of the first `_MULTIPLIED` features: all pairs of many would be more columns
    than rows.
    """
    centre, size = z.mean(axis=0), np.where(z.std(axis=0) > 0, z.std(axis=0), 1.0)
    scaled = (z - centre) / size
    knots = [np.unique(np.quantile(column, _CENTRES)) for column in scaled.T]

    def columns(rows: Matrix) -> Matrix:
        own = np.clip((rows - centre) / size, -5, 5)
        found = [np.ones(len(rows))]
        for v, at in zip(own.T, knots, strict=True):
            found += [
                v,
                v**3,
                *(np.tanh((v - knot) / width) for knot in at for width in (0.05, 0.4)),
            ]
        for i in range(min(own.shape[1], _MULTIPLIED)):
            for j in range(i):
                found += [
                    own[:, i] * own[:, j],
                    own[:, i] ** 2 * own[:, j],
                    own[:, i] * own[:, j] ** 2,
                ]
        return np.stack(found, axis=1)

    return columns


def _static(values: Vector, size: float) -> list[Vector]:
    """Return simple functions of a signal."""
    v = np.clip(values / size, -5, 5)
    return [v, np.abs(v), v * np.abs(v), v**3, np.tanh(10 * v)]


def _added_columns(model: Model, runs: list[LinearRun]) -> tuple[list[_Family], list[np.ndarray]]:
    """Return the families of terms, and each run's responses to all their terms, (T, ny, K)."""
    step, signals = model.sampling_time, [_signals(model, run) for run in runs]
    names = [name for name in signals[0] if all(name in other for other in signals)]
    families, columns = [], [[] for _ in runs]
    for name in names:
        joined = np.concatenate([own[name] for own in signals])
        size = float(np.sqrt(np.mean(joined**2))) or 1.0
        terms = memory_terms(name, joined, step)
        kinds = [("static", (None,) * _STATIC)]
        kinds += [(kind, tuple(term for term in terms if term.kind == kind)) for kind in KINDS]
        for place, equation in _equations(model).doubted:
            families += [_Family(equation, name, kind, own) for kind, own in kinds]
            for found, own, run in zip(columns, signals, runs, strict=True):
                values = _static(own[name], size) + [
                    term.along(own[name], step) / size for term in terms
                ]
                found.append(_respond(model, run, place, np.stack(values, axis=1)))
    # How the outputs follow a parameter that changes slowly, against what they remember
    rows = sum(len(run.error) for run in runs)
    over_time = np.split(np.linspace(-1, 1, rows), np.cumsum([len(run.error) for run in runs])[:-1])
    for i in range(len(model.numbers.theta)):
        families.append(_Family("", str(i), _DRIFT, (None, None)))
        for found, run, t in zip(columns, runs, over_time, strict=True):
            moved = run.parameters()[..., i]
            found.append(np.stack([moved * power[:, None] for power in (t, t**2)], axis=2))
    return families, [np.concatenate(found, axis=2) for found in columns]


def _test_families(
    runs: list[LinearRun],
    base: list[np.ndarray],
    families: list[_Family],
    added: list[np.ndarray],
    shift: Vector,
) -> StructureTest | None:
    """Filter rows and columns by the colour of the remaining errors, and test every family."""
    nt, known, colours = len(shift), base[0].shape[2], error_colours(runs, base)[1]
    both = [np.concatenate(columns, axis=2) for columns in zip(base, added, strict=True)]
    whole = np.concatenate(
        [filter_rows(piece, colours) for piece in stacked_rows(runs, both, error_scale(runs))]
    )
    if len(whole) < _ROWS_PER_COLUMN * (known + len(families)) or not np.isfinite(whole).all():
        return None
    starts = slice(nt, nt + runs[0].states.shape[1] * len(runs))
    q = span(whole[:, starts], RANK)
    # They move a few rows of one run only: blocks would not show them
    whole = whole - q @ (q.T @ whole)
    whole[:, starts] = 0.0
    size = np.linalg.norm(whole, axis=0)
    size = np.where(size > 0, size, 1.0)
    whole = whole / size
    static = np.concatenate(
        [np.full(len(family.terms), family.kind == "static") for family in families]
    )
    own, simple = list(range(known)), [known + int(j) for j in np.flatnonzero(static)]
    beside = _family_tests(whole, own, known, families, size, shift)
    hidden = _family_tests(whole, own + simple, known, families, size, None)
    memory = [entry for entry in beside if entry.kind in KINDS]
    found = StructureTest(
        _best_family([entry for entry in beside if entry.kind == "static"]),
        _best_family(memory),
        _best_family([entry for entry in hidden if entry.kind in KINDS]),
        tuple(sorted(memory, key=lambda entry: -entry.share)),
    )
    drift = _best_family([entry for entry in beside if entry.kind == _DRIFT])
    others = [one.share for one in (found.static, found.memory) if one is not None]
    if drift is None or drift.share < max(others, default=0.0):
        return found
    return replace(found, drift=_drift_of(whole, own, size, shift, drift))


def _drift_of(
    whole: Matrix, own: list[int], size: Vector, shift: Vector, best: FamilyTest
) -> ParameterDrift:
    """Return how far the parameter of a family is from the model's at either end of the record."""
    place, powers = int(best.on), 2  # the columns of all parameters come last, before the errors
    first = whole.shape[1] - 1 - powers * (len(shift) - place)
    taken = [*own, first, first + 1]
    steps = least_squares(whole[:, taken], whole[:, -1]) * size[-1] / size[taken]
    middle, (linear, square) = shift[place] + steps[place], steps[-powers:]
    return ParameterDrift(
        place, best.share, float(middle - linear + square), float(middle + linear + square)
    )


def _best_family(entries: list[FamilyTest]) -> FamilyTest | None:
    return max(
        (entry for entry in entries if entry.sure), key=lambda entry: entry.share, default=None
    )


def _family_tests(
    whole: Matrix,
    base: list[int],
    known: int,
    families: list[_Family],
    size: Vector,
    shift: Vector | None,
) -> list[FamilyTest]:
    """Test every family beside the columns of a base.

    `size` are the norms that columns were divided by.
    """
    q = span(whole[:, base], RANK)
    rest = whole[:, known:] - q @ (q.T @ whole[:, known:])
    target, terms = rest[:, -1], rest[:, :-1]
    total, left = float(target @ target), len(whole) - q.shape[1]
    sums = BlockSums.of(np.concatenate([q, terms], axis=1), whole[:, -1])
    blocks, found, place = list(range(q.shape[1])), [], 0
    for family in families:
        own = list(range(place, place + len(family.terms)))
        place += len(family.terms)
        own = [j for j in own if np.linalg.norm(terms[:, j]) > _OWN]
        if not own or not total > 0:
            continue
        basis = span(terms[:, own], RANK)
        gained, rank = float(np.sum((basis.T @ target) ** 2)), basis.shape[1]
        freedom = left - rank
        p = scipy.special.fdtrc(
            rank, freedom, gained / rank / (max(total - gained, 1e-300) / freedom)
        )
        share: Share = sums.share([len(blocks) + j for j in own], blocks)
        chosen = max(own, key=lambda j: (terms[:, j] @ target) ** 2 / (terms[:, j] @ terms[:, j]))
        term = family.terms[chosen - (place - len(family.terms))]
        entry = FamilyTest(
            family.equation, family.on, family.kind, share.value, share.error, float(p), term
        )
        if shift is not None and term is not None:
            step = least_squares(whole[:, [*base, known + chosen]], whole[:, -1])[: len(shift)]
            entry = replace(
                entry, moves=tuple(map(float, shift + step * size[-1] / size[: len(shift)]))
            )
        found.append(entry)
    return [replace(entry, p=min(entry.p * len(found), 1.0)) for entry in found]
