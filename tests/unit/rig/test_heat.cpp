// Temperatures of windings and switches: balance of their heat, their time constant, what holds them, their sensors.
#include "support/rig_bench.h"

extern "C" {
#include "rig/heat.h"
}

#include <cmath>
#include <numeric>

namespace {

constexpr uint64_t MS = 1000000;
enum : uint8_t { AMBIENT = 63, HELD_WINDING = 64, HELD_INVERTER = 65 };
constexpr int32_t FREE = -8388608;

uint16_t code_of(double temperature_C) {
    return uint16_t((temperature_C + 100.0) / 400.0 * 65536.0) & 0xFFF0u;
}

class Heat : public testing::Test {
  protected:
    void SetUp() override { client = bench.connect(); }

    void set(uint8_t variable, double value_C) {
        client->set(variable, std::isnan(value_C) ? FREE : int32_t(std::lround(value_C * 100.0)));
        bench.serve();
        ASSERT_EQ(client->receive().back().frame.data[1], 0) << "done";
    }

    void run_to(uint64_t time_ns) { bench.run_to(*client, time_ns); }

    const heat_t &heat() const { return bench.rig->heat; }
    const thermal_data_t &data() const { return machine_plant.thermal; }

    RigBench bench;
    std::unique_ptr<BusClient> client;
};

TEST_F(Heat, LossesOfThePhasesAreThoseOfThePlant) {
    run_to(50 * MS);
    const plant_t &plant = bench.rig->plant;
    const double copper_J = std::accumulate(plant.phase_copper_J, plant.phase_copper_J + HAL_PHASES_MAX, 0.0);
    const double converter_J = std::accumulate(plant.phase_converter_J, plant.phase_converter_J + HAL_PHASES_MAX, 0.0);
    EXPECT_GT(copper_J, 0.05);
    EXPECT_NEAR(copper_J, plant.energy_copper_J, 1e-12 * copper_J);
    EXPECT_NEAR(converter_J, plant.energy_converter_J, 1e-12);
    EXPECT_GT(plant.phase_copper_J[1], 0.9 * copper_J);
}

TEST_F(Heat, AWindingHasTheHeatOfItsLossesLessWhatItGaveAway) {
    run_to(500 * MS);
    const double rise_K = heat().winding.temperature_C[1] - 25.0;
    const double loss_J = heat().winding.loss_J[1];
    const double kept_J = rise_K * data().winding_capacity_J_K;
    EXPECT_GT(loss_J, 1.0);
    EXPECT_LT(kept_J, loss_J);
    // Given away: at most as at the last temperature all the time, at least none.
    EXPECT_GT(kept_J, loss_J - rise_K / data().winding_resistance_K_W * 0.5);
    EXPECT_NEAR(heat_winding_C(&bench.rig->heat), 25.0 + rise_K, 1e-12);
    EXPECT_NEAR(heat().winding.temperature_C[2], 25.0, 1e-3);
}

TEST_F(Heat, ResistanceOfAWindingFollowsItsTemperatureInStepsOf1K) {
    const plant_t &plant = bench.rig->plant;
    const double file_ohm = machine_plant.resistance_ohm;
    run_to(500 * MS);
    ASSERT_GT(heat().winding.temperature_C[1], 25.01);
    ASSERT_LT(heat().winding.temperature_C[1], 26.0);
    EXPECT_EQ(plant.winding_ohm[1], file_ohm) << "less than 1 K";
    for (const auto &[held_C, factor] : {std::pair{155.0, 1.5}, {-40.0, 0.75}, {51.0, 1.1}, {51.9, 1.1}}) {
        set(HELD_WINDING, held_C);
        run_to(bench.rig->board.time_ns + 3 * MS);
        for (unsigned phase = 0; phase < machine_plant.phases; phase++) {
            EXPECT_NEAR(plant.winding_ohm[phase], factor * file_ohm, 1e-12) << held_C;
        }
    }
}

TEST_F(Heat, CoolsWithItsTimeConstantToTheAmbientTemperature) {
    bench.firmware.lower = 0;
    set(HELD_WINDING, 125.0);
    set(HELD_INVERTER, 80.0);
    set(AMBIENT, 5.0);
    run_to(2 * MS);
    EXPECT_EQ(heat_winding_C(&bench.rig->heat), 125.0);
    EXPECT_EQ(heat_inverter_C(&bench.rig->heat), 80.0);
    set(HELD_WINDING, NAN);
    set(HELD_INVERTER, NAN);
    const double from_s = heat().time_ns * 1e-9;
    run_to(3000 * MS);
    const double passed_s = heat().time_ns * 1e-9 - from_s;
    const double winding_s = data().winding_capacity_J_K * data().winding_resistance_K_W;
    const double inverter_s = data().inverter_capacity_J_K * data().inverter_resistance_K_W;
    EXPECT_NEAR(winding_s, 60.0, 1e-9);
    EXPECT_NEAR(inverter_s, 20.0, 1e-9);
    EXPECT_NEAR(heat().winding.temperature_C[2], 5.0 + 120.0 * std::exp(-passed_s / winding_s), 2e-3);
    EXPECT_NEAR(heat().inverter.temperature_C[2], 5.0 + 75.0 * std::exp(-passed_s / inverter_s), 2e-3);
}

TEST_F(Heat, SensorsHaveTheLineOfTheBoardAndItsRails) {
    EXPECT_EQ(bench.rig->board.temperature_code[HAL_ADC_WINDING], code_of(25.0));
    for (const double temperature_C : {-50.0, 0.0, 99.9, 200.0}) {
        set(HELD_INVERTER, temperature_C);
        run_to(bench.rig->board.time_ns + 2 * MS);
        EXPECT_EQ(bench.rig->board.temperature_code[HAL_ADC_INVERTER + 1], code_of(temperature_C));
    }
    EXPECT_EQ(bench.rig->board.temperature_code[HAL_ADC_WINDING], code_of(25.0));
    bench.rig->heat.ambient_C = 1e4;
    bench.rig->heat.winding.held_C = -200.0;
    bench.rig->heat.inverter.held_C = 400.0;
    run_to(bench.rig->board.time_ns + 2 * MS);
    EXPECT_EQ(bench.rig->board.temperature_code[HAL_ADC_WINDING], 0);
    EXPECT_EQ(bench.rig->board.temperature_code[HAL_ADC_INVERTER], 65520);
}

} // namespace
