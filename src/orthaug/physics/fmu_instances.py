"""Instances of an FMU for Model Exchange or co-simulation, by FMPy: FMI 2.0 and 3.0.

The functions that a run calls at every point are called by their addresses.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from ctypes import (
    CFUNCTYPE,
    Structure,
    addressof,
    byref,
    c_bool,
    c_double,
    c_int,
    c_size_t,
    c_uint,
    c_void_p,
    cast,
)
from functools import partial
from typing import Any, ClassVar

from orthaug._base.checks import Vector

_ROUNDS = 100  # of discrete states at an event, which have to settle
_WARNING = 1  # the last status with which a call has a value


class Instance(ABC):
    """One instance of an FMU.

    Under Model Exchange it has values of its parameters, in continuous-time mode. For
    co-simulation it is begun anew for every step.
    """

    version: ClassVar[str]
    """The major version of FMI, with which the names of its functions begin: "fmi2"."""
    rates_name: ClassVar[str]
    """The function that returns ẋ."""

    def __init__(self, description: Any, folder: str) -> None:
        self._native: dict[str, object] = {}
        self._used = self._running = False
        self._events = description.numberOfEventIndicators > 0
        self._advances = description.modelExchange is None
        kind = description.coSimulation if self._advances else description.modelExchange
        self.fmu: Any = self._instantiate(
            guid=description.guid,
            modelIdentifier=kind.modelIdentifier,
            unzipDirectory=folder,
            instanceName="orthaug",
        )
        self._reset = self._bound("Reset")
        self._leave_initialization = self._bound("ExitInitializationMode")
        if self._advances:
            return
        self.rates = self._bound(self.rates_name, c_void_p, c_size_t)
        """Write ẋ to an address, of so many states; returns a status."""
        self._place = self._bound("SetContinuousStates", c_void_p, c_size_t)
        self._modes = [self._bound(name) for name in ("EnterEventMode", "EnterContinuousTimeMode")]

    @abstractmethod
    def _instantiate(self, **names: str) -> Any:
        """Return an instance of FMPy."""

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

    def _begin(self, *given: tuple[Any, int], time: float = 0.0) -> int:
        """Set variables from addresses, enter and leave initialization; return a status."""
        status = self._reset() if self._used else 0
        self._used, self._running = True, False
        status = max(status, self._open(time))
        for references, place in given:
            if len(references):
                status = max(status, self.enter(references, len(references), place))
        return max(status, self._enter_initialization(time), self._leave_initialization())

    def initialize(self, parameters: Sequence[int], values: Vector) -> None:
        """Set parameters, and go to continuous time.

        Raises:
            ArithmeticError: the FMU refuses.
        """
        own = (c_uint * len(parameters))(*parameters)
        numbers = (c_double * len(parameters))(*values)
        if self._begin((own, addressof(numbers))) > _WARNING:
            raise ArithmeticError("it refuses values of its parameters, or to be initialized")
        self._settle()
        self.fmu.enterContinuousTimeMode()
        self._running = True  # from here on, states are set from outside alone

    def advance(
        self,
        points: tuple[int, int, int],
        parameters: tuple[Any, int],
        moving: Any,
        times: tuple[float, int, float],
        asked: Any,
        place: int,
    ) -> list[int]:
        """Write variables after steps of a co-simulation to an address; return where that failed.

        It begins anew at every point, and without steps its start is read.

        Args:
            points: address of the first, bytes from one to the next, and their number; states come
                first, then inputs.
            parameters: value references of the parameters, as an array of C, and the address of
                their values.
            moving, asked: value references of states and inputs, and of what is read.
            times: of the start, number of steps, and s of each.
            place: where the values go, those of one point behind those of another.
        """
        (at, stride, count), (start, steps, step) = points, times
        size, failed = len(asked), []
        for i in range(count):
            status = self._begin(parameters, (moving, at), time=start)
            for k in range(steps if status <= _WARNING else 0):
                status = max(status, self._step(start + k * step, step))
            if max(status, self.read(asked, size, place + 8 * size * i)) > _WARNING:
                failed.append(i)
            at += stride
        return failed

    @abstractmethod
    def _open(self, time: float) -> int:
        """Say when a simulation starts, before anything is set; return a status."""

    @abstractmethod
    def _enter_initialization(self, time: float) -> int:
        """Enter initialization; return a status."""

    @abstractmethod
    def _step(self, time: float, step: float) -> int:
        """Advance from a time by s; return a status."""

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
        self._along: Any = None
        three = c_void_p, c_size_t, c_void_p
        self._enter = self._bound("SetReal", *three)
        self._read = self._bound("GetReal", *three)
        own = c_int, c_double, c_double, c_int, c_double
        self._set_up = self._bound("SetupExperiment", *own)
        self._initialize = self._bound("EnterInitializationMode")
        if self._advances:
            self._advance = self._bound("DoStep", c_double, c_double, c_int)
        else:
            self._update = self._bound("NewDiscreteStates", c_void_p)
            self._event = _Event()

    def _instantiate(self, **names: str) -> Any:
        from fmpy import fmi2

        fmu: Any = (fmi2.FMU2Slave if self._advances else fmi2.FMU2Model)(**names)
        self._callbacks = fmi2.fmi2CallbackFunctions()
        self._callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(lambda *message: None)
        self._callbacks.allocateMemory = fmi2.defaultCallbacks.allocateMemory
        self._callbacks.freeMemory = fmi2.defaultCallbacks.freeMemory
        fmu.instantiate(callbacks=self._callbacks)
        return fmu

    def _open(self, time: float) -> int:
        return self._set_up(0, 0.0, time, 0, 0.0)

    def _enter_initialization(self, time: float) -> int:
        return self._initialize()

    def _step(self, time: float, step: float) -> int:
        return self._advance(time, step, 1)

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
        self._along: Any = None
        four = c_void_p, c_size_t, c_void_p, c_size_t
        self._enter = self._bound("SetFloat64", *four)
        self._read = self._bound("GetFloat64", *four)
        self._flags, self._time = [c_bool() for _ in range(5)], c_double()
        own = c_bool, c_double, c_double, c_bool, c_double
        self._initialize = self._bound("EnterInitializationMode", *own)
        if self._advances:
            self._advance = self._bound("DoStep", c_double, c_double, c_bool, *(c_void_p,) * 4)
        else:
            self._update = self._bound("UpdateDiscreteStates", *(c_void_p,) * 6)

    def _instantiate(self, **names: str) -> Any:
        from fmpy import fmi3

        fmu: Any = (fmi3.FMU3Slave if self._advances else fmi3.FMU3Model)(**names)
        fmu.instantiate(logMessage=lambda *message: None)
        return fmu

    def _open(self, time: float) -> int:
        return 0

    def _enter_initialization(self, time: float) -> int:
        return self._initialize(False, 0.0, time, False, 0.0)  # noqa: FBT003  (as of FMI)

    def _step(self, time: float, step: float) -> int:
        own = (byref(flag) for flag in (*self._flags[:3], self._time))
        status = self._advance(time, step, True, *own)  # noqa: FBT003
        return 3 if self._flags[1] or self._flags[2] else status

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
