"""JAX in double precision, imported when it is first used.

A declaration of a learner or solver costs no import.

`jax` and `jnp` are lazy modules. `jax.jit` compiles at the first call, so that a module with
compiled functions can be imported without JAX.

Programs that it keeps on disk end with a checksum, and one that was cut, altered or exchanged is
compiled again: JAX runs whatever it finds under a program's name, and two that are exchanged give
an error, or other numbers.
"""

from __future__ import annotations

import functools
import gc
import hashlib
import inspect
import os
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthaug._base.errors import PrecisionError
from orthaug._base.kept_programs import Call, KeptPrograms
from orthaug._base.memory import return_free_memory

if TYPE_CHECKING:
    from types import ModuleType as ArrayModule

    import jax
    import jax.numpy as jnp
    import numpy as np
    from jax import Array

    AnyArray = np.ndarray | Array
else:
    # In annotations; at run time jaxtyping checks shape and type of whatever is an array
    Array = Any
    AnyArray = Any  # of NumPy or JAX
    ArrayModule = Any  # NumPy, or JAX's

_LENGTH = hashlib.sha256().digest_size
_MAPS = 65_530  # of memory, that Linux grants a process unless it is set otherwise
_MOST_MAPS = 0.5  # of these, up to which programs stay: one fit with its diagnosis takes 0.1
__all__ = [
    "AnyArray",
    "Array",
    "ArrayModule",
    "is_traced",
    "jax",
    "jnp",
    "keep_programs",
    "padded_length",
    "release_programs",
    "quick_jit",
    "starts",
]


def _real_jax() -> Any:
    """Return JAX, with double precision turned on.

    Raises:
        PrecisionError: the environment forbids double precision.
    """
    asked = os.environ.get("JAX_ENABLE_X64", "")
    if asked.strip().lower() not in {"", "1", "true", "t", "yes", "y", "on"}:
        raise PrecisionError(
            f"JAX_ENABLE_X64={asked} in the environment turns off double precision, which "
            "orthaug needs. Unset it, or set it to 1."
        )
    import jax

    jax.config.update("jax_enable_x64", True)
    return jax


class _LazyModule:
    """A module that is imported when one of its names is first asked for."""

    def __init__(self, real: Callable[[], Any], **own: Any) -> None:
        self.__dict__.update(own, _real=real)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # what tools ask of any object
            raise AttributeError(name)
        value = self.__dict__[name] = getattr(self._real(), name)
        return value


# What XLA leaves out where the data are small. Compiling takes half as long, and runs take as long
# as before (benchmarks/compile_effort.py)
_LESS_EFFORT = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_llvm_disable_expensive_passes": True,
}
# For what runs a few times only: a quarter of the time to compile, and runs take four times as long
_LEAST_EFFORT = {**_LESS_EFFORT, "xla_backend_optimization_level": 0}
_SMALL = 1 << 15  # numbers in an argument: with more, runs are worth any time to compile
_LITTLE = 1 << 23  # numbers that are computed: with more the same holds


