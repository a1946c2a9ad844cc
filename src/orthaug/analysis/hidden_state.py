"""Test for structure in a free run's errors that noise does not explain, and for hidden states.

The errors of the free run are regressed on how the outputs follow, to first order, the parameters,
the starts and any function of what a learner sees (`output_response`). What is added to that are
simple functions of a state or an input, and terms with memory of it (`memory`). Run and inputs are
no function of the noise: noise of any colour, on the sensor or in the equation, is no reason to
find one (`family_tests`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.columns import span
from orthaug.analysis.family_tests import (
    STATIC,
    Candidates,
    Family,
    FamilyTest,
    best_family,
    by_share,
)
from orthaug.analysis.filtered_rows import (
    RANK,
    error_colours,
    error_scale,
    filter_rows,
    stacked_rows,
)
from orthaug.analysis.memory import KINDS, memory_terms
from orthaug.analysis.output_response import LinearRun, linear_runs
from orthaug.analysis.parameter_changes import (
    CLEARLY,
    Alternatives,
    ParameterDrift,
    changing_columns,
    depending_columns,
    find_change,
)
from orthaug.data.record import Record
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.model import Model
from orthaug.models.moving import MotionDynamics

_MOST_ROWS = 6000
_VARIABLES, _EQUATIONS = 6, 3  # looked at, at most
_ROUNDING = 1e-7  # of the outputs' deviation: errors below that are rounding and the integrator's
_OWN = 1e-3  # of a column's size: what is left of it beside the model, so that it is one of its own
# Quantiles about which a function of a learner's feature bends
_CENTRES = (0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95)
_FUNCTIONS = 5  # of one row, that `_static` returns
_MULTIPLIED = 8  # features, of which products of pairs are taken
_LEAST_LAG = 3.0  # samples: a faster state is a lag that is missing
_MUCH = 1.5  # times what functions of one row predict, with which memory is the cause beside them
_NEARLY = 0.8  # of the best family's share
# Error of the run over the outputs' deviation, from which on the run's states are not the system's
_FAR = 0.5
# Steps, shorter ones, and the fall of the squares that ends them
_SETTLING, _HALVINGS, _SETTLED = (8, 4, 0.01)


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
    """The parameter that changes over the record, if that predicts more than any term.

    Where it follows the slow past of a signal's square, a state is missing that changes it.
    """
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
    def likeliest(self) -> FamilyTest:
        """The family to name: a function of one row, unless memory predicts clearly more."""
        assert self.static is not None or self.memory is not None
        if self.static is None or self.memory is None:
            return cast(FamilyTest, self.static or self.memory)
        static = self.static.share >= _NEARLY * self.memory.share
        return self.static if static else self.memory

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
        return self.static is None or self.state.share >= self.static.share + CLEARLY

    def exceeds(self, share: float) -> bool:
        """Return whether memory predicts much more than functions of one row, and than a share."""
        static = 0.0 if self.static is None else self.static.share
        return self.state is not None and self.state.share > _MUCH * max(static, share)


def structure_test(
    model: Model, record: Record, *, by_experiment: bool = True
) -> StructureTest | None:
    """Test what the free run of a model leaves of its training data.

    None where the run leaves all bounds or has no slopes, or there are too few rows.

    Args:
        by_experiment: whether parameters may differ between the record's experiments; False where
            these are segments of one.
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
    own = _base_columns(model, runs)
    recordings = record.recordings if by_experiment else ()
    added = _added_columns(model, runs, recordings)
    depending = partial(depending_columns, model, runs, *_common_signals(model, runs))
    one_step = _equations(model).one_step
    found = _structure_of(Candidates(runs, own, *added, moved, one_step), depending)
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


def _common_signals(
    model: Model, runs: list[LinearRun]
) -> tuple[list[str], list[dict[str, Vector]]]:
    """Return the names of signals that move in every run, and each run's signals."""
    signals = [_signals(model, run) for run in runs]
    return [name for name in signals[0] if all(name in other for other in signals)], signals


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

    def enter(self, run: LinearRun, place: int, columns: Matrix) -> tuple[np.ndarray, np.ndarray]:
        """Return by what signals (T, k) that are added to an equation move state and outputs."""
        (t, k), n0, ny = columns.shape, run.states.shape[1], run.error.shape[1]
        into_state, into_output = np.zeros((t, n0, k)), np.zeros((t, ny, k))
        into_output[:, place] = columns
        if n0:
            into_state[:, place] = columns
        return into_state, into_output

    def one_step(self, run: LinearRun, moved: np.ndarray) -> np.ndarray:
        """Return what was added to the equations so that the outputs moved by (T, ny, k).

        The inverse of `enter` and `LinearRun.respond`; of a run's errors, those one step ahead.
        """
        found, outputs = np.array(moved, dtype=float), moved.shape[1]
        state = np.zeros((run.states.shape[1], moved.shape[2]))
        for step in range(len(found)) if len(state) else ():
            found[step] -= run.to_output[step] @ state
            state = run.to_state[step] @ state
            state[:outputs] += found[step]
        return found


