"""Folds that evidence silences are made again with the ridge of all rows, and only these."""

from types import SimpleNamespace

import pytest

from orthaug.fitting import silence
from orthaug.fitting.status import Ending


@pytest.fixture(autouse=True)
def _a_ridge(monkeypatch):
    monkeypatch.setattr(silence, "evidence_ridge", lambda objective, point, effective: 0.123456)


def _run(effective, ending=Ending.CONVERGED):
    return SimpleNamespace(
        effective=effective, ending=ending, objective=None, end=SimpleNamespace(point=None)
    )


def _start(regularization):
    return SimpleNamespace(regularization=regularization)


def test_a_learner_that_lives_on_all_rows_has_a_ridge_for_its_folds():
    assert silence.fold_ridges([_start("evidence")], [_run(8.8)], 1) == [0.123]


@pytest.mark.parametrize(
    ("regularization", "run"),
    [
        ("none", _run(8.8)),
        (0.01, _run(8.8)),
        ("evidence", _run(0.9)),
        ("evidence", _run(2.5)),
        ("evidence", _run(8.8, Ending.STOPPED)),
    ],
)
def test_no_other_has_one(regularization, run):
    """Neither what is no evidence, nor what is silent on all rows: there `add_retries` has weaker ones."""
    assert silence.fold_ridges([_start(regularization)], [run], 2) == [None]
