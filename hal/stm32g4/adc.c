/* ADC: one injected conversion of each phase current in ADC1 to ADC4 and two in ADC5, DC link and torque transducer,
 * all started by TIM1's update; 12 bits. After each period's sample ADC2 converts one temperature. */
#include "hal_adc.h"
#include "stm32g4/board.h"
#include "stm32g4/pins.h"
#include "stm32g4/registers.h"

#define CKMODE_HCLK_4 3u
#define TRIGGER_TIM1_TRGO2 8u /* of ADC1 and 2 and of ADC3 to 5 */
#define RISING_EDGE 1u
#define REGULATOR_START_US 20u
#define CALIBRATION_TO_ENABLE_US 1u /* four ADC clocks at least */
/* Codes of SMPR, in ADC clocks of 23.5 ns at 170 MHz. */
#define SAMPLE_12_5 2u  /* currents, DC link, torque: source below 1 kohm */
#define SAMPLE_92_5 5u  /* temperatures */
#define SENSOR_BITS 16u /* of a temperature's code */

typedef struct {
    uint32_t adc;
    uint8_t channel;  /* of the first injected conversion */
    uint8_t channel2; /* of the second, 0: none */
} injected_t;

static const injected_t injected[] = {
    {ADC1_BASE, BOARD_CHANNEL_CURRENT_A, 0},
    {ADC2_BASE, BOARD_CHANNEL_CURRENT_B, 0},
    {ADC3_BASE, BOARD_CHANNEL_CURRENT_C, 0},
    {ADC4_BASE, BOARD_CHANNEL_CURRENT_D, 0},
    {ADC5_BASE, BOARD_CHANNEL_DC_LINK, BOARD_CHANNEL_TORQUE},
};
#define ADCS (sizeof injected / sizeof injected[0])

/* Windings a to d, then the switches of the phases. */
static const uint8_t temperature_channels[BOARD_TEMPERATURES] = {
    BOARD_CHANNEL_WINDING_A,  BOARD_CHANNEL_WINDING_B,  BOARD_CHANNEL_WINDING_C,  BOARD_CHANNEL_WINDING_D,
    BOARD_CHANNEL_SWITCHES_A, BOARD_CHANNEL_SWITCHES_B, BOARD_CHANNEL_SWITCHES_C, BOARD_CHANNEL_SWITCHES_D};

static void set_sample_time(uint32_t adc, unsigned channel, uint32_t code) {
    if (channel < 10) {
        ADC_SMPR1(adc) |= code << (3u * channel);
    } else {
        ADC_SMPR2(adc) |= code << (3u * (channel - 10u));
    }
}

static void start_up(uint32_t adc) {
    ADC_CR(adc) = 0; /* out of deep power-down */
    ADC_CR(adc) = ADC_CR_ADVREGEN;
    board_wait_us(REGULATOR_START_US, BOARD_CLOCK_MHZ);
    ADC_CR(adc) = ADC_CR_ADVREGEN | ADC_CR_ADCAL;
    while ((ADC_CR(adc) & ADC_CR_ADCAL) != 0) {
    }
    board_wait_us(CALIBRATION_TO_ENABLE_US, BOARD_CLOCK_MHZ);
    ADC_ISR(adc) = ADC_ISR_ADRDY;
    ADC_CR(adc) = ADC_CR_ADVREGEN | ADC_CR_ADEN;
    while (!(ADC_ISR(adc) & ADC_ISR_ADRDY)) {
    }
}

static void start_temperature(const hal_t *hal) {
    ADC_SQR1(ADC2_BASE) = PUT(ADC_SQR1_SQ1, temperature_channels[hal->temperature_sensor]);
    ADC_CR(ADC2_BASE) = ADC_CR_ADVREGEN | ADC_CR_ADSTART;
}

