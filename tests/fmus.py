"""Functional Mock-up Units that tests make, compiled by the C compiler: Model Exchange or co-simulation.

Values of parameters can be set before initialization only, as the standard has it.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest

PARTS = 10  # Euler steps of a step of co-simulation
CODE = r"""
#include <complex.h>
#include <stdlib.h>
#include <string.h>
typedef double complex number;
typedef struct { double p[NP + 1], x[NX], u[NU + 1], time; int relation, ready; } Model;
typedef struct { int needed, ends, nominals, jumps, defined; double next; } Event;

static const double START_P[] = {@start_p@}, START_X[] = {@start_x@};

static void equations(const Model *model, const number *x, const number *u, number *dx, number *y)
{
    const double *p = model->p;
    const double relation = model->relation, t = model->time;
    (void)p; (void)relation; (void)t; (void)u;
@equations@
}

static void start(Model *m)
{
    memset(m, 0, sizeof *m);
    memcpy(m->p, START_P, NP * sizeof(double));
    memcpy(m->x, START_X, sizeof START_X);
}

static double *place(Model *m, unsigned r)
{
    if (r < 100) return m->p + r;
    if (r < 200) return m->x + (r - 100);
    return m->u + (r - 300);
}

static void evaluate(Model *m, unsigned along, double seed, number *dx, number *y)
{
    number x[NX], u[NU + 1];
    for (int i = 0; i < NX; i++) x[i] = m->x[i] + (along == 100u + i ? I * seed : 0);
    for (int i = 0; i < NU; i++) u[i] = m->u[i] + (along == 300u + i ? I * seed : 0);
    equations(m, x, u, dx, y);
}

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
void *fmi2Instantiate(const char *n, int k, const char *g, const char *r, const void *f, int v, int l)
{ Model *m = malloc(sizeof *m); start(m); return m; }
void fmi2FreeInstance(void *c) { free(c); }
int fmi2SetupExperiment(void *c, int a, double b, double t, int d, double e)
{ ((Model *)c)->time = t; return 0; }
int fmi2EnterInitializationMode(void *c) { return 0; }
int fmi2ExitInitializationMode(void *c) { ((Model *)c)->ready = 1; return 0; }
int fmi2Terminate(void *c) { return 0; }
int fmi2Reset(void *c) { start(c); return 0; }
int fmi2GetReal(void *c, const unsigned *r, size_t n, double *v)
{
    number dx[NX], y[NY];
    evaluate(c, 999, 0, dx, y);
    for (size_t i = 0; i < n; i++)
        v[i] = r[i] >= 400 ? creal(y[r[i] - 400])
             : r[i] >= 200 && r[i] < 300 ? creal(dx[r[i] - 200]) : *place(c, r[i]);
    return 0;
}
int fmi2SetReal(void *c, const unsigned *r, size_t n, const double *v)
{
    for (size_t i = 0; i < n; i++) {
        if (r[i] < 100 && ((Model *)c)->ready) return 3;
        *place(c, r[i]) = v[i];
    }
    return 0;
}
int fmi2GetDirectionalDerivative(void *c, const unsigned *z, size_t nz, const unsigned *v, size_t nv,
                                 const double *s, double *out)
{
    number dx[NX], y[NY];
    memset(out, 0, nz * sizeof *out);
    for (size_t j = 0; j < nv; j++) {
        evaluate(c, v[j], 1e-100, dx, y);
        for (size_t i = 0; i < nz; i++)
            out[i] += s[j] * cimag(z[i] >= 400 ? y[z[i] - 400] : dx[z[i] - 200]) / 1e-100;
    }
    return 0;
}
int fmi2EnterEventMode(void *c) { return 0; }
int fmi2NewDiscreteStates(void *c, Event *e)
{
    Model *m = c;
    memset(e, 0, sizeof *e);
    m->relation = m->x[NX - 1] > 0 ? 1 : -1;
    return 0;
}
int fmi2EnterContinuousTimeMode(void *c) { return 0; }
int fmi2CompletedIntegratorStep(void *c, int a, int *b, int *d) { *b = *d = 0; return 0; }
int fmi2SetTime(void *c, double t) { ((Model *)c)->time = t; return 0; }
int fmi2SetContinuousStates(void *c, const double *x, size_t n)
{ memcpy(((Model *)c)->x, x, n * sizeof *x); return 0; }
int fmi2GetDerivatives(void *c, double *dx, size_t n)
{
    number full[NX], y[NY];
    evaluate(c, 999, 0, full, y);
    for (size_t i = 0; i < n; i++) dx[i] = creal(full[i]);
    return 0;
}
int fmi2GetEventIndicators(void *c, double *z, size_t n) { *z = ((Model *)c)->x[NX - 1]; return 0; }
int fmi2GetContinuousStates(void *c, double *x, size_t n)
{ memcpy(x, ((Model *)c)->x, n * sizeof *x); return 0; }
int fmi2GetNominalsOfContinuousStates(void *c, double *x, size_t n)
{ for (size_t i = 0; i < n; i++) x[i] = 1; return 0; }
int fmi2DoStep(void *c, double t, double h, int prior)
{
    Model *m = c;
    number k[NX], y[NY];
    if (!m->ready) return 3;
    for (int i = 0; i < @parts@; i++) {
        evaluate(c, 999, 0, k, y);
        for (int j = 0; j < NX; j++) m->x[j] += h / @parts@ * creal(k[j]);
        m->time = t + (i + 1) * h / @parts@;
    }
    return 0;
}
#define UNUSED(name) int name(void *c, void *a, size_t n, void *b) { return 3; }
UNUSED(fmi2SetDebugLogging) UNUSED(fmi2GetInteger) UNUSED(fmi2GetBoolean) UNUSED(fmi2GetString)
UNUSED(fmi2SetInteger) UNUSED(fmi2SetBoolean) UNUSED(fmi2SetString) UNUSED(fmi2GetFMUstate)
UNUSED(fmi2SetFMUstate) UNUSED(fmi2FreeFMUstate) UNUSED(fmi2SerializedFMUstateSize)
UNUSED(fmi2SerializeFMUstate) UNUSED(fmi2DeSerializeFMUstate)
UNUSED(fmi2SetRealInputDerivatives) UNUSED(fmi2GetRealOutputDerivatives) UNUSED(fmi2CancelStep)
UNUSED(fmi2GetStatus) UNUSED(fmi2GetRealStatus) UNUSED(fmi2GetIntegerStatus)
UNUSED(fmi2GetBooleanStatus) UNUSED(fmi2GetStringStatus)
"""
CODE_3 = r"""
#include <stdbool.h>
void *fmi3InstantiateModelExchange(const char *n, const char *g, const char *r, bool v, bool l,
                                   void *e, void *f)
{ return fmi2Instantiate(n, 0, g, r, f, v, l); }
void *fmi3InstantiateCoSimulation(const char *n, const char *g, const char *r, bool v, bool l, bool e,
                                  bool early, const unsigned *q, size_t nq, void *i, void *f, void *u)
{ return fmi2Instantiate(n, 1, g, r, f, v, l); }
int fmi3DoStep(void *c, double t, double h, bool prior, bool *a, bool *b, bool *d, double *last)
{ *a = *b = *d = false; *last = t + h; return fmi2DoStep(c, t, h, prior); }
void fmi3FreeInstance(void *c) { free(c); }
int fmi3EnterInitializationMode(void *c, bool a, double b, double t, bool d, double e)
{ ((Model *)c)->time = t; return 0; }
int fmi3ExitInitializationMode(void *c) { ((Model *)c)->ready = 1; return 0; }
int fmi3Terminate(void *c) { return 0; }
int fmi3Reset(void *c) { start(c); return 0; }
int fmi3GetFloat64(void *c, const unsigned *r, size_t n, double *v, size_t m)
{ return m == n ? fmi2GetReal(c, r, n, v) : 3; }
int fmi3SetFloat64(void *c, const unsigned *r, size_t n, const double *v, size_t m)
{ return m == n ? fmi2SetReal(c, r, n, v) : 3; }
int fmi3GetDirectionalDerivative(void *c, const unsigned *z, size_t nz, const unsigned *v, size_t nv,
                                 const double *s, size_t ns, double *out, size_t no)
{ return ns == nv && no == nz ? fmi2GetDirectionalDerivative(c, z, nz, v, nv, s, out) : 3; }
int fmi3EnterEventMode(void *c) { return 0; }
int fmi3UpdateDiscreteStates(void *c, bool *a, bool *b, bool *d, bool *e, bool *f, double *g)
{
    Event event;
    *a = *b = *d = *e = *f = false;
    return fmi2NewDiscreteStates(c, &event);
}
int fmi3EnterContinuousTimeMode(void *c) { return 0; }
int fmi3SetTime(void *c, double t) { return fmi2SetTime(c, t); }
int fmi3SetContinuousStates(void *c, const double *x, size_t n)
{ return fmi2SetContinuousStates(c, x, n); }
int fmi3GetContinuousStateDerivatives(void *c, double *dx, size_t n)
{ return fmi2GetDerivatives(c, dx, n); }
UNUSED(fmi3ActivateModelPartition) UNUSED(fmi3CompletedIntegratorStep)
UNUSED(fmi3DeserializeFMUState) UNUSED(fmi3EnterConfigurationMode)
UNUSED(fmi3EnterStepMode) UNUSED(fmi3EvaluateDiscreteStates) UNUSED(fmi3ExitConfigurationMode)
UNUSED(fmi3FreeFMUState) UNUSED(fmi3GetAdjointDerivative) UNUSED(fmi3GetBinary)
UNUSED(fmi3GetBoolean) UNUSED(fmi3GetClock) UNUSED(fmi3GetContinuousStates)
UNUSED(fmi3GetEventIndicators) UNUSED(fmi3GetFMUState) UNUSED(fmi3GetFloat32)
UNUSED(fmi3GetInt16) UNUSED(fmi3GetInt32) UNUSED(fmi3GetInt64) UNUSED(fmi3GetInt8)
UNUSED(fmi3GetIntervalDecimal) UNUSED(fmi3GetIntervalFraction)
UNUSED(fmi3GetNominalsOfContinuousStates) UNUSED(fmi3GetNumberOfContinuousStates)
UNUSED(fmi3GetNumberOfEventIndicators) UNUSED(fmi3GetNumberOfVariableDependencies)
UNUSED(fmi3GetOutputDerivatives) UNUSED(fmi3GetShiftDecimal) UNUSED(fmi3GetShiftFraction)
UNUSED(fmi3GetString) UNUSED(fmi3GetUInt16) UNUSED(fmi3GetUInt32) UNUSED(fmi3GetUInt64)
UNUSED(fmi3GetUInt8) UNUSED(fmi3GetVariableDependencies) UNUSED(fmi3GetVersion)
UNUSED(fmi3InstantiateScheduledExecution)
UNUSED(fmi3SerializeFMUState) UNUSED(fmi3SerializedFMUStateSize) UNUSED(fmi3SetBinary)
UNUSED(fmi3SetBoolean) UNUSED(fmi3SetClock) UNUSED(fmi3SetDebugLogging) UNUSED(fmi3SetFMUState)
UNUSED(fmi3SetFloat32) UNUSED(fmi3SetInt16) UNUSED(fmi3SetInt32) UNUSED(fmi3SetInt64)
UNUSED(fmi3SetInt8) UNUSED(fmi3SetIntervalDecimal) UNUSED(fmi3SetIntervalFraction)
UNUSED(fmi3SetShiftDecimal) UNUSED(fmi3SetShiftFraction) UNUSED(fmi3SetString)
UNUSED(fmi3SetUInt16) UNUSED(fmi3SetUInt32) UNUSED(fmi3SetUInt64) UNUSED(fmi3SetUInt8)
"""


@dataclass(frozen=True)
class Plant:
    """Equations in C on x, u and p: `dx[0] = …; y[0] = …;`, with starts of states and values."""

    states: dict[str, float]
    parameters: dict[str, str]
    """Attributes of `<Real>` by name, `start` among them."""
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    equations: str
    units: tuple[str, ...] = ("kg", "N s/m", "N/m", "J/K", "W/K")

    def described(
        self, *, directional: bool, events: int, version: str, kind: str, listed: bool
    ) -> str:
        """Return modelDescription.xml."""
        if version == "3.0":
            return self._described_3(directional=directional, events=events, kind=kind)
        lines, order = [], []

        def variable(name: str, reference: int, causality: str, change: str, real: str) -> None:
            order.append(name)
            lines.append(
                f'<ScalarVariable name="{name}" valueReference="{reference}" '
                f'causality="{causality}" variability="{change}"><Real {real}/></ScalarVariable>'
            )

        for i, (name, real) in enumerate(self.parameters.items()):
            variable(name, i, "parameter", "fixed", real)
        for i, (name, value) in enumerate(self.states.items()):
            variable(name, 100 + i, "local", "continuous", f'start="{value}"')
        for i, name in enumerate(self.states):
            at = len(self.parameters) + i + 1
            variable(f"der({name})", 200 + i, "local", "continuous", f'derivative="{at}"')
        for i, name in enumerate(self.inputs):
            variable(name, 300 + i, "input", "continuous", 'start="0"')
        for i, name in enumerate(self.outputs):
            variable(name, 400 + i, "output", "continuous", "")
        rates = "".join(
            f'<Unknown index="{order.index(f"der({name})") + 1}"/>' for name in self.states
        )
        seen = "".join(f'<Unknown index="{order.index(name) + 1}"/>' for name in self.outputs)
        states = f"<Derivatives>{rates}</Derivatives>" if listed else ""
        units = "".join(f'<Unit name="{unit}"/>' for unit in self.units)
        return (
            '<?xml version="1.0" encoding="UTF-8"?>\n'
            f'<fmiModelDescription fmiVersion="{version}" modelName="plant" guid="1" '
            f'numberOfEventIndicators="{events}"><{kind} modelIdentifier="plant" '
            f'providesDirectionalDerivative="{str(directional).lower()}"/>'
            f"<UnitDefinitions>{units}</UnitDefinitions>"
            f"<ModelVariables>{''.join(lines)}</ModelVariables><ModelStructure>"
            f"<Outputs>{seen}</Outputs>{states}</ModelStructure>"
            "</fmiModelDescription>"
        )

    def _described_3(self, *, directional: bool, events: int, kind: str) -> str:
        """Return modelDescription.xml of FMI 3.0."""
        groups = {
            "parameter": (0, self.parameters.items(), "fixed"),
            "local": (100, ((n, f'start="{x}"') for n, x in self.states.items()), "continuous"),
            "rate": (200, ((f"der({n})", "") for n in self.states), "continuous"),
            "input": (300, ((n, 'start="0"') for n in self.inputs), "continuous"),
            "output": (400, ((n, "") for n in self.outputs), "continuous"),
        }
        lines = ['<Float64 name="time" valueReference="999" causality="independent"/>']
        for causality, (first, named, change) in groups.items():
            for i, (name, more) in enumerate(named):
                derivative = f' derivative="{100 + i}"' if causality == "rate" else ""
                own = "local" if causality == "rate" else causality
                lines.append(
                    f'<Float64 name="{name}" valueReference="{first + i}" causality="{own}" '
                    f'variability="{change}" {more}{derivative}/>'
                )
        structure = "".join(
            [f'<Output valueReference="{400 + i}"/>' for i in range(len(self.outputs))]
            + [
                f'<ContinuousStateDerivative valueReference="{200 + i}"/>'
                for i in range(len(self.states))
            ]
            + [f'<EventIndicator valueReference="{100 + i}"/>' for i in range(events)]
        )
        units = "".join(f'<Unit name="{unit}"/>' for unit in self.units)
        return (
            '<?xml version="1.0" encoding="UTF-8"?>\n'
            '<fmiModelDescription fmiVersion="3.0" modelName="plant" instantiationToken="1">'
            f'<{kind} modelIdentifier="plant" '
            f'providesDirectionalDerivatives="{str(directional).lower()}"/>'
            f"<UnitDefinitions>{units}</UnitDefinitions>"
            f"<ModelVariables>{''.join(lines)}</ModelVariables>"
            f"<ModelStructure>{structure}</ModelStructure></fmiModelDescription>"
        )

    def build(
        self,
        file: Path,
        *,
        directional: bool = True,
        events: int = 0,
        version: str = "2.0",
        kind: str = "ModelExchange",
        platform: str = "",
        listed: bool = True,
    ) -> Path:
        """Write the FMU; skip the test where there is no compiler."""
        fmpy = pytest.importorskip("fmpy", reason="no FMPy")
        compiler = shutil.which("gcc") or shutil.which("cc") or pytest.skip("no C compiler")
        if sys.platform == "win32":
            pytest.skip("the C compiler of this test is that of Linux or macOS")
        from xml.etree import ElementTree

        code = CODE + (CODE_3 if version == "3.0" else "")
        attributes = [ElementTree.fromstring(f"<r {real}/>") for real in self.parameters.values()]
        for key, text in {
            "start_p": ", ".join([*(real.get("start", "0") for real in attributes), "0"]),
            "start_x": ", ".join(map(str, self.states.values())),
            "equations": self.equations,
            "parts": str(PARTS),
        }.items():
            code = code.replace(f"@{key}@", text)
        sizes = {"NX": self.states, "NP": self.parameters, "NU": self.inputs, "NY": self.outputs}
        source, library = file.with_suffix(".c"), file.with_suffix(".so")
        source.write_text(code)
        command = [compiler, "-O1", "-w", "-shared", "-fPIC", str(source), "-o", str(library)]
        macros = [f"-D{name}={len(group)}" for name, group in sizes.items()]
        subprocess.run([*command, *macros, "-lm"], check=True)
        described = self.described(
            directional=directional, events=events, version=version, kind=kind, listed=listed
        )
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("modelDescription.xml", described)
            name = f"plant{fmpy.sharedLibraryExtension}"
            own = fmpy.platform_tuple if version == "3.0" else fmpy.platform
            archive.write(library, f"binaries/{platform or own}/{name}")
        return file


SPRING = Plant(
    {"x": 0.0, "v": 0.0},
    {
        "m": 'start="1.2" min="0" unit="kg"',
        "c": 'start="1.2" min="0" unit="N s/m"',
        "k": 'start="120" min="0" unit="N/m"',
    },
    ("force",),
    ("position",),
    "dx[0] = x[1]; dx[1] = (u[0] - p[1]*x[1] - p[2]*x[0])/p[0]; y[0] = x[0];",
)
VAN_DER_POL = Plant(
    {"x": 2.0, "v": 0.0},
    {"osc.mu": 'start="0.8"'},
    (),
    ("y",),
    "dx[0] = x[1]; dx[1] = p[0]*(1 - x[0]*x[0])*x[1] - x[0]; y[0] = x[0];",
)
THERMAL = Plant(
    {"wall.T": 20.0, "room.T": 21.0},
    {
        "wall.C": 'start="5" min="0" unit="J/K"',
        "room.C": 'start="2" min="0" unit="J/K"',
        "loss.G": 'start="0.5" min="0" max="50" unit="W/K"',
        "contact.G": 'start="1" min="0" unit="W/K"',
    },
    ("heat", "outside"),
    ("room", "wall"),
    "dx[0] = (p[3]*(x[1] - x[0]) - p[2]*(x[0] - u[1]))/p[0];\n"
    "dx[1] = (u[0] - p[3]*(x[1] - x[0]))/p[1]; y[0] = x[1]; y[1] = x[0];",
)
