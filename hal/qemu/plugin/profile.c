/* SPDX-License-Identifier: GPL-2.0-or-later */
#include "profile.h"

#include <inttypes.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "host/output.h"
#include "plugin_api.h"

#define OPTION "--profile"

#define FUNCTIONS_MAX 1024
#define HANDLER 0 /* the handler itself, not among what blocks count */

/* `count` goes on in the background, where functions run, too; `inside` takes what it grows by in interrupts. */
static struct {
    const char *name; /* QEMU keeps it */
    uint64_t count, inside;
} functions[FUNCTIONS_MAX] = {[HANDLER] = {.name = "control_handler"}};
static unsigned function_count = 1;

static const char *name;
static FILE *file;

static void entered(unsigned vcpu, void *size) {
    (void)vcpu;
    functions[HANDLER].inside += (uintptr_t)size;
    for (unsigned i = HANDLER + 1; i < function_count; ++i) {
        functions[i].inside -= functions[i].count;
    }
}

static void returns(unsigned vcpu, void *size) {
    (void)vcpu;
    functions[HANDLER].inside += (uintptr_t)size;
    for (unsigned i = HANDLER + 1; i < function_count; ++i) {
        functions[i].inside += functions[i].count;
    }
}

static uint64_t *count_of(const char *symbol) {
    unsigned i = HANDLER + 1;
    while (i < function_count && strcmp(functions[i].name, symbol) != 0) {
        ++i;
    }
    if (i == FUNCTIONS_MAX) {
        fprintf(stderr, "salient: %s %s: more than %d functions\n", OPTION, name, FUNCTIONS_MAX);
        abort();
    }
    if (i == function_count) {
        functions[function_count++].name = symbol;
    }
    return &functions[i].count;
}

bool profile_open(const char *path) {
    name = path;
    file = output_open(OPTION, path);
    return file != NULL;
}

/* A block ends with a jump at the latest, so that it is within one function. */
void profile_translate(struct qemu_plugin_tb *tb) {
    const size_t size = qemu_plugin_tb_n_insns(tb);
    const char *symbol = qemu_plugin_insn_symbol(qemu_plugin_tb_get_insn(tb, 0));
    if (!symbol) {
        symbol = "(no name)";
    }
    if (strcmp(symbol, "control_handler") == 0) {
        qemu_plugin_register_vcpu_tb_exec_cb(tb, entered, QEMU_PLUGIN_CB_NO_REGS, (void *)(uintptr_t)size);
    } else if (strcmp(symbol, "control_handler_return") == 0) {
        qemu_plugin_register_vcpu_tb_exec_cb(tb, returns, QEMU_PLUGIN_CB_NO_REGS, (void *)(uintptr_t)size);
    } else {
        qemu_plugin_register_vcpu_tb_exec_inline(tb, QEMU_PLUGIN_INLINE_ADD_U64, count_of(symbol), size);
    }
}

bool profile_close(void) {
    for (unsigned i = 0; i < function_count; ++i) {
        if (functions[i].inside > 0) {
            fprintf(file, "%" PRIu64 " %s\n", functions[i].inside, functions[i].name);
        }
    }
    return output_close(file, OPTION, name);
}
