"""Removal of learner terms that are linear combinations of others on the data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from orthaug._base.errors import InputError, Warning
from orthaug._base.lines import first_words
from orthaug.data.regressors import Features
from orthaug.models.learners import Learner, NoLearner, learns
from orthaug.models.terms import Terms
from orthaug.physics.problem import Problem

_LEFT = 3e-5  # of a term's norm: what the physics and the terms before it leave of a dependent one
_NAMED = 6


def independent_terms(
    problem: Problem, learner: Learner
) -> tuple[Problem, Learner, tuple[Warning, ...]]:
    """Return problem and learner without linearly dependent terms, and a warning.

    A term depends on the physics or on the terms before it, on these rows.

    Another learner is left as it is; without one the problem has no features.

    Raises:
        InputError: more terms than rows can separate.
    """
    if not learns(learner):
        return replace(problem, features=Features(())), learner, ()
    if not isinstance(learner, Terms):
        return problem, learner, ()
    problem = problem.for_linear_learner()
    texts, rows, nt = (
        [str(entry) for entry in problem.features.entries],
        problem.rows,
        len(problem.baseline.names),
    )
    if len(texts) + nt > rows.y.size:
        raise InputError(
            f"the learner has {len(texts)} terms beside {nt} parameters, but there are "
            f"{rows.y.size} usable samples; give fewer terms, or let `orthaug select` choose "
            "among them."
        )
    z = problem.feature_rows()
    phi = problem.projection.phi[:, 0] if len(problem.outputs) == 1 else np.ones((len(z), 0))
    columns = np.column_stack([phi, z])
    size = np.linalg.norm(columns, axis=0)
    kept, gone = _independent_columns(columns / np.where(size > 0, size, 1.0), phi.shape[1])
    if not gone:
        return problem, learner if len(learner.terms) == len(texts) else learner.among(texts), ()
    warnings = (_warning([texts[i] for i in gone]),)
    left = replace(
        problem, features=Features(tuple(problem.features.entries[i] for i in kept), linear=True)
    )
    return left, learner.among([texts[i] for i in kept]) if kept else NoLearner(), warnings


def _independent_columns(columns: np.ndarray, first: int) -> tuple[list[int], list[int]]:
    """Return the columns from `first` that are independent of all before, and the rest."""
    r = np.abs(np.diag(np.linalg.qr(columns, mode="r")))
    left = r[first:] > _LEFT
    return [int(i) for i in np.flatnonzero(left)], [int(i) for i in np.flatnonzero(~left)]


def _warning(gone: list[str]) -> Warning:
    text = (
        f"left out of the learner: {first_words(gone, _NAMED)}. On these data the physics, or the "
        f"terms before, express {'them' if len(gone) > 1 else 'it'} already."
    )
    return Warning("terms_left_out", text)
