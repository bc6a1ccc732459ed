/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Edges of pins in a text file, one a line: cycle of HCLK, pin, level. The edges of timers are those computed from
 * counter, compare value and mode, as the bench gets them.
 */
#ifndef STM32G4_TRACE_H
#define STM32G4_TRACE_H

#include <stdbool.h>

bool trace_open(const char *path, const unsigned pins[], unsigned count);
void trace_close(void);

#endif
