"""An FMU 2.0 for co-simulation: the C export behind that standard, compiled here."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from xml.sax.saxutils import quoteattr

from orthaug import __version__
from orthaug._base.checks import free_name
from orthaug._base.errors import InputError
from orthaug.export.c_source import CSource, fields_of, places_of
from orthaug.export.program import Program, Vectors

_WRAPPER = Path(__file__).parent / "templates" / "fmi2.c"
_SOURCES = ("model.c", "fmi2.c")
_PLATFORMS = {"linux": ("linux64", ".so"), "darwin": ("darwin64", ".dylib")}
# Of the files in the archive, so that the same model makes the same archive
_EPOCH = (2020, 1, 1, 0, 0, 0)
_PATIENCE = 300  # seconds that a compiler may take


@dataclass(frozen=True)
class Fmu:
    """`NAME.fmu` with its sources."""

    summary = "an FMU 2.0 for co-simulation, with its sources"

    def files(self, program: Program, vectors: Vectors) -> Mapping[str, str | bytes]:
        inner = replace(program, name="model")
        sources = dict(CSource().files(inner, vectors))
        del sources["check.c"]
        sources |= {
            "fmi2.c": _WRAPPER.read_text(encoding="utf-8"),
            "variables.h": _variables(program),
        }
        folder, ending, library = _compile_library(sources)
        archive = BytesIO()
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
            parts: dict[str, str | bytes] = {"modelDescription.xml": _description(program)}
            parts |= {f"sources/{name}": text for name, text in sources.items()}
            parts[f"binaries/{folder}/{program.name}{ending}"] = library
            for name, content in parts.items():
                packed.writestr(zipfile.ZipInfo(name, _EPOCH), content, zipfile.ZIP_DEFLATED)
        return {f"{program.name}.fmu": archive.getvalue()}

    def usage(self, program: Program) -> str:
        return f"""```python
from fmpy import simulate_fmu

step = {program.sampling_time!r}
result = simulate_fmu("{program.name}.fmu", output_interval=step, stop_time=100 * step)
```

It was compiled for {_target()[0]}; for other platforms compile its `sources/`. A communication
step is the sampling time or a multiple of it. Inputs are held during a step. An output is that of
the current instant, of the state there and the inputs that are set. The entries of the state are
variables that can be set before the run. Where NaN or
infinity comes in, a step is discarded."""


def _target() -> tuple[str, str]:
    """Return folder and ending of the library for this machine.

    Raises:
        InputError: a machine that this is not made for.
    """
    machine = platform.machine().lower() in ("x86_64", "amd64")
    if sys.platform not in _PLATFORMS or not machine:
        raise InputError(
            "an FMU is compiled for 64-bit x86 under Linux or macOS, which this machine is "
            "not; export to c, and compile it where it is to run."
        )
    return _PLATFORMS[sys.platform]


def _compile_library(sources: Mapping[str, str]) -> tuple[str, str, bytes]:
    """Return folder, ending and content of the shared library.

    Raises:
        InputError: no C compiler, or one that fails.
    """
    folder, ending = _target()
    compiler = next(
        filter(None, map(shutil.which, (os.environ.get("CC") or "cc", "gcc", "clang"))), None
    )
    if compiler is None:
        raise InputError(
            "an FMU holds compiled code, and no C compiler was found (cc, gcc, clang); install one."
        )
    with tempfile.TemporaryDirectory() as place:
        for name, text in sources.items():
            (Path(place) / name).write_text(text, encoding="utf-8")
        command = [
            compiler,
            "-std=c99",
            "-O2",
            "-fPIC",
            "-fvisibility=hidden",
            "-shared",
            *_SOURCES,
            "-lm",
            "-o",
            "made",
        ]
        try:
            subprocess.run(
                command, cwd=place, check=True, capture_output=True, text=True, timeout=_PATIENCE
            )
        except (OSError, subprocess.SubprocessError) as error:
            said = (getattr(error, "stderr", "") or str(error)).strip().splitlines()
            raise InputError(
                f"the C compiler {compiler} failed: {said[0] if said else 'without a word'}."
            ) from None
        return folder, ending, (Path(place) / "made").read_bytes()


def _variables(program: Program) -> str:
    """Return the data that the wrapper needs of the model."""
    cases = "\n".join(
        f"    case {i}: return &state->{place};"
        for i, place in enumerate(places_of(fields_of(program)))
    )
    return f"""/* Written by orthaug. */
#define GUID "{_guid(program)}"
#define SAMPLING_TIME {program.sampling_time!r}
#define INPUTS {len(program.inputs)}
#define OUTPUTS {len(program.outputs)}
#define STATES {len(program.states)}

/* An entry of the state. */
static double *place(model_state *state, unsigned number)
{{
    static double none;
    (void)state;
    switch (number) {{
{cases}
    default: return &none;
    }}
}}
"""


def _guid(program: Program) -> str:
    d = program.digest
    return f"{{{d[:8]}-{d[8:12]}-{d[12:16]}-{d[16:20]}-{d[20:32]}}}"


def _description(program: Program) -> str:
    kinds = [
        ("input", "continuous", "", program.inputs),
        ("output", "continuous", "", program.outputs),
    ]
    kinds.append(("local", "continuous", "exact", program.states))
    variables, taken = [], set()
    for causality, variability, initial, signals in kinds:
        for signal in signals:
            name = f"state.{signal.identifier}" if causality == "local" else signal.identifier
            name = free_name(name, taken)
            taken.add(name)
            start = ' start="0"' if causality != "output" else ""
            exact = f' initial="{initial}"' if initial else ""
            unit = f" unit={quoteattr(signal.unit)}" if signal.unit else ""
            variables.append(
                f"    <ScalarVariable name={quoteattr(name)} "
                f'valueReference="{len(variables)}" causality="{causality}" '
                f'variability="{variability}"{exact} description={quoteattr(signal.label)}>'
                f"<Real{unit}{start}/></ScalarVariable>"
            )
    units = dict.fromkeys(s.unit for _, _, _, signals in kinds for s in signals if s.unit)
    named = "".join(f"<Unit name={quoteattr(unit)}/>" for unit in units)
    definitions = f"\n  <UnitDefinitions>{named}</UnitDefinitions>" if named else ""
    first = len(program.inputs) + 1
    outputs = "".join(f'<Unknown index="{first + i}"/>' for i in range(len(program.outputs)))
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="{program.name}" guid="{_guid(program)}"
  description="A fitted model, sha256 {program.digest}" generationTool="orthaug {__version__}"
  variableNamingConvention="structured">
  <CoSimulation modelIdentifier="{program.name}" canHandleVariableCommunicationStepSize="true">
    <SourceFiles>{"".join(f'<File name="{name}"/>' for name in _SOURCES)}</SourceFiles>
  </CoSimulation>{definitions}
  <DefaultExperiment startTime="0" stepSize="{program.sampling_time!r}"/>
  <ModelVariables>
{chr(10).join(variables)}
  </ModelVariables>
  <ModelStructure>
    <Outputs>{outputs}</Outputs>
    <InitialUnknowns>{outputs}</InitialUnknowns>
  </ModelStructure>
</fmiModelDescription>
"""
