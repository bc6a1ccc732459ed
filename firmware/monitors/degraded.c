/* [SR-31] */
#include "monitors/degraded.h"

#include "control/phase_map.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "hal.h"
#include "storage/fault.h"

bool degraded_accepts(const degraded_parameters_t *parameters, degraded_t *degraded, bool run, uint64_t failed,
                      uint32_t phases) {
    const uint64_t endurable = FAULT_BIT(FAULT_PHASE_OPEN) | FAULT_BIT(FAULT_CURRENT_SENSOR);
    const bool one = phases != 0 && (phases & (phases - 1u)) == 0;
    if (!parameters->allowed || !run || degraded->lost != 0 || failed == 0 || (failed & ~endurable) != 0 || !one) {
        return false;
    }
    *degraded = (degraded_t){.lost = phases, .least_q24 = INT32_MAX};
    return true;
}

COLD int32_t degraded_torque_q24(const degraded_parameters_t *parameters, const degraded_t *degraded,
                                 const machine_tables_t *tables, uint32_t electrical) {
    int32_t torque_q24 = 0;
    for (unsigned phase = 0; phase < tables->phases; phase++) {
        const uint32_t angle = electrical - phase * parameters->stroke;
        const bool remains = (degraded->lost >> phase & 1u) == 0;
        if (remains && angle >= HALF_REV && angle - parameters->window.turn_on < parameters->window.width) {
            const int32_t torque = phase_map_torque(tables, angle, parameters->current_limit_q9);
            torque_q24 = fixed_add(torque_q24, phase_map_scale(&tables->torque_format, torque));
        }
    }
    return fixed_clamp(torque_q24, 0, parameters->torque_max_q24);
}

COLD void degraded_step(const degraded_parameters_t *parameters, degraded_t *degraded, const machine_tables_t *tables) {
    if (degraded->lost == 0 || degraded->angle >= DEGRADED_ANGLES) {
        return;
    }
    const uint32_t electrical = degraded->angle * (UINT32_MAX / DEGRADED_ANGLES + 1u);
    const int32_t torque_q24 = degraded_torque_q24(parameters, degraded, tables, electrical);
    degraded->sum_q24 += torque_q24;
    degraded->least_q24 = fixed_min(torque_q24, degraded->least_q24);
    degraded->most_q24 = fixed_max(torque_q24, degraded->most_q24);
    degraded->angle++;
    if (degraded->angle == DEGRADED_ANGLES) {
        degraded->mean_q24 = (int32_t)(degraded->sum_q24 / (int32_t)DEGRADED_ANGLES);
    }
}

int32_t degraded_torque_limit_q24(const degraded_t *degraded) {
    return degraded->lost != 0 && degraded->angle >= DEGRADED_ANGLES ? degraded->most_q24 : INT32_MAX;
}
