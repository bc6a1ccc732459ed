#include "comms/xcp_memory.h"

#include <assert.h>

#include "comms/xcp_code.h"
#include "control/machine_tables.h"
#include "layout_hash.h"

#define WORD_BYTES 4u
#define DIGITS 8u /* of a number of the identification */
#define BITS_OF_DIGIT 4u

typedef enum { SCOPE_STOP, SCOPE_ARM, SCOPE_TRIGGER, SCOPE_COMMANDS } scope_command_t;

static const char event_names[XCP_EVENTS][XCP_TEXT_BYTES] = {"control", "background", "deferred", "identify"};

static bool within(uint32_t offset, unsigned bytes, uint32_t area_bytes) {
    return offset < area_bytes && bytes <= area_bytes - offset;
}

static uint8_t byte_of(uint32_t word, uint32_t offset) {
    return (uint8_t)(word >> (8u * (offset % WORD_BYTES)));
}

/* Words are read whole, so that a variable within one is of one step; a word twice when two variables share it. */
static void read_memory(const xcp_t *xcp, uint32_t offset, unsigned bytes, uint8_t *to) {
    sampler_word_t *words = xcp->memory;
    uint32_t word = words[offset / WORD_BYTES];
    for (unsigned i = 0; i < bytes; i++, offset++) {
        if (i > 0 && offset % WORD_BYTES == 0) {
            word = words[offset / WORD_BYTES];
        }
        to[i] = byte_of(word, offset);
    }
}

/* Character of the identification, 0 behind it: "salient" and, in hexadecimal, hashes of the headers and of the
 * machine's DBC and the size of the memory, which differs with the processor. */
static char identification(const xcp_t *xcp, unsigned at) {
    static const char name[] = "salient";
    const uint32_t numbers[] = {LAYOUT_HASH, machine_tables.dbc_hash, xcp->words};
    const unsigned first_digit = (unsigned)sizeof name - 1u;
    static_assert(sizeof name + DIGITS * (sizeof numbers / sizeof numbers[0]) <= XCP_TEXT_BYTES, "has an end");
    if (at < first_digit) {
        return name[at];
    }
    const unsigned digit = at - first_digit;
    if (digit / DIGITS >= sizeof numbers / sizeof numbers[0]) {
        return '\0';
    }
    return "0123456789abcdef"[numbers[digit / DIGITS] >> (BITS_OF_DIGIT * (DIGITS - 1u - digit % DIGITS)) & 0xFu];
}

/* at: 0..XCP_TEXT_BYTES - 1. */
static char character(const xcp_t *xcp, unsigned text, unsigned at) {
    return text == 0 ? identification(xcp, at) : event_names[(text - 1u) % XCP_EVENTS][at];
}

uint8_t xcp_text_length(const xcp_t *xcp, unsigned text) {
    uint8_t length = 0;
    while (character(xcp, text, length) != '\0') { /* which each text has */
        length++;
    }
    return length;
}

/* Byte of an area, from its start on; within() holds. */
static uint8_t byte_at(const xcp_t *xcp, const parameters_t *parameters, uint32_t area, uint32_t offset) {
    switch (area) {
    case XCP_AREA_PARAMETERS:
        return byte_of((uint32_t)parameters->values[offset / WORD_BYTES], offset);
    case XCP_AREA_SCOPE:
        return byte_of(xcp->scope[offset / WORD_BYTES], offset);
    case XCP_AREA_TABLES:
        return ((const uint8_t *)&machine_tables)[offset];
    default:
        return (uint8_t)character(xcp, offset / XCP_TEXT_BYTES, offset % XCP_TEXT_BYTES);
    }
}

static uint32_t area_bytes(const xcp_t *xcp, uint32_t area) {
    switch (area) {
    case XCP_AREA_MEMORY:
        return WORD_BYTES * xcp->words;
    case XCP_AREA_PARAMETERS:
        return WORD_BYTES * PARAMETER_COUNT;
    case XCP_AREA_SCOPE:
        return WORD_BYTES * XCP_SCOPE_WORDS;
    case XCP_AREA_TABLES:
        return TABLE_STORE_BYTES;
    case XCP_AREA_TEXT:
        return XCP_TEXT_BYTES * (1u + XCP_EVENTS);
    default:
        return 0;
    }
}

bool xcp_memory_read(const xcp_t *xcp, const parameters_t *parameters, uint32_t address, unsigned bytes, uint8_t *to) {
    const uint32_t area = address & XCP_AREA, offset = address & ~XCP_AREA;
    if (!within(offset, bytes, area_bytes(xcp, area))) {
        return false;
    }
    if (area == XCP_AREA_MEMORY) {
        read_memory(xcp, offset, bytes, to);
        return true;
    }
    for (unsigned i = 0; i < bytes; i++) {
        to[i] = byte_at(xcp, parameters, area, offset + i);
    }
    return true;
}