class _Compiled:
    """A function that JAX compiles when it is first called, with less effort for small arguments.

    Compiling takes a second or two for each program and is most of what a first fit takes. JAX
    takes such options for a whole program only, so inside another one the function is compiled as
    that one is. Where this version of JAX or the platform has no such options, they are left out.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        effort: dict[str, Any],
        options: dict[str, Any],
        work: Callable[[Any], int] | None = None,
    ) -> None:
        functools.update_wrapper(self, function)
        self._work = work
        self._function, self._effort, self._options = function, effort, options
        self._lock = threading.Lock()
        named = "<" not in getattr(function, "__qualname__", "<")  # objects have no name
        self._may_be_kept = named and options.keys() <= {"static_argnames", "static_argnums"}

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        most = _SMALL if self._work is None else _LITTLE // max(self._work(args[0]), 1)
        small = _are_small((args, kwargs), min(most, _SMALL))
        if small is not None and self._may_be_kept and _kept:
            result = self._of_kept(small, args, kwargs)
            if result is not NotImplemented:
                return result
        if small and _efforts_known():
            try:
                return self._with_less_effort(*args, **kwargs)
            except ValueError as error:  # called while another program is traced
                if "compiler_options" not in str(error):
                    raise
        return self._plain(*args, **kwargs)

    def __get__(self, instance: Any, owner: Any = None) -> Any:
        return self if instance is None else functools.partial(self, instance)

    def __reduce__(self) -> Any:
        """Return what pickle keeps: the name in its module, as of a function."""
        if "<locals>" in self._function.__qualname__:
            return type(self), (self._function, self._effort, self._options, self._work)
        return self._function.__qualname__

    def _of_kept(self, small: bool, args: Any, kwargs: Any) -> Any:
        """Return the result of a program on disk; `NotImplemented` without one."""
        if not _efforts_known() or len(_real_jax().devices()) > 1:
            return NotImplemented
        call = Call.of(self._signature, self._static, args, kwargs)
        return _kept[0].call(self._function, call, self._effort if small else None)

    @functools.cached_property
    def _signature(self) -> inspect.Signature:
        return inspect.signature(self._function)

    @functools.cached_property
    def _static(self) -> tuple[str, ...]:
        """Names of the static arguments."""
        names = self._options.get("static_argnames", ())
        numbers = self._options.get("static_argnums", ())
        all_names = list(self._signature.parameters)
        by_number = (numbers,) if isinstance(numbers, int) else numbers
        return (
            *((names,) if isinstance(names, str) else names),
            *(all_names[i] for i in by_number),
        )

    @functools.cached_property
    def _plain(self) -> Callable[..., Any]:
        with self._lock:
            return _real_jax().jit(self._function, **self._options)

    @functools.cached_property
    def _with_less_effort(self) -> Callable[..., Any]:
        with self._lock:
            options = {"compiler_options": self._effort, **self._options}
            return _real_jax().jit(self._function, **options)


def _late_jit(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Return `jax.jit(function, **options)`, made at the first call."""
    return _Compiled(function, _LESS_EFFORT, options)


def quick_jit(
    function: Callable[..., Any], work: Callable[[Any], int] | None = None, **options: Any
) -> Callable[..., Any]:
    """Return `jax.jit(function, **options)` for a program that runs a few times only.

    On small data it is compiled with the least effort.

    Args:
        work: of the first argument: how many numbers are computed for each one that is given.
    """
    return _Compiled(function, _LEAST_EFFORT, options, work)


@functools.cache
def _efforts_known() -> bool:
    """Return whether this JAX compiles for a processor and knows the options of less effort."""
    real = _real_jax()
    if real.default_backend() != "cpu":
        return False
    try:
        real.jit(lambda x: x + 1).lower(1.0).compile(_LEAST_EFFORT)
    except Exception:  # JAX has an error of its own for an option that it does not know
        return False
    return True


def _are_small(arguments: Any, most: int) -> bool | None:
    """Return whether no argument has more numbers; None if one is not known yet."""
    from jax.core import Tracer

    small = True
    for leaf in _real_jax().tree.leaves(arguments):
        if isinstance(leaf, Tracer):
            return None
        small = small and getattr(leaf, "size", 0) <= most
    return small


def starts() -> bool:
    """Return whether JAX finds a device to compute on.

    Otherwise its exception depends on the platform that is asked for.
    """
    try:
        return bool(_real_jax().devices())
    except Exception:
        return False


def is_traced(value: Any) -> bool:
    """Return whether a value is a tracer, whose numbers are not known yet."""
    from jax.core import Tracer

    return isinstance(value, Tracer)


class _CompileTimes(threading.local):
    """Spans of time [s] in which this thread traced and compiled, disjoint and in order."""

    def __init__(self) -> None:
        self.spans: list[tuple[float, float]] = []
        self.total = 0.0

    def note(self, event: str, duration: float, **_: Any) -> None:
        if not event.startswith("/jax/core/compile/"):
            return
        end = time.perf_counter()
        while (
            self.spans and self.spans[-1][1] > end - duration
        ):  # what a program calls is traced within it
            begin, last = self.spans.pop()
            self.total -= last - begin
            duration = max(duration, end - begin)
        self.spans.append((end - duration, end))
        self.total += duration


_compiling: list[_CompileTimes] = []


def training_clock() -> float:
    """Return a clock of this thread [s] without the time in which JAX compiles.

    Its differences are the time of the computation.
    """
    if not _compiling:
        _compiling.append(_CompileTimes())
        _real_jax().monitoring.register_event_duration_secs_listener(_compiling[0].note)
    return time.perf_counter() - _compiling[0].total


def padded_length(rows: int) -> int:
    """Return the length that a number of rows is padded to.

    Lengths grow by powers of two, so that few programs are compiled.

    To compile one takes longer than a thousand rows.
    """
    return max(1024, 1 << (rows - 1).bit_length())


