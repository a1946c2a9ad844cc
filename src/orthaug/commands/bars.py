"""Progress on standard error or in a notebook, and Ctrl-C that waits for compiled code to end."""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from html import escape
from typing import TYPE_CHECKING, Any

from orthaug._base.progress import (
    SILENT,
    Plan,
    Progress,
    ProgressCallback,
    ReachedStage,
    StopTraining,
    follow_training,
    stop_following,
)
from orthaug.commands import streams
from orthaug.commands.signals import WATCH
from orthaug.commands.streams import say

if TYPE_CHECKING:
    from rich.progress import Progress as Bar
    from rich.progress import ProgressColumn

PROGRESS_VARIABLE = "ORTHAUG_PROGRESS"
"""Environment variable: with the value `json`, progress is written as JSON to standard error.
"""
ENOUGH = threading.Event()
"""Event of the process: it ends training with the result so far and the warning `stopped`.
"""
ENOUGH_LINE = b"enough\n"
"""What sets it, on the standard input of a child of the page."""
GO_ON = "The finished runs are kept; the same command continues from there"
"""What an interrupted `reproduce` says last."""
_OFTEN = 0.02  # s between such lines
_SHOWN = 300  # rows of the free run of a model in such a line
_MANY = 1_000_000  # rows from which the rate is shown
_LONG = 5.0  # s of a search from which its duration is announced
_SEEN = 3  # models after which the remaining time is shown: the first ones compile


def on_terminal() -> bool:
    """Return whether standard error is a terminal.

    FORCE_COLOR, which build servers set, does not make it one.
    """
    return sys.stderr is not None and sys.stderr.isatty()


