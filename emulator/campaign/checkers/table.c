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
extern const checker_t fault_cells_checker;

const checkers_row_t checkers_table[] = {
    {CHECKER_NEVER, &over_current_checker},
    {CHECKER_NEVER, &over_voltage_checker},
    {CHECKER_NEVER, &over_speed_checker},
    {CHECKER_NEVER, &under_voltage_checker},
    {CHECKER_NEVER, &gate_on_checker},
    {CHECKER_NEVER, &no_command_checker},
    {CHECKER_NEVER, &resumed_checker},
    {CHECKER_NEVER, &cleared_checker},
    {CHECKER_NEVER, &stopped_checker},
    {CHECKER_NEVER, &applied_checker},
    {CHECKER_NEVER, &wrong_angle_checker},
    {CHECKER_NEVER, &wrong_current_checker},
    {CHECKER_NEVER, &wrong_voltage_checker},
    {CHECKER_NEVER, &wrong_temperature_checker},
    {CHECKER_NEVER, &wrong_torque_checker},
    {CHECKER_NEVER, &wrong_way_checker},
    {CHECKER_NEVER, &overshoot_checker},
    {CHECKER_NEVER, &above_limit_checker},
    {CHECKER_NEVER, &not_derated_checker},
    {CHECKER_NEVER, &wrong_status_checker},
    {CHECKER_NEVER, &wrong_telemetry_checker},
    {CHECKER_NEVER, &wrong_snapshot_checker},
    {CHECKER_NEVER, &wrong_torque_telemetry_checker},
    {CHECKER_NEVER, &wrong_cause_checker},
    {CHECKER_NEVER, &false_alarm_checker},
    {CHECKER_NEVER, &not_first_checker},
    {CHECKER_IN_TIME, &torque_in_silence_checker},
    {CHECKER_IN_TIME, &not_stopped_checker},
    {CHECKER_IN_TIME, &not_following_checker},
    {CHECKER_IN_TIME, &undetected_checker},
    {CHECKER_IN_TIME, &no_current_checker},
    {CHECKER_IN_TIME, &two_lost_checker},
    {CHECKER_IN_TIME, &blocked_checker},
    {CHECKER_IN_TIME, &misled_checker},
    {CHECKER_IN_TIME, &contested_checker},
    {CHECKER_IN_TIME, &not_reset_checker},
    {CHECKER_IN_TIME, &mute_checker},
    {CHECKER_IN_TIME, &not_recovered_checker},
    {CHECKER_SOMETIMES, &fault_cells_checker},
};

const unsigned checkers_count = sizeof checkers_table / sizeof *checkers_table;
