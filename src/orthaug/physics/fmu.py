"""Physics in a Functional Mock-up Unit: FMI 2.0 and 3.0, Model Exchange.

An FMU holds native code: to evaluate it is to run it.
"""

from __future__ import annotations

import atexit
import re
import shutil
import tempfile
import threading
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from ctypes import addressof, c_double, c_uint, string_at
from dataclasses import dataclass, field
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar
from xml.sax.saxutils import quoteattr

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.jax import AnyArray
from orthaug.physics.black_box import Groups, Points
from orthaug.physics.consent import CONSENTS
from orthaug.physics.fmu_instances import VERSIONS, Instance
from orthaug.physics.sources import Description, FileSource, Functions, Quantity, Seen

_STEP = np.finfo(float).eps ** (1 / 3)  # of central differences, against the size of a number
_FLOOR = 0.1
_EVERY = slice(None)
_WIDER = 80.0  # times that are the steps of second differences, of slopes with noise of 1e-10
_UNITS: dict[str, Unit] = {}
_LOCK = threading.RLock()  # of all native code: FMUs need not be safe for threads

_REAL = ("Real", "Float64")  # types of variables of FMI 2.0 and 3.0


@dataclass(frozen=True, kw_only=True)
class FMU(FileSource):
    """The equations of an FMU for Model Exchange, FMI 2.0 or 3.0: ẋ and outputs at points.

    Derivatives by states and inputs are the FMU's own where it provides them, otherwise central
    differences; those by parameters are differences. Time is 0, and the FMU must not use it.
    Relations, such as the sign of a speed, are evaluated anew at every point.

    Args:
        file, parameters, inputs, outputs, starts, learned: as of a `FileSource`.
        integrator, substeps, hold: of the motion.

    Examples:
        `oa.estimate(record, oa.FMU(file="model.fmu", parameters=("m", "c")), learner=None)`
    """

    ending: ClassVar[str] = ".fmu"
    native: ClassVar[bool] = True
    target: ClassVar[str] = "fmu-parameters"

    @property
    def compiled(self) -> bool:
        return False

    @cached_property
    def unit(self) -> Unit:
        """The FMU, unpacked."""
        return open_unit(self.file, self.content, self.sha256)

    def describe(self) -> Description:
        states = tuple(_quantity(v) for v in self.unit.states)
        own = {s.name: s for s in states}
        variables = [
            v for v in self.unit.description.modelVariables if v.type in _REAL and not v.dimensions
        ]
        return Description(
            states,
            tuple(_quantity(v) for v in variables if v.causality == "parameter"),
            tuple(_quantity(v) for v in variables if v.causality == "input"),
            tuple(
                own.get(v.name, _quantity(v))
                for v in variables
                if v.variability not in ("constant", "fixed", "tunable")
                and v.causality not in ("input", "independent")
            ),
        )

    def functions(
        self, parameters: Sequence[str], inputs: Sequence[str], outputs: Sequence[str]
    ) -> Functions:
        CONSENTS.give(self.sha256)  # whoever names an FMU wants it to run
        names = {v.name: v.valueReference for v in self.unit.description.modelVariables}
        p, u, y = (tuple(names[n] for n in group) for group in (parameters, inputs, outputs))
        f, h = (Evaluation(self.unit, p, u, of) for of in (None, y))
        self._check(f)
        states = [state.name for state in self.unit.states]
        if set(outputs) <= {*states}:
            return Points(f), Seen(tuple(states.index(name) for name in outputs))
        return Points(f), Points(h)

    def _check(self, f: Evaluation) -> None:
        """Raise InputError where the FMU does not run, or its equations depend on the time."""
        now, later = (f.at_start(time) for time in (0.0, 1000.1))
        if (now != later).any():
            raise InputError(
                f"{self.file}: its equations depend on the time; give what does as an input."
            )

    def written(self, values: Mapping[str, float]) -> dict[str, str]:
        """Return an SSP parameter set (.ssv)."""
        rows = "\n".join(
            f"    <ssv:Parameter name={quoteattr(name)}><ssv:Real value={quoteattr(repr(value))}/>"
            "</ssv:Parameter>"
            for name, value in values.items()
        )
        return {
            "parameters.ssv": (
                '<?xml version="1.0" encoding="UTF-8"?>\n'
                "<ssv:ParameterSet "
                'xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues" '
                f'version="1.0" name="estimates">\n  <ssv:Parameters>\n{rows}\n'
                "  </ssv:Parameters>\n</ssv:ParameterSet>\n"
            ),
        }


def _quantity(variable: Any) -> Quantity:
    declared = variable.declaredType

    def number(key: str) -> float | None:
        given = getattr(variable, key)
        if given is None and declared is not None:
            given = getattr(declared, key, None)
        return None if given is None else float(given)

    unit = variable.unit or (declared.unit if declared is not None else None) or ""
    start = None if variable.start is None else float(variable.start)
    return Quantity(variable.name, unit, start, number("min"), number("max"))


