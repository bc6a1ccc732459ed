/* [SR-34] */
#include "comms/arming.h"

#include "comms/counter.h"
#include "comms/e2e.h"
#include "drive_codec.h"
#include "fixed/compiler.h"
#include "hal_random.h"

void arming_init(arming_t *arming) {
    *arming = (arming_t){.changed = true}; /* a sender may take the drive for armed still */
}

/* Parts of arming_t.check: of one flipped bit neither becomes the other value. */
#define CHECK_ARMED 0x00ffu
#define CHECK_CONFIGURING 0xff00u

/* [SR-52] */
COLD bool arming_is_intact(const arming_t *arming) {
    return arming->check == ((arming->armed ? CHECK_ARMED : 0u) | (arming->configuring ? CHECK_CONFIGURING : 0u));
}

static void end_attempt(arming_t *arming) {
    arming->changed |= arming->attempt != ARMING_ATTEMPT_NONE;
    arming->attempt = ARMING_ATTEMPT_NONE;
    arming->challenge = 0;
}

COLD void arming_check_timeout(arming_t *arming, uint32_t time_us) {
    if (!arming_is_intact(arming)) {
        arming_disarm(arming);
        arming_end_configuration(arming);
    }
    const uint32_t age_us = time_us - arming->challenge_us;
    if (age_us > ARMING_RESPONSE_MAX_US) {
        end_attempt(arming);
    }
    if (age_us > ARMING_INTERVAL_US) {
        arming->drawn = false; /* long ago: the clock may come round */
    }
    if (time_us - arming->configuring_us > ARMING_CONFIGURATION_US) {
        arming_end_configuration(arming);
    }
}

/* [SR-35] */
COLD void arming_disarm(arming_t *arming) {
    if (arming->attempt == ARMING_ATTEMPT_RUN) {
        end_attempt(arming);
    }
    arming->changed |= arming->armed != 0;
    arming->armed = 0;
    arming->check &= (uint16_t)~CHECK_ARMED;
}

COLD void arming_end_configuration(arming_t *arming) {
    arming->changed |= arming->configuring != 0;
    arming->configuring = 0;
    arming->check &= (uint16_t)~CHECK_CONFIGURING;
}

COLD arming_result_t arming_refuse(arming_t *arming) {
    counter_add(&arming->refused, 1);
    return ARMING_REFUSED;
}

static arming_result_t request(arming_t *arming, hal_t *hal, arming_attempt_t attempt, const hal_can_frame_t *frame,
                               uint32_t time_us) {
    if (arming->drawn) {
        return arming_refuse(arming);
    }
    arming_end_configuration(arming);
    arming->counter = frame->data[E2E_HEADER_BYTES - 1];
    arming->attempt = attempt;
    arming->challenge = hal_random_u32(hal);
    arming->challenge_us = time_us;
    arming->drawn = true;
    arming->changed = true;
    return ARMING_CHALLENGED;
}

/* [SR-34] [SR-52] */
COLD void arming_arm(arming_t *arming) {
    arming->changed = true;
    arming->armed = 1;
    arming->check |= CHECK_ARMED;
}

static arming_result_t confirm(arming_t *arming, arming_attempt_t attempt, bool permitted, const hal_can_frame_t *frame,
                               uint32_t response, uint32_t time_us) {
    const uint32_t age_us = time_us - arming->challenge_us;
    const bool correct = permitted && arming->attempt == attempt && response == ~arming->challenge &&
                         age_us >= ARMING_RESPONSE_MIN_US && age_us <= ARMING_RESPONSE_MAX_US &&
                         frame->data[E2E_HEADER_BYTES - 1] == (uint8_t)(arming->counter + 1u);
    end_attempt(arming);
    if (!correct) {
        return arming_refuse(arming);
    }
    arming->changed = true;
    arming->drawn = false;
    if (attempt == ARMING_ATTEMPT_RUN) {
        arming_arm(arming);
        return ARMING_ARMED;
    }
    arming->configuring = 1;
    arming->check |= CHECK_CONFIGURING;
    arming->configuring_us = time_us;
    return ARMING_CONFIGURING;
}

COLD arming_result_t arming_receive(arming_t *arming, hal_t *hal, const hal_can_frame_t *frame, bool permitted,
                                    uint32_t time_us) {
    struct drive_arm_t message;
    (void)drive_arm_unpack(&message, frame->data, frame->length);
    switch ((arming_step_t)message.step) {
    case ARMING_STEP_REQUEST_RUN:
        return permitted && !arming->armed ? request(arming, hal, ARMING_ATTEMPT_RUN, frame, time_us)
                                           : arming_refuse(arming);
    case ARMING_STEP_CONFIRM_RUN:
        return confirm(arming, ARMING_ATTEMPT_RUN, permitted, frame, message.response, time_us);
    case ARMING_STEP_REQUEST_CONFIGURATION:
        return request(arming, hal, ARMING_ATTEMPT_CONFIGURATION, frame, time_us);
    case ARMING_STEP_CONFIRM_CONFIGURATION:
        return confirm(arming, ARMING_ATTEMPT_CONFIGURATION, true, frame, message.response, time_us);
    default:
        return arming_refuse(arming);
    }
}

COLD void arming_report(const arming_t *arming, uint16_t run_unarmed, hal_can_frame_t *frame) {
    const struct drive_arming_t message = {
        .challenge = arming->challenge,
        .attempt = (uint8_t)arming->attempt,
        .armed = arming->armed != 0,
        .configuring = arming->configuring != 0,
        .refused = (uint8_t)(arming->refused < UINT8_MAX ? arming->refused : UINT8_MAX),
        .run_unarmed = run_unarmed,
    };
    *frame = (hal_can_frame_t){.identifier = DRIVE_ARMING_FRAME_ID, .length = DRIVE_ARMING_LENGTH};
    (void)drive_arming_pack(frame->data, &message, sizeof frame->data);
}
