"""Routes of the server: the page of a session, uploads and downloads."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, RedirectResponse, Response
from nicegui import app as pages
from nicegui import ui
from starlette.requests import ClientDisconnect

from orthaug._base.errors import InputError
from orthaug._base.memory import in_words
from orthaug._base.progress import LOG
from orthaug.commands.app.gate import PLAIN
from orthaug.commands.app.session import Session, Sessions
from orthaug.commands.app.uploads import begin_file, keep_file
from orthaug.commands.app.view_data import DataView
from orthaug.commands.app.view_model import ModelView
from orthaug.commands.app.view_results import ExportView, ReportView
from orthaug.commands.app.view_training import TrainingView
from orthaug.commands.app.widgets import button, sentence, text

LARGEST = 2 * 2**30  # bytes of an upload: there is a second copy in a temporary folder
_TOO_LARGE = "the file is larger than {}, the limit of this page; give its path instead."
_OFTEN = 0.25  # s between looks at what has changed
_PARTS = ("Data", "Model", "Training", "Report", "Export")
MARK = (
    "<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32'><rect width='32' height='32' "
    "rx='7' fill='#0550ae'/><path d='M9 7v16h16' stroke='#fff' stroke-width='3.4' fill='none' "
    "stroke-linecap='round'/><path d='M9 17h6v6' stroke='#9cc8ff' stroke-width='2.2' "
    "fill='none'/></svg>"
)
"""The icon of the program."""


class Page:
    """The view of a session in one browser tab; several tabs may show the same session."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.data, self.model = DataView(session), ModelView(session)
        self.training, self.report, self.export = (
            TrainingView(session),
            ReportView(session),
            ExportView(session),
        )
        self.onward: dict[str, tuple[ui.html, ui.button]] = {}
        self.seen = dict(session.versions)

    def draw(self) -> None:
        place = files("orthaug.commands.app")
        for tag, name in (("style", "page.css"), ("script", "page.js")):
            ui.add_head_html(f"<{tag}>{(place / name).read_text(encoding='utf-8')}</{tag}>")
        ui.context.client.on_exception(self._complain)
        with ui.element("div").classes("head"):
            ui.html(MARK, sanitize=False, tag="span").classes("logo").props("aria-hidden=true")
            text("orthaug", "h1")
            self.title = text("", "p", "hint")
            with ui.element("div").classes("history"):
                self.undo = button("Undo", self.session.undo).props("aria-keyshortcuts=Control+Z")
                self.redo = button("Redo", self.session.redo)
                self.redo.props("aria-keyshortcuts=Control+Shift+Z")
        start = "Training" if self.session.commands or self.session.shown else "Data"
        with (
            ui.tabs()
            .props("no-caps align=left active-color=tab indicator-color=tab dense")
            .classes("tabs") as tabs
        ):
            for name in _PARTS:
                ui.tab(name)
        tabs.set_value(start)  # before anyone follows: a later one would count as a change
        self._keep_history(tabs, start)
        parts = (self.data, self.model, self.training, self.report, self.export)
        with ui.tab_panels(tabs, value=start).props("animated=false").classes("parts"):
            for name, part in zip(_PARTS, parts, strict=True):
                with ui.tab_panel(name):
                    part.draw()
                    if name != _PARTS[-1]:
                        self._draw_next(name, tabs)
        self._name()
        ui.timer(_OFTEN, self.follow)

    def _draw_next(self, part: str, tabs: ui.tabs) -> None:
        """Draw the button that leads to the next part, with what is missing before it."""
        following = _PARTS[_PARTS.index(part) + 1]
        with ui.element("div").classes("onward"):
            lacking = text("", "p", "hint")
            onward = button(f"Continue to {following}", lambda: tabs.set_value(following))
        self.onward[part] = (lacking, onward)

    def _keep_history(self, tabs: ui.tabs, start: str) -> None:
        """Let the browser's Back, Forward and reload lead to the part that was shown."""

        def go(event: Any) -> None:
            if event.args in _PARTS:
                tabs.set_value(event.args)

        def reopen(event: object) -> None:
            if tabs.value == start:  # otherwise another page was faster
                go(event)

        ui.on("part", go)
        ui.on("reopened", reopen)
        ui.on("undo", self.session.undo)
        ui.on("redo", self.session.redo)
        tabs.on_value_change(
            lambda event: ui.run_javascript(f"shown({json.dumps(str(event.value))}, false)")
        )
        opened = "location.hash ? emitEvent('reopened', location.hash.slice(1)) : shown({}, true)"
        ui.timer(_OFTEN, lambda: ui.run_javascript(opened.format(json.dumps(start))), once=True)

    def follow(self) -> None:
        """Let each part of the page redraw what has changed since it was last drawn."""
        now, seen = dict(self.session.versions), self.seen
        self.seen = now

        def has_moved(what: str) -> bool:
            return now.get(what, 0) != seen.get(what, 0)

        looks: list[Callable[[], None]] = []
        if has_moved("data"):
            looks += [self.data.follow_data, self.model.follow_data]
        if has_moved("spec"):
            authors = set(self.session.authors[seen.get("spec", 0) :])
            author = authors.pop() if len(authors) == 1 else ""
            looks += [
                partial(self.data.follow_spec, author),
                partial(self.model.follow_spec, author),
            ]
        if has_moved("check"):
            looks += [self.data.follow_check, self.model.follow_check]
        if (
            has_moved("work")
            or has_moved("spec")
            or has_moved("data")
            or self.session.running is not None
        ):
            looks.append(self.training.follow_work)
        elif has_moved("check"):
            looks.append(self.training.follow_check)
        if has_moved("work") or self.session.starting is not None:
            looks.append(self.model.follow_work)
        if has_moved("work") or has_moved("spec"):
            looks += [self.report.follow_work, self.export.follow_work]
        if now != seen:
            looks.append(self._name)
        for look in looks:
            try:
                look()
            except Exception as error:  # a part that fails does not stop the others
                LOG.exception("a part of the page failed")
                self._complain(error)

    def _name(self) -> None:
        session = self.session
        self.title.set_content(escape(session.title or "from data to a model"))
        for made, there in ((self.undo, session.earlier), (self.redo, session.undone)):
            made.set_visibility(bool(session.spec.strip()))
            made.set_enabled(bool(there))
        for part, (lacking, onward) in self.onward.items():
            why = session.missing(part)
            lacking.set_content(escape(why))
            onward.set_enabled(not why)

    def _complain(self, error: Exception) -> None:
        message = (
            str(error)
            if isinstance(error, InputError)
            else f"this did not work ({type(error).__name__})."
        )
        ui.notify(sentence(message).replace("`", ""), type="negative")


