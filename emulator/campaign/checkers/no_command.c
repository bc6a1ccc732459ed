/* A gate is on only by a request to run, of an armed client, that is neither withdrawn nor too old; after a fault and
 * after a reset by the watchdog only when a client has cleared it. [SR-34] [SR-35] [SR-41] [SR-48] */
#include "campaign/checkers/checker.h"

enum {
    NOT_ARMED = 1,
    AFTER_OFF,
    WITHOUT_A_COMMAND,
    FAULT_CLEARED = 5,
    IN_RUN_WITHOUT_A_COMMAND,
    AFTER_A_RESET = 8,
};

#define OFF_NS (5 * MS_NS)       /* until a request to switch off has opened the gates */
#define RUN_MAX_NS (502 * MS_NS) /* of a run since the last request: 500 ms, and the sender's step */

static void on_look(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    const observation_client_t *client = &seen->client;
    const uint64_t now_ns = seen->time_ns;
    const bool deaf = facts_may_be_deaf(seen);
    if (!seen->gates) {
        return;
    }
    if (client->unacknowledged && !facts_state_changed(seen) && !facts_impersonated(seen) && !seen->second_sender &&
        !seen->hostile_sender) {
        checker_violated(report, AFTER_A_RESET, (double)(now_ns - seen->reset_ns) * 1e-6);
    }
    if (!client->confirmed && !deaf) {
        checker_violated(report, NOT_ARMED, 0.0);
    }
    if (client->off_seen && now_ns > client->off_ns + OFF_NS && !deaf) {
        checker_violated(report, AFTER_OFF, 0.0);
    }
    /* The plant may not have advanced to the frame yet. */
    const uint64_t age_ns = now_ns > client->run_ns ? now_ns - client->run_ns : 0;
    if (!client->commanded || age_ns > facts_request_max_ns(seen, RUN_MAX_NS)) {
        checker_violated(report, WITHOUT_A_COMMAND, (double)age_ns * 1e-6);
    }
}

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    const uint64_t now_ns = seen->time_ns, run_ns = seen->client.run_ns;
    if (facts_state_changed(seen)) {
        return;
    }
    if (seen->drive.state == STATE_RUN && now_ns > run_ns + facts_request_max_ns(seen, RUN_MAX_NS)) {
        checker_violated(report, IN_RUN_WITHOUT_A_COMMAND, (double)(now_ns - run_ns) * 1e-6);
    }
    const bool ends = seen->before == STATE_FAULT && seen->drive.state != STATE_FAULT;
    if (ends && !seen->client.clear_seen && !facts_may_be_deaf(seen) && !facts_impersonated(seen)) {
        checker_violated(report, FAULT_CLEARED, 0.0);
    }
}

const checker_t no_command_checker = {.name = "no_command", .on_interrupt = on_interrupt, .on_look = on_look};