void adc_convert_temperature(hal_t *hal) {
    if ((ADC_ISR(ADC2_BASE) & ADC_ISR_EOC) != 0) {
        hal->temperature_counts[hal->temperature_sensor] = (uint16_t)ADC_DR(ADC2_BASE); /* clears EOC */
        hal->temperature_sensor = (uint8_t)((hal->temperature_sensor + 1u) % BOARD_TEMPERATURES);
        start_temperature(hal);
    }
}

void adc_init(hal_t *hal) {
    ADCC_CCR(ADC12_COMMON_BASE) = PUT(ADCC_CCR_CKMODE, CKMODE_HCLK_4);
    ADCC_CCR(ADC345_COMMON_BASE) = PUT(ADCC_CCR_CKMODE, CKMODE_HCLK_4);
    for (unsigned i = 0; i < ADCS; i++) {
        const injected_t *inputs = &injected[i];
        start_up(inputs->adc);
        set_sample_time(inputs->adc, inputs->channel, SAMPLE_12_5);
        uint32_t sequence = PUT(ADC_JSQR_JEXTSEL, TRIGGER_TIM1_TRGO2) | PUT(ADC_JSQR_JEXTEN, RISING_EDGE) |
                            PUT(ADC_JSQR_JSQ1, inputs->channel);
        if (inputs->channel2 != 0) {
            set_sample_time(inputs->adc, inputs->channel2, SAMPLE_12_5);
            sequence |= PUT(ADC_JSQR_JL, 1) | PUT(ADC_JSQR_JSQ2, inputs->channel2);
        }
        ADC_JSQR(inputs->adc) = sequence;
    }
    for (unsigned i = 0; i < BOARD_TEMPERATURES; i++) {
        set_sample_time(ADC2_BASE, temperature_channels[i], SAMPLE_92_5);
    }
    ADC_CFGR(ADC2_BASE) = ADC_CFGR_JQDIS | ADC_CFGR_OVRMOD;
    start_temperature(hal);
    for (unsigned i = 0; i < BOARD_TEMPERATURES; i++) { /* all once, before the drive asks for them */
        while (!(ADC_ISR(ADC2_BASE) & ADC_ISR_EOC)) {
        }
        adc_convert_temperature(hal);
    }
    ADC_IER(ADC5_BASE) = ADC_IER_JEOSIE;
    for (unsigned i = 0; i < ADCS; i++) {
        ADC_CR(injected[i].adc) = ADC_CR_ADVREGEN | ADC_CR_JADSTART;
    }
}

unsigned hal_adc_bits(const hal_t *hal) {
    (void)hal;
    return HAL_ADC_BITS_MIN;
}

void hal_adc_read(const hal_t *hal, hal_adc_sample_t *sample) {
    (void)hal;
    sample->phase_current_counts[0] = (uint16_t)ADC_JDR1(ADC1_BASE);
    sample->phase_current_counts[1] = (uint16_t)ADC_JDR1(ADC2_BASE);
    sample->phase_current_counts[2] = (uint16_t)ADC_JDR1(ADC3_BASE);
    sample->phase_current_counts[3] = (uint16_t)ADC_JDR1(ADC4_BASE);
    sample->bus_voltage_counts = (uint16_t)ADC_JDR1(ADC5_BASE);
    sample->load_torque_counts = (uint16_t)ADC_JDR2(ADC5_BASE);
}

/* The sensors of this board are linear: 0 V at HAL_ADC_TEMPERATURE_ZERO_C, the reference voltage at the upper end. */
uint16_t hal_adc_temperature(const hal_t *hal, unsigned sensor) {
    const unsigned index = sensor < HAL_ADC_INVERTER ? sensor : sensor - HAL_ADC_INVERTER + BOARD_TEMPERATURES / 2u;
    return (uint16_t)(*(const volatile uint16_t *)&hal->temperature_counts[index] << (SENSOR_BITS - HAL_ADC_BITS_MIN));
}

_Static_assert(HAL_PHASES_MAX == 4, "the board has four phases");
