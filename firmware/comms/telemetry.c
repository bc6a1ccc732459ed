#include "comms/telemetry.h"

#include "comms/counter.h"
#include "comms/units.h"
#include "drive_codec.h"

#define LAWS_CYCLES 10
#define HEARTBEAT_CYCLES 100
#define FAULT_CYCLES 100

void telemetry_init(telemetry_t *telemetry, uint8_t phases, uint32_t control_rate_hz, uint32_t time_us) {
    *telemetry = (telemetry_t){.phases = phases, .control_rate_hz = control_rate_hz, .next_us = time_us};
}

/* A frame to be packed into; the codec's pack functions write `length` bytes of data. */
static hal_can_frame_t frame_of(uint32_t identifier, uint8_t length) {
    return (hal_can_frame_t){.identifier = identifier, .length = length};
}

static void put_together(telemetry_t *telemetry, const hal_can_frame_t *frames, unsigned count) {
    if (frame_queue_room(&telemetry->queue) < count) {
        counter_add(&telemetry->dropped, count);
        return;
    }
    for (unsigned i = 0; i < count; i++) {
        frame_queue_put(&telemetry->queue, &frames[i]);
    }
}

static hal_can_frame_t status_frame(const telemetry_t *telemetry, const telemetry_snapshot_t *snapshot) {
    struct drive_status_t message = {0};
    drive_status_set_time_us(&message, snapshot->time_us);
    drive_status_set_state(&message, snapshot->state);
    drive_status_set_controller(&message, snapshot->controller);
    drive_status_set_fault(&message, snapshot->fault);
    drive_status_set_voltage_saturated(&message, snapshot->voltage_saturated);
    drive_status_set_cycle(&message, telemetry->cycle);
    hal_can_frame_t frame = frame_of(DRIVE_STATUS_FRAME_ID, DRIVE_STATUS_LENGTH);
    drive_status_pack(frame.data, &message, sizeof frame.data);
    return frame;
}

static hal_can_frame_t motion_frame(const telemetry_snapshot_t *snapshot) {
    struct drive_motion_t message = {0};
    drive_motion_set_speed_rpm(&message, units_milli_rpm(snapshot->speed_q22));
    drive_motion_set_speed_reference_rpm(&message, units_milli_rpm(snapshot->speed_reference_q22));
    drive_motion_set_rotor_angle_deg(&message, units_angle_u16(snapshot->rotor_angle));
    hal_can_frame_t frame = frame_of(DRIVE_MOTION_FRAME_ID, DRIVE_MOTION_LENGTH);
    drive_motion_pack(frame.data, &message, sizeof frame.data);
    return frame;
}

static hal_can_frame_t torque_frame(const telemetry_snapshot_t *snapshot) {
    struct drive_torque_t message = {0};
    drive_torque_set_torque_reference_nm(&message, units_torque_q8(snapshot->torque_reference_q24));
    drive_torque_set_torque_estimate_nm(&message, units_torque_q8(snapshot->torque_estimate_q24));
    drive_torque_set_load_torque_estimate_nm(&message, units_torque_q8(snapshot->load_torque_estimate_q24));
    drive_torque_set_bus_voltage_v(&message, snapshot->bus_voltage_q6);
    hal_can_frame_t frame = frame_of(DRIVE_TORQUE_FRAME_ID, DRIVE_TORQUE_LENGTH);
    drive_torque_pack(frame.data, &message, sizeof frame.data);
    return frame;
}

static hal_can_frame_t currents_frame(const telemetry_snapshot_t *snapshot) {
    struct drive_currents_t message = {0};
    drive_currents_set_current_a_a(&message, snapshot->current_q9[0]);
    drive_currents_set_current_b_a(&message, snapshot->current_q9[1]);
    drive_currents_set_current_c_a(&message, snapshot->current_q9[2]);
    drive_currents_set_current_d_a(&message, snapshot->current_q9[3]);
    hal_can_frame_t frame = frame_of(DRIVE_CURRENTS_FRAME_ID, DRIVE_CURRENTS_LENGTH);
    drive_currents_pack(frame.data, &message, sizeof frame.data);
    return frame;
}

static hal_can_frame_t bp_pid_frame(const telemetry_snapshot_t *snapshot) {
    struct drive_bp_pid_t message = {0};
    drive_bp_pid_set_kp_per_nm(&message, snapshot->kp_q15);
    drive_bp_pid_set_ki_per_nm(&message, snapshot->ki_q15);
    drive_bp_pid_set_kd_per_nm(&message, snapshot->kd_q15);
    drive_bp_pid_set_duty(&message, snapshot->duty_q15);
    hal_can_frame_t frame = frame_of(DRIVE_BP_PID_FRAME_ID, DRIVE_BP_PID_LENGTH);
    drive_bp_pid_pack(frame.data, &message, sizeof frame.data);
    return frame;
}

