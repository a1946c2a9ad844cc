"""Files of named variables: npz, MATLAB (v5 and v7.3) and HDF5.

A channel is a vector or a matrix column.
"""

from __future__ import annotations

import io
import math
import re
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.checks import Vector, nearest
from orthaug._base.errors import InputError, MissingColumnError
from orthaug._base.lines import first_words
from orthaug._base.memory import check_memory, in_words
from orthaug.data.matlab import MOST_ELEMENTS, Variable, read_mat5

_NAMED = 30  # variables that a message lists
_HDF5, _USERBLOCK = b"\x89HDF\r\n", 4096  # how such a file begins, and before which byte it does
_DIGITS = 10  # of an index at most
# Names, a choice of single numbers, or all names
Wanted = Sequence[str] | Callable[[str], bool] | None
_MOST_HELD, _DEEPEST = 10_000, 8  # variables that are noted, and references one behind the other
_LABELS = {
    "Data": "Name",
    "values": "label",
}  # fields of dSPACE and of Simulink: a signal, and what it is called
_LONGEST_NAME = 200  # characters of such a name at most
_ROOT = re.compile(r"[./\[]")  # what follows the name of a variable in a path
# As MATLAB writes it
_ELEMENT = re.compile(r"[({]\s*(?::\s*,\s*)?([1-9]\d{0,8})\s*(,\s*:\s*)?[)}]")


@dataclass(frozen=True)
class FileVariable:
    """A variable of a file: its description, and a function that reads it.

    The function is None where the variable holds no numbers.

    `text` reads a text. `named` is the name that the file itself gives to the signal, beside its
    path.
    """

    what: str
    read: Callable[[], np.ndarray] | None
    shape: tuple[int, ...] = ()
    text: Callable[[], str] | None = None
    named: str = ""


def read_variables(path: Path, names: Sequence[str]) -> dict[str, Vector]:
    """Return the named channels: a vector (1×N or N×1), or a line of a matrix, counted from 0.

    A column is written `"U[2]"`, a row `"U[2,:]"`; what is in MATLAB's structs or in groups of HDF5
    `"data.u"`.

    Raises:
        InputError: a missing variable, a struct, text, complex numbers, a corrupt file; the message
            lists what the file holds.
    """
    with foreign(path):
        return _FORMATS[path.suffix.lower()](path, names)


def variable_names(path: Path) -> list[str]:
    """Return the names of a file's channels: vectors, and every line along a narrow matrix.

    Raises:
        InputError: a corrupt file.
    """
    with foreign(path):
        return list(_FORMATS[path.suffix.lower()](path, None))


def scalars(path: Path, wanted: Callable[[str], bool]) -> dict[str, float]:
    """Return the wanted single numbers that a file holds beside its channels, by name.

    Raises:
        InputError: a corrupt file.
    """
    with foreign(path):
        return {
            name: float(value[0])
            for name, value in _FORMATS[path.suffix.lower()](path, wanted).items()
        }


@contextmanager
def foreign(path: Path) -> Iterator[None]:
    """Turn errors of libraries that read a file into InputError, and suppress their warnings."""
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except MemoryError:
        raise InputError(f"{path}: reading the file needs more memory than is available.") from None
    except Exception as error:  # there is no list of what they raise for corrupt files
        reason = "not an archive of plain arrays" if path.suffix.lower() == ".npz" else short(error)
        raise InputError(
            f"{path}: cannot be read as {path.suffix.lower()} ({reason}); is it cut or corrupt?"
        ) from None


def _from_npz(path: Path, names: Wanted) -> dict[str, Vector]:
    with zipfile.ZipFile(path) as archive:
        held: dict[str, FileVariable] = {}
        for info in archive.infolist():
            try:
                held[info.filename.removesuffix(".npy")] = _member(path, archive, info)
            except Exception as error:  # one that cannot be read matters only where it is asked for
                held[info.filename.removesuffix(".npy")] = FileVariable(
                    f"unreadable: {short(error)}", None
                )
        return _take_channels(path, names, held)


