/* Compiler extensions of the firmware, each defined here only. Gains are instructions of a control interrupt in the two
 * experiments of tools/scenarios, median, on a Cortex-M4 by GCC 12.2 at -O2 with link-time optimisation (2026-11). An
 * extension without a gain is not used. */
#ifndef FIXED_COMPILER_H
#define FIXED_COMPILER_H

/* Keeps a function out of its caller where both together need more registers than the processor has. The phase map's
 * look-ups: 11 instructions with traditional and paper, 20 with salient. The learning
 * of the misalignment: 40 of the computed bound of the deferred interrupt. */
#define NOINLINE __attribute__((noinline))

/* For the functions that a program calls outside the interrupts: they and what they alone call are optimised for size.
 * 764 bytes of flash. */
#define COLD __attribute__((cold))

/* For a function whose argument must be a constant, the operand of an instruction. */
#define ALWAYS_INLINE __attribute__((always_inline)) static inline

/* Computes a value here, in a register: the compiler otherwise moves a constant offset from the loads that follow into
 * their index, an address for each of them, or narrows a difference before it is stored. 17 of the computed bound of
 * salient. */
#define IN_REGISTER(value) __asm__("" : "+r"(value))

/* Type through which objects of any other type may be read. The self-test reads words without a call of memcpy for
 * each: 660 instructions of each pass of the background. */
#define MAY_ALIAS __attribute__((may_alias))

/* Loads and stores before it are not moved behind it, nor those behind it before it: for what the background and an
 * interrupt of the same processor share. No instruction. */
#define MEMORY_ORDER() __atomic_signal_fence(__ATOMIC_SEQ_CST)

/* A condition that holds in the longest interrupt: its code follows it without a jump. 4 of the computed bound of
 * traditional. */
#define LIKELY(condition) __builtin_expect(!!(condition), 1)

/* Unrolls the loop that follows; iterations is a number. Sums of the BP network and its PID: 29 instructions forward,
 * 12 learning, 16 in the PID. Duties of hysteresis control: 11. Loops over the phases, whose number is known when a
 * drive is linked with the tables of its machine: 122 of the computed bound of salient, 40 of paper's. */
#define UNROLL(iterations) COMPILER_PRAGMA(GCC unroll iterations)
#define COMPILER_PRAGMA(text) _Pragma(#text)

#endif
