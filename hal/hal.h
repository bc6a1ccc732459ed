/* The seam between firmware and hardware.
 *
 * Everything here is raw: converter counts, encoder counts, timer ticks, CAN frames. Scaling, offsets and saturation
 * belong to the firmware, so that they are under test too. A port (host/, qemu/ with its boards, later others) defines
 * `struct hal` and these functions; the firmware only holds the pointer, so several drives can live in a process.
 *
 * Each function says from which context it may be called: [interrupt] the control interrupt, [background] the main
 * loop, [both]. The control interrupt pre-empts the background, never the other way round.
 */
#ifndef HAL_H
#define HAL_H

typedef struct hal hal_t;

/* Most phases any port wires up; a drive uses the first `phases` of its machine. */
#define HAL_PHASES_MAX 4

#endif
