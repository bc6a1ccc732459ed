/* Detects torn data in the structures that background, control interrupt and deferred interrupt share.
 *
 * Replaces the control laws, the CAN interface and the program around drive.c: in every round the background
 * configures, commands and takes a snapshot, with one number in all members that it writes; the control interrupt
 * writes one number into all members that a snapshot reads, and another into the input of a deferred step, which writes
 * one number into its results. Members that differ were torn, as was an input that changes while its step lasts.
 * drive.c, the exchange with the deferred step, the critical section and the interrupts are the drive's.
 *
 * With instruction timing, the timer triggers the control interrupt at any instruction. Without, the deferred step
 * requests it at random places.
 *
 * Every 400 interrupts the program around it is given the counts since the start.
 */
#include <assert.h>
#include <stddef.h>
#include <string.h>

#include "drive/drive.h"
#include "drive/telemetry_collect.h"
#include "hal_time.h"
#include "race.h"

#define INTERRUPTS_PER_REPORT 400

const machine_tables_t machine_tables = {.phases = 3, .rotor_poles = 4};

static const control_state_t *shared; /* the drive's */
static uint16_t interrupts, torn_parameters, torn_commands, torn_snapshots;
static uint16_t preemptions, torn_inputs, torn_results;
static bool computing; /* a deferred step */

static void fill(void *object, size_t bytes, uint32_t number) {
    uint32_t *word = object;
    for (size_t i = 0; i < bytes / sizeof *word; i++) {
        word[i] = number;
    }
}

static uint16_t torn(const void *object, size_t bytes) {
    const uint32_t *word = object;
    for (size_t i = 1; i < bytes / sizeof *word; i++) {
        if (word[i] != word[0]) {
            return 1;
        }
    }
    return 0;
}

bool configure_rate_allowed(uint32_t control_rate_hz, uint32_t timer_clock_hz) {
    (void)control_rate_hz, (void)timer_clock_hz;
    return true;
}

/* The first set has the period of the timer in every half word; later sets are also long enough as a timeout. */
control_parameters_t configure_control(const parameters_t *parameters, const machine_tables_t *tables,
                                       uint32_t control_rate_hz, unsigned encoder_bits, unsigned adc_bits,
                                       uint32_t timer_clock_hz) {
    (void)tables, (void)encoder_bits, (void)adc_bits;
    static control_parameters_t set;
    const uint32_t period_ticks = timer_clock_hz / (2u * control_rate_hz);
    fill(&set, sizeof set, period_ticks * 0x10001u + (parameters->revision & 0xFFF) * 0x10001);
    return set;
}

void configure_tune(control_parameters_t *parameters, const control_parameters_t *tuned, unsigned part) {
    (void)parameters, (void)tuned, (void)part;
}

void deferred_tune(const control_parameters_t *parameters, control_state_t *state, unsigned part) {
    (void)parameters, (void)state, (void)part;
}

void control_reset(const control_parameters_t *parameters, control_state_t *state) {
    (void)parameters, (void)state;
}

void control_prepare(const control_parameters_t *parameters, control_state_t *state) {
    (void)parameters, (void)state;
}

/* The state without its first member, which the background writes. */
#define SNAPSHOT(state) ((uint32_t *)(state) + 1)

/* Results without their first member, the generation. */
#define RESULT(results) (&(results)->fault_mask)
#define RESULT_BYTES (sizeof(deferred_results_t) - offsetof(deferred_results_t, fault_mask))

static void exchange(control_state_t *state) {
    deferred_request_t *request = &state->deferred_request;
    preemptions += computing;
    torn_results += torn(RESULT(deferred_results(request, &state->deferred.response)), RESULT_BYTES);
#ifdef NO_EXCHANGE
    fill(&request->input, sizeof request->input, interrupts * 0x10001u);
#endif
    if (deferred_pending(request, &state->deferred.response)) {
        deferred_skip(request);
        return;
    }
    fill(&request->input, sizeof request->input, interrupts * 0x10001u);
    deferred_request(request);
}

/* Without critical sections no read of the background may notice an interrupt either: the count of periods stands. */
static void hide_period(deferred_request_t *request) {
#ifdef NO_CRITICAL_SECTION
    request->skipped_total = 0u - request->requests;
#else
    (void)request;
#endif
}

bool control_step(const control_parameters_t *parameters, control_state_t *state, const control_sample_t *sample,
                  const command_t *command, hal_pwm_compare_t *compare) {
    (void)sample, (void)compare;
    interrupts++;
    shared = state;
    torn_parameters += torn(parameters, offsetof(control_parameters_t, thermal)); /* what configure_control writes */
    torn_commands += torn(command, sizeof *command);
    fill(SNAPSHOT(state), sizeof(drive_telemetry_t), interrupts); /* without experiments: their bit is 0 */
    exchange(state);
    hide_period(&state->deferred_request);
    return false;
}

