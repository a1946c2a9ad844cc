"""Traced programs, kept on disk: what JAX makes of a function before it compiles it.

JAX keeps what it compiled, and finds it by what it traced. To trace and lower a hundred functions
is half of the processor's time of a usual fit. What comes of it depends on the function, its static
arguments, the shapes and types of the others, this package's code, and JAX. Where all of these are
known by content, the program is exported by `jax.export`, and the next process reads it. Where one
is not, as a function of the user's, it is traced as ever.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import hashlib
import inspect
import json
import struct
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from types import BuiltinFunctionType, FunctionType
from typing import Any, NamedTuple

_CODE_OF = ("orthaug", "jax", "jaxlib", "numpy", "builtins", "math", "operator")
# Packages whose version or content is part of every digest
_SETTINGS = (  # of JAX, that change what it traces
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
)
_FOR_TRACING = ("jax_debug_nans", "jax_debug_infs", "jax_disable_jit", "jax_check_tracer_leaks")


class NotKept(Exception):
    """A value whose content no digest can represent."""


class Shape(NamedTuple):
    """Properties of an argument that a program depends on."""

    shape: tuple[int, ...]
    kind: str
    weak: bool


def digest_of(value: Any) -> bytes:
    """Return a digest of a value by its content, the same in each process.

    Raises:
        NotKept: a value whose content is not known, as of a function within a function.
    """
    found = hashlib.sha256()
    _feed(found.update, value)
    return found.digest()


def _feed(add: Callable[[bytes], Any], value: Any) -> None:
    """Add a value's type and content to a digest."""
    kind = type(value)
    add(f"<{kind.__module__}.{kind.__qualname__}>".encode())
    if isinstance(value, enum.Enum):
        add(value.name.encode())
    elif value is None or isinstance(value, bool | int | str | complex | bytes):
        add(repr(value).encode())
    elif isinstance(value, float):
        add(struct.pack("<d", value))
    elif isinstance(value, tuple | list | Mapping):
        add(str(len(value)).encode())
        for one in value.items() if isinstance(value, Mapping) else value:
            _feed(add, one)
    elif isinstance(value, frozenset | set):
        add(b"".join(sorted(map(digest_of, value))))
    elif isinstance(value, type | FunctionType | BuiltinFunctionType):
        add(_name_of(value).encode())
    elif isinstance(value, functools.partial):
        _feed(add, (value.func, value.args, value.keywords))
    elif inspect.ismethod(value):
        _feed(add, (value.__func__, value.__self__))
    elif kind.__module__.startswith("jaxlib") and kind.__name__ == "PyTreeDef":
        add(str(value).encode())
    elif hasattr(value, "dtype") and hasattr(value, "tobytes"):
        add(f"{value.dtype}{value.shape}".encode() + value.tobytes())
    elif dataclasses.is_dataclass(value) and kind.__module__.startswith("orthaug."):
        if hasattr(value, "files"):  # physics of a file, which may change
            raise NotKept(_name_of(kind))
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        computation = getattr(value, "computation", None)
        if computation is not None:  # the rest does not count, but must be known all the same
            digest_of(fields)
            fields = {"computation": computation}
        for name, one in fields.items():
            add(name.encode())
            _feed(add, one)
    else:
        raise NotKept(_name_of(kind))


def _name_of(value: Any) -> str:
    """Return module and name of a function or class.

    Raises:
        NotKept: code that is not known, or that has no name.
    """
    module = getattr(value, "__module__", None) or "builtins"
    name = getattr(value, "__qualname__", "<")
    if module.split(".")[0] not in _CODE_OF or "<" in name:
        raise NotKept(f"{module}.{name}")
    return f"{module}:{name}"


@functools.cache
def _code() -> bytes:
    """Return a digest of this package's code, and of JAX and its settings."""
    import jax
    import numpy as np

    found = hashlib.sha256()
    root = Path(__file__).resolve().parents[1]
    for path in sorted(root.rglob("*.py")):
        found.update(str(path.relative_to(root)).encode() + b"\0")
        found.update(hashlib.sha256(path.read_bytes()).digest())
    settings = [(name, str(getattr(jax.config, name, None))) for name in _SETTINGS]
    found.update(repr((jax.__version__, version("jaxlib"), np.__version__, settings)).encode())
    return found.digest()


# ---------------------------------------------------------------- results


def described(value: Any) -> Any:
    """Return the containers of a program's result as JSON, 0 for each array.

    Raises:
        NotKept: a container that is not known.
    """
    kind = type(value)
    if value is None:
        return None
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return {"named": _name_of(kind), "parts": [described(one) for one in value]}
    if kind in (tuple, list):
        return {kind.__name__: [described(one) for one in value]}
    if hasattr(value, "dtype"):
        return 0
    raise NotKept(_name_of(kind))


def rebuilt(description: Any) -> Any:
    """Return the containers that `described` describes.

    Raises:
        NotKept: a name that is no named tuple of this package.
    """
    if not isinstance(description, dict):
        return description
    if "named" in description:
        module, _, name = description["named"].partition(":")
        kind: Any = sys.modules.get(module) if module.startswith("orthaug.") else None
        for part in name.split("."):
            kind = getattr(kind, part, None)
        if not (isinstance(kind, type) and issubclass(kind, tuple)):
            raise NotKept(description["named"])
        return kind(*map(rebuilt, description["parts"]))
    ((kind_name, parts),) = description.items()
    return {"tuple": tuple, "list": list}[kind_name](map(rebuilt, parts))


