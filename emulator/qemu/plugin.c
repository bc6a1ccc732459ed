/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * QEMU plugin: opens the co-simulation when QEMU starts, and serves each store of the drive to the doorbell.
 *
 * Plugin arguments: mailbox=FILE, the board's shared memory; instructions=FILE and deferred=FILE, see instructions.h;
 * execution=FILE and stack=END-BEGIN, see trace.h; timed=1, instructions take time; argument=TEXT, one
 * argument of the command line of the host executable, repeated in order.
 */
#define _DEFAULT_SOURCE /* on_exit */

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

#include "host/simulation.h"
#include "qemu/boards.h"
#include "qemu/cosimulation.h"
#include "qemu/instructions.h"
#include "qemu/plugin_api.h"
#include "qemu/trace.h"

#define EXPORT __attribute__((visibility("default")))
#define ARGUMENTS_MAX 64

EXPORT int qemu_plugin_version = PLUGIN_API_VERSION;
EXPORT int qemu_plugin_install(qemu_plugin_id_t id, const qemu_info_t *info, int argc, char **argv);

static const board_description_t *board;
static mailbox_t *mailbox;
static bool counting, tracing;

/* In images that are not optimised the function has further stores. */
static void stored(unsigned vcpu, qemu_plugin_meminfo_t info, uint64_t address, void *context) {
    (void)vcpu;
    (void)info;
    (void)context;
    if (address != board->memory_address + board->mailbox_offset) {
        return;
    }
    cosimulation_serve();
    if (mailbox->event != MAILBOX_EXIT) {
        return;
    }
    if ((counting && !instructions_close()) || (tracing && !trace_close())) {
        mailbox->exit_code = EXIT_USAGE;
    }
    counting = tracing = false;
}

/* Reports the cause when the drive ended QEMU before MAILBOX_EXIT, and keeps the recordings made until then. */
static void ended(int exit_code, void *context) {
    (void)context;
    if (mailbox->event == MAILBOX_EXIT) {
        return;
    }
    if (exit_code == MAILBOX_EXIT_FAULT) {
        fputs("salient: the drive's program stopped on an unexpected CPU exception\n", stderr);
    } else if (exit_code == MAILBOX_EXIT_LAYOUT) {
        fputs("salient: the drive's image and this program have different mailbox layouts: build both from the same "
              "sources\n",
              stderr);
    }
    cosimulation_abandon();
}

static void translate(qemu_plugin_id_t id, struct qemu_plugin_tb *tb) {
    (void)id;
    for (size_t i = 0; i < qemu_plugin_tb_n_insns(tb); ++i) {
        struct qemu_plugin_insn *insn = qemu_plugin_tb_get_insn(tb, i);
        const char *symbol = qemu_plugin_insn_symbol(insn);
        if (symbol && strcmp(symbol, "doorbell_ring") == 0) {
            qemu_plugin_register_vcpu_mem_cb(insn, stored, QEMU_PLUGIN_CB_NO_REGS, QEMU_PLUGIN_MEM_W, NULL);
        }
    }
    if (counting) {
        instructions_translate(tb);
    }
    if (tracing) {
        trace_translate(tb);
    }
}

static mailbox_t *map_mailbox(const char *path) {
    const int descriptor = open(path, O_RDWR | O_CLOEXEC);
    void *memory = MAP_FAILED;
    if (descriptor >= 0) {
        memory = mmap(NULL, sizeof(mailbox_t), PROT_READ | PROT_WRITE, MAP_SHARED, descriptor, board->mailbox_offset);
        close(descriptor);
    }
    if (memory == MAP_FAILED) {
        fprintf(stderr, "salient: mailbox %s: %s\n", path, strerror(errno));
        exit(EXIT_USAGE);
    }
    return memory;
}

static const board_description_t *board_of(const char *target) {
    for (size_t i = 0; i < BOARD_COUNT; ++i) {
        if (strcmp(boards[i].target, target) == 0) {
            return &boards[i];
        }
    }
    return NULL;
}

/* The text after `key` if the argument begins with it, else NULL. */
static char *value_of(char *argument, const char *key) {
    return strncmp(argument, key, strlen(key)) == 0 ? argument + strlen(key) : NULL;
}

int qemu_plugin_install(qemu_plugin_id_t id, const qemu_info_t *info, int argc, char **argv) {
    static options_t options; /* the co-simulation keeps it */
    char *words[ARGUMENTS_MAX + 1] = {"salient"};
    int count = 1;
    const char *mailbox_path = NULL, *control_path = NULL, *deferred_path = NULL, *trace_path = NULL, *stack = "";
    bool timed = false;
    for (int i = 0; i < argc; ++i) {
        char *value;
        if ((value = value_of(argv[i], "argument="))) {
            if (count == ARGUMENTS_MAX) {
                fprintf(stderr, "salient: more than %d arguments\n", ARGUMENTS_MAX);
                exit(EXIT_USAGE);
            }
            words[count++] = strdup(value);
        } else if ((value = value_of(argv[i], "mailbox="))) {
            mailbox_path = value;
        } else if ((value = value_of(argv[i], "instructions="))) {
            control_path = strdup(value);
        } else if ((value = value_of(argv[i], "deferred="))) {
            deferred_path = strdup(value);
        } else if ((value = value_of(argv[i], "execution="))) {
            trace_path = strdup(value);
        } else if ((value = value_of(argv[i], "stack="))) {
            stack = value;
        } else if (strcmp(argv[i], "timed=1") == 0) {
            timed = true;
        } else {
            fprintf(stderr, "salient: %s: unrecognised plugin argument\n", argv[i]);
            exit(EXIT_USAGE);
        }
    }
    board = board_of(info->target_name);
    if (!mailbox_path || !info->system_emulation || !board) {
        fputs("salient: this plugin needs a board of boards.h and mailbox=FILE\n", stderr);
        exit(EXIT_USAGE);
    }
    mailbox = map_mailbox(mailbox_path);
    const options_result_t result = options_parse(&options, count, words);
    if (result != OPTIONS_RUN || !cosimulation_open(mailbox, &options, timed)) {
        exit(result == OPTIONS_HELP ? 0 : EXIT_USAGE);
    }
    on_exit(ended, NULL);
    counting = control_path || deferred_path;
    tracing = trace_path;
    if ((counting && !instructions_open(control_path, deferred_path)) || (tracing && !trace_open(trace_path, stack))) {
        exit(EXIT_USAGE);
    }
    qemu_plugin_register_vcpu_tb_trans_cb(id, translate);
    return 0;
}
