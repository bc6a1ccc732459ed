/* Records the true state to a NumPy file (.npy, version 1.0, one-dimensional structured array, little endian):
 *
 *   time_s f8, then f4: speed_rpm, torque_Nm, load_torque_Nm, rotor_angle_deg (0..360), bus_voltage_V, current_a_A,
 *   current_b_A ..., and the cumulative energies: energy_drawn_J, energy_returned_J, energy_copper_J,
 *   energy_converter_J, energy_load_J, energy_friction_J
 *
 * Energies are cumulative, so the mean power between any two rows is a difference quotient, exact at any sampling rate.
 * A float resolves 6e-8 of the sum: 0.5 mJ after 10 s at 800 W, 5 mW of a mean over 0.1 s. More digits would be below
 * the error of the time: in a row within an integration step the energies are those at the start of the step (plant.h);
 * at the end of a control period they are exact. Doubles would add 24 bytes per row, typically one row per microsecond.
 *
 * recorder_close writes the number of rows into the header. After a run that was killed the header states 0 rows;
 * numpy.fromfile(path, dtype, offset=RECORDER_HEADER_BYTES) reads the rows written until then.
 */
#ifndef PLANT_RECORDER_H
#define PLANT_RECORDER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

#include "plant/plant.h"

#define RECORDER_HEADER_BYTES 1024
#define RECORDER_BUFFER_BYTES (1 << 16)

typedef struct {
    FILE *file; /* NULL when closed */
    const char *path;
    unsigned phases;
    uint64_t rows;
    int write_error; /* errno of the first write that failed */
    size_t buffered_bytes;
    char buffer[RECORDER_BUFFER_BYTES]; /* complete rows not yet written */
} recorder_t;

/* Creates or overwrites `path`, which must outlive the recorder. False, with a line in `error` that names the file, on
 * failure. */
bool recorder_open(recorder_t *recorder, const char *path, unsigned phases, char *error, size_t error_size);

/* Appends the state of the plant: callback for plant_observe with the recorder as context. */
void recorder_sample(void *context, const plant_t *plant);

/* The header of the file with the present number of rows. */
void recorder_header(const recorder_t *recorder, char text[RECORDER_HEADER_BYTES]);

/* Writes the number of rows and closes the file; does nothing when none is open. False, with a line in `error`, when
 * any write has failed. */
bool recorder_close(recorder_t *recorder, char *error, size_t error_size);

#endif