@dataclass(frozen=True)
class Unit:
    """An FMU that is unpacked; equal where the files are."""

    sha256: str
    file: str = field(compare=False)
    folder: Path = field(compare=False)
    description: Any = field(compare=False, repr=False)
    instances: OrderedDict[Any, Instance] = field(
        compare=False, repr=False, default_factory=OrderedDict
    )

    def __reduce__(self) -> tuple[Any, ...]:  # another process unpacks it again
        return open_unit, (self.file, self.content, self.sha256)

    @property
    def content(self) -> bytes:
        """The file's content."""
        return (self.folder / "packed").read_bytes()

    @cached_property
    def states(self) -> tuple[Any, ...]:
        """Variables that are continuous states, in the order of the FMU."""
        return tuple(rate.variable.derivative for rate in self.description.derivatives)

    @cached_property
    def rates(self) -> tuple[int, ...]:
        """Value references of their derivatives."""
        return tuple(rate.variable.valueReference for rate in self.description.derivatives)

    def instance(self, parameters: tuple[int, ...], values: bytes) -> Instance:
        """Return an instance with these values of parameters, the bytes of their vector."""
        key = parameters, values
        if key in self.instances:
            self.instances.move_to_end(key)
            return self.instances[key]
        single = self.description.modelExchange.canBeInstantiatedOnlyOncePerProcess
        most = 1 if single else 4 * len(parameters) + 4
        if len(self.instances) >= most:
            instance = self.instances.popitem(last=False)[1]
        else:
            instance = VERSIONS[self.description.fmiVersion](self.description, str(self.folder))
        instance.initialize(parameters, np.frombuffer(values))
        self.instances[key] = instance
        return instance


@dataclass(frozen=True)
class Evaluation:
    """ẋ of an FMU, or outputs of it, at points: a `BlackBox`.

    `parameters`, `inputs` and `outputs` are value references; without `outputs` it is ẋ.
    """

    unit: Unit
    parameters: tuple[int, ...]
    inputs: tuple[int, ...]
    outputs: tuple[int, ...] | None

    @property
    def size(self) -> int:
        """Number of values."""
        return len(self.unit.states if self.outputs is None else self.outputs)

    @property
    def widths(self) -> tuple[int, int, int]:
        """Numbers of states, inputs and parameters."""
        return len(self.unit.states), len(self.inputs), len(self.parameters)

    @cached_property
    def _references(self) -> tuple[Any, Any]:
        """Value references of inputs and of values, as arrays of C."""
        unknown = self.unit.rates if self.outputs is None else self.outputs
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
        with _LOCK:
            for rows, own, p in self._groups(z):
                found[rows] = self._at(own, p)
        return found

    def write_values(self, point: int, values: int) -> None:
        """Write the values at the point at an address to an address; NaN where it has none."""
        nx, nu, count = self.widths
        p = string_at(point + 8 * (nx + nu), 8 * count)
        with _LOCK:
            failed = self._read_at((point, 0, 1), p, lambda own: self._reader(own, values))
        if failed is None or failed:
            (c_double * self.size).from_address(values)[:] = [np.nan] * self.size

    def slopes(self, z: Matrix, groups: Groups) -> Any:
        """Return the slopes (m, size, n) by those of states, inputs and parameters asked for."""
        count = sum(np.array(self.widths)[list(groups)])
        found = np.empty((len(z), self.size, count))
        with _LOCK:
            for rows, own, p in self._groups(z):
                found[rows] = self._slopes(own, p, groups)
        return found

    def curvature(self, z: Matrix) -> np.ndarray:
        """Return central differences (m, size, n, n) of the slopes, n = nx + nu + np."""
        nx, nu, _ = self.widths
        columns = []
        for j, nominal in enumerate(self._nominal):
            h = _WIDER * _step(z[:, j], nominal, _FLOOR if j < nx + nu else 0.0)
            ends = []
            for sign in (1, -1):
                moved = z.copy()
                moved[:, j] += sign * h
                ends.append((moved[:, j], self.slopes(moved, (True, True, True))))
            (up, above), (down, below) = ends
            columns.append((above - below) / (up - down)[:, None, None])
        found = np.stack(columns, axis=-1)
        return (found + np.swapaxes(found, -1, -2)) / 2

    def at_start(self, time: float) -> Vector:
        """Return the values at the FMU's own start, at a time.

        Raises:
            InputError: native code that cannot be loaded, or does not run.
        """
        with _LOCK:
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
        p = z[:, len(self.unit.states) + len(self.inputs) :]
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
            h = _step(value, self._nominal[nx + nu + j])
            up[j], down[j] = value + h, value - h
            columns.append((self._at(z, up) - self._at(z, down)) / (up[j] - down[j]))
        return np.stack(columns, axis=-1)

    def _differences(self, z: Matrix, p: Vector, asked: np.ndarray) -> np.ndarray:
        """Return central differences (m, k, size) by k of the states and inputs."""
        m, every = len(z), np.arange(len(asked))
        moved = np.repeat(z[None, None], 2, axis=0).repeat(len(asked), axis=1)  # (2, k, m, nz)
        h = _step(z[:, asked].T, self._nominal[asked][:, None], _FLOOR)
        moved[0, every, :, asked] += h
        moved[1, every, :, asked] -= h
        found = self._at(moved.reshape(-1, z.shape[1]), p).reshape(2, len(asked), m, self.size)
        wide = moved[0, every, :, asked] - moved[1, every, :, asked]
        return np.moveaxis((found[0] - found[1]) / wide[..., None], 0, 1)

    def _own_slopes(self, z: Matrix, p: Vector, asked: np.ndarray) -> np.ndarray:
        """Return the slopes (m, k, size) by k of the states and inputs that the FMU gives."""
        known = (*(state.valueReference for state in self.unit.states), *self.inputs)
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
        states = tuple(state.valueReference for state in self.unit.states)
        variables = self.unit.description.modelVariables
        given = {v.valueReference: v.nominal for v in variables if v.nominal is not None}
        every = (*states, *self.inputs, *self.parameters)
        return np.array([abs(float(given.get(entry, 1.0))) or 1.0 for entry in every])


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


