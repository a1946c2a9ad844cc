"""Values of an FMU at points of states, inputs and parameters, with their slopes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from ctypes import addressof, c_double, c_uint, string_at
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.jax import AnyArray
from orthaug.physics.black_box import Groups
from orthaug.physics.fmu_instances import Instance
from orthaug.physics.fmu_units import NATIVE_CODE, Unit

_STEP = np.finfo(float).eps ** (1 / 3)  # of central differences, against the size of a number
_FLOOR = 0.1
_EVERY = slice(None)
_WIDER = 80.0  # times that are the steps of second differences, of slopes with noise of 1e-10
_ALIKE = 1e-3  # what the tolerances of an FMU's solver leave
_OF_TIME = "{}: its equations depend on the time; give what does as an input."


@dataclass(frozen=True)
class Evaluation:
    """ẋ of an FMU, or outputs of it, at points: a `BlackBox`.

    `states`, `parameters`, `inputs` and `outputs` are value references; without `outputs` it is ẋ.
    """

    unit: Unit
    states: tuple[int, ...]
    parameters: tuple[int, ...]
    inputs: tuple[int, ...]
    outputs: tuple[int, ...] | None

    _wide: ClassVar[float] = 1.0
    """Times that the steps of differences are, of values with more than rounding."""

    @property
    def size(self) -> int:
        """Number of values."""
        return len(self.states if self.outputs is None else self.outputs)

    @property
    def widths(self) -> tuple[int, int, int]:
        """Numbers of states, inputs and parameters."""
        return len(self.states), len(self.inputs), len(self.parameters)

    def sampled(self, sampling_time: float) -> Evaluation:
        """Return the evaluation: ẋ and outputs are those of an instant."""
        return self

    @property
    def _results(self) -> tuple[int, ...]:
        """Value references of ẋ."""
        return self.unit.rates

    @cached_property
    def _references(self) -> tuple[Any, Any]:
        """Value references of inputs and of values, as arrays of C."""
        unknown = self._results if self.outputs is None else self.outputs
        return (c_uint * len(self.inputs))(*self.inputs), (c_uint * len(unknown))(*unknown)

    @cached_property
    def _directional(self) -> bool:
        """True if the FMU gives the derivatives by states and inputs."""
        described = self.unit.description
        own = {v.valueReference for v in described.modelVariables if v.causality == "output"}
        provided = described.modelExchange.providesDirectionalDerivative
        return provided and set(self.outputs or ()) <= own

    def values(self, z: Matrix) -> Matrix:
        """Return the values (m, size); NaN where the FMU has none."""
        found = np.empty((len(z), self.size))
        with NATIVE_CODE:
            for rows, own, p in self._groups(z):
                found[rows] = self._at(own, p)
        return found

    def write_values(self, point: int, values: int) -> None:
        """Write the values at the point at an address to an address; NaN where it has none."""
        nx, nu, count = self.widths
        p = string_at(point + 8 * (nx + nu), 8 * count)
        with NATIVE_CODE:
            failed = self._read_at((point, 0, 1), p, lambda own: self._reader(own, values))
        if failed is None or failed:
            (c_double * self.size).from_address(values)[:] = [np.nan] * self.size

    def slopes(self, z: Matrix, groups: Groups) -> Any:
        """Return the slopes (m, size, n) by those of states, inputs and parameters asked for."""
        count = sum(np.array(self.widths)[list(groups)])
        found = np.empty((len(z), self.size, count))
        with NATIVE_CODE:
            for rows, own, p in self._groups(z):
                found[rows] = self._slopes(own, p, groups)
        return found

    def curvature(self, z: Matrix) -> np.ndarray:
        """Return central differences (m, size, n, n) of the slopes, n = nx + nu + np."""
        nx, nu, _ = self.widths
        columns = []
        for j, nominal in enumerate(self._nominal):
            h = _WIDER * self._wide * _step(z[:, j], nominal, _FLOOR if j < nx + nu else 0.0)
            ends = []
            for sign in (1, -1):
                moved = z.copy()
                moved[:, j] += sign * h
                ends.append((moved[:, j], self.slopes(moved, (True, True, True))))
            (up, above), (down, below) = ends
            columns.append((above - below) / (up - down)[:, None, None])
        found = np.stack(columns, axis=-1)
        return (found + np.swapaxes(found, -1, -2)) / 2

    def check(self) -> None:
        """Raise InputError where the FMU does not run, or its equations depend on the time."""
        now, later = (self.at_start(time) for time in (0.0, 1000.1))
        if (now != later).any():
            raise InputError(_OF_TIME.format(self.unit.file))

    def at_start(self, time: float) -> Vector:
        """Return the values at the FMU's own start, at a time.

        Raises:
            InputError: native code that cannot be loaded, or does not run.
        """
        with NATIVE_CODE:
            try:
                instance, found = self.unit.instance((), b""), np.empty(self.size)
                instance.fmu.setTime(time)
                self._reader(instance, _address(found))(0)
                instance.fmu.setTime(0.0)
                return found
            except Exception as error:  # of FMPy, or of the operating system
                raise InputError(
                    f"{self.unit.file}: the FMU does not run ({' '.join(str(error).split())})."
                ) from None

    def _groups(self, z: Matrix) -> Iterator[tuple[Any, Matrix, Vector]]:
        """Yield rows with the same parameters: which, contiguous points, and the parameters."""
        if not len(z):
            return
        z = np.ascontiguousarray(z)
        p = z[:, len(self.states) + len(self.inputs) :]
        if len(z) == 1 or (p == p[0]).all():
            yield _EVERY, z, p[0]
            return
        different, which = np.unique(p, axis=0, return_inverse=True)
        for i, own in enumerate(different):
            rows = np.flatnonzero(which.ravel() == i)
            yield rows, z[rows], own

    def _at(self, z: Matrix, p: Vector) -> Matrix:
        """Return the values at points (m, nx + nu or more) of one vector of parameters."""
        found = np.empty((len(z), self.size))
        self._visit(z, p, found, self._reader)
        return found

    def _visit(self, z: Matrix, p: Vector, found: AnyArray, reader: Any) -> None:
        """Fill `found` at points by the reader of an instance; NaN where the FMU refuses them."""
        points = _address(z), z.strides[0], len(z)
        failed = self._read_at(points, p.tobytes(), lambda own: reader(own, _address(found)))
        if failed is None or failed:
            found[slice(None) if failed is None else failed] = np.nan

    def _read_at(
        self, points: tuple[int, int, int], p: bytes, reader: Callable[[Instance], Any]
    ) -> list[int] | None:
        """Read at points, as `Instance.visit` takes them; return which failed, None for all."""
        nx, nu, _ = self.widths
        try:
            instance = self.unit.instance(self.parameters, p)
            return instance.visit(*points, nx, self._references[0], nu, reader(instance))
        except Exception:  # a refusal of FMPy: a run through these points has no value
            self.unit.instances.pop((self.parameters, p), None)
            return None

    def _reader(self, instance: Instance, place: int) -> Callable[[int], int]:
        """Return a function that writes the values of a row to an address; it returns a status."""
        size = self.size
        if self.outputs is None:
            rates = instance.rates
            return lambda i: rates(place + 8 * size * i, size)
        read, references = instance.read, self._references[1]
        return lambda i: read(references, size, place + 8 * size * i)

    def _slopes(self, z: Matrix, p: Vector, groups: Groups) -> Any:
        """Return the slopes (m, size, n) at points of one vector of parameters."""
        nx, nu, _ = self.widths
        asked = np.flatnonzero(np.repeat(groups[:2], (nx, nu)))
        own = self._own_slopes if self._directional else self._differences
        columns = [*np.moveaxis(own(z, p, asked), 1, 0)] if len(asked) else []
        for j, value in enumerate(p if groups[2] else ()):
            up, down = p.copy(), p.copy()
            h = self._wide * _step(value, self._nominal[nx + nu + j])
            up[j], down[j] = value + h, value - h
            columns.append((self._at(z, up) - self._at(z, down)) / (up[j] - down[j]))
        return np.stack(columns, axis=-1)

    def _differences(self, z: Matrix, p: Vector, asked: np.ndarray) -> np.ndarray:
        """Return central differences (m, k, size) by k of the states and inputs."""
        m, every = len(z), np.arange(len(asked))
        moved = np.repeat(z[None, None], 2, axis=0).repeat(len(asked), axis=1)  # (2, k, m, nz)
        h = self._wide * _step(z[:, asked].T, self._nominal[asked][:, None], _FLOOR)
        moved[0, every, :, asked] += h
        moved[1, every, :, asked] -= h
        found = self._at(moved.reshape(-1, z.shape[1]), p).reshape(2, len(asked), m, self.size)
        wide = moved[0, every, :, asked] - moved[1, every, :, asked]
        return np.moveaxis((found[0] - found[1]) / wide[..., None], 0, 1)

    def _own_slopes(self, z: Matrix, p: Vector, asked: np.ndarray) -> np.ndarray:
        """Return the slopes (m, k, size) by k of the states and inputs that the FMU gives."""
        known = (*self.states, *self.inputs)
        entries, one = (c_uint * len(asked))(*(known[j] for j in asked)), c_double(1.0)
        found, size, unknown = (
            np.empty((len(z), len(asked), self.size)),
            self.size,
            self._references[1],
        )
        first, seed = addressof(entries), addressof(one)

        def reader(instance: Instance, place: int) -> Callable[[int], int]:
            slopes = instance.slopes

            def read(i: int) -> int:
                at = place + 8 * size * len(asked) * i
                return max(
                    slopes(unknown, size, first + 4 * j, seed, at + 8 * size * j)
                    for j in range(len(asked))
                )

            return read

        self._visit(z, p, found, reader)
        return found

    @cached_property
    def _nominal(self) -> Vector:
        """Nominal values of states, inputs and parameters; 1 where none is given."""
        variables = self.unit.description.modelVariables
        given = {v.valueReference: v.nominal for v in variables if v.nominal is not None}
        every = (*self.states, *self.inputs, *self.parameters)
        return np.array([abs(float(given.get(entry, 1.0))) or 1.0 for entry in every])


@dataclass(frozen=True)
class Steps(Evaluation):
    """x(t + step) of an FMU for co-simulation from x(t), or its outputs at t: a `BlackBox`."""

    step: float = float("nan")
    """[s]; nothing has a value without it."""

    _wide: ClassVar[float] = 200.0
    """The solver of an FMU has tolerances."""

    @property
    def _results(self) -> tuple[int, ...]:
        return self.states

    @cached_property
    def _directional(self) -> bool:
        return False

    def sampled(self, sampling_time: float) -> Steps:
        """Return the evaluation with this step.

        Raises:
            InputError: an FMU that does not run, or that cannot be begun at any states.
        """
        if sampling_time == self.step:
            return self
        made = replace(self, step=sampling_time)
        if self.outputs is None:
            made._check_steps()
        return made

    def check(self) -> None:
        """Leave it to `sampled`: nothing runs before the time of a step is known."""

    def write_values(self, point: int, values: int) -> None:
        nx, nu, _ = self.widths
        with NATIVE_CODE:
            self._run((point, 0, 1), point + 8 * (nx + nu), values)

    def _at(self, z: Matrix, p: Vector) -> Matrix:
        found, z, p = np.empty((len(z), self.size)), np.ascontiguousarray(z), p.copy()
        self._run((_address(z), z.strides[0], len(z)), _address(p), _address(found))
        return found

    def _run(
        self, points: tuple[int, int, int], p: int, place: int, times: tuple[float, int] = (0.0, 1)
    ) -> None:
        """Write the values at points, as `Instance.advance` takes them; NaN where it is refused."""
        steps = times[1] if self.outputs is None else 0
        failed = self.unit.stepper.advance(
            points,
            (self._own, p),
            self._moving,
            (times[0], steps, self.step),
            self._references[1],
            place,
        )
        for i in failed:
            values = (c_double * self.size).from_address(place + 8 * self.size * i)
            values[:] = [np.nan] * self.size

    @cached_property
    def _own(self) -> Any:
        """Value references of parameters, as an array of C."""
        return (c_uint * len(self.parameters))(*self.parameters)

    @cached_property
    def _moving(self) -> Any:
        """Value references of states and inputs, as an array of C."""
        every = *self.states, *self.inputs
        return (c_uint * len(every))(*every)

    def _check_steps(self) -> None:
        """Raise InputError unless it can be begun at any states, which are all that it remembers.

        Two steps at once must end where a step does that begins anew at the end of the first.
        """
        file, nx = self.unit.file, self.widths[0]
        variables = {v.valueReference: v for v in self.unit.description.modelVariables}
        starts = [float(variables[entry].start or 0.0) for entry in (*self.states, *self.inputs)]
        own = [float(variables[entry].start or 0.0) for entry in self.parameters]
        nominal = self._nominal
        z = np.array(starts) + _FLOOR * nominal[: len(starts)]
        p = np.where(own, own, nominal[len(starts) :])
        later = 1000 * self.step

        def run(z: Vector, steps: int, time: float = 0.0) -> Vector:
            found = np.empty(nx)
            self._run((_address(z), 0, 1), _address(p), _address(found), (time, steps))
            return found

        with NATIVE_CODE:
            try:
                begun, first, apart = run(z, 0), run(z, 1), run(z, 1, later)
                at_once, anew = run(z, 2), run(np.concatenate([first, z[nx:]]), 1)
            except Exception as error:  # of FMPy, or of the operating system
                raise InputError(
                    f"{file}: the FMU does not run ({' '.join(str(error).split())})."
                ) from None
        if not np.isfinite([begun, first, apart, at_once, anew]).all():
            raise InputError(
                f"{file}: it cannot be begun anew at states and advanced by {self.step:g} s, as "
                "co-simulation needs; export it for Model Exchange."
            )
        names = [variables[entry].name for entry in self.states]
        kept = np.isclose(begun, z[:nx], rtol=1e-6, atol=0.0)
        if not kept.all():
            raise InputError(
                f"{file}: its state {names[int(np.argmin(kept))]} cannot be set where it begins, "
                "so no run of co-simulation starts at measured states; export it for Model "
                "Exchange."
            )
        if not np.allclose(first, apart, rtol=_ALIKE, atol=0.0):
            raise InputError(_OF_TIME.format(file))
        moved = np.abs(at_once - z[:nx]) + np.abs(z[:nx])
        off = np.abs(at_once - anew) / np.where(moved > 0, moved, 1.0)
        if not off.max() <= _ALIKE:
            raise InputError(
                f"{file}: it remembers more than {', '.join(names)}: two steps end elsewhere than "
                f"one that begins anew after the first, by {off.max():.2g} of "
                f"{names[int(np.argmax(off))]}. Name all of its states in `states`, or export it "
                "for Model Exchange."
            )


def _address(array: Any) -> int:
    """Return where the numbers of a contiguous array begin."""
    return array.__array_interface__["data"][0]


def _step(value: Any, nominal: Any, floor: float = 0.0) -> Any:
    """Return the step of a central difference, against the size of a number.

    The size is a share `floor` of the nominal one at least: a state or input that is nearly 0 now
    has others beside it which are not.
    """
    size = np.maximum(np.abs(value), floor * nominal)
    return _STEP * np.where(size == 0, nominal, size)
