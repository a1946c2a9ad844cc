"""Tests of families of terms that a model may lack, in the filtered errors of its free runs.

Rows and columns are filtered by the autoregression of the errors beside the model (Cochrane and
Orcutt 1949), so that what remains of noise is white. A family counts where its F-test rejects at
the level divided by the number of families and it predicts blocks of rows that it was not fitted
to.

One filter is the same for all rows. Noise that enters equations with products, such as those of a
switched converter, has a colour that changes with the signals, and left from row to row it looks
like structure. Filtered by the model's own step it is the error one step ahead: where that is
white, it has to show a family, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

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
from orthaug.analysis.memory import MemoryTerm
from orthaug.analysis.output_response import LinearRun
from orthaug.analysis.predictability import BlockSums, Share

STATIC = "static"
"""Kind of a family of functions of one row."""

_LEVEL = 0.01
_DIGITS = 9  # of a share that are no rounding
_ROWS_PER_COLUMN = 4
_OWN = 1e-3  # of a column's size: what is left of it beside the model, so that it is one of its own


@dataclass(frozen=True)
class FamilyTest:
    """A family of terms in one equation, and the `share` of the errors that it predicts.

    The share is of the filtered errors' square, on held-out blocks, and at most that on all rows:
    where a block's own base does not determine it, any further column seems to help.

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
    def key(self) -> tuple[str, ...]:
        """What distinguishes its family from the others."""
        return self.equation, self.on, self.kind, "" if self.term is None else self.term.on

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
class Family:
    """Terms of one kind on one signal, which are added to one equation and tested together."""

    equation: str
    on: str
    kind: str
    terms: tuple[MemoryTerm | None, ...]
    ranges: tuple[tuple[float, float], ...] = ()
    """Smallest and largest value of what each term adds."""

    def is_of(self, test: FamilyTest) -> bool:
        """Return whether a test is one of this family."""
        own = (self.equation, self.on, self.kind)
        return own == (test.equation, test.on, test.kind) and test.term in self.terms


@dataclass(frozen=True, eq=False)
class Tests:
    """Tests of all families beside the model's columns, and beside all static ones, too.

    Attributes:
        rows: filtered and normalised: the `known` columns of the model, those of the families, and
            the errors.
        size: norms that the columns were divided by.
        beside: every family beside the model's columns.
        find_hidden: tests every family beside these and all static ones.
    """

    rows: Matrix
    known: int
    size: Vector
    beside: list[FamilyTest]
    find_hidden: Callable[[], list[FamilyTest]]

    @cached_property
    def hidden(self) -> list[FamilyTest]:
        """Every family beside the model's columns and all static ones; few looks ask for them."""
        return self.find_hidden()


