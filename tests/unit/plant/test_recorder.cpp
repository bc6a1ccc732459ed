#include <gtest/gtest.h>
#include <sys/resource.h>

#include <cmath>
#include <csignal>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <iterator>
#include <string>

#include "support/emulator_machines.h"

extern "C" {
#include "plant/recorder.h"
}

namespace {

std::string contents(const std::string &path) {
    std::ifstream file(path, std::ios::binary);
    return {std::istreambuf_iterator<char>(file), {}};
}

template <typename number_t> number_t number_at(const std::string &bytes, size_t offset) {
    number_t number;
    std::memcpy(&number, bytes.data() + offset, sizeof number);
    return number;
}

class Recorder : public testing::Test {
  protected:
    Recorder() : machine(machine_of(MAGNETICS_SATURATING)), path(testing::TempDir() + "test_emulator_recorder.npy") {
        plant_init(&plant, &machine, 0.0);
    }
    ~Recorder() override { std::remove(path.c_str()); }

    static constexpr size_t ROW_BYTES = 8 + 5 * 4 + 3 * 4 + 6 * 4;
    const machine_t machine;
    const std::string path;
    plant_t plant;
    recorder_t recorder = {};
    char error[200] = "";
};

TEST_F(Recorder, WritesAHeaderThatNumpyReads) {
    ASSERT_TRUE(recorder_open(&recorder, path.c_str(), 3, error, sizeof error)) << error;
    for (unsigned n = 0; n < 5; n++) {
        recorder_sample(&recorder, &plant);
    }
    ASSERT_TRUE(recorder_close(&recorder, error, sizeof error)) << error;
    const std::string bytes = contents(path);
    ASSERT_EQ(bytes.size(), RECORDER_HEADER_BYTES + 5 * ROW_BYTES);
    EXPECT_EQ(bytes.substr(0, 8), std::string("\x93NUMPY\x01\x00", 8));
    EXPECT_EQ(number_at<uint16_t>(bytes, 8), RECORDER_HEADER_BYTES - 10);
    EXPECT_EQ(RECORDER_HEADER_BYTES % 64, 0); // the format requires aligned data
    const std::string dictionary = bytes.substr(10, RECORDER_HEADER_BYTES - 10);
    EXPECT_EQ(dictionary.back(), '\n');
    EXPECT_EQ(dictionary.substr(0, dictionary.find_last_not_of(" \n") + 1),
              "{'descr': [('time_s', '<f8'), ('speed_rpm', '<f4'), ('torque_Nm', '<f4'), ('load_torque_Nm', '<f4'), "
              "('rotor_angle_deg', '<f4'), ('bus_voltage_V', '<f4'), ('current_a_A', '<f4'), ('current_b_A', '<f4'), "
              "('current_c_A', '<f4'), ('energy_drawn_J', '<f4'), ('energy_returned_J', '<f4'), "
              "('energy_copper_J', '<f4'), ('energy_converter_J', '<f4'), ('energy_load_J', '<f4'), "
              "('energy_friction_J', '<f4')], "
              "'fortran_order': False, 'shape': (5,), }");
}

TEST_F(Recorder, RowsHaveTheStateInTheUnitsOfTheHeader) {
    ASSERT_TRUE(recorder_open(&recorder, path.c_str(), 3, error, sizeof error)) << error;
    plant.time_ns = 130000001;
    plant.speed_rad_s = 20.0 * M_PI;
    plant.load_torque_Nm = 8.0;
    plant.rotor_angle_rad = -0.25 * M_PI;
    plant.current_A[0] = 1.0;
    plant.current_A[2] = 30.0;
    plant.bus_voltage_V = 231.5;
    plant.energy_drawn_J = 1024.0;
    plant.energy_returned_J = 512.0;
    plant.energy_copper_J = 64.0;
    plant.energy_converter_J = 32.0;
    plant.energy_load_J = -16.0;
    plant.energy_friction_J = 8.0;
    recorder_sample(&recorder, &plant);
    plant.rotor_angle_rad = -1e-12; // 360 deg as a float
    recorder_sample(&recorder, &plant);
    const double torque_Nm = plant_torque_Nm(&plant);
    ASSERT_TRUE(recorder_close(&recorder, error, sizeof error)) << error;
    const std::string bytes = contents(path);
    const size_t row = RECORDER_HEADER_BYTES;
    EXPECT_EQ(number_at<double>(bytes, row), 0.130000001);
    EXPECT_FLOAT_EQ(number_at<float>(bytes, row + 8), 600.0f);
    EXPECT_FLOAT_EQ(number_at<float>(bytes, row + ROW_BYTES + 12), static_cast<float>(torque_Nm));
    EXPECT_EQ(number_at<float>(bytes, row + 16), 8.0f);
    EXPECT_FLOAT_EQ(number_at<float>(bytes, row + 20), 315.0f);
    EXPECT_EQ(number_at<float>(bytes, row + 24), 231.5f);
    const float currents_and_energies[] = {1.0f, 0.0f, 30.0f, 1024.0f, 512.0f, 64.0f, 32.0f, -16.0f, 8.0f};
    for (size_t n = 0; n < std::size(currents_and_energies); n++) {
        EXPECT_EQ(number_at<float>(bytes, row + 28 + 4 * n), currents_and_energies[n]) << n;
    }
    EXPECT_EQ(number_at<float>(bytes, row + ROW_BYTES + 20), 0.0f);
}

TEST_F(Recorder, WorksAsAnObserverOfThePlant) {
    ASSERT_TRUE(recorder_open(&recorder, path.c_str(), 3, error, sizeof error)) << error;
    plant_observe(&plant, 0, 1000, recorder_sample, &recorder);
    plant_advance(&plant, 1000000);
    EXPECT_EQ(recorder.rows, 1001u);
    ASSERT_TRUE(recorder_close(&recorder, error, sizeof error)) << error;
    const std::string bytes = contents(path);
    EXPECT_EQ(number_at<double>(bytes, RECORDER_HEADER_BYTES + 1000 * ROW_BYTES), 1e-3);
}

// More rows than fit into the buffer, whose size is no multiple of theirs: none is lost or duplicated.
TEST_F(Recorder, EveryRowOfALongRunIsWrittenOnce) {
    static_assert(RECORDER_BUFFER_BYTES % (8 + 5 * 4 + 4 * 4 + 6 * 4) != 0);
    ASSERT_TRUE(recorder_open(&recorder, path.c_str(), 4, error, sizeof error)) << error;
    const size_t rows = 3 * RECORDER_BUFFER_BYTES / (ROW_BYTES + 4);
    for (size_t n = 0; n < rows; n++) {
        plant.time_ns = 1000 * n;
        recorder_sample(&recorder, &plant);
    }
    EXPECT_EQ(recorder.rows, rows);
    ASSERT_TRUE(recorder_close(&recorder, error, sizeof error)) << error;
    const std::string bytes = contents(path);
    ASSERT_EQ(bytes.size(), RECORDER_HEADER_BYTES + rows * (ROW_BYTES + 4));
    for (size_t n = 0; n < rows; n++) {
        ASSERT_NEAR(number_at<double>(bytes, RECORDER_HEADER_BYTES + n * (ROW_BYTES + 4)), n * 1e-6, 1e-12);
    }
}

TEST_F(Recorder, HeaderOfTheLongestRunOfTheMostPhasesFits) {
    ASSERT_TRUE(recorder_open(&recorder, path.c_str(), HAL_PHASES_MAX, error, sizeof error)) << error;
    recorder.rows = UINT64_MAX;
    ASSERT_TRUE(recorder_close(&recorder, error, sizeof error)) << error;
    const std::string bytes = contents(path);
    ASSERT_EQ(bytes.size(), RECORDER_HEADER_BYTES);
    EXPECT_NE(bytes.find("('energy_friction_J', '<f4')], 'fortran_order': False, 'shape': (18446744073709551615,), } "),
              std::string::npos);
}

TEST_F(Recorder, UnfinishedRunHasAHeaderWithoutRows) {
    ASSERT_TRUE(recorder_open(&recorder, path.c_str(), 3, error, sizeof error)) << error;
    recorder_sample(&recorder, &plant);
    EXPECT_NE(contents(path).find("'shape': (0,)"), std::string::npos);
    ASSERT_TRUE(recorder_close(&recorder, error, sizeof error));
    EXPECT_TRUE(recorder_close(&recorder, error, sizeof error)); // the second call does nothing
}

TEST_F(Recorder, FileThatCannotBeCreatedIsNamed) {
    EXPECT_FALSE(recorder_open(&recorder, "/nonexistent/run.npy", 3, error, sizeof error));
    EXPECT_STREQ(error, "cannot create recording '/nonexistent/run.npy': No such file or directory");
    EXPECT_TRUE(recorder_close(&recorder, error, sizeof error));
}

TEST_F(Recorder, FullDiskIsReportedAtTheEnd) {
    if (FILE *full = std::fopen("/dev/full", "wb")) {
        std::fclose(full);
    } else {
        GTEST_FAIL() << "/dev/full is missing";
    }
    EXPECT_FALSE(recorder_open(&recorder, "/dev/full", 3, error, sizeof error));
    EXPECT_STREQ(error, "cannot write recording '/dev/full': No space left on device");
}

// A file size limit emulates a disk that fills up during the run.
TEST_F(Recorder, WriteErrorDuringTheRunIsReportedAtTheEnd) {
    struct rlimit before = {}, low = {};
    ASSERT_EQ(getrlimit(RLIMIT_FSIZE, &before), 0);
    const auto signal_before = std::signal(SIGXFSZ, SIG_IGN);
    low = before;
    low.rlim_cur = RECORDER_HEADER_BYTES + RECORDER_BUFFER_BYTES / 2;
    ASSERT_TRUE(recorder_open(&recorder, path.c_str(), 3, error, sizeof error)) << error;
    ASSERT_EQ(setrlimit(RLIMIT_FSIZE, &low), 0);
    for (size_t n = 0; n < 2 * RECORDER_BUFFER_BYTES / ROW_BYTES; n++) {
        recorder_sample(&recorder, &plant);
    }
    const bool closed_well = recorder_close(&recorder, error, sizeof error);
    ASSERT_EQ(setrlimit(RLIMIT_FSIZE, &before), 0);
    std::signal(SIGXFSZ, signal_before);
    EXPECT_FALSE(closed_well);
    EXPECT_EQ(std::string(error), "cannot write recording '" + path + "': File too large");
}

} // namespace
