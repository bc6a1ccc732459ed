#include "comms/xcp_daq.h"

#include "comms/xcp_code.h"

enum { WORD_BYTES = 4, MODE_TIMESTAMP = 0x10, MODE_SELECTED = 0x01, MODE_RUNNING = 0x40 };
enum { STOP, START, SELECT };                     /* of a list */
enum { STOP_ALL, START_SELECTED, STOP_SELECTED }; /* of all lists */
enum { FIRST_BYTES = 7, TIMESTAMP_BYTES = 2 };
enum { EVENT = 0xFD, EVENT_DAQ_OVERLOAD = 0x06 };

/* Dynamic configuration, prescaler, timestamps, event of an overload; identification by an absolute number, of 256 in
 * one list. */
#define DAQ_PROPERTIES 0x93u
/* Size 2, unit 1 us, one tick is one unit. */
#define TIMESTAMP_MODE (TIMESTAMP_BYTES | 3u << 4)
#define EVENT_PROPERTIES 0x04u /* of DAQ */

void xcp_daq_stop(xcp_t *xcp) {
    if (xcp->daq.running) {
        sampler_stop(xcp->sampler);
    }
    xcp->daq.running = false;
    xcp->daq.next_odt = xcp->daq.odts;
}

static xcp_error_t allocate_list(xcp_daq_t *daq, unsigned lists) {
    if (daq->allocated != XCP_DAQ_FREE) {
        return XCP_ERROR_SEQUENCE;
    }
    if (lists > 1) {
        return XCP_ERROR_MEMORY_OVERFLOW;
    }
    daq->allocated = lists == 1 ? XCP_DAQ_LIST : XCP_DAQ_FREE;
    return XCP_ERROR_NONE;
}

static xcp_error_t allocate_odts(xcp_daq_t *daq, unsigned list, uint8_t odts) {
    if (daq->allocated != XCP_DAQ_LIST) {
        return XCP_ERROR_SEQUENCE;
    }
    if (list != 0) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    if (odts == 0 || odts > XCP_ODTS_MAX) {
        return XCP_ERROR_MEMORY_OVERFLOW;
    }
    daq->odts = odts;
    daq->allocated = XCP_DAQ_ODTS;
    return XCP_ERROR_NONE;
}

static xcp_error_t allocate_entries(xcp_daq_t *daq, unsigned list, uint8_t odt, uint8_t entries) {
    if (daq->allocated < XCP_DAQ_ODTS) {
        return XCP_ERROR_SEQUENCE;
    }
    if (list != 0 || odt >= daq->odts) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    if (daq->odt[odt].end != 0) {
        return XCP_ERROR_SEQUENCE;
    }
    if (entries > SAMPLER_CHANNELS_MAX - daq->entries) {
        return XCP_ERROR_MEMORY_OVERFLOW;
    }
    daq->odt[odt] = (xcp_odt_t){daq->entries, (uint8_t)(daq->entries + entries)};
    daq->entries = (uint8_t)(daq->entries + entries);
    daq->allocated = XCP_DAQ_ENTRIES;
    return XCP_ERROR_NONE;
}

static xcp_error_t set_pointer(xcp_daq_t *daq, const uint8_t *command) {
    const unsigned odt = command[4];
    if (xcp_get_half_word(command + 2) != 0 || odt >= daq->odts ||
        daq->odt[odt].begin + command[5] >= daq->odt[odt].end) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    daq->pointer = (uint8_t)(daq->odt[odt].begin + command[5]);
    daq->pointer_end = daq->odt[odt].end;
    return XCP_ERROR_NONE;
}

/* No bit is masked. An entry lies within a word, which is recorded whole. */
static xcp_error_t write_entry(xcp_t *xcp, const uint8_t *command) {
    xcp_daq_t *daq = &xcp->daq;
    const uint32_t address = xcp_get_word(command + 4);
    const unsigned bytes = command[2], first = address % WORD_BYTES;
    if (daq->pointer >= daq->pointer_end) {
        return XCP_ERROR_SEQUENCE;
    }
    if (command[1] != 0xFFu || command[3] != 0 || bytes == 0 || first + bytes > WORD_BYTES ||
        address / WORD_BYTES >= xcp->words) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    daq->entry[daq->pointer++] = (xcp_entry_t){(uint16_t)(address / WORD_BYTES), (uint8_t)first, (uint8_t)bytes};
    return XCP_ERROR_NONE;
}

static xcp_error_t set_mode(xcp_daq_t *daq, const uint8_t *command) {
    if (daq->allocated == XCP_DAQ_FREE || xcp_get_half_word(command + 2) != 0 ||
        xcp_get_half_word(command + 4) >= XCP_EVENTS || command[6] == 0) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    if ((command[1] & ~MODE_TIMESTAMP) != 0) {
        return XCP_ERROR_MODE_NOT_VALID;
    }
    daq->timestamps = (command[1] & MODE_TIMESTAMP) != 0;
    daq->event = command[4];
    daq->divider = command[6];
    return XCP_ERROR_NONE;
}