/* Words of the set-up that fit no member of sampler_setup_t are out of range. */
static bool setup_of(const xcp_t *xcp, sampler_setup_t *setup) {
    const uint32_t *scope = xcp->scope;
    const uint32_t end = WORD_BYTES * xcp->words;
    bool fits = scope[XCP_SCOPE_EVENT] <= UINT8_MAX && scope[XCP_SCOPE_DIVIDER] <= UINT16_MAX &&
                scope[XCP_SCOPE_BEFORE] <= UINT16_MAX && scope[XCP_SCOPE_CONDITION] <= UINT8_MAX &&
                scope[XCP_SCOPE_VARIABLE] < end && scope[XCP_SCOPE_LEFT] <= UINT8_MAX &&
                scope[XCP_SCOPE_RIGHT] <= UINT8_MAX && scope[XCP_SCOPE_CHANNELS] <= SAMPLER_CHANNELS_MAX;
    *setup = (sampler_setup_t){
        .channels = (uint8_t)scope[XCP_SCOPE_CHANNELS],
        .event = (sampler_event_t)scope[XCP_SCOPE_EVENT],
        .divider = (uint16_t)scope[XCP_SCOPE_DIVIDER],
        .before = (uint16_t)scope[XCP_SCOPE_BEFORE],
        .condition = (sampler_condition_t)scope[XCP_SCOPE_CONDITION],
        .variable =
            {
                .word = (uint16_t)(scope[XCP_SCOPE_VARIABLE] / WORD_BYTES),
                .left = (uint8_t)scope[XCP_SCOPE_LEFT],
                .right = (uint8_t)scope[XCP_SCOPE_RIGHT],
                .is_signed = scope[XCP_SCOPE_SIGNED] != 0,
            },
        .level = (int32_t)scope[XCP_SCOPE_LEVEL],
    };
    for (unsigned i = 0; i < setup->channels && i < SAMPLER_CHANNELS_MAX; i++) {
        fits = fits && scope[XCP_SCOPE_CHANNEL + i] < end && scope[XCP_SCOPE_CHANNEL + i] % WORD_BYTES == 0;
        setup->word[i] = (uint16_t)(scope[XCP_SCOPE_CHANNEL + i] / WORD_BYTES);
    }
    return fits;
}

static xcp_error_t command_scope(xcp_t *xcp, uint32_t command) {
    sampler_setup_t setup;
    if (xcp->daq.running) {
        return XCP_ERROR_DAQ_ACTIVE;
    }
    if (command >= SCOPE_COMMANDS) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    if (command == SCOPE_STOP) {
        sampler_stop(xcp->sampler);
    } else if (command == SCOPE_TRIGGER) {
        sampler_trigger(xcp->sampler);
    } else if (!setup_of(xcp, &setup) || !sampler_arm(xcp->sampler, &setup, false, xcp->memory, xcp->words)) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    return XCP_ERROR_NONE;
}

static xcp_error_t write_scope(xcp_t *xcp, uint32_t word, uint32_t value) {
    if ((xcp->unlocked & XCP_RESOURCE_DAQ) == 0) {
        return XCP_ERROR_ACCESS_LOCKED;
    }
    if (word >= XCP_SCOPE_WORDS) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    if (word == XCP_SCOPE_COMMAND) {
        const xcp_error_t error = command_scope(xcp, value);
        if (error != XCP_ERROR_NONE) {
            return error;
        }
    }
    xcp->scope[word] = value;
    return XCP_ERROR_NONE;
}

static xcp_error_t write_parameter(const xcp_t *xcp, const xcp_context_t *context, uint32_t index, uint32_t value) {
    if ((xcp->unlocked & XCP_RESOURCE_CALIBRATION) == 0) {
        return XCP_ERROR_ACCESS_LOCKED;
    }
    if (index >= PARAMETER_COUNT) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    if (context->set->begun) {
        return XCP_ERROR_BUSY;
    }
    switch (parameter_set_one(context->set, context->parameters, context->conditions, index, (int32_t)value).status) {
    case PARAMETER_STATUS_DONE:
        return XCP_ERROR_NONE;
    case PARAMETER_STATUS_NOT_WHILE_RUNNING:
        return XCP_ERROR_WRITE_PROTECTED;
    case PARAMETER_STATUS_MEMORY:
        return XCP_ERROR_ACCESS_DENIED;
    default:
        return XCP_ERROR_OUT_OF_RANGE;
    }
}

xcp_error_t xcp_memory_write(xcp_t *xcp, const xcp_context_t *context, uint32_t address, unsigned bytes,
                             const uint8_t *from) {
    const uint32_t area = address & XCP_AREA, offset = address & ~XCP_AREA;
    if (area != XCP_AREA_PARAMETERS && area != XCP_AREA_SCOPE) {
        return XCP_ERROR_WRITE_PROTECTED;
    }
    if (bytes != WORD_BYTES || offset % WORD_BYTES != 0) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    const uint32_t value = xcp_get_word(from);
    return area == XCP_AREA_SCOPE ? write_scope(xcp, offset / WORD_BYTES, value)
                                  : write_parameter(xcp, context, offset / WORD_BYTES, value);
}
