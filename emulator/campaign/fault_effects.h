/* Disturbances by each fault of the bench, and the first causes a drive may name for it: a row for each kind of rig.dbc
 * and for each bench variable that is a disturbance. The only place that knows kinds by more than their name. */
#ifndef CAMPAIGN_FAULT_EFFECTS_H
#define CAMPAIGN_FAULT_EFFECTS_H

#include <stdint.h>

/* Bits of what a kind of fault disturbs. */
enum {
    DISTURBS_PHASE = 1 << 0,               /* winding, switches or diodes */
    DISTURBS_PHASE_LOST = 1 << 1,          /* no current can be made in the phase */
    DISTURBS_CURRENT_SENSOR = 1 << 2,      /* a current sensor */
    DISTURBS_CURRENT_SHOWN = 1 << 3,       /* a measured current is not the current of the winding's terminals */
    DISTURBS_THERMAL_MODEL = 1 << 4,       /* a measured current heats the drive's model of winding and switch */
    DISTURBS_DC_LINK_SENSOR = 1 << 5,      /* sensor of the link voltage */
    DISTURBS_ENCODER = 1 << 6,             /* the encoder */
    DISTURBS_ANGLE = 1 << 7,               /* the angle is wrong, and nothing in the encoder's answer says so */
    DISTURBS_SHAFT = 1 << 8,               /* the shaft sticks */
    DISTURBS_LOAD = 1 << 9,                /* the load is gone */
    DISTURBS_SUPPLY = 1 << 10,             /* the supply */
    DISTURBS_CHOPPER = 1 << 11,            /* the brake chopper */
    DISTURBS_PROCESSOR = 1 << 12,          /* control interrupt or background come late */
    DISTURBS_BACKGROUND = 1 << 13,         /* the background comes late: frames wait */
    DISTURBS_TEMPERATURE_SENSOR = 1 << 14, /* a temperature sensor */
    DISTURBS_MEMORY = 1 << 15,             /* memory or registers */
    DISTURBS_STATE = 1 << 16,              /* state of the drive, or what it has latched */
    DISTURBS_CLOCK = 1 << 17,              /* the clock */
};

typedef struct {
    uint32_t disturbs;
    uint32_t causes;            /* CAUSE_BIT of each first cause that it may have */
    unsigned noticed_within_ms; /* by a drive in a run, which can see it at any time; 0: not at any time */
} fault_effect_t;

/* Zeros for a number that is no kind. */
fault_effect_t fault_effect(unsigned kind);

/* Bits of what a bench variable disturbs. */
enum {
    VARIABLE_STO = 1 << 0,               /* a line of safe torque off */
    VARIABLE_LOSES_COMMANDS = 1 << 1,    /* frames to the drive are lost or late */
    VARIABLE_LOSES_STATUS = 1 << 2,      /* frames of the drive are lost or late */
    VARIABLE_DELAYS_INTERRUPTS = 1 << 3, /* time of the processor */
    VARIABLE_LOAD = 1 << 4,              /* torque of the load, that steps or ramps */
    VARIABLE_LOAD_SINE = 1 << 5,         /* torque of the load, that swings */
};

typedef struct {
    uint32_t disturbs;
    uint32_t causes;
} variable_effect_t;

/* Zeros for a variable that disturbs nothing. */
variable_effect_t variable_effect(unsigned variable);

#endif
