"""Folders and files that appear whole or not at all: written beside their place, then renamed.

What is in the place is replaced only where orthaug wrote it and nobody changed it, or by force.
The manifest of a folder lists every file that orthaug wrote into it, with its checksum. What is
not in its place yet is named after the process, and removed when that ends early.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import secrets
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from orthaug import __version__
from orthaug._base.errors import InputError, OutputError

MANIFEST = "manifest.json"
_PARTIAL, _OLD = ".orthaug-partial-", ".orthaug-old-"
# Of a folder that several machines share
_HOST = hashlib.sha256(platform.node().encode()).hexdigest()[:8]
_OF_THE_SYSTEM = {
    ".DS_Store",
    "Thumbs.db",
    "desktop.ini",
}  # file managers write these into every folder


class Partials:
    """The partial folders and files of this process.

    `lock` is held while one is put in its place.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.placed: list[Path] = []
        self.seen: dict[str, str] = {}
        """Checksum of each folder's manifest when a command that writes it began."""
        self.overtaken: list[Path] = []
        """Folders that were replaced although another run had written them meanwhile."""
        self._open: dict[Path, Sequence[Path]] = {}
        self._swept: set[Path] = set()

    def folder(self, parent: Path, made: Sequence[Path] = ()) -> Path:
        """Return a new folder in `parent`; `made` are the parents that vanish with it."""
        with self.lock:
            partial = self._name_file(parent, made)
            partial.mkdir()
            return partial

    def file(self, parent: Path) -> Path:
        """Return a new empty file in `parent`."""
        with self.lock:
            partial = self._name_file(parent, ())
            partial.touch(exist_ok=False)
            return partial

    def shelter(self, parent: Path) -> Path:
        """Return a new folder for the former content, until the new one is in its place."""
        shelter = parent / _name(_OLD)
        shelter.mkdir()
        return shelter

    def mark_placed(self, partial: Path, place: Path, *, result: bool = True) -> None:
        """Note that a partial one is in its place.

        `placed` has only what is a result of the command.
        """
        self._open.pop(partial, None)
        if result:
            self.placed.append(place)

    def discard(self, partial: Path) -> None:
        """Remove a partial one, and the parents that were made for it."""
        made = self._open.pop(partial, ())
        for _ in range(20):  # whoever writes into it may not have stopped yet
            if partial.is_dir():
                shutil.rmtree(partial, ignore_errors=True)
            else:
                with suppress(OSError):
                    partial.unlink(missing_ok=True)
            if not os.path.lexists(partial):
                break
            time.sleep(0.01)
        for parent in made:
            with suppress(OSError):  # somebody else's files are in it by now
                parent.rmdir()

    def discard_all(self) -> None:
        """Remove all of them, and let no other be made or put in its place, as the process ends."""
        self.lock.acquire()
        for partial in list(self._open):
            self.discard(partial)

    def _name_file(self, parent: Path, made: Sequence[Path]) -> Path:
        if parent not in self._swept:
            remove_stale(parent, self._open)
            self._swept.add(parent)
        partial = parent / _name(_PARTIAL)
        self._open[partial] = made
        return partial


PARTIALS = Partials()  # of the process, as its signals are


def remove_stale(parent: Path, alive: Sequence[Path] | dict[Path, Sequence[Path]] = ()) -> None:
    """Remove what processes of this machine left in `parent` when they were killed.

    Folders that were being replaced are restored.
    """
    if os.name != "posix":  # elsewhere asking for a process may end it
        return
    with suppress(OSError):
        for path in parent.iterdir():
            if path in alive or not path.name.startswith((_PARTIAL, _OLD)) or _lives(path.name):
                continue
            if path.name.startswith(_OLD):
                for old in path.iterdir():
                    if not os.path.lexists(parent / old.name):
                        old.rename(parent / old.name)
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


def _name(kind: str) -> str:
    return f"{kind}{_HOST}-{os.getpid()}-{secrets.token_hex(4)}"


def _lives(name: str) -> bool:
    """Return whether the process in a name may be alive; one of another machine may be."""
    parts = name.split("-")
    if len(parts) != 5 or parts[2] != _HOST or not parts[3].isdecimal():
        return True
    process = int(parts[3])
    if process == os.getpid():  # an earlier process had the same number
        return name.startswith(_OLD)
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return True


