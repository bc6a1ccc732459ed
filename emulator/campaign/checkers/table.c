#include "campaign/checkers/table.h"

extern const checker_t over_current_checker;
extern const checker_t over_voltage_checker;
extern const checker_t over_speed_checker;
extern const checker_t under_voltage_checker;
extern const checker_t gate_on_checker;
extern const checker_t no_command_checker;
extern const checker_t resumed_checker;
extern const checker_t cleared_checker;
extern const checker_t stopped_checker;
extern const checker_t applied_checker;
extern const checker_t wrong_angle_checker;
extern const checker_t wrong_current_checker;
extern const checker_t wrong_voltage_checker;
extern const checker_t wrong_temperature_checker;
extern const checker_t wrong_torque_checker;
extern const checker_t wrong_way_checker;
extern const checker_t overshoot_checker;
extern const checker_t above_limit_checker;
extern const checker_t not_derated_checker;
extern const checker_t wrong_status_checker;
extern const checker_t wrong_telemetry_checker;
extern const checker_t wrong_snapshot_checker;
extern const checker_t wrong_torque_telemetry_checker;
extern const checker_t wrong_cause_checker;
extern const checker_t false_alarm_checker;
extern const checker_t not_first_checker;
extern const checker_t torque_in_silence_checker;
extern const checker_t not_stopped_checker;
extern const checker_t not_following_checker;
extern const checker_t undetected_checker;
extern const checker_t no_current_checker;
extern const checker_t two_lost_checker;
extern const checker_t blocked_checker;
extern const checker_t misled_checker;
extern const checker_t contested_checker;
extern const checker_t not_reset_checker;
extern const checker_t mute_checker;
extern const checker_t not_recovered_checker;
extern const checker_t not_enabled_checker;
extern const checker_t false_stall_checker;
extern const checker_t wrong_position_checker;
extern const checker_t beyond_travel_checker;
extern const checker_t moved_unasked_checker;
extern const checker_t quick_stop_checker;
extern const checker_t not_arrived_checker;
extern const checker_t fault_cells_checker;

const checkers_row_t checkers_table[] = {
    {CHECKER_NEVER, CHECKER_ALL, &over_current_checker},
    {CHECKER_NEVER, CHECKER_ALL, &over_voltage_checker},
    {CHECKER_NEVER, CHECKER_ALL, &over_speed_checker},
    {CHECKER_NEVER, CHECKER_ALL, &under_voltage_checker},
    {CHECKER_NEVER, CHECKER_ALL, &gate_on_checker},
    {CHECKER_NEVER, CHECKER_DBC, &no_command_checker},
    {CHECKER_NEVER, CHECKER_DBC, &resumed_checker},
    {CHECKER_NEVER, CHECKER_DBC, &cleared_checker},
    {CHECKER_NEVER, CHECKER_DBC, &stopped_checker},
    {CHECKER_NEVER, CHECKER_DBC, &applied_checker},
    {CHECKER_NEVER, CHECKER_ALL, &wrong_angle_checker},
    {CHECKER_NEVER, CHECKER_ALL, &wrong_current_checker},
    {CHECKER_NEVER, CHECKER_ALL, &wrong_voltage_checker},
    {CHECKER_NEVER, CHECKER_ALL, &wrong_temperature_checker},
    {CHECKER_NEVER, CHECKER_SPEED, &wrong_torque_checker},
    {CHECKER_NEVER, CHECKER_SPEED, &wrong_way_checker},
    {CHECKER_NEVER, CHECKER_SPEED, &overshoot_checker},
    {CHECKER_NEVER, CHECKER_SPEED, &above_limit_checker},
    {CHECKER_NEVER, CHECKER_SPEED, &not_derated_checker},
    {CHECKER_NEVER, CHECKER_DBC, &wrong_status_checker},
    {CHECKER_NEVER, CHECKER_SPEED, &wrong_telemetry_checker},
    {CHECKER_NEVER, CHECKER_DBC, &wrong_snapshot_checker},
    {CHECKER_NEVER, CHECKER_SPEED, &wrong_torque_telemetry_checker},
    {CHECKER_NEVER, CHECKER_ALL, &wrong_cause_checker},
    {CHECKER_NEVER, CHECKER_ALL, &false_alarm_checker},
    {CHECKER_NEVER, CHECKER_ALL, &not_first_checker},
    {CHECKER_NEVER, CHECKER_CANOPEN, &not_enabled_checker},
    {CHECKER_NEVER, CHECKER_MOTION, &false_stall_checker},
    {CHECKER_NEVER, CHECKER_MOTION, &wrong_position_checker},
    {CHECKER_NEVER, CHECKER_MOTION, &beyond_travel_checker},
    {CHECKER_NEVER, CHECKER_MOTION, &moved_unasked_checker},
    {CHECKER_IN_TIME, CHECKER_DBC, &torque_in_silence_checker},
    {CHECKER_IN_TIME, CHECKER_SPEED, &not_stopped_checker},
    {CHECKER_IN_TIME, CHECKER_SPEED, &not_following_checker},
    {CHECKER_IN_TIME, CHECKER_SPEED, &undetected_checker},
    {CHECKER_IN_TIME, CHECKER_SPEED, &no_current_checker},
    {CHECKER_IN_TIME, CHECKER_SPEED, &two_lost_checker},
    {CHECKER_IN_TIME, CHECKER_SPEED, &blocked_checker},
    {CHECKER_IN_TIME, CHECKER_SPEED, &misled_checker},
    {CHECKER_IN_TIME, CHECKER_DBC, &contested_checker},
    {CHECKER_IN_TIME, CHECKER_ALL, &not_reset_checker},
    {CHECKER_IN_TIME, CHECKER_DBC, &mute_checker},
    {CHECKER_IN_TIME, CHECKER_SPEED, &not_recovered_checker},
    {CHECKER_IN_TIME, CHECKER_CANOPEN, &quick_stop_checker},
    {CHECKER_IN_TIME, CHECKER_MOTION, &not_arrived_checker},
    {CHECKER_SOMETIMES, CHECKER_SPEED, &fault_cells_checker},
};

const unsigned checkers_count = sizeof checkers_table / sizeof *checkers_table;
