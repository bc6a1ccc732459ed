#define _POSIX_C_SOURCE 200809L

#include "host/machine_image.h"

#include <assert.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "hal.h"

static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "members are copied as they are");

#define FILE_BYTES_MAX (16u << 20) /* far more than any image */

enum { TABLES, PLANT, FLUX_MAP, NAME, PARTS };
enum { LAYOUT_AT = 8, CRC_AT = 12, CHECKED_AT = 16, HEADER_BYTES = CHECKED_AT + PARTS * 4 };

static bool fail(const char *path, const char *format, ...) __attribute__((format(printf, 2, 3)));

static bool fail(const char *path, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    fprintf(stderr, "salient: %s: ", path);
    vfprintf(stderr, format, arguments);
    fputc('\n', stderr);
    va_end(arguments);
    return false;
}

static uint32_t word_at(const uint8_t *bytes) {
    uint32_t word;
    memcpy(&word, bytes, sizeof word);
    return word;
}

static uint32_t crc32_of(const uint8_t *bytes, size_t count) {
    uint32_t crc = UINT32_MAX;
    for (size_t i = 0; i < count; i++) {
        crc ^= bytes[i];
        for (int bit = 0; bit < 8; bit++) {
            crc = crc >> 1 ^ (crc & 1 ? 0xedb88320u : 0);
        }
    }
    return ~crc;
}

/* The whole file, on the heap; NULL after one line on stderr. */
static uint8_t *read_file(const char *path, size_t *size) {
    const int descriptor = open(path, O_RDONLY | O_CLOEXEC | O_NONBLOCK); /* a pipe may have no writer */
    struct stat status;
    if (descriptor < 0 || fstat(descriptor, &status) != 0) {
        fail(path, "%s", strerror(errno));
        if (descriptor >= 0) {
            close(descriptor);
        }
        return NULL;
    }
    uint8_t *bytes = NULL;
    *size = (size_t)status.st_size;
    if (!S_ISREG(status.st_mode) || status.st_size < HEADER_BYTES || *size > FILE_BYTES_MAX) {
        fail(path, "not a machine image");
    } else if (!(bytes = malloc(*size)) || read(descriptor, bytes, *size) != (ssize_t)*size) {
        fail(path, "cannot be read");
        free(bytes);
        bytes = NULL;
    }
    close(descriptor);
    return bytes;
}

static void copy(const machine_structure_t *structure, const uint8_t *part, void *to) {
    for (size_t i = 0; i < structure->count; i++) {
        const machine_member_t *member = &structure->members[i];
        memcpy((char *)to + member->offset, part, member->bytes);
        part += member->bytes;
    }
}

/* Checks a file of at least HEADER_BYTES. */
static bool check_header(const uint8_t *file, const char *path, size_t size) {
    if (memcmp(file, "SALIENTM", LAYOUT_AT) != 0) {
        return fail(path, "not a machine image");
    }
    if (word_at(file + LAYOUT_AT) != machine_layout) {
        return fail(path,
                    "machine image of another version, %08x; this program reads %08x: build both from the same"
                    " sources",
                    word_at(file + LAYOUT_AT), machine_layout);
    }
    if (crc32_of(file + CHECKED_AT, size - CHECKED_AT) != word_at(file + CRC_AT)) {
        return fail(path, "damaged machine image: wrong checksum");
    }
    return true;
}

static bool sizes_are_right(const uint64_t bytes[PARTS]) {
    return bytes[PLANT] == machine_plant_structure.bytes && bytes[NAME] > 0 &&
           (bytes[FLUX_MAP] == 0 || bytes[FLUX_MAP] == flux_map_structure.bytes);
}

static bool values_are_in_range(const machine_t *machine) {
    return (machine->magnetics.form == MAGNETICS_MAP) == (machine->magnetics.map != NULL) &&
           machine->magnetics.form <= MAGNETICS_MAP && machine->phases >= 1 && machine->phases <= HAL_PHASES_MAX;
}

/* Reads the parts of a file of at least HEADER_BYTES. */
static bool read_parts(machine_image_t *image, const char *path, size_t size) {
    const uint8_t *file = image->file;
    if (!check_header(file, path, size)) {
        return false;
    }
    const uint8_t *part[PARTS];
    uint64_t bytes[PARTS], end = HEADER_BYTES;
    for (unsigned i = 0; i < PARTS; i++) {
        bytes[i] = word_at(file + CHECKED_AT + 4 * i);
        part[i] = file + (end < size ? end : size);
        end += bytes[i];
    }
    if (end != size || !sizes_are_right(bytes) || file[size - 1] != '\0') {
        return fail(path, "damaged machine image: parts of a wrong size");
    }
    image->tables = part[TABLES];
    image->tables_bytes = (size_t)bytes[TABLES];
    copy(&machine_plant_structure, part[PLANT], &image->machine);
    if (bytes[FLUX_MAP] != 0) {
        copy(&flux_map_structure, part[FLUX_MAP], &image->map);
        image->machine.magnetics.map = &image->map;
    }
    image->machine.name = (const char *)part[NAME];
    return values_are_in_range(&image->machine) || fail(path, "damaged machine image: values out of range");
}

bool machine_image_open(machine_image_t *image, const char *path) {
    size_t size;
    uint8_t *const bytes = read_file(path, &size);
    return bytes && machine_image_take(image, path, bytes, size);
}

bool machine_image_take(machine_image_t *image, const char *name, uint8_t *bytes, size_t size) {
    *image = (machine_image_t){.file = bytes};
    const bool good = size >= HEADER_BYTES ? read_parts(image, name, size) : fail(name, "not a machine image");
    if (!good) {
        machine_image_close(image);
    }
    return good;
}

bool machine_image_tables(const machine_image_t *image, const machine_structure_t *structure, void *tables) {
    if (image->tables_bytes != structure->bytes) {
        return fail(image->machine.name, "damaged machine image: tables of a wrong size");
    }
    copy(structure, image->tables, tables);
    return true;
}

void machine_image_close(machine_image_t *image) {
    free(image->file);
    image->file = NULL;
}
