"""Parameters that change: along a curve of time, with a signal's past, or between experiments.

A part that heats up, wears or empties changes what the physics calls a constant. To first order the
outputs follow such a parameter as they follow the parameter itself, times what it follows; these
are families of terms beside all others (`family_tests`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.columns import least_squares
from orthaug.analysis.family_tests import Candidates, Family, FamilyTest, Tests, best_family
from orthaug.analysis.memory import MemoryTerm
from orthaug.analysis.output_response import LinearRun
from orthaug.models.model import Model

CLEARLY = 0.1
"""Share by which one cause predicts clearly more than another."""

_DRIFT, _SCHEDULED, _STEPPED = _CHANGES = "drift", "scheduled", "stepped"
_DEPENDING = "depending"

Alternatives = Callable[[], tuple[list[Family], list[np.ndarray]]]
"""Gives families of terms, and each run's responses to all their terms (T, ny, K)."""
_MOST_EXPERIMENTS = 6  # of more, a block of held-out rows may be all that one has
# Time constants, in samples, of what a parameter may follow; rows from which on it is looked for
_SLOW, _SLOW_ROWS = (16.0, 32.0, 64.0, 128.0, 256.0, 512.0), 1000
_LIKELY = 0.5  # p with which a family is worth a second look
_HIDDEN_SHARE = 0.2  # least of the errors that a drift explains whose own colour hides it
_BENT = 0.5  # of the distance of both ends: from there on a curve turns far beyond them


@dataclass(frozen=True)
class ParameterDrift:
    """A parameter, by its place, that seems to change over the record.

    `share` of the errors is what its change predicts: a curve of the second degree over time, or a
    multiple of the slow lag `follows` of a signal's square, as of a gain that falls as its device
    heats up, or a value of its own in `each` experiment. `begin` and `end` are by how much its
    value at either end of the record, or where that lag is smallest and largest, differs from the
    model's, in the coordinate that is estimated.
    """

    place: int
    share: float
    begin: float
    end: float
    follows: MemoryTerm | None = None
    turn: float | None = None
    """The difference where the curve turns, where that is far beyond both ends; None elsewhere."""
    each: tuple[float, ...] = ()
    """The differences in each experiment, where it has a value of its own in each."""
    on: str = ""
    """The signal of which it is a function of the second degree. `begin`, `turn` and `end` are then
    at its least value, in the middle and at its largest, `at`.
    """
    at: tuple[float, ...] = ()


def changing_columns(
    model: Model,
    runs: list[LinearRun],
    names: list[str],
    signals: list[dict[str, Vector]],
    recordings: Sequence[int],
) -> tuple[list[Family], list[list[np.ndarray]]]:
    """Return families of parameters that change over time, and the responses of every run.

    Args:
        names: of the signals whose past parameters may follow.
        signals: of every run, by name.
        recordings: of which experiment every run is a stretch, from 0.
    """
    count, step = len(model.numbers.theta), model.sampling_time
    kinds = (
        _scheduled_columns(count, step, runs, names, signals),
        _drift_columns(count, runs),
        _stepped_columns(count, runs, recordings),
    )
    families = [family for found, _ in kinds for family in found]
    return families, [sum(own, []) for own in zip(*(found for _, found in kinds), strict=True)]


def _scheduled_columns(
    count: int,
    step: float,
    runs: list[LinearRun],
    names: list[str],
    signals: list[dict[str, Vector]],
) -> tuple[list[Family], list[list[np.ndarray]]]:
    """Return families of parameters that follow slow lags of a signal's square, and responses.

    The lag begins at the mean, as that of a device that has run before the record. None in records
    too short to show it.
    """
    rows = sum(len(run.error) for run in runs)
    families, columns = [], [[] for _ in runs]
    constants = [steps for steps in _SLOW if rows >= _SLOW_ROWS and steps <= rows / 10]
    for name in names if constants else ():
        mean = float(np.mean(np.concatenate([own[name] for own in signals]) ** 2))
        square = f"{name}**2" if " " not in name else f"({name})**2"
        terms = tuple(MemoryTerm("lag", square, steps * step) for steps in constants)
        lags = [
            np.stack([term.along(np.append(mean, own[name] ** 2), step)[1:] for term in terms])
            - mean
            for own in signals
        ]
        joined = np.concatenate(lags, axis=1)
        ranges = tuple(zip(joined.min(axis=1), joined.max(axis=1), strict=True))
        families += [Family("", str(i), _SCHEDULED, terms, ranges) for i in range(count)]
        for found, run, lag in zip(columns, runs, lags, strict=True):
            found.append(_changes(run, lag.T))
    return families, columns


