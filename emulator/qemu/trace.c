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

/* An exact count of each instruction at the cost of one addition a block. */
static struct {
    uint64_t address;
    size_t size; /* instructions */
} blocks[BLOCKS_MAX];
static unsigned block_count;

/* `executed` goes on in the background, too; `before` is what it was when the interrupt began. Apart from the blocks,
 * because every interrupt goes through them. */
static uint64_t executed[BLOCKS_MAX], before[BLOCKS_MAX], inside[BLOCKS_MAX], in_worst[BLOCKS_MAX];
static uint64_t worst; /* instructions */

/* Of the stack, as far as written to; low > high: not at all. Of the interrupt: the present one. */
typedef struct {
    uint64_t low, high; /* the lowest byte, the highest word */
} written_t;

static const written_t NOTHING_WRITTEN = {.low = UINT64_MAX, .high = 0};
static written_t by_thread, by_interrupt;
static uint64_t interrupt_bytes_max, stack_end, stack_begin;
static bool in_interrupt;

static const char *name;
static FILE *file;

static void entered(unsigned vcpu, void *block) {
    (void)vcpu;
    memcpy(before, executed, block_count * sizeof before[0]); /* of a block yet to be translated both are 0 */
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
    if (instructions > worst) {
        worst = instructions;
        for (unsigned i = 0; i < block_count; ++i) {
            in_worst[i] = executed[i] - before[i];
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
    (void)info;
    (void)context;
    if (address < stack_end || address >= stack_begin) {
        return;
    }
    written_t *written = in_interrupt ? &by_interrupt : &by_thread;
    written->low = address < written->low ? address : written->low;
    written->high = address > written->high ? address : written->high;
}

/* The block's number; one that QEMU translates again keeps it. */
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
        fprintf(stderr, "salient: %s %s: not a stack, END-BEGIN\n", OPTION, stack);
        return false;
    }
    by_thread = NOTHING_WRITTEN;
    file = output_open(OPTION, path);
    return file != NULL;
}

/* As in instructions.c, the handler's two ends are blocks that begin and end with them. They count themselves, so that
 * it does not matter which of a block's callbacks QEMU calls first. */
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
    for (size_t i = 0; i < size; ++i) {
        qemu_plugin_register_vcpu_mem_cb(qemu_plugin_tb_get_insn(tb, i), stored, QEMU_PLUGIN_CB_NO_REGS,
                                         QEMU_PLUGIN_MEM_W, NULL);
    }
}

bool trace_close(void) {
    if (in_interrupt) {
        leave(); /* the program ends in the middle of one */
    }
    for (unsigned i = 0; i < block_count; ++i) {
        fprintf(file, "block %" PRIx64 " %zu %" PRIu64 " %" PRIu64 " %" PRIu64 "\n", blocks[i].address, blocks[i].size,
                executed[i], inside[i], in_worst[i]);
    }
    fprintf(file, "stack thread %" PRIx64 "\n", by_thread.low);
    fprintf(file, "stack interrupt %" PRIu64 "\n", interrupt_bytes_max);
    return output_close(file, OPTION, name);
}
