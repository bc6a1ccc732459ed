/* SPDX-License-Identifier: GPL-2.0-or-later */
#include "qemu/trace.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "host/output.h"
#include "qemu/plugin_api.h"

#define OPTION "--execution"

#define BLOCKS_MAX 65536
#define WORD_BYTES 4

/* Executions are counted per block, exactly for each instruction and with one addition per block. */
static struct {
    uint64_t address;
    size_t size; /* instructions */
} blocks[BLOCKS_MAX];
static unsigned block_count;

/* `executed` counts interrupts and background; `before` is its value at the start of the interrupt. Separate arrays,
 * because every interrupt iterates over them. */
static uint64_t executed[BLOCKS_MAX], before[BLOCKS_MAX], inside[BLOCKS_MAX], in_longest[BLOCKS_MAX];
static uint64_t longest; /* instructions */

/* Range of the stack that was written to; low > high: none. by_interrupt: by the present interrupt. */
typedef struct {
    uint64_t low, high; /* lowest byte, highest word */
} written_t;

static const written_t NOTHING_WRITTEN = {.low = UINT64_MAX, .high = 0};
static written_t by_thread, by_interrupt;
static uint64_t interrupt_bytes_max, stack_end, stack_begin;
static bool in_interrupt;

static const char *name;
static FILE *file;

static void entered(unsigned vcpu, void *block) {
    (void)vcpu;
    memcpy(before, executed, block_count * sizeof before[0]); /* both are 0 for a block not yet translated */
    ++executed[(uintptr_t)block];
    in_interrupt = true;
    by_interrupt = NOTHING_WRITTEN;
}

static void leave(void) {
    uint64_t instructions = 0;
    for (unsigned i = 0; i < block_count; ++i) {
        const uint64_t times = executed[i] - before[i];
        inside[i] += times;
        instructions += times * blocks[i].size;
    }
    if (instructions > longest) {
        longest = instructions;
        for (unsigned i = 0; i < block_count; ++i) {
            in_longest[i] = executed[i] - before[i];
        }
    }
    in_interrupt = false;
    if (by_interrupt.low <= by_interrupt.high) {
        const uint64_t bytes = by_interrupt.high + WORD_BYTES - by_interrupt.low;
        interrupt_bytes_max = bytes > interrupt_bytes_max ? bytes : interrupt_bytes_max;
    }
}

static void returns(unsigned vcpu, void *block) {
    (void)vcpu;
    ++executed[(uintptr_t)block];
    leave();
}

static void stored(unsigned vcpu, qemu_plugin_meminfo_t info, uint64_t address, void *context) {
    (void)vcpu;
    (void)context;
    /* QEMU 7.2 also reports loads (here: the self-test's, of words that were never used). */
    if (!qemu_plugin_mem_is_store(info) || address < stack_end || address >= stack_begin) {
        return;
    }
    written_t *written = in_interrupt ? &by_interrupt : &by_thread;
    written->low = address < written->low ? address : written->low;
    written->high = address > written->high ? address : written->high;
}

/* Number of a block; a block that QEMU translates again keeps its number. */
static unsigned number_of(uint64_t address, size_t size) {
    unsigned i = 0;
    while (i < block_count && (blocks[i].address != address || blocks[i].size != size)) {
        ++i;
    }
    if (i == BLOCKS_MAX) {
        fprintf(stderr, "salient: %s %s: more than %d blocks\n", OPTION, name, BLOCKS_MAX);
        abort();
    }
    if (i == block_count) {
        blocks[i].address = address;
        blocks[i].size = size;
        ++block_count;
    }
    return i;
}

bool trace_open(const char *path, const char *stack) {
    name = path;
    char rest;
    if (sscanf(stack, "%" SCNx64 "-%" SCNx64 "%c", &stack_end, &stack_begin, &rest) != 2 || stack_end >= stack_begin) {
        fprintf(stderr, "salient: %s %s: must be the limits of the stack, END-BEGIN\n", OPTION, stack);
        return false;
    }
    by_thread = NOTHING_WRITTEN;
    file = output_open(OPTION, path);
    return file != NULL;
}

/* The ends of the handler are recognised as in instructions.c. Their callbacks also count the block, so that the order
 * in which QEMU calls the callbacks of a block does not matter. */
void trace_translate(struct qemu_plugin_tb *tb) {
    const size_t size = qemu_plugin_tb_n_insns(tb);
    struct qemu_plugin_insn *first = qemu_plugin_tb_get_insn(tb, 0);
    const char *symbol = qemu_plugin_insn_symbol(first);
    const unsigned number = number_of(qemu_plugin_insn_vaddr(first), size);
    if (symbol && strcmp(symbol, "control_handler") == 0) {
        qemu_plugin_register_vcpu_tb_exec_cb(tb, entered, QEMU_PLUGIN_CB_NO_REGS, (void *)(uintptr_t)number);
    } else if (symbol && strcmp(symbol, "control_handler_return") == 0) {
        qemu_plugin_register_vcpu_tb_exec_cb(tb, returns, QEMU_PLUGIN_CB_NO_REGS, (void *)(uintptr_t)number);
    } else {
        qemu_plugin_register_vcpu_tb_exec_inline(tb, QEMU_PLUGIN_INLINE_ADD_U64, &executed[number], 1);
    }
    const bool paints = symbol && strcmp(symbol, "stack_paint") == 0; /* not a use of the stack */
    for (size_t i = 0; i < size && !paints; ++i) {
        qemu_plugin_register_vcpu_mem_cb(qemu_plugin_tb_get_insn(tb, i), stored, QEMU_PLUGIN_CB_NO_REGS,
                                         QEMU_PLUGIN_MEM_W, NULL);
    }
}

bool trace_close(void) {
    if (in_interrupt) {
        leave(); /* the program ended during an interrupt */
    }
    for (unsigned i = 0; i < block_count; ++i) {
        fprintf(file, "block %" PRIx64 " %zu %" PRIu64 " %" PRIu64 " %" PRIu64 "\n", blocks[i].address, blocks[i].size,
                executed[i], inside[i], in_longest[i]);
    }
    fprintf(file, "stack thread %" PRIx64 "\n", by_thread.low);
    fprintf(file, "stack interrupt %" PRIu64 "\n", interrupt_bytes_max);
    return output_close(file, OPTION, name);
}
