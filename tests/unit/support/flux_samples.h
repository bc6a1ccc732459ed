// Samples of currents, angle and integrals of the voltage for the flux monitors. Machine: saturating, 40 kHz, 240 V.
#pragma once

#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "control/flux_residual.h"
}

#include "support/fixed_point.h"
#include "support/phase_map_results.h"

using fixed_point::Q29;
constexpr uint32_t UNALIGNED = 0x80000000u;
constexpr uint32_t MIDDLE = 0xC0000000u;
constexpr int32_t PERIOD_Q29 = int32_t(240.0 * 25e-6 * Q29);

class FluxSamples : public testing::Test {
  protected:
    // In a run, at the unaligned position, each phase off.
    FluxSamples() {
        input.run = true;
        input.periods_per_ms = 40;
        input.stroke = 0x55555555u;
        input.electrical = UNALIGNED;
        input.period_flux_q29 = PERIOD_Q29;
        for (bool &off : input.off) {
            off = true;
        }
    }

    void set(unsigned phase, double current_A, double flux_Wb) {
        input.current_q9[phase] = int32_t(current_A * 512.0);
        input.flux_q29[phase] = int32_t(flux_Wb * Q29);
        input.off[phase] = false;
    }
    double table_Wb(double current_A) const {
        return phase_map_results::flux_q29(machine_tables, input.electrical, int32_t(current_A * 512.0)) / Q29;
    }

    flux_sample_t input{};
    int32_t correction_q29[HAL_PHASES_MAX] = {};
};
