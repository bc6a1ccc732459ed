// Jobs that take turns in the deferred interrupt: order of the turns, order of the jobs in a turn by what they need and
// write, and that a turn writes nothing else.
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

#include <gtest/gtest.h>

extern "C" {
#include "interrupts/deferred.h"
#include "interrupts/deferred_jobs.h"
}

#include "support/closed_loop.h"

namespace {

struct job_t {
    const char *call;
    deferred_turn_t turn;
    unsigned before, after, writes; // DATA_ bits
};

const std::vector<job_t> JOBS = {
#define JOB(turn, call, before, after, writes) {#call, turn, unsigned(before), unsigned(after), unsigned(writes)},
#include "interrupts/deferred_jobs.def"
#undef JOB
};

const std::vector<deferred_turn_t> TURNS = {DEFERRED_TURNS};

TEST(DeferredJobs, no_earlier_job_of_the_turn_writes_what_a_job_needs_as_the_turn_has_found_it) {
    for (size_t i = 0; i < JOBS.size(); i++) {
        for (size_t earlier = 0; earlier < i; earlier++) {
            if (JOBS[earlier].turn == JOBS[i].turn) {
                EXPECT_EQ(JOBS[earlier].writes & JOBS[i].before, 0u) << JOBS[earlier].call << ", " << JOBS[i].call;
            }
        }
    }
}

TEST(DeferredJobs, no_later_job_of_the_turn_writes_what_a_job_needs_as_new_as_it_is) {
    for (size_t i = 0; i < JOBS.size(); i++) {
        for (size_t later = i + 1; later < JOBS.size(); later++) {
            if (JOBS[later].turn == JOBS[i].turn) {
                EXPECT_EQ(JOBS[later].writes & JOBS[i].after, 0u) << JOBS[i].call << ", " << JOBS[later].call;
            }
        }
    }
}

TEST(DeferredJobs, what_a_job_needs_is_written_by_one) {
    unsigned written = 0;
    for (const job_t &job : JOBS) {
        written |= job.writes;
    }
    for (const job_t &job : JOBS) {
        EXPECT_EQ((job.before | job.after) & ~written, 0u) << job.call;
        EXPECT_NE(job.writes, unsigned(DATA_NONE)) << job.call << " has no effect";
    }
}

TEST(DeferredJobs, turns_come_as_often_as_the_periods_of_their_updates_state) {
    const auto every = [](deferred_turn_t first, deferred_turn_t second) {
        std::vector<size_t> at;
        for (size_t k = 0; k < 2 * TURNS.size(); k++) {
            if (TURNS[k % TURNS.size()] == first || TURNS[k % TURNS.size()] == second) {
                at.push_back(k);
            }
        }
        const size_t periods = at[1] - at[0];
        for (size_t k = 1; k < at.size(); k++) {
            EXPECT_EQ(at[k] - at[k - 1], periods);
        }
        return periods;
    };
    EXPECT_EQ(TURNS.size(), size_t(DEFERRED_COMMON_PERIODS));
    EXPECT_EQ(every(TURN_PHASE, TURN_PHASE), size_t(DEFERRED_LEARNING_PERIODS));
    EXPECT_EQ(every(TURN_LOAD, TURN_LOAD), size_t(DEFERRED_SLOW_PERIODS));
    EXPECT_EQ(every(TURN_COMMON, TURN_COMMON), size_t(DEFERRED_COMMON_PERIODS));
    EXPECT_EQ(every(TURN_INERTIA, TURN_INERTIA), size_t(DEFERRED_COMMON_PERIODS));
    EXPECT_EQ(every(TURN_COMMON, TURN_INERTIA) * CONDUCTION_STEPS, size_t(DEFERRED_CONDUCTION_PERIODS));
}

// Bytes of the data, by bit.
std::vector<std::vector<char>> contents(const deferred_t &deferred) {
    std::vector<std::vector<char>> data(10);
    const auto add = [&data](unsigned bit, const auto &member) {
        for (size_t k = 0; k < data.size(); k++) {
            if (bit == 1u << k) {
                const char *bytes = reinterpret_cast<const char *>(&member);
                data[k].insert(data[k].end(), bytes, bytes + sizeof member);
            }
        }
    };
    add(DATA_STROKES, deferred.stroke_mean);
    add(DATA_STROKES, deferred.load_constant);
    add(DATA_PERIODIC_LOAD, deferred.periodic_load);
    add(DATA_TORQUE_OFFSET, deferred.torque_offset);
    add(DATA_SPEED_LAW, deferred.speed_smc);
    add(DATA_MISALIGNMENT, deferred.misalignment);
    add(DATA_APPROACH, deferred.approached_q22);
    add(DATA_APPROACH, deferred.updates_since_near);
    add(DATA_APPROACH, deferred.approaches_reference);
    add(DATA_MEAN_TORQUE, deferred.mean_torque_q24);
    add(DATA_INERTIA, deferred.inertia);
    add(DATA_CONDUCTION, deferred.conduction);
    add(DATA_CONDUCTION, deferred.conduction_update);
    add(DATA_SLOW_COUNTS, deferred.slow_counts);
    return data;
}

// A drive that compares the data before and after each of its deferred steps.
struct watched_drive_t : closed_loop::fixed_drive_t {
    unsigned changed[TURN_INERTIA + 1] = {}; // DATA_ bits by turn
    using fixed_drive_t::fixed_drive_t;

    bool step(const control_sample_t &sample, const command_t &command, hal_pwm_compare_t *compare) {
        const bool run = control_step(&parameters, &state, &sample, &command, compare);
        const auto before = contents(state.deferred);
        const unsigned turn = state.deferred.turn;
        deferred_step(&parameters, &state, &command);
        if (state.deferred.turn != turn) {
            const auto after = contents(state.deferred);
            for (size_t k = 0; k < after.size(); k++) {
                changed[TURNS[state.deferred.turn]] |= before[k] != after[k] ? 1u << k : 0;
            }
        }
        return run;
    }
};

TEST(DeferredJobs, a_turn_changes_what_its_jobs_write_and_nothing_else) {
    closed_loop::Bench<watched_drive_t> bench({}); // an encoder of 17 bits: counts are never slow
    bench.plant.speed_rad_s =
        fixed_point::rad_s(2000.0); // above base speed, where the gain of the speed law is smaller
    bench.reference_rpm = 2000.0;
    bench.run_until(0.05);
    bench.sensors.encoder_offset_deg = 0.3; // to be learned
    bench.reference_rpm = 120.0;            // fewer than 53 strokes in a second, whose course is reviewed
    bench.plant.load_torque_Nm = 8.0;
    bench.run_until(0.6);
    unsigned writes[TURN_INERTIA + 1] = {};
    for (const job_t &job : JOBS) {
        writes[job.turn] |= job.writes;
    }
    for (const deferred_turn_t turn : {TURN_LOAD, TURN_PHASE, TURN_COMMON, TURN_INERTIA}) {
        EXPECT_EQ(bench.drive.changed[turn], writes[turn]) << turn;
    }
}

} // namespace
