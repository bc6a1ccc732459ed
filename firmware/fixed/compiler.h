#ifndef FIXED_COMPILER_H
#define FIXED_COMPILER_H
#define COLD __attribute__((cold))
#define NOINLINE __attribute__((noinline))
#define LIKELY(condition) __builtin_expect((condition), 1)
#endif
