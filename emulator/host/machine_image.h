/* Machine image: the file from which the emulator reads a machine, its own part and the firmware's tables. Python makes
 * it from a machine file; tools/src/salient/machine/image.py lists the members.
 *
 * Layout, little endian, without padding:
 *
 *   offset  bytes
 *        0      8  "SALIENTM"
 *        8      4  layout: a hash of the list of members, so that an image of another version is recognised
 *       12      4  CRC-32 (IEEE 802.3) of everything that follows
 *       16     16  bytes of each of the four parts
 *       32         members of machine_tables_t, of machine_t, of flux_map_t (none unless the form is a map), and the
 *                  machine's name with a zero at its end
 *
 * The members come from a validated machine file. Checked here is that the file is whole, of this version and
 * unchanged, and whatever bounds an access to memory. */
#ifndef HOST_MACHINE_IMAGE_H
#define HOST_MACHINE_IMAGE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "plant/machine.h"

typedef struct {
    size_t offset; /* in the structure */
    size_t bytes;
} machine_member_t;

/* Members of a structure in the sequence of the image; generated. */
typedef struct {
    const machine_member_t *members;
    size_t count;
    size_t bytes; /* in the image */
} machine_structure_t;

extern const uint32_t machine_layout;
extern const machine_structure_t machine_plant_structure, flux_map_structure;
extern const machine_structure_t machine_tables_structure; /* only in programs that include the firmware */

/* Large: static or on the heap. Must not be copied: the machine points to its name and its map. */
typedef struct {
    machine_t machine;
    flux_map_t map;
    uint8_t *file;
    const uint8_t *tables;
    size_t tables_bytes;
} machine_image_t;

/* Reads and checks an image. False, with nothing to be closed, after one line on stderr that names `path`. */
bool machine_image_open(machine_image_t *image, const char *path);

/* The same with an image in memory, on the heap, which becomes the machine image's. */
bool machine_image_take(machine_image_t *image, const char *name, uint8_t *bytes, size_t size);

/* Fills the firmware's tables. False, after one line on stderr, when the image has other tables. */
bool machine_image_tables(const machine_image_t *image, const machine_structure_t *structure, void *tables);

void machine_image_close(machine_image_t *image);

#endif