def check_replaceable(folder: Path, *, force: bool = False) -> None:
    """Raise InputError unless `folder` may be written.

    It must be absent, empty or unchanged since orthaug wrote it, in a place that can be written.

    Args:
        force: whatever the folder holds may be lost.
    """
    try:
        there = folder.exists() or folder.is_symlink()
        if there and not folder.is_dir():
            raise OutputError(f"{folder}: not a folder; give another name.")
        mine = not_ours(folder) if there and not force else None
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror}).") from None
    if mine is not None:
        raise OutputError(
            f"{folder}: holds {mine}; give another folder, or replace all of it with --force (in "
            "Python: force=True)."
        )
    if there:
        _check_parts_writable(folder)
    if there and force:
        _check_no_one_lives_there(folder)
    ancestor = _nearest_ancestor(folder)
    if not ancestor.is_dir():
        raise OutputError(f"{folder}: cannot be written; {ancestor} is not a folder.")
    try:
        Path(tempfile.mkdtemp(prefix=".orthaug-", dir=ancestor)).rmdir()
    except OSError as error:
        raise OutputError(
            f"{folder}: cannot be written ({error.strerror} in {ancestor})."
        ) from None


def remember(folder: Path) -> None:
    """Note the result that a folder holds now, to notice a run that replaces it meanwhile."""
    place = os.path.realpath(folder)
    PARTIALS.seen[place] = file_digest(Path(place, MANIFEST))


def _check_parts_writable(folder: Path) -> None:
    """Raise InputError where a folder below could not be removed."""
    for place, _, _ in os.walk(folder):
        if not os.access(place, os.W_OK | os.X_OK):
            raise OutputError(f"{folder}: cannot be written (Permission denied in {place}).")


def _check_no_one_lives_there(folder: Path) -> None:
    """Raise InputError for the home, the working folder, or a folder above them.

    Not even by force are they replaced.
    """
    place = os.path.realpath(folder)
    for taken, what in ((os.getcwd(), "working folder"), (os.path.expanduser("~"), "home folder")):
        if Path(os.path.realpath(taken)).is_relative_to(place):
            raise OutputError(f"{folder}: is or holds the {what}; give another folder.")


@contextmanager
def whole_folder(folder: Path, *, force: bool = False) -> Iterator[Path]:
    """Yield a temporary folder that takes the place of `folder` at the end.

    It vanishes on any exception.

    A manifest is added. A link is followed: its target is replaced.

    Raises:
        InputError: the folder cannot be written, or holds what is not orthaug's.
    """
    check_replaceable(folder, force=force)
    place = Path(os.path.realpath(folder))
    before = PARTIALS.seen.pop(str(place), file_digest(place / MANIFEST))
    made = [p for p in place.parents if not p.exists()]
    partial = None
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        partial = PARTIALS.folder(place.parent, made)
        yield partial
        write_manifest(partial)
        with PARTIALS.lock:
            check_replaceable(folder, force=force)
            if file_digest(place / MANIFEST) != before:
                PARTIALS.overtaken.append(folder)
            _put_in_place(partial, place)
            PARTIALS.mark_placed(partial, folder)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror or error}).") from None
    finally:
        if partial is not None and os.path.lexists(partial):
            PARTIALS.discard(partial)


def _put_in_place(partial: Path, place: Path) -> None:
    """Rename a folder; the former one is kept until the new one is in its place."""
    if not place.exists():
        partial.rename(place)
        return
    shelter = PARTIALS.shelter(place.parent)
    old = None
    try:
        old = place.rename(shelter / place.name)
        partial.rename(place)
    except BaseException:
        if old is not None:
            old.rename(place)
        raise
    finally:
        PARTIALS.discard(shelter)


def _nearest_ancestor(folder: Path) -> Path:
    return next(parent for parent in Path(os.path.realpath(folder)).parents if parent.exists())


