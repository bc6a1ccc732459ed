#include "plant/recorder.h"

#include <errno.h>
#include <inttypes.h>
#include <math.h>
#include <stdarg.h>
#include <string.h>

#include "plant/units.h"

#define PREAMBLE_BYTES 10

#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "rows are written in native byte order, which must be little endian as in the header"
#endif

/* Row of the file; only the currents of existing phases are written, directly followed by the energies. */
typedef struct {
    double time_s;
    float values[5 + HAL_PHASES_MAX + 6];
} row_t;

typedef struct {
    char text[RECORDER_HEADER_BYTES];
    size_t length;
} header_t;

static void append(header_t *header, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    const int written =
        vsnprintf(header->text + header->length, sizeof header->text - header->length, format, arguments);
    va_end(arguments);
    header->length += (size_t)written;
}

/* Format: numpy.lib.format, version 1.0. Padding to RECORDER_HEADER_BYTES makes the size of the header independent of
 * the number of rows. */
void recorder_header(const recorder_t *recorder, char text[RECORDER_HEADER_BYTES]) {
    header_t header = {.length = PREAMBLE_BYTES};
    append(&header, "{'descr': [('time_s', '<f8'), ('speed_rpm', '<f4'), ('torque_Nm', '<f4'), "
                    "('load_torque_Nm', '<f4'), ('rotor_angle_deg', '<f4'), ('bus_voltage_V', '<f4')");
    for (unsigned phase = 0; phase < recorder->phases; phase++) {
        append(&header, ", ('current_%c_A', '<f4')", 'a' + (int)phase);
    }
    append(&header, ", ('energy_drawn_J', '<f4'), ('energy_returned_J', '<f4'), ('energy_copper_J', '<f4'), "
                    "('energy_converter_J', '<f4'), ('energy_load_J', '<f4'), ('energy_friction_J', '<f4')");
    append(&header, "], 'fortran_order': False, 'shape': (%" PRIu64 ",), }", recorder->rows);
    memset(header.text + header.length, ' ', sizeof header.text - header.length);
    header.text[sizeof header.text - 1] = '\n';
    const uint16_t dictionary_bytes = RECORDER_HEADER_BYTES - PREAMBLE_BYTES;
    memcpy(header.text, "\x93NUMPY\x01\x00", 8);
    memcpy(header.text + 8, &dictionary_bytes, sizeof dictionary_bytes);
    memcpy(text, header.text, sizeof header.text);
}

static bool write_header(const recorder_t *recorder) {
    char text[RECORDER_HEADER_BYTES];
    recorder_header(recorder, text);
    return fwrite(text, sizeof text, 1, recorder->file) == 1;
}

static void format_error(const recorder_t *recorder, const char *action, int reason, char *error, size_t error_size) {
    snprintf(error, error_size, "cannot %s recording '%s': %s", action, recorder->path, strerror(reason));
}

bool recorder_open(recorder_t *recorder, const char *path, unsigned phases, char *error, size_t error_size) {
    memset(recorder, 0, sizeof *recorder);
    recorder->path = path;
    recorder->phases = phases;
    recorder->file = fopen(path, "wb");
    if (recorder->file == NULL) {
        format_error(recorder, "create", errno, error, error_size);
        return false;
    }
    setvbuf(recorder->file, NULL, _IONBF, 0); /* rows are buffered here: stdio takes a third of the time per row */
    if (!write_header(recorder)) {
        format_error(recorder, "write", errno, error, error_size);
        fclose(recorder->file);
        recorder->file = NULL;
        return false;
    }
    return true;
}

static void flush(recorder_t *recorder) {
    if (recorder->write_error == 0 && recorder->buffered_bytes > 0 &&
        fwrite(recorder->buffer, recorder->buffered_bytes, 1, recorder->file) != 1) {
        recorder->write_error = errno;
    }
    recorder->buffered_bytes = 0;
}

void recorder_sample(void *context, const plant_t *plant) {
    recorder_t *recorder = context;
    row_t row;
    const double angle_deg = plant->rotor_angle_rad * DEG_PER_RAD;
    const float wrapped_deg = (float)(angle_deg - 360.0 * floor(angle_deg / 360.0));
    row.time_s = (double)plant->time_ns * S_PER_NS;
    row.values[0] = (float)(plant->speed_rad_s * RPM_PER_RAD_S);
    row.values[1] = (float)plant_torque_Nm(plant);
    row.values[2] = (float)plant_shaft_torque_Nm(plant);
    row.values[3] = wrapped_deg < 360.0f ? wrapped_deg : 0.0f; /* just below 360 deg the float is rounded up */
    row.values[4] = (float)plant->bus_voltage_V;
    float *value = row.values + 5;
    for (unsigned phase = 0; phase < recorder->phases; phase++) {
        *value++ = (float)plant_current_A(plant, phase);
    }
    *value++ = (float)plant->energy_drawn_J;
    *value++ = (float)plant->energy_returned_J;
    *value++ = (float)plant->energy_copper_J;
    *value++ = (float)plant->energy_converter_J;
    *value++ = (float)plant->energy_load_J;
    *value++ = (float)plant->energy_friction_J;
    const size_t bytes = (size_t)((const char *)value - (const char *)&row);
    if (recorder->buffered_bytes + bytes > sizeof recorder->buffer) {
        flush(recorder);
    }
    memcpy(recorder->buffer + recorder->buffered_bytes, &row, bytes);
    recorder->buffered_bytes += bytes;
    recorder->rows++;
}

bool recorder_close(recorder_t *recorder, char *error, size_t error_size) {
    if (recorder->file == NULL) {
        return true;
    }
    flush(recorder);
    int reason = recorder->write_error;
    if (reason == 0 && (fseek(recorder->file, 0, SEEK_SET) != 0 || !write_header(recorder))) {
        reason = errno;
    }
    if (fclose(recorder->file) != 0 && reason == 0) {
        reason = errno;
    }
    recorder->file = NULL;
    if (reason != 0) {
        format_error(recorder, "write", reason, error, error_size);
    }
    return reason == 0;
}
