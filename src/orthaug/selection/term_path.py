"""Choice of the number of terms: a path of models, judged by free runs on held-out blocks.

Forward the terms come by what they lower the error by: of the lags that the physics reads alone, of
those of the orders that were chosen, and of all, for a term of a slow signal looks like that of its
neighbours. About the best model as many are picked anew, and from it on backward they go, the least
missed first. The choice is the smallest model that is within one standard error of the best
(Breiman et al. 1984), block by block in pairs, or worse by less than is worth a term; of as many
terms those of fewer lags. Blocks that had a say in the terms judge them too well: so the path is
gone anew without each block, and no term is chosen where physics alone is as good there. Last,
terms go that noise among so many candidates would give as well (`selection/false_discoveries.py`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.parallel import Threads, one_blas_thread
from orthaug.data.expressions import Lag
from orthaug.fitting.held_out import WORTH, held_out_blocks
from orthaug.fitting.segments import Segments, build_segments
from orthaug.selection.false_discoveries import Control, p_values
from orthaug.selection.forward import Equations, forward
from orthaug.selection.term_runs import Able, Point, TermRuns

_ONE_BY_ONE = 8  # terms are added singly up to here, later an eighth at a time
_LEAST = 1e-6  # share of the squared error left below which nothing is worth adding
# Additions that did not improve the score by `_BETTER` each, after which the path ends
_PATIENCE = 5
_BETTER = 0.005
_FOLD_ITERATIONS = 10
_ANEW = 5  # times that the terms are picked anew about the choice
# Times the mean squared error of another model on every block: surely worse
_FAR_WORSE = 2.0
# Standard errors, and of the error of physics alone: what is better by both is confirmed
_SURE, _HALF = (3.0, 0.5)
_HALVES = 50  # random halves of the data over which terms are chosen again
_PARTS = 10  # of the training data, that halves are made of
_SEED = 20_261_122

OnModel = Callable[["PathModel"], None]
"""Called with every model that was judged."""


@dataclass(frozen=True, eq=False)
class PathModel:
    """A model on the path: its terms, and its free runs' mean squared error on each held-out block.

    Errors are in units of the output squared; infinite where a free run diverged.
    """

    point: Point
    change: tuple[str, ...]
    """What was added, with a plus, or taken away, with a minus."""
    held: Vector
    seconds: float
    size: int
    """Number of terms, or of lags."""
    lags: int = 0
    """Number of lags that the model of terms reads."""

    @property
    def score(self) -> float:
        """Root of the mean over the blocks."""
        return float(np.sqrt(np.mean(self.held)))


@dataclass(frozen=True, eq=False)
class RankedModel:
    """A model against the best one: the standard error of its score, and whether it is as good.

    As good means within one standard error.
    """

    rung: PathModel
    error: float
    within: bool
    chosen: bool


def judge_all(rungs: Sequence[PathModel], terms: bool = True) -> tuple[RankedModel, ...]:
    """Return every model beside the best, block by block in pairs.

    The choice is the smallest that is as good.

    Args:
        terms: whether a model that has any may be chosen.
    """
    best, found = (
        min((rung for rung in rungs if terms or not rung.size), key=lambda rung: rung.score),
        [],
    )
    for rung in rungs:
        count = len(rung.held)
        finite = bool(np.isfinite(rung.held).all()) and (terms or not rung.size)
        worse = rung.held - best.held if finite else np.full(count, np.inf)
        tolerated = worse.std(ddof=1) / np.sqrt(count) if finite else 0.0
        within = finite and (
            (float(worse.mean()) <= tolerated and not _worse_everywhere(rung.held, best.held))
            or rung.score <= (1 + WORTH) * best.score
        )
        spread_of = (
            rung.held.std(ddof=1) / np.sqrt(count) / (2 * rung.score)
            if finite and rung.score
            else np.inf
        )
        found.append(RankedModel(rung, float(spread_of), within, False))
    able = [i for i, one in enumerate(found) if one.within]
    chosen = min(able, key=lambda i: (rungs[i].size, rungs[i].lags, rungs[i].score), default=0)
    found[chosen] = replace(found[chosen], chosen=True)
    return tuple(found)


def _worse_everywhere(held: Vector, best: Vector) -> bool:
    """Return whether a model is far worse on every block, however unequal these are."""
    return bool(np.all(held > _FAR_WORSE * best))


@dataclass(frozen=True, eq=False)
class Search:
    """All models that were judged, and the choice: the smallest within one error of the best.

    The error is the standard error of the best score.
    """

    rungs: tuple[PathModel, ...]

    def judge(self) -> tuple[RankedModel, ...]:
        """Return every model beside the best."""
        return judge_all(self.rungs)

    @property
    def place(self) -> int:
        """The number of the choice."""
        return next(i for i, one in enumerate(self.judge()) if one.chosen)


class Blocks:
    """Folds of blocked cross-validation: segments to fit, and rows of the block to simulate."""

    def __init__(self, runs: TermRuns, blocks: int, runner: Any) -> None:
        first = runs.menu.first_row
        self.runner = runner
        self.folds: list[tuple[TermRuns, Segments]] = []
        held_shape: Segments | None = None
        for kept, held in held_out_blocks(runs.problem.record, blocks, first):
            layout = build_segments(held, runs.menu, 0, runs.free_run.washout, held_shape)
            held_shape = layout if held_shape is None else held_shape
            self.folds.append((runs.on(kept), layout))
        self.given = runs, self.folds

    def along(
        self, points: Sequence[Point | None], count: int, able: Able
    ) -> tuple[list[Point], Vector]:
        """Return the path anew without each block, by as many terms.

        The mean squared errors on the blocks come with it.
        """
        items = [(i, point, count, able) for i, point in enumerate(points)]
        points, errors = zip(*self.runner.map(_path_without, self.given, items), strict=True)
        return list(points), np.array(errors)

    def judge(self, points: Sequence[Point]) -> Iterator[tuple[Vector, float]]:
        """Yield errors of the same terms on each block, fitted without it, and the seconds it took.

        Errors are mean squares of free runs.
        """
        items = [
            (point._replace(states=None), i) for point in points for i in range(len(self.folds))
        ]
        found = self.runner.map(_on_fold, self.given, items)
        for _ in points:
            errors, seconds = zip(*islice(found, len(self.folds)), strict=True)
            yield np.array(errors), sum(seconds)

    def fit_each(self, choices: Sequence[Sequence[int]]) -> Iterator[tuple[Point, Vector, float]]:
        """Yield each choice fitted to all of the record and judged; and what it took [s]."""
        points = list(self.runner.map(_on_all, self.given, choices))
        judged = self.judge([point for point, _ in points])
        for (point, fitting), (held, judging) in zip(points, judged, strict=True):
            yield point, held, fitting + judging


_Given = tuple[TermRuns, list[tuple[TermRuns, Segments]]]


def _on_all(
    given: _Given, chosen: Sequence[int], report: Callable[..., None]
) -> tuple[Point, float]:
    """Return chosen terms beside the physics, fitted from physics alone and from one step ahead.

    The time that it took [s] comes with it.
    """
    began = time.monotonic()
    return from_both_starts(given[0], chosen), time.monotonic() - began


def from_both_starts(runs: TermRuns, chosen: Sequence[int]) -> Point:
    """Return chosen terms beside the physics, fitted from physics alone and from one step ahead."""
    point = runs.fit(runs.start(), chosen)
    if (
        runs.layout is not None and chosen
    ):  # from physics alone a free run may end in a local minimum
        other = _refit(runs, runs.start(), runs.step_equations, tuple(chosen))
        point = min(point, other, key=lambda one: one.loss)
    return point


def _on_fold(
    given: _Given, item: tuple[Point, int], report: Callable[..., None]
) -> tuple[float, float]:
    """Return the mean squared error on a block of a model that is fitted without it.

    The time that it took [s] comes with it.
    """
    began, (point, number) = time.monotonic(), item
    runs, held = given[1][number]
    own = point._replace(states=None if runs.layout is None else np.asarray(runs.layout.start))
    return runs.errors(
        runs.fit(own, point.chosen, _FOLD_ITERATIONS), held
    ), time.monotonic() - began


def _path_without(
    given: _Given, item: tuple[int, Point | None, int, Able], report: Callable[..., None]
) -> tuple[Point, float]:
    """Return physics alone, or some terms more, picked without a block.

    The mean squared error on the block comes with it.
    """
    number, point, count, able = item
    runs, held = given[1][number]
    if point is None:
        point = runs.fit(runs.start(), ())
    elif np.isfinite(point.loss):
        point = _grow(runs, point, count, able)
    return point, runs.errors(point, held) if np.isfinite(point.loss) else np.inf


@dataclass(frozen=True, eq=False)
class TermPath(Search):
    """Models of terms, which are chosen where `confirmed` on blocks that had no say in them."""

    runs: TermRuns
    confirmed: bool = True
    ways: tuple[tuple[int, ...], ...] = ()
    """Terms that ways forward kept to, before the one that had all."""
    control: Control | None = None
    """The rule for a term among so many candidates; None for no such rule."""
    kept: int | None = None
    """The model that the rule left, where it took terms away; None where it took none."""

    @property
    def way(self) -> Able:
        """The terms of the first way that has those of the choice."""
        chosen = set(self.chosen.point.chosen)
        return next((able for able in self.ways if chosen <= set(able)), None)

    def judge(self) -> tuple[RankedModel, ...]:
        found = judge_all(self.rungs, self.confirmed)
        if self.kept is None:
            return found
        return tuple(replace(one, chosen=i == self.kept) for i, one in enumerate(found))

    def rates(self) -> dict[str, float]:
        """Return the least rate of false discoveries at which each chosen term would remain."""
        point, texts = self.chosen.point, self.runs.library.texts
        control = self.control or Control(1.0, len(texts))
        found = control.rates(p_values(self.runs, point)) if point.chosen else ()
        return {texts[i]: float(rate) for i, rate in zip(point.chosen, found, strict=True)}

    @property
    def chosen(self) -> PathModel:
        """The choice."""
        return self.rungs[self.place]

    def shares(self) -> dict[str, float]:
        """Return the share of random halves of the data on which each term of the choice is chosen.

        This is stability selection.

        As many terms are picked as the choice has, by the equations about the chosen model.
        """
        runs, rung = self.runs, self.chosen
        parts, most = runs.parts(rung.point, _PARTS, self.way), rung.size
        if not most or len(parts) < 4:
            return {}
        rng, count = np.random.default_rng(_SEED), np.zeros(len(runs.library))
        for _ in range(_HALVES):
            half = rng.permutation(len(parts))[: len(parts) // 2]
            picks = _pick(runs, Equations.sum_of(parts[i] for i in half), (), most)
            count[picks] += 1
        texts = runs.library.texts
        return {texts[i]: float(count[i] / _HALVES) for i in rung.point.chosen}


def climb(
    runs: TermRuns,
    blocks: int,
    most: int,
    report: OnModel = lambda rung: None,
    runner: Any = Threads(),  # noqa: B008  (it holds nothing)
    near: Sequence[Collection[Lag]] = (),
    linear: Sequence[str] = (),
    control: Control | None = None,
) -> TermPath:
    """Return the path of up to `most` terms forward, and from the best model on backward.

    Args:
        near: lags whose terms have a way forward of their own, before the one that has all.
        linear: terms that the last of these ways begins with, the linear lags that the choice of
        orders has beside the
            physics.
        control: the rate of false discoveries that is allowed; None for any.

    Raises:
        InputError: too few rows for so many blocks.
    """
    with one_blas_thread():
        folds, rungs, ways = Blocks(runs, blocks, runner), [], _ways(runs, near)
        confirmed, kept = True, None

        def judge_model(point: Point, change: Sequence[str], began: float) -> PathModel:
            known = (
                rung.held for rung in rungs if rung.point.chosen == point.chosen
            )  # ways that begin alike
            held = next(known, None)
            if held is None:
                held, _ = next(folds.judge([point]))
            lags = frozenset[Lag]().union(*(runs.lags[i] for i in point.chosen))
            rung = PathModel(
                point, tuple(change), held, time.monotonic() - began, len(point.chosen), len(lags)
            )
            rungs.append(rung)
            report(rung)
            return rung

        def path() -> TermPath:
            return TermPath(tuple(rungs), runs, confirmed, ways, control, kept)

        try:
            began = time.monotonic()
            alone = judge_model(runs.fit(runs.start(), ()), (), began)
            given = _named_candidates(runs, alone.point, linear[:most])
            for able in (*ways, None):
                begin = alone
                if (
                    given
                    and (able is None or able == ways[-1])
                    and set(given) <= set(able or given)
                ):
                    began, given_now, given = time.monotonic(), given, ()
                    point = runs.fit(alone.point, given_now)
                    begin = judge_model(
                        point,
                        ["physics alone", *(f"+ {runs.library.texts[i]}" for i in given_now)],
                        began,
                    )
                _forward(runs, begin, most, able, judge_model, again=len(rungs) > 1)
            _judge_again(path, judge_model)
            confirmed = _is_confirmed(folds, path().chosen.size, path().way)
            _backward(path(), judge_model)
            kept = _apply_control(path(), judge_model)
        except KeyboardInterrupt:
            if not rungs:
                raise
    return path()


def _ways(runs: TermRuns, near: Sequence[Collection[Lag]]) -> tuple[tuple[int, ...], ...]:
    """Return the terms of each set of lags by number, except empty, full and repeated sets."""
    own = [
        tuple(i for i, lags in enumerate(runs.lags) if lags <= frozenset(given))
        for given in near
        if given
    ]
    return tuple(able for able in dict.fromkeys(own) if 0 < len(able) < len(runs.library))


def _named_candidates(runs: TermRuns, alone: Point, linear: Sequence[str]) -> tuple[int, ...]:
    """Return the named candidates, by number, outside the span of physics and one another."""
    texts = {text: i for i, text in enumerate(runs.library.texts)}
    numbers = [texts[text] for text in linear if text in texts]
    return tuple(_pick(runs, runs.equations(alone, numbers), (), len(numbers))) if numbers else ()


def steps(most: int) -> int:
    """Return the largest number of models that are judged before terms are removed.

    They are physics alone, three ways forward, and the choice picked anew.
    """
    count, size = 0, 0
    while size < most:
        count, size = count + 1, size + _added_to(size)
    return 1 + 3 * count + _ANEW


def _added_to(size: int) -> int:
    """Return the number of terms to add at once to a model of so many."""
    return 1 if size < _ONE_BY_ONE else max(1, size // 8)


def _forward(
    runs: TermRuns, begin: PathModel, most: int, able: Able, judged: Any, *, again: bool
) -> None:
    texts, point, best, waited = runs.library.texts, begin.point, begin.score, 0
    while len(point.chosen) < most and waited < _PATIENCE and np.isfinite(point.loss):
        began = time.monotonic()
        count = min(_added_to(len(point.chosen)), most - len(point.chosen))
        before, point = point, _grow(runs, point, count, able)
        new = point.chosen[len(before.chosen) :]
        if not new or not point.loss < before.loss:
            break
        change = ["physics alone"] * (again and not before.chosen) + [f"+ {texts[i]}" for i in new]
        rung = judged(point, change, began)
        waited = 0 if rung.score < (1 - _BETTER) * best else waited + 1
        best = min(best, rung.score)


def _grow(runs: TermRuns, point: Point, count: int, able: Able) -> Point:
    """Return the point with the terms that lower the error most; the point itself without any."""
    new = _pick(runs, runs.equations(point, able), point.chosen, count, least=_LEAST)
    return runs.fit(point, (*point.chosen, *new)) if new else point


def _pick(
    runs: TermRuns, equations: Equations, chosen: Sequence[int], count: int, *, least: float = 0.0
) -> list[int]:
    """Return up to `count` further terms by number, each outside the span of those before it."""
    nt = equations.hessian.shape[0] - len(runs.library)
    known = [*range(nt), *(nt + i for i in chosen)]
    picks = forward(
        equations, known, count, least=least, within=runs.collinear, constant=runs.constant
    )
    return [pick.column - nt for pick in picks]


def _judge_again(path: Callable[[], TermPath], judged: Any) -> None:
    """Judge as many terms, picked anew at once about the chosen model.

    There the free run bends otherwise than about physics alone.
    """
    for _ in range(_ANEW):
        began, rung, runs = time.monotonic(), path().chosen, path().runs
        if not rung.size:
            return
        texts, before = runs.library.texts, set(rung.point.chosen)
        equations = runs.equations(rung.point, path().way)
        new = tuple(_pick(runs, equations, (), rung.size))
        if any({*new} == set(other.point.chosen) for other in path().rungs):
            return
        change = [f"+ {texts[i]}" for i in new if i not in before] + [
            f"− {texts[i]}" for i in sorted(before - {*new})
        ]
        judged(_refit(runs, rung.point, equations, new), change, began)


def _refit(runs: TermRuns, point: Point, equations: Equations, chosen: tuple[int, ...]) -> Point:
    """Return the point with other terms, fitted from where its equations have them."""
    nt = len(point.c)
    p = equations.of([*range(nt), *(nt + i for i in chosen)]).solve()
    return runs.fit(point._replace(chosen=chosen, c=p[:nt], w=p[nt:]), chosen)


def _is_confirmed(folds: Blocks, size: int, able: Able) -> bool:
    """Return whether up to `size` terms beat physics alone on blocks not used to pick them."""
    points: Sequence[Point | None] = [None] * len(folds.folds)
    rungs: list[PathModel] = []
    while size and (not rungs or rungs[-1].size < size):
        before = rungs[-1].size if rungs else 0
        count = min(_added_to(before), size - before) if rungs else 0
        points, held = folds.along(points, count, able)
        rungs.append(PathModel(Point((), held, held), (), held, 0.0, before + count))
        if _beyond_doubt(rungs[0].held, held):
            return True
    return bool(size) and not judge_all(rungs)[0].within


def _beyond_doubt(alone: Vector, held: Vector) -> bool:
    """Return whether physics alone is so much worse than a model that no larger one is needed."""
    worse = alone - held
    if not np.isfinite(held).all() or not np.isfinite(alone).all():
        return False
    error = float(worse.std(ddof=1)) / np.sqrt(len(held))
    sure = worse.mean() > _SURE * error or _worse_everywhere(alone, held)
    return bool(sure and np.mean(held) < _HALF**2 * np.mean(alone))


def _backward(path: TermPath, judged: Any) -> None:
    """Remove terms of the choice, one after another, as long as the rest is as good."""
    runs, rung = path.runs, path.chosen
    nt, texts = len(rung.point.c), runs.library.texts
    while rung.size > 1 and path.chosen is rung:
        began, point = time.monotonic(), rung.point
        equations = runs.equations(point, path.way)
        own = equations.of([*range(nt), *(nt + i for i in point.chosen)]).scaled()
        inverse = np.linalg.pinv(own.hessian, rcond=1e-13, hermitian=True)
        missed = (inverse @ own.right)[nt:] ** 2 / np.maximum(np.diag(inverse)[nt:], 1e-300)
        gone = point.chosen[int(np.argmin(missed))]
        left = tuple(i for i in point.chosen if i != gone)
        point = _refit(runs, point, equations, left)  # the others take over what it did
        rung = judged(point, [f"− {texts[gone]}"], began)
        path = replace(path, rungs=(*path.rungs, rung))


def _apply_control(path: TermPath, judged: Any) -> int | None:
    """Return the number of the model whose terms all pass the control.

    None where those of the choice do.
    """
    runs, rung, control, place = path.runs, path.chosen, path.control, None
    rungs = list(path.rungs)
    while control is not None and rung.size:
        began, point = time.monotonic(), rung.point
        p = p_values(runs, point)
        if p.max() <= control.largest_p(rung.size):
            break
        gone = point.chosen[int(np.argmax(p))]
        left = tuple(i for i in point.chosen if i != gone)
        place = next(
            (i for i, other in enumerate(rungs) if set(other.point.chosen) == set(left)), None
        )
        if place is None:
            fitted = _refit(runs, point, runs.equations(point, ()), left)
            rungs.append(judged(fitted, [f"− {runs.library.texts[gone]}"], began))
            place = len(rungs) - 1
        rung = rungs[place]
    return place
