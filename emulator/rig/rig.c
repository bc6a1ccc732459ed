#include "rig/rig.h"

#include <stdlib.h>
#include <string.h>

#include "rig/truth.h"
#include "rig_codec.h"

#define NS_PER_US UINT64_C(1000)
#define TRUTH_PERIOD_DEFAULT_NS UINT64_C(1000000)

static bool may_read(void *context, uint32_t client);
static bool take(void *context, uint32_t client, const transport_frame_t *frame);

void rig_init(rig_t *rig, const rig_config_t *config) {
    plant_init(&rig->plant, config->machine, config->initial_angle_rad);
    sensors_init(&rig->sensors, &config->machine->sensors, config->encoder_bits, config->adc_bits, config->seed);
    rig->sensors.encoder_edges = config->encoder_edges;
    can_bus_init(&rig->bus, config->bit_rate);
    board_init(&rig->board, &rig->plant, &rig->sensors, &rig->bus);
    rig->board.immediate_pwm = config->immediate_pwm;
    rig->config = *config;
    rig->config.transport->full = config->pacing.kind == PACING_TIMED ? TRANSPORT_DROP : TRANSPORT_WAIT;
    rig->firmware = (rig_firmware_t){0};
    rig->period_ns = 0;
    rig->control_ns = rig->background_ns = rig->hold_ns = RIG_NEVER;
    rig->truth_period_ns = rig->truth_ns = TRUTH_PERIOD_DEFAULT_NS;
    rig->interrupt_time_ns = rig->interrupt_end_ns = 0;
    rig->settings.count = 0;
    rig->run_count = 0;
    rig->stop_asked_ns = 0;
    rig->staged_count = 0;
    rig->staged_mixed = false;
}

static uint64_t earlier(uint64_t a, uint64_t b) {
    return a < b ? a : b;
}

/* When the currents are held that the next period's start will convert: sooner than that by the sensors' delay, limited
 * to a whole period. Without a delay, or with that instant passed already, the present ones will be converted. */
static void schedule_hold(rig_t *rig) {
    const uint64_t delay_ns = (uint64_t)(rig->sensors.errors.current_delay_ns + 0.5);
    const uint64_t before_ns = earlier(delay_ns, rig->period_ns);
    const bool ahead = before_ns > 0 && rig->control_ns - rig->board.time_ns >= before_ns;
    rig->hold_ns = ahead ? rig->control_ns - before_ns : RIG_NEVER;
    rig->sensors.currents_held = false;
}

void rig_join(rig_t *rig, const rig_firmware_t *firmware) {
    rig->firmware = *firmware;
    if (rig->board.period_ticks > 0) {
        rig->period_ns = UINT64_C(2) * rig->board.period_ticks * HAL_PWM_TICK_NS;
        rig->control_ns = rig->board.time_ns + rig->period_ns;
        schedule_hold(rig);
    }
}

void rig_busy_until(rig_t *rig, uint64_t time_ns) {
    rig->interrupt_end_ns = time_ns;
}

static void call(rig_t *rig, board_context_t context, void (*function)(void *)) {
    rig->board.context = context;
    function(rig->firmware.context);
}

static void hold_event(rig_t *rig) {
    rig->hold_ns = RIG_NEVER;
    plant_advance(&rig->plant, rig->board.time_ns);
    sensors_hold_currents(&rig->sensors, &rig->plant);
}

static void control_event(rig_t *rig) {
    uint64_t now_ns = rig->board.time_ns;
    bool busy = now_ns < rig->interrupt_end_ns;
    plant_advance(&rig->plant, now_ns);
    board_start_period(&rig->board, busy);
    rig->control_ns = now_ns + rig->period_ns;
    schedule_hold(rig);
    if (busy) {
        return;
    }
    rig->board.interrupt_took_ns = rig->interrupt_time_ns;
    call(rig, BOARD_INTERRUPT, rig->firmware.control_interrupt);
    if (rig->board.interrupt_took_ns == 0) {
        call(rig, BOARD_BACKGROUND, rig->firmware.background);
    } else {
        /* At the very instant of the next period's start the interrupt comes first and puts this off again. */
        rig->interrupt_end_ns = rig->background_ns = now_ns + rig->board.interrupt_took_ns;
    }
}

