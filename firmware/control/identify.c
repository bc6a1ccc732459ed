#include "control/identify.h"

#include "control/modulator.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"

/* Current of this part of the limit counts as no current. */
#define NONE_SHIFT 7
#define REST_PERIODS 4u
/* Records of a pulse: after that part of the limit, or so many periods. */
#define RECORD_SHIFT 5
#define PULSE_SPACING 16u
#define MARK_PERIODS 32u
/* Records of a hold in a millisecond: as many as leave the bus half of its time. */
#define HOLD_RECORDS 2u
/* A hold: the error of the current is removed in so many periods, at most at a quarter of full voltage. */
#define HOLD_SHIFT 2
#define HOLD_DUTY_MAX_Q15 (MODULATOR_DUTY_ONE_Q15 / 4)
/* Its largest current, part of the limit. */
#define HOLD_LEVEL_MAX_Q12 2048
/* From which another square exceeds no word. */
#define ENERGY_MAX (UINT32_MAX - (1u << 16))
/* Rotations within a period beyond this are counted as this, 2^-16 rev. */
#define STEP_MAX 32767

static void enter(identify_t *identify, identify_state_t state) {
    identify->state = (uint8_t)state;
    identify->periods = 0;
}

static void end(identify_t *identify, identify_limit_t limit) {
    if (identify->state != IDENTIFY_ENDED) {
        identify->limit = (uint8_t)limit;
        enter(identify, IDENTIFY_ENDED);
    }
}

COLD void identify_begin(identify_t *identify, uint32_t angle, bool permitted) {
    const identify_command_t command = identify->command;
    *identify = (identify_t){
        .command = command, .begun = true, .number = command.number, .angle = angle, .mark = {angle, angle}};
    if (!permitted) {
        end(identify, IDENTIFY_CONTROLLER);
    }
}

/* Sums of squares: (A Q7.9 >> 8)^2 / 2 is A^2 Q1, at most 2^15; 2^15 in each of the 100 periods of 1000 ms is below
 * 2^32, and the limit ends the run before a sum exceeds it. More periods in a millisecond have what fits. */
static void check_limits(const identify_parameters_t *parameters, identify_t *identify,
                         const identify_sample_t *sample) {
    const int32_t most_q9 = parameters->limit_q9 + (parameters->limit_q9 >> 5);
    const uint32_t limit_q1 = (uint32_t)parameters->limit_q9 >> 8;
    const uint32_t most_in_ms = limit_q1 * limit_q1 / 2u * parameters->periods_per_ms; /* at most 2^25 */
    const uint32_t most_energy = fixed_min_u32(most_in_ms, ENERGY_MAX / IDENTIFY_ENERGY_MS) * IDENTIFY_ENERGY_MS;
    for (unsigned phase = 0; phase < parameters->phases; phase++) {
        const uint32_t current_q1 = ((uint32_t)sample->current_q9[phase] + 128u) >> 8;
        identify->energy[phase] += current_q1 * current_q1 / 2u;
        if (identify->energy[phase] > most_energy) {
            end(identify, IDENTIFY_ENERGY);
        }
        if (sample->current_q9[phase] > most_q9) {
            end(identify, IDENTIFY_CURRENT);
        }
    }
    const int32_t step = (int32_t)(sample->angle - identify->angle) >> 16;
    identify->travel = fixed_add(identify->travel, fixed_clamp(step, -STEP_MAX, STEP_MAX));
    identify->angle = sample->angle;
    if (fixed_abs(identify->travel) > IDENTIFY_TRAVEL_REV << 16) {
        end(identify, IDENTIFY_TRAVEL);
    }
    if (identify->run_periods++ > IDENTIFY_TIME_MS * parameters->periods_per_ms) {
        end(identify, IDENTIFY_TIME);
    }
}

static bool is_pulse(identify_kind_t kind) {
    return kind == IDENTIFY_KIND_PULSE || kind == IDENTIFY_KIND_FREEWHEEL;
}

/* The experiment of a new number, out of any other one: what carries current loses it first, or goes on being held. A
 * phase that the machine does not have ends the present one, too: its number has changed in memory. */
static void take_command(const identify_parameters_t *parameters, identify_t *identify) {
    const identify_command_t *command = &identify->command;
    const bool known = command->phase < parameters->phases;
    if (identify->state == IDENTIFY_ENDED || (known && command->number == identify->number)) {
        return;
    }
    identify->number = command->number;
    identify->rise_q9 = identify->growth_q9 = 0;
    if (!known || command->kind == IDENTIFY_KIND_REST) {
        enter(identify, IDENTIFY_IDLE);
    } else if (is_pulse(command->kind)) {
        enter(identify, IDENTIFY_WAITS);
    } else {
        enter(identify, IDENTIFY_HOLDS);
    }
}

