/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Starts QEMU with the image of a drive and the co-simulation host as plugin, in the same process:
 * command line, ready line and exit codes are the host executable's.
 */
#define _GNU_SOURCE /* memfd_create */

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <unistd.h>

#include "host/simulation.h"
#include "qemu/boards.h"

/* Reports errno of an operation on `subject`; returns the exit code. */
static int system_error(const char *subject) {
    fprintf(stderr, "salient: %s: %s\n", subject, strerror(errno));
    return EXIT_USAGE;
}

/* Writes ,KEY=VALUE in the syntax of QEMU: commas in the value are doubled. */
static void put_option(FILE *list, const char *key, const char *value) {
    fprintf(list, ",%s=", key);
    for (; *value; ++value) {
        if (*value == ',') {
            fputc(',', list);
        }
        fputc(*value, list);
    }
}

/* Shift with 2^shift equal to the number; -1 when the number is invalid. */
static int shift_of(const char *number) {
    static const char *const powers[] = {"1", "2", "4", "8", "16", "32", "64"};
    for (int shift = 0; shift < (int)(sizeof powers / sizeof powers[0]); ++shift) {
        if (strcmp(number, powers[shift]) == 0) {
            return shift;
        }
    }
    return -1;
}

/* Board of an image; NULL, after one line on stderr, on failure. */
static const board_description_t *board_of(const char *image) {
    FILE *file = fopen(image, "rb");
    if (!file) {
        system_error(image);
        return NULL;
    }
    Elf32_Ehdr header = {0}; /* little endian, like this computer */
    const bool whole = fread(&header, sizeof header, 1, file) == 1;
    fclose(file);
    if (whole && memcmp(header.e_ident, ELFMAG, SELFMAG) == 0 && header.e_ident[EI_CLASS] == ELFCLASS32) {
        for (size_t i = 0; i < BOARD_COUNT; ++i) {
            if (boards[i].elf_machine == header.e_machine) {
                return &boards[i];
            }
        }
    }
    fprintf(stderr, "salient: %s: not an image of a drive for a board of QEMU\n", image);
    return NULL;
}

/* Options of this program, which precede the options of the host executable. */
enum { INSTRUCTIONS, DEFERRED_INSTRUCTIONS, EXECUTION, INSTRUCTION_NS, OPTIONS };
#define VALUES_MAX 2

typedef struct {
    const char *name;
    const char *keys[VALUES_MAX]; /* of the plugin, for its values; NULL: no value, or none for the plugin */
    int values;
    const char *usage, *help;
} own_option_t;

static const own_option_t own_options[OPTIONS] = {
    [INSTRUCTIONS] = {"--instructions",
                      {"instructions"},
                      1,
                      "--instructions FILE",
                      "writes the number of instructions of each control interrupt as uint32_t"},
    [DEFERRED_INSTRUCTIONS] = {"--deferred-instructions",
                               {"deferred"},
                               1,
                               "--deferred-instructions FILE",
                               "the same of each deferred interrupt"},
    [EXECUTION] =
        {"--execution",
         {"execution", "stack"},
         2,
         "--execution FILE STACK",
         "writes the execution count of each block of instructions and the lowest address\n"
         "                                written on the stack, whose limits are STACK: END-BEGIN, hexadecimal"},
    [INSTRUCTION_NS] = {"--instruction-ns",
                        {NULL},
                        1,
                        "--instruction-ns N",
                        "execution time per instruction: a power of two up to 64; without this option\n"
                        "                                instructions take no time"},
};

/* Values of the options of this program, NULL where one is not given, and the arguments of the host executable. */
typedef struct {
    const char *image;
    char *const *values[OPTIONS];
    int count;
    char *const *arguments;
} invocation_t;

static void print_usage(const char *program) {
    printf("usage: %s IMAGE.elf", program);
    for (unsigned i = 0; i < OPTIONS; ++i) {
        printf(" [%s]", own_options[i].usage);
    }
    printf(" OPTION...\n"
           "  IMAGE.elf                     the drive, as built for a board of QEMU\n");
    for (unsigned i = 0; i < OPTIONS; ++i) {
        printf("  %-29s %s\n", own_options[i].usage, own_options[i].help);
    }
    printf("  OPTION                        as the host executable's; its --help lists them\n");
}

/* The option of this program that `arguments` begin with, with all its values; OPTIONS: none. */
static unsigned own_option(int count, char *const *arguments) {
    unsigned option = 0;
    while (option < OPTIONS &&
           !(count > own_options[option].values && strcmp(arguments[0], own_options[option].name) == 0)) {
        ++option;
    }
    return option;
}

