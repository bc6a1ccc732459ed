#include "interrupts/sampler.h"

#include <stddef.h>

#include "fixed/compiler.h"
#include "fixed/fixed.h"

/* A place out of the drive, as after a change in memory, reads 0. */
static inline uint32_t word_at(const void *memory, uint32_t words, uint32_t word) {
    return word < words ? ((sampler_word_t *)memory)[word] : 0;
}

/* Unsigned values are compared as signed ones from -2^31 on, in their order. */
static inline int32_t in_order(const sampler_variable_t *variable, uint32_t value) {
    return (int32_t)(variable->is_signed ? value : value ^ 0x80000000u);
}

static inline int32_t value_of(const sampler_variable_t *variable, const void *memory, uint32_t words) {
    const uint32_t left = word_at(memory, words, variable->word) << (variable->left & 31u);
    const uint32_t right = variable->right & 31u;
    /* Arithmetic shift of a negative number: as everywhere in the firmware (fixed/fixed.h). */
    return in_order(variable, variable->is_signed ? (uint32_t)((int32_t)left >> right) : left >> right);
}

static bool holds(const sampler_t *sampler, int32_t value) {
    const int32_t level = in_order(&sampler->setup.variable, (uint32_t)sampler->setup.level);
    switch (sampler->setup.condition) {
    case SAMPLER_AT_LEAST:
        return value >= level;
    case SAMPLER_AT_MOST:
        return value <= level;
    case SAMPLER_RISING:
        return sampler->has_last && value >= level && sampler->last < level;
    case SAMPLER_FALLING:
        return sampler->has_last && value <= level && sampler->last > level;
    case SAMPLER_EQUAL:
        return value == level;
    case SAMPLER_CHANGED:
        return sampler->has_last && value != sampler->last;
    case SAMPLER_AT_ONCE:
    default:
        return true;
    }
}

static void follow(sampler_t *sampler) {
    sampler->trigger_events = sampler->countdown;
    sampler->following = sampler->capacity - (sampler->setup.before - sampler->missing);
    sampler->state = SAMPLER_FOLLOWS;
}

static void await_trigger(sampler_t *sampler, const void *memory, uint32_t words) {
    const int32_t value = value_of(&sampler->setup.variable, memory, words);
    if (holds(sampler, value)) {
        follow(sampler);
    }
    sampler->last = value;
    sampler->has_last = true;
}

static inline uint32_t next_place(const sampler_t *sampler, uint32_t end) {
    return end + sampler->record_words > SAMPLER_WORDS ? 0 : end;
}

static inline void write_record(sampler_t *sampler, const void *memory, uint32_t words, uint32_t time_us) {
    const bool streams = sampler->state == SAMPLER_STREAMS;
    const uint32_t channels = fixed_min_u32(sampler->setup.channels, SAMPLER_CHANNELS_MAX);
    const uint32_t needed = channels + (streams ? 1u : 0u);
    uint32_t place = sampler->place;
    if (needed > SAMPLER_WORDS || place > SAMPLER_WORDS - needed) { /* changed in memory */
        sampler_stop(sampler);
        return;
    }
    if (streams) {
        sampler->ring[place++] = time_us;
    }
    for (uint32_t i = 0; i < channels; i++) {
        sampler->ring[place++] = word_at(memory, words, sampler->setup.word[i]);
    }
    sampler->place = next_place(sampler, place);
    sampler->missing -= sampler->missing > 0 && sampler->state == SAMPLER_WAITS;
    sampler->written++;
}

