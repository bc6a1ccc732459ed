#include "hal_random.h"

#include "stm32g4/board.h"
#include "stm32g4/registers.h"

void random_init(void) {
    RNG_CR = RNG_CR_RNGEN;
}

/* After a seed error the generator is started again (RM0440, RNG: error management). */
uint32_t hal_random_u32(hal_t *hal) {
    (void)hal;
    for (;;) {
        const uint32_t status = RNG_SR;
        if ((status & (RNG_SR_SECS | RNG_SR_SEIS | RNG_SR_CEIS)) != 0) {
            RNG_SR = ~(RNG_SR_SEIS | RNG_SR_CEIS);
            RNG_CR = 0;
            RNG_CR = RNG_CR_RNGEN;
        } else if ((status & RNG_SR_DRDY) != 0) {
            return RNG_DR;
        }
    }
}