/* Every frame has room for its entries, and each of these was written. */
static bool is_complete(const xcp_daq_t *daq) {
    for (unsigned i = 0; i < daq->odts; i++) {
        unsigned bytes = i == 0 && daq->timestamps ? TIMESTAMP_BYTES : 0;
        for (unsigned entry = daq->odt[i].begin; entry < daq->odt[i].end; entry++) {
            if (daq->entry[entry].bytes == 0) {
                return false;
            }
            bytes += daq->entry[entry].bytes;
        }
        if (bytes > FIRST_BYTES) {
            return false;
        }
    }
    return daq->entries != 0 && daq->divider != 0;
}

static xcp_error_t start(xcp_t *xcp) {
    xcp_daq_t *daq = &xcp->daq;
    if (!is_complete(daq)) {
        return XCP_ERROR_DAQ_CONFIGURATION;
    }
    sampler_setup_t setup = {.channels = daq->entries,
                             .event = (sampler_event_t)(SAMPLER_EVENT_CONTROL + daq->event),
                             .divider = daq->divider};
    for (unsigned i = 0; i < daq->entries; i++) {
        setup.word[i] = daq->entry[i].word;
    }
    if (!sampler_arm(xcp->sampler, &setup, true, xcp->memory, xcp->words)) {
        return XCP_ERROR_DAQ_CONFIGURATION;
    }
    daq->next_odt = daq->odts;
    daq->told_lost = 0;
    daq->told_taken = 0u - XCP_OVERLOAD_RECORDS;
    daq->overloads = 0;
    daq->running = true;
    return XCP_ERROR_NONE;
}

static xcp_error_t start_or_stop(xcp_t *xcp, const uint8_t *command, uint8_t *response, uint8_t *length) {
    xcp_daq_t *daq = &xcp->daq;
    if (command[0] == START_STOP_DAQ_LIST) {
        if (xcp_get_half_word(command + 2) != 0 || daq->allocated != XCP_DAQ_ENTRIES) {
            return XCP_ERROR_OUT_OF_RANGE;
        }
        if (command[1] > SELECT) {
            return XCP_ERROR_MODE_NOT_VALID;
        }
        response[1] = 0; /* number of its first frame */
        *length = 2;
        daq->selected = command[1] == SELECT || (daq->selected && command[1] == START);
        if (command[1] == STOP) {
            xcp_daq_stop(xcp);
        }
        return command[1] == START ? start(xcp) : XCP_ERROR_NONE;
    }
    if (command[1] > STOP_SELECTED) {
        return XCP_ERROR_MODE_NOT_VALID;
    }
    const bool selected = daq->selected;
    daq->selected = false;
    if (command[1] == START_SELECTED) {
        return selected ? start(xcp) : XCP_ERROR_DAQ_CONFIGURATION;
    }
    if (command[1] == STOP_ALL || selected) {
        xcp_daq_stop(xcp);
    }
    return XCP_ERROR_NONE;
}

static xcp_error_t describe(xcp_t *xcp, const uint8_t *command, uint8_t *response, uint8_t *length) {
    const xcp_daq_t *daq = &xcp->daq;
    *length = 8;
    switch (command[0]) {
    case GET_DAQ_PROCESSOR_INFO:
        response[1] = DAQ_PROPERTIES;
        xcp_put_half_word(response + 2, 1); /* lists */
        xcp_put_half_word(response + 4, XCP_EVENTS);
        return XCP_ERROR_NONE;
    case GET_DAQ_RESOLUTION_INFO:
        response[1] = 1; /* granularity and largest size of an entry, bytes */
        response[2] = WORD_BYTES;
        response[3] = 1; /* the same of stimulation, which there is not */
        response[5] = TIMESTAMP_MODE;
        xcp_put_half_word(response + 6, 1);
        return XCP_ERROR_NONE;
    case GET_DAQ_EVENT_INFO:
        if (xcp_get_half_word(command + 2) >= XCP_EVENTS) {
            return XCP_ERROR_OUT_OF_RANGE;
        }
        response[1] = EVENT_PROPERTIES;
        response[2] = 1; /* lists of an event */
        response[3] = xcp_text_length(xcp, 1u + command[2]);
        xcp->address = XCP_AREA_TEXT + XCP_TEXT_BYTES * (1u + command[2]);
        *length = 7;
        return XCP_ERROR_NONE;
    case GET_DAQ_LIST_INFO:
        if (xcp_get_half_word(command + 2) != 0) {
            return XCP_ERROR_OUT_OF_RANGE;
        }
        response[1] = 0x04; /* DAQ, event and set-up not fixed */
        response[2] = XCP_ODTS_MAX;
        response[3] = SAMPLER_CHANNELS_MAX;
        *length = 6;
        return XCP_ERROR_NONE;
    case GET_DAQ_LIST_MODE:
        if (xcp_get_half_word(command + 2) != 0) {
            return XCP_ERROR_OUT_OF_RANGE;
        }
        response[1] = (uint8_t)((daq->selected ? MODE_SELECTED : 0) | (daq->timestamps ? MODE_TIMESTAMP : 0) |
                                (daq->running ? MODE_RUNNING : 0));
        xcp_put_half_word(response + 4, daq->event);
        response[6] = daq->divider;
        return XCP_ERROR_NONE;
    default: /* GET_DAQ_CLOCK: the time at which the command was received */
        xcp_put_word(response + 4, xcp->received_us);
        return XCP_ERROR_NONE;
    }
}