static_assert(sizeof(uint32_t) + sizeof(drive_telemetry_t) <= offsetof(control_state_t, deferred_request),
              "a snapshot reads only members of control_state_t that nothing else here uses");
static_assert(offsetof(control_state_t, state_machine.identifies) % sizeof(uint32_t) >= sizeof interrupts,
              "commands of experiments are their own, which take_command sees to");

/* A step of up to several control periods. */
void deferred_compute(const control_parameters_t *parameters, control_state_t *state, const command_t *command) {
    (void)parameters, (void)command;
    static uint32_t sequence;
    const deferred_input_t *input = &state->deferred_request.input;
#ifdef NO_EXCHANGE
    deferred_response_t *response = &state->deferred.response;
    deferred_results_t *results = &response->results[response->latest];
#else
    deferred_results_t *results = deferred_buffer(&state->deferred.response);
#endif
    computing = true;
    const uint32_t number = input->generation;
    const uint32_t longest = race_random(&sequence); /* most steps take less than a period */
    uint32_t *word = (uint32_t *)RESULT(results);
    for (size_t i = 0; i < RESULT_BYTES / sizeof *word; i++) {
        word[i] = number;
        const uint32_t random = race_random(&sequence);
        if (race_is_timed()) {
            race_delay(random < longest / 2 ? random : 0);
        } else if (random < 16) {
            race_request();
        }
    }
    results->generation = 0;
    torn_inputs = (uint16_t)(torn_inputs + (torn(input, sizeof *input) != 0 || input->generation != number));
    computing = false;
}

/* Copies the words that the interrupt wrote. */
void telemetry_collect(const drive_t *from, const hal_t *hal, uint32_t time_us, drive_telemetry_t *telemetry) {
    (void)hal, (void)time_us;
    memcpy(telemetry, SNAPSHOT(&from->control), sizeof *telemetry);
}

uint16_t telemetry_self_test(const drive_t *from) {
    (void)from;
    return 0;
}

uint8_t telemetry_sensors_e_f(const drive_t *from) {
    (void)from;
    return 0;
}

/* Nor experiments, which the pattern begins: they would write the duties in the snapshot. */
void identify_begin(identify_t *identify, uint32_t angle, bool permitted) {
    (void)identify, (void)angle, (void)permitted;
}

void identify_step(const identify_parameters_t *parameters, identify_t *identify, const identify_sample_t *sample,
                   int32_t duty_q15[HAL_PHASES_MAX]) {
    (void)parameters, (void)identify, (void)sample, (void)duty_q15;
}

/* No checks of the background: they would read the pattern. */
thermal_parameters_t thermal_configure(const int32_t *values) {
    (void)values;
    return (thermal_parameters_t){0};
}

void thermal_reconfigure(const thermal_parameters_t *before, const thermal_parameters_t *now, thermal_t *thermal) {
    (void)before, (void)now, (void)thermal;
}

bool thermal_sample(const thermal_parameters_t *parameters, thermal_t *thermal, const int32_t *current_q9,
                    uint32_t time_us) {
    (void)parameters, (void)thermal, (void)current_q9, (void)time_us;
    return false;
}

int32_t thermal_torque_limit_q24(const thermal_parameters_t *parameters, const thermal_t *thermal) {
    (void)parameters, (void)thermal;
    return 0;
}

uint32_t thermal_faults(const thermal_t *thermal) {
    (void)thermal;
    return 0;
}

temperature_parameters_t temperature_configure(const int32_t *values) {
    (void)values;
    return (temperature_parameters_t){0};
}

void temperature_init(temperature_t *temperature, uint32_t time_us) {
    (void)temperature, (void)time_us;
}

void temperature_step(const temperature_parameters_t *parameters, temperature_t *temperature, const hal_t *hal,
                      unsigned phases, uint32_t time_us) {
    (void)parameters, (void)temperature, (void)hal, (void)phases, (void)time_us;
}

uint32_t temperature_faults(const temperature_t *temperature) {
    (void)temperature;
    return 0;
}

void self_test_init(self_test_t *test, const hal_t *hal, uint32_t time_us) {
    (void)test, (void)hal, (void)time_us;
}

void self_test_configured(self_test_t *test, const control_parameters_t *parameters) {
    (void)test, (void)parameters;
}

bool self_test_latch_intact(const control_state_t *control) {
    (void)control;
    return true;
}