static void background_event(rig_t *rig) {
    rig->background_ns = RIG_NEVER;
    plant_advance(&rig->plant, rig->board.time_ns);
    call(rig, BOARD_BACKGROUND, rig->firmware.background);
}

static void truth_event(rig_t *rig) {
    transport_frame_t frames[TRUTH_FRAMES];
    rig->truth_ns += rig->truth_period_ns;
    plant_advance(&rig->plant, rig->board.time_ns);
    truth_pack(&rig->plant, frames);
    for (unsigned i = 0; i < TRUTH_FRAMES; ++i) {
        transport_send(rig->config.transport, rig->board.time_ns, TRANSPORT_FROM_EMULATOR, &frames[i]);
    }
}

static void bus_event(rig_t *rig) {
    can_bus_delivery_t delivery;
    if (!can_bus_step(&rig->bus, &delivery)) {
        return;
    }
    transport_frame_t frame;
    transport_frame_from_hal(&delivery.frame, &frame);
    transport_send(rig->config.transport, rig->board.time_ns,
                   delivery.from_drive ? TRANSPORT_FROM_EMULATOR : TRANSPORT_FROM_CLIENT_ON_BUS, &frame);
    if (!delivery.from_drive) {
        board_deliver(&rig->board, &delivery.frame);
    }
}

static void set_gains(rig_t *rig, const plant_gains_t *gains) {
    plant_advance(&rig->plant, rig->board.time_ns);
    plant_set_gains(&rig->plant, gains);
}

static void apply(rig_t *rig, const quantity_setting_t *setting) {
    uint64_t now_ns = rig->board.time_ns;
    plant_gains_t gains = rig->plant.gains;
    switch (setting->quantity) {
    case RIG_SET_QUANTITY_LOAD_TORQUE_NM_CHOICE:
        plant_advance(&rig->plant, now_ns);
        rig->plant.load_torque_Nm = setting->value;
        break;
    case RIG_SET_QUANTITY_SUPPLY_VOLTAGE_V_CHOICE:
        plant_advance(&rig->plant, now_ns);
        plant_set_supply_voltage(&rig->plant, setting->value);
        break;
    case RIG_SET_QUANTITY_ENCODER_FAULT_CHOICE:
        rig->sensors.encoder_fault = (sensors_encoder_fault_t)setting->value;
        break;
    case RIG_SET_QUANTITY_INTERRUPT_TIME_US_CHOICE:
        rig->interrupt_time_ns = (uint64_t)(setting->value * (double)NS_PER_US + 0.5);
        break;
    case RIG_SET_QUANTITY_CURRENT_SENSOR_GAIN_CHOICE:
        rig->sensors.errors.current_gain = setting->value;
        break;
    case RIG_SET_QUANTITY_CURRENT_SENSOR_OFFSET_A_CHOICE:
        rig->sensors.errors.current_offset_A = setting->value;
        break;
    case RIG_SET_QUANTITY_CURRENT_NOISE_A_CHOICE:
        rig->sensors.errors.current_noise_A = setting->value;
        break;
    case RIG_SET_QUANTITY_CURRENT_SENSOR_LIMIT_A_CHOICE:
        rig->sensors.errors.current_limit_A = setting->value;
        break;
    case RIG_SET_QUANTITY_CURRENT_SENSOR_DELAY_US_CHOICE:
        rig->sensors.errors.current_delay_ns = setting->value * (double)NS_PER_US;
        schedule_hold(rig);
        break;
    case RIG_SET_QUANTITY_ENCODER_ECCENTRICITY_DEG_CHOICE:
        rig->sensors.errors.encoder_eccentricity_deg = setting->value;
        break;
    case RIG_SET_QUANTITY_FLUX_LINKAGE_GAIN_CHOICE:
        gains.flux_linkage = setting->value;
        set_gains(rig, &gains);
        break;
    case RIG_SET_QUANTITY_RESISTANCE_GAIN_CHOICE:
        gains.resistance = setting->value;
        set_gains(rig, &gains);
        break;
    case RIG_SET_QUANTITY_INERTIA_GAIN_CHOICE:
        gains.inertia = setting->value;
        set_gains(rig, &gains);
        break;
    case RIG_SET_QUANTITY_FRICTION_GAIN_CHOICE:
        gains.friction = setting->value;
        set_gains(rig, &gains);
        break;
    case RIG_SET_QUANTITY_ENCODER_OFFSET_DEG_CHOICE:
        rig->sensors.encoder_offset_deg = setting->value;
        break;
    case RIG_SET_QUANTITY_MINIMUM_PULSE_NS_CHOICE:
        rig->plant.minimum_pulse_ns = setting->value;
        break;
    case RIG_SET_QUANTITY_TRUTH_PERIOD_US_CHOICE:
        /* On multiples of the period, so that two logs of one bench have the same instants. */
        rig->truth_period_ns = (uint64_t)setting->value * NS_PER_US;
        rig->truth_ns =
            rig->truth_period_ns > 0 ? (now_ns / rig->truth_period_ns + 1) * rig->truth_period_ns : RIG_NEVER;
        break;
    default:
        break; /* quantity_decode lets no other through */
    }
}

