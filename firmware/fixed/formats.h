/* Numbers 1 of the formats and the half revolution, which several modules need. */
#ifndef FIXED_FORMATS_H
#define FIXED_FORMATS_H

#define ONE_Q14 (1 << 14)
#define ONE_Q15 (1 << 15)
#define ONE_Q16 (1 << 16)
#define ONE_Q22 (1 << 22)
#define ONE_Q30 (1 << 30)

/* Angles are unsigned, 2^-32 revolution, and wrap: mechanical ones of the rotor's revolution, electrical ones of a
 * rotor pole pitch. Of a phase, electrical 0 is the aligned and half a revolution the unaligned position. */
#define HALF_REV 0x80000000u

#endif
