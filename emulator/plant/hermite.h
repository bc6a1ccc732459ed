/* Cubic Hermite interpolation. */
#ifndef PLANT_HERMITE_H
#define PLANT_HERMITE_H

/* Value at fraction x of a step h, from values and slopes at its ends. */
static inline double hermite(double x, double h, double start, double start_slope, double end, double end_slope) {
    const double y = 1.0 - x;
    return y * y * (start * (1.0 + 2.0 * x) + h * x * start_slope) +
           x * x * (end * (1.0 + 2.0 * y) - h * y * end_slope);
}

#endif
