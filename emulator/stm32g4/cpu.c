/* SPDX-License-Identifier: GPL-2.0-or-later */
#include "stm32g4/cpu.h"

#include <elf.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unicorn/unicorn.h>

#include "stm32g4/cycles.h"
#include "stm32g4/flash.h"
#include "stm32g4/nvic.h"
#include "stm32g4/soc.h"

#define ENTRY_CYCLES 12 /* of an exception, its stacking included */
#define RETURN_CYCLES 10
#define TAIL_CHAIN_CYCLES 6
#define FRAME_BYTES 32
#define FRAME_ALIGNED 0x200u /* bit 9 of the stacked xPSR */
#define THUMB 0x01000000u
#define OPCODE_WFI 0xBF30
#define CODE_SLOTS (FLASH_BANK_BYTES / 2)
#define WAITS_FOR_EVER 50000000u /* instructions at one instant */

cpu_t cpu;

static uc_engine *engine;
static uint64_t until, at_instant;
static unsigned cost; /* cycles of the block that executes */
static bool returns;  /* EXC_RETURN was loaded into the program counter */
static uint64_t invalid_address;
static struct {
    uint32_t size;
    uint16_t cycles, instructions;
    uint8_t wait_states;
} blocks[CODE_SLOTS];

static void check(uc_err error, const char *what) {
    if (error) {
        fprintf(stderr, "salient_stm32g4: %s: %s\n", what, uc_strerror(error));
        exit(EXIT_VIOLATION);
    }
}

static uint32_t get(int reg) {
    uint32_t value = 0;
    uc_reg_read(engine, reg, &value);
    return value;
}

static void set(int reg, uint32_t value) {
    uc_reg_write(engine, reg, &value);
}

uint32_t cpu_program_counter(void) {
    return engine ? get(UC_ARM_REG_PC) & ~1u : 0;
}

unsigned cpu_exception(void) {
    return get(UC_ARM_REG_XPSR) & 0x1FF;
}

static unsigned candidate(void) {
    return nvic_any() ? nvic_candidate(get(UC_ARM_REG_PRIMASK) & 1, get(UC_ARM_REG_BASEPRI)) : 0;
}

/* --- Hooks --- */

/* Cycles and instructions of a block; a block of the flash is counted once. */
static void measure(uint64_t address, uint32_t size, unsigned *cycles, unsigned *instructions) {
    const unsigned wait_states = flash_wait_states();
    const uint64_t slot = (address - FLASH_BASE) / 2;
    const bool in_flash = address >= FLASH_BASE && slot < CODE_SLOTS;
    if (in_flash && blocks[slot].size == size && blocks[slot].wait_states == wait_states) {
        *cycles = blocks[slot].cycles;
        *instructions = blocks[slot].instructions;
        return;
    }
    uint8_t code[8192];
    const uint32_t length = size < sizeof code ? size : sizeof code;
    uc_mem_read(engine, address, code, length);
    if (cycles_floating(code, length)) {
        soc_violation("fault of the processor: floating-point instruction from 0x%08X on, the unit is off",
                      (uint32_t)address);
    }
    *cycles = cycles_of(code, length, in_flash ? wait_states : 0);
    *instructions = cycles_instructions(code, length);
    if (in_flash) {
        blocks[slot].size = size;
        blocks[slot].cycles = (uint16_t)*cycles;
        blocks[slot].instructions = (uint16_t)*instructions;
        blocks[slot].wait_states = (uint8_t)wait_states;
    }
}

static void block_begins(uc_engine *uc, uint64_t address, uint32_t size, void *context) {
    (void)context;
    const uint64_t now = soc.now + cost;
    cost = 0;
    if (now >= soc.next) {
        soc_advance(now);
    } else {
        soc.now = now;
    }
    if (cpu.exited || soc.reset_request || soc.now >= until || candidate()) {
        uc_emu_stop(uc); /* before the block */
        return;
    }
    unsigned cycles, instructions;
    measure(address, size, &cycles, &instructions);
    cost = soc.untimed ? 0 : cycles;
    cpu.instructions += instructions;
    ++cpu.blocks;
    at_instant = soc.untimed ? at_instant + instructions : 0;
    if (at_instant > WAITS_FOR_EVER) {
        soc_violation("the program waits without end where instructions take no time");
    }
}

static void exception(uc_engine *uc, uint32_t number, void *context) {
    (void)context;
    static const char *const names[] = {
        [1] = "undefined instruction",
        [2] = "SVC, which is not modelled",
        [3] = "instruction outside of the memory",
        [4] = "access outside of the memory",
        [17] = "floating-point instruction, whose unit is off",
        [18] = "branch to ARM state",
        [22] = "unaligned access",
    };
    if (number == 8) {
        returns = true;
    } else if (number == 7) {
        cpu.exited = true;
        cpu.exit_code = (int)get(UC_ARM_REG_R0);
    } else {
        const bool named = number < sizeof names / sizeof names[0] && names[number];
        soc_violation("fault of the processor: %s", named ? names[number] : "exception");
    }
    uc_emu_stop(uc);
}

