#include "interrupts/sampler.h"

#include <stddef.h>

#include "fixed/compiler.h"

#define PART_BITS 32

typedef struct {
    const void *memory;
    uint32_t words;
} drive_words_t;

static inline uint32_t word_of(drive_words_t *drive, uint32_t part) {
    IN_REGISTER(drive->words); /* else the upper half of a product of 64 bits would be computed, too: 9 */
    return ((sampler_word_t *)drive->memory)[(uint32_t)((uint64_t)part * drive->words >> PART_BITS)];
}

static inline void copy_one(const sampler_t *sampler, drive_words_t *drive, unsigned channel, uint32_t *to) {
    to[channel] = word_of(drive, sampler->part[channel]);
}

/* In pairs: eight instructions fewer for eight channels. */
static inline void copy_two(const sampler_t *sampler, drive_words_t *drive, unsigned channel, uint32_t *to) {
    uint32_t first_part = sampler->part[channel], second_part = sampler->part[channel + 1u];
    IN_REGISTER(first_part);
    IN_REGISTER(second_part);
    const uint32_t first = word_of(drive, first_part), second = word_of(drive, second_part);
    to[channel] = first;
    to[channel + 1u] = second;
}

/* Without a loop: 24 instructions fewer for eight channels. */
ALWAYS_INLINE void copy_channels(const sampler_t *sampler, drive_words_t *drive, uint32_t *to) {
    IN_REGISTER(to);
    const uint32_t last = sampler->last_channel;
    if (LIKELY(last >= 7)) {
        copy_two(sampler, drive, 6, to);
        goto six;
    }
    switch (last) {
    case 6:
        copy_one(sampler, drive, 6, to);
        goto six;
    case 5:
    six:
        copy_two(sampler, drive, 4, to);
        goto four;
    case 4:
        copy_one(sampler, drive, 4, to);
        goto four;
    case 3:
    four:
        copy_two(sampler, drive, 2, to);
        goto two;
    case 2:
        copy_one(sampler, drive, 2, to);
        goto two;
    case 1:
    two:
        copy_two(sampler, drive, 0, to);
        return;
    default:
        copy_one(sampler, drive, 0, to);
    }
}

/* Place of the next record, in the ring whatever the memory holds. */
static inline uint32_t *next_record(sampler_t *sampler) {
    uint32_t place = sampler->place;
    const uint32_t record_words = sampler->record_words;
    if (place >= SAMPLER_WORDS) {
        place = 0;
    }
    sampler->place = place + record_words;
    IN_REGISTER(place);
    return sampler->ring + place;
}

NOINLINE static void record_stream(sampler_t *sampler, const void *memory, uint32_t words, uint32_t time_us) {
    if (--sampler->countdown > 0) {
        return;
    }
    sampler->countdown = sampler->divider;
    if (sampler->written - sampler->taken >= sampler->room) {
        sampler->lost++;
        return;
    }
    uint32_t *to = next_record(sampler);
    *to = time_us;
    drive_words_t drive = {memory, words};
    copy_channels(sampler, &drive, to + 1);
    sampler->written++;
}

NOINLINE void sampler_record(sampler_t *sampler, const void *memory, uint32_t words, uint32_t time_us,
                             uint32_t skipped) {
    IN_REGISTER(sampler);
    if (SAMPLER_WORDS == 0 || (sampler->event == SAMPLER_EVENT_DEFERRED && skipped > 0)) {
        return;
    }
    IN_REGISTER(memory);
    drive_words_t drive = {memory, words};
    if (sampler->room != 0) {
        record_stream(sampler, memory, words, time_us);
        return;
    }
    const uint32_t countdown = --sampler->countdown;
    uint32_t least = sampler->waiting_floor, left = sampler->left;
    if (least > 0) {
        const uint32_t value = word_of(&drive, sampler->trigger_part) * sampler->factor;
        if (sampler->window_end - value > sampler->window_length) {
            sampler->waits_for_outside = 0;
        } else if (sampler->waits_for_outside == 0) {
            sampler->trigger_events = countdown;
            sampler->trigger_left = left;
            sampler->waiting_floor = least = 0;
        }
        if (countdown > 0) {
            return;
        }
        left -= left > least;
    } else {
        if (countdown > 0) {
            return;
        }
        left--;
        if (left == 0) {
            sampler->state = SAMPLER_COMPLETE;
            sampler->event = 0;
        }
    }
    const uint32_t divider = sampler->divider;
    sampler->left = left;
    sampler->countdown = divider;
    copy_channels(sampler, &drive, next_record(sampler));
}

COLD void sampler_stop(sampler_t *sampler) {
    *(volatile uint32_t *)&sampler->event = 0;
    MEMORY_ORDER(); /* the interrupt leaves the rest alone from here on */
    if (sampler->state != SAMPLER_COMPLETE) {
        sampler->state = SAMPLER_OFF;
    }
}

/* Without a division of 64 bits: the part exceeds the word's begin by less than 2^-16 of the drive, which is less than
 * a word. */
COLD static uint32_t part_of(uint32_t word, uint32_t words) {
    return word * (UINT32_MAX / words + 1u);
}

static bool has_level(sampler_condition_t condition) {
    return condition != SAMPLER_AT_ONCE && condition != SAMPLER_CHANGED;
}

