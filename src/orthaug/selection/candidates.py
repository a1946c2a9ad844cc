"""Terms of a library that can be chosen on given data, shortlisted where there are very many."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Vector
from orthaug._base.errors import InputError, Warning
from orthaug._base.lines import first_words
from orthaug.data.terms import TermLibrary, products_of
from orthaug.fitting.criteria import Prediction
from orthaug.physics.problem import Problem
from orthaug.selection.forward import DEPENDENT, Equations, forward
from orthaug.selection.term_runs import TermRuns

SHORTLIST = 400
"""As many terms are linearised at once; of more the most promising are looked at."""
_BLOCK = 2000  # terms that are evaluated at once
_CHUNK = 4096  # rows
_ROUNDS = 5  # of looking through all terms
_PICKED = 8  # terms between two rounds
_NAMED = 6


@dataclass(frozen=True, eq=False)
class Candidates:
    """Terms that can be chosen, and warnings on the others."""

    library: TermLibrary
    notes: tuple[Warning, ...]
    considered: int
    """Number of terms that could have been chosen, those that promise little included."""


def candidates(problem: Problem, library: TermLibrary) -> Candidates:
    """Return the terms that the physics does not express, of many the `SHORTLIST` most promising.

    A term is promising by what it lowers the error one step ahead, beside the physics and beside
    those that are picked between rounds of looking through all (iterated screening). Nothing of the
    size rows × terms is kept.

    Raises:
        InputError: no term is left.
    """
    runs = TermRuns.of(problem, library, Prediction())
    known = _ModelColumns.of(runs)
    norms, left, _ = known.weigh(runs)
    finite = np.isfinite(norms)
    own = finite & (left > DEPENDENT * norms) & (norms > 0)
    notes = _notes(library, finite, own)
    if not own.any():
        raise InputError(
            "the physics expresses all candidate terms already; give other functions, or a "
            "higher degree."
        )
    kept = np.flatnonzero(own)
    if len(kept) > SHORTLIST:
        kept = _promising_terms(runs, known, kept)
        text = (
            f"of {own.sum()} terms the {len(kept)} that are most promising one step ahead were "
            "tried on the free run."
        )
        notes.append(Warning("terms_shortlisted", text))
    return Candidates(library.pick(kept), tuple(notes), int(own.sum()))


@dataclass(frozen=True, eq=False)
class _ModelColumns:
    """Columns of the model: their orthonormal basis Q over the rows, and the error left."""

    q: Float[np.ndarray, "N k"]
    left: Vector

    @classmethod
    def of(cls, runs: TermRuns) -> _ModelColumns:
        """Return the columns of the physics without terms."""
        every = (
            runs.physics(*runs.rows(experiment)) for experiment in runs.problem.record.experiments
        )
        phi, target = zip(*every, strict=True)
        return cls(np.zeros((sum(map(len, target)), 0)), np.concatenate(target)).beside(
            np.concatenate(phi)
        )

    def beside(self, columns: Float[np.ndarray, "N m"]) -> _ModelColumns:
        """Return the columns with further ones."""
        size = np.linalg.norm(columns, axis=0)
        columns = columns / np.where(size > 0, size, 1.0)
        for _ in range(2):  # twice is enough
            columns = columns - self.q @ (self.q.T @ columns)
        u, sigma, _ = np.linalg.svd(columns, full_matrices=False)
        u = u[:, sigma > 1e-10]
        return _ModelColumns(np.column_stack([self.q, u]), self.left - u @ (u.T @ self.left))

    def weigh(
        self, runs: TermRuns, chosen: Sequence[int] | np.ndarray | None = None
    ) -> tuple[Vector, Vector, Vector]:
        """Return each term's squared norm, its part outside the model, and product with error."""
        every = np.arange(len(runs.library)) if chosen is None else np.asarray(chosen)
        norms, left, right = (np.zeros(len(every)) for _ in range(3))
        for a in range(0, len(every), _BLOCK):
            block = slice(a, a + _BLOCK)
            across = np.zeros((self.q.shape[1], len(every[block])))
            with np.errstate(all="ignore"):
                for rows, terms in _chunks(runs, every[block]):
                    norms[block] += np.einsum("kn,kn->k", terms, terms)
                    across += (terms @ self.q[rows]).T
                    right[block] += terms @ self.left[rows]
                left[block] = norms[block] - np.einsum("ik,ik->k", across, across)
        return norms, left, right


def _chunks(
    runs: TermRuns, chosen: Sequence[int] | np.ndarray
) -> Iterator[tuple[slice, Float[np.ndarray, "K m"]]]:
    numbers, begin = runs.library.numbers[np.asarray(chosen, dtype=int)], 0
    for experiment in runs.problem.record.experiments:
        factors = runs.factors(experiment)
        for a in range(0, factors.shape[1], _CHUNK):
            terms = products_of(factors[:, a : a + _CHUNK], numbers, np)
            yield slice(begin + a, begin + a + terms.shape[1]), terms
        begin += factors.shape[1]


def _promising_terms(runs: TermRuns, known: _ModelColumns, among: np.ndarray) -> np.ndarray:
    """Return the most promising terms, in rounds: one look through all, then picks of the best."""
    found: dict[int, None] = {}
    for _ in range(_ROUNDS):
        norms, left, right = known.weigh(runs, among)
        able = left > DEPENDENT * norms
        gains = np.where(able, right**2 / np.where(able, left, 1.0), 0.0)
        best = among[np.argsort(-gains)[: SHORTLIST // _ROUNDS + len(found)]]
        new = [int(i) for i in best if int(i) not in found][: SHORTLIST // _ROUNDS]
        found |= dict.fromkeys(new)
        columns = np.concatenate([terms for _, terms in _chunks(runs, new)], axis=1).T
        rest = columns - known.q @ (known.q.T @ columns)
        square = float(known.left @ known.left)
        picks = forward(
            Equations(rest.T @ rest, rest.T @ known.left, square, len(rest)), (), _PICKED
        )
        known = known.beside(columns[:, [pick.column for pick in picks]])
    return np.array(sorted(found))


def _notes(library: TermLibrary, finite: np.ndarray, own: np.ndarray) -> list[Warning]:
    texts, notes = library.texts, []
    infinite = [texts[i] for i in np.flatnonzero(~finite)]
    if infinite:
        named = first_words(infinite, _NAMED)
        text = f"terms that are not finite on these data were left out: {named}."
        notes.append(Warning("terms_not_finite", text))
    known = [texts[i] for i in np.flatnonzero(finite & ~own)]
    if known:
        named = first_words(known, _NAMED)
        text = f"terms that the physics expresses already were left out: {named}."
        notes.append(Warning("terms_are_physics", text))
    return notes