static bool invalid(uc_engine *uc, uc_mem_type type, uint64_t address, int size, int64_t value, void *context) {
    (void)uc;
    (void)size;
    (void)context;
    invalid_address = address;
    switch (type) {
    case UC_MEM_WRITE_PROT:
        soc_violation("write of 0x%08X to 0x%08X, the bank that the program runs from or a read-only memory",
                      (uint32_t)value, (uint32_t)address);
    case UC_MEM_WRITE_UNMAPPED:
        soc_violation("fault of the processor: write of 0x%08X to 0x%08X, where nothing is", (uint32_t)value,
                      (uint32_t)address);
    case UC_MEM_FETCH_UNMAPPED:
    case UC_MEM_FETCH_PROT:
        if ((address & 0xFFFFFF00u) == 0xFFFFFF00u) {
            return false; /* EXC_RETURN, if anything */
        }
        soc_violation("fault of the processor: instruction at 0x%08X, where no code is", (uint32_t)address);
    default:
        soc_violation("fault of the processor: read at 0x%08X, where nothing is", (uint32_t)address);
    }
}

/* --- Exceptions --- */

static void spend(unsigned cycles) {
    if (!soc.untimed) {
        soc_advance(soc.now + cycles);
    }
}

static void enter(unsigned number) {
    const uint32_t psr = get(UC_ARM_REG_XPSR), stack = get(UC_ARM_REG_SP);
    if (get(UC_ARM_REG_CONTROL) & 2) {
        soc_violation("CONTROL.SPSEL: the process stack is not modelled");
    }
    const uint32_t frame[] = {
        get(UC_ARM_REG_R0),       get(UC_ARM_REG_R1),
        get(UC_ARM_REG_R2),       get(UC_ARM_REG_R3),
        get(UC_ARM_REG_R12),      get(UC_ARM_REG_LR),
        get(UC_ARM_REG_PC) & ~1u, (psr & ~FRAME_ALIGNED) | THUMB | (stack & 4 ? FRAME_ALIGNED : 0),
    };
    const uint32_t top = (stack - FRAME_BYTES) & ~7u;
    if (uc_mem_write(engine, top, frame, sizeof frame)) {
        soc_violation("fault of the processor: the stack pointer 0x%08X at the entry of exception %u", stack, number);
    }
    uint32_t vector = 0;
    uc_mem_read(engine, nvic_vectors() + 4 * number, &vector, sizeof vector);
    if (!(vector & 1)) {
        soc_violation("vector %u is 0x%08X, not an address of Thumb code", number, vector);
    }
    set(UC_ARM_REG_SP, top);
    set(UC_ARM_REG_LR, psr & 0x1FF ? 0xFFFFFFF1 : 0xFFFFFFF9);
    set(UC_ARM_REG_XPSR, (psr & 0xF80F0000) | THUMB | number);
    set(UC_ARM_REG_PC, vector | 1);
    nvic_enter(number);
    cpu.asleep = false;
    ++cpu.exceptions;
}

/* End of a handler: the next exception follows without a return, or the frame is restored. */
static void leave(void) {
    const uint32_t link = get(UC_ARM_REG_PC) | 1, psr = get(UC_ARM_REG_XPSR), stack = get(UC_ARM_REG_SP);
    nvic_leave(psr & 0x1FF);
    (void)link;
    uint32_t frame[8];
    if (uc_mem_read(engine, stack, frame, sizeof frame)) {
        soc_violation("fault of the processor: the stack pointer 0x%08X at the end of an exception", stack);
    }
    set(UC_ARM_REG_XPSR, frame[7] & ~FRAME_ALIGNED);
    set(UC_ARM_REG_SP, stack + FRAME_BYTES + (frame[7] & FRAME_ALIGNED ? 4 : 0));
    static const int registers[] = {UC_ARM_REG_R0, UC_ARM_REG_R1,  UC_ARM_REG_R2,
                                    UC_ARM_REG_R3, UC_ARM_REG_R12, UC_ARM_REG_LR};
    for (unsigned i = 0; i < sizeof registers / sizeof registers[0]; ++i) {
        set(registers[i], frame[i]);
    }
    set(UC_ARM_REG_PC, frame[6] | 1);
}

/* Takes exceptions after the end of a handler (`chained`) or before an instruction. One that comes during the stacking
 * with a higher priority runs first. */
