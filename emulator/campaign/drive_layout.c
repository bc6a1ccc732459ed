/* The type of the drive, for the debug information of the program: names of the members at each offset. */
#include "drive/drive.h"

extern const drive_t *const drive_layout;
const drive_t *const drive_layout = 0;
