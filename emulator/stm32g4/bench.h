/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * The part on the project's bench: pins to gates, sensors, lines and bus.
 */
#ifndef STM32G4_BENCH_H
#define STM32G4_BENCH_H

/* Runs the image that is loaded; arguments as the host executable's. Exit code. */
int bench_run(int argc, char *argv[]);

#endif
