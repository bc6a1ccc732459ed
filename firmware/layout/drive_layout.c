/* The type of the drive, for the debug information of the program: names of the members at each offset; and the hash
 * by which the firmware identifies the layout (comms/xcp.h). */
#include "drive/drive.h"
#include "layout_hash.h"

#include <stddef.h>

extern const drive_t *const drive_layout;
const drive_t *const drive_layout = NULL;

extern const uint32_t drive_layout_hash;
const uint32_t drive_layout_hash = LAYOUT_HASH;
