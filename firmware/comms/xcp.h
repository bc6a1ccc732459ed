/* XCP on CAN (ASAM MCD-1 XCP 1.3, part 2 and part 3), slave: masters as pyXCP, CANape and INCA read the drive's memory,
 * measure it at the rate of the interrupts and change its parameters, with the A2L file that `tools/salient a2l` makes
 * of the program.
 *
 * Frames XCP_COMMAND and XCP_RESPONSE (drive.dbc) of at most 8 bytes, low byte first, addresses of bytes. An address is
 * of one of four areas:
 *
 *   0x00000000  the drive's memory, read only, counted from its start: the same on any board
 *   0x10000000  parameters, 4 bytes each, in the order of parameters.def: read, and written as below
 *   0x20000000  set-up of the triggered buffer, words of xcp_scope_word_t: read and written; a write of the word
 *               XCP_SCOPE_COMMAND arms, triggers or stops it (interrupts/sampler.h)
 *   0x30000000  texts of XCP_TEXT_BYTES: the identification of program and layout of its memory, which the A2L file has
 *               too (EPK), and the names of the events
 *   0x40000000  machine tables (control/machine_tables.h): those in effect are read, new ones for the next start are
 *               programmed (comms/xcp_program.h), where the port can load them (storage/table_store.h)
 *
 * Reading is free. Measuring, which takes time of the interrupts, and the triggered buffer need resource DAQ, writing a
 * parameter resource CAL/PAG, programming tables resource PGM. Each is unlocked by a seed, of which the key is every
 * bit inverted, as the key of the arming: a random or recorded frame opens nothing. A seed serves one attempt within
 * ARMING_RESPONSE_MAX_US. All are locked again by the end of the session: DISCONNECT, CONNECT, a wrong key, bus-off, or
 * XCP_SILENT_US without a command. A master that measures sends no command: then XCP_SILENT_US locks all but DAQ.
 *
 * A write of a parameter is a set of one (parameter_set.h): staged, checked as any other, and applied or refused. It
 * is refused while another set is staged. In a run tunable parameters only. SET_REQUEST STORE_CAL stores.
 *
 * Measuring: one DAQ list, of a choice of four events, of at most SAMPLER_CHANNELS_MAX entries within single words.
 * Records that the bus does not take are lost, and counted (drive_t.sampler.lost); the time in the first frame of a
 * record shows them. The event EV_DAQ_OVERLOAD tells that records were lost: the first time at once, then at most once
 * in XCP_OVERLOAD_RECORDS records that are sent, and it is counted (drive_t.comms.xcp.daq.overloads). DAQ frames have
 * the lowest priority of the drive but for two, and only one of them is in a mailbox.
 */
#ifndef COMMS_XCP_H
#define COMMS_XCP_H

#include <stdbool.h>
#include <stdint.h>

#include "comms/parameter_set.h"
#include "hal_can.h"
#include "interrupts/sampler.h"
#include "storage/nvm_store.h"
#include "storage/parameters.h"
#include "storage/table_store.h"

#define XCP_SILENT_US 10000000u
#define XCP_ODTS_MAX SAMPLER_CHANNELS_MAX
#define XCP_EVENTS 4u /* of sampler_event_t */
#define XCP_TEXT_BYTES 32u
#define XCP_OVERLOAD_RECORDS 64u

#define XCP_AREA 0xF0000000u /* bits of an address that select the area */
#define XCP_AREA_MEMORY 0x00000000u
#define XCP_AREA_PARAMETERS 0x10000000u
#define XCP_AREA_SCOPE 0x20000000u
#define XCP_AREA_TEXT 0x30000000u
#define XCP_AREA_TABLES 0x40000000u

