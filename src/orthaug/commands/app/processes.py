"""Processes of the page: commands with their progress, and workers that answer questions."""

from __future__ import annotations

import asyncio
import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from orthaug._base.errors import InputError
from orthaug._base.progress import ReachedStage
from orthaug.commands.bars import ENOUGH_LINE, PROGRESS_VARIABLE

_LONGEST = 2**26  # bytes of a line of an answer
_LINES = 400  # of a command that are kept
_GRACE = 8.0  # s for a process to end by itself
_AT_ONCE = 2  # questions


class Run(NamedTuple):
    """A run of training, as a line of progress describes it; what the line omits is empty or 0."""

    number: int
    structure: str = ""
    start: int = 0
    regularization: str = ""

    @classmethod
    def of(cls, line: Mapping[str, Any]) -> Run:
        """Return the run that a line of progress describes."""
        kind = str(line.get("regularization", ""))
        return cls(line["run"], line.get("structure", ""), line.get("start", 0), kind)


@dataclass(eq=False)
class Command:
    """A command of the program that runs in a child process."""

    arguments: Sequence[str]
    changed: Callable[[], None]
    progress: dict[str, Any] = field(default_factory=dict)
    """The last progress: `run`, `runs`, `iteration`, `loss`, `done` (share)."""
    losses: list[tuple[Run, int, float | None]] = field(default_factory=list)
    """(run, iteration, loss) of each line of progress."""
    stage: ReachedStage | None = None
    """The stage after the runs that it has come to."""
    models: dict[str, dict[str, Any]] = field(default_factory=dict)
    """By name, the free run of physics alone and of the best run so far: `time`, `outputs`."""
    lines: list[str] = field(default_factory=list)
    began: float = 0.0
    ended: float | None = None
    code: int | None = None
    stopping: bool = False
    ending: bool = False
    """True if it was asked to end with the result reached so far."""
    process: asyncio.subprocess.Process | None = None

    @property
    def running(self) -> bool:
        """True while the process still runs."""
        return self.code is None

    @property
    def seconds(self) -> float:
        """Seconds since it began, or those that it took."""
        return (time.monotonic() if self.ended is None else self.ended) - self.began

    @property
    def complaint(self) -> str:
        """The last message of a command that failed."""
        lines = [line for line in self.lines if line.strip()]
        known = [
            line for line in lines if line.startswith(("error:", "training failed:", "interrupted"))
        ]
        last = (known or ["it ended without a message; is there enough memory?"])[-1]
        return last.removeprefix("error:").strip()

    async def run(self) -> None:
        """Start the command and follow it to its end; one that cannot start counts as failed."""
        self.began = time.monotonic()
        try:
            self.code = await self._follow()
        except OSError as error:
            self.lines, self.code = [f"error: the command cannot start ({error.strerror})."], 2
        self.ended = time.monotonic()
        self.changed()

    async def _follow(self) -> int:
        """Return the exit code of the command."""
        program = [sys.executable, "-m", "orthaug.commands.app.child", *self.arguments]
        self.process = await asyncio.create_subprocess_exec(
            *program,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            limit=_LONGEST,
            env={
                **os.environ,
                PROGRESS_VARIABLE: "json",
                "PYTHONIOENCODING": "utf-8",
                "NO_COLOR": "1",
            },
        )
        assert self.process.stderr is not None
        if self.stopping:
            self.stop()
        elif self.ending:
            self.finish()
        async for raw in self.process.stderr:
            line = raw.decode("utf-8", "replace").rstrip()
            message = _message_in(line)
            if message is None:
                self.lines = [*self.lines, line][-_LINES:]
            elif "stage" in message:
                self.stage = ReachedStage.of(message["stage"], self.stage)
            elif "model" in message:
                if self.stage is None:  # else it is of a trial
                    self.models.pop(message["model"], None)
                    self.models[message["model"]] = message
            else:
                self.progress, self.stage = message, None
                self.losses.append((Run.of(message), message["iteration"], message["loss"]))
            self.changed()
        return await self.process.wait()

    def stop(self) -> None:
        """Interrupt the command: it keeps or removes partial files, and ends."""
        self.stopping = True
        if self.process is not None and self.process.stdin is not None:
            self.process.stdin.close()

    def finish(self) -> None:
        """Ask training to end with the result reached so far."""
        self.ending = True
        if self.process is not None and self.process.stdin is not None:
            self.process.stdin.write(ENOUGH_LINE)

    async def end(self) -> None:
        """Stop the command, and wait until it has ended."""
        self.stop()
        if self.process is not None and self.process.returncode is None:
            try:
                await asyncio.wait_for(self.process.wait(), _GRACE)
            except TimeoutError:
                _kill(self.process)


