/* FMI 2.0 for co-simulation on top of the exported step. Written by orthaug.
 *
 * Inputs are held during a step. An output is that of the current instant: of the state there and of the inputs that
 * are set. A step takes the sampling time or a multiple of it.
 */
#include "model.h"
#include "variables.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#elif defined __GNUC__
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif

typedef unsigned int reference;
typedef const char *text;
typedef enum { OK, WARNING, DISCARD, ERROR, FATAL, PENDING } status;

typedef struct {
    model_state state;
    double u[INPUTS + 1];
} instance;

/* Inputs come first, then outputs, then the state. */
enum { FIRST_OUTPUT = INPUTS, FIRST_STATE = INPUTS + OUTPUTS, ALL = INPUTS + OUTPUTS + STATES };

EXPORT text fmi2GetTypesPlatform(void) { return "default"; }
EXPORT text fmi2GetVersion(void) { return "2.0"; }
EXPORT status fmi2SetDebugLogging(void *c, int on, size_t n, const text categories[])
{
    (void)c, (void)on, (void)n, (void)categories;
    return OK;
}

EXPORT void *fmi2Instantiate(text name, int type, text guid, text resources, const void *functions, int visible, int logging)
{
    instance *made;
    (void)name, (void)resources, (void)functions, (void)visible, (void)logging;
    if (type != 1 || guid == NULL || strcmp(guid, GUID) != 0) return NULL;
    made = calloc(1, sizeof *made);
    if (made != NULL) model_start(&made->state);
    return made;
}

EXPORT void fmi2FreeInstance(void *c) { free(c); }

EXPORT status fmi2SetupExperiment(void *c, int tolerance_defined, double tolerance, double start, int stop_defined, double stop)
{
    (void)c, (void)tolerance_defined, (void)tolerance, (void)start, (void)stop_defined, (void)stop;
    return OK;
}
EXPORT status fmi2EnterInitializationMode(void *c) { (void)c; return OK; }
EXPORT status fmi2ExitInitializationMode(void *c) { (void)c; return OK; }
EXPORT status fmi2Terminate(void *c) { (void)c; return OK; }
EXPORT status fmi2Reset(void *c)
{
    memset(c, 0, sizeof(instance));
    model_start(&((instance *)c)->state);
    return OK;
}

EXPORT status fmi2GetReal(void *c, const reference which[], size_t n, double values[])
{
    instance *own = c;
    model_state ahead = own->state;
    double y[OUTPUTS];
    size_t i;
    model_step(&ahead, own->u, y);
    for (i = 0; i < n; i++) {
        if (which[i] >= ALL) return ERROR;
        if (which[i] >= FIRST_STATE) values[i] = *place(&own->state, which[i] - FIRST_STATE);
        else values[i] = which[i] >= FIRST_OUTPUT ? y[which[i] - FIRST_OUTPUT] : own->u[which[i]];
    }
    return OK;
}

EXPORT status fmi2SetReal(void *c, const reference which[], size_t n, const double values[])
{
    instance *own = c;
    size_t i;
    for (i = 0; i < n; i++) {
        if (which[i] < FIRST_OUTPUT) own->u[which[i]] = values[i];
        else if (which[i] >= FIRST_STATE && which[i] < ALL) *place(&own->state, which[i] - FIRST_STATE) = values[i];
        else return ERROR;
    }
    return OK;
}

EXPORT status fmi2DoStep(void *c, double now, double size, int last)
{
    instance *own = c;
    const double steps = size / SAMPLING_TIME, whole = floor(steps + 0.5);
    double y[OUTPUTS];
    long k;
    (void)now, (void)last;
    if (!(whole >= 1) || whole > 1e9 || fabs(steps - whole) > 1e-3) return ERROR;
    for (k = 0; k < (long)whole; k++) {
        model_step(&own->state, own->u, y);
        if (own->state.flag) return DISCARD;
    }
    return OK;
}

EXPORT status fmi2CancelStep(void *c) { (void)c; return ERROR; }

/* There are no variables of other types, and none of the optional capabilities. */
#define NO_VALUES(kind, type)                                                                                      \
    EXPORT status fmi2Get##kind(void *c, const reference which[], size_t n, type values[])                         \
    {                                                                                                              \
        (void)c, (void)which, (void)values;                                                                        \
        return n ? ERROR : OK;                                                                                     \
    }                                                                                                              \
    EXPORT status fmi2Set##kind(void *c, const reference which[], size_t n, const type values[])                   \
    {                                                                                                              \
        (void)c, (void)which, (void)values;                                                                        \
        return n ? ERROR : OK;                                                                                     \
    }
NO_VALUES(Integer, int)
NO_VALUES(Boolean, int)
NO_VALUES(String, text)

#define NO_STATUS(kind, type)                                                                                      \
    EXPORT status fmi2Get##kind##Status(void *c, int what, type *value)                                            \
    {                                                                                                              \
        (void)c, (void)what, (void)value;                                                                          \
        return DISCARD;                                                                                            \
    }
NO_STATUS(, status)
NO_STATUS(Real, double)
NO_STATUS(Integer, int)
NO_STATUS(Boolean, int)
NO_STATUS(String, text)

#define NO_STATE(name, second, third)                                                                              \
    EXPORT status fmi2##name(void *c, second a, third b)                                                           \
    {                                                                                                              \
        (void)c, (void)a, (void)b;                                                                                 \
        return ERROR;                                                                                              \
    }
NO_STATE(SerializedFMUstateSize, void *, size_t *)
EXPORT status fmi2GetFMUstate(void *c, void **state) { (void)c, (void)state; return ERROR; }
EXPORT status fmi2SetFMUstate(void *c, void *state) { (void)c, (void)state; return ERROR; }
EXPORT status fmi2FreeFMUstate(void *c, void **state) { (void)c, (void)state; return ERROR; }
EXPORT status fmi2SerializeFMUstate(void *c, void *state, char bytes[], size_t n)
{
    (void)c, (void)state, (void)bytes, (void)n;
    return ERROR;
}
EXPORT status fmi2DeSerializeFMUstate(void *c, const char bytes[], size_t n, void **state)
{
    (void)c, (void)state, (void)bytes, (void)n;
    return ERROR;
}
EXPORT status fmi2GetDirectionalDerivative(
    void *c, const reference unknown[], size_t n, const reference known[], size_t m, const double seed[], double values[])
{
    (void)c, (void)unknown, (void)n, (void)known, (void)m, (void)seed, (void)values;
    return ERROR;
}
EXPORT status fmi2SetRealInputDerivatives(void *c, const reference which[], size_t n, const int order[], const double values[])
{
    (void)c, (void)which, (void)n, (void)order, (void)values;
    return ERROR;
}
EXPORT status fmi2GetRealOutputDerivatives(void *c, const reference which[], size_t n, const int order[], double values[])
{
    (void)c, (void)which, (void)n, (void)order, (void)values;
    return ERROR;
}
