// A sample with its conversion results, to which control_sample_t points.
#ifndef TESTS_UNIT_WHOLE_SAMPLE_H
#define TESTS_UNIT_WHOLE_SAMPLE_H

extern "C" {
#include "interrupts/control_step.h"
}

struct whole_sample_t : control_sample_t {
    hal_adc_sample_t adc{};

    whole_sample_t() : control_sample_t{} { control_sample_t::adc = &adc; }
    whole_sample_t(const whole_sample_t &other) : control_sample_t(other), adc(other.adc) {
        control_sample_t::adc = &adc;
    }
    whole_sample_t &operator=(const whole_sample_t &other) {
        control_sample_t::operator=(other);
        adc = other.adc;
        control_sample_t::adc = &adc;
        return *this;
    }
};

#endif
