/* Hardware abstraction layer: the interface between firmware and hardware.
 *
 * All values are raw: ADC counts, encoder counts, timer ticks, CAN frames. Scaling, offsets and saturation belong to
 * the firmware, so that they are under test too.
 *
 * A port defines `struct hal` and every function of hal_adc.h, hal_can.h, hal_encoder.h, hal_interrupt.h, hal_nvm.h,
 * hal_pwm.h, hal_random.h, hal_time.h and hal_watchdog.h. It calls drive_control_interrupt once per control period,
 * from an interrupt that the PWM timer triggers, drive_deferred_interrupt once for each request of
 * hal_interrupt_request_deferred, and drive_background from its main loop. Each call of the firmware is given a
 * pointer to the port's structure, so several drives can share a process. Ports: emulator/host (the emulated board),
 * hal/qemu (boards of QEMU).
 *
 * Each function states the contexts from which it may be called: [control interrupt], [deferred interrupt],
 * [background], the main loop, or [any] of the three. The control interrupt pre-empts the deferred interrupt and the
 * background, the deferred interrupt pre-empts the background, never the reverse.
 */
#ifndef HAL_H
#define HAL_H

typedef struct hal hal_t;

/* Maximum number of phases of a port, 4 or 6; a drive uses the first `phases` of its machine. The host's programs serve
 * every machine. An image for a board is compiled with 4 for a machine of up to four phases: what lies behind an array
 * of phases is as near as it can be. */
#ifndef HAL_PHASES_MAX
#define HAL_PHASES_MAX 6
#endif

#endif
