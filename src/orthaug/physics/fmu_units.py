"""FMUs that are unpacked, with their descriptions and instances."""

from __future__ import annotations

import atexit
import re
import shutil
import tempfile
import threading
import zipfile
from collections import OrderedDict
from dataclasses import dataclass, field
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug.physics.fmu_instances import VERSIONS, Instance

_UNITS: dict[str, Unit] = {}
NATIVE_CODE = threading.RLock()
"""Of all native code: FMUs need not be safe for threads."""


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

    @property
    def advances(self) -> bool:
        """True if it is for co-simulation alone, and integrates by itself."""
        return self.description.modelExchange is None

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
        full = len(self.instances) >= most
        instance = self.instances.popitem(last=False)[1] if full else self._new_instance()
        instance.initialize(parameters, np.frombuffer(values))
        self.instances[key] = instance
        return instance

    @cached_property
    def stepper(self) -> Instance:
        """The instance of an FMU for co-simulation."""
        return self._new_instance()

    def _new_instance(self) -> Instance:
        return VERSIONS[self.description.fmiVersion](self.description, str(self.folder))


def open_unit(file: str, content: bytes, sha256: str) -> Unit:
    """Unpack an FMU, once in a process, and read its description; no code of it runs.

    Raises:
        InputError: FMPy is not installed, or a file that is no FMU of FMI 2.0 or 3.0 for Model
            Exchange with code for this computer.
    """
    with NATIVE_CODE:
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
    kind = described.modelExchange or described.coSimulation
    if kind is None:
        raise InputError(
            f"{file}: an FMU for scheduled execution only; export it for Model Exchange or "
            "co-simulation."
        )
    if described.modelExchange and re.search(
        r"<ModelExchange\b[^>]*providesDirectionalDerivatives=.(true|1)\b", text
    ):
        described.modelExchange.providesDirectionalDerivative = True  # FMPy reads FMI 2.0's name
    if described.modelExchange and not described.derivatives:
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
    name = f"{kind.modelIdentifier}{fmpy.sharedLibraryExtension}"
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
