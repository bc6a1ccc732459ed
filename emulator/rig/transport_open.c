#include <stdio.h>
#include <string.h>

#include "rig/transport.h"

transport_t *transport_open(const char *address, char error[TRANSPORT_ERROR_SIZE]) {
    if (strncmp(address, "unix:", 5) == 0 && address[5] != '\0') {
        return transport_local_open(address + 5, error);
    }
    if (strncmp(address, "socketcan:", 10) == 0 && address[10] != '\0') {
        return transport_socketcan_open(address + 10, error);
    }
    snprintf(error, TRANSPORT_ERROR_SIZE, "--can %.120s: must be unix:PATH or socketcan:INTERFACE", address);
    return NULL;
}
