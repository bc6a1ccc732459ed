#include "qemu/hal_qemu.h"

#include "hal_interrupt.h"
#include "hal_memory.h"
#include "hal_nvm.h"
#include "hal_random.h"
#include "hal_time.h"
#include "hal_watchdog.h"

/* The plugin identifies this store by the function's name: the function must be neither inlined nor cloned. */
__attribute__((noipa)) void doorbell_ring(mailbox_command_t command) {
    *(volatile uint32_t *)&board.mailbox.doorbell = command;
}

unsigned hal_adc_bits(const hal_t *hal) {
    return hal->mailbox.adc_bits;
}

void hal_adc_read(const hal_t *hal, hal_adc_sample_t *sample) {
    *sample = hal->mailbox.adc;
}

uint16_t hal_adc_temperature(const hal_t *hal, unsigned sensor) {
    return hal->mailbox.temperature_code[sensor];
}

unsigned hal_encoder_bits(const hal_t *hal) {
    return hal->mailbox.encoder_bits;
}

void hal_encoder_read(const hal_t *hal, hal_encoder_sample_t *sample) {
    *sample = hal->mailbox.encoder;
}

uint32_t hal_pwm_clock_hz(const hal_t *hal) {
    (void)hal;
    return MAILBOX_PWM_CLOCK_HZ;
}

void hal_pwm_start(hal_t *hal, uint16_t period_ticks) {
    hal->mailbox.period_ticks = period_ticks;
    doorbell_ring(MAILBOX_PWM_START);
}

void hal_pwm_write(hal_t *hal, const hal_pwm_compare_t *compare) {
    hal->mailbox.compare = *compare;
    hal->mailbox.compare_written = 1;
}

void hal_pwm_open_all(hal_t *hal) {
    (void)hal;
    doorbell_ring(MAILBOX_PWM_OPEN_ALL);
}

uint32_t hal_pwm_break(const hal_t *hal) {
    return hal->mailbox.break_causes;
}

void hal_pwm_clear_break(hal_t *hal) {
    (void)hal;
    doorbell_ring(MAILBOX_PWM_CLEAR_BREAK);
}

uint32_t hal_interrupt_missed_triggers(hal_t *hal) {
    const uint32_t missed = hal->mailbox.missed_triggers;
    hal->mailbox.missed_triggers = 0;
    return missed;
}

bool hal_can_receive(hal_t *hal, hal_can_frame_t *frame) {
    if (hal->mailbox.receive_waiting == 0) {
        return false;
    }
    doorbell_ring(MAILBOX_CAN_RECEIVE);
    *frame = hal->mailbox.frame;
    return hal->mailbox.accepted != 0;
}

uint32_t hal_can_receive_overflows(const hal_t *hal) {
    return hal->mailbox.receive_overflows;
}

bool hal_can_transmit(hal_t *hal, const hal_can_frame_t *frame) {
    hal->mailbox.frame = *frame;
    doorbell_ring(MAILBOX_CAN_TRANSMIT);
    return hal->mailbox.accepted != 0;
}

void hal_can_status(const hal_t *hal, hal_can_status_t *status) {
    status->state = (hal_can_error_state_t)hal->mailbox.can_error_state;
    status->transmit_errors = (uint16_t)hal->mailbox.transmit_errors;
    status->receive_errors = (uint16_t)hal->mailbox.receive_errors;
    status->transmitting = hal->mailbox.transmitting != 0;
}

void hal_can_rejoin(hal_t *hal) {
    (void)hal;
    doorbell_ring(MAILBOX_CAN_REJOIN);
}

/* The memory belongs to the host, which keeps it in a reset; hal is not written but through the mailbox. */
uint64_t hal_nvm_read(const hal_t *hal, unsigned page, unsigned word) {
    (void)hal;
    mailbox_t *mailbox = &board.mailbox;
    mailbox->nvm_page = page;
    mailbox->nvm_word = word;
    doorbell_ring(MAILBOX_NVM_READ);
    return (uint64_t)mailbox->nvm_value[1] << 32 | mailbox->nvm_value[0];
}

bool hal_nvm_program(hal_t *hal, unsigned page, unsigned word, uint64_t value) {
    hal->mailbox.nvm_page = page;
    hal->mailbox.nvm_word = word;
    hal->mailbox.nvm_value[0] = (uint32_t)value;
    hal->mailbox.nvm_value[1] = (uint32_t)(value >> 32);
    doorbell_ring(MAILBOX_NVM_PROGRAM);
    return hal->mailbox.accepted != 0;
}

bool hal_nvm_erase(hal_t *hal, unsigned page) {
    hal->mailbox.nvm_page = page;
    doorbell_ring(MAILBOX_NVM_ERASE);
    return hal->mailbox.accepted != 0;
}

bool hal_registers_intact(const hal_t *hal) {
    return hal->mailbox.registers_intact != 0;
}

uint32_t hal_time_reference_us(const hal_t *hal) {
    return hal->mailbox.reference_us;
}

uint32_t hal_time_us(const hal_t *hal) {
    return hal->mailbox.time_us;
}

uint32_t hal_random_u32(hal_t *hal) {
    doorbell_ring(MAILBOX_RANDOM);
    return hal->mailbox.random;
}

hal_reset_cause_t hal_reset_cause(const hal_t *hal) {
    return (hal_reset_cause_t)hal->mailbox.reset_cause;
}

void hal_watchdog_start(hal_t *hal) {
    (void)hal;
    doorbell_ring(MAILBOX_WATCHDOG_START);
}

void hal_watchdog_kick(hal_t *hal) {
    (void)hal;
    doorbell_ring(MAILBOX_WATCHDOG_KICK);
}
