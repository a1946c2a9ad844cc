"""Work on the page: file, spec, check, training, results.

It lives on the server; a page only shows it.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import secrets
import shutil
import time
import zipfile
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import suppress
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from orthaug._base.errors import InputError
from orthaug._base.progress import LOG
from orthaug.commands.app.kept_results import KeptResult, keep_result, kept_results
from orthaug.commands.app.processes import Command, WorkerPool
from orthaug.commands.app.spec_text import (
    Shelf,
    absolute,
    files,
    in_file,
    keep,
    kept_name,
    kept_title,
    plain,
    results_folder,
    section,
    with_physics,
    with_value,
)
from orthaug.commands.app.uploads import as_name

_SESSIONS = 50  # that are kept at once
_PAUSE = 0.6  # s without a change until a spec is checked
_TYPING = 2.0  # s between two changes in the editor that are undone together
KINDS = ("fit", "compare")


class Session:
    """State and actions of one user's work.

    `versions` counts the changes of `data`, `spec`, `check` and `work`, for pages to follow.
    """

    def __init__(self, key: str, folder: Path, desk: WorkerPool) -> None:
        self.key, self.folder, self.desk = key, folder, desk
        self.versions: Counter[str] = Counter()
        self.title = ""
        """What the work is called: the file that it began with."""
        self.data: Path | None = None
        self.found: dict[str, Any] | None = None
        self.raw: dict[Path, dict[str, Any]] = {}
        """By file that was looked at, the curves of its columns."""
        self.looking = ""
        self.trouble = ""
        """What is wrong with the data."""
        self.unfit = ""
        """Why the chosen channels make no spec."""
        self.spec = ""
        self.kept_as = ""
        """The name under which its spec and its results are kept when the server ends; empty
        until there is something to keep.
        """
        self.undone: list[str] = []
        """Specs that redo brings back, the next one last."""
        self.earlier: list[str] = []
        """Specs that undo brings back, the next one last."""
        self.shelf: Shelf = {}
        """By kind of physics, what the spec had of it before another kind took its place."""
        self._typed = 0.0
        self.starting: float | None = None
        """When the estimation of initial values began that runs now."""
        self.start_trouble = ""
        """Why there are no new initial values."""
        self.authors: list[str] = []
        """Author of each change of the spec: a part of a page, which ignores its own changes."""
        self.checked: dict[str, Any] | None = None
        self.refused = ""
        """Why the spec cannot be trained."""
        self.stale = False
        """True if `checked` is of an earlier spec: this one could not be opened."""
        self.checking = False
        self.commands: dict[str, Command] = {}
        self.trained: dict[str, str] = {}
        """The spec of each result."""
        self.results: dict[str, dict[str, Any]] = {}
        self.verdicts: dict[str, dict[str, Any]] = {}
        """Of each result: `level` and `sentences`, as its report begins."""
        self.kept: list[KeptResult] = []
        """Results of this spec, the oldest first."""
        self.shown: dict[str, int] = {}
        """By kind, the number of the kept result that is shown."""
        self.curves: dict[str, dict[str, Any]] = {}
        """Of each result, and of a pair, what the worker's `free_runs` gives."""
        self.pair: tuple[KeptResult, ...] = ()
        """Two fits that are compared."""
        self.exports: dict[str, str] = {}
        """By target, why there is none; empty where there is."""
        self._tasks: set[asyncio.Task[Any]] = set()
        self._check: asyncio.Task[None] | None = None
        self._look: asyncio.Task[None] | None = None

    @property
    def untouched(self) -> bool:
        """True if the session has not been used yet."""
        return not self.commands and self.data is None and set(self.authors) <= {"file"}

    def mark_changed(self, what: str) -> None:
        """Mark the session as changed, so that every page of it redraws."""
        self.versions[what] += 1

    def start(self, work: Awaitable[Any]) -> asyncio.Task[Any]:
        """Start a coroutine without waiting for it."""
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._report_failure)
        return task

    def _report_failure(self, task: asyncio.Task[Any]) -> None:
        """Report the error of a task that has failed."""
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            LOG.error("a task of the page failed", exc_info=error)
            self.trouble = f"this did not work ({type(error).__name__})."
            self.mark_changed("data")

    @property
    def first_step(self) -> str:
        """The first step of the work, where there is no spec yet."""
        return (
            "Start with a data file."
            if self.found is None
            else "Choose the channels in Data first."
        )

    def missing(self, part: str) -> str:
        """Return what is missing before a part of the page is done; empty where nothing is."""
        if not self.spec.strip():
            begin = part == "Data" and self.found is not None
            return "Begin with the channels first." if begin else self.first_step
        if part == "Model" and self.checking:
            return "The spec is being checked."
        if part == "Model" and self.refused:
            return "The spec cannot be trained yet: Check says why."
        if part in ("Training", "Report") and self.running is not None:
            return "Training is still running."
        if part in ("Training", "Report") and not self.results:
            return "Nothing has been trained yet."
        return ""

    # Data

    def open_file(self, path: Path) -> None:
        """Look at a data file; begin a spec for it where its columns show their roles."""
        self.data, self.found = Path(os.path.abspath(path)), None
        self.title = (self.spec.strip() and self.title) or path.name
        self._look_again(None, None, None)
        if self.spec.strip():  # it may name this file
            self._check_soon()

    def try_example(self) -> None:
        """Begin with the records and the spec of the built-in example."""
        self.start(self._make_example())

    async def _make_example(self) -> None:
        self.looking, self.trouble = "Writing the records …", ""
        self.mark_changed("data")
        try:
            spec = (await self.desk.ask("example", folder=self.folder))["spec"]
        except InputError as error:
            self.looking, self.trouble = "", self.reword(error)
            self.mark_changed("data")
            return
        self.title = "mass, spring and damper"
        self.write(spec, "example")
        self.open_file(self.folder / "train.csv")

    def choose(self, inputs: Sequence[str], outputs: Sequence[str], step: float | None) -> None:
        """Begin the spec anew with these columns."""
        self._look_again(",".join(inputs), ",".join(outputs), step)

    def _look_again(self, inputs: str | None, outputs: str | None, step: float | None) -> None:
        if self._look is not None:
            self._look.cancel()
        self._look = self.start(self._look_at(inputs, outputs, step))

    async def _look_at(self, inputs: str | None, outputs: str | None, step: float | None) -> None:
        assert self.data is not None
        self.looking, self.trouble, self.unfit = f"Looking at {self.data.name} …", "", ""
        self.mark_changed("data")
        place = self.folder / "spec.toml"
        try:
            found = await self.desk.ask(
                "look", path=self.data, out=place, inputs=inputs, outputs=outputs, step=step
            )
            if self.found is not None and found["spec"] is None:
                self.unfit = found["open"]
            else:
                self.found = found
            kept = {path: curves for path, curves in self.raw.items() if self.names(path)}
            self.raw = kept | {self.data: found["curves"]}
            if found["spec"] is not None and (inputs is not None or self._may_begin):
                self._begin(found["spec"])
        except InputError as error:
            if self.found is None:
                self.trouble = self.reword(error)
            else:
                self.unfit = self.reword(error)
        finally:
            self.looking = ""
            self.mark_changed("data")

    @property
    def _may_begin(self) -> bool:
        """True if looking at a file may begin the spec.

        It may where there is no spec, or one that an earlier look began and nobody has edited.
        """
        return not self.spec.strip() or (set(self.authors) <= {"look"} and not self.apart)

    def _begin(self, spec: str) -> None:
        assert self.data is not None
        if self.title != self.data.name:  # the earlier work keeps its name
            self.title, self.kept_as = self.data.name, ""
        own = self.data.parent == self.folder  # an uploaded file is in the same folder as the spec
        self.write(spec if own else absolute(spec, self.folder), "look")

    @property
    def apart(self) -> bool:
        """True if the spec does not name the file that was looked at."""
        return self.data is not None and bool(self.spec.strip()) and not self.names(self.data)

    def names(self, file: Path) -> bool:
        """Return whether the spec names a file, or has a pattern that matches it."""
        whole = os.path.abspath(file)
        named = [os.path.abspath(self.folder / name) for name in files(self.content())]
        return any(whole == name or fnmatch(whole, name) for name in named)

    def add_test(self) -> None:
        """Add the file that was looked at to the tests of the spec."""
        assert self.data is not None
        file = self.data.name if self.data.parent == self.folder else self.data.as_posix()
        taken, name = section(self.content(), "data", "tests"), re.sub(r"\W", "_", self.data.stem)
        while name in taken:
            name += "_"
        self.edit("test", with_value, ("data", "tests", name), {"files": [file]})
        self.mark_changed("data")

    def open_spec(self, path: Path, *, kept: bool = False) -> None:
        """Open a spec from a file, or one of earlier work that was kept.

        The file is read, and never written.

        Raises:
            InputError: a file that cannot be read, or broken TOML.
        """
        text = (
            path.read_text(encoding="utf-8")
            if kept
            else absolute(in_file(path), path.absolute().parent)
        )
        self.title = kept_title(path) if kept else path.name
        self.kept_as = path.stem if kept else ""
        self.write(text, "file")
        self.mark_changed("data")
        if kept:
            self.kept = kept_results(self._results_folder)
            for kind in KINDS:
                if own := [result for result in self.kept if result.kind == kind]:
                    self.show_result(own[-1])

    # Spec

    def write(self, text: str, author: str) -> None:
        """Take a new text of the spec; check it when it has not changed for a moment."""
        if text == self.spec:
            return
        now = time.monotonic()
        typing = author == "editor" and now - self._typed < _TYPING
        self._typed = now if author == "editor" else 0.0
        if self.spec.strip() and not (typing and self.earlier):
            self.earlier.append(self.spec)
        self.undone.clear()
        self._take(text, author)

    def undo(self) -> None:
        """Take back the last change of the spec."""
        self._go(self.earlier, self.undone)

    def redo(self) -> None:
        """Make the change again that was taken back last."""
        self._go(self.undone, self.earlier)

    def _go(self, there: list[str], back: list[str]) -> None:
        if there:
            back.append(self.spec)
            self._typed = 0.0
            self._take(there.pop(), "history")

    def _take(self, text: str, author: str) -> None:
        self.spec = text
        self.authors.append(author)
        self.mark_changed("spec")
        if author != "file" and text.strip():
            self._keep_spec()
        self._check_soon()

    def _keep_spec(self) -> None:
        self.kept_as = self.kept_as or kept_name(as_name(self.title) or "spec", self.key)
        keep(self.kept_as, self.spec)

    def edit(self, author: str, change: Callable[..., str], *given: Any) -> None:
        """Replace the spec by the result of a function of `spec_text` with these arguments."""
        self.write(change(self.spec, *given), author)

    def choose_physics(self, kind: str) -> None:
        """Write the physics as `terms` or as equations of `motion`; the other kind is kept."""
        self.edit("physics", with_physics, kind, self.shelf)

    def estimate_starts(self) -> None:
        """Estimate initial values of a motion from the data, and write them into the spec."""
        self.starting, self.start_trouble = time.monotonic(), ""
        self.mark_changed("work")
        self.start(self._estimate_starts(self.spec))

    async def _estimate_starts(self, begun: str) -> None:
        place = self.folder / "starts.toml"
        place.write_text(begun, encoding="utf-8")
        try:
            spec, found = begun, await self.desk.ask("starts", path=place)
            for name, value in found["values"].items():
                spec = with_value(spec, ("motion", "parameters", name, "initial"), value)
            if self.spec == begun:
                self.write(spec, "starts")
            else:
                self.start_trouble = "the spec has changed meanwhile; estimate them again."
        except InputError as error:
            self.start_trouble = self.reword(error)
        finally:
            self.starting = None
            self.mark_changed("work")

    def _check_soon(self) -> None:
        if self._check is not None:
            self._check.cancel()
        self.checking = bool(self.spec.strip())
        self.mark_changed("check")
        self._check = self.start(self._run_check())

    async def _run_check(self) -> None:
        await asyncio.sleep(_PAUSE)
        if not self.spec.strip():
            self.checked, self.refused, self.stale = None, "", False
            self.mark_changed("check")
            return
        place = self.folder / "check.toml"
        place.write_text(self.spec, encoding="utf-8")
        try:
            self.checked = await self.desk.ask("examine", path=place, whole=False)
            if self.checked["check"] is None:
                self.refused, self.stale = "", False
                self.mark_changed("check")
                self.checked = await self.desk.ask("examine", path=place, whole=True)
            self.refused, self.stale = self.reword(self.checked["refusal"] or ""), False
        except InputError as error:
            self.refused, self.stale = self.reword(error), True
        self.checking = False
        self.mark_changed("check")

    @property
    def units(self) -> dict[str, str]:
        """Units of parameters that follow from the channels of the present spec.

        Empty until the spec is checked.
        """
        if self.checked is None or self.checking or self.stale:
            return {}
        return {name: asked or "1" for name, _, asked in self.checked["units"] if asked is not None}

    def content(self) -> dict[str, Any]:
        """Return the spec as dictionaries; empty while its TOML is invalid."""
        try:
            return plain(self.spec)
        except InputError:
            return {}

    def reword(self, text: Any) -> str:
        """Return a message without the session's own folder and file names."""
        own = re.escape(f"{self.folder}{os.sep}")
        text = re.sub(rf"^{own}[\w-]+\.toml: ", "", str(text))
        return text.replace(f"{self.folder}/", "").replace(f"{self.folder}\\", "")

    # Training

    @property
    def running(self) -> Command | None:
        """The training that runs now."""
        return next(
            (command for kind in KINDS if (command := self.commands.get(kind)) and command.running),
            None,
        )

    def train(self, kind: str) -> None:
        """Run `orthaug fit` or `orthaug compare` on the spec."""
        if self.running is not None or not self.spec.strip():
            return
        place = self.folder / "spec.toml"
        place.write_text(self.spec, encoding="utf-8")
        shutil.rmtree(self.folder / f"{kind}.training", ignore_errors=True)
        self.exports.clear()
        arguments = (kind, str(place), "--out", str(self.folder / kind), "--force")
        command = self.commands[kind] = Command(arguments, lambda: self.mark_changed("work"))
        self.mark_changed("work")
        self.start(self._follow_run(kind, command, self.spec))

    async def _follow_run(self, kind: str, command: Command, spec: str) -> None:
        await command.run()
        if command.code == 0:
            self._keep_spec()
            try:
                keep_result(self._results_folder, kind, self.folder / kind, spec)
            except OSError:  # it is shown all the same
                self.trouble = "The result could not be kept beside the others."
            self.kept = kept_results(self._results_folder)
            self.shown[kind] = self.kept[-1].number if self.kept else 0
            await self._read_result(kind, spec)
        self.mark_changed("work")

    @property
    def _results_folder(self) -> Path:
        return results_folder(self.kept_as)

    async def _read_result(self, kind: str, spec: str) -> None:
        """Read the result in the folder, the verdict of its report, and its free runs."""
        place = self.folder / kind / "result.json"
        self.trained[kind] = spec
        self.verdicts.pop(kind, None)
        self.curves.pop(kind, None)
        self.exports.clear()
        with suppress(OSError, ValueError):  # InputError among them
            self.results[kind] = json.loads(place.read_text(encoding="utf-8"))
            self.verdicts[kind] = await self.desk.ask("verdict", path=place, kind=kind)
        self.mark_changed("work")
        models = {folder.name: folder for folder in sorted((place.parent / "models").glob("*"))}
        fitted = {"model": place.parent / "model", "physics alone": place.parent / "model-physics"}
        await self._run_freely(kind, spec, models or fitted)

    async def _run_freely(self, what: str, spec: str, models: Mapping[str, Path]) -> None:
        """Ask for the free runs of saved models on the data of a spec."""
        place = self.folder / f"{what}-runs.toml"
        place.write_text(spec, encoding="utf-8")
        there = {name: folder for name, folder in models.items() if folder.is_dir()}
        try:
            self.curves[what] = await self.desk.ask("free_runs", path=place, models=there)
        except InputError as error:
            self.curves[what] = {"refused": self.reword(error)}
        self.mark_changed("work")

    def show_result(self, kept: KeptResult, *, with_spec: bool = False) -> None:
        """Show a kept result again; `with_spec` makes its spec the present one."""
        if self.running is not None:
            return
        place = self.folder / kept.kind
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(kept.folder, place)
        (place / "spec.toml").unlink(missing_ok=True)  # it is no part of what the command writes
        self.shown[kept.kind] = kept.number
        if with_spec:
            self.write(kept.spec, "kept")
        self.start(self._read_result(kept.kind, kept.spec))

    def choose_pair(self, kept: KeptResult, chosen: bool) -> None:
        """Take a fit into the pair that is compared, or out of it; of three the first one goes."""
        if chosen == (kept in self.pair):
            return
        others = tuple(one for one in self.pair if one.number != kept.number)
        self.pair = (*others, kept)[-2:] if chosen else others
        self.curves.pop("pair", None)
        self.mark_changed("work")
        if len(self.pair) == 2:
            models = {one.name: one.folder / "model" for one in self.pair}
            self.start(self._run_freely("pair", self.pair[-1].spec, models))

    def stop(self) -> None:
        """Interrupt the training that runs now."""
        if self.running is not None:
            self.running.stop()
            self.mark_changed("work")

    def finish(self) -> None:
        """Let the training that runs now end with the result reached so far."""
        if self.running is not None:
            self.running.finish()
            self.mark_changed("work")

    # Downloads

    def export(self, target: str, name: str) -> None:
        """Run `orthaug export` on the model."""
        self.start(self._run_export(target, name))

    async def _run_export(self, target: str, name: str) -> None:
        arguments = (
            "export",
            str(self.folder / "fit"),
            "--to",
            target,
            "--out",
            str(self.folder / "export" / target),
        )
        (self.folder / "export").mkdir(exist_ok=True)
        command = Command((*arguments, "--name", name, "--force"), lambda: None)
        self.exports[target] = "…"
        self.mark_changed("work")
        await command.run()
        if target in self.exports:  # else another model or another name came in between
            self.exports[target] = "" if command.code == 0 else self.reword(command.complaint)
            self.mark_changed("work")

    def download(self, what: str) -> Path:
        """Return the file to download under a name: from a fixed list, never a path.

        Raises:
            InputError: nothing there.
        """
        if what == "spec.toml" and self.spec:
            place = self.folder / "download.toml"
            place.write_text(self.spec, encoding="utf-8")
            return place
        single = {"report.html": "fit/report.html", "result.json": "fit/result.json"}
        single["comparison.html"] = "compare/report.html"
        folders = {"model.zip": "fit/model", "result.zip": "fit", "comparison.zip": "compare"}
        folders |= {
            f"{target}.zip": f"export/{target}" for target, why in self.exports.items() if not why
        }
        if what in single and (self.folder / single[what]).is_file():
            return self.folder / single[what]
        if what in folders and (self.folder / folders[what]).is_dir():
            return _zip_folder(self.folder / folders[what], self.folder / f"download-{what}")
        raise InputError("there is nothing of that name yet.")

    async def close(self) -> None:
        for task in list(self._tasks):
            if task is self._check or task is self._look:
                task.cancel()
        await asyncio.gather(*(command.end() for command in self.commands.values()))
        rest = list(self._tasks)
        for task in rest:
            task.cancel()
        await asyncio.gather(*rest, return_exceptions=True)


