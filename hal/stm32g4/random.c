#include "hal_random.h"

#include "stm32g4/board.h"
#include "stm32g4/registers.h"

#define PIPELINE_WORDS 12u

void random_init(void) {
    RNG_CR = RNG_CR_RNGEN;
}

/* After a seed error the words of the pipeline are discarded, and a clock error has no effect on the numbers (RM0440,
 * RNG: error management). A zero is the sign of a seed error since the status was read. */
uint32_t hal_random_u32(hal_t *hal) {
    (void)hal;
    uint32_t discard = 0;
    for (;;) {
        const uint32_t status = RNG_SR;
        if ((status & RNG_SR_SEIS) != 0) {
            RNG_SR = status & ~RNG_SR_SEIS;
            discard = PIPELINE_WORDS;
        } else if ((status & RNG_SR_DRDY) != 0) {
            const uint32_t number = RNG_DR;
            if (discard > 0) {
                discard--;
            } else if (number != 0) {
                return number;
            } else {
                /* the next status says so */
            }
        }
    }
}