static hal_can_frame_t trim_frame(const telemetry_snapshot_t *snapshot) {
    struct drive_trim_t message = {0};
    drive_trim_set_trim_torque_nm(&message, units_torque_q8(snapshot->trim_torque_q24));
    drive_trim_set_misalignment_deg(&message, units_deviation_q20(snapshot->misalignment));
    drive_trim_set_torque_missing_nm(&message, units_torque_q8(snapshot->torque_missing_q24));
    drive_trim_set_observer_bandwidth_rad_s(&message, snapshot->observer_bandwidth_rad_s);
    hal_can_frame_t frame = frame_of(DRIVE_TRIM_FRAME_ID, DRIVE_TRIM_LENGTH);
    drive_trim_pack(frame.data, &message, sizeof frame.data);
    return frame;
}

static hal_can_frame_t fault_cause_frame(const fault_record_t *fault) {
    struct drive_fault_cause_t message = {0};
    drive_fault_cause_set_time_us(&message, fault->time_us);
    drive_fault_cause_set_fault(&message, fault->fault);
    drive_fault_cause_set_state(&message, fault->state);
    drive_fault_cause_set_checks(&message, fault->checks);
    hal_can_frame_t frame = frame_of(DRIVE_FAULT_CAUSE_FRAME_ID, DRIVE_FAULT_CAUSE_LENGTH);
    drive_fault_cause_pack(frame.data, &message, sizeof frame.data);
    return frame;
}

static hal_can_frame_t fault_snapshot_frame(const fault_record_t *fault) {
    struct drive_fault_snapshot_t message = {0};
    drive_fault_snapshot_set_speed_rpm(&message, units_quarter_rpm(units_milli_rpm(fault->speed_q22)));
    drive_fault_snapshot_set_bus_voltage_v(&message, fault->bus_voltage_q6);
    drive_fault_snapshot_set_current_max_a(&message, fault->current_max_q9);
    drive_fault_snapshot_set_torque_reference_nm(&message, units_torque_q8(fault->torque_reference_q24));
    hal_can_frame_t frame = frame_of(DRIVE_FAULT_SNAPSHOT_FRAME_ID, DRIVE_FAULT_SNAPSHOT_LENGTH);
    drive_fault_snapshot_pack(frame.data, &message, sizeof frame.data);
    return frame;
}

static hal_can_frame_t command_counters_frame(const commands_counters_t *counters) {
    struct drive_command_counters_t message = {0};
    drive_command_counters_set_wrong_length(&message, counters->wrong_length);
    drive_command_counters_set_wrong_checksum(&message, counters->wrong_checksum);
    drive_command_counters_set_wrong_counter(&message, counters->wrong_counter);
    drive_command_counters_set_out_of_range(&message, counters->out_of_range);
    hal_can_frame_t frame = frame_of(DRIVE_COMMAND_COUNTERS_FRAME_ID, DRIVE_COMMAND_COUNTERS_LENGTH);
    drive_command_counters_pack(frame.data, &message, sizeof frame.data);
    return frame;
}

static hal_can_frame_t bus_counters_frame(const telemetry_t *telemetry, const commands_counters_t *counters,
                                          uint32_t receive_overflows) {
    struct drive_bus_counters_t message = {0};
    drive_bus_counters_set_unknown_frame(&message, counters->unknown_frame);
    drive_bus_counters_set_receive_overflow(&message, receive_overflows);
    drive_bus_counters_set_telemetry_dropped(&message, telemetry->dropped);
    drive_bus_counters_set_command_accepted(&message, counters->accepted);
    hal_can_frame_t frame = frame_of(DRIVE_BUS_COUNTERS_FRAME_ID, DRIVE_BUS_COUNTERS_LENGTH);
    drive_bus_counters_pack(frame.data, &message, sizeof frame.data);
    return frame;
}

static hal_can_frame_t processor_frame(const telemetry_snapshot_t *snapshot) {
    struct drive_processor_t message = {0};
    drive_processor_set_used_us(&message, snapshot->used_ticks);
    drive_processor_set_worst_us(&message, snapshot->worst_ticks);
    drive_processor_set_available_us(&message, snapshot->available_ticks);
    drive_processor_set_late_interrupts(&message, snapshot->late_interrupts);
    hal_can_frame_t frame = frame_of(DRIVE_PROCESSOR_FRAME_ID, DRIVE_PROCESSOR_LENGTH);
    drive_processor_pack(frame.data, &message, sizeof frame.data);
    return frame;
}