if not TYPE_CHECKING:
    jax, jnp = _LazyModule(_real_jax, jit=_late_jit), _LazyModule(lambda: _real_jax().numpy)
    if (
        "jax" in sys.modules
    ):  # then it costs nothing, and what the user computes is in double precision too
        _real_jax()


def release_programs(share: float = _MOST_MAPS) -> bool:
    """Let compiled programs go if they take most of the process's memory maps; True if they did.

    Each compiled program takes some maps, and Linux ends a process that asks for more than it
    grants (65,530): a loop over hundreds of fits would crash. Those that are needed again are
    compiled again, or come from disk.

    Args:
        share: of the maps that the system grants, up to which programs stay.
    """
    held, granted = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
    if "jax" not in sys.modules or not held.exists():
        return False
    try:
        most = int(granted.read_bytes())
    except (OSError, ValueError):
        most = _MAPS
    if held.read_bytes().count(b"\n") <= share * most:
        return False
    for programs in _kept:
        programs.clear()
    jax.clear_caches()
    gc.collect()
    return_free_memory()
    return True


def keep_programs(folder: str | Path | None = None) -> Path:
    """Keep compiled programs for later processes, and return the folder where they are kept.

    A script that is run again then starts faster: most of what its first fit takes is compiling.
    The command line does this by itself; from Python nothing is kept without it. Call it before
    the first fit; programs that were compiled earlier are not kept. It is a setting of JAX in the
    whole process.

    Args:
        folder: by default that of `JAX_COMPILATION_CACHE_DIR`, else the user's folder for caches,
            which the command line uses, too. Removing it costs a slower start and nothing else.
    """
    import platformdirs
    from jax.experimental.compilation_cache import compilation_cache

    place = os.environ.get("JAX_COMPILATION_CACHE_DIR") or platformdirs.user_cache_dir("orthaug")
    place = str(folder or place)
    jax.config.update("jax_compilation_cache_dir", place)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    compilation_cache.reset_cache()  # JAX asks once whether there is one
    _check_cached_programs()
    keep_traced_programs(place)
    return Path(place)


_kept: list[KeptPrograms] = []  # one where traced programs are kept


def keep_traced_programs(folder: str) -> None:
    """Read traced programs from a folder from now on, and write there what is traced."""
    try:
        from jax._src.compilation_cache import get_file_cache
    except ImportError:  # another version of JAX: its functions are traced in each process
        return
    cache = get_file_cache(folder)
    _kept[:] = [] if cache is None else [KeptPrograms(cache[0])]


class ChecksummedCache:
    """A cache of JAX whose entries end with a checksum of their key and content.

    A cache without writing is silent.
    """

    def __init__(self, cache: Any, folder: str) -> None:
        self._cache, self._folder = cache, Path(folder)
        self._path = getattr(cache, "_path", folder)

    def get(self, key: str) -> bytes | None:
        """Return the content of an entry; None where there is none, or not that one."""
        try:
            entry = self._cache.get(key)
        except Exception:  # JAX words each failure in a warning of many lines
            return None
        if entry is None or entry[-_LENGTH:] == _digest(key, entry[:-_LENGTH]):
            return entry and entry[:-_LENGTH]
        with suppress(OSError):  # or what is compiled now would not be kept
            (self._folder / f"{key}-cache").unlink(missing_ok=True)
        return None

    def put(self, key: str, value: bytes) -> None:
        """Keep an entry, if it can be written."""
        with suppress(Exception):
            self._cache.put(key, value + _digest(key, value))


def _digest(key: str, content: bytes) -> bytes:
    return hashlib.sha256(key.encode() + b"\0" + content).digest()


def _check_cached_programs() -> None:
    """Make JAX's cache a checked one from now on.

    If this version of JAX has another cache, nothing is kept.
    """
    try:
        from jax._src import compilation_cache

        make = compilation_cache.get_file_cache
    except (ImportError, AttributeError):
        jax.config.update("jax_enable_compilation_cache", False)
        return
    if hasattr(make, "__wrapped__"):
        return

    @functools.wraps(make)
    def check_one(path: str) -> Any:
        try:
            made = make(path)
        except Exception:  # a place that cannot be written
            return None
        return made and (ChecksummedCache(made[0], path), made[1])

    compilation_cache.get_file_cache = check_one
