"""The command line as a child of the page: it ends with the process that started it.

The parent keeps its standard input open. Where that is closed, the child is interrupted as by
Ctrl-C, which keeps or removes partial files; the page stops it in the same way. A line `enough`
on it ends training with the result reached so far.
"""

from __future__ import annotations

import _thread
import os
import signal
import sys
import time

_PATIENCE = 5.0  # s for what an interrupt is to remove


def main() -> None:
    """Run the command that the arguments give."""
    from orthaug.commands.entry import main as program

    watch_parent()
    program()


def watch_parent() -> None:
    """End this process once its standard input is closed."""
    _thread.start_new_thread(_wait, ())


def _wait() -> None:
    while received := os.read(0, 4096):
        from orthaug.commands.bars import ENOUGH, ENOUGH_LINE

        if ENOUGH_LINE in received:
            ENOUGH.set()
    if os.name == "posix":
        os.kill(os.getpid(), signal.SIGINT)
    else:
        _thread.interrupt_main()
    time.sleep(_PATIENCE)
    os._exit(130)


if __name__ == "__main__":
    sys.argv[0] = "orthaug"
    main()
