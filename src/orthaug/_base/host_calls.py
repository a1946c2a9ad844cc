"""Functions of the host in compiled programs: calls by XLA's foreign function interface.

XLA passes a call frame of C, which `ctypes` reads: a call takes a few microseconds, where
`jax.pure_callback` takes a hundred, and programs with such calls are kept on disk. Where the
interface is another one, or the device no CPU, the call is a `pure_callback`.
"""

from __future__ import annotations

import _thread
from collections.abc import Sequence
from ctypes import (
    CFUNCTYPE,
    POINTER,
    Structure,
    c_char_p,
    c_double,
    c_int,
    c_int64,
    c_size_t,
    c_uint,
    c_void_p,
    cast,
    pointer,
    sizeof,
)
from functools import cache
from math import prod
from typing import Any, Protocol, runtime_checkable

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import Array, jax, jnp

_TARGET = "orthaug_host_call"
_METADATA = 1  # the extension by which XLA asks for the version of a handler
_INTERNAL = 13  # XLA's code of an error
_WORTH_COMPARING = 8  # rows: to find repeated ones among fewer takes longer than to compute them
_FUNCTIONS: list[HostFunction] = []


@runtime_checkable
class HostFunction(Protocol):
    """A function of rows; hashable, and equal where it is the same."""

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """The shape of each result at one row."""
        ...

    def __call__(self, rows: Matrix) -> tuple[Any, ...]:
        """Return the results at rows (m, n), each (m, …)."""
        ...

    def write_one(self, row: int, results: Sequence[int]) -> bool:
        """Write the results at the row at an address to addresses; False to be called instead."""
        ...


def call_on_host(function: HostFunction, row: Array) -> tuple[Array, ...]:
    """Return the results of a function at a row (n,) on JAX arrays, under `vmap` at all rows.

    It has no derivatives; give them by `jax.custom_jvp`.
    """
    shaped = tuple(jax.ShapeDtypeStruct(shape, jnp.float64) for shape in function.shapes)
    if jax.default_backend() == "cpu" and _register():
        number = np.int64(_number_of(function))
        return tuple(jax.ffi.ffi_call(_TARGET, shaped, vmap_method="expand_dims")(number, row))

    def call(rows: Any) -> tuple[Any, ...]:
        rows = np.asarray(rows, dtype=float)
        found = _at_different_rows(function, rows.reshape(-1, rows.shape[-1]))
        return tuple(part.reshape(*rows.shape[:-1], *part.shape[1:]) for part in found)

    return jax.pure_callback(call, shaped, row, vmap_method="expand_dims")


@cache
def _number_of(function: HostFunction) -> int:
    """Return the number by which programs of this process name a function."""
    _FUNCTIONS.append(function)
    return len(_FUNCTIONS) - 1


def _at_different_rows(function: HostFunction, rows: Matrix) -> tuple[np.ndarray, ...]:
    """Return the results at rows; those that repeat the one before are computed once.

    Compiled programs pad theirs so.
    """
    if len(rows) < _WORTH_COMPARING:
        return function(rows)
    fresh = np.ones(len(rows), dtype=bool)
    fresh[1:] = (rows[1:] != rows[:-1]).any(axis=1)
    if fresh.all():
        return function(rows)
    again = np.cumsum(fresh) - 1
    return tuple(part[again] for part in function(rows[fresh]))


class _Version(Structure):
    """`XLA_FFI_Api_Version`."""

    _fields_ = (("size", c_size_t), ("more", c_void_p), ("major", c_int), ("minor", c_int))


class _Metadata(Structure):
    """`XLA_FFI_Metadata`."""

    _fields_ = (("size", c_size_t), ("version", _Version), ("traits", c_uint))


class _Extension(Structure):
    """`XLA_FFI_Metadata_Extension`, which begins as any extension does."""

    _fields_ = (
        ("size", c_size_t),
        ("kind", c_int),
        ("following", c_void_p),
        ("metadata", POINTER(_Metadata)),
    )


class _Buffer(Structure):
    """`XLA_FFI_Buffer`."""

    _fields_ = (
        ("size", c_size_t),
        ("more", c_void_p),
        ("kind", c_int),
        ("data", c_void_p),
        ("rank", c_int64),
        ("dims", POINTER(c_int64)),
    )


class _Buffers(Structure):
    """`XLA_FFI_Args`, or `XLA_FFI_Rets`."""

    _fields_ = (
        ("size", c_size_t),
        ("more", c_void_p),
        ("count", c_int64),
        ("kinds", c_void_p),
        ("each", POINTER(POINTER(_Buffer))),
    )


class _ErrorArguments(Structure):
    """`XLA_FFI_Error_Create_Args`."""

    _fields_ = (("size", c_size_t), ("more", c_void_p), ("message", c_char_p), ("code", c_int))


_CreateError = CFUNCTYPE(c_void_p, POINTER(_ErrorArguments))


class _Api(Structure):
    """The first entries of `XLA_FFI_Api`."""

    _fields_ = (
        ("size", c_size_t),
        ("more", c_void_p),
        ("version", _Version),
        ("internal", c_void_p),
        ("create_error", _CreateError),
    )


class _Frame(Structure):
    """The first entries of `XLA_FFI_CallFrame`."""

    _fields_ = (
        ("size", c_size_t),
        ("extension", POINTER(_Extension)),
        ("api", POINTER(_Api)),
        ("context", c_void_p),
        ("stage", c_int),
        ("arguments", _Buffers),
        ("results", _Buffers),
    )


_Handler = CFUNCTYPE(c_void_p, POINTER(_Frame))


@cache
def _register() -> bool:
    """Make the handler known to XLA, once in a process; False where its interface is another."""
    try:
        address = cast(_HANDLER, c_void_p).value
        jax.ffi.register_ffi_target(_TARGET, jax.ffi.pycapsule(address), platform="cpu")
    except Exception:  # whatever a version of JAX without this interface raises
        return False
    return True


def _answer(frame: Any) -> int | None:
    """Compute the results of a call frame; return the address of an error, or None."""
    own = frame.contents
    if own.extension and own.extension.contents.kind == _METADATA:
        asked = own.extension.contents.metadata.contents
        known = own.api.contents.version
        asked.version.major, asked.version.minor, asked.traits = known.major, known.minor, 0
        return None
    try:
        number, rows = (own.arguments.each[i].contents for i in range(2))
        function = _FUNCTIONS[c_int64.from_address(number.data).value]
        results = [own.results.each[i].contents for i in range(own.results.count)]
        dims = rows.dims[: rows.rank]
        count = prod(dims[:-1])
        if count == 1 and function.write_one(rows.data, [each.data for each in results]):
            return None
        points = _numbers_at(rows.data, count * dims[-1]).reshape(count, dims[-1])
        for into, part in zip(results, _at_different_rows(function, points), strict=True):
            _numbers_at(into.data, part.size)[:] = part.ravel()
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            _thread.interrupt_main()  # an exception cannot pass through XLA
        words = f"{type(error).__name__}: {error}".encode()
        made = _ErrorArguments(sizeof(_ErrorArguments), None, words, _INTERNAL)
        return own.api.contents.create_error(pointer(made))
    return None


def _numbers_at(address: int, count: int) -> Vector:
    """Return the numbers at an address, without a copy."""
    if not count:
        return np.zeros(0)
    there: Any = (c_double * count).from_address(address)
    return np.frombuffer(there)


_HANDLER: Any = _Handler(_answer)
