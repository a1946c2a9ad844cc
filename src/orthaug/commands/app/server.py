"""The server of the page: local only, behind a token, ended by Ctrl-C with all that it started."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import tempfile
import threading
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from orthaug._base.errors import InputError
from orthaug._base.folders import PARTIALS
from orthaug.commands import streams
from orthaug.commands.app.gate import Gate
from orthaug.commands.app.session import Sessions
from orthaug.commands.signals import WATCH

_HOST = "127.0.0.1"
_LOOK = 0.2  # s between looks at whether Ctrl-C came


def free_port(wanted: int | None) -> socket.socket:
    """Return a socket that listens on this machine only, on the wanted port or a free one.

    Raises:
        InputError: a port that is taken or not allowed.
    """
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        if os.name == "posix":  # elsewhere this would share the port
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((_HOST, wanted or 0))
    except (OSError, OverflowError) as error:
        listening.close()
        why = getattr(error, "strerror", None) or error
        raise InputError(
            f"--port: cannot listen on port {wanted} ({why}); leave it out for a free one."
        ) from None
    return listening


def check_installed() -> None:
    """Raise InputError where the extra is not installed."""
    try:
        import nicegui  # noqa: F401
    except ImportError:
        raise InputError(
            "the page is drawn by NiceGUI, which is not installed; pip install 'orthaug[app]', "
            "or pip install nicegui."
        ) from None


@contextlib.contextmanager
def private_folder() -> Iterator[Path]:
    """Yield a folder that only this user can read; it is removed at the end.

    The folder of a killed program is removed by the next one.
    """
    before = os.umask(0o077)
    folder = PARTIALS.folder(Path(tempfile.gettempdir()))
    try:
        yield folder
    finally:
        PARTIALS.discard(folder)
        os.umask(before)


def serve(spec: Path | None, *, port: int | None = None, browser: bool = True) -> None:
    """Serve the page until Ctrl-C.

    Raises:
        InputError: a spec that cannot be read, a port that is taken, or NiceGUI missing.
    """
    listening = free_port(port)
    with listening, private_folder() as folder:
        # Else it would keep one in the working folder
        os.environ["NICEGUI_STORAGE_PATH"] = str(folder / "storage")
        check_installed()
        from orthaug.commands.app.spec_text import in_file

        sessions = Sessions(folder)
        if spec is not None:
            in_file(spec)
        with _asked_to_end() as asked:
            asyncio.run(_serve(sessions, listening, spec, asked, browser))
    streams.say("ended")


@contextlib.contextmanager
def _asked_to_end() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C sets; a second Ctrl-C ends the program at once."""
    if WATCH.active:
        with WATCH.ask_to_stop() as event:
            yield event
    else:
        event = threading.Event()
        with contextlib.suppress(KeyboardInterrupt):
            yield event


async def _serve(
    sessions: Sessions,
    listening: socket.socket,
    spec: Path | None,
    asked: threading.Event,
    browser: bool,
) -> None:
    import uvicorn

    from orthaug.commands.app.routes import application

    gate = Gate(application(sessions, spec), listening.getsockname()[1])
    options: dict[str, Any] = {
        "log_level": "critical",
        "access_log": False,
        "timeout_graceful_shutdown": 1,
    }
    server = uvicorn.Server(uvicorn.Config(gate, lifespan="on", ws_max_size=2**26, **options))
    server.capture_signals = contextlib.nullcontext  # type: ignore[method-assign]
    sessions.desk.prepare()
    serving = asyncio.ensure_future(server.serve([listening]))
    while not (server.started or serving.done()):
        await asyncio.sleep(0.02)
    streams.echo(f"{gate.url}\nThe page is at this address, on this machine only. Ctrl-C ends it.")
    if browser:
        threading.Thread(target=webbrowser.open, args=(gate.ticket(),), daemon=True).start()
    try:
        while not (asked.is_set() or serving.done()):
            await asyncio.sleep(_LOOK)
    finally:
        await sessions.close()
        server.should_exit = True
        await serving
