/* Conversions of units, one per quantity. */
#ifndef PLANT_UNITS_H
#define PLANT_UNITS_H

#include <stdint.h>

#define PI 3.14159265358979323846
#define TWO_PI (2.0 * PI)

#define RAD_PER_DEG (PI / 180.0)
#define DEG_PER_RAD (180.0 / PI)
#define RAD_S_PER_RPM (PI / 30.0)
#define RPM_PER_RAD_S (30.0 / PI)

#define S_PER_NS 1e-9
#define NS_PER_US UINT64_C(1000)

#endif