_LONGEST_HEAD = 2**16  # bytes of a member that are unpacked to know what it is
# Bytes of an array that may shrink as it likes, and by how much a larger one may
_LARGE, _DENSEST = (2**28, 300)


def _member(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> FileVariable:
    """Return an array of an archive by its header; Python objects are never opened."""
    with archive.open(info) as member:
        # A header may declare a length of its own, in gigabytes
        head = io.BytesIO(member.read(_LONGEST_HEAD))
    version = np.lib.format.read_magic(head)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }[version]
    shape, _, kind = read(head)
    begin = head.tell()
    if kind.hasobject:
        return FileVariable("Python objects", None)
    if kind.kind not in "fiubc":
        return FileVariable("text" if kind.kind in "US" else f"{kind} values", None)
    size = math.prod(shape) * kind.itemsize
    if size != info.file_size - begin:
        return FileVariable(f"cut: {in_words(info.file_size - begin)} of {in_words(size)}", None)
    dense = size > _LARGE and size > _DENSEST * info.compress_size

    def load() -> np.ndarray:
        if dense:  # by its header: nothing of it is unpacked
            raise InputError(
                f"{path}: '{info.filename.removesuffix('.npy')}' is {in_words(size)} in "
                f"{in_words(info.compress_size)} of the file, denser than measurements are. "
                "Store it uncompressed (`numpy.savez`) if it is true."
            )
        with archive.open(info) as member:
            return np.lib.format.read_array(member, allow_pickle=False)

    return _lazy(path, shape, kind.itemsize, load)


def _from_mat(path: Path, names: Wanted) -> dict[str, Vector]:
    content = path.read_bytes()
    if _HDF5 in content[:_USERBLOCK] or content[124:126] in (b"\x00\x02", b"\x02\x00"):  # v7.3
        return _from_hdf5(path, names)
    variables = read_mat5(content, path)
    asked = () if names is None or callable(names) else names
    roots = {_ROOT.split(name.lstrip("/"))[0] for name in asked}
    held: dict[str, FileVariable] = {}
    for name, variable in variables.items():
        held |= _variable_tree(
            path, variable, deep=not roots or name in roots or not roots <= variables.keys()
        )
    return _take_channels(path, names, _with_names(held))


def _variable_tree(path: Path, variable: Variable, *, deep: bool) -> dict[str, FileVariable]:
    """Return a variable and, if wanted, its contents, by their paths."""
    if not variable.what:
        return {variable.name: _lazy(path, variable.shape, 8, variable.numbers)}
    text = variable.text if variable.what == "text" else None
    held = {variable.name: FileVariable(variable.what, None, variable.shape, text)}
    for part in variable.parts() if deep else ():
        held |= _variable_tree(path, part, deep=True)
    return held


def _from_hdf5(path: Path, names: Wanted) -> dict[str, Vector]:
    """Return datasets by their path; MATLAB's v7.3 files hold every matrix transposed."""
    try:
        import h5py
    except ImportError:
        raise InputError(f"{path}: reading HDF5 needs h5py; install orthaug[hdf5].") from None
    with h5py.File(path, "r") as file:
        _ = [
            name in file for name in (() if names is None or callable(names) else names)
        ]  # complains of broken tables on which a visit never ends
        found = _Datasets(path, file, path.suffix.lower() == ".mat", {})
        file.visititems(found.add)
        return _take_channels(path, names, _with_names(found.held) if found.matlab else found.held)


