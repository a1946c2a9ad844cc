"""Independent runs spread over cores by threads: compiled programs release Python's lock, results keep their order."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from typing import TypeVar

from threadpoolctl import ThreadpoolController

Item = TypeVar("Item")
Result = TypeVar("Result")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """BLAS on one thread.

    Its other threads would wait actively after every call, for longer than a pass over 10⁵ rows takes. LAPACK makes the
    Cholesky factors of a step; XLA's own threads do everything else. Where they shared the cores with waiting threads,
    an iteration took 45 % longer (benchmarks/lm_iteration.py).
    """
    with _blas().limit(limits=1):
        yield


@cache
def _blas() -> ThreadpoolController:
    """The BLAS libraries of NumPy and SciPy, found once.

    To find them is to read the process's memory map, which gets longer with every compiled program: after some hundred
    of them it took longer than a small fit.
    """
    import scipy.linalg  # noqa: F401  (brings its own BLAS, which is JAX's as well)

    return ThreadpoolController().select(user_api="blas")


class Stopped(Exception):
    """Another run failed, or the user pressed Ctrl-C: this run's result is no longer wanted."""


def spread(
    function: Callable[[Item, Callable[[], None]], Result], items: Sequence[Item], workers: int | None = None
) -> list[Result]:
    """`[function(item, check) for item in items]`, several at a time.

    Args:
        function: calls `check()` now and then, which raises `Stopped` once the results are not wanted.
        workers: how many at a time; by default the machine's cores.
    """
    stop = threading.Event()

    def check() -> None:
        if stop.is_set():
            raise Stopped

    workers = min(len(items), workers or os.cpu_count() or 1)
    if workers <= 1:
        with one_blas_thread():
            return [function(item, check) for item in items]
    with one_blas_thread(), ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(function, item, check) for item in items]
        try:
            done, _ = wait(futures, return_when=FIRST_EXCEPTION)
            for future in done:
                future.result()
            return [future.result() for future in futures]
        except BaseException:
            stop.set()
            for future in futures:
                future.cancel()
            raise


def in_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """`[function(item) for item in items]`, as many at a time as there are cores."""
    with ThreadPoolExecutor(min(len(items), os.cpu_count() or 1)) as pool:
        return list(pool.map(function, items))
