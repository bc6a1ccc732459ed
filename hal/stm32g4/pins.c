/* Pins: alternate functions, analogue inputs, pulls, from the table of pins.toml. */
#include "stm32g4/pins.h"
#include "stm32g4/board.h"
#include "stm32g4/registers.h"

#define MODE_INPUT 0u
#define MODE_ALTERNATE 2u
#define MODE_ANALOGUE 3u
#define SPEED_HIGH 2u

typedef struct {
    uint32_t port;
    uint8_t number;   /* of the pin in its port */
    uint8_t mode;     /* MODE_* */
    uint8_t function; /* number of the alternate function */
    uint8_t pull;     /* 0 none, 1 up, 2 down */
} pin_t;

#define PIN(port, number, mode, function, pull) {port, number, mode, function, pull},
static const pin_t pins[] = {BOARD_PINS(PIN)};

/* Replaces field `n` of a register whose fields have `width` bits. */
static void set_field(volatile uint32_t *word, unsigned n, unsigned width, uint32_t value) {
    const uint32_t mask = BITS(width * n, width);
    *word = (*word & ~mask) | value << (width * n);
}

/* The function and the pull are there before the mode, so that a gate output is never driven by anything else. */
void pins_init(void) {
    for (unsigned i = 0; i < sizeof pins / sizeof pins[0]; i++) {
        const pin_t *pin = &pins[i];
        set_field(&GPIO_PUPDR(pin->port), pin->number, 2, pin->pull);
        if (pin->mode == MODE_ALTERNATE) {
            set_field(&GPIO_OSPEEDR(pin->port), pin->number, 2, SPEED_HIGH);
            set_field(pin->number < 8 ? &GPIO_AFRL(pin->port) : &GPIO_AFRH(pin->port), pin->number % 8u, 4,
                      pin->function);
        }
        set_field(&GPIO_MODER(pin->port), pin->number, 2, pin->mode);
    }
}
