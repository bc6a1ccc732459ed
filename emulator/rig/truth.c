#include "rig/truth.h"

#include <math.h>
#include <string.h>

#include "plant/units.h"
#include "rig_codec.h"

static uint8_t *begin(transport_frame_t *frame, canid_t identifier) {
    memset(frame, 0, sizeof *frame);
    frame->size = CAN_MTU;
    frame->classic.can_id = identifier | CAN_EFF_FLAG;
    frame->classic.len = 8;
    return frame->classic.data;
}

void truth_pack_fault(unsigned kind, unsigned phase, unsigned leg, bool present, transport_frame_t *frame) {
    const struct rig_truth_fault_t fault = {
        .kind = (uint8_t)kind, .phase = (uint8_t)phase, .leg = (uint8_t)leg, .present = present};
    rig_truth_fault_pack(begin(frame, RIG_TRUTH_FAULT_FRAME_ID), &fault, RIG_TRUTH_FAULT_LENGTH);
    frame->classic.len = RIG_TRUTH_FAULT_LENGTH;
}

unsigned truth_pack(const plant_t *plant, const heat_t *heat, transport_frame_t frames[TRUTH_FRAMES_MAX]) {
    unsigned count = 0;
    struct rig_truth_motion_t motion;
    motion.speed_rpm = rig_truth_motion_speed_rpm_encode(plant->speed_rad_s * RPM_PER_RAD_S);
    motion.torque_nm = rig_truth_motion_torque_nm_encode(plant_torque_Nm(plant));
    rig_truth_motion_pack(begin(&frames[count++], RIG_TRUTH_MOTION_FRAME_ID), &motion, 8);

    struct rig_truth_currents_t currents;
    rig_truth_currents_set_physical_current_a_a(&currents, plant_current_A(plant, 0));
    rig_truth_currents_set_physical_current_b_a(&currents, plant_current_A(plant, 1));
    rig_truth_currents_set_physical_current_c_a(&currents, plant_current_A(plant, 2));
    rig_truth_currents_set_physical_current_d_a(&currents, plant_current_A(plant, 3));
    rig_truth_currents_set_physical_current_e_a(&currents, plant_current_A(plant, 4));
    rig_truth_currents_set_physical_current_f_a(&currents, plant_current_A(plant, 5));
    const unsigned parts = plant->machine->phases > 4 ? 3 : 2;
    for (uint8_t part = 0; part < parts; part++) {
        currents.part = part;
        rig_truth_currents_pack(begin(&frames[count++], RIG_TRUTH_CURRENTS_FRAME_ID), &currents, 8);
    }

    double angle_deg = fmod(plant->rotor_angle_rad * DEG_PER_RAD, 360.0);
    struct rig_truth_bench_t bench;
    rig_truth_bench_set_physical_rotor_angle_deg(&bench, angle_deg < 0.0 ? angle_deg + 360.0 : angle_deg);
    bench.load_torque_nm = rig_truth_bench_load_torque_nm_encode(plant_shaft_torque_Nm(plant));
    bench.bus_voltage_v = rig_truth_bench_bus_voltage_v_encode(plant->bus_voltage_V);
    rig_truth_bench_set_physical_winding_temperature_c(&bench, heat_winding_C(heat));
    rig_truth_bench_set_physical_inverter_temperature_c(&bench, heat_inverter_C(heat));
    for (uint8_t part = 0; part < 2; part++) {
        bench.part = part;
        rig_truth_bench_pack(begin(&frames[count++], RIG_TRUTH_BENCH_FRAME_ID), &bench, 8);
    }
    return count;
}