def _message_in(line: str) -> dict[str, Any] | None:
    """Return what a line says of the training: a run, a stage or a model; None for others."""
    with suppress(ValueError):
        return json.loads(line) if line.startswith(('{"run"', '{"stage"', '{"model"')) else None
    return None


class WorkerPool:
    """Workers that answer questions in their own processes.

    So the page neither waits nor holds the data.

    One process waits with its modules imported for the next question.
    """

    def __init__(self) -> None:
        self._idle: list[asyncio.subprocess.Process] = []
        self._coming: asyncio.Task[asyncio.subprocess.Process] | None = None
        self._busy: set[asyncio.subprocess.Process] = set()
        self._room = asyncio.Semaphore(_AT_ONCE)

    async def ask(self, question: str, **given: Any) -> dict[str, Any]:
        """Return the answer of a worker. A caller that is cancelled ends the worker.

        Raises:
            InputError: the question was refused.
        """
        async with self._room:
            process = await self._take()
            self._busy.add(process)
            answer: dict[str, Any] = {"last": True}
            try:
                answer = await _ask_worker(process, {"question": question, **given})
            finally:
                self._busy.discard(process)
                if answer["last"]:
                    _kill(process)
                    self.prepare()
                else:
                    self._idle.append(process)
        if "refused" in answer:
            raise InputError(answer["refused"])
        return answer

    def prepare(self) -> None:
        """Start a process that waits for the next question."""
        if self._coming is None and not self._idle:
            self._coming = asyncio.ensure_future(_start_worker())

    async def _take(self) -> asyncio.subprocess.Process:
        while self._idle:
            process = self._idle.pop()
            if process.returncode is None:
                return process
        coming, self._coming = self._coming, None
        if coming is None or (coming.done() and coming.exception()):  # or it could not start then
            coming = asyncio.ensure_future(_start_worker())
        try:
            return await asyncio.shield(coming)
        except asyncio.CancelledError:
            self._coming = self._coming or coming  # for the next one
            raise
        except OSError as error:
            raise InputError(f"no process can be started ({error.strerror}).") from None

    async def close(self) -> None:
        coming: list[asyncio.subprocess.Process] = []
        if self._coming is not None:
            with suppress(OSError):
                coming = [await self._coming]
        for process in (*self._busy, *self._idle, *coming):
            _kill(process)
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(process.wait(), _GRACE)


async def _start_worker() -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "orthaug.commands.app.worker"),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
        limit=_LONGEST,
        env={**os.environ, "PYTHONIOENCODING": "utf-8"},
    )


async def _ask_worker(
    process: asyncio.subprocess.Process, question: dict[str, Any]
) -> dict[str, Any]:
    assert process.stdin is not None and process.stdout is not None
    try:
        process.stdin.write(json.dumps(question, default=str).encode() + b"\n")
        await process.stdin.drain()
        line = await process.stdout.readline()
        return json.loads(line)
    except (OSError, ValueError):
        raise InputError(
            "the data could not be read: the process ended early. Is there enough memory?"
        ) from None


def _kill(process: asyncio.subprocess.Process) -> None:
    with suppress(ProcessLookupError):
        process.kill()
