/* Block transfer of the SDO server (canopen_sdo.h). */
#ifndef COMMS_CANOPEN_SDO_BLOCK_H
#define COMMS_CANOPEN_SDO_BLOCK_H

#include "comms/canopen_sdo_data.h"

#define CANOPEN_DOWNLOAD_BLOCK 32u /* segments */

/* CRC-16 of CiA 301 (x^16 + x^12 + x^5 + 1, begins with 0), continued. */
uint16_t canopen_sdo_crc(uint16_t crc, const uint8_t *data, unsigned count);

/* Requests of an upload and of a download, and a segment of the latter. */
void canopen_sdo_block_upload(canopen_t *canopen, const canopen_context_t *context, const uint8_t *request);
void canopen_sdo_block_download(canopen_t *canopen, const canopen_context_t *context, const uint8_t *request);
void canopen_sdo_block_segment(canopen_t *canopen, const canopen_context_t *context, const uint8_t *segment);

/* Queues segments of an upload while there is room. */
void canopen_sdo_block_step(canopen_t *canopen, const canopen_context_t *context);

#endif