def drawn_bar(*columns: ProgressColumn, transient: bool = True) -> Bar:
    """Return a bar with its description and these columns, drawn on a terminal only.

    NO_COLOR has effect.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn
    from rich.table import Column

    console = Console(stderr=True)
    # Of a long description, such as that of a change of the spec, the bar leaves the beginning
    described = Column(no_wrap=True, overflow="ellipsis", max_width=max(console.width - 30, 20))
    shown = (TextColumn("{task.description}", markup=False, table_column=described), BarColumn())
    return Progress(
        *shown, *columns, console=console, transient=transient, disable=not on_terminal()
    )


@contextmanager
def training_bar(
    runs: int, iterations: int, wanted: bool = True, rows: int = 0
) -> Iterator[Progress]:
    """Show a progress bar on standard error where that is a terminal; report what Ctrl-C stopped.

    Args:
        rows: of the training data. Where there are many, the rate in rows/s is shown.
    """
    line = _Lines(runs, iterations)
    if not wanted:
        line.follow()
        yield SILENT
        return
    from rich.progress import TimeElapsedColumn, TimeRemainingColumn

    reached, began = "the start of training", time.monotonic()
    with (
        _deferred_interrupt() as interrupted,
        drawn_bar(TimeElapsedColumn(), TimeRemainingColumn()) as bar,
        WATCH.report_stop(lambda: reached, bar.stop),
    ):
        task = bar.add_task("compiling", total=runs * iterations)
        done: dict[int, int] = {}
        stage: ReachedStage | None = None

        def show(run: int, iteration: int, loss: float) -> None:
            nonlocal reached
            done[run] = iteration
            count = max(runs, run + 1)  # a run may be made again
            reached = f"run {run + 1} of {count}, iteration {iteration}, loss {loss:.3g}"
            passes = sum(done.values())
            rate = rows * passes / max(time.monotonic() - began, 1e-3)
            description = (
                f"{reached}, {rate / 1e6:.3g} million rows/s" if rows >= _MANY else reached
            )
            bar.update(task, completed=passes, description=description)
            line(run, iteration, loss, passes)
            if interrupted.is_set():
                raise KeyboardInterrupt(reached)
            if ENOUGH.is_set():
                raise StopTraining

        def enter(text: str) -> None:
            nonlocal reached, stage
            line.enter(text)
            stage = ReachedStage.of(text, stage)
            reached = stage.text
            bar.update(task, description=reached, total=None)

        follow_training(enter, _tell_model if line.wanted else None)
        try:
            yield Progress(show, plan=line.planned)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(reached) from None
        finally:
            line.follow()  # the result is written after the bar has ended
        if interrupted.is_set():
            raise KeyboardInterrupt(reached)


class _Lines:
    """A writer of progress as lines of JSON, for a program that follows this one.

    It writes only if the environment asks for it.
    """

    def __init__(self, runs: int, iterations: int) -> None:
        self.runs, self.iterations = runs, iterations
        self.wanted, self._last = os.environ.get(PROGRESS_VARIABLE) == "json", -_OFTEN
        self._first, self._plan = 0, ()

    def follow(self) -> None:
        """Write the stages and models that follow, where lines are wanted."""
        if self.wanted:
            follow_training(self.enter, _tell_model)
        else:  # an earlier command of this process may have been followed
            stop_following()

    def enter(self, stage: str) -> None:
        """Write that the fit has come to a stage."""
        if self.wanted:
            streams.say(json.dumps({"stage": stage}))

    def planned(self, first: int, plan: Plan) -> None:
        """Set the runs that follow from this number on."""
        self._first, self._plan = first, tuple(plan)

    def __call__(self, run: int, iteration: int, loss: float, passes: int) -> None:
        if not self.wanted or time.monotonic() - self._last < _OFTEN:
            return
        self._last = time.monotonic()
        fields = {
            "run": run + 1,
            "runs": max(self.runs, run + 1),
            "iteration": iteration,
            "iterations": self.iterations,
        }
        share = min(1.0, passes / max(self.runs * self.iterations, 1))
        own = run - self._first  # one that is made again has a number after those that are planned
        known = self._plan[own] if 0 <= own < len(self._plan) else {}
        streams.say(
            json.dumps(
                {**fields, "loss": loss if math.isfinite(loss) else None, "done": share, **known}
            )
        )


def _tell_model(name: str, fit: Any, record: Any) -> None:
    """Write the free run of a model on the first rows of the training data, as a line of JSON."""
    if fit is None or not fit.status.ok:
        return
    few = replace(record, experiments=record.experiments[:1]).rows(0, _SHOWN)
    response = fit.model.simulate(few)
    (run,) = response.trajectories
    outputs = {
        channel.name: {
            "unit": channel.unit,
            "measured": _finite(run.measured[:, j]),
            "model": _finite(run.model[:, j]),
        }
        for j, channel in enumerate(response.outputs)
    }
    time = _finite(run.time(response.sampling_time))
    streams.say(json.dumps({"model": name, "time": time, "outputs": outputs}))


def _finite(values: Any) -> list[float | None]:
    return [float(f"{v:.6g}") if math.isfinite(v) else None for v in values]


@contextmanager
def study_bars() -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar per study on standard error where that is a terminal.

    Ctrl-C stops after the run at hand.
    """
    from rich.progress import MofNCompleteColumn, TimeElapsedColumn

    reached = "the start of the studies"
    with (
        _deferred_interrupt() as interrupted,
        drawn_bar(MofNCompleteColumn(), TimeElapsedColumn(), transient=False) as bar,
        WATCH.report_stop(lambda: reached, bar.stop, GO_ON),
    ):
        tasks: dict[str, Any] = {}

        def show(title: str, done: int, total: int) -> None:
            nonlocal reached
            reached = f"'{title}', {done} of {total} runs done"
            if title not in tasks:
                tasks[title] = bar.add_task(title, total=total)
            bar.update(tasks[title], completed=done)
            if interrupted.is_set():
                raise KeyboardInterrupt(reached, GO_ON)

        yield show


