/* Arming by induction: of any state that holds, any frame and any time. The state after it holds, and a drive is armed
 * by the answer to its challenge alone. */
#include "comms/arming.c"
#include "proof.h"

uint32_t nondet_uint32(void);

uint32_t hal_random_u32(hal_t *hal) {
    (void)hal;
    return nondet_uint32();
}

/* The codec is generated: it may give any step and any response. */
int drive_arm_unpack(struct drive_arm_t *message, const uint8_t *data, size_t length) {
    (void)data;
    (void)length;
    message->step = (uint8_t)nondet_uint32();
    message->response = nondet_uint32();
    return 0;
}

int drive_arming_pack(uint8_t *data, const struct drive_arming_t *message, size_t length) {
    CLAIM(length == sizeof((hal_can_frame_t *)0)->data);
    (void)data;
    (void)message;
    return 0;
}

/* Kept by every function. */
static bool is_whole(const arming_t *arming) {
    return arming_is_intact(arming) && arming->armed <= 1 && arming->configuring <= 1 &&
           IMPLIES(arming->attempt == ARMING_ATTEMPT_NONE, arming->challenge == 0);
}

void prove_arming_receive(arming_t arming, hal_can_frame_t frame, bool permitted, uint32_t time_us) {
    ASSUME(is_whole(&arming));
    const arming_t before = arming;
    const uint32_t age_us = time_us - before.challenge_us;
    const arming_result_t result = arming_receive(&arming, (hal_t *)0, &frame, permitted, time_us);
    CLAIM(is_whole(&arming));
    CLAIM((result == ARMING_ARMED) == (arming.armed && !before.armed) || before.armed);
    if (result == ARMING_ARMED || result == ARMING_CONFIGURING) {
        CLAIM(before.attempt == (result == ARMING_ARMED ? ARMING_ATTEMPT_RUN : ARMING_ATTEMPT_CONFIGURATION));
        CLAIM(age_us >= ARMING_RESPONSE_MIN_US && age_us <= ARMING_RESPONSE_MAX_US);
        CLAIM(frame.data[E2E_HEADER_BYTES - 1] == (uint8_t)(before.counter + 1u));
        CLAIM(arming.attempt == ARMING_ATTEMPT_NONE);
        CLAIM(IMPLIES(result == ARMING_ARMED, permitted));
    } else {
        CLAIM(arming.armed == before.armed && arming.configuring <= before.configuring);
    }
    CLAIM(IMPLIES(result == ARMING_CHALLENGED, !before.drawn && arming.drawn));
    CLAIM(IMPLIES(result == ARMING_REFUSED, arming.refused > before.refused || before.refused == UINT16_MAX));
}

void prove_arming(arming_t arming, uint32_t time_us, uint16_t run_unarmed) {
    ASSUME(is_whole(&arming));
    const arming_t before = arming;
    hal_can_frame_t frame;
    arming_report(&arming, run_unarmed, &frame);
    arming_check_timeout(&arming, time_us);
    CLAIM(is_whole(&arming) && arming.armed == before.armed && arming.configuring <= before.configuring);
    arming_disarm(&arming);
    CLAIM(is_whole(&arming) && !arming.armed && arming.attempt != ARMING_ATTEMPT_RUN);
    arming_end_configuration(&arming);
    CLAIM(is_whole(&arming) && !arming.configuring);
    arming_arm(&arming);
    CLAIM(is_whole(&arming) && arming.armed);
    arming_init(&arming);
    CLAIM(is_whole(&arming) && !arming.armed && !arming.configuring && arming.changed);
}

/* A flipped bit of what arms is found before it can act, in arming_check_timeout(). */
void prove_arming_flipped(arming_t arming, unsigned bit, unsigned part, uint32_t time_us) {
    ASSUME(is_whole(&arming) && bit < (part == 2 ? 16 : 8) && part < 3);
    arming.armed ^= (uint8_t)(part == 0 ? 1u << bit : 0u);
    arming.configuring ^= (uint8_t)(part == 1 ? 1u << bit : 0u);
    arming.check ^= (uint16_t)(part == 2 ? 1u << bit : 0u);
    const bool other = arming.armed > 1 || arming.configuring > 1; /* still true as before */
    CLAIM(other || !arming_is_intact(&arming));
    arming_check_timeout(&arming, time_us);
    CLAIM(other || (!arming.armed && !arming.configuring));
}