static hal_can_frame_t heartbeat_frame(const telemetry_t *telemetry, const telemetry_snapshot_t *snapshot) {
    struct drive_heartbeat_t message = {0};
    drive_heartbeat_set_state(&message, snapshot->state);
    drive_heartbeat_set_fault(&message, snapshot->fault);
    drive_heartbeat_set_controller(&message, snapshot->controller);
    drive_heartbeat_set_phases(&message, telemetry->phases);
    drive_heartbeat_set_control_rate_hz(&message, telemetry->control_rate_hz);
    hal_can_frame_t frame = frame_of(DRIVE_HEARTBEAT_FRAME_ID, DRIVE_HEARTBEAT_LENGTH);
    drive_heartbeat_pack(frame.data, &message, sizeof frame.data);
    return frame;
}

/* Counts down the cycles to a slower frame; true when it is due now. */
static bool count_down(uint8_t *cycles_left, uint8_t period) {
    const bool due = *cycles_left == 0;
    *cycles_left = (uint8_t)((due ? period : *cycles_left) - 1);
    return due;
}

static void put_measurements(telemetry_t *telemetry, const telemetry_snapshot_t *snapshot) {
    hal_can_frame_t frames[6] = {status_frame(telemetry, snapshot), motion_frame(snapshot), torque_frame(snapshot),
                                 currents_frame(snapshot)};
    unsigned count = 4;
    if (count_down(&telemetry->laws_in, LAWS_CYCLES)) {
        frames[count++] = bp_pid_frame(snapshot);
        frames[count++] = trim_frame(snapshot);
    }
    put_together(telemetry, frames, count);
}

static void put_fault(telemetry_t *telemetry, const telemetry_snapshot_t *snapshot) {
    if (snapshot->state != DRIVE_STATUS_STATE_FAULT_CHOICE) {
        telemetry->in_fault = false;
        return;
    }
    const fault_record_t *fault = &snapshot->last_fault;
    if (!telemetry->in_fault || fault->time_us != telemetry->fault_time_us) {
        telemetry->fault_in = 0;
    }
    telemetry->in_fault = true;
    telemetry->fault_time_us = fault->time_us;
    if (count_down(&telemetry->fault_in, FAULT_CYCLES)) {
        const hal_can_frame_t frames[] = {fault_cause_frame(fault), fault_snapshot_frame(fault)};
        put_together(telemetry, frames, 2);
    }
}

static void put_heartbeat(telemetry_t *telemetry, const telemetry_snapshot_t *snapshot) {
    if (telemetry->heartbeat_in_mailbox) {
        counter_add(&telemetry->dropped, 1);
        return;
    }
    const hal_can_frame_t frame = heartbeat_frame(telemetry, snapshot);
    put_together(telemetry, &frame, 1);
}

void telemetry_cycle(telemetry_t *telemetry, const telemetry_snapshot_t *snapshot, const commands_counters_t *counters,
                     uint32_t receive_overflows) {
    put_measurements(telemetry, snapshot);
    put_fault(telemetry, snapshot);
    if (count_down(&telemetry->heartbeat_in, HEARTBEAT_CYCLES)) {
        const hal_can_frame_t frames[] = {command_counters_frame(counters),
                                          bus_counters_frame(telemetry, counters, receive_overflows),
                                          processor_frame(snapshot)};
        put_together(telemetry, frames, 3);
        put_heartbeat(telemetry, snapshot);
    }

    uint32_t cycles = 1;
    /* Negative when the snapshot was taken a little before the cycle was due. */
    const int32_t late_us = (int32_t)(snapshot->time_us - telemetry->next_us);
    if (late_us >= TELEMETRY_CYCLE_US) {
        cycles += (uint32_t)late_us / TELEMETRY_CYCLE_US;
    }
    telemetry->next_us += cycles * TELEMETRY_CYCLE_US;
    telemetry->cycle = (uint8_t)(telemetry->cycle + cycles);
}

void telemetry_flush(telemetry_t *telemetry, hal_t *hal) {
    unsigned taken = 0; /* mailboxes that were free in this call, since the heartbeat took one */
    const hal_can_frame_t *frame;
    while ((frame = frame_queue_head(&telemetry->queue)) != NULL && hal_can_transmit(hal, frame)) {
        taken++;
        if (frame->identifier == DRIVE_HEARTBEAT_FRAME_ID) {
            telemetry->heartbeat_in_mailbox = true;
            taken = 0;
        }
        if (taken == HAL_CAN_MAILBOXES) {
            telemetry->heartbeat_in_mailbox = false;
        }
        frame_queue_drop_head(&telemetry->queue);
    }
}
