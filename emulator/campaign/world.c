#include "campaign/world.h"

#include <inttypes.h>
#include <math.h>
#include <stdio.h>

#include "bench_variables.h"
#include "fault_kinds.h"

static int32_t raw_of(unsigned variable, double value) {
    const double raw = value / bench_variables[variable].scale;
    return (int32_t)fmin(fmax(floor(raw + 0.5), bench_variables[variable].raw_minimum),
                         bench_variables[variable].raw_maximum);
}

world_t world_plain(const world_machine_t *machine, unsigned controller) {
    return (world_t){
        .machine = machine,
        .controller = controller,
        .control_rate_hz = 40000,
        .encoder_bits = 17,
        .adc_bits = 12,
        .kept = UINT64_MAX,
        .inertia_gain = 1.0,
    };
}

double world_settled_s(const world_machine_t *machine, double speed_rpm) {
    const double start_s =
        machine->image.machine.inertia_kg_m2 * speed_rpm * WORLD_RAD_S_PER_RPM / machine->torque_max_Nm;
    return 0.25 + 2.0 * start_s;
}

world_event_t *world_add(world_t *world, world_kind_t kind, uint64_t begin_us, uint64_t end_us) {
    if (world->events == WORLD_EVENTS_MAX) {
        return NULL;
    }
    world_event_t *event = &world->event[world->events++];
    *event = (world_event_t){.kind = kind, .begin_us = begin_us, .end_us = end_us};
    return event;
}

void world_add_set(world_t *world, unsigned variable, double value, double after, uint64_t begin_us, uint64_t end_us) {
    world_event_t *event = world_add(world, WORLD_SET, begin_us, end_us);
    if (event) {
        event->what = variable;
        event->raw = raw_of(variable, value);
        event->raw_end = raw_of(variable, after);
    }
}

const world_event_t *world_begun(const world_t *world, unsigned event, uint64_t time_us) {
    const world_event_t *each = &world->event[event];
    return (world->kept >> event & 1u) && each->begin_us <= time_us ? each : NULL;
}

bool world_active(const world_t *world, unsigned event, uint64_t time_us) {
    const world_event_t *each = world_begun(world, event, time_us);
    return each != NULL && (each->end_us == 0 || time_us < each->end_us);
}

const world_event_t *world_latest(const world_t *world, world_kind_t kind, uint64_t time_us, bool active) {
    const world_event_t *latest = NULL;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = world_begun(world, i, time_us);
        if (event != NULL && event->kind == kind && (!active || world_active(world, i, time_us)) &&
            (latest == NULL || event->begin_us >= latest->begin_us)) {
            latest = event;
        }
    }
    return latest;
}

const char *world_event_name(const world_event_t *event) {
    static const char *const names[] = {
        [WORLD_SPEED] = "speed_reference",
        [WORLD_TORQUE] = "torque_reference",
        [WORLD_SILENT] = "silent",
        [WORLD_HOSTILE] = "hostile",
        [WORLD_SECOND] = "second_sender",
        [WORLD_EAGER] = "eager",
        [WORLD_UNARMED] = "unarmed",
        [WORLD_REQUEST] = "request",
        [WORLD_BEYOND] = "speed_beyond_range",
        [WORLD_DEGRADED] = "degraded_running",
        [WORLD_LIMITED] = "limited_torque",
        [WORLD_ARMED] = "armed",
        [WORLD_TARGET] = "position_rev",
        [WORLD_MODE] = "mode",
        [WORLD_CONTROL] = "controlword",
        [WORLD_NMT] = "nmt",
        [WORLD_LOST] = "lost_master",
        [WORLD_NOISE] = "canopen_noise",
        [WORLD_MASTER] = "second_master",
    };
    return event->kind == WORLD_SET     ? bench_variables[event->what].name
           : event->kind == WORLD_FAULT ? fault_kinds[event->what].name
                                        : names[event->kind];
}

static bool has_number(world_kind_t kind) {
    return kind == WORLD_HOSTILE || kind == WORLD_REQUEST || kind == WORLD_DEGRADED || kind == WORLD_MODE ||
           kind == WORLD_CONTROL || kind == WORLD_NMT || kind == WORLD_MASTER;
}

static void print_master(const world_master_t *master) {
    static const char *const watches[] = {"silence", "heartbeat", "guarding", "pdo"};
    printf("\"master\": {\"mode\": %u, \"cycle_ms\": %u, \"synchronous\": %s, \"watch\": \"%s\", \"watch_ms\": %u, "
           "\"quick_stop_option\": %u, \"abort_option\": %u, \"halt_option\": %u, \"speed_rpm\": %.9g, "
           "\"acceleration_rpm_s\": %.9g, \"torque\": %.9g, \"limited\": %s, \"lowest_rev\": %.9g, "
           "\"highest_rev\": %.9g}, ",
           master->mode, master->cycle_ms, master->synchronous ? "true" : "false", watches[master->watch],
           master->watch_ms, master->quick_stop_option, master->abort_option, master->halt_option, master->speed_rpm,
           master->acceleration_rpm_s, master->torque, master->limited ? "true" : "false", master->lowest_rev,
           master->highest_rev);
}

void world_print(const world_t *world) {
    static const char *const controllers[] = {"traditional", "paper", "salient"};
    static const char *const clients[] = {"speed", "position", "canopen"};
    printf("{\"seed\": %" PRIu64 ", \"machine\": \"%s\", \"controller\": \"%s\", \"control_rate_hz\": %u, "
           "\"encoder_bits\": %u, \"adc_bits\": %u, \"encoder_edges\": %s, \"initial_angle_deg\": %.17g, "
           "\"keeps_reference\": %s, \"duration_us\": %" PRIu64 ", \"recovery_us\": %" PRIu64 ", \"client\": \"%s\", ",
           world->seed, world->machine->name, controllers[world->controller], world->control_rate_hz,
           world->encoder_bits, world->adc_bits, world->encoder_edges ? "true" : "false", world->initial_angle_deg,
           world->keeps_reference ? "true" : "false", world->duration_us, world->recovery_us, clients[world->client]);
    if (world->client == WORLD_CLIENT_CANOPEN) {
        print_master(&world->master);
    }
    printf("\"events\": [");
    const char *separator = "";
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = world_begun(world, i, UINT64_MAX);
        if (event == NULL) {
            continue;
        }
        double value = event->value;
        if (event->kind == WORLD_SET) {
            value = event->raw * bench_variables[event->what].scale;
        } else if (event->kind == WORLD_FAULT) {
            value = event->raw * fault_kinds[event->what].scale;
        } else if (has_number(event->kind)) {
            value = event->what;
        }
        printf("%s{\"index\": %u, \"event\": \"%s\", \"begin_us\": %" PRIu64 ", \"end_us\": %" PRIu64
               ", \"phase\": %u, \"leg\": %u, \"value\": %.9g}",
               separator, i, world_event_name(event), event->begin_us, event->end_us, event->phase, event->leg, value);
        separator = ", ";
    }
    printf("]}\n");
}
