/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * The rig calls a firmware at the start of each control period. Here that is the trigger of the part's converters: the
 * model advances to it, the gates take the edges of the new period, and the processor runs its handlers. The rig's call
 * of the background is the main program up to its sleep; without that call it hangs where it is.
 * Instructions take time from the reset to the start of TIM1, and none afterwards, as in the host executable.
 */
#include "stm32g4/bench.h"

#include <stdio.h>
#include <string.h>

#include "host/simulation.h"
#include "plant/pwm_timer.h"
#include "stm32g4/bench_io.h"
#include "stm32g4/cpu.h"
#include "stm32g4/timer.h"

#define BOOT_LIMIT_NS UINT64_C(5000000000)
#define ENCODER_NS UINT64_C(15000000) /* start of the encoder: after the start of TIM2, before the crystal LSE's */
#define NS_PER_S UINT64_C(1000000000)
#define CSR_IWDGRSTF (1u << 29)
#define CSR_POWER (3u << 26)

static simulation_t simulation; /* large: static */
static board_t *board;
static struct {
    bool started, encoder_on, outputs_changed;
    uint64_t start_cycle, origin_ns; /* the same instant in both times */
} bench;

/* The start takes no time on the host: the time stands until the bench begins, as the bench's second clock does. */
static void hold_time(bool held) {
    for (unsigned i = 0; i < TIMERS; ++i) {
        if (timers[i].runs && timers[i].arr == UINT32_MAX && timers[i].psc > 0) {
            timers[i].held = held;
            timer_restart(&timers[i], 0);
        }
    }
}

static void outputs_changed(void *context) {
    (void)context;
    bench.outputs_changed = true;
    if (!bench.started && timers[TIM1].runs) {
        bench.started = true;
        bench.start_cycle = soc.now;
        bench.origin_ns = board->time_ns;
        soc.untimed = true;
        cpu_stall(soc.now); /* nor does the rest of this block of instructions take time */
        hold_time(false);
    } else if (!bench.started) {
        hold_time(true);
    }
}

/* The rig's time in cycles; control periods are whole numbers of them. */
static uint64_t cycle_of(uint64_t ns) {
    return bench.start_cycle + (uint64_t)((__uint128_t)(ns - bench.origin_ns) * soc.hclk_hz / NS_PER_S);
}

static uint64_t period_cycles(void) {
    return timer_period(&timers[TIM1]) * timers[TIM1].tick;
}

/* The encoder counts to its position, with the part or without it: edges that TIM2 does not count are lost. */
static void encoder_starts(void) {
    bench.encoder_on = true;
    bench_io_encoder();
}

/* Until the processor sleeps after the start of TIM1. */
static void boot(void) {
    bench.started = bench.encoder_on = false;
    soc.untimed = false;
    const uint64_t encoder_from = soc_ns(soc.now) + ENCODER_NS, limit = soc_ns(soc.now) + BOOT_LIMIT_NS;
    while (!bench.started || !cpu.asleep) {
        cpu_run(soc_cycle_of_ns(bench.encoder_on ? limit : encoder_from), true);
        if (!bench.encoder_on && soc_ns(soc.now) >= encoder_from) {
            encoder_starts();
        }
        if (cpu.exited || soc.reset_request || soc_ns(soc.now) >= limit) {
            soc_violation("TIM1 has not been started within 5 s of the reset");
        }
        if (!bench.started && cpu.asleep) {
            soc_advance(soc.next < soc_cycle_of_ns(limit) ? soc.next : soc_cycle_of_ns(limit));
        }
    }
    if (!bench.encoder_on) {
        encoder_starts();
    }
    const uint64_t length_ns = period_cycles() * NS_PER_S / soc.hclk_hz;
    const uint64_t ticks = pwm_timer_ticks(length_ns) / 2;
    if (pwm_timer_ns(2 * ticks) != length_ns || ticks > UINT16_MAX) {
        soc_violation("control period of %llu ns: not a whole number of the plant's ticks, or too long",
                      (unsigned long long)length_ns);
    }
    board_pwm_start(board, (uint16_t)ticks);
}