def depending_columns(
    model: Model,
    runs: list[LinearRun],
    names: list[str],
    signals: list[dict[str, Vector]],
) -> tuple[list[Family], list[np.ndarray]]:
    """Return families of parameters that depend on a signal, and the responses of every run.

    A gain that falls with a stroke is such a function, of the second degree here. It follows the
    short past of the stroke's square nearly as well.

    Args:
        names: of the signals.
        signals: of every run, by name.
    """
    count, families, columns = len(model.numbers.theta), [], [[] for _ in runs]
    for name in names:
        joined = np.concatenate([own[name] for own in signals])
        low, high = float(joined.min()), float(joined.max())
        families += [
            Family(name, str(i), _DEPENDING, (None, None), ((low, high),)) for i in range(count)
        ]
        for found, run, own in zip(columns, runs, signals, strict=True):
            scaled = (2 * own[name] - low - high) / (high - low)
            found.append(_changes(run, np.stack([scaled, scaled**2], axis=1)))
    return families, [np.concatenate(found, axis=2) for found in columns]


def _drift_columns(
    count: int, runs: list[LinearRun]
) -> tuple[list[Family], list[list[np.ndarray]]]:
    """Return families of parameters that are curves of the second degree, and responses."""
    rows = [len(run.error) for run in runs]
    over_time = np.split(np.linspace(-1, 1, sum(rows)), np.cumsum(rows)[:-1])
    families = [Family("", str(i), _DRIFT, (None, None)) for i in range(count)]
    pairs = zip(runs, over_time, strict=True)
    return families, [[_changes(run, np.stack([t, t**2], axis=1))] for run, t in pairs]


def _stepped_columns(
    count: int, runs: list[LinearRun], recordings: Sequence[int]
) -> tuple[list[Family], list[list[np.ndarray]]]:
    """Return families of parameters with a value of their own in each experiment, and responses.

    The first experiment has the common value. None of a single one, or of many.
    """
    last = max(recordings, default=0)
    if not 1 <= last < _MOST_EXPERIMENTS or len(recordings) != len(runs):
        return [], [[] for _ in runs]
    families = [Family("", str(i), _STEPPED, (None,) * last) for i in range(count)]
    found = []
    for run, own in zip(runs, recordings, strict=True):
        steps = np.zeros((len(run.error), last))
        steps[:, own - 1 : own] = 1.0  # none of experiment 0
        found.append([_changes(run, steps)])
    return families, found


def _changes(run: LinearRun, over_time: Matrix) -> np.ndarray:
    """Return the responses to all parameters, each changed by all k signals (T, k) in turn."""
    moved = run.changes(over_time)
    return moved.reshape(*moved.shape[:2], -1)


def find_change(
    candidates: Candidates,
    tests: Tests,
    others: list[FamilyTest | None],
    depending: Alternatives,
) -> ParameterDrift | None:
    """Return the change of a parameter that predicts more than all other terms; None without one.

    Args:
        candidates: what was tested, changing parameters among it.
        tests: their tests.
        others: the best terms of other kinds.
        depending: gives the families of parameters that depend on a signal.
    """
    known = [one.share for one in others if one is not None]
    stepped = _look(tests, _STEPPED) or _look_again(candidates, tests, _STEPPED)
    if stepped is not None and _is_simplest(stepped, known):
        return _change_of(candidates, stepped.tests, stepped.best)
    drift, slow = _look(tests, _DRIFT), _look(tests, _SCHEDULED)
    if slow is None:
        slow = _look_again(candidates, tests, _SCHEDULED)
    if drift is None and slow is None:
        drift = _look_again(candidates, tests, _DRIFT)
    if drift is not None and drift.share < max(known, default=0.0):
        drift = None
    shares = known if drift is None else [*known, drift.share]
    if slow is not None and slow.share > (1 + CLEARLY) * max(shares, default=0.0):
        drift = slow
    if slow is None or drift is not slow:
        return None if drift is None else _change_of(candidates, drift.tests, drift.best)
    return _without_past(candidates, slow, depending)


def _without_past(
    candidates: Candidates, slow: _Seen, depending: Alternatives
) -> ParameterDrift | None:
    """Return the change of a parameter that seems to follow the slow past of a signal.

    It is one where functions of the present, and memory of other kinds, predict clearly less in
    the same rows. Else it is the parameter that depends on a signal, if that predicts most.
    """
    families, columns = depending()
    both = replace(
        candidates,
        families=[*candidates.families, *families],
        added=[
            np.concatenate(pair, axis=2) for pair in zip(candidates.added, columns, strict=True)
        ],
    )
    tests = both.test(slow.best)
    if tests is None:
        return None
    same = (slow.best.on, slow.best.kind)
    own = max((one.share for one in tests.beside if (one.on, one.kind) == same), default=0.0)
    other = best_family([one for one in tests.beside if one.kind not in _CHANGES])
    if other is None or own > (1 + CLEARLY) * other.share:
        return _change_of(candidates, slow.tests, slow.best)
    return _change_of(both, tests, other) if other.kind == _DEPENDING else None