/* Every event up to and including until_ns, which is the time afterwards. */
static void run_events(rig_t *rig, uint64_t until_ns) {
    for (;;) {
        uint64_t setting_ns = quantity_queue_next_ns(&rig->settings);
        uint64_t next_ns =
            earlier(earlier(setting_ns, rig->bus.next_event_ns),
                    earlier(earlier(rig->hold_ns, rig->control_ns), earlier(rig->background_ns, rig->truth_ns)));
        if (next_ns > until_ns) {
            break;
        }
        rig->board.time_ns = next_ns;
        if (next_ns == setting_ns) {
            quantity_setting_t setting = quantity_queue_take(&rig->settings);
            apply(rig, &setting);
        } else if (next_ns == rig->bus.next_event_ns) {
            bus_event(rig);
        } else if (next_ns == rig->hold_ns) {
            hold_event(rig);
        } else if (next_ns == rig->control_ns) {
            control_event(rig);
        } else if (next_ns == rig->background_ns) {
            background_event(rig);
        } else {
            truth_event(rig);
        }
        if (rig->bus.start_requested) {
            can_bus_start(&rig->bus, next_ns);
        }
    }
    rig->board.time_ns = until_ns;
}

static void send_clock(rig_t *rig, uint8_t sequence) {
    struct rig_clock_t clock = {.sequence = sequence};
    rig_clock_set_time_ns(&clock, (int64_t)rig->board.time_ns);
    transport_frame_t frame = {.size = CAN_MTU,
                               .classic = {.can_id = RIG_CLOCK_FRAME_ID | CAN_EFF_FLAG, .len = RIG_CLOCK_LENGTH}};
    rig_clock_pack(frame.classic.data, &clock, RIG_CLOCK_LENGTH);
    transport_send(rig->config.transport, rig->board.time_ns, TRANSPORT_CLOCK, &frame);
}

/* Runs to until_ns and answers the RIG_RUN_UNTILs on the way, each at its time. */
static void advance(rig_t *rig, uint64_t until_ns) {
    while (rig->run_count > 0 && rig->runs[0].time_ns <= until_ns) {
        if (rig->runs[0].time_ns > rig->board.time_ns) {
            run_events(rig, rig->runs[0].time_ns);
        }
        uint8_t sequence = rig->runs[0].sequence;
        memmove(&rig->runs[0], &rig->runs[1], --rig->run_count * sizeof rig->runs[0]);
        send_clock(rig, sequence);
    }
    run_events(rig, until_ns);
}