def application(sessions: Sessions, spec: Path | None) -> FastAPI:
    """Return the application with all its routes, and the pages of NiceGUI behind them."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    @app.get("/")
    async def begin() -> Response:
        try:
            session = sessions.new(spec)
        except InputError as error:
            return _error_page(str(error), 503)
        return RedirectResponse(f"/session/{session.key}", 303)

    @app.put("/session/{key}/file/{name}")
    async def drop(key: str, name: str, request: Request) -> Response:
        return await _keep_upload(sessions, key, name, request)

    @app.get("/session/{key}/get/{what}")
    def get(key: str, what: str, show: bool = False) -> Response:
        session = sessions.find(key)
        try:
            if session is None:
                raise InputError("this session has ended.")
            file = session.download(what)
        except InputError as error:
            return _error_page(str(error), 404)
        if show and file.suffix == ".html":  # else a spec could be read as a page of this origin
            return FileResponse(file, headers={"cache-control": "no-store"}, media_type="text/html")
        return FileResponse(file, filename=what, headers={"cache-control": "no-store"})

    @ui.page("/session/{key}", title="orthaug", response_timeout=20)
    def work(key: str) -> Response | None:
        session = sessions.find(key)
        if session is None:
            return _error_page(
                "This session has ended. Its spec is offered at the start of a new one.",
                404,
            )
        Page(session).draw()

    pages.on_exception(lambda error: None)  # each page reports its own errors
    ui.run_with(
        app,
        title="orthaug",
        favicon=MARK,
        dark=None,
        language="en-US",
        tailwind=False,
        binding_refresh_interval=None,
        reconnect_timeout=30,
        show_welcome_message=False,
    )
    return app


async def _keep_upload(sessions: Sessions, key: str, name: str, request: Request) -> Response:
    """Return the answer to an upload: the file is written piece by piece, then examined."""
    session = sessions.find(key)
    if session is None:
        return _refuse("this session has ended; open the page anew.", 404)
    partial: Path | None = None
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and int(declared) > LARGEST:
        return _refuse(_TOO_LARGE.format(in_words(LARGEST)), 413)
    try:
        partial, size = begin_file(session.folder, name), 0
        with partial.open("wb") as file:
            async for piece in request.stream():
                size += len(piece)
                if size > LARGEST:
                    return _refuse(_TOO_LARGE.format(in_words(LARGEST)), 413)
                file.write(piece)
        place, note = keep_file(partial, name)
    except InputError as error:
        return _refuse(str(error), 422)
    except ClientDisconnect:
        return _refuse("only a part of the file arrived.", 400)
    except OSError as error:
        return _refuse(f"the file cannot be kept ({error.strerror}).", 507)
    finally:
        if partial is not None:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
    session.open_file(place)
    return JSONResponse({"kept": place.name, "note": note})


def _refuse(text: str, code: int) -> Response:
    return JSONResponse({"refused": text}, code)


def _error_page(text: str, code: int) -> Response:
    return HTMLResponse(
        f"{PLAIN}<p>{escape(text)}</p><p><a href='/'>Begin anew</a></p></body></html>", code
    )
