/* SPDX-License-Identifier: GPL-2.0-or-later */
#include "qemu/instructions.h"

#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include "host/output.h"
#include "qemu/plugin_api.h"

#define OPTION "--instructions"

static const char *name;
static FILE *file;
static uint64_t count; /* since entry of the handler; a block is counted when it begins */

static void entered(unsigned vcpu, void *size) {
    (void)vcpu;
    count = (uintptr_t)size;
}

static void returns(unsigned vcpu, void *size) {
    (void)vcpu;
    const uint32_t whole = (uint32_t)(count + (uintptr_t)size);
    fwrite(&whole, sizeof whole, 1, file);
}

bool instructions_open(const char *path) {
    name = path;
    file = output_open(OPTION, path);
    return file != NULL;
}

/* The handler's ends are symbols: control_handler and control_handler_return. Exception entry and return occur between
 * blocks only, so that the first instruction begins a block and the last one ends one. */
void instructions_translate(struct qemu_plugin_tb *tb) {
    const size_t size = qemu_plugin_tb_n_insns(tb);
    const char *symbol = qemu_plugin_insn_symbol(qemu_plugin_tb_get_insn(tb, 0));
    if (symbol && strcmp(symbol, "control_handler") == 0) {
        qemu_plugin_register_vcpu_tb_exec_cb(tb, entered, QEMU_PLUGIN_CB_NO_REGS, (void *)(uintptr_t)size);
    } else if (symbol && strcmp(symbol, "control_handler_return") == 0) {
        qemu_plugin_register_vcpu_tb_exec_cb(tb, returns, QEMU_PLUGIN_CB_NO_REGS, (void *)(uintptr_t)size);
    } else {
        qemu_plugin_register_vcpu_tb_exec_inline(tb, QEMU_PLUGIN_INLINE_ADD_U64, &count, size);
    }
}

bool instructions_close(void) {
    return output_close(file, OPTION, name);
}
