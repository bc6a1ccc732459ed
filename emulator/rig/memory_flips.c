#include "rig/memory_flips.h"

void memory_flips_init(memory_flips_t *flips) {
    *flips = (memory_flips_t){0};
}

void memory_flips_set(memory_flips_t *flips, const rig_firmware_t *firmware, memory_object_t object, bool flipped,
                      uint32_t bit) {
    if (flips->flipped[object] && !(flipped && flips->bit[object] == bit)) {
        flips->flipped[object] = false;
        firmware->flip(firmware->context, object, flips->bit[object]);
    }
    if (flipped && !flips->flipped[object]) {
        flips->flipped[object] = true;
        flips->bit[object] = bit;
        firmware->flip(firmware->context, object, bit);
    }
}

void memory_flips_drive_reset(memory_flips_t *flips) {
    for (unsigned object = 0; object < MEMORY_OBJECTS; object++) {
        flips->flipped[object] = flips->flipped[object] && object == MEMORY_CODE;
    }
}
