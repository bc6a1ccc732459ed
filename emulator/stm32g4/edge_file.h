/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Edges of pins in a text file, one a line: cycle of HCLK, pin, level. The edges of timers are those computed from
 * counter, compare value and mode, as the bench gets them.
 */
#ifndef STM32G4_EDGE_FILE_H
#define STM32G4_EDGE_FILE_H

#include <stdbool.h>

bool edge_file_open(const char *path, const unsigned pins[], unsigned count);
void edge_file_close(void);

#endif
