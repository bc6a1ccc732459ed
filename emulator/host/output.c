#include "host/output.h"

#include <errno.h>
#include <string.h>

FILE *output_open(const char *option, const char *path) {
    FILE *file = fopen(path, "wb");
    if (!file) {
        fprintf(stderr, "salient: %s %s: %s\n", option, path, strerror(errno));
    }
    return file;
}

bool output_close(FILE *file, const char *option, const char *path) {
    const bool written = !ferror(file);
    if (fclose(file) != 0 || !written) {
        fprintf(stderr, "salient: %s %s: write failed\n", option, path);
        return false;
    }
    return true;
}
