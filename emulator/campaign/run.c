#define _DEFAULT_SOURCE

#include "campaign/run.h"

#include <stdio.h>
#include <stdlib.h>
#include <sys/wait.h>
#include <unistd.h>

#include "rig/heat.h"

static void look(void *context, const plant_t *plant) {
    (void)plant;
    checkers_on_look(&((run_t *)context)->checkers);
}

static void before_interrupt(void *context) {
    run_t *run = context;
    if (run->before_interrupt) {
        run->before_interrupt(run);
    }
}

static void after_interrupt(void *context) {
    run_t *run = context;
    checkers_on_interrupt(&run->checkers, run->drive->view());
}

static void after_restart(void *context) {
    run_t *run = context;
    checkers_on_reset(&run->checkers, run->rig.board.time_ns, run->drive->view());
}

static void on_command(void *context, uint64_t time_ns, const sender_meaning_t *meaning) {
    checkers_on_command(&((run_t *)context)->checkers, time_ns, meaning);
}

static void on_frame(void *context, uint64_t time_ns, unsigned identifier, const uint8_t data[8]) {
    checkers_on_frame(&((run_t *)context)->checkers, time_ns, identifier, data);
}

static void on_fault(void *context, uint64_t time_ns, unsigned kind, bool begins) {
    (void)time_ns;
    checkers_on_fault(&((run_t *)context)->checkers, kind, begins);
}

bool run_begin(run_t *run, const world_t *world, const run_drive_t *drive, FILE *record) {
    run->world = world;
    run->drive = drive;
    run->before_interrupt = NULL;
    run->end_ns = world->duration_us * 1000;
    sender_init(&run->sender, world, drive->parameters);
    run->sender.record = record;
    run->sender.on_command = on_command;
    run->sender.on_frame = on_frame;
    run->sender.on_fault = on_fault;
    run->sender.context = run;
    rig_config_t config = {
        .machine = &world->machine->image.machine,
        .initial_angle_rad = world->initial_angle_deg * (3.14159265358979323846 / 180.0),
        .encoder_bits = world->encoder_bits,
        .adc_bits = world->adc_bits,
        .encoder_edges = world->encoder_edges,
        .seed = world->seed,
        .bit_rate = 1000000,
        .stop_at_ns = RIG_NEVER,
        .stop = {.descriptors = {-1, -1}},
        .transport = &run->sender.transport,
    };
    pacing_parse(&config.pacing, "lockstep");
    rig_init(&run->rig, &config);
    rig_firmware_t firmware;
    if (!drive->start(world, &run->rig.board, &firmware) ||
        !checkers_start(&run->checkers, world, &run->rig.plant, 1000000000u / world->control_rate_hz)) {
        return false;
    }
    run->checkers.seen.master = &run->sender.master;
    run->checkers.seen.limit_bits = drive->limit_bits;
    run->checkers.seen.constant_bits = drive->constant_bits;
    run->rig.observer = (rig_observer_t){before_interrupt, after_interrupt, after_restart, run};
    rig_join(&run->rig, &firmware);
    plant_observe(&run->rig.plant, OBSERVATION_LOOK_NS / 2, OBSERVATION_LOOK_NS, look, run);
    return true;
}

void run_to_end(run_t *run) {
    const uint64_t recovery_ns = run->world->recovery_us * 1000;
    bool recovers = recovery_ns > 0;
    while (run->rig.board.time_ns < run->end_ns) {
        if (recovers && run->rig.board.time_ns >= recovery_ns) {
            recovers = false;
            sender_set_recovery_speed(&run->sender, observation_recovery_speed_rpm(&run->checkers.seen));
        }
        if (!rig_serve(&run->rig, 0)) {
            break;
        }
        if (run->checkers.seen.recovery.settled) { /* nothing left to be judged */
            run->end_ns = run->rig.board.time_ns;
        }
    }
    rig_finish(&run->rig);
    checkers_at_end(&run->checkers,
                    (observation_heat_t){heat_winding_C(&run->rig.heat), heat_inverter_C(&run->rig.heat)});
    rig_close(&run->rig);
}

bool run_fork(unsigned *signal) {
    fflush(stdout);
    const pid_t child = fork();
    if (child == 0) {
        return true;
    }
    int status;
    if (child < 0 || waitpid(child, &status, 0) != child) {
        perror("salient: fork");
        exit(1);
    }
    *signal = WIFSIGNALED(status) ? (unsigned)WTERMSIG(status) : 0;
    return false;
}