static void take_exceptions(bool chained) {
    unsigned number = candidate();
    if (!number) {
        spend(chained ? RETURN_CYCLES : 0);
        number = candidate();
        chained = false;
        if (!number) {
            return;
        }
    }
    cpu.tail_chained += chained;
    spend(chained ? TAIL_CHAIN_CYCLES : ENTRY_CYCLES);
    enter(candidate());
}

/* --- Running --- */

/* The processor stopped after WFI. */
static bool waits(void) {
    uint16_t opcode = 0;
    uc_mem_read(engine, cpu_program_counter() - 2, &opcode, sizeof opcode);
    return opcode == OPCODE_WFI;
}

static void execute(void) {
    cost = 0;
    returns = false;
    const uc_err error = uc_emu_start(engine, get(UC_ARM_REG_PC) | 1, 0xFFFFFFFE, 0, 0);
    if (cost) {
        soc_advance(soc.now + cost);
        cost = 0;
    }
    if (returns) {
        leave();
        take_exceptions(true);
        return;
    }
    if (error) {
        soc_violation("fault of the processor: %s",
                      error == UC_ERR_INSN_INVALID ? "undefined instruction" : uc_strerror(error));
    }
    if (!cpu.exited && waits()) {
        cpu.asleep = true;
    }
}

/* Sleeps to the next event, at most to the end of the run. */
static void sleep_on(void) {
    soc_advance(soc.next < until ? soc.next : until);
}

void cpu_run(uint64_t end, bool to_sleep) {
    until = end;
    at_instant = 0;
    while (!cpu.exited && !soc.reset_request && soc.now < until) {
        if (candidate()) {
            take_exceptions(false);
        } else if (cpu.asleep && nvic_any() && nvic_candidate(false, get(UC_ARM_REG_BASEPRI))) {
            cpu.asleep = false; /* woken, but PRIMASK holds the exception back */
        } else if (!cpu.asleep) {
            execute();
        } else if (to_sleep || soc.next == SOC_NEVER) {
            return;
        } else {
            sleep_on();
        }
    }
}

void cpu_run_handlers(void) {
    until = SOC_NEVER;
    at_instant = 0;
    while (!cpu.exited && !soc.reset_request && (candidate() || cpu_exception())) {
        if (candidate()) {
            take_exceptions(false);
        } else {
            execute();
        }
    }
}

void cpu_stall(uint64_t to) {
    cost = to > soc.now ? (unsigned)(to - soc.now) : 0;
}

/* --- Memory --- */

static uint64_t peripheral_read(uc_engine *uc, uint64_t offset, unsigned size, void *context) {
    (void)uc;
    (void)context;
    return soc_read(0x40000000u + (uint32_t)offset, size);
}

static void peripheral_write(uc_engine *uc, uint64_t offset, unsigned size, uint64_t value, void *context) {
    (void)uc;
    (void)context;
    soc_write(0x40000000u + (uint32_t)offset, (uint32_t)value, size);
}

static uint64_t processor_read(uc_engine *uc, uint64_t offset, unsigned size, void *context) {
    (void)uc;
    (void)context;
    return nvic_read((uint32_t)offset, size);
}

static void processor_write(uc_engine *uc, uint64_t offset, unsigned size, uint64_t value, void *context) {
    (void)uc;
    (void)context;
    nvic_write((uint32_t)offset, (uint32_t)value, size);
}

static uint64_t bank_2_read(uc_engine *uc, uint64_t offset, unsigned size, void *context) {
    (void)uc;
    (void)context;
    return flash_bank_2_read((uint32_t)offset, size);
}

static void bank_2_write(uc_engine *uc, uint64_t offset, unsigned size, uint64_t value, void *context) {
    (void)uc;
    (void)context;
    flash_bank_2_write((uint32_t)offset, (uint32_t)value, size);
}

uint32_t cpu_memory_read(uint32_t address, unsigned size) {
    uint32_t value = 0;
    if (uc_mem_read(engine, address, &value, size)) {
        soc_violation("DMA: read of 0x%08X, where nothing is", address);
    }
    return value;
}

void cpu_memory_write(uint32_t address, uint32_t value, unsigned size) {
    if (address < SRAM_BASE || uc_mem_write(engine, address, &value, size)) {
        soc_violation("DMA: write of 0x%X to 0x%08X, where no memory is", value, address);
    }
}

static void torn_read(uc_engine *uc, uc_mem_type type, uint64_t address, int size, int64_t value, void *context) {
    (void)uc;
    (void)type;
    (void)size;
    (void)value;
    (void)context;
    flash_double_error((uint32_t)address - FLASH_BASE);
}

void cpu_tear(uint32_t address) {
    uc_hook hook;
    check(uc_hook_add(engine, &hook, UC_HOOK_MEM_READ, (void *)torn_read, NULL, address, address + 7),
          "hook of a torn word");
}