def check_new_file(path: Path, *, force: bool = False) -> None:
    """Raise InputError where a file could not be written, or would replace one without force."""
    try:
        if path.is_dir() or not path.name:
            raise OutputError(f"{path}: is a folder; expected the name of a file.")
        if path.is_file() and not force:
            raise OutputError(
                f"{path}: exists; give another name, or replace it with --force (in Python: "
                "force=True)."
            )
        if path.exists():
            return
        target = Path(os.path.realpath(path))
        if target.is_symlink():
            raise OutputError(f"{path}: is a link to itself; give another name.")
        if not target.parent.is_dir():
            raise OutputError(f"{path}: cannot be written; there is no folder {path.parent}.")
        if not os.access(target.parent, os.W_OK | os.X_OK):
            raise OutputError(f"{path}: cannot be written (Permission denied in {path.parent}).")
        os.stat(target.parent / target.name)
    except FileNotFoundError:
        return
    except InputError:
        raise
    except (OSError, ValueError) as error:  # such as a NUL byte in the name
        raise OutputError(
            f"{path}: cannot be written ({getattr(error, 'strerror', None) or error})."
        ) from None


@contextmanager
def whole_file(path: Path, *, force: bool = False, result: bool = True) -> Iterator[Path]:
    """Yield a file beside `path` that replaces it at the end, and vanishes on any exception.

    A link is followed: its target is written. What is no regular file, such as a pipe, is written
    into.

    Args:
        path: the file to write.
        force: replace whatever is there.
        result: whether a command that a signal ends names the file among what it wrote; False for a
            cache.

    Raises:
        InputError: the file cannot be written, or exists already and holds something else.
    """
    check_new_file(
        path, force=True
    )  # whether it may be replaced is asked at the end: others write the same
    target = Path(os.path.realpath(path))
    partial = None
    try:
        if path.exists() and not path.is_file():
            yield path
            return
        partial = PARTIALS.file(target.parent)
        yield partial
        with PARTIALS.lock:
            _place_file(partial, target, force)
            PARTIALS.mark_placed(partial, path, result=result)
    except FileExistsError:
        text = (
            f"{path}: exists and holds something else; give another name, or replace it with "
            "--force (in Python: force=True)."
        )
        raise OutputError(text) from None
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error}).") from None
    finally:
        if partial is not None and os.path.lexists(partial):
            PARTIALS.discard(partial)


def _place_file(partial: Path, target: Path, force: bool) -> None:
    """Rename a file; without force only where no other file has appeared.

    A file of the same bytes is no other file.
    """
    if not force:
        try:
            os.link(partial, target)
        except FileExistsError:
            if target.read_bytes() != partial.read_bytes():
                raise
        except OSError:  # a file system without links
            if target.exists():
                raise FileExistsError from None
        else:
            partial.unlink()
            return
    with suppress(FileNotFoundError):
        partial.chmod(target.stat().st_mode & 0o777)
    partial.replace(target)


def write_manifest(folder: Path) -> None:
    """Write `manifest.json` about all files of a folder."""
    files = {name: file_digest(folder / name) for name in sorted(_names(folder))}
    content = {"orthaug": __version__, "files": files}
    (folder / MANIFEST).write_text(
        json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
    )


def not_ours(folder: Path) -> str | None:
    """Return a file of a folder that orthaug did not write or that was changed, in words.

    None where all may be replaced.

    Without a manifest nothing says who wrote a file, whatever its name: each counts as the user's
    own.
    """
    listed = _listed_checksums(folder / MANIFEST)
    if listed is None:
        name = next(_names(folder), None)
        return (
            None
            if name is None
            else (f"{name} and no {MANIFEST} which shows that orthaug wrote it")
        )
    names = [name for name in _names(folder) if name != MANIFEST]
    for name in names:
        if name not in listed:
            return f"{name}, which orthaug did not write"
    for name in names:
        if (folder / name).is_symlink() or file_digest(folder / name) != listed[name]:
            return f"{name}, which was changed since orthaug wrote it"
    return None


def _names(folder: Path) -> Iterator[str]:
    """Return relative names of all files below a folder, and of links to folders."""
    for place, folders, files in os.walk(folder):
        folders.sort()
        links = [name for name in folders if os.path.islink(os.path.join(place, name))]
        for name in sorted(files + links):
            if name not in _OF_THE_SYSTEM:
                yield Path(place, name).relative_to(folder).as_posix()


def file_digest(path: Path) -> str:
    """Return the sha256 of a file; empty where there is none."""
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _listed_checksums(path: Path) -> dict[str, str] | None:
    """Return the checksums of a manifest; None where there is none of orthaug's."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    if (
        not isinstance(content, dict)
        or "orthaug" not in content
        or not isinstance(content.get("files"), dict)
    ):
        return None
    return content["files"]
