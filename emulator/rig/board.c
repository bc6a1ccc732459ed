#include "rig/board.h"

#include <string.h>

#include "plant/random.h"

#define PHASES_OF_A_BOARD 4u

void board_init(board_t *board, plant_t *plant, sensors_t *sensors, can_bus_t *bus, unsigned bus_drive, uint64_t seed) {
    memset(board, 0, sizeof *board);
    board->adc_bits = sensors->adc_bits;
    board->encoder_bits = sensors->encoder_bits;
    board->plant = plant;
    board->sensors = sensors;
    board->bus = bus;
    board->bus_drive = bus_drive;
    board->random_state = seed;
    board->sto_energised[0] = board->sto_energised[1] = true;
    if (plant->machine->trip_current_A > 0.0) {
        plant_set_trip(plant, plant->machine->trip_current_A);
    }
    board->watchdog_ns = UINT64_MAX;
    board->reference_rate = 1.0;
    nvm_init(&board->nvm);
}

/* --- Gate path: acts without the firmware --- */

/* Periods in succession whose compare values are not renewed before the switches open. */
#define PERIODS_UNRENEWED_MAX 2

/* [SR-01] [SR-10] [SR-45] */
static void apply_break(board_t *board, uint32_t causes) {
    board->break_causes |= causes;
    plant_open_all(board->plant);
}

/* [SR-01] */
void board_set_sto(board_t *board, unsigned line, bool energised) {
    board->sto_energised[line] = energised;
    if (!energised) {
        apply_break(board, line == 0 ? HAL_PWM_BREAK_STO_1 : HAL_PWM_BREAK_STO_2);
    }
}

/* [SR-01] [SR-10] */
uint32_t board_pwm_break(const board_t *board) {
    return board->break_causes | (board->plant->tripped ? HAL_PWM_BREAK_OVER_CURRENT : 0u);
}

/* [SR-01] [SR-10] */
void board_pwm_clear_break(board_t *board) {
    plant_clear_trip(board->plant);
    board->break_causes =
        (board->sto_energised[0] ? 0u : HAL_PWM_BREAK_STO_1) | (board->sto_energised[1] ? 0u : HAL_PWM_BREAK_STO_2);
}

/* Start of a period: compare values that were not renewed twice in succession, or a break, open the switches.
 * [SR-01] [SR-10] [SR-45] */
static void drive_gates(board_t *board, bool busy) {
    /* Values that an interrupt still running has written count at its end. */
    if (busy || !board->renewed) {
        board->periods_unrenewed++;
    } else {
        board->periods_unrenewed = 0;
        board->renewed = false;
    }
    if (board->periods_unrenewed == PERIODS_UNRENEWED_MAX) {
        apply_break(board, HAL_PWM_BREAK_NOT_RENEWED);
    }
    if (board_pwm_break(board) == 0) {
        plant_set_switches(board->plant, &board->active, board->period_ticks);
    } else {
        plant_open_all(board->plant);
    }
}

/* [SR-45] */
void board_stop_gates(board_t *board) {
    apply_break(board, HAL_PWM_BREAK_NOT_RENEWED);
}

/* [SR-45] */
void board_reset(board_t *board, hal_reset_cause_t cause) {
    board_pwm_open_all(board);
    board->start_ns = board->reference_from_ns = board->time_ns;
    board->reference_at = 0.0;
    board->context = BOARD_START;
    board_convert_temperatures(board);
    board->in_critical_section = false;
    board->deferred_requested = false;
    board->period_ticks = 0;
    board->missed_triggers = 0;
    board->periods_unrenewed = 0;
    board_pwm_clear_break(board);
    board->interrupt_took_ns = 0;
    board->watchdog_ns = UINT64_MAX;
    board->reset_cause = cause;
    board->received_popped = board->received_pushed;
    board->receive_overflows = 0;
    nvm_power_on(&board->nvm);
}

/* Phases for which the board has sensors. */
static unsigned board_phases(const board_t *board) {
    return board->plant->machine->phases > PHASES_OF_A_BOARD ? HAL_PHASES_MAX : PHASES_OF_A_BOARD;
}

/* Windings come before switches. */
static unsigned temperature_sensor(const board_t *board) {
    const unsigned phases = board_phases(board), number = board->temperature_number;
    return number < phases ? HAL_ADC_WINDING + number : HAL_ADC_INVERTER + number - phases;
}

static void start_temperature(board_t *board, unsigned number) {
    board->temperature_number = number % (2 * board_phases(board));
    board->temperature_sample = board->temperature_input[temperature_sensor(board)];
}

