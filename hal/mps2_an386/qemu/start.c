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

#include "host/bench.h"
#include "mps2_an386/mailbox.h"

#define QEMU "qemu-system-arm"
#define EXIT_MISTAKE BENCH_EXIT_MISTAKE

static int mistake(const char *what) {
    fprintf(stderr, "salient: %s: %s\n", what, strerror(errno));
    return EXIT_MISTAKE;
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

int main(int argc, char *argv[]) {
    if (argc < 2 || strcmp(argv[1], "--help") == 0) {
        printf("usage: %s IMAGE.elf [--instructions FILE] [--execution FILE STACK] OPTION...\n"
               "  IMAGE.elf            the drive, as built for the Cortex-M4\n"
               "  --instructions FILE  writes the instructions of each control interrupt, a uint32_t each\n"
               "  --execution FILE STACK  writes how often each block of instructions was executed and how far\n"
               "                       down the stack was written to, whose end and beginning STACK are: END-BEGIN\n"
               "  OPTION               as the host executable's; its --help lists them\n",
               argv[0]);
        return argc < 2 ? EXIT_MISTAKE : 0;
    }
    const char *image = argv[1], *instructions = NULL, *execution = NULL, *stack = NULL;
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
    if (access(image, R_OK) != 0) {
        return mistake(image);
    }
    const int memory = memfd_create("salient mailbox", 0); /* inherited by QEMU, gone with it */
    if (memory < 0 || ftruncate(memory, MAILBOX_MEMORY_BYTES) != 0) {
        return mistake("the board's memory");
    }
    int network[2]; /* the board's network card warns when nothing is at the other end */
    if (socketpair(AF_UNIX, SOCK_DGRAM, 0, network) != 0) {
        return mistake("a socket pair");
    }
    char path[64], card[64], *object = NULL, *plugin = NULL;
    size_t object_size, plugin_size;
    snprintf(path, sizeof path, "/proc/self/fd/%d", memory);
    snprintf(card, sizeof card, "socket,model=lan9118,fd=%d", network[0]);
    FILE *list = open_memstream(&object, &object_size);
    fprintf(list, "memory-backend-file,id=psram,size=%d,share=on,mem-path=%s", MAILBOX_MEMORY_BYTES, path);
    fclose(list);
    list = open_memstream(&plugin, &plugin_size);
    fputs(SALIENT_PLUGIN, list);
    put_option(list, "mailbox", path);
    if (instructions) {
        put_option(list, "instructions", instructions);
    }
    if (execution) {
        put_option(list, "execution", execution);
        put_option(list, "stack", stack);
    }
    for (int i = first; i < argc; ++i) {
        put_option(list, "argument", argv[i]);
    }
    fclose(list);
    execlp(QEMU, QEMU, "-nodefaults", "-display", "none", "-nic", card, "-machine", "mps2-an386,memory-backend=psram",
           "-object", object, "-semihosting-config", "enable=on,target=native", "-kernel", image, "-plugin", plugin,
           (char *)NULL);
    return mistake(QEMU " (Debian package qemu-system-arm)");
}