class Sessions:
    """All sessions, by keys that cannot be guessed."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.desk = folder, WorkerPool()
        self._open: dict[str, Session] = {}
        self._made = 0

    def new(self, spec: Path | None = None) -> Session:
        """Return a session in a folder of its own, which nobody else can read.

        Raises:
            InputError: too many sessions, or a spec that cannot be read.
        """
        untouched = [session for session in self._open.values() if session.untouched]
        if len(self._open) >= _SESSIONS and untouched:
            del self._open[untouched[0].key]
        if len(self._open) >= _SESSIONS:
            raise InputError(f"{_SESSIONS} sessions are open; end orthaug app, and start it again.")
        key = secrets.token_urlsafe(12)
        self._made += 1
        folder = self.folder / f"work-{self._made}"
        folder.mkdir(mode=0o700)
        session = self._open[key] = Session(key, folder, self.desk)
        if spec is not None:
            session.open_spec(spec)
        return session

    def find(self, key: str) -> Session | None:
        return self._open.get(key)

    async def close(self) -> None:
        await asyncio.gather(
            self.desk.close(), *(session.close() for session in self._open.values())
        )


def _zip_folder(folder: Path, place: Path) -> Path:
    with zipfile.ZipFile(place, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, file.relative_to(folder.parent).as_posix())
    return place
