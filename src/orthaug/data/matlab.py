"""MATLAB's v5 files, every length in them checked.

SciPy's reader ends the process on some files that are corrupt.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from orthaug._base.memory import check_memory

_NUMBERS = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
_INT32, _UINT32, _MATRIX, _COMPRESSED = 5, 6, 14, 15
_CELL, _STRUCT, _OBJECT = 1, 2, 3
MOST_ELEMENTS = 1000  # of an array of structs or a cell that is looked into
_NO_NUMBERS = {
    _CELL: "a cell",
    _STRUCT: "a struct",
    _OBJECT: "an object",
    4: "text",
    5: "a sparse matrix",
    16: "a function",
    17: "an opaque object",
}
_COMPLEX_FLAG = 0x0800
# Bytes of the file's header; of a compressed variable that hold its name and shape
_HEADER, _PREFIX = (128, 4096)


@dataclass(frozen=True, eq=False)
class Variable:
    """A variable of a file, or a field of one.

    `what` says in words why it holds no numbers, "" where it does.
    """

    name: str
    what: str
    shape: tuple[int, ...]
    _order: str
    _flags: int
    _begin: int
    _body: Callable[[], memoryview]

    def numbers(self) -> np.ndarray:
        """Read the values, in the variable's shape."""
        kind, data, at = _element(body := self._body(), self._begin, self._order)
        values = self._values(kind, data)
        if self._flags & _COMPLEX_FLAG:
            kind, data, _ = _element(body, at, self._order)
            values = values + 1j * self._values(kind, data)
        return values

    def text(self) -> str:
        """Read the characters of a text."""
        kind, data, _ = _element(self._body(), self._begin, self._order)
        utf_16 = "utf-16-le" if self._order == "<" else "utf-16-be"
        return bytes(data).decode({4: utf_16, 17: utf_16, 16: "utf-8"}.get(kind, "latin-1"))

    def _values(self, kind: int, data: memoryview) -> np.ndarray:
        values = np.frombuffer(data, self._order + _NUMBERS[kind])
        if len(values) != math.prod(self.shape):
            raise ValueError(
                f"'{self.name}' has {len(values)} numbers; declared are {math.prod(self.shape)}"
            )
        return values.reshape(self.shape, order="F")

    def parts(self) -> Iterator[Variable]:
        """Yield the contents of a struct, an object or a cell, by path; nothing of anything else.

        Elements of arrays are counted from 0: `runs[1].u`, `c[0]`. The only element of a cell has
        the cell's own name.
        """
        kind, count = self._flags & 0xFF, math.prod(self.shape)
        if kind not in (_CELL, _STRUCT, _OBJECT) or not 0 < count <= MOST_ELEMENTS:
            return
        body, at, names = self._body(), self._begin, [""]
        if kind == _OBJECT:
            at = _element(body, at, self._order)[2]  # the name of its class
        if kind != _CELL:
            _, length, at = _element(body, at, self._order)
            _, packed, at = _element(body, at, self._order)
            (size,) = struct.unpack(self._order + "i", length)
            if size < 1:
                raise ValueError("field names have no length")
            fields = (bytes(packed[begin : begin + size]) for begin in range(0, len(packed), size))
            names = ["." + field.split(b"\0")[0].decode("latin-1") for field in fields]
        for i in range(count):
            for name in names:
                type_, data, at = _element(body, at, self._order)
                if type_ != _MATRIX:
                    raise ValueError("the content of a struct or cell is not a matrix")
                if data:
                    path = f"{self.name}{f'[{i}]' if count > 1 else ''}{name}"
                    yield _variable(data, self._order, lambda data=data: data, path)


def read_mat5(content: bytes, path: object) -> dict[str, Variable]:
    """Return the variables of a v5 file by name; their numbers are read when they are asked for.

    Raises:
        ValueError, KeyError, struct.error, zlib.error: what is no such file, or ends too early.
    """
    order = {b"IM": "<", b"MI": ">"}[content[126:128]]
    whole, at, found = memoryview(content), _HEADER, {}
    while at < len(whole):
        kind, data, at = _element(whole, at, order)
        if kind == _COMPRESSED:
            kind, data, body = _inflate(data, order, path)
        else:
            body = lambda data=data: data  # noqa: E731
        if kind != _MATRIX:
            raise ValueError(f"expected a matrix, found an element of type {kind}")
        variable = _variable(data, order, body)
        if variable.name:  # what MATLAB keeps for itself has none
            found[variable.name] = variable
    return found


def _element(data: memoryview, at: int, order: str) -> tuple[int, memoryview, int]:
    """Return type and content of the element at a place, and the place behind it."""
    kind, size = struct.unpack_from(order + "II", data, at)
    if kind >> 16:  # a small one: type and size share a word, the data have the other
        kind, size, begin, end = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        if size > 4:
            raise ValueError(f"a small element of {size} bytes")
    else:
        begin = at + 8
        end = begin + size if kind == _COMPRESSED else begin + (size + 7) // 8 * 8
    if begin + size > len(data):
        raise ValueError(f"ends within an element of {size} bytes")
    return kind, data[begin : begin + size], end


def _inflate(
    data: memoryview, order: str, path: object
) -> tuple[int, memoryview, Callable[[], memoryview]]:
    """Return type, first bytes, and a function for all bytes of a compressed element."""
    first = zlib.decompressobj().decompress(data, _PREFIX)
    kind, size = struct.unpack_from(order + "II", first)

    def body() -> memoryview:
        check_memory(3 * size, f"{path}: a compressed variable")
        inflate = zlib.decompressobj()
        inflated = inflate.decompress(data, size + 16)
        if (
            len(inflated) < size + 8 or not inflate.eof
        ):  # at the end of the stream its checksum was compared
            raise ValueError("a compressed variable is cut")
        return memoryview(inflated)[8 : size + 8]

    return kind, memoryview(first)[8:], body


def _variable(
    data: memoryview, order: str, body: Callable[[], memoryview], name: str | None = None
) -> Variable:
    """Return a variable by its header; `body` gives all of its bytes."""
    kind, flags, at = _element(data, 0, order)
    if kind != _UINT32 or len(flags) != 8:
        raise ValueError("a variable has no flags")
    (word,) = struct.unpack_from(order + "I", flags)
    shape: tuple[int, ...] = ()
    if word & 0xFF != 17:
        kind, sizes, at = _element(data, at, order)
        shape = tuple(np.frombuffer(sizes, order + "i4").tolist())
        if kind != _INT32 or min(shape, default=-1) < 0:
            raise ValueError(f"a variable has the shape {shape}")
    kind, own, at = _element(data, at, order)
    what = "" if 6 <= word & 0xFF <= 15 else _NO_NUMBERS[word & 0xFF]
    return Variable(name or bytes(own).decode("latin-1"), what, shape, order, word, at, body)