@dataclass(frozen=True, eq=False)
class _Datasets:
    """Contents of an HDF5 file, by path.

    MATLAB keeps cells and arrays of structs as references to `#refs#`.
    """

    path: Path
    file: Any
    matlab: bool
    held: dict[str, FileVariable]

    def add(self, name: str, item: object) -> None:
        """Note the contents of a path of groups; `#refs#` is reached by its references only."""
        if not name.startswith("#"):
            self._note(name, item, 0)

    def _note(self, name: str, item: Any, depth: int) -> None:
        import h5py

        key = name.replace("/", ".") if self.matlab else name
        kind = _word(item.attrs.get("MATLAB_class", b""))
        if isinstance(item, h5py.Group):
            sparse = "MATLAB_sparse" in item.attrs
            self.held[key] = FileVariable(
                "a sparse matrix" if sparse else "a struct" if self.matlab else "a group", None
            )
            for child in item if depth else ():  # of what a reference points at; others are visited
                self._note(f"{name}/{child}", item[child], depth + 1)
        elif "MATLAB_sparse" in item.parent.attrs:
            pass
        elif item.shape is None or "MATLAB_empty" in item.attrs:
            self.held[key] = FileVariable("empty", None)
        elif self.matlab and (kind == "cell" or h5py.check_ref_dtype(item.dtype) is h5py.Reference):
            self._note_elements(name, item, kind == "cell", depth)
        elif kind == "char":
            text = lambda: "".join(map(chr, item[()].ravel().tolist()))  # noqa: E731
            self.held[key] = FileVariable("text", None, item.shape[::-1], text)
        elif item.dtype.kind not in "fiubc" and item.dtype.names is None:
            self.held[key] = FileVariable(f"{item.dtype} values", None)
        elif item.dtype.kind in "fiu" and item.id.get_type() != h5py.h5t.py_create(item.dtype):
            self.held[key] = FileVariable("numbers in an unknown format", None)
        else:
            shape = item.shape[::-1] if self.matlab else item.shape
            load = lambda: item[()].T if self.matlab else item[()]  # noqa: E731
            self.held[key] = _lazy(self.path, shape, item.dtype.itemsize, load)

    def _note_elements(self, name: str, item: Any, cell: bool, depth: int) -> None:
        """Note the elements that a cell or a field of an array of structs refers to.

        Their names are `c[0]` and `runs[0].u`.
        """
        count = math.prod(item.shape)
        parent, _, field = name.rpartition("/")
        if cell:
            self.held[name.replace("/", ".")] = FileVariable("a cell", None)
        if not 0 < count <= MOST_ELEMENTS or depth >= _DEEPEST:
            return
        for i, reference in enumerate(item[()].flat):
            place = f"{name}[{i}]" if cell else f"{parent}[{i}]/{field}"
            if reference and len(self.held) < _MOST_HELD:
                self._note(name if cell and count == 1 else place, self.file[reference], depth + 1)


def _word(text: object) -> str:
    return text.decode("latin-1") if isinstance(text, bytes) else str(text)


def _with_names(held: Mapping[str, FileVariable]) -> dict[str, FileVariable]:
    """Add the signals that a file names in a field beside their values.

    Each gets its name unless another has it.
    """
    named: dict[str, str] = {}
    for path, variable in held.items():
        parent, _, field = path.rpartition(".")
        label = held.get(f"{parent}.{_LABELS.get(field)}")
        if not (variable.read and label and label.text and max(variable.shape, default=0) > 1):
            continue
        if math.prod(label.shape) <= _LONGEST_NAME and label.text().strip():
            named[path] = label.text().strip()
    often, found = Counter(named.values()), {}
    for path, variable in held.items():
        name = named.get(path, "")
        if name and often[name] == 1 and name not in held:
            found[name] = variable
            variable = replace(variable, named=name)
        found[path] = variable
    return found


_FORMATS: dict[str, Callable[[Path, Wanted], dict[str, Vector]]] = {
    ".npz": _from_npz,
    ".mat": _from_mat,
    ".h5": _from_hdf5,
}
ENDINGS = tuple(_FORMATS)


def short(error: Exception) -> str:
    """Return the message of a library on one line."""
    if isinstance(error, LookupError) or any(isinstance(part, bytes) for part in error.args):
        return "unknown bytes"
    return " ".join(str(error).split())[:120] or type(error).__name__


def _lazy(
    path: Path, shape: Sequence[int], itemsize: int, read: Callable[[], object]
) -> FileVariable:
    what = "×".join(map(str, shape)) or "a scalar"

    def read_checked() -> Any:
        check_memory(2 * math.prod(shape) * max(itemsize, 8), f"{path}: an array of {what} numbers")
        return read()

    return FileVariable(what, read_checked, tuple(shape))


