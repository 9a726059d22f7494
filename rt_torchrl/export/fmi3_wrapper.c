/* FMI 3.0 for co-simulation. */

FMI const char *fmi3GetVersion(void) { return "3.0"; }
FMI int fmi3SetDebugLogging(Component c, bool on, size_t n, const char *const names[]) {
    (void)c, (void)on, (void)n, (void)names;
    return OK;
}

FMI Component fmi3InstantiateCoSimulation(const char *name, const char *token, const char *place, bool visible,
                                          bool logging, bool events, bool early, const Reference between[], size_t n,
                                          void *environment, void (*log)(void), void (*update)(void)) {
    (void)name, (void)place, (void)visible, (void)logging, (void)early, (void)between, (void)n;
    (void)environment, (void)log, (void)update;
    return events ? NULL : new_instance(token); /* without events */
}
FMI Component fmi3InstantiateModelExchange(const char *name, const char *token, const char *place, bool visible,
                                           bool logging, void *environment, void (*log)(void)) {
    (void)name, (void)token, (void)place, (void)visible, (void)logging, (void)environment, (void)log;
    return NULL;
}
FMI Component fmi3InstantiateScheduledExecution(const char *name, const char *token, const char *place, bool visible,
                                                bool logging, void *environment, void (*log)(void),
                                                void (*update)(void), void (*lock)(void), void (*unlock)(void)) {
    (void)name, (void)token, (void)place, (void)visible, (void)logging, (void)environment, (void)log;
    (void)update, (void)lock, (void)unlock;
    return NULL;
}
FMI void fmi3FreeInstance(Component c) { free(c); }

FMI int fmi3EnterInitializationMode(Component c, bool with, double tolerance, double start, bool ends, double stop) {
    (void)with, (void)tolerance, (void)ends, (void)stop;
    ((Instance *)c)->t = start;
    return OK;
}
FMI int fmi3ExitInitializationMode(Component c) { (void)c; return OK; }
FMI int fmi3Terminate(Component c) { (void)c; return OK; }
FMI int fmi3Reset(Component c) { begin(c); return OK; }

FMI int fmi3GetFloat64(Component c, const Reference r[], size_t n, double x[], size_t m) {
    return n == m ? get(c, r, n, x) : ERROR;
}
FMI int fmi3SetFloat64(Component c, const Reference r[], size_t n, const double x[], size_t m) {
    return n == m ? set(c, r, n, x) : ERROR;
}

FMI int fmi3DoStep(Component c, double t, double length, bool kept, bool *event, bool *ends, bool *early, double *last) {
    int found = step(c, t, length);
    (void)kept;
    *event = *ends = *early = false;
    *last = ((Instance *)c)->t;
    return found;
}

/* There are variables of type Float64 alone, and none of the optional capabilities. */
#define NO_VARIABLES(NAME, TYPE) \
    FMI int fmi3Get##NAME(Component c, const Reference r[], size_t n, TYPE x[], size_t m) { \
        (void)c, (void)r, (void)x, (void)m; \
        return n ? ERROR : OK; \
    } \
    FMI int fmi3Set##NAME(Component c, const Reference r[], size_t n, const TYPE x[], size_t m) { \
        (void)c, (void)r, (void)x, (void)m; \
        return n ? ERROR : OK; \
    }
NO_VARIABLES(Float32, float)
NO_VARIABLES(Int8, int8_t)
NO_VARIABLES(UInt8, uint8_t)
NO_VARIABLES(Int16, int16_t)
NO_VARIABLES(UInt16, uint16_t)
NO_VARIABLES(Int32, int32_t)
NO_VARIABLES(UInt32, uint32_t)
NO_VARIABLES(Int64, int64_t)
NO_VARIABLES(UInt64, uint64_t)
NO_VARIABLES(Boolean, bool)
typedef const char *Text;
NO_VARIABLES(String, Text)
FMI int fmi3GetBinary(Component c, const Reference r[], size_t n, size_t s[], const uint8_t *x[], size_t m) {
    (void)c, (void)r, (void)s, (void)x, (void)m;
    return n ? ERROR : OK;
}
FMI int fmi3SetBinary(Component c, const Reference r[], size_t n, const size_t s[], const uint8_t *const x[], size_t m) {
    (void)c, (void)r, (void)s, (void)x, (void)m;
    return n ? ERROR : OK;
}
FMI int fmi3GetClock(Component c, const Reference r[], size_t n, bool x[]) { (void)c, (void)r, (void)x; return n ? ERROR : OK; }
FMI int fmi3SetClock(Component c, const Reference r[], size_t n, const bool x[]) { (void)c, (void)r, (void)x; return n ? ERROR : OK; }

