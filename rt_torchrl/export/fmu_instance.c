/* An FMU around the functions of rt_torchrl. Written by rt_torchrl; do not edit. */

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
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
    double t;
} Instance;

static const double first[COUNT] = {@VALUES@};

static void output(double *v) { @OUTPUT@ }

static void advance(double t, double *v) { @STEP@ }

static void begin(Instance *one) {
    memcpy(one->values, first, sizeof first);
    one->t = 0.0;
}

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
        if (r[k] > COUNT) return ERROR;
        x[k] = r[k] == COUNT ? one->t : one->values[r[k]]; /* the time comes last */
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
    one->t = t + length;
    for (k = 0; k < COUNT; k++)
        if (!(fabs(one->values[k]) < HUGE_VAL)) return ERROR; /* diverged */
    return OK;
}

