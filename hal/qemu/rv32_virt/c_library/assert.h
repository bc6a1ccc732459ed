/* Of C11's assert.h, what the firmware uses: Debian's compiler for RISC-V comes without a C library. */
#ifndef ASSERT_H
#define ASSERT_H

#define static_assert _Static_assert

#endif
