/* SPDX-License-Identifier: GPL-2.0-or-later */
#include "qemu/instructions.h"

#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include "host/output.h"
#include "qemu/plugin_api.h"

/* File of one interrupt. */
typedef struct {
    const char *option;
    const char *name; /* NULL: none */
    FILE *file;
} series_t;

static series_t control = {.option = "--instructions"}, deferred = {.option = "--deferred-instructions"};

static uint64_t count; /* instructions executed; a block is counted when it begins */
static uint64_t count_in_control;
static uint64_t control_entry, deferred_entry;

static void put(const series_t *series, uint64_t instructions) {
    if (series->file) {
        const uint32_t whole = (uint32_t)instructions;
        fwrite(&whole, sizeof whole, 1, series->file);
    }
}

static void control_entered(unsigned vcpu, void *size) {
    (void)vcpu;
    control_entry = count;
    count += (uintptr_t)size;
}

static void control_returns(unsigned vcpu, void *size) {
    (void)vcpu;
    count += (uintptr_t)size;
    count_in_control += count - control_entry;
    put(&control, count - control_entry);
}

static void deferred_entered(unsigned vcpu, void *size) {
    (void)vcpu;
    deferred_entry = count - count_in_control;
    count += (uintptr_t)size;
}

static void deferred_returns(unsigned vcpu, void *size) {
    (void)vcpu;
    count += (uintptr_t)size;
    put(&deferred, count - count_in_control - deferred_entry);
}

static bool open_series(series_t *series, const char *path) {
    series->name = path;
    series->file = path ? output_open(series->option, path) : NULL;
    return !path || series->file;
}

static bool close_series(series_t *series) {
    return !series->name || output_close(series->file, series->option, series->name);
}

bool instructions_open(const char *control_path, const char *deferred_path) {
    return open_series(&control, control_path) && open_series(&deferred, deferred_path);
}

/* The handlers' ends are symbols: control_handler and control_handler_return, deferred_handler and
 * deferred_handler_return. Exception entry and return occur between blocks only, so that the first instruction begins a
 * block and the last one ends one. */
void instructions_translate(struct qemu_plugin_tb *tb) {
    static const struct {
        const char *symbol;
        qemu_plugin_vcpu_udata_cb_t callback;
    } ends[] = {
        {"control_handler", control_entered},
        {"control_handler_return", control_returns},
        {"deferred_handler", deferred_entered},
        {"deferred_handler_return", deferred_returns},
    };
    const size_t size = qemu_plugin_tb_n_insns(tb);
    const char *symbol = qemu_plugin_insn_symbol(qemu_plugin_tb_get_insn(tb, 0));
    for (size_t i = 0; symbol && i < sizeof ends / sizeof ends[0]; ++i) {
        if (strcmp(symbol, ends[i].symbol) == 0) {
            qemu_plugin_register_vcpu_tb_exec_cb(tb, ends[i].callback, QEMU_PLUGIN_CB_NO_REGS, (void *)(uintptr_t)size);
            return;
        }
    }
    qemu_plugin_register_vcpu_tb_exec_inline(tb, QEMU_PLUGIN_INLINE_ADD_U64, &count, size);
}

bool instructions_close(void) {
    const bool closed = close_series(&control);
    return close_series(&deferred) && closed;
}
