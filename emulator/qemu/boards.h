/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * QEMU boards that a drive runs on: properties of their images, arguments of QEMU, address of the memory shared by
 * drive and co-simulation host.
 */
#ifndef BOARDS_H
#define BOARDS_H

#include <elf.h>
#include <stdbool.h>
#include <stdint.h>

typedef struct {
    uint16_t elf_machine; /* of the images */
    const char *target;   /* name of the processor that QEMU passes to plugins */
    const char *program;  /* QEMU's executable */
    const char *package;  /* Debian package of the executable */
    const char *machine;  /* QEMU's name of the board */
    /* Shared memory, of a size that the board accepts; the mailbox is at an offset in it. */
    uint32_t memory_address;
    uint32_t memory_bytes;
    uint32_t mailbox_offset;
    bool timer;               /* the port uses a timer: instruction timing is available */
    const char *network_card; /* model that is always part of the board, or NULL */
} board_description_t;

static const board_description_t boards[] = {
    {
        .elf_machine = EM_ARM,
        .target = "arm",
        .program = "qemu-system-arm",
        .package = "qemu-system-arm",
        .machine = "mps2-an386",
        .memory_address = 0x21000000, /* PSRAM */
        .memory_bytes = 16 * 1024 * 1024,
        .mailbox_offset = 0,
        .timer = true,
        .network_card = "lan9118",
    },
    {
        .elf_machine = EM_RISCV,
        .target = "riscv32",
        .program = "qemu-system-riscv32",
        .package = "qemu-system-misc",
        .machine = "virt",
        .memory_address = 0x80000000, /* the whole RAM; QEMU places the device tree at 16 MiB */
        .memory_bytes = 32 * 1024 * 1024,
        .mailbox_offset = 8 * 1024 * 1024,
    },
};

#define BOARD_COUNT (sizeof boards / sizeof boards[0])

#endif
