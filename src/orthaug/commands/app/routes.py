"""What the server answers: the page of a session, files that are dropped, files that are taken away."""

from __future__ import annotations

import os
from contextlib import suppress
from html import escape
from pathlib import Path

from fastapi import FastAPI, Request
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, RedirectResponse, Response
from nicegui import app as pages
from nicegui import ui
from starlette.requests import ClientDisconnect

from orthaug._base.errors import InputError
from orthaug.commands.app.gate import PLAIN
from orthaug.commands.app.page import MARK, Page
from orthaug.commands.app.session import Sessions


def application(sessions: Sessions, spec: Path | None) -> FastAPI:
    """All routes, with the pages of NiceGUI behind them."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    @app.get("/")
    async def begin() -> Response:
        try:
            session = sessions.new(spec)
        except InputError as error:
            return _told(str(error), 503)
        return RedirectResponse(f"/session/{session.key}", 303)

    @app.put("/session/{key}/file/{name}")
    async def drop(key: str, name: str, request: Request) -> Response:
        return await _kept(sessions, key, name, request)

    @app.get("/session/{key}/get/{what}")
    def get(key: str, what: str, show: bool = False) -> Response:
        session = sessions.find(key)
        try:
            if session is None:
                raise InputError("this work is not open any more.")
            file = session.download(what)
        except InputError as error:
            return _told(str(error), 404)
        if show and file.suffix == ".html":  # else a spec could be read as a page of this origin
            return FileResponse(file, headers={"cache-control": "no-store"}, media_type="text/html")
        return FileResponse(file, filename=what, headers={"cache-control": "no-store"})

    @ui.page("/session/{key}", title="orthaug", response_timeout=20)
    def work(key: str) -> Response | None:
        session = sessions.find(key)
        if session is None:
            return _told("This work is not open any more. Its spec is offered where something new begins.", 404)
        Page(session).draw()

    pages.on_exception(lambda error: None)  # each page tells of its own
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


async def _kept(sessions: Sessions, key: str, name: str, request: Request) -> Response:
    """A file as it comes, a piece at a time, and looked at once it is whole."""
    session = sessions.find(key)
    if session is None:
        return _refused("this work is not open any more; open the page anew.", 404)
    partial: Path | None = None
    try:
        place = session.place_for(name)
        partial = place.with_name(f"{place.name}.partial")
        with partial.open("wb") as file:
            async for piece in request.stream():
                file.write(piece)
        os.replace(partial, place)
    except InputError as error:
        return _refused(str(error), 422)
    except ClientDisconnect:
        return _refused("the file came only in part.", 400)
    except OSError as error:
        return _refused(f"the file cannot be kept ({error.strerror}).", 507)
    finally:
        if partial is not None:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
    session.open_file(place)
    return JSONResponse({"kept": place.name})


def _refused(text: str, code: int) -> Response:
    return JSONResponse({"refused": text}, code)


def _told(text: str, code: int) -> Response:
    return HTMLResponse(f"{PLAIN}<p>{escape(text)}</p><p><a href='/'>Begin anew</a></p></body></html>", code)
