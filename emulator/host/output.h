/* Files that options of the command line name. */
#ifndef HOST_OUTPUT_H
#define HOST_OUTPUT_H

#include <stdbool.h>
#include <stdio.h>

/* Opens `path` for writing; NULL, after a line on standard error that names the option, when that cannot be. */
FILE *output_open(const char *option, const char *path);

/* Closes it; false, after such a line, when not all could be written. */
bool output_close(FILE *file, const char *option, const char *path);

#endif
