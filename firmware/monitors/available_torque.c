/* [SR-09] */
#include "monitors/available_torque.h"

#include "fixed/compiler.h"
#include "fixed/fixed.h"

static void limit(available_torque_side_t *side, int32_t torque_q24, torque_limit_t limit) {
    if (torque_q24 < side->torque_q24) {
        *side = (available_torque_side_t){torque_q24, limit};
    }
}

static available_torque_side_t side_of(const available_torque_input_t *input, bool backward) {
    const bool brakes = backward ? input->speed_q22 > 0 : input->speed_q22 < 0;
    available_torque_side_t side = {input->largest_q24, TORQUE_LIMIT_CURRENT};
    limit(&side, input->by_voltage_q24[backward],
          brakes && input->link_fills ? TORQUE_LIMIT_DC_LINK : TORQUE_LIMIT_VOLTAGE);
    if (brakes) {
        limit(&side, input->by_link_q24, TORQUE_LIMIT_DC_LINK);
    }
    limit(&side, input->by_heat_q24, TORQUE_LIMIT_HEAT);
    limit(&side, input->by_degraded_q24, TORQUE_LIMIT_DEGRADED);
    if (backward && !input->four_quadrant) {
        side = (available_torque_side_t){0, TORQUE_LIMIT_CONTROLLER};
    }
    return side;
}

COLD available_torque_t available_torque(const available_torque_input_t *input) {
    const available_torque_side_t forward = side_of(input, false), backward = side_of(input, true);
    const int32_t error_q24 = input->largest_q24 / AVAILABLE_TORQUE_ERROR;
    const int32_t beyond_forward_q24 = fixed_subtract(input->load_torque_q24, forward.torque_q24);
    const int32_t beyond_backward_q24 = fixed_subtract(-backward.torque_q24, input->load_torque_q24);
    return (available_torque_t){
        .forward = forward,
        .backward = backward,
        .load_exceeds = input->run && (beyond_forward_q24 > error_q24 || beyond_backward_q24 > error_q24),
    };
}
