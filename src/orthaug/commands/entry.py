"""Where the program starts: signals first, then streams and surroundings, and only then the command line.

The user's switches for libraries that orthaug uses within itself do not reach them.
"""

from __future__ import annotations

import os
import sys

from orthaug.commands.signals import WATCH

_OF_JAX = ("JAX_PLATFORMS", "JAX_ENABLE_X64", "JAX_COMPILATION_CACHE_DIR", "JAX_DISABLE_JIT")  # the others are dropped


def main() -> None:
    """Entry point of the program."""
    WATCH.start()
    from orthaug.commands import streams

    streams.prepare()
    _settle()
    try:
        os.getcwd()
    except OSError:
        streams.say("error: the working folder is gone; change to one that exists.")
        sys.exit(2)
    from orthaug.commands import cli

    try:
        cli.main()
    finally:
        WATCH.hold()


def _settle() -> None:
    """Surroundings in which libraries neither fail nor talk: their warnings are no lines for users."""
    import logging
    import warnings

    for name in list(os.environ):
        if name.startswith("JAX_") and name not in _OF_JAX:
            del os.environ[name]
    os.environ["MPLBACKEND"] = "agg"
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    warnings.resetwarnings()
    warnings.simplefilter("ignore")
    logging.getLogger().addHandler(logging.NullHandler())