static void convert_temperature(board_t *board) {
    board->temperature_code[temperature_sensor(board)] = board->temperature_sample;
    start_temperature(board, board->temperature_number + 1);
}

void board_convert_temperatures(board_t *board) {
    memcpy(board->temperature_code, board->temperature_input, sizeof board->temperature_code);
    start_temperature(board, 0);
}

void board_start_period(board_t *board, bool busy) {
    hal_encoder_sample_t encoder;
    sensors_sample_encoder(board->sensors, board->plant, &encoder);
    if (busy) {
        ++board->missed_triggers;
    } else {
        sensors_sample_adc(board->sensors, board->plant, &board->adc);
        board->encoder = encoder;
        convert_temperature(board);
        board->active = board->buffered;
    }
    drive_gates(board, busy);
}

void board_deliver(board_t *board, const hal_can_frame_t *frame) {
    if (board->received_pushed - board->received_popped == HAL_CAN_RECEIVE_QUEUE) {
        ++board->receive_overflows;
        return;
    }
    board->received[board->received_pushed++ % HAL_CAN_RECEIVE_QUEUE] = *frame;
}

void board_pwm_start(board_t *board, uint16_t period_ticks) {
    board->period_ticks = board->period_written = period_ticks;
}

bool board_registers_intact(const board_t *board) {
    return board->period_ticks == board->period_written;
}

static double reference_cycles(const board_t *board) {
    const double elapsed_ns = (double)(board->time_ns - board->reference_from_ns);
    return board->reference_at + elapsed_ns * board->reference_rate * BOARD_REFERENCE_HZ / 1e9;
}

uint64_t board_reference_cycles(const board_t *board) {
    return (uint64_t)reference_cycles(board);
}

uint32_t board_reference_us(const board_t *board) {
    return (uint32_t)(board_reference_cycles(board) * 1000000u / BOARD_REFERENCE_HZ);
}

void board_set_reference_rate(board_t *board, double rate) {
    board->reference_at = reference_cycles(board);
    board->reference_from_ns = board->time_ns;
    board->reference_rate = rate;
}

void board_pwm_write(board_t *board, const hal_pwm_compare_t *compare) {
    board->buffered = *compare;
    board->renewed = true;
    if (board->immediate_pwm && board_pwm_break(board) == 0) {
        board->active = *compare;
        plant_set_switches(board->plant, compare, board->period_ticks);
    }
}

void board_pwm_open_all(board_t *board) {
    memset(&board->active, 0, sizeof board->active);
    memset(&board->buffered, 0, sizeof board->buffered);
    board->renewed = true;
    plant_open_all(board->plant);
}

uint32_t board_missed_triggers(board_t *board) {
    uint32_t missed = board->missed_triggers;
    board->missed_triggers = 0;
    return missed;
}

bool board_can_receive(board_t *board, hal_can_frame_t *frame) {
    if (board->received_pushed == board->received_popped) {
        return false;
    }
    *frame = board->received[board->received_popped++ % HAL_CAN_RECEIVE_QUEUE];
    return true;
}

bool board_can_transmit(board_t *board, const hal_can_frame_t *frame) {
    return can_bus_transmit(board->bus, board->bus_drive, frame);
}

void board_can_status(const board_t *board, hal_can_status_t *status) {
    const can_node_t *node = &board->bus->drives[board->bus_drive].node;
    *status = (hal_can_status_t){
        .state = node->bus_off               ? HAL_CAN_BUS_OFF
                 : can_node_is_passive(node) ? HAL_CAN_ERROR_PASSIVE
                                             : HAL_CAN_ERROR_ACTIVE,
        .transmit_errors = (uint16_t)(node->bus_off ? HAL_CAN_TRANSMIT_ERRORS_BUS_OFF : node->transmit_errors),
        .receive_errors = (uint16_t)node->receive_errors,
        .transmitting = can_node_backlog(node) > 0,
    };
}

void board_can_rejoin(board_t *board) {
    can_bus_rejoin(board->bus, board->bus_drive, board->time_ns);
}

void board_watchdog_start(board_t *board) {
    board->watchdog_ns = board->time_ns + HAL_WATCHDOG_TIMEOUT_US * UINT64_C(1000);
}

void board_watchdog_kick(board_t *board) {
    if (board->watchdog_ns != UINT64_MAX) {
        board_watchdog_start(board);
    }
}

/* With the time in the state, so that the numbers of two runs with one seed differ once their calls do. */
uint32_t board_random(board_t *board) {
    board->random_state += board->time_ns;
    return (uint32_t)(random_next(&board->random_state) >> 32);
}