@dataclass(frozen=True)
class _OfStates:
    """The equations of a motion: those of its states."""

    form: MotionDynamics
    parameters: Vector
    one_step: None = None  # the noise of outputs does not enter its equations

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

    def enter(self, run: LinearRun, place: int, columns: Matrix) -> tuple[np.ndarray, np.ndarray]:
        (t, k), n0, ny = columns.shape, run.states.shape[1], run.error.shape[1]
        into_state, into_output = np.zeros((t, n0, k)), np.zeros((t, ny, k))
        if self.form.motion.scheme.discrete:
            into_state[:, place] = columns
        else:
            half = run.steps[:, None] / 2
            entries = self.form.motion.mass.entries(run.states, self.parameters)
            acting = entries[:, :, place, None] * columns[:, None]
            into_state += half[..., None] * (run.to_state @ acting)
            into_state += half[..., None] * np.concatenate([acting[1:], acting[-1:]])
        return into_state, into_output


_EQUATIONS_OF: dict[type, Callable[[Model], _OfOutputs | _OfStates]] = {
    LaggedDynamics: lambda model: _OfOutputs(model.form),
    MotionDynamics: lambda model: _OfStates(
        model.form, np.asarray(model.form.parameters(model.numbers))
    ),
}


def _equations(model: Model) -> _OfOutputs | _OfStates:
    """Return the equations of a model to which terms may be added."""
    return _EQUATIONS_OF[type(model.form)](model)


def _respond(model: Model, run: LinearRun, place: int, columns: Matrix) -> np.ndarray:
    """Compute how the outputs follow signals (T, k) that are added to an equation, (T, ny, k)."""
    entering = _equations(model).enter(run, place, columns)
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


def _added_columns(
    model: Model, runs: list[LinearRun], recordings: Sequence[int]
) -> tuple[list[Family], list[np.ndarray]]:
    """Return the families of terms, and each run's responses to all their terms, (T, ny, K)."""
    step, (names, signals) = model.sampling_time, _common_signals(model, runs)
    families, columns = [], [[] for _ in runs]
    for name in names:
        joined = np.concatenate([own[name] for own in signals])
        size = float(np.sqrt(np.mean(joined**2))) or 1.0
        terms = memory_terms(name, joined, step)
        kinds = [(STATIC, (None,) * _FUNCTIONS)]
        kinds += [(kind, tuple(term for term in terms if term.kind == kind)) for kind in KINDS]
        values = [
            np.stack(_static(x, size) + [term.along(x, step) / size for term in terms], axis=1)
            for x in (own[name] for own in signals)
        ]
        for place, equation in _equations(model).doubted:
            families += [Family(equation, name, kind, own) for kind, own in kinds]
            for found, own, run in zip(columns, values, runs, strict=True):
                found.append(_respond(model, run, place, own))
    changing, moved = changing_columns(model, runs, names, signals, recordings)
    families += changing
    for found, own in zip(columns, moved, strict=True):
        found += own
    return families, [np.concatenate(found, axis=2) for found in columns]


def _structure_of(candidates: Candidates, depending: Alternatives) -> StructureTest | None:
    """Return the best of all families, each beside what the model has.

    Args:
        candidates: families of terms, and of changing parameters.
        depending: gives the families of parameters that depend on a signal.
    """
    tests = candidates.test()
    if tests is None:
        return None
    kinds = (STATIC, *KINDS)
    if best := best_family([entry for entry in tests.beside if entry.kind in kinds]):
        # What is missing colours the errors: filtered by their colour little of it is left. Beside
        # the best family this is the colour of the noise, and shows which of them it is
        tests = candidates.test(best) or tests
    memory = [entry for entry in tests.beside if entry.kind in KINDS]
    static = best_family([entry for entry in tests.beside if entry.kind == STATIC])
    found = StructureTest(
        static,
        best_family(memory),
        best_family([entry for entry in tests.hidden if entry.kind in KINDS]),
        tuple(by_share(memory)),
    )
    return replace(found, drift=find_change(candidates, tests, [static, found.memory], depending))