static void follow_watchdog(void) {
    const uint64_t expires_ns = apart_watchdog_expires_ns();
    board->watchdog_ns =
        expires_ns == SOC_NEVER ? UINT64_MAX : bench.origin_ns + (expires_ns - soc_ns(bench.start_cycle));
    soc_schedule(EVENT_IWDG, SOC_NEVER); /* the rig resets */
}

static void stopped(void) {
    if (soc.reset_request || cpu.exited) {
        soc_violation("the program has ended or reset itself");
    }
    fdcan_refresh();
    follow_watchdog();
}

static void control_interrupt(void *context) {
    (void)context;
    const uint64_t now = cycle_of(board->time_ns);
    soc_advance(now - 1);
    bench_io_encoder();
    bench_io_lines();
    fdcan_refresh();
    bench.outputs_changed = false;
    soc_advance(now); /* update, trigger, conversions */
    bench_io_gates(now + period_cycles());
    bench.outputs_changed = false;
    bench_io_receive();
    cpu_run_handlers();
    if (bench.outputs_changed) {
        bench_io_gates(now + period_cycles());
    }
    board->renewed = true; /* the part has a break of its own for that */
    stopped();
}

static void background(void *context) {
    (void)context;
    cpu_run(SOC_NEVER, true);
    stopped();
}

static void restart(void *context) {
    (void)context;
    soc_reset(board->reset_cause == HAL_RESET_WATCHDOG ? CSR_IWDGRSTF | 1u << 26 : CSR_POWER);
    cpu_reset();
    bench_io_reset();
    boot();
    follow_watchdog();
}

static bool check(const options_t *options) {
    if (options->drives > 1 || board->adc_bits != 12 || simulation.image.machine.phases > WIRING_PHASES) {
        fputs("salient_stm32g4: one drive of up to four phases with --adc-bits 12\n", stderr);
        return false;
    }
    return true;
}

/* REGISTER,CLEAR,SET: bits that each write of the register clears and sets. */
static bool plant_mistake(const char *text) {
    char name[32];
    unsigned clear, set;
    return sscanf(text, "%31[A-Z0-9_],%x,%x", name, &clear, &set) == 3 && soc_alter(name, clear, set);
}

int bench_run(int argc, char *argv[]) {
    static options_t options; /* the simulation keeps it */
    wiring_t wiring;
    if (argc < 3 || strcmp(argv[1], "--wiring") != 0) {
        fputs("salient_stm32g4: --wiring FILE comes first on the bench\n", stderr);
        return EXIT_USAGE;
    }
    if (!wiring_read(&wiring, argv[2])) {
        return EXIT_USAGE;
    }
    int first = 2;
    while (first + 2 < argc && strcmp(argv[first + 1], "--mistake") == 0) {
        if (!plant_mistake(argv[first + 2])) {
            fprintf(stderr, "salient_stm32g4: --mistake %s: must be REGISTER,CLEAR,SET with bits in hexadecimal\n",
                    argv[first + 2]);
            return EXIT_USAGE;
        }
        first += 2;
    }
    argv[first] = argv[0];
    const options_result_t result = options_parse(&options, argc - first, argv + first);
    if (result != OPTIONS_RUN) {
        return result == OPTIONS_HELP ? 0 : EXIT_USAGE;
    }
    if (!simulation_open(&simulation, &options)) {
        return EXIT_USAGE;
    }
    board = &simulation.rigs[0].board;
    if (!check(&options)) {
        simulation_close(&simulation);
        return EXIT_USAGE;
    }
    sensors_sample_encoder(&simulation.rigs[0].sensors, &simulation.rigs[0].plant, &board->encoder);
    bench_io_open(board, &wiring);
    timer_watch(outputs_changed, NULL);
    boot();
    follow_watchdog();
    simulation_run(
        &simulation,
        &(rig_firmware_t){.control_interrupt = control_interrupt, .background = background, .restart = restart});
    return simulation_close(&simulation);
}
