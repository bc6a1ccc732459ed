#ifndef FIXED_COMPILER_H
#define FIXED_COMPILER_H

#define NOINLINE __attribute__((noinline))
#define ALWAYS_INLINE __attribute__((always_inline)) static inline
#define LIKELY(condition) __builtin_expect((condition), 1)
#define UNROLL(iterations) COMPILER_PRAGMA(GCC unroll iterations)
#define COMPILER_PRAGMA(text) _Pragma(#text)

#endif
