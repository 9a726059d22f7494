
/* DISCON, the interface of Bladed, around the controller above. The controller is a variable of this library: each
 * turbine of a simulation needs a copy of the file. */

#include <stdio.h>

#define DT @DT@
#define GEAR_RATIO @GEAR_RATIO@
#define DEGREES @DEGREES@
#define RECORD(number) avrSWAP[(number) - 1]
#define READ(number) (double)RECORD(number)
#define REFUSE(...) do { *aviFAIL = -1; snprintf(avcMSG, room, "@NAME@: " __VA_ARGS__); return; } while (0)

enum { @RECORDS@ };

/* Brake, yaw torque, pitch rate, yaw rate, overrides of pitch and torque, logging, resistance, loads, slip. */
static const int not_used[] = {36, 41, 46, 48, 55, 56, 65, 72, 79, 80, 81};

#ifdef _WIN32
__declspec(dllexport)
#endif
void DISCON(float *avrSWAP, int *aviFAIL, char *accINFILE, char *avcOUTNAME, char *avcMSG)
{
    static @NAME@_state state;
    static double start;
    const size_t room = RECORD(MESSAGE_LENGTH) > 0.0f ? (size_t)RECORD(MESSAGE_LENGTH) : 0;
    const long status = lrintf(RECORD(STATUS));
    const double t = READ(TIME), dt = READ(COMMUNICATION_INTERVAL), torque = READ(GENERATOR_TORQUE);
    const double pitch = READ(PITCH_1) * DEGREES, measured[] = {@MEASURED@};
    double due, action[2], sum = torque + pitch;
    size_t k;

    (void)accINFILE, (void)avcOUTNAME;
    *aviFAIL = 0;
    if (room > 0) avcMSG[0] = '\0';
    if (status == -1) return; /* the simulation ends */
    if (status < -1) REFUSE("restart files (iStatus %ld) are not supported; simulate from the start.", status);
    if (fabs(dt - DT) > 1e-6 * DT)
        REFUSE("the communication interval is %g s and must be %g s, such as DLL_DT of ServoDyn.", dt, DT);
    if (RECORD(RATE_ACTUATOR) > 0.5f) REFUSE("record 10 asks for pitch rates; only pitch angles are demanded.");
    for (k = 0; k < sizeof measured / sizeof *measured; k++) sum += measured[k];
    if (!isfinite(sum)) REFUSE("a speed, the torque or the pitch is not finite at t = %g s.", t);
    if (status == 0 || state.steps == 0) {
        @NAME@_init(&state, measured);
        @START@
        start = t;
    }
    due = start + DT * (double)state.steps;
    if (fabs(t - due) > 1e-3 * DT + 1e-6 * fabs(t)) /* the time is in single precision */
        REFUSE("called at t = %g s instead of %g s; call it every %g s.", t, due, DT);
    @NAME@_step(&state, measured, action);
    for (k = 0; k < sizeof not_used / sizeof *not_used; k++) RECORD(not_used[k]) = 0.0f;
    RECORD(GENERATOR_ON) = 1.0f;
    RECORD(DEMANDED_TORQUE) = (float)action[@TORQUE@];
    for (k = DEMANDED_PITCH_1; k <= DEMANDED_PITCH; k++) RECORD(k) = (float)(action[@PITCH@] / DEGREES);
}
