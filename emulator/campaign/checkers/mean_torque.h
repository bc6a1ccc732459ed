/* Mean torque of the shaft over at least an electrical period. */
#ifndef CAMPAIGN_MEAN_TORQUE_H
#define CAMPAIGN_MEAN_TORQUE_H

#include "campaign/observation.h"

typedef struct {
    unsigned samples; /* 0: begins with the next one */
    uint64_t begin_ns;
    double begin_angle_rad, sum_Nm;
} mean_torque_t;

/* Adds the present torque. True, with the mean, at the end of an electrical period that is at least so long, after
 * which it begins again. */
bool mean_torque_step(mean_torque_t *torque, const observation_t *seen, uint64_t min_ns, double *mean_Nm);

#endif
