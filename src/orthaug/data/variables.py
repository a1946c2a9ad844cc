"""Files of named variables: npz, MATLAB (v5 and v7.3) and HDF5. A channel is a vector or a matrix column."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.checks import Vector, nearest
from orthaug._base.errors import InputError, MissingColumnError


@dataclass(frozen=True)
class Held:
    """A variable of a file: what it is, in words, and how to read it (None where it holds no numbers)."""

    what: str
    read: Callable[[], np.ndarray] | None


def read_variables(path: Path, names: Sequence[str]) -> dict[str, Vector]:
    """The named channels: a vector (1×N or N×1), or a column of a matrix written `"U[2]"`, counted from 0.

    Raises:
        InputError: a corrupt file, a missing variable, a struct, text, complex numbers; the message lists
            what the file holds.
    """
    try:
        return _FORMATS[path.suffix.lower()](path, names)
    except InputError:
        raise
    except _CORRUPT as error:
        reason = "no archive of plain arrays" if path.suffix.lower() == ".npz" else " ".join(str(error).split())[:120]
        raise InputError(f"{path}: cannot be read as {path.suffix.lower()} ({reason}); is it cut or corrupt?") from None


_CORRUPT = (OSError, ValueError, TypeError, KeyError, IndexError, AttributeError, EOFError, zipfile.BadZipFile)


def _from_npz(path: Path, names: Sequence[str]) -> dict[str, Vector]:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        held = {}
        for name in archive.files:
            try:
                array = archive[name]
            except ValueError:  # pickled objects, which are never opened
                held[name] = Held("Python objects", None)
            else:
                held[name] = _array(array)
        return {name: _pick(path, name, held) for name in names}


def _from_mat(path: Path, names: Sequence[str]) -> dict[str, Vector]:
    import scipy.io
    import scipy.io.matlab

    try:
        shapes = scipy.io.whosmat(path)
    except NotImplementedError:  # v7.3 is HDF5
        return _from_hdf5(path, names)
    except scipy.io.matlab.MatReadError as error:
        raise InputError(f"{path}: cannot be read as .mat ({error}); is it cut or corrupt?") from None
    numeric = ("double", "single", "logical", "int", "uint")
    held = {}
    for name, shape, kind in shapes:
        if kind.startswith(numeric):
            held[name] = _lazy(shape, lambda name=name: scipy.io.loadmat(path, variable_names=[name])[name])
        else:
            held[name] = Held({"char": "text", "sparse": "a sparse matrix"}.get(kind, f"a {kind}"), None)
    return {name: _pick(path, name, held) for name in names}


def _from_hdf5(path: Path, names: Sequence[str]) -> dict[str, Vector]:
    """Datasets by their path; MATLAB's v7.3 files hold every matrix transposed."""
    try:
        import h5py
    except ImportError:
        raise InputError(f"{path}: reading HDF5 needs h5py; install orthaug[hdf5].") from None
    matlab = path.suffix.lower() == ".mat"
    held: dict[str, Held] = {}

    def note(name: str, item: Any) -> None:
        if isinstance(item, h5py.Group):
            if not name.startswith("#"):
                sparse = "MATLAB_sparse" in item.attrs
                held[name] = Held("a sparse matrix" if sparse else "a struct" if matlab else "a group", None)
        elif not name.startswith("#") and "MATLAB_sparse" not in item.parent.attrs:
            kind = item.attrs.get("MATLAB_class", b"")
            if kind in (b"char", b"cell", "char", "cell"):
                held[name] = Held("text" if kind in (b"char", "char") else "a cell", None)
            elif item.dtype.kind not in "fiubc" and item.dtype.names is None:
                held[name] = Held(f"{item.dtype} values", None)
            else:
                shape = item.shape[::-1] if matlab else item.shape
                held[name] = _lazy(shape, lambda: item[()].T if matlab else item[()])

    with h5py.File(path, "r") as file:
        file.visititems(note)
        return {name: _pick(path, name, held) for name in names}


_FORMATS: dict[str, Callable[[Path, Sequence[str]], dict[str, Vector]]] = {
    ".npz": _from_npz,
    ".mat": _from_mat,
    ".h5": _from_hdf5,
}
ENDINGS = tuple(_FORMATS)


def _array(array: np.ndarray) -> Held:
    if array.dtype.kind not in "fiubc":
        return Held("text" if array.dtype.kind in "US" else f"{array.dtype} values", None)
    return _lazy(array.shape, lambda: array)


def _lazy(shape: Sequence[int], read: Callable[[], Any]) -> Held:
    return Held("×".join(map(str, shape)) or "a scalar", read)


def _pick(path: Path, name: str, held: Mapping[str, Held]) -> Vector:
    variable, column = name, None
    if name not in held and name.endswith("]") and "[" in name:
        variable, _, index = name[:-1].rpartition("[")
        if not index.strip().isdecimal():
            raise InputError(f"{path}: '{name}': a column of a matrix is written \"{variable}[0]\", counted from 0.")
        column = int(index)
    listing = ", ".join(f"{key} ({value.what})" for key, value in held.items()) or "nothing"
    if variable not in held:
        raise MissingColumnError(
            f"{path}: no variable '{variable}'{nearest(variable, held)}; the file holds {listing}."
        )
    read = held[variable].read
    if read is None:
        raise InputError(f"{path}: '{variable}' is {held[variable].what}, no numbers; the file holds {listing}.")
    array = np.asarray(read())
    if np.iscomplexobj(array) or array.dtype.names is not None:
        raise InputError(f"{path}: '{variable}' is complex; expected real numbers. The file holds {listing}.")
    if column is not None:
        if array.ndim != 2 or column >= array.shape[1]:
            raise InputError(f"{path}: '{name}': no such column (counted from 0); the file holds {listing}.")
        array = array[:, column]
    if array.ndim == 2 and 1 in array.shape:
        array = array.ravel()
    if array.ndim != 1:
        raise InputError(
            f"{path}: '{name}' is no vector; write a column of a matrix as \"{variable}[0]\". The file holds {listing}."
        )
    return np.asarray(array, dtype=float)