def open_unit(file: str, content: bytes, sha256: str) -> Unit:
    """Unpack an FMU, once in a process, and read its description; no code of it runs.

    Raises:
        InputError: FMPy is not installed, or a file that is no FMU of FMI 2.0 or 3.0 for Model
            Exchange with code for this computer.
    """
    with _LOCK:
        if sha256 not in _UNITS:
            _UNITS[sha256] = _unpack(file, content, sha256)
        return _UNITS[sha256]


def _unpack(file: str, content: bytes, sha256: str) -> Unit:
    try:
        import fmpy
    except ImportError:
        raise InputError(
            f"{file}: an FMU needs FMPy, which is not installed: pip install 'orthaug[fmu]'."
        ) from None
    if not zipfile.is_zipfile(BytesIO(content)):
        raise InputError(f"{file}: not a zip archive, so it is no FMU; export it again.")
    text = _description(file, content)
    found = re.search(r"fmiVersion\s*=\s*[\"']([^\"']+)", text)
    version = found[1] if found else "without a version"
    if version not in VERSIONS:
        known = " or ".join(VERSIONS)
        raise InputError(f"{file}: FMI {version}; expected {known}. Export the FMU as one of them.")
    try:
        described = fmpy.read_model_description(BytesIO(content), validate=False)
    except Exception as error:  # FMPy says what is wrong by various types
        words = " ".join(str(error).split())
        raise InputError(f"{file}: no description of an FMU can be read ({words}).") from None
    if described.modelExchange is None:
        raise InputError(
            f"{file}: an FMU for co-simulation only, which hides its equations; export it for "
            "Model Exchange."
        )
    if re.search(r"<ModelExchange\b[^>]*providesDirectionalDerivatives=.(true|1)\b", text):
        described.modelExchange.providesDirectionalDerivative = True  # FMPy reads FMI 2.0's name
    if not described.derivatives:
        raise InputError(f"{file}: the FMU has no continuous states; expected at least one.")
    if described.numberOfContinuousStates > len(described.derivatives):
        raise InputError(f"{file}: states that are arrays; export the FMU with scalar states.")
    folder = Path(tempfile.mkdtemp(prefix="orthaug-fmu-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    try:
        (folder / "packed").write_bytes(content)
        fmpy.extract(folder / "packed", folder)
    except Exception as error:
        raise InputError(f"{file}: cannot be unpacked ({error}).") from None
    name = f"{described.modelExchange.modelIdentifier}{fmpy.sharedLibraryExtension}"
    platform = fmpy.platform if version == "2.0" else fmpy.platform_tuple
    if not (folder / "binaries" / platform / name).is_file():
        there = ", ".join(sorted(p.name for p in (folder / "binaries").glob("*"))) or "none"
        raise InputError(
            f"{file}: no code for {platform} in the FMU; it has {there}. Export it for this "
            "computer."
        )
    return Unit(sha256, file, folder, described)


def _description(file: str, content: bytes) -> str:
    """Return the text of modelDescription.xml.

    Raises:
        InputError: an archive without a description.
    """
    with zipfile.ZipFile(BytesIO(content)) as archive:
        if "modelDescription.xml" not in archive.namelist():
            raise InputError(f"{file}: no modelDescription.xml in it, so it is no FMU.")
        return archive.read("modelDescription.xml").decode("utf-8", "replace")