NOINLINE void sampler_record(sampler_t *sampler, const void *memory, uint32_t words, uint32_t time_us) {
    sampler->countdown -= sampler->countdown > 0;
    if (sampler->state == SAMPLER_WAITS) {
        await_trigger(sampler, memory, words);
    }
    if (sampler->countdown > 0) {
        return;
    }
    sampler->countdown = sampler->setup.divider;
    if (sampler->state == SAMPLER_STREAMS && sampler->written - sampler->taken >= sampler->capacity) {
        sampler->lost++;
        return;
    }
    write_record(sampler, memory, words, time_us);
    if (sampler->state == SAMPLER_FOLLOWS && --sampler->following == 0) {
        sampler->state = SAMPLER_COMPLETE;
        sampler->event = 0;
    }
}

NOINLINE void sampler_record_control(sampler_t *sampler, const void *memory, uint32_t words, uint32_t time_us,
                                     uint32_t deferred_steps) {
    if (sampler->event == SAMPLER_EVENT_DEFERRED) {
        if (sampler->step == deferred_steps) {
            return;
        }
        sampler->step = deferred_steps;
    }
    sampler_record(sampler, memory, words, time_us);
}

COLD void sampler_stop(sampler_t *sampler) {
    *(volatile uint32_t *)&sampler->event = 0;
    MEMORY_ORDER(); /* the interrupt leaves the rest alone from here on */
    if (sampler->state != SAMPLER_COMPLETE) {
        sampler->state = SAMPLER_OFF;
    }
}

COLD static bool valid(const sampler_setup_t *setup, uint32_t words) {
    bool within = setup->variable.word < words;
    for (unsigned i = 0; i < setup->channels && i < SAMPLER_CHANNELS_MAX; i++) {
        within = within && setup->word[i] < words;
    }
    return within && setup->channels >= 1u && setup->channels <= SAMPLER_CHANNELS_MAX &&
           setup->event >= SAMPLER_EVENT_CONTROL && setup->event <= SAMPLER_EVENT_IDENTIFY && setup->divider >= 1u &&
           setup->condition < SAMPLER_CONDITIONS && setup->variable.left <= 31u && setup->variable.right <= 31u;
}

COLD bool sampler_arm(sampler_t *sampler, const sampler_setup_t *setup, bool streams, uint32_t words) {
    if (!valid(setup, words)) {
        return false;
    }
    const uint32_t record_words = setup->channels + (streams ? 1u : 0u);
    const uint32_t capacity = SAMPLER_WORDS / record_words;
    if (capacity < 2u || (!streams && setup->before > capacity - 2u)) {
        return false;
    }
    sampler_stop(sampler);
    sampler->setup = *setup;
    sampler->record_words = record_words;
    sampler->capacity = capacity;
    sampler->written = sampler->taken = sampler->place = sampler->taken_place = sampler->lost = 0;
    sampler->missing = setup->before;
    sampler->following = sampler->trigger_events = 0;
    sampler->countdown = 1;
    sampler->has_last = false;
    sampler->state = streams ? SAMPLER_STREAMS : SAMPLER_WAITS;
    MEMORY_ORDER(); /* the interrupt of the event may come from here on */
    *(volatile uint32_t *)&sampler->event = setup->event;
    return true;
}

COLD void sampler_trigger(sampler_t *sampler) {
    sampler->setup.condition = SAMPLER_AT_ONCE; /* one store: the interrupt may come before or after it */
}

COLD bool sampler_take(sampler_t *sampler, uint32_t record[1 + SAMPLER_CHANNELS_MAX]) {
    if (sampler->state != SAMPLER_STREAMS || *(volatile uint32_t *)&sampler->written == sampler->taken) {
        return false;
    }
    MEMORY_ORDER();
    uint32_t place = sampler->taken_place;
    for (uint32_t i = 0; i < sampler->record_words && i <= SAMPLER_CHANNELS_MAX; i++) {
        record[i] = place < SAMPLER_WORDS ? sampler->ring[place] : 0;
        place++;
    }
    sampler->taken_place = next_place(sampler, place);
    MEMORY_ORDER(); /* the interrupt may overwrite the record from here on */
    *(volatile uint32_t *)&sampler->taken = sampler->taken + 1u;
    return true;
}
