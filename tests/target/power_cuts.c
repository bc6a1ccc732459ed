/* Power cuts at every operation of the memory, as tests/unit/storage/test_nvm_store.cpp makes them on the host: the
 * firmware compiled for the target, with the emulated flash in the memory of the board.
 *
 * Writes a line on standard error with single cuts, pairs of cuts, losses, mixed and failures of the sets of
 * parameters, and then of the faults in the log. There are no interrupts.
 */
#include "support/power_cuts.h"

#include "qemu/board.h"
#include "qemu/mps2_an386/timer.h"

#define WORK ((power_cuts_work_t *)0x21000000) /* the PSRAM, where a drive has the mailbox */
#define SYS_WRITE0 4

/* Symbols of the linker script. */
extern uint32_t bss_start[], bss_end[];

void program_interrupt(void) {}

void program_deferred(void) {}

void timer_start(uint32_t period_ticks) {
    (void)period_ticks;
}

void timer_handler(void) {}

static void print(const char *text) {
    register uint32_t operation __asm__("r0") = SYS_WRITE0;
    register const char *argument __asm__("r1") = text;
    __asm__ volatile("bkpt 0xAB" : "+r"(operation) : "r"(argument) : "memory");
}

static void print_number(uint32_t number) {
    char text[12];
    char *digit = &text[sizeof text - 1];
    *digit = '\0';
    *--digit = ' ';
    do {
        *--digit = (char)('0' + number % 10);
        number /= 10;
    } while (number > 0);
    print(digit);
}

static void report(const power_cuts_t *result) {
    print_number(result->cuts);
    print_number(result->pairs);
    print_number(result->losses);
    print_number(result->mixed);
    print_number(result->failures);
}

/* Pairs of cuts of the first write that erases. */
static bool paired_set(uint32_t number) {
    return number == SETS;
}

static bool paired_fault(uint32_t number) {
    return number == FAULTS;
}

noreturn void program_start(void) {
    memset(bss_start, 0, (size_t)((char *)bss_end - (char *)bss_start)); /* there are no other variables */
    power_cuts_t sets = {0}, faults = {0};
    cut_writes(&sets, WORK, WRITE_SET, SETS, paired_set);
    cut_writes(&faults, WORK, WRITE_FAULT, FAULTS, paired_fault);
    report(&sets);
    report(&faults);
    print("\n");
    board_exit(0);
}