/* Arithmetic shift of a negative number: as everywhere in the firmware (fixed/fixed.h). */
COLD static bool is_value(const sampler_variable_t *variable, int32_t level) {
    const uint32_t shifted = (uint32_t)level << variable->right;
    return variable->is_signed ? (int32_t)shifted >> variable->right == level
                               : shifted >> variable->right == (uint32_t)level;
}

COLD static bool valid(const sampler_setup_t *setup, uint32_t words) {
    bool within = setup->variable.word < words;
    for (unsigned i = 0; i < setup->channels && i < SAMPLER_CHANNELS_MAX; i++) {
        within = within && setup->word[i] < words;
    }
    return within && setup->channels >= 1u && setup->channels <= SAMPLER_CHANNELS_MAX &&
           setup->event >= SAMPLER_EVENT_CONTROL && setup->event <= SAMPLER_EVENT_IDENTIFY && setup->divider >= 1u &&
           setup->condition < SAMPLER_CONDITIONS && setup->variable.left <= 31u && setup->variable.right <= 31u &&
           (!has_level(setup->condition) || is_value(&setup->variable, setup->level));
}

/* value: of the variable's word now. */
COLD static void set_window(sampler_t *sampler, const sampler_setup_t *setup, uint32_t word) {
    const sampler_variable_t *variable = &setup->variable;
    const uint32_t step = (1u << variable->right) - 1u; /* of the variable, less 1 */
    const uint32_t smallest = variable->is_signed ? 1u << 31 : 0;
    const uint32_t factor = 1u << variable->left;
    uint32_t begin = (uint32_t)setup->level << variable->right, end = begin | step;
    uint32_t waits_for_outside = 0;
    switch (setup->condition) {
    case SAMPLER_RISING:
        waits_for_outside = 1;
        end = smallest - 1u;
        break;
    case SAMPLER_AT_LEAST:
        end = smallest - 1u;
        break;
    case SAMPLER_FALLING:
        waits_for_outside = 1;
        begin = smallest;
        break;
    case SAMPLER_AT_MOST:
        begin = smallest;
        break;
    case SAMPLER_EQUAL:
        break;
    case SAMPLER_CHANGED:
        begin = (word * factor | step) + 1u;
        end = (word * factor & ~step) - 1u;
        break;
    case SAMPLER_AT_ONCE:
    default:
        begin = smallest;
        end = smallest - 1u;
        break;
    }
    sampler->factor = factor;
    sampler->window_end = end;
    sampler->window_length = end - begin;
    sampler->waits_for_outside = waits_for_outside;
}

COLD bool sampler_arm(sampler_t *sampler, const sampler_setup_t *setup, bool streams, const void *memory,
                      uint32_t words) {
    if (!valid(setup, words)) {
        return false;
    }
    const uint32_t record_words = setup->channels + (streams ? 1u : 0u);
    const uint32_t capacity = (SAMPLER_WORDS + record_words - 1u) / record_words;
    if (capacity < 2u || (!streams && setup->before > capacity - 2u)) {
        return false;
    }
    sampler_stop(sampler);
    for (unsigned i = 0; i < setup->channels; i++) {
        sampler->part[i] = part_of(setup->word[i], words);
    }
    sampler->trigger_part = part_of(setup->variable.word, words);
    drive_words_t drive = {memory, words};
    set_window(sampler, setup, word_of(&drive, sampler->trigger_part));
    sampler->last_channel = setup->channels - 1u;
    sampler->record_words = record_words;
    sampler->capacity = capacity;
    sampler->room = streams ? capacity : 0;
    sampler->written = sampler->taken = sampler->place = sampler->taken_place = sampler->lost = 0;
    sampler->left = capacity;
    sampler->waiting_floor = capacity - setup->before;
    sampler->trigger_events = sampler->trigger_left = 0;
    sampler->countdown = 1;
    sampler->divider = setup->divider;
    sampler->state = streams ? SAMPLER_STREAMS : SAMPLER_ARMED;
    MEMORY_ORDER(); /* the interrupt of the event may come from here on */
    *(volatile uint32_t *)&sampler->event = setup->event;
    return true;
}

/* The interrupt may come between any two stores: then it triggers or does not. */
COLD void sampler_trigger(sampler_t *sampler) {
    *(volatile uint32_t *)&sampler->window_length = UINT32_MAX;
    *(volatile uint32_t *)&sampler->waits_for_outside = 0;
}

COLD bool sampler_take(sampler_t *sampler, uint32_t record[1 + SAMPLER_CHANNELS_MAX]) {
    if (SAMPLER_WORDS == 0 || sampler->state != SAMPLER_STREAMS ||
        *(volatile uint32_t *)&sampler->written == sampler->taken) {
        return false;
    }
    MEMORY_ORDER();
    const uint32_t place = sampler->taken_place < SAMPLER_WORDS ? sampler->taken_place : 0;
    for (uint32_t i = 0; i < sampler->record_words && i <= SAMPLER_CHANNELS_MAX; i++) {
        record[i] = sampler->ring[place + i];
    }
    sampler->taken_place = place + sampler->record_words;
    MEMORY_ORDER(); /* the interrupt may overwrite the record from here on */
    *(volatile uint32_t *)&sampler->taken = sampler->taken + 1u;
    return true;
}
