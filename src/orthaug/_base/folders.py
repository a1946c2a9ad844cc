"""Folders and files that appear whole or not at all: written beside their place, then renamed."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from orthaug._base.errors import InputError


def check_replaceable(folder: Path, is_ours: Callable[[Path], bool]) -> None:
    """Raise InputError unless `folder` is absent, empty or ours, and stands where one may write."""
    try:
        there = folder.exists() or folder.is_symlink()
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}).") from None
    if there:
        if not folder.is_dir():
            raise InputError(f"{folder}: not a folder; give another name.")
        if any(folder.iterdir()) and not is_ours(folder):
            raise InputError(
                f"{folder}: holds something that is not an orthaug result; give another folder, or empty it."
            )
    ancestor = _nearest_ancestor(folder)
    if not ancestor.is_dir():
        raise InputError(f"{folder}: cannot be written; {ancestor} is not a folder.")
    try:
        Path(tempfile.mkdtemp(prefix=".orthaug-", dir=ancestor)).rmdir()
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror} in {ancestor}).") from None


@contextmanager
def whole_folder(folder: Path, is_ours: Callable[[Path], bool]) -> Iterator[Path]:
    """A temporary folder that takes the place of `folder` at the end, and vanishes on any exception."""
    check_replaceable(folder, is_ours)
    folder = folder.absolute()
    created = [p for p in folder.parents if not p.exists()]
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}-partial-", dir=folder.parent))
    try:
        partial.chmod(0o755)
        yield partial
        _put_in_place(partial, folder)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        for parent in created:
            if parent.is_dir() and not any(parent.iterdir()):
                parent.rmdir()
        raise


def _put_in_place(partial: Path, folder: Path) -> None:
    """Rename. The folder that was there is kept until the new one stands."""
    if not folder.exists():
        partial.rename(folder)
        return
    shelter = Path(tempfile.mkdtemp(prefix=f".{folder.name}-old-", dir=folder.parent))
    old = folder.rename(shelter / folder.name)
    try:
        partial.rename(folder)
    except BaseException:
        old.rename(folder)
        raise
    finally:
        shutil.rmtree(shelter, ignore_errors=True)


def _nearest_ancestor(folder: Path) -> Path:
    return next(parent for parent in folder.absolute().parents if parent.exists())


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A file beside `path` that takes its place at the end, and vanishes on any exception.

    Raises:
        InputError: the file cannot be written.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        yield partial
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}).") from None
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
