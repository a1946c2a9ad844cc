"""Runs over threads: order, exceptions and Ctrl-C; restarts give the same however many threads share them."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import Counter

import numpy as np
import pytest
import scipy.linalg  # noqa: F401  (brings a BLAS of its own)
from threadpoolctl import threadpool_info, threadpool_limits

from orthaug import MLP, AdamLBFGS, Baseline, LevenbergMarquardt, Record, Term, estimate
from orthaug._base import parallel
from orthaug._base.parallel import RunCancelled, one_blas_thread, run_all


@pytest.fixture
def cores(monkeypatch):
    """Sets how many cores there are."""
    return lambda count: monkeypatch.setattr(parallel.os, "cpu_count", lambda: count)


def test_blas_has_one_thread_inside_and_what_it_had_after():
    def threads():
        return {
            library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"
        }

    with threadpool_limits(limits=2, user_api="blas"):
        before = threads()
        with one_blas_thread():
            assert threads() == {1}
            with one_blas_thread():
                assert threads() == {1}
            assert threads() == {1}
        assert threads() == before


def test_results_keep_the_order_of_the_items(cores):
    cores(4)

    def slow_first(item, check):
        check()
        time.sleep(0.05 * (6 - item))
        return item, threading.get_ident()

    found = run_all(slow_first, range(6))
    assert [item for item, _ in found] == list(range(6))
    assert 1 < len({ident for _, ident in found}) <= 4


@pytest.mark.parametrize(("items", "count"), [([7], 4), ([1, 2, 3], 1), ([1, 2], None)])
def test_one_item_or_one_core_runs_inline(cores, items, count):
    cores(count)
    here = threading.get_ident()
    assert run_all(lambda item, check: (check(), item, threading.get_ident())[1:], items) == [
        (i, here) for i in items
    ]


class Odd(Exception):
    pass


def until_stopped(ended: Counter, check) -> None:
    """A run that ends by itself only after two seconds."""
    for _ in range(200):
        try:
            check()
        except RunCancelled:
            ended["stopped"] += 1
            raise
        time.sleep(0.01)
    ended["went on to its end"] += 1


@pytest.mark.parametrize("exception", [Odd, KeyboardInterrupt])
@pytest.mark.parametrize("failing", [0, 1, 2])
def test_an_exception_reaches_the_caller_and_stops_the_others(cores, failing, exception):
    cores(3)
    ended: Counter = Counter()

    def function(item, check):
        if item == failing:
            time.sleep(0.1)
            raise exception
        until_stopped(ended, check)

    with pytest.raises(exception):
        run_all(function, range(3))
    assert ended == {"stopped": 2}


def test_runs_that_wait_for_a_core_never_start(cores):
    cores(2)
    ended: Counter = Counter()

    def function(item, check):
        ended[f"started {item}"] += 1
        if item == 0:
            time.sleep(0.1)
            raise Odd
        until_stopped(ended, check)

    with pytest.raises(Odd):
        run_all(function, range(12))
    assert ended["went on to its end"] == 0
    assert sum(count for text, count in ended.items() if text.startswith("started")) <= 3


def test_ctrl_c_in_the_main_thread_stops_the_runs(cores, monkeypatch):
    cores(2)
    ended: Counter = Counter()
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)

    def function(item, check):
        if item == 0:
            time.sleep(0.1)
            os.kill(os.getpid(), signal.SIGINT)
        until_stopped(ended, check)

    try:
        with pytest.raises(KeyboardInterrupt):
            run_all(function, range(2))
    finally:
        signal.signal(signal.SIGINT, previous)
    assert ended == {"stopped": 2}


# restarts

PHYSICS = Baseline.from_terms([Term("a", "y[k-1]", initial=0.5), Term("b", "u[k]", initial=1.0)])


def record_of(seed: int = 0, rows: int = 121) -> Record:
    rng = np.random.default_rng(seed)
    u, e = rng.uniform(-1, 1, (2, rows))
    y = np.zeros(rows)
    for k in range(1, rows):
        y[k] = 0.6 * y[k - 1] + 0.8 * u[k] + 0.5 * u[k] ** 2 + 0.05 * e[k]
    return Record.from_arrays(u, y)


SOLVERS = {
    "none": (LevenbergMarquardt(iterations=40), "none"),
    "evidence": (LevenbergMarquardt(iterations=40), "evidence"),
    "adam-lbfgs": (AdamLBFGS(30, 30, 1e-2), 0.1),
}


@pytest.mark.parametrize("name", SOLVERS)
def test_restarts_do_not_depend_on_the_number_of_cores(cores, name):
    solver, regularization = SOLVERS[name]
    options = {"learner": MLP(hidden=(4,)), "solver": solver, "regularization": regularization}

    def table(fit):
        return [(r.seed, r.loss, r.iterations, r.code) for r in fit.restarts]

    cores(1)
    serial = estimate(record_of(), PHYSICS, restarts=4, seed=3, **options)
    alone = [estimate(record_of(), PHYSICS, seed=seed, **options) for seed in (3, 4, 5, 6)]
    assert [row for fit in alone for row in table(fit)] == table(serial)
    chosen = [r.chosen for r in serial.restarts].index(True)
    for count in (2, 4):
        cores(count)
        fit = estimate(record_of(), PHYSICS, restarts=4, seed=3, **options)
        assert table(fit) == table(serial)
        assert [r.chosen for r in fit.restarts] == [r.chosen for r in serial.restarts]
        for other in (serial, alone[chosen]):
            assert fit.theta.tobytes() == other.theta.tobytes()
            weights, theirs = (np.asarray(f.model.numbers.weights) for f in (fit, other))
            assert weights.tobytes() == theirs.tobytes()


def test_what_progress_raises_in_any_run_ends_the_estimate(cores):
    """As Ctrl-C does: the command line's progress raises it."""
    cores(2)
    heard = set()

    def progress(run, iteration, loss):
        heard.add(run)
        if run == 1:
            raise KeyboardInterrupt

    solver = LevenbergMarquardt(iterations=100_000, tolerance=0.0)
    with pytest.raises(KeyboardInterrupt):
        estimate(
            record_of(),
            PHYSICS,
            learner=MLP(hidden=(4,)),
            solver=solver,
            restarts=3,
            progress=progress,
        )
    assert 1 in heard