/* Level of a hold; damped a quarter of it while the rotor approaches its place of rest. */
static int32_t hold_level_q9(const identify_parameters_t *parameters, const identify_t *identify) {
    const identify_command_t *command = &identify->command;
    const int32_t part_q12 = fixed_min(command->level_q12, HOLD_LEVEL_MAX_Q12);
    const int32_t level_q9 = (parameters->limit_q9 * part_q12) >> 12; /* below 2^28 */
    const int32_t away = (int32_t)(identify->angle - ((uint32_t)command->angle_q16 << 16));
    const int32_t turned = (int32_t)(identify->angle - identify->mark[1]);
    const bool approaches = (away < 0) != (turned < 0);
    return command->kind == IDENTIFY_KIND_DAMPED && approaches ? level_q9 >> 2 : level_q9;
}

/* The phase needs a known rise: without one it stays off. */
static int32_t hold_duty_q15(const identify_parameters_t *parameters, const identify_t *identify, int32_t current_q9) {
    const int32_t rise_q9 = identify->first_rise_q9[identify->command.phase];
    const int32_t level_q9 = hold_level_q9(parameters, identify), error_q9 = level_q9 - current_q9;
    if (rise_q9 <= 0 || -error_q9 > level_q9 >> 2) {
        return -MODULATOR_DUTY_ONE_Q15;
    }
    const int32_t most_q9 = rise_q9 << HOLD_SHIFT; /* error beyond which the duty is limited anyway */
    return error_q9 <= 0 ? 0
                         : fixed_min((int32_t)(((uint32_t)fixed_min(error_q9, most_q9) << 15) / (uint32_t)most_q9),
                                     HOLD_DUTY_MAX_Q15);
}

/* Effect of the last period on the current, when that was one at full voltage. */
static void follow_rise(identify_t *identify, int32_t current_q9) {
    if (identify->acted != IDENTIFY_ON) {
        return;
    }
    const int32_t rise_q9 = fixed_max(current_q9 - identify->previous_q9, 1);
    int32_t *first_q9 = &identify->first_rise_q9[identify->command.phase];
    if (identify->rise_q9 == 0) {
        *first_q9 = fixed_max(*first_q9, rise_q9);
    } else {
        identify->growth_q9 = fixed_max(rise_q9 - identify->rise_q9, 0);
    }
    identify->rise_q9 = rise_q9;
}

/* A period more at full voltage, after the one that begins now, leaves the current within the level. */
static bool may_charge(const identify_t *identify, int32_t current_q9, int32_t level_q9) {
    const int32_t first_q9 = identify->first_rise_q9[identify->command.phase];
    const int32_t rise_q9 = identify->rise_q9 != 0 ? identify->rise_q9 : first_q9;
    const bool on = identify->action == IDENTIFY_ON;
    if (rise_q9 == 0) { /* the first one of all: its effect is awaited, and known after that */
        return !on;
    }
    const int32_t now_q9 = on ? rise_q9 + identify->growth_q9 : 0;
    return current_q9 + now_q9 + rise_q9 + 2 * identify->growth_q9 <= level_q9; /* each below 2^17 */
}

static bool in_window(const identify_command_t *command, uint32_t angle) {
    return command->width_q16 == 0 || (angle >> 16) - command->angle_q16 < command->width_q16 ||
           (angle >> 16) + 0x10000u - command->angle_q16 < command->width_q16;
}

/* The next action while the current rises; IDENTIFY_OFF when that ends. */
static identify_action_t charge(const identify_parameters_t *parameters, const identify_t *identify,
                                int32_t current_q9) {
    const identify_command_t *command = &identify->command;
    const int32_t level_q9 = (parameters->limit_q9 * command->level_q12) >> 12;
    const bool unknown = identify->rise_q9 == 0 && identify->first_rise_q9[command->phase] == 0;
    if (may_charge(identify, current_q9, level_q9) &&
        identify->periods < IDENTIFY_CHARGE_MS * parameters->periods_per_ms) {
        return IDENTIFY_ON;
    }
    return unknown ? IDENTIFY_ZERO : IDENTIFY_OFF;
}

/* Its end: no current, and then a rest of some periods. */
static void end_pulse(const identify_parameters_t *parameters, identify_t *identify, int32_t current_q9) {
    if (identify->state == IDENTIFY_DISCHARGES && identify->periods > 1u &&
        current_q9 <= parameters->limit_q9 >> NONE_SHIFT) {
        enter(identify, IDENTIFY_RESTS);
    }
    if (identify->state == IDENTIFY_RESTS && identify->periods >= REST_PERIODS) {
        enter(identify, IDENTIFY_IDLE);
    }
}

