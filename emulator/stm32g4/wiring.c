/* SPDX-License-Identifier: GPL-2.0-or-later */
#include "stm32g4/wiring.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define NAME_BYTES 32

static int pin_of(const char *text) {
    char *end;
    const unsigned long bit = strlen(text) > 2 ? strtoul(text + 2, &end, 10) : 16;
    return text[0] == 'P' && text[1] >= 'A' && text[1] <= 'D' && bit < 16 ? (text[1] - 'A') * 16 + (int)bit
                                                                          : WIRING_NONE;
}

/* The member of a signal; NULL: one that the model has no use for. */
static int *member_of(wiring_t *wiring, const char *signal) {
    const struct {
        const char *name;
        int *first;
    } phases[] = {{"LOWER_", wiring->lower},
                  {"UPPER_", wiring->upper},
                  {"CURRENT_", wiring->current},
                  {"WINDING_", wiring->winding},
                  {"SWITCHES_", wiring->switches}};
    for (unsigned i = 0; i < sizeof phases / sizeof phases[0]; ++i) {
        const size_t length = strlen(phases[i].name);
        const int phase = signal[length] - 'A';
        if (strncmp(signal, phases[i].name, length) == 0 && phase >= 0 && phase < WIRING_PHASES) {
            return phases[i].first + phase;
        }
    }
    const struct {
        const char *name;
        int *member;
    } others[] = {{"DC_LINK", &wiring->dc_link},
                  {"TORQUE", &wiring->torque},
                  {"ENCODER_A", &wiring->encoder_a},
                  {"ENCODER_B", &wiring->encoder_b},
                  {"ENCODER_INDEX", &wiring->encoder_index},
                  {"STO_1", &wiring->sto[0]},
                  {"STO_2", &wiring->sto[1]},
                  {"DRIVER_FAULT", &wiring->driver_fault},
                  {"BREAK_1", &wiring->breaks[0]},
                  {"BREAK_2", &wiring->breaks[1]}};
    for (unsigned i = 0; i < sizeof others / sizeof others[0]; ++i) {
        if (strcmp(signal, others[i].name) == 0) {
            return others[i].member;
        }
    }
    return NULL;
}

bool wiring_read(wiring_t *wiring, const char *path) {
    FILE *file = fopen(path, "r");
    if (!file) {
        fprintf(stderr, "salient_stm32g4: --wiring %s: %s\n", path, strerror(errno));
        return false;
    }
    memset(wiring, 0xFF, sizeof *wiring); /* WIRING_NONE */
    char signal[NAME_BYTES], pin[NAME_BYTES];
    bool good = true;
    while (good && fscanf(file, "%31s %31s", signal, pin) == 2) {
        int *member = member_of(wiring, signal);
        const int number = pin_of(pin);
        good = number != WIRING_NONE;
        if (!good) {
            fprintf(stderr, "salient_stm32g4: --wiring %s: %s %s: must be a pin PA0 to PD15\n", path, signal, pin);
        } else if (member) {
            *member = number;
        }
    }
    fclose(file);
    return good;
}
