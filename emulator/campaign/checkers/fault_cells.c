/* Every kind of fault begins in every state of the drive and in every sector of phase a. */
#include "campaign/checkers/checker.h"

#include <math.h>

#include "campaign/checkers/checkers.h"

static void on_fault(const observation_t *seen, void *memory, checker_report_t *report, unsigned kind) {
    (void)memory;
    const double pitches = seen->plant->rotor_angle_rad * seen->plant->machine->rotor_poles / TWO_PI;
    const unsigned sector = (unsigned)((pitches - floor(pitches)) * CHECKERS_SECTORS) % CHECKERS_SECTORS;
    const unsigned state = seen->drive.state % CHECKERS_STATES;
    checker_reached(report, (kind * CHECKERS_STATES + state) * CHECKERS_SECTORS + sector);
}

const checker_t fault_cells_checker = {.name = "fault_cells", .on_fault = on_fault};
