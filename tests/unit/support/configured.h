// Control parameters as a drive of a unit test derives them: default values but for the controller and those given.
#ifndef TESTS_UNIT_CONFIGURED_H
#define TESTS_UNIT_CONFIGURED_H

#include <cstdint>
#include <initializer_list>
#include <utility>

extern "C" {
#include "interrupts/configure.h"
}

#include "support/fixed_point.h"

inline control_parameters_t configured(drive_controller_t controller, uint32_t rate_hz, unsigned encoder_bits,
                                       unsigned adc_bits = 12,
                                       std::initializer_list<std::pair<parameter_index_t, int32_t>> values = {},
                                       uint32_t timer_clock_hz = fixed_point::TIMER_CLOCK_HZ) {
    parameters_t parameters;
    parameters_init(&parameters);
    parameters.values[PARAMETER_CONTROLLER] = controller;
    for (const auto &[index, value] : values) {
        parameters.values[index] = value;
    }
    return configure_control(&parameters, &machine_tables, rate_hz, encoder_bits, adc_bits, timer_clock_hz);
}

#endif