@dataclass(frozen=True)
class _Seen:
    """A family of changing parameters that is sure in tests."""

    best: FamilyTest
    tests: Tests

    @property
    def share(self) -> float:
        return self.best.share


def _is_simplest(stepped: _Seen, others: list[float]) -> bool:
    """Return whether no drift, state or term predicts clearly more than a value in each experiment.

    Shares of the tests that show it are compared, and those that were found before.
    """
    beside = best_family([one for one in stepped.tests.beside if one.kind != _STEPPED])
    shares = others if beside is None else [*others, beside.share]
    return (1 + CLEARLY) * stepped.share >= max(shares, default=0.0)


def _look(tests: Tests, kind: str) -> _Seen | None:
    """Return the family of a kind that is sure and predicts most; None without one."""
    own = [one for one in tests.beside if one.kind == kind]
    best = _best_scheduled(tests) if kind == _SCHEDULED else best_family(own)
    return None if best is None else _Seen(best, tests)


def _look_again(candidates: Candidates, tests: Tests, kind: str) -> _Seen | None:
    """Return the family that is sure in rows filtered by the colour that its likeliest leaves.

    A slow change colours the errors: filtered by that colour hardly anything of it is left. What
    functions of signals predict better in the same rows is none.
    """
    likely = _likeliest(tests, kind)
    again = None if likely is None else candidates.test(likely)
    found = None if again is None else _look(again, kind)
    if found is None or kind != _DRIFT:
        return found
    other = best_family([one for one in found.tests.beside if one.kind not in _CHANGES])
    least = _HIDDEN_SHARE if other is None else max(other.share, _HIDDEN_SHARE)
    return found if found.share >= least else None


def _best_scheduled(tests: Tests) -> FamilyTest | None:
    """Return the family of a parameter that surely follows a signal.

    It is sure beside all terms of one row, too, which grow with the signal as well.
    """
    surely = {_scheduled_by(one) for one in tests.hidden if one.kind == _SCHEDULED and one.sure}
    return best_family(
        [one for one in tests.beside if one.kind == _SCHEDULED and _scheduled_by(one) in surely]
    )


def _likeliest(tests: Tests, kind: str) -> FamilyTest | None:
    """Return the family of a kind that most likely is there; None where all are by chance."""
    likely = [one for one in tests.beside if one.kind == kind and one.p < _LIKELY]
    return max(likely, key=lambda one: one.share, default=None)


def _scheduled_by(one: FamilyTest) -> tuple[str, str]:
    """Return the parameter and the signal of a family."""
    assert one.term is not None
    return one.on, one.term.on


def _change_of(candidates: Candidates, tests: Tests, best: FamilyTest) -> ParameterDrift:
    """Return how far the parameter of a family is from the model's at either end of its change."""
    at, place, whole = candidates.places_of(best), int(best.on), tests.rows
    family = next(one for one in candidates.families if one.is_of(best))
    every = list(range(len(family.terms)))
    chosen = every if best.term is None else [family.terms.index(best.term)]
    taken = [*range(tests.known), *(tests.known + at[j] for j in chosen)]
    steps = least_squares(whole[:, taken], whole[:, -1]) * tests.size[-1] / tests.size[taken]
    middle, moved = candidates.shift[place] + steps[place], steps[tests.known :]
    turn = None
    if best.kind == _STEPPED:
        each = (float(middle), *(float(middle + one) for one in moved))
        return ParameterDrift(place, best.share, each[0], each[-1], each=each)
    if best.term is None:
        linear, square = moved
        ends = middle - linear + square, middle + linear + square
        if best.kind == _DEPENDING:
            low, high = family.ranges[0]
            values = tuple(map(float, (*ends, middle)))
            at = low, (low + high) / 2, high
            return ParameterDrift(
                place, best.share, values[0], values[1], turn=values[2], on=best.equation, at=at
            )
        turn = _turn_of(float(middle), float(linear), float(square))
    else:
        low, high = family.ranges[chosen[0]]
        ends = middle + moved[0] * low, middle + moved[0] * high
    return ParameterDrift(place, best.share, float(ends[0]), float(ends[1]), best.term, turn)


def _turn_of(middle: float, linear: float, square: float) -> float | None:
    """Return the value of a curve over -1 to 1 where it turns, if that is far beyond its ends."""
    if abs(linear) >= 2 * abs(square):
        return None
    beyond = abs(square) + linear**2 / (4 * abs(square)) - abs(linear)  # the nearer end
    return middle - linear**2 / (4 * square) if beyond > _BENT * 2 * abs(linear) else None
