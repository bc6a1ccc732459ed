/* Predictive torque control: deadbeat flux-linkage control of each phase, following a torque sharing function.
 *
 *   sample k          flux linkage now, and at k + 1 under the voltage that already acts (flux_observer.h)
 *   target            at the angle of k + 2: share of the torque -> flux linkage (phase_cell.h)
 *   voltage           duty = (psi*(k+2) - psi(k+1) + R i Ts) / (Vdc Ts), acts from k + 1 to k + 2
 *
 * Deadbeat flux control: B. H. Kenny, R. D. Lorenz, "Stator- and rotor-flux-based deadbeat direct torque control of
 * induction machines", IEEE Trans. Ind. Appl. 39(4), 2003. For a phase of a switched reluctance machine derived here:
 * psi(k+2) = psi(k+1) + Ts (duty Vdc - R i), solved for the duty with psi(k+2) = psi*. Torque sharing:
 * torque_sharing.h.
 *
 * Each phase is planned in one cell of the tables, a column wide and extrapolated where needed, at the current that is
 * expected from its last two plans: no search, and the same number of instructions for any sample. In one period a flux
 * linkage changes by at most +-Vdc Ts. When that, or the end of a cell, keeps phases from their torque, one phase is
 * planned again with the sum of what is missing, in the order of DITC (ditc_hysteresis.h): a shortfall goes to the
 * phase that entered last and can make more torque, an excess is taken from the one that entered first and can make
 * less. This correction is free to change to another cell, so that a load step is answered within the period. Measured
 * (tools/salient compare dip --quick): three corrections, each in a cell of its own, give the same speed drop.
 * Switch states are as in DITC: every duty alternates between +1 and 0 or between -1 and 0.
 *
 * Two periods later the cell of the plan also gives torque and flux linkage from the measured current
 * (predictive_torque_estimate), at the predicted angle.
 *
 * Four quadrants: a phase makes positive torque between unaligned and aligned position, negative torque in the other
 * half of the electrical revolution, where all quantities are evaluated at the mirrored angle.
 *
 * Braking: a phase that moves towards the unaligned position carries at most the flux linkage that leaves the braking
 * flux linkage when -Vdc has acted up to the braking end, Vdc Ts * (angle to it) / (angle step per period): with torque
 * sharing none at the unaligned position. Otherwise, where the motional EMF exceeds Vdc, its current would rise beyond
 * any limit against full -Vdc, as the inductance falls.
 *
 * Torque reserve: the halves are loaded against each other so that positive and negative torque add up to at least the
 * reserve. A load step then only needs the removal of flux linkage, which -Vdc does immediately at any position. The
 * cost is continuous copper loss.
 *
 * The conduction angles come from torque sharing, or above base speed from single pulse operation (conduction.h):
 * flux linkage is then built up before the phase enters the half of the wanted torque, at full voltage and up to the
 * current limit. What a phase produces there counts as torque shortfall, and nothing of it is corrected there.
 */
#ifndef CONTROL_PREDICTIVE_TORQUE_H
#define CONTROL_PREDICTIVE_TORQUE_H

#include <stdbool.h>
#include <stdint.h>

#include "control/conduction.h"
#include "control/flux_observer.h"
#include "control/machine_tables.h"
#include "control/phase_cell.h"
#include "hal.h"

typedef struct {
    flux_observer_parameters_t flux;
    uint32_t stroke;          /* 2^32 / phases */
    int32_t period_q40;       /* Ts in s, Q-9.40 */
    int32_t current_limit_q9; /* A, Q7.9 */
    int32_t current_max_q9;   /* that gets no voltage: the limit, which the plans hold, and their error; A, Q7.9 */
    int32_t column_max;       /* last table column whose cell reaches down to the limit */
    int32_t reserve_q24;      /* N m, Q7.24, >= 0 */
} predictive_torque_parameters_t;

typedef struct {
    int32_t flux_q29[HAL_PHASES_MAX];     /* predicted for the coming sample, Wb, Q2.29 */
    int32_t duty_q15[HAL_PHASES_MAX];     /* acts from the coming sample on, Q1.15 */
    int32_t torque_shortfall_q24;         /* reference less planned torque, N m, Q7.24; 0 within 1/64 N m */
    int32_t position_q13[HAL_PHASES_MAX]; /* of the planned operating point, in table columns, Q13; about 0..40 */
    int8_t column[HAL_PHASES_MAX];        /* table column in which the next plan begins, before it is limited */
    phase_cell_t cell[2][HAL_PHASES_MAX]; /* of the plans for this sample and for the next one, in turn */
    unsigned turn;                        /* index of those for this sample, by its lowest bit */
} predictive_torque_t;

typedef struct {
    const int32_t *current_q9;      /* A, Q7.9, by phase, at the sample */
    const int32_t *flux;            /* from the tables, in their unit, by phase, at the sample */
    const conduction_t *conduction; /* conduction angles */
    uint32_t angle;                 /* of phase 0 two periods after the sample, 2^-32 electrical rev */
    const int32_t *misalignment;    /* to subtract from the angle of each phase, 2^-32 electrical rev */
    int32_t bus_voltage_q6;         /* DC-link voltage, V, Q9.6 */
    int32_t torque_q24;             /* reference, N m, Q7.24 */
    bool reverse;                   /* negative direction of rotation */
    uint32_t lost_phase;            /* number from 1 on of a phase without voltage, which the others replace; 0: none */
    uint32_t angle_step;            /* magnitude of the rotation per period, 2^-32 electrical rev */
    const flux_observer_parameters_t *flux_observer; /* with the resistance, and the period, over the scale of the
                                                      * tables, table_scale.h */
    int32_t period_q40;                              /* s, Q-9.40 */
} predictive_torque_sample_t;

/* Flux linkages and duties 0. */
void predictive_torque_reset(predictive_torque_t *control);

/* Cells by phase that were planned for the sample of predictive_torque_estimate. */
ALWAYS_INLINE const phase_cell_t *predictive_torque_cells(const predictive_torque_t *control) {
    return control->cell[control->turn & 1u];
}

/* Torque and flux linkage of a phase at a sample, in units of the tables, from its current in A, Q7.9, in the cell that
 * was planned for this sample; 0 where the plan was no flux linkage. The planned angle is that which the load observer
 * predicted two periods ago. */
ALWAYS_INLINE int32_t predictive_torque_estimate(const phase_cell_t *cell, int32_t current_q9, int32_t *flux) {
    if (!cell->located) {
        *flux = 0;
        return 0;
    }
    const int32_t u_q13 = phase_cell_u_q13(cell, current_q9);
    *flux = phase_cell_curve_at(&cell->flux, u_q13);
    return cell->sign * phase_cell_curve_at(&cell->torque, u_q13);
}

/* One sample: duty of each phase, Q1.15, -32768..32767. All sums saturate; 32-bit products are rounded to nearest, the
 * error of the quotient is below 2^-14 of full duty. */
void predictive_torque_step(const predictive_torque_parameters_t *parameters, predictive_torque_t *control,
                            const machine_tables_t *tables, const predictive_torque_sample_t *sample,
                            int32_t duty_q15[HAL_PHASES_MAX]);

#endif
