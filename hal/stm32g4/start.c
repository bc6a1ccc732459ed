/* Vectors, start and main program. */
#include <string.h>

#include "drive/drive.h"
#include "hal_memory.h"
#include "stm32g4/board.h"
#include "stm32g4/core.h"
#include "stm32g4/registers.h"

/* Symbols of the linker script. */
extern const uint32_t code_start[];
extern uint32_t data_start[], data_end[], data_load[], bss_start[], bss_end[], stack_end[], stack_top[];

hal_t board;
static drive_t drive;

#ifdef MACHINE_TABLES_VARIABLE
/* Tables of the program: what its variable begins with. Those in the memory take its place before the drive starts. */
static void load_tables(void) {
    const uintptr_t offset = (uintptr_t)&machine_tables - (uintptr_t)data_start;
    const machine_tables_t *built_in = (const machine_tables_t *)((uintptr_t)data_load + offset);
    (void)table_store_load(&board, board_control_rate_hz, built_in, &machine_tables);
}

#define STORED_TABLES true
#else
static void load_tables(void) {}

#define STORED_TABLES false
#endif

static void control_handler(void) {
    if (control_begin(&board)) {
        drive_control_interrupt(&drive, &board);
    }
    control_end(&board);
}

static void deferred_handler(void) {
    drive_deferred_interrupt(&drive, &board);
}

static void can_handler(void) {
    can_interrupt(&board);
}

/* Double error of the flash, or the crystal has stopped, which has broken both timers already. */
static void nmi_handler(void) {
    if ((RCC_CIFR & RCC_CIFR_CSSF) || !nvm_error_in_parameters()) {
        board_halt();
    }
}

static void fault_handler(void) {
    board_halt();
}

static noreturn void run(void) {
    SCB_VTOR = (uint32_t)(uintptr_t)code_start;
    board.watchdog_reset = (RCC_CSR & RCC_CSR_IWDGRSTF) != 0;
    RCC_CSR |= RCC_CSR_RMVF;
    clock_init();
    pins_init();
    encoder_init();
    time_init();
    pwm_init();
    break_init();
    adc_init(&board);
    can_init();
    random_init();
    const drive_config_t config = {
        .control_rate_hz = board_control_rate_hz,
        .controller = (drive_controller_t)BOARD_CONTROLLER,
        .node = BOARD_NODE,
        .telemetry_period_ms = BOARD_TELEMETRY_PERIOD_MS,
        .stored_tables = STORED_TABLES,
    };
    load_tables();
    const bool started = drive_init(&drive, &board, &config);
    board_interrupts_enable(&board);
    for (;;) {
        __asm__ volatile("wfi" ::: "memory"); /* the next period's interrupt is the longest wait */
        if (started) {
            drive_background(&drive, &board);
        }
    }
}

/* Far enough below the present frame for the frames of the calls here. */
__attribute__((noipa)) static void stack_paint(void) {
    const volatile uint32_t *const end = (uint32_t *)__builtin_frame_address(0) - 64;
    for (volatile uint32_t *word = stack_end; word < end; word++) {
        *word = HAL_STACK_UNUSED;
    }
}

__attribute__((used)) noreturn void program_start(void) {
    __asm__ volatile("cpsid i" ::: "memory");
    stack_paint();
    (void)memcpy(data_start, data_load, (size_t)((char *)data_end - (char *)data_start));
    (void)memset(bss_start, 0, (size_t)((char *)bss_end - (char *)bss_start));
    run();
}

typedef void (*vector_t)(void);
#define INTERRUPTS 102

__attribute__((section(".first"), used)) static const struct {
    uint32_t *stack;
    vector_t exceptions[15];
    vector_t interrupts[INTERRUPTS];
} vectors = {
    .stack = stack_top,
    .exceptions = {program_start, nmi_handler, fault_handler, fault_handler, fault_handler, fault_handler,
                   fault_handler, fault_handler, fault_handler, fault_handler, fault_handler, fault_handler,
                   fault_handler, deferred_handler, fault_handler},
    /* No other one is enabled; the address 0 of one that comes all the same is a fault. */
    .interrupts = {[FDCAN1_IT0_IRQ] = can_handler, [ADC5_IRQ] = control_handler},
};
