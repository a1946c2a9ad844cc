"""Independent runs spread over cores by threads: compiled programs release Python's lock, results keep their order."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class Stopped(Exception):
    """Another run failed, or the user pressed Ctrl-C: this run's result is no longer wanted."""


def spread(function: Callable[[Item, Callable[[], None]], Result], items: Sequence[Item]) -> list[Result]:
    """`[function(item, check) for item in items]`, several at a time.

    Args:
        function: calls `check()` now and then, which raises `Stopped` once the results are not wanted.
    """
    stop = threading.Event()

    def check() -> None:
        if stop.is_set():
            raise Stopped

    workers = min(len(items), os.cpu_count() or 1)
    if workers <= 1:
        return [function(item, check) for item in items]
    with ThreadPoolExecutor(workers) as pool:
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
