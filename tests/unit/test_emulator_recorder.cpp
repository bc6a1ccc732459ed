#include <gtest/gtest.h>

#include <cmath>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <iterator>
#include <string>

#include "emulator_machines.h"

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

    static constexpr size_t ROW_BYTES = 8 + 4 * 4 + 3 * 4;
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
    EXPECT_EQ(RECORDER_HEADER_BYTES % 64, 0); // the format asks for aligned data
    const std::string dictionary = bytes.substr(10, RECORDER_HEADER_BYTES - 10);
    EXPECT_EQ(dictionary.back(), '\n');
    EXPECT_EQ(dictionary.substr(0, dictionary.find_last_not_of(" \n") + 1),
              "{'descr': [('time_s', '<f8'), ('speed_rpm', '<f4'), ('torque_Nm', '<f4'), ('load_torque_Nm', '<f4'), "
              "('rotor_angle_deg', '<f4'), ('current_a_A', '<f4'), ('current_b_A', '<f4'), ('current_c_A', '<f4')], "
              "'fortran_order': False, 'shape': (5,), }");
}

TEST_F(Recorder, RowsHoldTheStateInTheirUnits) {
    ASSERT_TRUE(recorder_open(&recorder, path.c_str(), 3, error, sizeof error)) << error;
    plant.time_ns = 130000001;
    plant.speed_rad_s = 20.0 * M_PI;
    plant.load_torque_Nm = 8.0;
    plant.rotor_angle_rad = -0.25 * M_PI;
    plant.current_A[0] = 1.0;
    plant.current_A[2] = 30.0;
    recorder_sample(&recorder, &plant);
    plant.rotor_angle_rad = -1e-12; // as a float a whole turn
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
    EXPECT_EQ(number_at<float>(bytes, row + 24), 1.0f);
    EXPECT_EQ(number_at<float>(bytes, row + 28), 0.0f);
    EXPECT_EQ(number_at<float>(bytes, row + 32), 30.0f);
    EXPECT_EQ(number_at<float>(bytes, row + ROW_BYTES + 20), 0.0f);
}

TEST_F(Recorder, IsThePlantsObserver) {
    ASSERT_TRUE(recorder_open(&recorder, path.c_str(), 3, error, sizeof error)) << error;
    plant_observe(&plant, 0, 1000, recorder_sample, &recorder);
    plant_advance(&plant, 1000000);
    EXPECT_EQ(recorder.rows, 1001u);
    ASSERT_TRUE(recorder_close(&recorder, error, sizeof error)) << error;
    const std::string bytes = contents(path);
    EXPECT_EQ(number_at<double>(bytes, RECORDER_HEADER_BYTES + 1000 * ROW_BYTES), 1e-3);
}

TEST_F(Recorder, UnfinishedRunHasAHeaderWithoutRows) {
    ASSERT_TRUE(recorder_open(&recorder, path.c_str(), 3, error, sizeof error)) << error;
    recorder_sample(&recorder, &plant);
    EXPECT_NE(contents(path).find("'shape': (0,)"), std::string::npos);
    ASSERT_TRUE(recorder_close(&recorder, error, sizeof error));
    EXPECT_TRUE(recorder_close(&recorder, error, sizeof error)); // twice does nothing
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

} // namespace
