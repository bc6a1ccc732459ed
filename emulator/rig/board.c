#include "rig/board.h"

#include <string.h>

void board_init(board_t *board, plant_t *plant, sensors_t *sensors, can_bus_t *bus) {
    memset(board, 0, sizeof *board);
    board->adc_bits = sensors->adc_bits;
    board->encoder_bits = sensors->encoder_bits;
    board->plant = plant;
    board->sensors = sensors;
    board->bus = bus;
}

void board_start_period(board_t *board, bool busy) {
    hal_encoder_sample_t encoder;
    sensors_sample_encoder(board->sensors, board->plant, &encoder);
    if (busy) {
        ++board->missed_triggers;
    } else {
        sensors_sample_adc(board->sensors, board->plant, &board->adc);
        board->encoder = encoder;
        board->active = board->buffered;
    }
    plant_set_switches(board->plant, &board->active, board->period_ticks);
}

void board_deliver(board_t *board, const hal_can_frame_t *frame) {
    if (board->received_pushed - board->received_popped == HAL_CAN_RECEIVE_QUEUE) {
        ++board->receive_overflows;
        return;
    }
    board->received[board->received_pushed++ % HAL_CAN_RECEIVE_QUEUE] = *frame;
}

void board_pwm_start(board_t *board, uint16_t period_ticks) {
    board->period_ticks = period_ticks;
}

void board_pwm_write(board_t *board, const hal_pwm_compare_t *compare) {
    board->buffered = *compare;
    if (board->immediate_pwm) {
        board->active = *compare;
        plant_set_switches(board->plant, compare, board->period_ticks);
    }
}

void board_pwm_open_all(board_t *board) {
    memset(&board->active, 0, sizeof board->active);
    memset(&board->buffered, 0, sizeof board->buffered);
    plant_open_all(board->plant);
}

uint32_t board_missed_triggers(board_t *board) {
    uint32_t missed = board->missed_triggers;
    board->missed_triggers = 0;
    return missed;
}

bool board_can_receive(board_t *board, hal_can_frame_t *frame) {
    if (board->received_pushed == board->received_popped) {
        return false;
    }
    *frame = board->received[board->received_popped++ % HAL_CAN_RECEIVE_QUEUE];
    return true;
}

bool board_can_transmit(board_t *board, const hal_can_frame_t *frame) {
    return can_bus_transmit(board->bus, frame);
}