@contextmanager
def selection_bar(most: int) -> Iterator[Callable[[str, Any], None]]:
    """Show a bar of the models judged so far, on standard error.

    Ctrl-C keeps the models judged so far, a second one ends at once.

    After some terms it announces the longest remaining time, also without a terminal.
    """
    from rich.progress import MofNCompleteColumn, TimeElapsedColumn, TimeRemainingColumn

    with (
        _asked_to_stop() as asked,
        drawn_bar(MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()) as bar,
        WATCH.report_stop(lambda: "the selection of a structure", bar.stop),
    ):
        tasks: dict[str, Any] = {}
        judged: dict[str, list[float]] = {}

        def show(stage: str, rung: Any) -> None:
            done = judged.setdefault(stage, [])
            done.append(rung.seconds)
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=most if stage == "terms" else None)
            bar.update(tasks[stage], advance=1)
            whole = done[-1] * most
            if stage == "terms" and len(done) == _SEEN and whole > _LONG and not on_terminal():
                say(
                    f"note: a model takes {done[-1]:.1f} s; at most {most} are judged, "
                    f"{whole:.0f} s."
                )
            if asked.is_set():
                raise KeyboardInterrupt

        yield show


@contextmanager
def _asked_to_stop() -> Iterator[threading.Event]:
    """Yield an event that the first Ctrl-C sets."""
    if WATCH.active:
        with WATCH.ask_to_stop() as event:
            yield event
    else:
        with _deferred_interrupt() as event:
            yield event


@contextmanager
def _deferred_interrupt() -> Iterator[threading.Event]:
    """Let Ctrl-C set the event, so that it never interrupts compiled code.

    A second one interrupts at once.

    Where a thread watches for signals, it ends the program itself.
    """
    event = threading.Event()
    if WATCH.active:
        yield event
        return

    def note(signum: int, frame: object) -> None:
        if event.is_set():
            raise KeyboardInterrupt
        event.set()

    previous = signal.signal(signal.SIGINT, note)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, previous)


@contextmanager
def shown_progress() -> Iterator[ProgressCallback]:
    """Show the progress of a fit from Python: on a terminal a bar, in a notebook a line."""
    display = _display()
    if display is not None:
        yield from _in_notebook(display)
    elif on_terminal():
        yield from _on_terminal()
    else:
        yield SILENT


def _display() -> Any:
    """Return IPython's `display` in a notebook, which has loaded it; None elsewhere."""
    ipython, shown = sys.modules.get("IPython"), sys.modules.get("IPython.display")
    if ipython is None or shown is None:
        return None
    return shown.display if type(ipython.get_ipython()).__name__ == "ZMQInteractiveShell" else None


def _in_notebook(display: Any) -> Iterator[ProgressCallback]:
    lock, began = threading.Lock(), time.monotonic()
    runs: dict[int, tuple[int, float]] = {}
    handle: Any = display(
        {"text/html": _line("compiling", ended=False), "text/plain": ""}, raw=True, display_id=True
    )

    def draw(words: str, *, ended: bool) -> None:
        handle.update({"text/html": _line(words, ended=ended), "text/plain": words}, raw=True)

    def show(run: int, iteration: int, loss: float) -> None:
        with lock:
            runs[run] = (iteration, loss)
            draw(_words(run, iteration, loss), ended=False)

    try:
        yield show
    finally:
        steps = sum(iteration for iteration, _ in runs.values())
        draw(
            f"{len(runs) or 1} runs, {steps} iterations, {time.monotonic() - began:.1f} s",
            ended=True,
        )


def _on_terminal() -> Iterator[ProgressCallback]:
    from rich.progress import TimeElapsedColumn

    with drawn_bar(TimeElapsedColumn()) as shown:
        task = shown.add_task("compiling", total=None)
        yield lambda run, iteration, loss: shown.update(
            task, description=_words(run, iteration, loss)
        )


def _words(run: int, iteration: int, loss: float) -> str:
    return f"run {run + 1}, iteration {iteration}, loss {loss:.3g}"


def _line(words: str, *, ended: bool) -> str:
    """Return a bar that moves while the total is unknown."""
    moving = (
        ""
        if ended
        else '<progress aria-label="training" style="vertical-align:middle"></progress> '
    )
    return f"<div>{moving}{escape(words)}</div>"
