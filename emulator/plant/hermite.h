/* Cubic Hermite interpolation. */
#ifndef PLANT_HERMITE_H
#define PLANT_HERMITE_H

/* Value at fraction x of a step h, from values and slopes at its ends. */
static inline double hermite(double x, double h, double start, double start_slope, double end, double end_slope) {
    const double y = 1.0 - x;
    return y * y * (start * (1.0 + 2.0 * x) + h * x * start_slope) +
           x * x * (end * (1.0 + 2.0 * y) - h * y * end_slope);
}

/* Course of a quantity in a step of length h: values and time derivatives at its ends. */
typedef struct {
    double start, end, start_1_s, end_1_s;
} course_t;

static inline double course_at(const course_t *f, double h, double x) {
    return hermite(x, h, f->start, f->start_1_s, f->end, f->end_1_s);
}

static inline double course_integral(const course_t *f, double h) {
    return 0.5 * h * (f->start + f->end) + h * h * (1.0 / 12.0) * (f->start_1_s - f->end_1_s);
}

/* Integral from the start to fraction x. */
static inline double course_integral_to(const course_t *f, double h, double x) {
    const double x2 = x * x, x3 = x2 * x, x4 = x2 * x2;
    return h * (f->start * (0.5 * x4 - x3 + x) + f->end * (x3 - 0.5 * x4) +
                h * (f->start_1_s * (0.25 * x4 - (2.0 / 3.0) * x3 + 0.5 * x2) +
                     f->end_1_s * (0.25 * x4 - (1.0 / 3.0) * x3)));
}

/* Integral of the quantity times the time since the start. */
static inline double course_moment(const course_t *f, double h) {
    return h * h * (0.15 * f->start + 0.35 * f->end + h * ((1.0 / 30.0) * f->start_1_s - 0.05 * f->end_1_s));
}

/* Integral of the square, by the Hermite course of the square. */
static inline double course_square(const course_t *f, double h) {
    return 0.5 * h * (f->start * f->start + f->end * f->end) +
           h * h * (1.0 / 6.0) * (f->start * f->start_1_s - f->end * f->end_1_s);
}

#endif