/* The state of a pulse from this sample on, and its action from the next one on. */
static identify_action_t pulse(const identify_parameters_t *parameters, identify_t *identify, int32_t current_q9) {
    const identify_command_t *command = &identify->command;
    const uint32_t time = command->time_ms * parameters->periods_per_ms;
    if (identify->state == IDENTIFY_WAITS) {
        if (current_q9 > parameters->limit_q9 >> NONE_SHIFT || !in_window(command, identify->angle)) {
            if (identify->periods > time) {
                enter(identify, IDENTIFY_IDLE);
            }
            return IDENTIFY_OFF;
        }
        enter(identify, IDENTIFY_CHARGES);
    }
    if (identify->state == IDENTIFY_CHARGES) {
        const identify_action_t action = charge(parameters, identify, current_q9);
        if (action != IDENTIFY_OFF) {
            return action;
        }
        enter(identify, command->kind == IDENTIFY_KIND_FREEWHEEL ? IDENTIFY_FREEWHEELS : IDENTIFY_DISCHARGES);
    }
    if (identify->state == IDENTIFY_FREEWHEELS) {
        if (identify->periods < time) {
            return IDENTIFY_ZERO;
        }
        enter(identify, IDENTIFY_DISCHARGES);
    }
    end_pulse(parameters, identify, current_q9);
    return IDENTIFY_OFF;
}

/* Records of a pulse are the periods in which the switches or the state are others than in the period before, and where
 * the current has changed by a part of the limit since the last record: few enough for the bus, and none is missed by
 * which the voltage or its integral would be another one. */
static bool is_due(const identify_parameters_t *parameters, identify_t *identify, int32_t current_q9) {
    const bool pulses = identify->state >= IDENTIFY_CHARGES && identify->state <= IDENTIFY_RESTS;
    const uint32_t spacing = pulses                              ? PULSE_SPACING
                             : identify->state == IDENTIFY_HOLDS ? parameters->periods_per_ms / HOLD_RECORDS
                                                                 : parameters->periods_per_ms;
    const bool changed = identify->state != identify->recorded_state || identify->action != identify->recorded_action ||
                         fixed_abs(current_q9 - identify->recorded_q9) > parameters->limit_q9 >> RECORD_SHIFT;
    identify->recorded_periods++;
    if (identify->recorded_periods < spacing && !(pulses && changed) &&
        (identify->state == IDENTIFY_RESTS) == (identify->recorded_state == IDENTIFY_RESTS)) {
        return false;
    }
    identify->recorded_periods = 0;
    identify->recorded_state = identify->state;
    identify->recorded_action = identify->action;
    identify->recorded_q9 = current_q9;
    return true;
}

static void write_record(const identify_parameters_t *parameters, identify_t *identify, const identify_sample_t *sample,
                         unsigned phase) {
    identify->records = is_due(parameters, identify, sample->current_q9[phase]);
    uint32_t word = sample->angle >> (32u - IDENTIFY_RECORD_ANGLE_BITS);
    word = (word << IDENTIFY_RECORD_PHASE_BITS) | phase;
    word = (word << IDENTIFY_RECORD_ACTION_BITS) | identify->action;
    word = (word << IDENTIFY_RECORD_STATE_BITS) | identify->state;
    identify->record[1] = (word << IDENTIFY_RECORD_NUMBER_BITS) | (identify->number & 15u);
    identify->record[0] = (uint32_t)sample->current_q9[phase] | (uint32_t)sample->dc_link_q6 << 16;
}

void identify_step(const identify_parameters_t *parameters, identify_t *identify, const identify_sample_t *sample,
                   int32_t duty_q15[HAL_PHASES_MAX]) {
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        duty_q15[phase] = -MODULATOR_DUTY_ONE_Q15;
    }
    check_limits(parameters, identify, sample);
    const uint8_t before = identify->number;
    take_command(parameters, identify);
    const unsigned phase = identify->command.phase < parameters->phases ? identify->command.phase : 0;
    if (identify->number != before) { /* whatever acts is of another phase or purpose */
        identify->acted = identify->action = IDENTIFY_OFF;
        identify->previous_q9 = sample->current_q9[phase];
    }
    if (identify->run_periods % MARK_PERIODS == 0) {
        identify->mark[1] = identify->mark[0];
        identify->mark[0] = sample->angle;
    }
    const int32_t current_q9 = sample->current_q9[phase];
    identify_action_t next = IDENTIFY_OFF;
    if (identify->state == IDENTIFY_HOLDS) {
        const int32_t hold_q15 = hold_duty_q15(parameters, identify, current_q9);
        duty_q15[phase] = hold_q15;
        next = hold_q15 < 0 ? IDENTIFY_OFF : IDENTIFY_PART;
        if (identify->periods > IDENTIFY_HOLD_MS * parameters->periods_per_ms) {
            enter(identify, IDENTIFY_IDLE);
        }
    } else if (identify->state != IDENTIFY_IDLE && identify->state != IDENTIFY_ENDED) {
        follow_rise(identify, current_q9);
        next = pulse(parameters, identify, current_q9);
        duty_q15[phase] = next == IDENTIFY_ON     ? MODULATOR_DUTY_ONE_Q15
                          : next == IDENTIFY_ZERO ? 0
                                                  : -MODULATOR_DUTY_ONE_Q15;
    }
    identify->previous_q9 = current_q9;
    write_record(parameters, identify, sample, phase);
    identify->acted = identify->action;
    identify->action = (uint8_t)next;
    identify->periods++;
}