#define REFUSED(NAME, ...) \
    FMI int fmi3##NAME(Component c, __VA_ARGS__) { \
        (void)c; \
        return ERROR; \
    }
#define REFUSED_ALWAYS(NAME) \
    FMI int fmi3##NAME(Component c) { \
        (void)c; \
        return ERROR; \
    }
REFUSED_ALWAYS(EnterEventMode)
REFUSED_ALWAYS(EnterConfigurationMode)
REFUSED_ALWAYS(ExitConfigurationMode)
REFUSED_ALWAYS(EvaluateDiscreteStates)
REFUSED_ALWAYS(EnterContinuousTimeMode)
REFUSED_ALWAYS(EnterStepMode)
REFUSED(GetNumberOfVariableDependencies, Reference r, size_t *n)
REFUSED(GetVariableDependencies, Reference r, size_t k[], Reference x[], size_t l[], int kinds[], size_t n)
REFUSED(GetFMUState, void **s)
REFUSED(SetFMUState, void *s)
REFUSED(FreeFMUState, void **s)
REFUSED(SerializedFMUStateSize, void *s, size_t *n)
REFUSED(SerializeFMUState, void *s, uint8_t x[], size_t n)
REFUSED(DeserializeFMUState, const uint8_t x[], size_t n, void **s)
REFUSED(GetDirectionalDerivative, const Reference u[], size_t n, const Reference k[], size_t m, const double dk[], size_t p, double du[], size_t q)
REFUSED(GetAdjointDerivative, const Reference u[], size_t n, const Reference k[], size_t m, const double du[], size_t p, double dk[], size_t q)
REFUSED(GetIntervalDecimal, const Reference r[], size_t n, double x[], int kinds[])
REFUSED(GetIntervalFraction, const Reference r[], size_t n, uint64_t x[], uint64_t y[], int kinds[])
REFUSED(GetShiftDecimal, const Reference r[], size_t n, double x[])
REFUSED(GetShiftFraction, const Reference r[], size_t n, uint64_t x[], uint64_t y[])
REFUSED(SetIntervalDecimal, const Reference r[], size_t n, const double x[])
REFUSED(SetIntervalFraction, const Reference r[], size_t n, const uint64_t x[], const uint64_t y[])
REFUSED(SetShiftDecimal, const Reference r[], size_t n, const double x[])
REFUSED(SetShiftFraction, const Reference r[], size_t n, const uint64_t x[], const uint64_t y[])
REFUSED(UpdateDiscreteStates, bool *again, bool *ends, bool *nominals, bool *states, bool *timed, double *t)
REFUSED(CompletedIntegratorStep, bool kept, bool *event, bool *ends)
REFUSED(SetTime, double t)
REFUSED(SetContinuousStates, const double x[], size_t n)
REFUSED(GetContinuousStateDerivatives, double x[], size_t n)
REFUSED(GetEventIndicators, double x[], size_t n)
REFUSED(GetContinuousStates, double x[], size_t n)
REFUSED(GetNominalsOfContinuousStates, double x[], size_t n)
REFUSED(GetNumberOfEventIndicators, size_t *n)
REFUSED(GetNumberOfContinuousStates, size_t *n)
REFUSED(GetOutputDerivatives, const Reference r[], size_t n, const int32_t o[], double x[], size_t m)
REFUSED(ActivateModelPartition, Reference clock, double t)

