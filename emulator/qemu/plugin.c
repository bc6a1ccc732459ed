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
static const char *value_of(const char *argument, const char *key) {
    return strncmp(argument, key, strlen(key)) == 0 ? argument + strlen(key) : NULL;
}

/* Arguments of the plugin. Strings outlive the installation where they are kept after it. */
typedef struct {
    char *words[ARGUMENTS_MAX + 1]; /* command line of the host executable */
    int count;
    const char *mailbox, *instructions, *deferred, *execution, *stack, *timed;
} arguments_t;

static void add_word(arguments_t *arguments, const char *word) {
    if (arguments->count == ARGUMENTS_MAX) {
        fprintf(stderr, "salient: more than %d arguments\n", ARGUMENTS_MAX);
        exit(EXIT_USAGE);
    }
    arguments->words[arguments->count++] = strdup(word);
}

static void parse(arguments_t *arguments, int argc, char **argv) {
    const struct {
        const char *key;
        const char **value;
    } values[] = {
        {"mailbox=", &arguments->mailbox},   {"instructions=", &arguments->instructions},
        {"deferred=", &arguments->deferred}, {"execution=", &arguments->execution},
        {"stack=", &arguments->stack},       {"timed=", &arguments->timed},
    };
    for (int i = 0; i < argc; ++i) {
        const char *word = value_of(argv[i], "argument=");
        bool known = word != NULL;
        if (word) {
            add_word(arguments, word);
        }
        for (size_t n = 0; !known && n < sizeof values / sizeof values[0]; ++n) {
            const char *value = value_of(argv[i], values[n].key);
            if (value) {
                *values[n].value = strdup(value);
                known = true;
            }
        }
        if (!known) {
            fprintf(stderr, "salient: %s: unrecognised plugin argument\n", argv[i]);
            exit(EXIT_USAGE);
        }
    }
}

int qemu_plugin_install(qemu_plugin_id_t id, const qemu_info_t *info, int argc, char **argv) {
    static options_t options; /* the co-simulation keeps it */
    arguments_t arguments = {.words = {"salient"}, .count = 1, .stack = ""};
    parse(&arguments, argc, argv);
    board = board_of(info->target_name);
    if (!arguments.mailbox || !info->system_emulation || !board) {
        fputs("salient: this plugin needs a board of boards.h and mailbox=FILE\n", stderr);
        exit(EXIT_USAGE);
    }
    mailbox = map_mailbox(arguments.mailbox);
    const options_result_t result = options_parse(&options, arguments.count, arguments.words);
    if (result != OPTIONS_RUN || !cosimulation_open(mailbox, &options, arguments.timed != NULL)) {
        exit(result == OPTIONS_HELP ? 0 : EXIT_USAGE);
    }
    on_exit(ended, NULL);
    counting = arguments.instructions || arguments.deferred;
    tracing = arguments.execution;
    if ((counting && !instructions_open(arguments.instructions, arguments.deferred)) ||
        (tracing && !trace_open(arguments.execution, arguments.stack))) {
        exit(EXIT_USAGE);
    }
    qemu_plugin_register_vcpu_tb_trans_cb(id, translate);
    return 0;
}
