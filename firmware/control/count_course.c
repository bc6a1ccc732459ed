#include "control/count_course.h"

#include "control/machine_tables.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"

#define LEAST_1_S 4
#define MOST_1_S 10

/* 2 pi, Q3.28. */
#define TWO_PI_Q28 INT64_C(1686629713)

static int32_t counts_per_s_q22(int32_t counts, unsigned encoder_bits) {
    return (int32_t)(counts * TWO_PI_Q28 >> (6u + encoder_bits + machine_tables.speed_exponent));
}

count_course_parameters_t count_course_configure(int32_t angle_step_q32, unsigned encoder_bits) {
    return (count_course_parameters_t){
        .angle_step_q32 = angle_step_q32,
        .least_q22 = counts_per_s_q22(LEAST_1_S, encoder_bits),
        .most_q22 = counts_per_s_q22(MOST_1_S, encoder_bits),
        .count = (int32_t)(1u << (32u - encoder_bits)),
        .to_q30 = encoder_bits - 2u,
    };
}

NOINLINE int32_t count_course_step(const count_course_parameters_t *parameters, count_course_t *course,
                                   int32_t reference_q22, uint32_t angle, uint32_t periods) {
    const uint64_t step_q64 = (uint64_t)fixed_product(reference_q22, parameters->angle_step_q32);
    const uint64_t angle_q64 = course->angle_q64 + step_q64 * periods;
    const int32_t ahead = (int32_t)((uint32_t)(angle_q64 >> 32) - angle);
    const int32_t error = fixed_clamp(ahead, -parameters->count, parameters->count);
    course->angle_q64 = angle_q64 + ((uint64_t)(uint32_t)(error - ahead) << 32);
    const int32_t rate_q22 = fixed_clamp(fixed_abs(reference_q22), parameters->least_q22, parameters->most_q22);
    return 4 * fixed_multiply_high(rate_q22, (int32_t)((uint32_t)error << parameters->to_q30));
}
