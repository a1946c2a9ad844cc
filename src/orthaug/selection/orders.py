"""Orders and delays na, nb and nk beside the physics, judged by free runs on held-out blocks.

Starting from the largest orders, lags are removed as long as the rest is as good; also a
past output together with an input, for pole and zero go in pairs where both are superfluous.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orthaug._base.parallel import Threads, one_blas_thread
from orthaug.data.record import Record
from orthaug.data.regressors import Lags
from orthaug.data.terms import CONSTANT, TermLibrary
from orthaug.fitting.criteria import Criterion
from orthaug.physics.baseline import Baseline
from orthaug.physics.problem import Problem
from orthaug.selection.term_path import Blocks, OnModel, PathModel, Search, judge_all
from orthaug.selection.term_runs import TermRuns

_SURE = 1.96  # standard errors of a cross-correlation of white signals
_WHITENING = 20  # lags of the filter that whitens an input


@dataclass(frozen=True)
class Orders:
    """na of the output, and nb and nk of every input, as in `Lags`."""

    na: int
    nb: tuple[int, ...]
    nk: tuple[int, ...]

    def __str__(self) -> str:
        several = len(self.nb) != 1
        nb, nk = (str(list(n)) if several else str(n[0]) for n in (self.nb, self.nk))
        return f"na {self.na}, nb {nb}, nk {nk}"

    @property
    def size(self) -> int:
        """Number of lags."""
        return self.na + sum(self.nb)

    @property
    def first_row(self) -> int:
        """The first row that has all its lags."""
        late = (nb + nk - 1 for nb, nk in zip(self.nb, self.nk, strict=True))
        return max([self.na, *late])

    def smaller(self, least: Orders) -> Iterator[Orders]:
        """Yield one lag less: the oldest output, the oldest or the newest of an input.

        An output and an input may also go at once.
        """
        shorter = [replace(self, na=self.na - 1)] if self.na > least.na else []
        yield from shorter
        for base in (self, *shorter):
            for i, nb in enumerate(self.nb):
                if nb > 0 and self.size - nb + least.nb[i] < self.size:
                    fewer = tuple(n - (j == i) for j, n in enumerate(self.nb))
                    if nb > 1 or least.nb[i] == 0:
                        yield replace(base, nb=fewer)
                    if nb > 1 and (not least.nb[i] or self.nk[i] < least.nk[i]):
                        yield replace(
                            base, nb=fewer, nk=tuple(n + (j == i) for j, n in enumerate(self.nk))
                        )

    @property
    def lags(self) -> Lags:
        """The lags that a regressor of these orders has."""
        return Lags(self.na, self.nb, self.nk)


@dataclass(frozen=True, eq=False)
class Delay:
    """Delay of an input, by its cross-correlation with the output under whitening.

    Both signals are filtered until the input is white.

    `correlation` is None where no lag is significant; `fitted` is the first lag that the choice of
    orders kept, None where it kept none. `square` is that of the cross-correlation of the input's
    square, which is looked at where the input itself does not correlate: an even nonlinearity has
    no linear correlation.
    """

    input: str
    correlation: int | None
    fitted: int | None
    square: int | None = None

    def __str__(self) -> str:
        seen = "no lag is significant" if self.correlation is None else f"{self.correlation}"
        fitted = "the orders keep no lag" if self.fitted is None else f"{self.fitted} by the fit"
        squared = (
            "" if self.square is None else f"; {self.square} by cross-correlation of its square"
        )
        return f"{self.input}: {seen} by cross-correlation, {fitted}{squared}"

    @classmethod
    def of(cls, record: Record, number: int, most: int, orders: Orders) -> Delay:
        """Return the delay of an input by both ways."""
        linear = correlated_delay(record, number, most)
        square = correlated_delay(record, number, most, squared=True) if linear is None else None
        fitted = orders.nk[number] if orders.nb[number] else None
        return cls(record.inputs[number].name, linear, fitted, square)


@dataclass(frozen=True, eq=False)
class OrderSearch(Search):
    """Models of linear lags and a constant."""

    orders: tuple[Orders, ...]
    constant: bool = False
    """True if the choice needs a constant that the physics does not have."""

    @property
    def chosen(self) -> Orders:
        """Those of the choice."""
        return self.orders[self.place]

    def linear_texts(self, record: Record, baseline: Baseline) -> list[str]:
        """Return linear lags of the choice, and its constant, that the physics does not have."""
        outputs, inputs = (
            [channel.name for channel in group] for group in (record.outputs, record.inputs)
        )
        own = {term.regressor for term in baseline.terms}
        linear = [str(lag) for lag in self.chosen.lags.layout(outputs, inputs)]
        return [text for text in [*linear, *([CONSTANT] * self.constant)] if text not in own]


def search_orders(
    problem: Problem,
    criterion: Criterion,
    largest: Orders,
    least: Orders,
    blocks: int,
    report: OnModel = lambda rung: None,
    runner: Any = Threads(),  # noqa: B008  (it holds nothing)
) -> OrderSearch:
    """Judge orders from `largest` down, never below `least`, what the physics reads already.

    Every model has a constant: without one, further lags would make up for the level of the
    signals.

    Raises:
        InputError: too few rows for so many blocks.
    """
    output, inputs = problem.outputs[0], [channel.name for channel in problem.record.inputs]
    lags = [f"{output}[k-{i}]" for i in range(1, largest.na + 1)]
    place = {(output, i): i - 1 for i in range(1, largest.na + 1)}
    for name, nb, nk in zip(inputs, largest.nb, largest.nk, strict=True):
        for i in range(nk, nk + nb):
            place[name, i] = len(lags)
            lags.append(f"{name}[k-{i}]" if i else f"{name}[k]")
    runs = TermRuns.of(
        problem, TermLibrary(tuple(lags), (*((i,) for i in range(len(lags))), ())), criterion
    )
    level = [len(lags)] if runs.constant == len(problem.baseline.names) + len(lags) else []
    known = {str(lag) for term in problem.baseline.terms for lag in [term.regressor]}
    found: dict[Orders, PathModel] = {}
    with one_blas_thread():
        folds = Blocks(runs, blocks, runner)

        def choose_orders(orders: Orders, level: list[int] = level) -> list[int]:
            numbers = [place[output, i] for i in range(1, orders.na + 1)]
            for name, nb, nk in zip(inputs, orders.nb, orders.nk, strict=True):
                numbers += [place[name, i] for i in range(nk, nk + nb)]
            return [i for i in numbers if lags[i] not in known] + level

        def judge(several: Iterable[Orders]) -> None:
            new = [orders for orders in dict.fromkeys(several) if orders not in found]
            for orders, (point, held, seconds) in zip(
                new, folds.fit_each(list(map(choose_orders, new))), strict=True
            ):
                found[orders] = PathModel(point, (str(orders),), held, seconds, orders.size)
                report(found[orders])

        try:
            shorter = []
            for na in range(max(least.na, min(1, largest.na)), largest.na + 1):
                fewer = largest.na - na
                nb = tuple(
                    max(n - fewer, low, min(n, 1))
                    for n, low in zip(largest.nb, least.nb, strict=True)
                )
                shorter.append(Orders(na, nb, largest.nk))
            judge(shorter)
            _shrink(found, judge, least)
        except KeyboardInterrupt:
            if not found:
                raise
        search = OrderSearch(tuple(found.values()), tuple(found))
        if not level:
            return search
        point, held, seconds = next(folds.fit_each([choose_orders(search.chosen, [])]))
        without = PathModel(point, (), held, seconds, search.chosen.size)
        needed = not judge_all(
            (without, replace(search.rungs[search.place], size=without.size + 1))
        )[0].within
        return replace(search, constant=needed)


def _shrink(
    found: dict[Orders, PathModel], judge: Callable[[Iterable[Orders]], None], least: Orders
) -> None:
    """Remove one lag after another from the best orders, as long as the rest is as good."""
    current = min(found, key=lambda orders: found[orders].score)
    while True:
        smaller = list(current.smaller(least))
        judge(smaller)
        within = dict(zip(found, judge_all(tuple(found.values())), strict=True))
        able = [orders for orders in smaller if within[orders].within]
        if not able:
            return
        current = min(able, key=lambda orders: found[orders].score)


def correlated_delay(
    record: Record, number: int, most: int, *, squared: bool = False
) -> int | None:
    """Return the first lag at which an input, made white, acts on the output.

    None where none is significant.

    Both signals go through the filter that makes the input white (Box and Jenkins); a lag counts
    from 1.96/√N on, for all `most` lags together.

    Args:
        number: of the input.
        most: the largest lag that is looked at.
        squared: of the input's square about its mean.
    """
    total, rows = np.zeros(most + 1), 0
    for experiment in record.experiments:
        u, y = experiment.inputs[:, number], experiment.outputs[:, 0]
        n = min(_WHITENING, len(u) // 10)
        u, y = u - u.mean(), y - y.mean()
        u = u**2 - np.mean(u**2) if squared else u
        past = (
            np.column_stack([u[n - i : len(u) - i] for i in range(1, n + 1)])
            if n
            else np.zeros((len(u), 0))
        )
        filtered = np.linalg.lstsq(past, u[n:], rcond=1e-8)[0] if n else np.zeros(0)
        taps = np.concatenate([[1.0], -filtered])
        white, out = (np.convolve(part, taps)[n : len(part)] for part in (u, y))
        white, out = (part / max(float(part.std()), 1e-300) for part in (white, out))
        total += [float(white[: len(white) - lag] @ out[lag:]) for lag in range(most + 1)]
        rows += len(white)
    bound = _SURE * np.sqrt(1 + 2 * np.log(most + 1)) / np.sqrt(rows)
    over = np.flatnonzero(np.abs(total) / rows > bound)
    return int(over[0]) if len(over) else None
