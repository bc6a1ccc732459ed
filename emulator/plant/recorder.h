/* Records the true state to a NumPy file (.npy, version 1.0, one-dimensional structured array, little endian):
 *
 *   time_s f8, speed_rpm f4, torque_Nm f4, load_torque_Nm f4, rotor_angle_deg f4 (0..360), current_a_A f4, current_b_A
 * ...
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

#define RECORDER_HEADER_BYTES 512

typedef struct {
    FILE *file; /* NULL when closed */
    const char *path;
    unsigned phases;
    uint64_t rows;
    int write_error; /* errno of the first row that could not be written */
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