static void take_run_until(rig_t *rig, uint32_t client, const uint8_t *data) {
    struct rig_run_until_t message;
    rig_run_until_unpack(&message, data, RIG_RUN_UNTIL_LENGTH);
    if (message.time_ns <= rig->board.time_ns || rig->run_count == RIG_RUNS_MAX) {
        send_clock(rig, message.sequence);
        return;
    }
    unsigned place = rig->run_count++;
    for (; place > 0 && rig->runs[place - 1].time_ns > message.time_ns; --place) {
        rig->runs[place] = rig->runs[place - 1];
    }
    rig->runs[place] = (rig_run_t){.time_ns = message.time_ns, .sequence = message.sequence, .client = client};
}

static void take_set(rig_t *rig, const uint8_t *data) {
    quantity_setting_t setting;
    uint8_t status = quantity_decode(data, &setting);
    uint64_t at_ns = setting.at_us * NS_PER_US;
    if (status == RIG_SET_REPLY_STATUS_DONE_CHOICE) {
        if (setting.at_us == 0 || at_ns == rig->board.time_ns) {
            apply(rig, &setting);
        } else if (at_ns < rig->board.time_ns) {
            status = RIG_SET_REPLY_STATUS_IN_THE_PAST_CHOICE;
        } else if (!quantity_queue_add(&rig->settings, at_ns, &setting)) {
            status = RIG_SET_REPLY_STATUS_QUEUE_FULL_CHOICE;
        }
    }
    struct rig_set_reply_t reply = {.quantity = setting.quantity, .status = status, .at_us = setting.at_us};
    transport_frame_t frame = {
        .size = CAN_MTU, .classic = {.can_id = RIG_SET_REPLY_FRAME_ID | CAN_EFF_FLAG, .len = RIG_SET_REPLY_LENGTH}};
    rig_set_reply_pack(frame.classic.data, &reply, RIG_SET_REPLY_LENGTH);
    transport_send(rig->config.transport, rig->board.time_ns, TRANSPORT_FROM_EMULATOR, &frame);
}

static bool may_read(void *context, uint32_t client) {
    const rig_t *rig = context;
    if (rig->config.pacing.kind != PACING_LOCKSTEP) {
        return can_bus_client_backlog(&rig->bus) + rig->staged_count < RIG_MOVING_BACKLOG_MAX;
    }
    for (unsigned i = 0; i < rig->run_count; ++i) {
        if (rig->runs[i].client == client) {
            return false;
        }
    }
    return true;
}

static bool take(void *context, uint32_t client, const transport_frame_t *frame) {
    rig_t *rig = context;
    if (!transport_frame_is_off_bus(frame)) {
        if (can_bus_client_backlog(&rig->bus) + rig->staged_count == CAN_BUS_CLIENT_QUEUE) {
            return false;
        }
        rig_staged_t *staged = &rig->staged[rig->staged_count];
        transport_frame_to_hal(frame, &staged->frame);
        staged->client = client;
        staged->arrival = rig->staged_count;
        rig->staged_mixed = rig->staged_mixed || (rig->staged_count > 0 && staged[-1].client > client);
        ++rig->staged_count;
        return true;
    }
    transport_send(rig->config.transport, rig->board.time_ns, TRANSPORT_FROM_CLIENT_AT_ONCE, frame);
    if (frame->size == CAN_MTU && transport_frame_is_rig(frame) && !(frame->classic.can_id & CAN_RTR_FLAG)) {
        canid_t identifier = frame->classic.can_id & CAN_EFF_MASK;
        if (identifier == RIG_RUN_UNTIL_FRAME_ID && frame->classic.len == RIG_RUN_UNTIL_LENGTH) {
            take_run_until(rig, client, frame->classic.data);
        } else if (identifier == RIG_SET_FRAME_ID && frame->classic.len == RIG_SET_LENGTH) {
            take_set(rig, frame->classic.data);
        }
    }
    return true;
}

