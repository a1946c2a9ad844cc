"""Available memory, and the refusal of arrays that do not fit."""

from __future__ import annotations

import ctypes
import math
import os
import sys
from contextlib import suppress

from orthaug._base.errors import InputError

_ARENA_MAX = -8  # glibc's name for the number of arenas


def available() -> float:
    """Return the bytes that this process may still take; infinite where they are not known."""
    return min(_free_bytes(), _limit_bytes())


def limit() -> float:
    """Return the bytes of addresses that this process may take at most (`ulimit -v`).

    Infinite where nothing says so.
    """
    try:
        import resource
    except ImportError:
        return math.inf
    size = resource.getrlimit(resource.RLIMIT_AS)[0]
    return math.inf if size == resource.RLIM_INFINITY else float(size)


def return_free_memory() -> None:
    """Give memory that is free back to the system, where the C library can (glibc)."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL("libc.so.6").malloc_trim(0)


def check_limit(size: float, what: str) -> None:
    """Raise InputError where a limit on the process leaves less than `size` bytes.

    The system would end the process without a message.
    """
    there = _limit_bytes()
    if size > there:
        raise InputError(
            f"{what} takes {in_words(size)} of memory; the limit (ulimit -v) leaves "
            f"{in_words(there)}."
        )


def check_memory(size: float, what: str) -> None:
    """Raise InputError where `size` bytes are more than there are; `what` begins the sentence."""
    there = available()
    if size > there:
        raise InputError(
            f"{what} would take {in_words(size)} of memory; {in_words(there)} are available."
        )


def few_arenas() -> None:
    """Let threads share what they allocate from, where the C library is glibc.

    By default each thread has an arena of its own, which hardly shrinks: with the threads of XLA a
    streamed fit took a fifth more memory. Threads that run already keep theirs.
    """
    if sys.platform != "linux":
        return
    with suppress(AttributeError, OSError):  # another C library
        ctypes.CDLL(None).mallopt(_ARENA_MAX, 2)


def in_words(size: float) -> str:
    """Return bytes in the unit that suits them."""
    step = max(0, min(int(math.log(max(size, 1), 1024)), 5))
    return f"{size / 1024**step:.3g} {('bytes', 'KiB', 'MiB', 'GiB', 'TiB', 'PiB')[step]}"


def _free_bytes() -> float:
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            lines = dict(line.split(":", 1) for line in file)
        return 1024.0 * int(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        try:
            return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
        except (AttributeError, OSError, ValueError):
            return math.inf


def _limit_bytes() -> float:
    """Return the bytes that limits on the process (`ulimit -v`) leave."""
    most = limit()
    if math.isinf(most):
        return most
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return max(0.0, most - int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE"))
    except (OSError, ValueError):
        return math.inf