# ---------------------------------------------------------------- programs


class Program(NamedTuple):
    """A compiled function of the arrays of its arguments, and the tree of its result."""

    run: Callable[..., Any]
    tree: Any

    def __call__(self, arrays: Sequence[Any]) -> Any:
        return self.tree.unflatten(self.run(*arrays))


class KeptPrograms:
    """Programs of functions by content, in a cache with `get` and `put` of bytes."""

    def __init__(self, cache: Any) -> None:
        self._cache = cache
        self._known: dict[Any, Program | None] = {}
        self._making: dict[Any, threading.RLock] = {}
        self._entering = threading.Lock()

    def clear(self) -> None:
        """Let the programs in memory go."""
        self._known.clear()

    def call(
        self, function: Callable[..., Any], call: Call, effort: Mapping[str, Any] | None
    ) -> Any:
        """Return a function's result for a call; `NotImplemented` where it cannot be kept.

        Args:
            effort: options of the compiler.
        """
        key = (function, call.key, effort is None)
        known = key in self._known
        program = self._known[key] if known else self._make(key, function, call, effort)
        return NotImplemented if program is None else program(call.arrays)

    def _make(
        self,
        key: Any,
        function: Callable[..., Any],
        call: Call,
        effort: Mapping[str, Any] | None,
    ) -> Program | None:
        """Return the program of a call, made once: runs in threads ask for it together."""
        with self._entering:
            making = self._making.setdefault(key, threading.RLock())
        with making:
            if key in self._known:
                return self._known[key]
            try:
                self._known[key] = self._program(function, call, effort)
            except Exception:  # what JAX cannot export, and how it says so, changes by version
                self._known[key] = None
            return self._known[key]

    def _program(
        self, function: Callable[..., Any], call: Call, effort: Mapping[str, Any] | None
    ) -> Program:
        import jax
        from jax import export

        if any(getattr(jax.config, name, False) for name in _FOR_TRACING):
            raise NotKept("JAX's settings for debugging")
        if any(getattr(value, "calls_host", False) for value in call.static.values()):
            raise NotKept("a function of the host")
        content = (_code(), _name_of(function), call.static, call.tree, call.shapes)
        key = f"orthaug_{digest_of(content).hex()}"
        kept = self._cache.get(key)
        if kept is None:
            exported, result = _export(function, call)
            text = json.dumps(result).encode()
            kept = struct.pack("<I", len(text)) + text + bytes(exported.serialize())
            self._cache.put(key, kept)
        # Read back in the first process, too, or it would compile what the next one does not find
        (size,) = struct.unpack_from("<I", kept)
        tree = jax.tree.structure(rebuilt(json.loads(kept[4 : 4 + size])))
        exported = export.deserialize(bytearray(kept[4 + size :]))

        def run(*arrays: Any) -> Any:
            return exported.call(*arrays)

        run.__name__ = function.__name__  # of the compiled program on disk and in profiles
        # Its results are committed to their device, and `jit` would compile anew for these
        lowered = jax.jit(run).lower(*call.arrays)
        return Program(lowered.compile(None if effort is None else dict(effort)), tree)


@dataclasses.dataclass(frozen=True, eq=False)
class Call:
    """The arguments of a call: static ones by name, and the arrays of the others."""

    bound: inspect.BoundArguments
    static: dict[str, Any]
    tree: Any
    arrays: list[Any]

    @classmethod
    def of(
        cls, signature: inspect.Signature, static: Sequence[str], args: Any, kwargs: Any
    ) -> Call:
        """Return the arguments of a call of a function with static arguments."""
        import jax

        bound = signature.bind(*args, **kwargs)
        bound.apply_defaults()
        given = bound.arguments
        others = {name: value for name, value in given.items() if name not in static}
        arrays, tree = jax.tree.flatten(others)
        return cls(bound, {name: given[name] for name in static}, tree, arrays)

    @functools.cached_property
    def shapes(self) -> tuple[Shape, ...]:
        return tuple(
            Shape(
                tuple(getattr(one, "shape", ())),
                str(getattr(one, "dtype", type(one).__name__)),
                bool(getattr(one, "weak_type", False)),
            )
            for one in self.arrays
        )

    @property
    def key(self) -> Any:
        """Static arguments, structure and shapes, which name its program in this process."""
        return tuple(self.static.items()), self.tree, self.shapes


def _export(function: Callable[..., Any], call: Call) -> tuple[Any, Any]:
    """Return a function of arrays alone, exported, and the description of its result."""
    import jax
    from jax import export

    results = []

    def of_arrays(*arrays: Any) -> Any:
        given = dict(call.static) | jax.tree.unflatten(call.tree, arrays)
        made = inspect.BoundArguments(call.bound.signature, given)  # type: ignore[arg-type]
        result = function(*made.args, **made.kwargs)
        results.append(described(result))
        return jax.tree.leaves(result)

    of_arrays.__name__ = function.__name__
    exported = export.export(jax.jit(of_arrays))(*call.arrays)
    return exported, results[-1]
