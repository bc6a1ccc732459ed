/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * salient_stm32g4 IMAGE.elf --alone [OPTION...]: a program alone on the part, until BKPT, whose R0 is the exit code.
 * salient_stm32g4 IMAGE.elf OPTION...: a drive on its bench; options, ready line and exit codes are the host
 * executable's.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "stm32g4/bench.h"
#include "stm32g4/cpu.h"
#include "stm32g4/edge_file.h"
#include "stm32g4/nvic.h"
#include "stm32g4/peripherals.h"

#define EXIT_USAGE_OF_ALONE 2
#define LIMIT_DEFAULT_US 10000000u

static uint16_t codes[GPIO_PINS];

static uint16_t analogue(void *context, unsigned pin) {
    (void)context;
    return codes[pin];
}

static int usage(const char *program) {
    printf(
        "usage: %s IMAGE.elf --alone [--wire PIN=PIN] [--analogue PIN=CODE] [--trace FILE PIN...] [--limit-us N]\n"
        "       %s IMAGE.elf --wiring FILE [--mistake REGISTER,CLEAR,SET]... OPTION...\n"
        "  --alone              no bench: until BKPT, whose R0 is the exit code\n"
        "  --wire PIN=PIN       joins two pins, as PA0=PB3\n"
        "  --analogue PIN=CODE    converters read this code of 12 bits at the pin, comparators its part of 3.3 V\n"
        "  --trace FILE PIN...  writes time in cycles of HCLK, pin and level for each edge; the last option\n"
        "  --limit-us N         ends the run with exit code 124 after this virtual time\n"
        "  --wiring FILE        on the bench: a signal and a pin in each line\n"
        "  --mistake R,C,S      writes of the register clear and set bits (hexadecimal), as a mistake of the program\n"
        "  OPTION               as the host executable's; its --help lists them\n",
        program, program);
    return 0;
}

static int pin_of(const char *text) {
    char *end;
    if (text[0] != 'P' || text[1] < 'A' || text[1] > 'D') {
        return -1;
    }
    const unsigned long bit = strtoul(text + 2, &end, 10);
    return end != text + 2 && bit < 16 ? (text[1] - 'A') * 16 + (int)bit : -1;
}

static int mistake(const char *option, const char *value) {
    fprintf(stderr, "salient_stm32g4: %s %s: must be as the usage says (--help)\n", option, value);
    return EXIT_USAGE_OF_ALONE;
}

static int wire(const char *value) {
    const char *equals = strchr(value, '=');
    const int from = pin_of(value), to = equals ? pin_of(equals + 1) : -1;
    if (from < 0 || to < 0) {
        return mistake("--wire", value);
    }
    gpio_connect((unsigned)from, (unsigned)to);
    return 0;
}

/* A code at a pin: for the converters and the comparators that it leads to. */
static void apply_code(unsigned pin, unsigned code) {
    codes[pin] = (uint16_t)code;
    analog_set_pin(pin, (double)code / 4096.0 * 3.3);
}

static int set_analog(const char *value) {
    const char *equals = strchr(value, '=');
    const int pin = pin_of(value);
    const unsigned long code = equals ? strtoul(equals + 1, NULL, 10) : 4096;
    if (pin < 0 || code > 4095) {
        return mistake("--analogue", value);
    }
    apply_code((unsigned)pin, (unsigned)code);
    return 0;
}

/* The program is its own bench: stimulus port 1 gives a pin a code, port 2 a level; number of the pin in the upper half
 * of the word. Port 3: errors of the bus, transmit counter, receive counter << 8, bus-off << 16. Port 4: address of a
 * word of bank 1 with a double error. Port 5: a seed error of the random numbers. */
static void stimulus(unsigned port, uint32_t value) {
    const unsigned pin = value >> 16;
    if (port == 3) {
        fdcan_set_errors(value & 0xFF, value >> 8 & 0xFF, value >> 16 & 1);
        return;
    }
    if (port == 4) {
        cpu_tear(value);
        return;
    }
    if (port == 5) {
        apart_seed_error();
        return;
    }
    if (pin >= GPIO_PINS) {
        soc_violation("stimulus port %u, value 0x%X: no such pin", port, value);
    }
    if (port == 1) {
        apply_code(pin, value & 0xFFF);
        analog_refresh();
    } else {
        gpio_drive(pin, value & 1);
    }
}

static int alone(int argc, char *argv[]) {
    uint64_t limit_us = LIMIT_DEFAULT_US;
    for (int i = 3; i < argc; i += 2) {
        int error = 0;
        const char *value = i + 1 < argc ? argv[i + 1] : "";
        if (strcmp(argv[i], "--wire") == 0) {
            error = wire(value);
        } else if (strcmp(argv[i], "--analogue") == 0) {
            error = set_analog(value);
        } else if (strcmp(argv[i], "--limit-us") == 0) {
            limit_us = strtoull(value, NULL, 10);
        } else if (strcmp(argv[i], "--trace") == 0) {
            unsigned pins[GPIO_PINS], count = 0;
            for (int k = i + 2; k < argc && count < GPIO_PINS; ++k) {
                const int pin = pin_of(argv[k]);
                if (pin < 0) {
                    return mistake("--trace", argv[k]);
                }
                pins[count++] = (unsigned)pin;
            }
            if (!edge_file_open(value, pins, count)) {
                return mistake("--trace", value);
            }
            break;
        } else {
            error = mistake(argv[i], "");
        }
        if (error) {
            return error;
        }
    }
    adc_set_input(analogue, NULL);
    nvic_set_stimulus(stimulus);
    for (;;) {
        const uint64_t end = soc_cycle_of_ns(limit_us * 1000);
        cpu_run(end, false);
        if (cpu.exited) {
            break;
        }
        if (soc.reset_request) {
            soc_reset(soc.reset_request);
            cpu_reset();
        } else if (soc_ns(soc.now) >= limit_us * 1000 || soc.next == SOC_NEVER) {
            fprintf(stderr, "salient_stm32g4: no BKPT until %llu us; pc 0x%08X\n", (unsigned long long)limit_us,
                    cpu_program_counter());
            cpu.exit_code = 124;
            break;
        }
    }
    edge_file_close();
    fflush(stdout);
    return cpu.exit_code;
}

int main(int argc, char *argv[]) {
    if (argc < 2 || strcmp(argv[1], "--help") == 0) {
        usage(argv[0]);
        return argc < 2 ? EXIT_USAGE_OF_ALONE : 0;
    }
    soc_open();
    cpu_open();
    cpu_load(argv[1]);
    cpu_reset();
    if (argc > 2 && strcmp(argv[2], "--alone") == 0) {
        return alone(argc, argv);
    }
    return bench_run(argc - 1, argv + 1);
}
