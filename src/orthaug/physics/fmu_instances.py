"""Instances of an FMU for Model Exchange, by FMPy: FMI 2.0 and 3.0.

The functions that a run calls at every point are called by their addresses.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from ctypes import (
    CFUNCTYPE,
    Structure,
    byref,
    c_bool,
    c_double,
    c_int,
    c_size_t,
    c_void_p,
    cast,
)
from functools import partial
from typing import Any, ClassVar

from orthaug._base.checks import Vector

_ROUNDS = 100  # of discrete states at an event, which have to settle
_WARNING = 1  # the last status with which a call has a value


class Instance(ABC):
    """One instance of an FMU, with values of its parameters, in continuous-time mode."""

    version: ClassVar[str]
    """The major version of FMI, with which the names of its functions begin: "fmi2"."""
    rates_name: ClassVar[str]
    """The function that returns ẋ."""

    def __init__(self, description: Any, folder: str) -> None:
        self._native: dict[str, object] = {}
        self._used = self._running = False
        self._events = description.numberOfEventIndicators > 0
        self.fmu: Any = self._instantiate(
            guid=description.guid,
            modelIdentifier=description.modelExchange.modelIdentifier,
            unzipDirectory=folder,
            instanceName="orthaug",
        )
        self.rates = self._bound(self.rates_name, c_void_p, c_size_t)
        """Write ẋ to an address, of so many states; returns a status."""
        self._place = self._bound("SetContinuousStates", c_void_p, c_size_t)
        self._modes = [self._bound(name) for name in ("EnterEventMode", "EnterContinuousTimeMode")]

    @abstractmethod
    def _instantiate(self, **names: str) -> Any:
        """Return an instance of FMPy."""

    @abstractmethod
    def _begin(self, parameters: Sequence[int], values: Sequence[float]) -> None:
        """Set parameters, and enter and leave initialization."""

    @abstractmethod
    def _update_discrete(self) -> tuple[bool, bool]:
        """Update discrete states; return whether again, and whether the FMU ends or jumps."""

    @abstractmethod
    def enter(self, references: Any, count: int, place: int) -> int:
        """Set variables from the numbers at an address; return a status."""

    @abstractmethod
    def read(self, references: Any, count: int, place: int) -> int:
        """Write the values of variables to an address; return a status."""

    @abstractmethod
    def slopes(self, unknown: object, count: int, known: int, seed: int, place: int) -> int:
        """Write the derivatives by one variable to an address; return a status.

        Args:
            unknown, count: value references of what is differentiated, and their number.
            known: the address of the value reference of the variable.
            seed: the address of 1.0.
            place: where they go.
        """

    def initialize(self, parameters: Sequence[int], values: Vector) -> None:
        """Set parameters, and go to continuous time."""
        if self._used:
            self.fmu.reset()
        self._used, self._running = True, False
        self._begin(list(parameters), [float(v) for v in values])
        self._settle()
        self.fmu.enterContinuousTimeMode()
        self._running = True  # from here on, states are set from outside alone

    def visit(
        self,
        at: int,
        stride: int,
        count: int,
        nx: int,
        inputs: object,
        nu: int,
        read: Callable[[int], int],
    ) -> list[int]:
        """Set states and inputs to each point in turn, and read; return where that failed.

        Addresses of points go to the native code as they are: a call takes less than a
        microsecond.

        Args:
            at, stride, count: address of the first point, bytes from one to the next, and their
                number; states come first, then inputs.
            nx, nu: number of states and inputs.
            inputs: value references of the inputs, as an array of C.
            read: called with the number of the point, returns a status.
        """
        place, enter, events, failed = self._place, self.enter, self._events, []
        for i in range(count):
            status = place(at, nx)
            if nu:
                status = max(status, enter(inputs, nu, at + 8 * nx))
            if events:
                self._update_relations()
            if max(status, read(i)) > _WARNING:
                failed.append(i)
            at += stride
        return failed

    def _bound(self, name: str, *kinds: Any) -> Callable[..., int]:
        """Return a function of the FMU with its instance; it returns a status."""
        address = cast(getattr(self.fmu.dll, f"{self.version}{name}"), c_void_p).value
        made: Any = CFUNCTYPE(c_int, c_void_p, *kinds)
        return partial(made(address), self.fmu.component)

    def _update_relations(self) -> None:
        enter, leave = self._modes
        enter()
        self._settle()
        leave()

    def _settle(self) -> None:
        for _ in range(_ROUNDS):
            again, ends = self._update_discrete()
            if ends:
                raise ArithmeticError("the FMU ends, or sets its states, at an event")
            if not again:
                return
        raise ArithmeticError("discrete states do not settle")


class _Event(Structure):
    """`fmi2EventInfo`."""

    _fields_ = (
        *((name, c_int) for name in ("needed", "ends", "nominals", "jumps", "timed")),
        ("time", c_double),
    )


class Instance2(Instance):
    """An instance of FMI 2.0."""

    version = "fmi2"
    rates_name = "GetDerivatives"

    def __init__(self, description: object, folder: str) -> None:
        super().__init__(description, folder)
        three = c_void_p, c_size_t, c_void_p
        self._enter = self._bound("SetReal", *three)
        self._read = self._bound("GetReal", *three)
        self._update = self._bound("NewDiscreteStates", c_void_p)
        self._event = _Event()
        self._along: Any = None

    def _instantiate(self, **names: str) -> Any:
        from fmpy import fmi2

        fmu: Any = fmi2.FMU2Model(**names)
        self._callbacks = fmi2.fmi2CallbackFunctions()
        self._callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(lambda *message: None)
        self._callbacks.allocateMemory = fmi2.defaultCallbacks.allocateMemory
        self._callbacks.freeMemory = fmi2.defaultCallbacks.freeMemory
        fmu.instantiate(callbacks=self._callbacks)
        return fmu

    def _begin(self, parameters: Sequence[int], values: Sequence[float]) -> None:
        self.fmu.setupExperiment(startTime=0.0)
        if parameters:
            self.fmu.setReal(parameters, values)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def _update_discrete(self) -> tuple[bool, bool]:
        event = self._event
        if self._update(byref(event)) > _WARNING:
            raise ArithmeticError("an event has no end")
        return bool(event.needed), bool(event.ends or (event.jumps and self._running))

    def enter(self, references: object, count: int, place: int) -> int:
        return self._enter(references, count, place)

    def read(self, references: Any, count: int, place: int) -> int:
        return self._read(references, count, place)

    def slopes(self, unknown: object, count: int, known: int, seed: int, place: int) -> int:
        if self._along is None:  # not every FMU has it
            kinds = c_void_p, c_size_t, c_void_p, c_size_t, c_void_p, c_void_p
            self._along = self._bound("GetDirectionalDerivative", *kinds)
        return self._along(unknown, count, known, 1, seed, place)


class Instance3(Instance):
    """An instance of FMI 3.0."""

    version = "fmi3"
    rates_name = "GetContinuousStateDerivatives"

    def __init__(self, description: object, folder: str) -> None:
        super().__init__(description, folder)
        four = c_void_p, c_size_t, c_void_p, c_size_t
        self._enter = self._bound("SetFloat64", *four)
        self._read = self._bound("GetFloat64", *four)
        self._update = self._bound("UpdateDiscreteStates", *(c_void_p,) * 6)
        self._flags, self._time = [c_bool() for _ in range(5)], c_double()
        self._along: Any = None

    def _instantiate(self, **names: str) -> Any:
        from fmpy import fmi3

        fmu: Any = fmi3.FMU3Model(**names)
        fmu.instantiate(logMessage=lambda *message: None)
        return fmu

    def _begin(self, parameters: Sequence[int], values: Sequence[float]) -> None:
        if parameters:
            self.fmu.setFloat64(parameters, values)
        self.fmu.enterInitializationMode(startTime=0.0)
        self.fmu.exitInitializationMode()

    def _update_discrete(self) -> tuple[bool, bool]:
        if self._update(*(byref(flag) for flag in self._flags), byref(self._time)) > _WARNING:
            raise ArithmeticError("an event has no end")
        again, ends, _, jumps, _ = (flag.value for flag in self._flags)
        return again, ends or (jumps and self._running)

    def enter(self, references: object, count: int, place: int) -> int:
        return self._enter(references, count, place, count)

    def read(self, references: Any, count: int, place: int) -> int:
        return self._read(references, count, place, count)

    def slopes(self, unknown: object, count: int, known: int, seed: int, place: int) -> int:
        if self._along is None:
            kinds = *(c_void_p, c_size_t) * 2, c_void_p, c_size_t, c_void_p, c_size_t
            self._along = self._bound("GetDirectionalDerivative", *kinds)
        return self._along(unknown, count, known, 1, seed, 1, place, count)


VERSIONS: dict[str, type[Instance]] = {"2.0": Instance2, "3.0": Instance3}
"""Instances by the version of FMI."""