static int compare_staged(const void *left, const void *right) {
    const rig_staged_t *a = left, *b = right;
    if (a->client != b->client) {
        return a->client < b->client ? -1 : 1;
    }
    return a->arrival < b->arrival ? -1 : 1;
}

/* Gives the frames that arrived while time stood still to the bus. */
static void submit_staged(rig_t *rig) {
    if (rig->staged_mixed) {
        qsort(rig->staged, rig->staged_count, sizeof rig->staged[0], compare_staged);
    }
    for (unsigned i = 0; i < rig->staged_count; ++i) {
        can_bus_push(&rig->bus, &rig->staged[i].frame); /* take() left room for it */
    }
    rig->staged_count = 0;
    rig->staged_mixed = false;
    if (rig->bus.start_requested) {
        can_bus_start(&rig->bus, rig->board.time_ns);
    }
}

static bool stop_requested(rig_t *rig) {
    rig->stop_asked_ns = rig->board.time_ns;
    return rig->config.stop.requested && rig->config.stop.requested(rig->config.stop.context);
}

/* Asks when RIG_STOP_STEP_NS have passed since it last did. */
static bool stop_requested_by_now(rig_t *rig) {
    return rig->board.time_ns - rig->stop_asked_ns >= RIG_STOP_STEP_NS && stop_requested(rig);
}

/* True when one of the descriptors that say when to end became readable. */
static bool wait_for_clients(rig_t *rig, int timeout_ms) {
    struct pollfd list[TRANSPORT_DESCRIPTORS_MAX + 2];
    size_t count = transport_descriptors(rig->config.transport, list);
    for (unsigned i = 0; i < 2; ++i) {
        list[count++] = (struct pollfd){.fd = rig->config.stop.descriptors[i], .events = POLLIN};
    }
    return poll(list, count, timeout_ms) > 0 && (list[count - 1].revents || list[count - 2].revents);
}

static bool serve_lockstep(rig_t *rig, int timeout_ms) {
    if (rig->run_count == 0) {
        transport_flush(rig->config.transport);
        return !(wait_for_clients(rig, timeout_ms) && stop_requested(rig));
    }
    submit_staged(rig);
    uint64_t target_ns = rig->runs[0].time_ns;
    while (rig->board.time_ns < target_ns) {
        advance(rig, earlier(target_ns, rig->stop_asked_ns + RIG_STOP_STEP_NS));
        if (rig->config.transport->failure || stop_requested_by_now(rig)) {
            return false;
        }
    }
    transport_flush(rig->config.transport);
    return true;
}

static bool serve_moving(rig_t *rig) {
    submit_staged(rig);
    uint64_t reading_ns = (rig->board.time_ns / RIG_READ_STEP_NS + 1) * RIG_READ_STEP_NS;
    advance(rig, earlier(reading_ns, rig->config.stop_at_ns));
    transport_flush(rig->config.transport);
    if (rig->board.time_ns >= rig->config.stop_at_ns) {
        return false;
    }
    pacing_wait(&rig->config.pacing, rig->board.time_ns);
    return !stop_requested_by_now(rig);
}

bool rig_serve(rig_t *rig, int timeout_ms) {
    const transport_receiver_t receiver = {.context = rig, .may_read = may_read, .take = take};
    transport_read(rig->config.transport, &receiver);
    if (rig->config.transport->failure) {
        return false;
    }
    return rig->config.pacing.kind == PACING_LOCKSTEP ? serve_lockstep(rig, timeout_ms) : serve_moving(rig);
}

void rig_finish(rig_t *rig) {
    plant_advance(&rig->plant, rig->board.time_ns);
    transport_flush(rig->config.transport);
}
