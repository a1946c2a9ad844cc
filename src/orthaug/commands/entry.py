"""Entry point of the program: signals first, then streams and environment, then the command line.

Environment variables of the user for libraries inside orthaug have no effect on them.
"""

from __future__ import annotations

import gc
import os
import sys

from orthaug.commands.signals import WATCH

# The others are dropped
_OF_JAX = ("JAX_PLATFORMS", "JAX_ENABLE_X64", "JAX_COMPILATION_CACHE_DIR", "JAX_DISABLE_JIT")
# Bytes of addresses that JAX and BLAS take for themselves
_LEAST_MEMORY, _MEMORY_PER_CORE = (3.0 * 2**30, 0.15 * 2**30)


def main() -> None:
    """Entry point of the program."""
    gc.set_threshold(
        100_000, 50, 100
    )  # what imports and traces leave is no garbage: looking for it costs a tenth
    _open_streams()
    WATCH.start()
    from orthaug.commands import streams

    streams.prepare()
    _settle()
    complaint = _complaint()
    if complaint is not None:
        from orthaug.commands.program import fail

        fail("error", complaint, 2, "environment")
    from orthaug.commands import cli

    try:
        cli.main()
    finally:
        WATCH.hold()


def _open_streams() -> None:
    """Open standard streams that are closed, so that no file takes their number.

    Writing to a closed output fails.
    """
    for number, way in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, way)  # takes the lowest number that is free


def _complaint() -> str | None:
    """Return a message on the cause that keeps every command from running; None without one."""
    from orthaug._base.memory import in_words, limit

    try:
        os.getcwd()
    except OSError:
        return "the working folder is gone; change to one that exists."
    needed = _LEAST_MEMORY + _MEMORY_PER_CORE * (os.cpu_count() or 1)
    if limit() < needed and not {"--help", "--version"} & set(sys.argv):
        return (
            f"the memory limit (ulimit -v) is {in_words(limit())}; with its libraries orthaug "
            f"needs {in_words(needed)} of address space on this machine. Raise the limit."
        )
    return None


def _settle() -> None:
    """Prepare the environment so that libraries neither fail nor print warnings of their own."""
    import logging
    import warnings

    for name in list(os.environ):
        if name.startswith("JAX_") and name not in _OF_JAX:
            del os.environ[name]
    os.environ |= {"MPLBACKEND": "agg", "MATPLOTLIBRC": os.devnull}
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    warnings.resetwarnings()
    warnings.simplefilter("ignore")
    logging.getLogger().addHandler(logging.NullHandler())
