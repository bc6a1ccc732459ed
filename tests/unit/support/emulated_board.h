// A board of the bench with its plant and sensors, without bus and firmware.
#pragma once

#include <gtest/gtest.h>

#include "support/emulator_machines.h"

extern "C" {
#include "rig/board.h"
}

class EmulatedBoard : public testing::Test {
  protected:
    EmulatedBoard() : machine(machine_of(MAGNETICS_LINEAR_COSINE)) {
        plant_init(&plant, &machine, 0.3);
        sensors_init(&sensors, &machine.sensors, 17, 12, 1);
        board_init(&board, &plant, &sensors, &bus, 0, 1);
    }

    machine_t machine;
    plant_t plant;
    sensors_t sensors;
    can_bus_t bus;
    board_t board;
};
