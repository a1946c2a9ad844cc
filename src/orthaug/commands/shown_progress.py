"""Progress of a fit that was started from Python: a bar on a terminal, a line in a notebook, nothing elsewhere."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from typing import Any

from orthaug._base.progress import SILENT, Tell
from orthaug.commands.bars import drawn_bar, on_terminal


@contextmanager
def shown_progress() -> Iterator[Tell]:
    """What to call with (run, iteration, loss)."""
    display = _display()
    if display is not None:
        yield from _in_notebook(display)
    elif on_terminal():
        yield from _on_terminal()
    else:
        yield SILENT


def _display() -> Any:
    """IPython's `display` in a notebook, which has loaded it; None elsewhere."""
    ipython, shown = sys.modules.get("IPython"), sys.modules.get("IPython.display")
    if ipython is None or shown is None:
        return None
    return shown.display if type(ipython.get_ipython()).__name__ == "ZMQInteractiveShell" else None


def _in_notebook(display: Any) -> Iterator[Tell]:
    lock, began = threading.Lock(), time.monotonic()
    runs: dict[int, tuple[int, float]] = {}
    handle: Any = display({"text/html": _line("compiling", ended=False), "text/plain": ""}, raw=True, display_id=True)

    def show(words: str, *, ended: bool) -> None:
        handle.update({"text/html": _line(words, ended=ended), "text/plain": words}, raw=True)

    def tell(run: int, iteration: int, loss: float) -> None:
        with lock:
            runs[run] = (iteration, loss)
            show(_words(run, iteration, loss), ended=False)

    try:
        yield tell
    finally:
        steps = sum(iteration for iteration, _ in runs.values())
        show(f"{len(runs) or 1} runs, {steps} iterations, {time.monotonic() - began:.1f} s", ended=True)


def _on_terminal() -> Iterator[Tell]:
    from rich.progress import TimeElapsedColumn

    with drawn_bar(TimeElapsedColumn()) as shown:
        task = shown.add_task("compiling", total=None)
        yield lambda run, iteration, loss: shown.update(task, description=_words(run, iteration, loss))


def _words(run: int, iteration: int, loss: float) -> str:
    return f"run {run + 1}, iteration {iteration}, loss {loss:.3g}"


def _line(words: str, *, ended: bool) -> str:
    """A bar that moves as long as it is not known how long it takes."""
    moving = "" if ended else '<progress aria-label="training" style="vertical-align:middle"></progress> '
    return f"<div>{moving}{escape(words)}</div>"