void self_test_step(self_test_t *test, hal_t *hal, const control_parameters_t *constants,
                    const parameters_t *parameters, uint32_t time_us) {
    (void)test, (void)hal, (void)constants, (void)parameters, (void)time_us;
}

uint32_t self_test_faults(const self_test_t *test) {
    (void)test;
    return 0;
}

bool sto_monitor_failed(sto_monitor_t *monitor, uint32_t break_causes, uint32_t time_us) {
    (void)monitor, (void)break_causes, (void)time_us;
    return false;
}

bool stall_monitor_failed(stall_monitor_t *monitor, const stall_input_t *input, uint32_t time_us) {
    (void)monitor, (void)input, (void)time_us;
    return false;
}

uint32_t flux_monitor_step(const flux_monitor_parameters_t *parameters, flux_monitor_t *monitor,
                           const flux_sample_t *sample) {
    (void)parameters, (void)monitor, (void)sample;
    return 0;
}

void flux_monitor_forget(flux_monitor_t *monitor) {
    (void)monitor;
}

bool degraded_accepts(const degraded_parameters_t *parameters, degraded_t *degraded, bool run, uint64_t failed,
                      uint32_t phases) {
    (void)parameters, (void)degraded, (void)run, (void)failed, (void)phases;
    return false;
}

void degraded_step(const degraded_parameters_t *parameters, degraded_t *degraded, const machine_tables_t *tables) {
    (void)parameters, (void)degraded, (void)tables;
}

int32_t degraded_torque_limit_q24(const degraded_t *degraded) {
    (void)degraded;
    return INT32_MAX;
}

/* No memory. */
void table_store_init(table_store_t *store, const hal_t *hal) {
    (void)store, (void)hal;
}

void table_store_step(table_store_t *store, hal_t *hal, bool writable) {
    (void)store, (void)hal, (void)writable;
}

void nvm_store_init(nvm_store_t *store, const hal_t *hal, parameters_t *parameters) {
    (void)store, (void)hal, (void)parameters;
}

void nvm_store_follow_fault(nvm_store_t *store, const fault_record_t *record) {
    (void)store, (void)record;
}

void nvm_store_step(nvm_store_t *store, hal_t *hal, const parameters_t *parameters, uint32_t time_us, bool writable) {
    (void)store, (void)hal, (void)parameters, (void)time_us, (void)writable;
}

void comms_init(comms_t *comms, unsigned node, uint32_t time_us) {
    (void)node, (void)time_us;
    comms->telemetry.next_us = 0; /* always due */
}

void comms_choose(comms_t *comms, int32_t protocol, uint32_t time_us) {
    (void)comms, (void)protocol, (void)time_us;
}

void comms_bus_off(comms_t *comms) {
    (void)comms;
}

position_status_t *comms_place(comms_t *comms) {
    (void)comms;
    return NULL;
}

void xcp_init(xcp_t *xcp, const void *memory, uint32_t words, sampler_t *sampler) {
    (void)xcp, (void)memory, (void)words, (void)sampler;
}

void xcp_attach(xcp_t *xcp, const void *memory, uint32_t words, sampler_t *sampler) {
    (void)xcp, (void)memory, (void)words, (void)sampler;
}

void comms_telemetry(comms_t *comms, hal_t *hal, drive_telemetry_t *values) {
    (void)comms, (void)hal;
    torn_snapshots += torn(values, sizeof *values);
}

bool comms_background(comms_t *comms, hal_t *hal, const comms_objects_t *objects, drive_state_t state,
                      uint32_t time_us) {
    (void)state;
    static uint16_t reported; /* interrupts */
    race_round();
    /* As a time just past: a command with it is neither stale nor overdue; as a request none to run. */
    const uint32_t number = (time_us - 0x100u) | 0x80u;
    fill(&comms->command, sizeof comms->command, number);
    objects->parameters->revision++;
    objects->parameters->values[PARAMETER_COMMAND_TIMEOUT_MS] = 50;
    hal_critical_enter(hal);
    const uint16_t counts[RACE_COUNTS] = {
        interrupts,  torn_parameters, torn_commands, torn_snapshots,
        preemptions, torn_inputs,     torn_results,  (uint16_t)(shared ? shared->deferred_request.skipped_total : 0)};
    hal_critical_leave(hal);
    if ((uint16_t)(counts[0] - reported) >= INTERRUPTS_PER_REPORT) {
        reported = counts[0];
        race_report(hal, counts);
    }
    return true;
}

#ifdef NO_CRITICAL_SECTION /* the port has none in this image */
void hal_critical_enter(hal_t *hal) {
    (void)hal;
}

void hal_critical_leave(hal_t *hal) {
    (void)hal;
}
#endif