/* The commands that allocate come in the order FREE_DAQ, ALLOC_DAQ, ALLOC_ODT, ALLOC_ODT_ENTRY; before one comes
 * again, all is freed. */
static xcp_error_t set_up(xcp_t *xcp, const uint8_t *command) {
    xcp_daq_t *daq = &xcp->daq;
    switch (command[0]) {
    case SET_DAQ_PTR:
        return set_pointer(daq, command);
    case WRITE_DAQ:
        return write_entry(xcp, command);
    case SET_DAQ_LIST_MODE:
        return set_mode(daq, command);
    case FREE_DAQ:
        xcp_daq_stop(xcp);
        *daq = (xcp_daq_t){0};
        return XCP_ERROR_NONE;
    case ALLOC_DAQ:
        return allocate_list(daq, xcp_get_half_word(command + 2));
    case ALLOC_ODT:
        return allocate_odts(daq, xcp_get_half_word(command + 2), command[4]);
    case ALLOC_ODT_ENTRY:
        return allocate_entries(daq, xcp_get_half_word(command + 2), command[4], command[5]);
    default:
        return XCP_ERROR_UNKNOWN;
    }
}

static bool only_describes(uint8_t code) {
    return code == GET_DAQ_PROCESSOR_INFO || code == GET_DAQ_RESOLUTION_INFO || code == GET_DAQ_EVENT_INFO ||
           code == GET_DAQ_LIST_INFO || code == GET_DAQ_LIST_MODE || code == GET_DAQ_CLOCK;
}

xcp_error_t xcp_daq_command(xcp_t *xcp, const uint8_t *command, uint8_t *response, uint8_t *length) {
    const uint8_t code = command[0];
    if (code < ALLOC_ODT_ENTRY || code > CLEAR_DAQ_LIST) {
        return XCP_ERROR_UNKNOWN;
    }
    if (only_describes(code)) {
        return describe(xcp, command, response, length);
    }
    if ((xcp->unlocked & XCP_RESOURCE_DAQ) == 0) {
        return XCP_ERROR_ACCESS_LOCKED;
    }
    if (code == START_STOP_DAQ_LIST || code == START_STOP_SYNCH) {
        return start_or_stop(xcp, command, response, length);
    }
    if (xcp->daq.running && code != FREE_DAQ) {
        return XCP_ERROR_DAQ_ACTIVE;
    }
    return set_up(xcp, command);
}

/* Between two records; the first overload at once. */
static bool tells_overload(xcp_t *xcp, hal_can_frame_t *frame) {
    xcp_daq_t *daq = &xcp->daq;
    const uint32_t lost = *(const volatile uint32_t *)&xcp->sampler->lost;
    if (lost == daq->told_lost || xcp->sampler->taken - daq->told_taken < XCP_OVERLOAD_RECORDS) {
        return false;
    }
    daq->told_lost = lost;
    daq->told_taken = xcp->sampler->taken;
    daq->overloads++;
    frame->data[0] = EVENT;
    frame->data[1] = EVENT_DAQ_OVERLOAD;
    frame->length = 2;
    return true;
}

bool xcp_daq_next_frame(xcp_t *xcp, hal_can_frame_t *frame) {
    xcp_daq_t *daq = &xcp->daq;
    if (daq->next_odt >= daq->odts) {
        if (tells_overload(xcp, frame)) {
            return true;
        }
        if (!sampler_take(xcp->sampler, daq->record)) {
            return false;
        }
        daq->next_odt = 0;
    }
    const unsigned number = daq->next_odt++;
    const xcp_odt_t *odt = &daq->odt[number % XCP_ODTS_MAX];
    frame->data[0] = (uint8_t)number;
    frame->length = 1;
    if (number == 0 && daq->timestamps) {
        xcp_put_half_word(frame->data + 1, daq->record[0]);
        frame->length = 1 + TIMESTAMP_BYTES;
    }
    for (unsigned entry = odt->begin; entry < odt->end && entry < SAMPLER_CHANNELS_MAX; entry++) {
        const xcp_entry_t *of = &daq->entry[entry];
        for (unsigned i = 0; i < of->bytes && frame->length < sizeof frame->data; i++) {
            frame->data[frame->length++] = (uint8_t)(daq->record[1u + entry] >> (8u * ((of->first + i) % WORD_BYTES)));
        }
    }
    return true;
}
