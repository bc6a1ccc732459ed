/* Records the true state to a NumPy file (.npy, version 1.0, one-dimensional structured array, little endian):
 *
 *   time_s f8, then f4: speed_rpm, torque_Nm, load_torque_Nm, rotor_angle_deg (0..360), bus_voltage_V, current_a_A,
 *   current_b_A ..., and the plant's energies so far: energy_drawn_J, energy_returned_J, energy_copper_J,
 *   energy_converter_J, energy_load_J, energy_friction_J
 *
 * Energies are sums, so that the mean power between any two rows is a difference and no sampling loses a part of it. A
 * float resolves 6e-8 of such a sum: 0.5 mJ after 10 s at 800 W, 5 mW of a mean over 0.1 s. More digits would show the
 * age of the ledger, which in a row within an integration step is that of the step's start (plant.h) and exact where a
 * control period ends; they would cost 24 bytes a row, and a row a microsecond is the usual one.
 *
 * The number of rows is written into the header by recorder_close. A run that was killed leaves a header that says 0
 * rows in front of the rows written so far; numpy.fromfile(path, dtype, offset=RECORDER_HEADER_BYTES) reads them.
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
    char buffer[RECORDER_BUFFER_BYTES]; /* whole rows on their way to the file */
} recorder_t;

/* Creates `path` (overwrites). `path` must outlive the recorder. False with a line in `error` naming the file when
 * it cannot. */
bool recorder_open(recorder_t *recorder, const char *path, unsigned phases, char *error, size_t error_size);

/* Appends the plant's state; the callback for plant_observe, context is the recorder. */
void recorder_sample(void *context, const plant_t *plant);

/* Writes the number of rows and closes; does nothing when not open. False with a line in `error` when any write
 * failed. */
bool recorder_close(recorder_t *recorder, char *error, size_t error_size);

#endif
