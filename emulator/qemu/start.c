/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Becomes QEMU with the image of one machine's drive, its world in the plugin: a program with the command line, the
 * ready line and the exit codes of the host executable.
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

static int mistake(const char *what) {
    fprintf(stderr, "salient: %s: %s\n", what, strerror(errno));
    return EXIT_USAGE;
}

/* ,KEY=VALUE as QEMU reads it: a comma in the value is written twice. */
static void put_option(FILE *list, const char *key, const char *value) {
    fprintf(list, ",%s=", key);
    for (; *value; ++value) {
        if (*value == ',') {
            fputc(',', list);
        }
        fputc(*value, list);
    }
}

/* 2^shift is the number; -1: it is none that is allowed. */
static int shift_of(const char *number) {
    static const char *const powers[] = {"1", "2", "4", "8", "16", "32", "64"};
    for (int shift = 0; shift < (int)(sizeof powers / sizeof powers[0]); ++shift) {
        if (strcmp(number, powers[shift]) == 0) {
            return shift;
        }
    }
    return -1;
}

/* The board that an image is for; NULL: one line on stderr said why. */
static const board_description_t *board_of(const char *image) {
    FILE *file = fopen(image, "rb");
    if (!file) {
        mistake(image);
        return NULL;
    }
    Elf32_Ehdr header = {0}; /* little endian, as this program's */
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

int main(int argc, char *argv[]) {
    if (argc < 2 || strcmp(argv[1], "--help") == 0) {
        printf("usage: %s IMAGE.elf [--instructions FILE] [--execution FILE STACK] [--instruction-ns N] OPTION...\n"
               "  IMAGE.elf            the drive, as built for a board of QEMU\n"
               "  --instructions FILE  writes the instructions of each control interrupt, a uint32_t each\n"
               "  --execution FILE STACK  writes how often each block of instructions was executed and how far\n"
               "                       down the stack was written to, whose end and beginning STACK are: END-BEGIN\n"
               "  --instruction-ns N   an instruction takes so long, a power of two up to 64; without it the drive\n"
               "                       takes no time\n"
               "  OPTION               as the host executable's; its --help lists them\n",
               argv[0]);
        return argc < 2 ? EXIT_USAGE : 0;
    }
    const char *image = argv[1], *instructions = NULL, *execution = NULL, *stack = NULL, *instruction_ns = NULL;
    int first = 2;
    if (argc > first + 1 && strcmp(argv[first], "--instructions") == 0) {
        instructions = argv[first + 1];
        first += 2;
    }
    if (argc > first + 2 && strcmp(argv[first], "--execution") == 0) {
        execution = argv[first + 1];
        stack = argv[first + 2];
        first += 3;
    }
    if (argc > first + 1 && strcmp(argv[first], "--instruction-ns") == 0) {
        instruction_ns = argv[first + 1];
        first += 2;
    }
    const board_description_t *board = board_of(image);
    if (!board) {
        return EXIT_USAGE;
    }
    const int shift = instruction_ns ? shift_of(instruction_ns) : 0;
    if (shift < 0) {
        fprintf(stderr, "salient: --instruction-ns %s: allowed are 1, 2, 4, 8, 16, 32 and 64\n", instruction_ns);
        return EXIT_USAGE;
    }
    if (instruction_ns && !board->timer) {
        fprintf(stderr, "salient: --instruction-ns %s: not on the board %s, whose port uses no timer\n", instruction_ns,
                board->machine);
        return EXIT_USAGE;
    }
    const int memory = memfd_create("salient mailbox", 0); /* inherited by QEMU, gone with it */
    if (memory < 0 || ftruncate(memory, board->memory_bytes) != 0) {
        return mistake("the board's memory");
    }
    char path[64], *machine = NULL, *object = NULL, *plugin = NULL;
    size_t size;
    snprintf(path, sizeof path, "/proc/self/fd/%d", memory);
    FILE *list = open_memstream(&machine, &size);
    fprintf(list, "%s,memory-backend=shared", board->machine);
    fclose(list);
    list = open_memstream(&object, &size);
    fprintf(list, "memory-backend-file,id=shared,size=%u,share=on,mem-path=%s", (unsigned)board->memory_bytes, path);
    fclose(list);
    list = open_memstream(&plugin, &size);
    fputs(SALIENT_PLUGIN, list);
    put_option(list, "mailbox", path);
    if (instructions) {
        put_option(list, "instructions", instructions);
    }
    if (execution) {
        put_option(list, "execution", execution);
        put_option(list, "stack", stack);
    }
    if (instruction_ns) {
        fputs(",timed=1", list);
    }
    for (int i = first; i < argc; ++i) {
        put_option(list, "argument", argv[i]);
    }
    fclose(list);
    char card[64] = "none";
    if (board->network_card) { /* it warns when nothing is at the other end */
        int network[2];
        if (socketpair(AF_UNIX, SOCK_DGRAM, 0, network) != 0) {
            return mistake("a socket pair");
        }
        snprintf(card, sizeof card, "socket,model=%s,fd=%d", board->network_card, network[0]);
    }
    /* The clock of the board's timers counts instructions, and nothing else. */
    char clock[64];
    snprintf(clock, sizeof clock, "shift=%d,align=off,sleep=off", shift);
    execlp(board->program, board->program, "-nodefaults", "-display", "none", "-nic", card, "-machine", machine,
           "-object", object, "-semihosting-config", "enable=on,target=native", "-bios", "none", "-kernel", image,
           "-plugin", plugin, instruction_ns ? "-icount" : (char *)NULL, clock, (char *)NULL);
    char name[64];
    snprintf(name, sizeof name, "%s (Debian package %s)", board->program, board->package);
    return mistake(name);
}
