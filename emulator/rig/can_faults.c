#include "rig/can_faults.h"

#include "plant/random.h"

#define STREAM UINT64_C(0x63616E5F66617565) /* distinguishes this stream from the stream of the sensors' noise */

void can_faults_init(can_faults_t *faults, uint64_t seed) {
    *faults = (can_faults_t){.fault = CAN_FAULT_NONE, .per_mille = 1000, .random_state = seed ^ STREAM};
}

uint32_t can_faults_random(can_faults_t *faults, uint32_t limit) {
    return (uint32_t)((random_next(&faults->random_state) >> 32) * limit >> 32);
}

can_fault_t can_faults_draw(can_faults_t *faults, bool from_drive) {
    if (faults->fault == CAN_FAULT_NONE || (faults->sender == CAN_FAULT_OF_DRIVE && !from_drive) ||
        (faults->sender == CAN_FAULT_OF_OTHERS && from_drive)) {
        return CAN_FAULT_NONE;
    }
    const uint32_t number = can_faults_random(faults, 1000 * 1000);
    return number < faults->per_mille * 1000 ? faults->fault : CAN_FAULT_NONE;
}
