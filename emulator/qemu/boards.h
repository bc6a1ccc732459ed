/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * The boards that a drive runs on in QEMU: what an image for one looks like, how QEMU is started, where the memory is
 * that drive and world share.
 */
#ifndef BOARDS_H
#define BOARDS_H

#include <elf.h>
#include <stdbool.h>
#include <stdint.h>

typedef struct {
    uint16_t elf_machine; /* of the images */
    const char *target;   /* QEMU's name of the processor, in a plugin */
    const char *program;  /* QEMU's executable */
    const char *package;  /* that has it in Debian */
    const char *machine;  /* QEMU's name of the board */
    /* Of the shared memory; the sizes are those that the board takes. The mailbox is in it at an offset. */
    uint32_t memory_address;
    uint32_t memory_bytes;
    uint32_t mailbox_offset;
    bool timer;               /* its port uses one: the processor may take time */
    const char *network_card; /* one that the board always has, or NULL */
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
        .memory_address = 0x80000000, /* all of the board's RAM; the device tree that QEMU puts there is at 16 MiB */
        .memory_bytes = 32 * 1024 * 1024,
        .mailbox_offset = 8 * 1024 * 1024,
    },
};

#define BOARD_COUNT (sizeof boards / sizeof boards[0])

#endif
