"""Signals that end the program: Ctrl-C, a request to terminate, a terminal that is closed.

A thread waits for them, so that the program ends at once, whatever compiled code runs: what is
partial is removed, one line says so, and the exit code is 128 and the signal's number. An exception
in the main thread would come late, or inside a callback of JAX, which swallows it and prints a
traceback instead.

Little is imported here: signals may come while everything else is being imported.
"""

from __future__ import annotations

import _thread
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import threading

_WORDS = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "ended with its terminal"}
_PATIENCE = 0.5  # s for a progress bar to leave the terminal as it was


def _no_text() -> str:
    return ""


def ending_message(words: str, during: str, kept: str = "", then: str = "") -> str:
    """Return the message of an early end: what was stopped, what is written, how to continue."""
    return (
        f"{words}{during and f' during {during}'}; {kept or 'nothing'} is "
        f"written{then and f'. {then}'}"
    )


class SignalWatch:
    """A watch that ends the program on a signal, once it is started.

    Before that, signals have their usual effect.
    """

    def __init__(self) -> None:
        self.active = self.ending = False
        self._during: Callable[[], str] = _no_text
        self._stop: Callable[[], object] = _no_text
        self._then = ""
        self._asked: threading.Event | None = None
        self.rescue: Callable[[], object] = _no_text
        """Writes what is finished already, before a signal ends the program."""

    def start(self) -> None:
        """Begin to wait for signals.

        Signals that `nohup` made the program ignore stay ignored.
        """
        if os.name != "posix":  # elsewhere Ctrl-C is an exception in the main thread
            return
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        for name in _WORDS:
            number = getattr(signal, name)
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, _leave_to_the_thread)
        self.active = True
        _thread.start_new_thread(self._wait, (reader,))

    @contextmanager
    def report_stop(
        self, during: Callable[[], str], stop: Callable[[], object] = _no_text, then: str = ""
    ) -> Iterator[None]:
        """Say what a signal stopped and how to go on, `then`, and stop drawing before that."""
        self._during, self._stop, self._then = during, stop, then
        try:
            yield
        finally:
            self._during = self._stop = _no_text
            self._then = ""

    @contextmanager
    def ask_to_stop(self) -> Iterator[threading.Event]:
        """Yield an event that the first Ctrl-C sets, for work that can stop with a partial result.

        A second one ends the program.
        """
        import threading

        self._asked = threading.Event()
        try:
            yield self._asked
        finally:
            self._asked = None

    def hold(self) -> None:
        """Wait where the program is about to end: an error then is only a consequence."""
        while self.ending:
            time.sleep(1.0)

    def _wait(self, reader: int) -> None:
        known = {getattr(signal, name): words for name, words in _WORDS.items()}
        while True:
            number = os.read(reader, 1)[0]
            if number == signal.SIGINT and self._asked is not None and not self._asked.is_set():
                self._asked.set()
            elif number in known:
                self.ending = True
                self._end(number, known[number])

    def _end(self, number: int, words: str) -> None:
        try:
            partials = getattr(sys.modules.get("orthaug._base.folders"), "PARTIALS", None)
            during = self._during()
            with suppress(Exception):  # what cannot be written is lost, as without it
                self.rescue()
            if partials is not None:
                partials.discard_all()
            kept = ", ".join(str(path) for path in getattr(partials, "placed", ()) if path.exists())
            self._stop_drawing()
            line = ending_message(words, during, kept, self._then) + "\n"
            with suppress(OSError):
                os.write(
                    2,
                    line.encode(
                        "utf-8" if sys.stderr is None else sys.stderr.encoding, "backslashreplace"
                    ),
                )
        finally:
            os._exit(128 + number)

    def _stop_drawing(self) -> None:
        if self._stop is _no_text:
            return
        done = _thread.allocate_lock()
        done.acquire()

        def stop() -> None:
            with suppress(Exception):
                self._stop()
            done.release()

        _thread.start_new_thread(stop, ())
        done.acquire(timeout=_PATIENCE)


def _leave_to_the_thread(number: int, frame: object) -> None:
    """Install a handler that does nothing: the thread receives the signal.

    Without a handler Python ends the process before the thread hears of it.
    """


WATCH = SignalWatch()  # of the process, as its signals are