def _take_channels(
    path: Path, names: Wanted, held: Mapping[str, FileVariable]
) -> dict[str, Vector]:
    """Return the named channels.

    Without names an empty one for each that could be named; or the single numbers wanted.
    """
    if callable(names):
        single = {
            name: one
            for name, one in held.items()
            if one.read and math.prod(one.shape) == 1 and names(name)
        }
        read = {name: np.asarray(one.read()).ravel() for name, one in single.items() if one.read}
        return {
            name: value.astype(float) for name, value in read.items() if value.dtype.kind in "fiu"
        }
    if names is not None:
        return {name: _pick(path, name, held) for name in names}
    lines = {}
    for name, variable in held.items():
        sides = (
            [n for n in variable.shape if n != 1] if variable.read and not variable.named else []
        )
        if len(variable.shape) <= 2 and len(sides) == 1:
            lines[name] = np.empty(0)
        elif len(sides) == len(variable.shape) == 2 and min(sides) <= _NAMED:
            tall = sides[0] >= sides[1]
            lines |= {
                f"{name}[{i}]" if tall else f"{name}[{i},:]": np.empty(0) for i in range(min(sides))
            }
    return lines


def _pick(path: Path, name: str, held: Mapping[str, FileVariable]) -> Vector:
    name = _known_as(name, held)
    variable, axis, index = (name, 0, 0) if name in held else _line(path, name)
    described = [f"{key} ({value.what})" for key, value in held.items()]
    listing = first_words(described, _NAMED) or "nothing"
    if variable not in held:
        ours = _ELEMENT.sub(lambda m: f"[{int(m[1]) - 1}{',:' if m[2] else ''}]", name)
        hint = f'; elements are counted from 0 here, "{ours}"' if ours != name else ""
        raise MissingColumnError(
            f"{path}: no variable '{variable}'{hint or nearest(variable, held)}; the file "
            f"holds {listing}."
        )
    read = held[variable].read
    if read is None:
        hint = (
            f' Name a field of it, such as "{variable}.u".'
            if held[variable].what.startswith("a struct")
            else ""
        )
        raise InputError(
            f"{path}: '{variable}' is {held[variable].what}, no numbers; the file holds "
            f"{listing}.{hint}"
        )
    array = np.asarray(read())
    if np.iscomplexobj(array) or array.dtype.names is not None:
        raise InputError(
            f"{path}: '{variable}' is complex; expected real numbers. The file holds {listing}."
        )
    if variable != name:
        if array.ndim != 2 or index >= array.shape[axis]:
            kind = "column" if axis else "row"
            raise InputError(
                f"{path}: '{name}': no such {kind} (counted from 0); the file holds {listing}."
            )
        array = array.take(index, axis=axis)
    if array.ndim == 2 and 1 in array.shape:
        array = array.ravel()
    if array.ndim != 1:
        raise InputError(
            f"{path}: '{name}' is no vector; write a column of a matrix as "
            f'"{variable}[0]", a row as '
            f'"{variable}[0,:]". The file holds {listing}.'
        )
    return np.asarray(array, dtype=float)


def _known_as(name: str, held: Mapping[str, FileVariable]) -> str:
    """Return the name as the file has it: paths may be written with points or slashes."""
    bare = name.lstrip("/")
    for one in (name, bare, bare.replace("/", "."), bare.replace(".", "/")):
        if one in held or (one.endswith("]") and one.rpartition("[")[0] in held):
            return one
    return name


def _line(path: Path, name: str) -> tuple[str, int, int]:
    """Return variable, axis and index of a column `U[2]` or a row `U[2,:]`."""
    if not (name.endswith("]") and "[" in name):
        return name, 0, 0
    variable, _, place = name[:-1].rpartition("[")
    first, comma, second = (part.strip() for part in place.partition(","))
    axis = 0 if comma and second == ":" else 1
    index = second if comma and first == ":" else first
    if not (index.isascii() and index.isdecimal() and len(index) < _DIGITS) or (
        comma and ":" not in (first, second)
    ):
        raise InputError(
            f"{path}: '{name}': a column of a matrix is written "
            f'"{variable}[0]", a row "{variable}[0,:]", '
            "counted from 0."
        )
    return variable, axis, int(index)