/* Words of the area of the triggered buffer. */
typedef enum {
    XCP_SCOPE_COMMAND, /* 0: stop, 1: arm, 2: trigger now */
    XCP_SCOPE_EVENT,   /* the next members are sampler_setup_t's */
    XCP_SCOPE_DIVIDER,
    XCP_SCOPE_BEFORE,
    XCP_SCOPE_CONDITION,
    XCP_SCOPE_LEVEL,
    XCP_SCOPE_VARIABLE, /* its address in the drive's memory, bytes */
    XCP_SCOPE_LEFT,
    XCP_SCOPE_RIGHT,
    XCP_SCOPE_SIGNED,
    XCP_SCOPE_CHANNELS,
    XCP_SCOPE_CHANNEL, /* the first of SAMPLER_CHANNELS_MAX addresses in the drive's memory, multiples of 4 */
    XCP_SCOPE_WORDS = XCP_SCOPE_CHANNEL + SAMPLER_CHANNELS_MAX
} xcp_scope_word_t;

/* Variable of a DAQ list: bytes of a word. */
typedef struct {
    uint16_t word; /* of the drive */
    uint8_t first; /* byte, 0..3 */
    uint8_t bytes; /* 1..4, 0: not written */
} xcp_entry_t;

typedef struct {
    uint8_t begin, end; /* of its entries */
} xcp_odt_t;

typedef enum { XCP_DAQ_FREE, XCP_DAQ_LIST, XCP_DAQ_ODTS, XCP_DAQ_ENTRIES } xcp_allocated_t;

typedef struct {
    xcp_allocated_t allocated;
    xcp_entry_t entry[SAMPLER_CHANNELS_MAX];
    xcp_odt_t odt[XCP_ODTS_MAX];
    uint8_t odts, entries;
    uint8_t pointer, pointer_end; /* entry that WRITE_DAQ writes, and the end of its ODT */
    uint8_t event;                /* sampler_event_t - 1 */
    uint8_t divider;
    bool timestamps, selected, running;
    uint32_t told_lost, told_taken;             /* sampler_t's counters at the last event of an overload */
    uint32_t overloads;                         /* such events since the start */
    uint8_t next_odt;                           /* of `record`; at `odts` there is none left */
    uint32_t record[1u + SAMPLER_CHANNELS_MAX]; /* of which the frames are sent */
} xcp_daq_t;

typedef struct {
    const void *memory; /* the drive */
    uint32_t words;
    sampler_t *sampler;
    bool connected;
    uint8_t unlocked; /* XCP_RESOURCE_* */
    uint8_t seed_resource;
    bool programming;       /* since PROGRAM_START */
    bool pending;           /* a command waits for the memory */
    uint32_t seed, seed_us; /* 0: none */
    uint32_t received_us;
    uint32_t address;    /* memory transfer address */
    uint8_t upload_left; /* bytes of an UPLOAD still to be sent */
    uint32_t scope[XCP_SCOPE_WORDS];
    xcp_daq_t daq;
} xcp_t;

/* Objects on which a command may act. */
typedef struct {
    parameters_t *parameters;
    const parameters_conditions_t *conditions;
    parameter_set_t *set;
    nvm_store_t *store;
    table_store_t *tables; /* NULL: the port has tables of its own alone */
} xcp_context_t;

/* No session. memory: the drive, aligned as its words are. */
void xcp_init(xcp_t *xcp, const void *memory, uint32_t words, sampler_t *sampler);

/* As of xcp_init. Call it in each pass of the background before the functions below: nothing that memory holds alone is
 * a pointer. [background] */
void xcp_attach(xcp_t *xcp, const void *memory, uint32_t words, sampler_t *sampler);

/* Takes an XCP_COMMAND and writes its response; false without one, also while the command waits for the memory.
 * [background] */
bool xcp_receive(xcp_t *xcp, hal_t *hal, const hal_can_frame_t *frame, const xcp_context_t *context, uint32_t time_us,
                 hal_can_frame_t *response);

/* Writes the response to a command that has waited for the memory; false before it is done. [background] */
bool xcp_late_response(xcp_t *xcp, const table_store_t *tables, hal_can_frame_t *response);

/* Ends the session after XCP_SILENT_US, or at once in bus-off. Call it at least once in 35 minutes. [background] */
void xcp_supervise(xcp_t *xcp, bool bus_off, uint32_t time_us);

/* The next frame of an UPLOAD or, while no frame of the drive waits for the bus, of the DAQ list; false when there is
 * none. A frame that is returned has to be sent. [background] */
bool xcp_next_frame(xcp_t *xcp, const parameters_t *parameters, bool transmitting, hal_can_frame_t *frame);

#endif
