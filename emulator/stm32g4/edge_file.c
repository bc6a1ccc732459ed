/* SPDX-License-Identifier: GPL-2.0-or-later */
#include "stm32g4/edge_file.h"

#include <stdio.h>

#include "stm32g4/peripherals.h"
#include "stm32g4/timer.h"

#define EDGES_KEPT 16
#define AHEAD 1000000u /* cycles that edges are computed ahead; the next change of an output replaces them */

static FILE *file;
static unsigned pins[GPIO_PINS], pin_count;
static struct {
    timer_edge_t edge[EDGES_KEPT];
    unsigned count;
    bool level, known;
} planned[GPIO_PINS];

/* Writes the planned edges up to now. */
static void write_until(unsigned i, uint64_t cycle) {
    for (unsigned k = 0; k < planned[i].count && planned[i].edge[k].cycle < cycle; ++k) {
        if (!planned[i].known || planned[i].edge[k].level != planned[i].level) {
            fprintf(file, "%llu %s %d\n", (unsigned long long)planned[i].edge[k].cycle, gpio_name(pins[i]),
                    planned[i].edge[k].level);
            planned[i].level = planned[i].edge[k].level;
            planned[i].known = true;
        }
    }
}

static void changed(void *context) {
    (void)context;
    for (unsigned i = 0; i < pin_count; ++i) {
        write_until(i, soc.now);
        bool driven;
        planned[i].count = timer_edges(pins[i], soc.now + AHEAD, planned[i].edge, &driven);
    }
}

bool edge_file_open(const char *path, const unsigned of_pins[], unsigned count) {
    file = fopen(path, "w");
    if (!file) {
        return false;
    }
    pin_count = count;
    for (unsigned i = 0; i < count; ++i) {
        pins[i] = of_pins[i];
    }
    timer_watch(changed, NULL);
    return true;
}

void edge_file_close(void) {
    if (file) {
        for (unsigned i = 0; i < pin_count; ++i) {
            write_until(i, soc.now);
        }
        fclose(file);
    }
}
