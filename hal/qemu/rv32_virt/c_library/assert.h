/* Part of C11's assert.h that the firmware uses: Debian's compiler for RISC-V has no C library. */
#ifndef ASSERT_H
#define ASSERT_H

#define static_assert _Static_assert

#endif
