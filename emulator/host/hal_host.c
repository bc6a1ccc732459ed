#include "host/hal_host.h"

#include <stdio.h>
#include <stdlib.h>

#include "hal_adc.h"
#include "hal_can.h"
#include "hal_encoder.h"
#include "hal_interrupt.h"
#include "hal_memory.h"
#include "hal_nvm.h"
#include "hal_pwm.h"
#include "hal_random.h"
#include "hal_time.h"
#include "hal_watchdog.h"
#include "plant/pwm_timer.h"

static const char *const context_names[] = {
    [BOARD_START] = "the background",
    [BOARD_INTERRUPT] = "the control interrupt",
    [BOARD_DEFERRED] = "the deferred interrupt",
    [BOARD_BACKGROUND] = "the background",
};

static void abort_call(const hal_t *hal, board_context_t required, const char *function) {
    fprintf(stderr, "salient: firmware called %s from %s, must be from %s\n", function,
            context_names[hal->board->context], context_names[required]);
    abort();
}

/* Aborts when the firmware calls a function from a context that the HAL does not allow. */
static void require(const hal_t *hal, bool interrupt, const char *function) {
    const board_context_t context = hal->board->context;
    if ((context == BOARD_INTERRUPT) != interrupt || context == BOARD_DEFERRED) {
        abort_call(hal, interrupt ? BOARD_INTERRUPT : BOARD_BACKGROUND, function);
    }
}

unsigned hal_adc_bits(const hal_t *hal) {
    return hal->board->adc_bits;
}

void hal_adc_read(const hal_t *hal, hal_adc_sample_t *sample) {
    require(hal, true, __func__);
    *sample = hal->board->adc;
}

uint16_t hal_adc_temperature(const hal_t *hal, unsigned sensor) {
    require(hal, false, __func__);
    return hal->board->temperature_code[sensor];
}

unsigned hal_encoder_bits(const hal_t *hal) {
    return hal->board->encoder_bits;
}

void hal_encoder_read(const hal_t *hal, hal_encoder_sample_t *sample) {
    require(hal, true, __func__);
    *sample = hal->board->encoder;
}

uint32_t hal_pwm_clock_hz(const hal_t *hal) {
    (void)hal;
    return PWM_TIMER_CLOCK_HZ;
}

void hal_pwm_start(hal_t *hal, uint16_t period_ticks) {
    require(hal, false, __func__);
    board_pwm_start(hal->board, period_ticks);
}

void hal_pwm_write(hal_t *hal, const hal_pwm_compare_t *compare) {
    require(hal, true, __func__);
    board_pwm_write(hal->board, compare);
}

void hal_pwm_open_all(hal_t *hal) {
    board_pwm_open_all(hal->board);
}

uint32_t hal_pwm_break(const hal_t *hal) {
    require(hal, true, __func__);
    return board_pwm_break(hal->board);
}

void hal_pwm_clear_break(hal_t *hal) {
    require(hal, true, __func__);
    board_pwm_clear_break(hal->board);
}

uint32_t hal_interrupt_missed_triggers(hal_t *hal) {
    require(hal, true, __func__);
    return board_missed_triggers(hal->board);
}

/* The firmware's code takes no virtual time; the execution time that the bench sets counts from the start. */
uint32_t hal_interrupt_elapsed_ticks(const hal_t *hal) {
    if (hal->board->context != BOARD_DEFERRED) {
        require(hal, true, __func__);
    }
    return (uint32_t)pwm_timer_ticks(hal->board->interrupt_took_ns);
}

void hal_interrupt_request_deferred(hal_t *hal) {
    require(hal, true, __func__);
    hal->board->deferred_requested = true;
}

bool hal_can_receive(hal_t *hal, hal_can_frame_t *frame) {
    require(hal, false, __func__);
    return board_can_receive(hal->board, frame);
}

uint32_t hal_can_receive_overflows(const hal_t *hal) {
    require(hal, false, __func__);
    return hal->board->receive_overflows;
}

bool hal_can_transmit(hal_t *hal, const hal_can_frame_t *frame) {
    require(hal, false, __func__);
    return board_can_transmit(hal->board, frame);
}

void hal_can_status(const hal_t *hal, hal_can_status_t *status) {
    require(hal, false, __func__);
    board_can_status(hal->board, status);
}

void hal_can_rejoin(hal_t *hal) {
    require(hal, false, __func__);
    board_can_rejoin(hal->board);
}

/* Flash stalls the interrupts: the firmware must not operate it while they are masked. */
static void require_unmasked(const hal_t *hal, const char *function) {
    require(hal, false, function);
    if (hal->board->in_critical_section) {
        fprintf(stderr, "salient: firmware called %s in a critical section\n", function);
        abort();
    }
}

uint64_t hal_nvm_read(const hal_t *hal, unsigned page, unsigned word) {
    require(hal, false, __func__);
    return nvm_read(&hal->board->nvm, page, word);
}

bool hal_nvm_program(hal_t *hal, unsigned page, unsigned word, uint64_t value) {
    require_unmasked(hal, __func__);
    return nvm_program(&hal->board->nvm, page, word, value);
}

bool hal_nvm_erase(hal_t *hal, unsigned page) {
    require_unmasked(hal, __func__);
    board_watchdog_kick(hal->board);
    return nvm_erase(&hal->board->nvm, page);
}

uint32_t hal_random_u32(hal_t *hal) {
    require(hal, false, __func__);
    return board_random(hal->board);
}

hal_reset_cause_t hal_reset_cause(const hal_t *hal) {
    require(hal, false, __func__);
    return hal->board->reset_cause;
}

void hal_watchdog_start(hal_t *hal) {
    require(hal, false, __func__);
    board_watchdog_start(hal->board);
}

void hal_watchdog_kick(hal_t *hal) {
    require(hal, false, __func__);
    board_watchdog_kick(hal->board);
}

/* Code and stack belong to a process of the host. */
void hal_memory(const hal_t *hal, hal_memory_t *memory) {
    require(hal, false, __func__);
    *memory = (hal_memory_t){0};
}

bool hal_registers_intact(const hal_t *hal) {
    require(hal, false, __func__);
    return board_registers_intact(hal->board);
}

uint32_t hal_time_reference_us(const hal_t *hal) {
    require(hal, false, __func__);
    return board_reference_us(hal->board);
}

uint32_t hal_time_us(const hal_t *hal) {
    return (uint32_t)((hal->board->time_ns - hal->board->start_ns) / 1000);
}

/* One thread: the interrupt cannot interrupt the background. Only the pairing of the calls is checked. */
void hal_critical_enter(hal_t *hal) {
    require(hal, false, __func__);
    if (hal->board->in_critical_section) {
        fputs("salient: firmware called hal_critical_enter twice; it does not nest\n", stderr);
        abort();
    }
    hal->board->in_critical_section = true;
}

void hal_critical_leave(hal_t *hal) {
    require(hal, false, __func__);
    if (!hal->board->in_critical_section) {
        fputs("salient: firmware called hal_critical_leave without hal_critical_enter\n", stderr);
        abort();
    }
    hal->board->in_critical_section = false;
}
