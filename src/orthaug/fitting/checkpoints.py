"""States of training on disk, from which an interrupted fit resumes.

A state is that of the Levenberg-Marquardt loop between two steps, so a resumed run takes the same
steps, bit by bit.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug._base.folders import PARTIALS
from orthaug._base.jax import jax
from orthaug.fitting.normal_equations import Normal
from orthaug.fitting.solvers.compiled import State
from orthaug.fitting.solvers.damped_step import StepControl
from orthaug.fitting.solvers.minimize import Pause
from orthaug.models.rows import Overlap

EVERY = 10.0  # s
_ABOUT = "training.json"
_FORMAT = b"orthaug state 1 "
_HEAD = len(_FORMAT) + 65  # bytes: format, checksum, end of line
_ONE: Any = 0
_CONTROL = StepControl(_ONE, _ONE, _ONE, _ONE, _ONE)
_LEAVES = State(_ONE, Normal(_ONE, _ONE, _ONE, Overlap(_ONE, _ONE)), _CONTROL, _ONE, _ONE, _ONE)

OF_DESCENT = Pause((_ONE,) * 5, _ONE, _CONTROL, _ONE, _ONE, _ONE)
"""The form of what a descent keeps."""


@dataclass(eq=False)
class Checkpoints:
    """A folder with the state of every run of one fit.

    `fingerprint` is of all that the fit depends on.

    `every` is the time [s] between two states of a run.
    """

    folder: Path
    fingerprint: str
    every: float = EVERY
    spoilt: list[str] = field(default_factory=list)
    """Files whose state was damaged: those runs begin anew."""
    lost: str = ""
    """Why the last state could not be written; the one before it stays."""

    def opened(self, *, resume: bool) -> Checkpoints:
        """Return a folder ready for states: emptied, or with `resume` as it is.

        Raises:
            InputError: states of another fit, or something else in the folder.
        """
        about = self.folder / _ABOUT
        known = _fingerprint(about)
        if self.folder.exists() and known is None:
            raise InputError(f"{self.folder}: holds no state of a training; give another --out.")
        if resume and known not in (None, self.fingerprint):
            raise InputError(
                f"{self.folder}: is the state of another spec, other data or another version; "
                "fit without --resume."
            )
        if not resume:
            self.discard()
        return self

    def of_run(self, *parts: Any, form: Any = _LEAVES) -> RunCheckpoint:
        """Return the checkpoint of a run that begins with these weights and choices.

        States have the form of the solver's.
        """
        digest = hashlib.sha256(self.fingerprint.encode())
        for part in parts:
            digest.update(
                np.ascontiguousarray(part).tobytes()
                if isinstance(part, np.ndarray)
                else repr(part).encode()
            )
        return RunCheckpoint(self, self.folder / f"{digest.hexdigest()[:24]}.safetensors", form)

    def discard(self) -> None:
        """Remove the states: the fit is done."""
        if _fingerprint(self.folder / _ABOUT) is None:
            return
        for path in self.folder.iterdir():
            if path.suffix in (".safetensors", ".partial") or path.name == _ABOUT:
                path.unlink(missing_ok=True)
        with suppress(OSError):  # somebody else's files are in it
            self.folder.rmdir()


@dataclass(eq=False)
class RunCheckpoint:
    """The state of one run in a file."""

    checkpoints: Checkpoints
    path: Path
    form: Any
    written: float = field(default_factory=time.monotonic)

    def state(self, *shapes: tuple[int, ...]) -> Any:
        """Return the last one that was written whole, finite and with first arrays of these shapes.

        None where there is none.

        A checksum shows what was damaged, not what was made: a run does not go on from what it
        cannot have written.
        """
        from safetensors import SafetensorError
        from safetensors.numpy import load

        try:
            # Mapped into memory, it could not be replaced on Windows
            content = self.path.read_bytes()
        except OSError:
            return None
        try:
            if content[:_HEAD] != _head(content[_HEAD:]):
                raise ValueError
            held = load(content[_HEAD:])
            leaves = [held[str(i)] for i in range(len(held))]
            if any(np.shape(leaf) != shape for leaf, shape in zip(leaves, shapes, strict=False)):
                raise ValueError
            if not all(np.isfinite(leaf).all() for leaf in leaves):
                raise ValueError
            state = jax.tree.unflatten(jax.tree.structure(self.form), leaves)
        except (KeyError, ValueError, SafetensorError):
            self.checkpoints.spoilt.append(self.path.name)
            return None
        return state

    def keep(self, state: object, *, ended: bool = False) -> None:
        """Write the state, or the result of a call that makes it, if due or if the run `ended`.

        A full disk leaves the one before.
        """
        now = time.monotonic()
        if now - self.written < self.checkpoints.every and not (ended and self.path.exists()):
            return
        self.written = now
        try:
            self._write(state() if callable(state) else state)
            self.checkpoints.lost = ""
        except OSError as error:
            self.checkpoints.lost = f"{self.checkpoints.folder}: {error.strerror or error}"

    def _write(self, state: Any) -> None:
        from safetensors.numpy import save

        folder = self.checkpoints.folder
        folder.mkdir(parents=True, exist_ok=True)
        if folder not in PARTIALS.placed:
            PARTIALS.placed.append(folder)
        if not (folder / _ABOUT).exists():
            _replace(
                folder / _ABOUT, json.dumps({"fingerprint": self.checkpoints.fingerprint}).encode()
            )
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(state)]
        if not all(
            np.isfinite(leaf).all() for leaf in leaves
        ):  # a run that failed: nothing goes on from there
            return
        content = save(
            {
                str(i): np.ascontiguousarray(leaf).reshape(leaf.shape)
                for i, leaf in enumerate(leaves)
            }
        )
        _replace(self.path, _head(content) + content)


def _head(content: bytes) -> bytes:
    """Return the bytes before a state: its format and its checksum."""
    return _FORMAT + hashlib.sha256(content).hexdigest().encode() + b"\n"


def _replace(path: Path, content: bytes) -> None:
    """Write a file whole: it is on the disk before it takes its place."""
    partial = path.with_suffix(".partial")
    try:
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        raise


def _fingerprint(about: Path) -> str | None:
    try:
        return str(json.loads(about.read_text(encoding="utf-8"))["fingerprint"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
