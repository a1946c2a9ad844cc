"""Independent runs spread over cores by threads.

Compiled programs release Python's lock; results keep their order.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import TypeVar

from threadpoolctl import ThreadpoolController

Given = TypeVar("Given")
Item = TypeVar("Item")
Result = TypeVar("Result")
Heard = Callable[..., None]
"""Called with the number of a run, and with its reports."""
_own_cores: ContextVar[int | None] = ContextVar("own_cores", default=None)


def cores() -> int:
    """Return the number of simultaneous runs of this process.

    It is the machine's cores, or those that are left to it.
    """
    return _own_cores.get() or os.cpu_count() or 1


@contextmanager
def one_core() -> Iterator[None]:
    """Make runs inside one after another, since others have the other cores."""
    before = _own_cores.set(1)
    try:
        yield
    finally:
        _own_cores.reset(before)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread.

    Its other threads would wait actively after every call, for longer than a pass over 10⁵ rows
    takes. LAPACK makes the Cholesky factors of a step; XLA's own threads do everything else. Where
    they shared the cores with waiting threads, an iteration took 45 % longer
    (benchmarks/lm_iteration.py).
    """
    with _blas().limit(limits=1):
        yield


@cache
def _blas() -> ThreadpoolController:
    """Return the BLAS libraries of NumPy and SciPy, found once.

    To find them is to read the process's memory map, which gets longer with every compiled program:
    after some hundred of them it took longer than a small fit.
    """
    import scipy.linalg  # noqa: F401  (brings its own BLAS, which is JAX's as well)

    return ThreadpoolController().select(user_api="blas")


class RunCancelled(Exception):
    """Another run failed, or the user pressed Ctrl-C: this run's result is no longer wanted."""


def run_all(
    function: Callable[[Item, Callable[[], None]], Result],
    items: Sequence[Item],
    workers: int | None = None,
) -> list[Result]:
    """Return `[function(item, check) for item in items]`, several at a time.

    Arguments are those of `each`.
    """
    return list(iterate_results(function, items, workers))


def iterate_results(
    function: Callable[[Item, Callable[[], None]], Result],
    items: Sequence[Item],
    workers: int | None = None,
) -> Iterator[Result]:
    """Yield `function(item, check)` of every item in order, several at a time.

    The first that fails ends the others, and so does a caller that takes no more.

    Args:
        function: calls `check()` now and then, which raises `RunCancelled` once the results are not
            wanted.
        workers: how many at a time; by default the machine's cores.
    """
    stop = threading.Event()

    def check() -> None:
        if stop.is_set():
            raise RunCancelled

    workers = min(len(items), workers or cores())
    if workers <= 1:
        with one_blas_thread():
            yield from (function(item, check) for item in items)
        return
    with one_blas_thread(), ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(function, item, check) for item in items]
        pending = set(futures)
        try:
            for future in futures:
                while future in pending:
                    done, pending = wait(pending, return_when=FIRST_COMPLETED)
                    for other in done:
                        other.result()
                yield future.result()
        finally:
            stop.set()
            for future in futures:
                future.cancel()


def nobody(*_: object) -> None:
    """Ignore a report."""


class Threads:
    """Runner of independent runs on this machine's cores."""

    def map(
        self,
        function: Callable[[Given, Item, Callable[..., None]], Result],
        given: Given,
        items: Sequence[Item],
        heard: Heard = nobody,
    ) -> Iterator[Result]:
        """Yield `function(given, item, report)` of every item in order.

        Args:
            function: of a module, so that it can be sent elsewhere. It calls `report(…)` now and
                then, which raises `RunCancelled` once the results are not wanted.
            given: what all runs share.
            items: one for each run.
            heard: called with the number of an item and the reports of its run.
        """

        def one(numbered: tuple[int, Item], check: Callable[[], None]) -> Result:
            i, item = numbered

            def report(*what: object) -> None:
                check()
                heard(i, *what)

            return function(given, item, report)

        return iterate_results(one, list(enumerate(items)))


def in_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Return `[function(item) for item in items]`, as many at a time as there are cores."""
    with ThreadPoolExecutor(min(len(items), cores())) as pool:
        return list(pool.map(function, items))
