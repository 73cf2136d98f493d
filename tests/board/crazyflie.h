// What a controller needs of the Crazyflie's firmware, for tests: its types as the firmware has
// them, a clock that a test sets, and a PID controller that only counts.
#ifndef FIRMWARE_H_
#define FIRMWARE_H_
#include <stdbool.h>
#include <stdint.h>

#define CONFIG_ENABLE_THRUST_BAT_COMPENSATED
#define THRUST_MAX 0.2f  // [N]
#define M2T(ms) (ms)
#define DEBUG_PRINT(...)
#define PARAM_GROUP_START(name)
#define PARAM_GROUP_STOP(name)
#define PARAM_ADD(type, name, address) uint8_t* const param_##name = address;
#define LOG_GROUP_START(name)
#define LOG_GROUP_STOP(name)
#define LOG_ADD(type, name, address) const void* const log_##name = address;

typedef uint32_t stabilizerStep_t;
typedef struct {
  float x, y, z;
} Axis3f;
typedef struct {
  uint32_t timestamp;
  float x, y, z;
} point_t;
typedef struct {
  float x, y, z, w;
} quaternion_t;
typedef struct {
  Axis3f acc, gyro;  // [g], [deg/s]
} sensorData_t;
typedef struct {
  quaternion_t attitudeQuaternion;
  point_t position, velocity;
} state_t;
typedef enum { modeDisable = 0, modeAbs, modeVelocity } stab_mode_t;
typedef struct {
  uint32_t timestamp;
  point_t position;
  struct {
    stab_mode_t x, y, z;
  } mode;
} setpoint_t;
typedef enum { controlModeLegacy = 0, controlModeForceTorque, controlModeForce } control_mode_t;
typedef struct {
  float normalizedForces[4];
  control_mode_t controlMode;
} control_t;

uint32_t ticks;
int pids, begun;  // how often the PID controller flew, and began

static inline uint32_t xTaskGetTickCount(void) { return ticks; }
static inline void vTaskDelay(uint32_t time) { (void)time; }
static inline float pmGetBatteryVoltage(void) { return 4.0f; }
static inline void controllerPidInit(void) { ++begun; }
static inline bool controllerPidTest(void) { return true; }
static inline void controllerPid(control_t* control, const setpoint_t* setpoint,
                                 const sensorData_t* sensors, const state_t* state,
                                 const stabilizerStep_t step) {
  (void)setpoint, (void)sensors, (void)state, (void)step;
  control->controlMode = controlModeLegacy;
  ++pids;
}

void controllerOutOfTreeInit(void);
bool controllerOutOfTreeTest(void);
void controllerOutOfTree(control_t* control, const setpoint_t* setpoint,
                         const sensorData_t* sensors, const state_t* state,
                         const stabilizerStep_t step);

// A millisecond with a motion as quadrl has it, the goal, and how old and of which modes (x, y, z) the
// setpoint is. Gives the forces of the motors, and whether the policy made them.
bool millisecond(const float* now, const float* goal, uint32_t age, const int* mode, float* forces) {
  const float degrees = 57.29577951f;
  const state_t state = {
      .attitudeQuaternion = {.x = now[4], .y = now[5], .z = now[6], .w = now[3]},
      .position = {.x = now[0] + goal[0], .y = now[1] + goal[1], .z = now[2] + goal[2]},
      .velocity = {.x = now[7], .y = now[8], .z = now[9]},
  };
  const sensorData_t sensors = {
      .gyro = {now[10] * degrees, now[11] * degrees, now[12] * degrees}};
  const setpoint_t setpoint = {
      .timestamp = ticks - age,
      .position = {.x = goal[0], .y = goal[1], .z = goal[2]},
      .mode = {(stab_mode_t)mode[0], (stab_mode_t)mode[1], (stab_mode_t)mode[2]},
  };
  control_t control = {.controlMode = controlModeLegacy};
  controllerOutOfTree(&control, &setpoint, &sensors, &state, ticks);
  for (int k = 0; k < 4; ++k) forces[k] = control.normalizedForces[k];
  ++ticks;
  return control.controlMode == controlModeForce;
}
#endif