void cpu_open(void) {
    check(uc_open(UC_ARCH_ARM, UC_MODE_THUMB | UC_MODE_MCLASS, &engine), "Unicorn");
    check(uc_ctl_set_cpu_model(engine, UC_CPU_ARM_CORTEX_M4), "Cortex-M4");
    const uint32_t all = UC_PROT_ALL, code = UC_PROT_READ | UC_PROT_EXEC;
    check(uc_mem_map_ptr(engine, FLASH_BASE, FLASH_BANK_BYTES, code, soc.flash), "flash");
    check(uc_mem_map_ptr(engine, 0, FLASH_BANK_BYTES, code, soc.flash), "alias of the flash");
    check(uc_mmio_map(engine, FLASH_BASE + FLASH_BANK_BYTES, FLASH_BANK_BYTES, bank_2_read, NULL, bank_2_write, NULL),
          "bank 2");
    check(uc_mem_map_ptr(engine, SRAM_BASE, SRAM_BYTES, all, soc.sram), "SRAM");
    check(uc_mem_map_ptr(engine, CCM_BASE, CCM_BYTES, all, soc.sram + SRAM_BYTES - CCM_BYTES), "CCM SRAM");
    check(uc_mem_map_ptr(engine, 0x1FFF7000, 0x1000, UC_PROT_READ, flash_system_memory()), "system memory");
    check(uc_mmio_map(engine, 0x40000000, 0x20000000, peripheral_read, NULL, peripheral_write, NULL), "peripherals");
    check(uc_mmio_map(engine, 0xE0000000, 0x100000, processor_read, NULL, processor_write, NULL), "processor");
    uc_hook hook;
    check(uc_hook_add(engine, &hook, UC_HOOK_BLOCK, (void *)block_begins, NULL, 1, 0), "hook of blocks");
    check(uc_hook_add(engine, &hook, UC_HOOK_INTR, (void *)exception, NULL, 1, 0), "hook of exceptions");
    check(uc_hook_add(engine, &hook, UC_HOOK_MEM_INVALID, (void *)invalid, NULL, 1, 0), "hook of faults");
}

static noreturn void refuse(const char *path, const char *why) {
    fprintf(stderr, "salient_stm32g4: %s: %s\n", path, why);
    exit(2);
}

static uint8_t *read_file(const char *path, long *size) {
    FILE *file = fopen(path, "rb");
    if (!file) {
        refuse(path, "cannot be read");
    }
    fseek(file, 0, SEEK_END);
    *size = ftell(file);
    rewind(file);
    uint8_t *data = malloc(*size > 0 ? (size_t)*size : 1);
    if (!data || fread(data, 1, (size_t)*size, file) != (size_t)*size) {
        refuse(path, "cannot be read");
    }
    fclose(file);
    return data;
}

void cpu_load(const char *path) {
    long size;
    uint8_t *data = read_file(path, &size);
    Elf32_Ehdr header;
    if (size < (long)sizeof header || memcmp(data, ELFMAG, SELFMAG) != 0 || data[EI_CLASS] != ELFCLASS32) {
        refuse(path, "not an ELF file of 32 bits");
    }
    memcpy(&header, data, sizeof header);
    if (header.e_machine != EM_ARM) {
        refuse(path, "not an image for a Cortex-M");
    }
    for (unsigned i = 0; i < header.e_phnum; ++i) {
        Elf32_Phdr segment;
        memcpy(&segment, data + header.e_phoff + i * sizeof segment, sizeof segment);
        if (segment.p_type != PT_LOAD || segment.p_filesz == 0) {
            continue;
        }
        if (segment.p_paddr < FLASH_BASE || segment.p_paddr + segment.p_filesz > FLASH_BASE + FLASH_BANK_BYTES) {
            refuse(path, "a segment is not within bank 1 of the flash, 0x08000000 to 0x0803FFFF");
        }
        memcpy(soc.flash + (segment.p_paddr - FLASH_BASE), data + segment.p_offset, segment.p_filesz);
    }
    free(data);
}

void cpu_reset(void) {
    uint32_t vector[2];
    memcpy(vector, soc.flash, sizeof vector);
    nvic_reset();
    cost = 0;
    cpu.asleep = false;
    set(UC_ARM_REG_XPSR, THUMB);
    set(UC_ARM_REG_PRIMASK, 0);
    set(UC_ARM_REG_BASEPRI, 0);
    set(UC_ARM_REG_CONTROL, 0);
    set(UC_ARM_REG_LR, 0xFFFFFFFF);
    set(UC_ARM_REG_SP, vector[0]);
    set(UC_ARM_REG_PC, vector[1] | 1);
}
