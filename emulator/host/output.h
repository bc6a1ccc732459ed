/* Output files named by options of the command line. */
#ifndef HOST_OUTPUT_H
#define HOST_OUTPUT_H

#include <stdbool.h>
#include <stdio.h>

/* Opens `path` for writing; NULL, after a line on standard error that names the option, on failure. */
FILE *output_open(const char *option, const char *path);

/* Closes the file; false, after such a line, when a write has failed. */
bool output_close(FILE *file, const char *option, const char *path);

#endif
