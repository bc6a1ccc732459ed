/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Between the part's pins and the emulated board of the rig: sensors, encoder, lines, bus, memory, gates.
 */
#ifndef STM32G4_BENCH_IO_H
#define STM32G4_BENCH_IO_H

#include <stdint.h>

#include "rig/board.h"
#include "stm32g4/wiring.h"

/* Joins both; keeps them. */
void bench_io_open(board_t *of, const wiring_t *pins);

/* Levels of the lines and pins after a reset of the part; the encoder counts from 0 to its position, as at power-up. */
void bench_io_reset(void);

/* The encoder's pins follow the latched count. */
void bench_io_encoder(void);

/* Lines of safe torque off, comparators and the drivers' fault follow the board. */
void bench_io_lines(void);

/* Frames of the bus go to the controller, as many as it takes. */
void bench_io_receive(void);

/* The gates of the plant follow the part's outputs from now on, until `to`, a cycle. */
void bench_io_gates(uint64_t to);

#endif