@dataclass(frozen=True)
class Candidates:
    """Families of terms that may be added to a model, and what they do to its free runs.

    Attributes:
        base: the model's own columns of every run (T, ny, k): parameters first, starts behind them.
        families: what may be added, with as many columns as terms.
        added: the families' columns of every run (T, ny, K).
        shift: by how much the parameters of `runs` differ from the model's (nt,).
        one_step: filters what is added to the outputs of a run (T, ny, k) by the model's own step;
            None where the model has no such filter.
    """

    runs: list[LinearRun]
    base: list[np.ndarray]
    families: list[Family]
    added: list[np.ndarray]
    shift: Vector
    one_step: Callable[[LinearRun, np.ndarray], np.ndarray] | None = None

    def test(self, coloured_beside: FamilyTest | None = None) -> Tests | None:
        """Test all families in rows filtered by the colour of the errors.

        The colour is that of errors beside the model, and beside a family where one is given. None
        where there are too few rows, or some are not finite.
        """
        runs, families, shift, base = self.runs, self.families, self.shift, self.base
        if coloured_beside is not None:
            own = self.places_of(coloured_beside)
            base = [
                np.concatenate([columns, new[..., own]], axis=2)
                for columns, new in zip(base, self.added, strict=True)
            ]
        known, colours = self.base[0].shape[2], error_colours(runs, base)[1]
        both = [np.concatenate(each, axis=2) for each in zip(self.base, self.added, strict=True)]
        whole = np.concatenate(
            [filter_rows(piece, colours) for piece in stacked_rows(runs, both, error_scale(runs))]
        )
        if len(whole) < _ROWS_PER_COLUMN * (known + len(families)):
            return None
        if not np.isfinite(whole).all():
            return None
        whole, size = self._normalised(whole)
        static = np.concatenate(
            [np.full(len(family.terms), family.kind == STATIC) for family in families]
        )
        own, simple = list(range(known)), [known + int(j) for j in np.flatnonzero(static)]
        turn, reduced = np.linalg.qr(whole)  # few rows say of the columns what all rows say
        run = partial(_test_families, turn, reduced, known=known, families=families, size=size)
        beside = self._sure_one_step(run(own, shift=shift), own)

        def find_hidden() -> list[FamilyTest]:
            return self._sure_one_step(run(own + simple, shift=None), own + simple)

        return Tests(whole, known, size, beside, find_hidden)

    def _normalised(self, whole: Matrix) -> tuple[Matrix, Vector]:
        """Return rows without what the starts explain, in units of their norms, and the norms."""
        first = len(self.shift)
        starts = slice(first, first + self.runs[0].states.shape[1] * len(self.runs))
        q = span(whole[:, starts], RANK)
        # They move a few rows of one run only: blocks would not show them
        whole = whole - q @ (q.T @ whole)
        whole[:, starts] = 0.0
        size = np.linalg.norm(whole, axis=0)
        size = np.where(size > 0, size, 1.0)
        return whole / size, size

    @cached_property
    def _one_step_rows(self) -> Matrix | None:
        """Columns and errors filtered by the model's own step; None unless these are white."""
        if self.one_step is None:
            return None
        runs, filters = self.runs, partial(map, self.one_step, self.runs)
        errors = [one[..., 0] for one in filters([run.error[..., None] for run in runs])]
        runs = [replace(run, error=error) for run, error in zip(runs, errors, strict=True)]
        pieces, colours = error_colours(runs, list(filters(self.base)))
        if any(len(colour) > 1 for colour in colours):
            return None
        scale = error_scale(runs)[:, None]
        added = [one / scale for one in filters(self.added)]
        known = self.base[0].shape[2]
        whole = np.concatenate(
            [
                np.concatenate([own[..., :known], new, own[..., known:]], axis=2)
                for own, new in zip(pieces, added, strict=True)
            ]
        )
        whole = whole.reshape(-1, whole.shape[2])
        return self._normalised(whole)[0] if np.isfinite(whole).all() else None

    def _sure_one_step(self, tests: list[FamilyTest], base: list[int]) -> list[FamilyTest]:
        """Return tests with the larger p of their own and of those one step ahead.

        Only where the errors one step ahead are white.
        """
        if not any(one.sure for one in tests) or self._one_step_rows is None:
            return tests
        turn, reduced = np.linalg.qr(self._one_step_rows)
        known = self.base[0].shape[2]
        again = _test_families(
            turn, reduced, base, known, self.families, np.ones(reduced.shape[1]), None
        )
        found = {one.key: one.p for one in again}
        return [replace(one, p=max(one.p, found.get(one.key, 1.0))) for one in tests]

    def places_of(self, one: FamilyTest) -> list[int]:
        """Return the places of a tested family's columns among those of all families."""
        first = 0
        for family in self.families:
            if family.is_of(one):
                return list(range(first, first + len(family.terms)))
            first += len(family.terms)
        raise ValueError(one)


def _test_families(
    turn: Matrix,
    whole: Matrix,
    base: list[int],
    known: int,
    families: list[Family],
    size: Vector,
    shift: Vector | None,
) -> list[FamilyTest]:
    """Test every family beside the columns of a base.

    Rows are `turn @ whole`, a QR factorisation. `size` are the norms that columns were divided by.
    """
    q = span(whole[:, base], RANK)
    rest = whole[:, known:] - q @ (q.T @ whole[:, known:])
    target, terms = rest[:, -1], rest[:, :-1]
    total, left = float(target @ target), len(turn) - q.shape[1]
    # Of the target and every term: a term beside the base moves it by its own share of them
    solved = None if shift is None else least_squares(whole[:, base], whole[:, known:])
    sums = BlockSums.of(turn @ np.concatenate([q, terms], axis=1), turn @ whole[:, -1])
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
        share = _at_most(sums.share([len(blocks) + j for j in own], blocks), gained / total)
        chosen = max(own, key=lambda j: (terms[:, j] @ target) ** 2 / (terms[:, j] @ terms[:, j]))
        term = family.terms[chosen - (place - len(family.terms))]
        entry = FamilyTest(
            family.equation, family.on, family.kind, share.value, share.error, float(p), term
        )
        if shift is not None and solved is not None and term is not None:
            beside = (terms[:, chosen] @ target) / (terms[:, chosen] @ terms[:, chosen])
            step = (solved[:, -1] - beside * solved[:, chosen])[: len(shift)]
            entry = replace(
                entry, moves=tuple(map(float, shift + step * size[-1] / size[: len(shift)]))
            )
        found.append(entry)
    return [replace(entry, p=min(entry.p * len(found), 1.0)) for entry in found]


def _at_most(share: Share, most: float) -> Share:
    """Return a share that is no larger than another, as sure as it was."""
    if share.value <= most:
        return share
    return Share(most, share.error * most / share.value)


def by_share(entries: list[FamilyTest]) -> list[FamilyTest]:
    """Return families by falling share; those that span the same rows keep their order."""
    return sorted(entries, key=lambda entry: -round(entry.share, _DIGITS))


def best_family(entries: list[FamilyTest]) -> FamilyTest | None:
    """Return the family with the largest share of those that are sure; None without any."""
    return next(iter(by_share([entry for entry in entries if entry.sure])), None)
