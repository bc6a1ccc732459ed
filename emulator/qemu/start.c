/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Starts QEMU with the image of a drive and the co-simulation host as plugin, in the same process:
 * command line, ready line and exit codes are those of the host executable.
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

int main(int argc, char *argv[]) {
    if (argc < 2 || strcmp(argv[1], "--help") == 0) {
        printf("usage: %s IMAGE.elf [--instructions FILE] [--deferred-instructions FILE] [--execution FILE STACK] "
               "[--instruction-ns N] OPTION...\n"
               "  IMAGE.elf            the drive, as built for a board of QEMU\n"
               "  --instructions FILE  writes the number of instructions of each control interrupt as uint32_t\n"
               "  --deferred-instructions FILE  the same of each deferred interrupt\n"
               "  --execution FILE STACK  writes the execution count of each block of instructions and the lowest\n"
               "                       address written on the stack, whose limits are STACK: END-BEGIN, hexadecimal\n"
               "  --instruction-ns N   execution time per instruction: a power of two up to 64; without this option\n"
               "                       instructions take no time\n"
               "  OPTION               as the host executable's; its --help lists them\n",
               argv[0]);
        return argc < 2 ? EXIT_USAGE : 0;
    }
    const char *image = argv[1], *instructions = NULL, *deferred = NULL, *execution = NULL, *stack = NULL,
               *instruction_ns = NULL;
    int first = 2;
    if (argc > first + 1 && strcmp(argv[first], "--instructions") == 0) {
        instructions = argv[first + 1];
        first += 2;
    }
    if (argc > first + 1 && strcmp(argv[first], "--deferred-instructions") == 0) {
        deferred = argv[first + 1];
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
        fprintf(stderr, "salient: --instruction-ns %s: must be 1, 2, 4, 8, 16, 32 or 64\n", instruction_ns);
        return EXIT_USAGE;
    }
    if (instruction_ns && !board->timer) {
        fprintf(stderr, "salient: --instruction-ns %s: not on the board %s, whose port uses no timer\n", instruction_ns,
                board->machine);
        return EXIT_USAGE;
    }
    const int memory = memfd_create("salient mailbox", 0); /* inherited by QEMU, freed when it ends */
    if (memory < 0 || ftruncate(memory, board->memory_bytes) != 0) {
        return system_error("the board's memory");
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
    if (deferred) {
        put_option(list, "deferred", deferred);
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
    if (board->network_card) { /* QEMU warns about an unconnected card */
        int network[2];
        if (socketpair(AF_UNIX, SOCK_DGRAM, 0, network) != 0) {
            return system_error("a socket pair");
        }
        snprintf(card, sizeof card, "socket,model=%s,fd=%d", board->network_card, network[0]);
    }
    /* The clock of the timers counts instructions only. */
    char clock[64];
    snprintf(clock, sizeof clock, "shift=%d,align=off,sleep=off", shift);
    execlp(board->program, board->program, "-nodefaults", "-display", "none", "-nic", card, "-machine", machine,
           "-object", object, "-semihosting-config", "enable=on,target=native", "-bios", "none", "-kernel", image,
           "-plugin", plugin, instruction_ns ? "-icount" : (char *)NULL, clock, (char *)NULL);
    char name[64];
    snprintf(name, sizeof name, "%s (Debian package %s)", board->program, board->package);
    return system_error(name);
}
