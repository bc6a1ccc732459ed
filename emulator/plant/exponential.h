/* The exponential function without libm, whose results differ in the last bit between processors (it selects a variant
 * with fused multiply-add where there is one): equal arguments must have equal results on every computer. */
#ifndef PLANT_EXPONENTIAL_H
#define PLANT_EXPONENTIAL_H

/* Adding and subtracting this constant rounds to the nearest integer, for magnitudes below 2^51. */
#define ROUNDING_SHIFT 0x1.8p52

/* e^x for -700 <= x <= 700, relative error below 3e-16; 0 below that range. */
double exponential(double x);

#endif
