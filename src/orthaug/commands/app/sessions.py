"""All sessions of a server, by keys that cannot be guessed."""

from __future__ import annotations

import asyncio
import secrets
from pathlib import Path

from orthaug._base.errors import InputError
from orthaug.commands.app.processes import Desk
from orthaug.commands.app.session import Session

_SESSIONS = 50  # that are kept at once


class Sessions:
    """All work that goes on, by keys that cannot be guessed."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.desk = folder, Desk()
        self._open: dict[str, Session] = {}
        self._made = 0

    def new(self, spec: Path | None = None) -> Session:
        """A session in a folder of its own, which nobody else may read.

        Raises:
            InputError: too many sessions, or a spec that cannot be read.
        """
        untouched = [session for session in self._open.values() if session.untouched]
        if len(self._open) >= _SESSIONS and untouched:
            del self._open[untouched[0].key]
        if len(self._open) >= _SESSIONS:
            raise InputError(f"{_SESSIONS} pieces of work are open; end orthaug app, and start it again.")
        key = secrets.token_urlsafe(12)
        self._made += 1
        folder = self.folder / f"work-{self._made}"
        folder.mkdir(mode=0o700)
        session = self._open[key] = Session(key, folder, self.desk)
        if spec is not None:
            session.open_spec(spec)
        return session

    def find(self, key: str) -> Session | None:
        """The session of a key."""
        return self._open.get(key)

    async def close(self) -> None:
        """End all that runs."""
        await asyncio.gather(self.desk.close(), *(session.close() for session in self._open.values()))
