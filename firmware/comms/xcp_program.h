/* Programming by XCP (xcp.h): new machine tables for the memory (storage/table_store.h).
 *
 *   PROGRAM_START    in no run and without a measurement
 *   SET_MTA          XCP_AREA_TABLES
 *   PROGRAM_CLEAR    absolute, TABLE_STORE_BYTES: erases the slot that the drive does not use
 *   PROGRAM          1..6 bytes, from the first one on, in succession
 *   PROGRAM, 0 bytes the tables are complete: the drive has them from its next start on
 *   PROGRAM_RESET    ends the session; it does not start the drive anew
 *
 * A command that waits for the memory is answered when this is done, in the meantime others with ERR_CMD_BUSY. In a
 * run the memory is not written: the answer comes after it.
 */
#ifndef COMMS_XCP_PROGRAM_H
#define COMMS_XCP_PROGRAM_H

#include "comms/xcp.h"
#include "comms/xcp_memory.h"

/* Executes a command of the group PGM, whole, of 8 bytes with zeros behind those that have come, but for PROGRAM_RESET.
 * response, length: as of xcp_daq_command. XCP_ERROR_NONE with xcp->pending set: there is no response yet.
 * [background] */
xcp_error_t xcp_program_command(xcp_t *xcp, const hal_t *hal, const xcp_context_t *context, const uint8_t *command,
                                uint8_t *response, uint8_t *length);

/* True when a command that has waited for the memory is done; error: its result. tables NULL: none has.
 * [background] */
bool xcp_program_done(xcp_t *xcp, const table_store_t *tables, xcp_error_t *error);

#endif
