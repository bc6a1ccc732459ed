/* Evidence of a sample about phases and encoder by their flux linkage: the conditions of flux_verdict.def, each with
 * its time. Masks have a bit of each phase for which the condition holds. */
#ifndef MONITORS_FLUX_EVIDENCE_H
#define MONITORS_FLUX_EVIDENCE_H

#include <stdbool.h>
#include <stdint.h>

typedef struct {
    /* By each phase (phase_evidence.h): */
    uint32_t too_little;                             /* less current than the voltage must have caused, at any angle */
    uint32_t too_little_at_angle, too_much_at_angle; /* in one phase alone, at the measured angle */
    uint32_t missing;                                /* voltage without current, or one that has ended too soon */
    uint32_t excess; /* a current that should not be, however short; the next three are of one that lasts: */
    uint32_t excess_moves;
    uint32_t excess_still;
    uint32_t excess_by_tables; /* there is one only because the tables have emptied the integral */
    /* By the mean ratio of each phase (phase_balance.h): */
    uint32_t unbalanced; /* other than the ratios of all other phases */
    bool all_small;      /* of all phases below what tolerances explain */
    /* By the encoder's angle (angle_evidence.h, encoder_monitor.h): */
    bool parted;            /* flux linkage and tables, while the encoder stays at one count */
    uint32_t contradicts;   /* the angle, in the last quarter of a second */
    bool contradicts_alone; /* one phase for long enough, while no other has agreed */
    bool turned_round;      /* the encoder, faster than a rotor, in the last quarter of a second */
    bool suspicious;        /* a condition begins or nearly holds: samples without delay decide */
} flux_evidence_t;

#endif
