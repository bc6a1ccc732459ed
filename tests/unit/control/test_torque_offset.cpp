// Integral of requested less estimated torque.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/torque_offset.h"
}

#include "support/fixed_point.h"
#include "support/wide_integer.h"

namespace {

using namespace fixed_point;
constexpr uint32_t RATE_HZ = 10000;

// A drive whose torque is smaller than its reference.
class Drive {
  public:
    void run(double duration_s, double requested_Nm, double missing_Nm, bool voltage_limited = false) {
        for (int k = 0; k < int(duration_s * RATE_HZ); k++) {
            const int32_t reference_q24 = to_fixed(requested_Nm, Q24) + torque_offset_q24(&offset);
            torque_q24 = reference_q24 - to_fixed(missing_Nm, Q24);
            torque_offset_step(&parameters, &offset, reference_q24, torque_q24, voltage_limited);
        }
    }

    torque_offset_parameters_t parameters = torque_offset_configure(RATE_HZ, to_fixed(16.0, Q24));
    torque_offset_t offset{};
    int32_t torque_q24 = 0;
};

TEST(TorqueOffset, missing_torque_is_made_up_exponentially_within_50_ms) {
    Drive drive;
    drive.run(0.05, 8.0, 0.1);
    EXPECT_NEAR(drive.torque_q24 / Q24, 8.0 - 0.1 * std::exp(-1.0), 1e-4);
    drive.run(1.0, 8.0, 0.1);
    EXPECT_NEAR(drive.torque_q24 / Q24, 8.0, 1e-6);
    drive.run(1.0, -8.0, -0.1);
    EXPECT_NEAR(drive.torque_q24 / Q24, -8.0, 1e-6);
}

TEST(TorqueOffset, is_kept_while_the_voltage_limits_the_torque) {
    Drive drive;
    drive.run(1.0, 8.0, 0.1);
    const int32_t before_q24 = torque_offset_q24(&drive.offset);
    drive.run(1.0, 8.0, 3.0, true);
    EXPECT_EQ(torque_offset_q24(&drive.offset), before_q24);
}

TEST(TorqueOffset, is_at_most_an_eighth_of_the_largest_torque_and_overflows_nothing) {
    for (const int32_t torque_q24 : {INT32_MIN, INT32_MAX}) {
        Drive drive;
        for (uint32_t k = 0; k < RATE_HZ; k++) {
            torque_offset_step(&drive.parameters, &drive.offset, torque_q24 < 0 ? INT32_MAX : INT32_MIN, torque_q24,
                               false);
        }
        EXPECT_NEAR(torque_offset_q24(&drive.offset) / Q24, torque_q24 < 0 ? 2.0 : -2.0, 1e-6);
    }
}

TEST(TorqueOffset, is_the_clamped_sum_of_saturated_differences_rounded_down_for_any_arguments) {
    using namespace wide_integer;
    std::mt19937 random(1);
    int inside = 0;
    for (int drive = 0; drive < 200; drive++) {
        const torque_offset_parameters_t parameters =
            torque_offset_configure(1000 + random() % 100000, any_up_to(random, INT32_MAX));
        const wide_t limit_q56 = wide_t(parameters.limit_q24) << 32;
        torque_offset_t offset{};
        wide_t exact_q56 = 0;
        for (int k = 0; k < 500; k++) {
            const wide_t offset_q24 = rounded_down(exact_q56, power_of_2(32));
            ASSERT_EQ(torque_offset_q24(&offset), int32_t(offset_q24)) << drive << " " << k;
            inside += exact_q56 != 0 && exact_q56 < limit_q56 && exact_q56 > -limit_q56;
            const int32_t reference_q24 = any(random), torque_q24 = any(random);
            torque_offset_step(&parameters, &offset, reference_q24, torque_q24, false);
            const wide_t error_q24 = saturated(wide_t(saturated(reference_q24 - offset_q24)) - torque_q24);
            exact_q56 = std::clamp(exact_q56 + error_q24 * parameters.gain_q32, -limit_q56, limit_q56);
        }
    }
    EXPECT_GT(inside, 40000) << "of 100000";
}

} // namespace
