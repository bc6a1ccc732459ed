#include "control/commutation.h"

#include "control/phase_map.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"

/* 2^32 / phases as (2^32 - phases) / phases + 1, for a 32-bit division. */
uint32_t commutation_stroke(unsigned phases) {
    return (0u - phases) / phases + 1u;
}

commutation_parameters_t commutation_configure(const commutation_angles_t *angles, unsigned phases,
                                               unsigned rotor_poles) {
    const uint32_t stroke = commutation_stroke(phases);
    const uint32_t turn_on = angles->turn_on;
    const uint32_t active = angles->turn_off > turn_on ? angles->turn_off - turn_on : 0;
    const uint32_t available = angles->outgoing_off > turn_on ? angles->outgoing_off - turn_on : 0;
    return (commutation_parameters_t){
        .phases = phases,
        .rotor_poles = rotor_poles,
        .stroke = stroke,
        .turn_on = turn_on,
        /* Three strokes are one LSB short of a revolution: a window of one stroke is widened to close that gap. */
        .active_width = active == stroke ? stroke + 1 : active,
        .available_width = fixed_max_u32(available, active),
    };
}

COLD bool commutation_drives_forward(const commutation_parameters_t *parameters, const machine_tables_t *tables,
                                     int32_t current_q9) {
    int32_t most = 0, least_early = INT32_MAX; /* units of the tables */
    for (unsigned i = 0; i < COMMUTATION_ANGLES; i++) {
        commutation_t commutation = {.electrical = parameters->turn_on + i * (parameters->stroke / COMMUTATION_ANGLES)};
        commutation_find(parameters, &commutation);
        bool early = false;
        int32_t torque = 0;
        for (unsigned phase = 0; phase < parameters->phases; phase++) {
            if (phase == commutation.active || phase == commutation.outgoing) {
                const uint32_t angle = commutation_angle(parameters, &commutation, phase);
                torque += phase_map_torque(tables, angle, current_q9);
                early = early || phase_map_mirrored(angle);
            }
        }
        most = fixed_max(most, torque);
        if (early) {
            least_early = fixed_min(least_early, torque);
        }
    }
    return least_early >= most / 4;
}

void commutation_find(const commutation_parameters_t *parameters, commutation_t *commutation) {
    /* Complete strokes since turn-on of phase 0: the phase turned on last, and its angle past turn-on. A number of
     * phases that has changed in memory is no index beyond the phases. */
    const uint32_t since_phase_0_on = commutation->electrical - parameters->turn_on;
    const unsigned newest = (unsigned)(((uint64_t)since_phase_0_on * parameters->phases) >> 32) % HAL_PHASES_MAX;
    const uint32_t since_on = since_phase_0_on - newest * parameters->stroke;
    unsigned active = COMMUTATION_NONE;
    unsigned outgoing = COMMUTATION_NONE;
    if (since_on < parameters->active_width) {
        active = newest;
        const unsigned previous = LIKELY(newest > 0) ? newest - 1 : (parameters->phases - 1) % HAL_PHASES_MAX;
        if (since_on + parameters->stroke < parameters->available_width) { /* at most two strokes: no overflow */
            outgoing = previous;
        }
    } else if (since_on < parameters->available_width) {
        outgoing = newest;
    }
    commutation->active = active;
    commutation->outgoing = outgoing;
}
