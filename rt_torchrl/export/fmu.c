/* An FMU of FMI 2.0 for co-simulation around the functions of rt_torchrl. Written by rt_torchrl; do not edit. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "@HEADER@"

#define COUNT @COUNT@
#define INTERVAL @INTERVAL@
#define GUID "@GUID@"
#if defined _WIN32
#define FMI __declspec(dllexport)
#else
#define FMI
#endif

typedef void *Component;
typedef unsigned int Reference;
enum { OK, WARNING, DISCARD, ERROR, FATAL, PENDING };

typedef struct {
    double values[COUNT];
} Instance;

static const double first[COUNT] = {@VALUES@};

static void output(double *v) { @OUTPUT@ }

static void advance(double t, double *v) { @STEP@ }

static void begin(Instance *one) { memcpy(one->values, first, sizeof first); }

static Instance *new_instance(const char *guid) {
    Instance *one;
    if (strcmp(guid, GUID) != 0) return NULL;
    one = malloc(sizeof *one);
    if (one) begin(one);
    return one;
}

static int get(Instance *one, const Reference r[], size_t n, double x[]) {
    size_t k;
    output(one->values);
    for (k = 0; k < n; k++) {
        if (r[k] >= COUNT) return ERROR;
        x[k] = one->values[r[k]];
    }
    return OK;
}

static int set(Instance *one, const Reference r[], size_t n, const double x[]) {
    size_t k;
    for (k = 0; k < n; k++) {
        if (r[k] >= COUNT) return ERROR;
        one->values[r[k]] = x[k];
    }
    return OK;
}

static int step(Instance *one, double t, double length) {
    double count = length / INTERVAL;
    long k, steps = (long)floor(count + 0.5);
    if (steps < 1 || fabs(count - (double)steps) > 1e-6) return DISCARD; /* no whole number of control intervals */
    for (k = 0; k < steps; k++) advance(t + (double)k * INTERVAL, one->values);
    for (k = 0; k < COUNT; k++)
        if (!(fabs(one->values[k]) < HUGE_VAL)) return ERROR; /* diverged */
    return OK;
}

FMI const char *fmi2GetTypesPlatform(void) { return "default"; }
FMI const char *fmi2GetVersion(void) { return "2.0"; }
FMI int fmi2SetDebugLogging(Component c, int on, size_t n, const char *const names[]) {
    (void)c, (void)on, (void)n, (void)names;
    return OK;
}

FMI Component fmi2Instantiate(const char *name, int kind, const char *guid, const char *place, const void *functions,
                              int visible, int logging) {
    (void)name, (void)place, (void)functions, (void)visible, (void)logging;
    return kind == 1 ? new_instance(guid) : NULL; /* co-simulation alone */
}

FMI void fmi2FreeInstance(Component c) { free(c); }
FMI int fmi2SetupExperiment(Component c, int with, double tolerance, double start, int ends, double stop) {
    (void)c, (void)with, (void)tolerance, (void)start, (void)ends, (void)stop;
    return OK;
}
FMI int fmi2EnterInitializationMode(Component c) { (void)c; return OK; }
FMI int fmi2ExitInitializationMode(Component c) { (void)c; return OK; }
FMI int fmi2Terminate(Component c) { (void)c; return OK; }
FMI int fmi2Reset(Component c) { begin(c); return OK; }

FMI int fmi2GetReal(Component c, const Reference r[], size_t n, double x[]) { return get(c, r, n, x); }
FMI int fmi2SetReal(Component c, const Reference r[], size_t n, const double x[]) { return set(c, r, n, x); }

FMI int fmi2DoStep(Component c, double t, double length, int again) {
    (void)again;
    return step(c, t, length);
}
FMI int fmi2CancelStep(Component c) { (void)c; return ERROR; }

/* There are variables of type Real alone, and none of the optional capabilities. */
FMI int fmi2GetInteger(Component c, const Reference r[], size_t n, int x[]) { (void)c, (void)r, (void)x; return n ? ERROR : OK; }
FMI int fmi2GetBoolean(Component c, const Reference r[], size_t n, int x[]) { (void)c, (void)r, (void)x; return n ? ERROR : OK; }
FMI int fmi2GetString(Component c, const Reference r[], size_t n, const char *x[]) { (void)c, (void)r, (void)x; return n ? ERROR : OK; }
FMI int fmi2SetInteger(Component c, const Reference r[], size_t n, const int x[]) { (void)c, (void)r, (void)x; return n ? ERROR : OK; }
FMI int fmi2SetBoolean(Component c, const Reference r[], size_t n, const int x[]) { (void)c, (void)r, (void)x; return n ? ERROR : OK; }
FMI int fmi2SetString(Component c, const Reference r[], size_t n, const char *const x[]) { (void)c, (void)r, (void)x; return n ? ERROR : OK; }
FMI int fmi2GetFMUstate(Component c, void **s) { (void)c, (void)s; return ERROR; }
FMI int fmi2SetFMUstate(Component c, void *s) { (void)c, (void)s; return ERROR; }
FMI int fmi2FreeFMUstate(Component c, void **s) { (void)c, (void)s; return ERROR; }
FMI int fmi2SerializedFMUstateSize(Component c, void *s, size_t *n) { (void)c, (void)s, (void)n; return ERROR; }
FMI int fmi2SerializeFMUstate(Component c, void *s, char x[], size_t n) { (void)c, (void)s, (void)x, (void)n; return ERROR; }
FMI int fmi2DeSerializeFMUstate(Component c, const char x[], size_t n, void **s) { (void)c, (void)x, (void)n, (void)s; return ERROR; }
FMI int fmi2GetDirectionalDerivative(Component c, const Reference u[], size_t n, const Reference k[], size_t m,
                                     const double dk[], double du[]) {
    (void)c, (void)u, (void)n, (void)k, (void)m, (void)dk, (void)du;
    return ERROR;
}
FMI int fmi2SetRealInputDerivatives(Component c, const Reference r[], size_t n, const int o[], const double x[]) {
    (void)c, (void)r, (void)n, (void)o, (void)x;
    return ERROR;
}
FMI int fmi2GetRealOutputDerivatives(Component c, const Reference r[], size_t n, const int o[], double x[]) {
    (void)c, (void)r, (void)n, (void)o, (void)x;
    return ERROR;
}
FMI int fmi2GetStatus(Component c, int k, int *x) { (void)c, (void)k, (void)x; return DISCARD; }
FMI int fmi2GetRealStatus(Component c, int k, double *x) { (void)c, (void)k, (void)x; return DISCARD; }
FMI int fmi2GetIntegerStatus(Component c, int k, int *x) { (void)c, (void)k, (void)x; return DISCARD; }
FMI int fmi2GetBooleanStatus(Component c, int k, int *x) { (void)c, (void)k, (void)x; return DISCARD; }
FMI int fmi2GetStringStatus(Component c, int k, const char **x) { (void)c, (void)k, (void)x; return DISCARD; }