static invocation_t parse(int argc, char *argv[]) {
    invocation_t invocation = {.image = argv[1], .count = argc - 2, .arguments = argv + 2};
    for (;;) {
        const unsigned option = own_option(invocation.count, invocation.arguments);
        if (option == OPTIONS) {
            return invocation;
        }
        invocation.values[option] = invocation.arguments + 1;
        invocation.count -= 1 + own_options[option].values;
        invocation.arguments += 1 + own_options[option].values;
    }
}

/* Shift of the time per instruction, 0 without one; -1, after one line on stderr, when it is not possible. */
static int instruction_shift(const invocation_t *invocation, const board_description_t *board) {
    if (!invocation->values[INSTRUCTION_NS]) {
        return 0;
    }
    const char *number = invocation->values[INSTRUCTION_NS][0];
    const int shift = shift_of(number);
    if (shift < 0) {
        fprintf(stderr, "salient: --instruction-ns %s: must be 1, 2, 4, 8, 16, 32 or 64\n", number);
    } else if (!board->timer) {
        fprintf(stderr, "salient: --instruction-ns %s: not on the board %s, whose port uses no timer\n", number,
                board->machine);
        return -1;
    }
    return shift;
}

/* The plugin with its arguments, as QEMU's option takes them. On the heap, for the life of the program. */
static char *plugin_option(const invocation_t *invocation, const char *mailbox) {
    char *plugin = NULL;
    size_t size;
    FILE *list = open_memstream(&plugin, &size);
    fputs(SALIENT_PLUGIN, list);
    put_option(list, "mailbox", mailbox);
    for (unsigned option = 0; option < OPTIONS; ++option) {
        for (unsigned n = 0; n < VALUES_MAX && invocation->values[option] && own_options[option].keys[n]; ++n) {
            put_option(list, own_options[option].keys[n], invocation->values[option][n]);
        }
    }
    if (invocation->values[INSTRUCTION_NS]) {
        put_option(list, "timed", "1");
    }
    for (int i = 0; i < invocation->count; ++i) {
        put_option(list, "argument", invocation->arguments[i]);
    }
    fclose(list);
    return plugin;
}

/* Becomes QEMU; returns the exit code when that is not possible. */
static int become_qemu(const invocation_t *invocation, const board_description_t *board, int shift) {
    const int memory = memfd_create("salient mailbox", 0); /* inherited by QEMU, freed when it ends */
    if (memory < 0 || ftruncate(memory, board->memory_bytes) != 0) {
        return system_error("the board's memory");
    }
    char path[64], machine[64], object[160], card[64] = "none", clock[64], name[64];
    snprintf(path, sizeof path, "/proc/self/fd/%d", memory);
    snprintf(machine, sizeof machine, "%s,memory-backend=shared", board->machine);
    snprintf(object, sizeof object, "memory-backend-file,id=shared,size=%u,share=on,mem-path=%s",
             (unsigned)board->memory_bytes, path);
    if (board->network_card) { /* QEMU warns about an unconnected card */
        int network[2];
        if (socketpair(AF_UNIX, SOCK_DGRAM, 0, network) != 0) {
            return system_error("a socket pair");
        }
        snprintf(card, sizeof card, "socket,model=%s,fd=%d", board->network_card, network[0]);
    }
    /* The clock of the timers counts instructions only. */
    snprintf(clock, sizeof clock, "shift=%d,align=off,sleep=off", shift);
    execlp(board->program, board->program, "-nodefaults", "-display", "none", "-nic", card, "-machine", machine,
           "-object", object, "-semihosting-config", "enable=on,target=native", "-bios", "none", "-kernel",
           invocation->image, "-plugin", plugin_option(invocation, path),
           invocation->values[INSTRUCTION_NS] ? "-icount" : (char *)NULL, clock, (char *)NULL);
    snprintf(name, sizeof name, "%s (Debian package %s)", board->program, board->package);
    return system_error(name);
}

int main(int argc, char *argv[]) {
    if (argc < 2 || strcmp(argv[1], "--help") == 0) {
        print_usage(argv[0]);
        return argc < 2 ? EXIT_USAGE : 0;
    }
    const invocation_t invocation = parse(argc, argv);
    const board_description_t *board = board_of(invocation.image);
    if (!board) {
        return EXIT_USAGE;
    }
    const int shift = instruction_shift(&invocation, board);
    return shift < 0 ? EXIT_USAGE : become_qemu(&invocation, board, shift);
}
