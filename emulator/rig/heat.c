#include "rig/heat.h"

#include <math.h>

#include "hal_adc.h"
#include "plant/units.h"
#include "rig_codec.h"

#define AMBIENT_C 25.0
/* Change of a winding's temperature that its resistance follows. */
#define FOLLOWED_K 1.0
#define STEP_NS UINT64_C(1000000)
#define CODES 65536.0
#define CODE_12_BITS 0xFFF0u

static double free_C(void) {
    return rig_set_held_winding_c_decode(RIG_SET_HELD_WINDING_C_FREE_CHOICE);
}

static uint16_t code_of(const sensors_input_fault_t *fault, double temperature_C) {
    const double read_C = temperature_C + (fault->scaled ? fault->offset : 0.0);
    const double code = (read_C - HAL_ADC_TEMPERATURE_ZERO_C) / HAL_ADC_TEMPERATURE_SPAN_K * CODES;
    const double converted = fault->held ? (double)fault->code : code;
    return (uint16_t)fmin(fmax(converted, 0.0), CODES - 1.0) & CODE_12_BITS;
}

static void convert(const heat_t *heat) {
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        heat->codes[HAL_ADC_WINDING + phase] =
            code_of(&heat->winding.sensor_fault[phase], heat->winding.temperature_C[phase]);
        heat->codes[HAL_ADC_INVERTER + phase] =
            code_of(&heat->inverter.sensor_fault[phase], heat->inverter.temperature_C[phase]);
    }
}

void heat_init(heat_t *heat, plant_t *plant, uint16_t *codes) {
    *heat = (heat_t){.plant = plant, .codes = codes};
    heat->ambient_C = AMBIENT_C;
    heat->winding.held_C = heat->inverter.held_C = free_C();
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        heat->winding.temperature_C[phase] = heat->inverter.temperature_C[phase] = AMBIENT_C;
        heat->resistance_C[phase] = PLANT_RESISTANCE_C;
    }
    convert(heat);
}

/* loss_J: since the plant's begin, per phase. */
static void step(heat_bodies_t *bodies, const double *loss_J, double capacity_J_K, double resistance_K_W,
                 double ambient_C, double step_s) {
    const bool held = bodies->held_C != free_C();
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        double *temperature_C = &bodies->temperature_C[phase];
        const double gained_J = loss_J[phase] - bodies->loss_J[phase];
        const double lost_J = (*temperature_C - ambient_C) * fmin(step_s / resistance_K_W, capacity_J_K);
        *temperature_C = held ? bodies->held_C : *temperature_C + (gained_J - lost_J) / capacity_J_K;
        bodies->loss_J[phase] = loss_J[phase];
    }
}

static void follow_resistances(heat_t *heat) {
    bool changed = false;
    for (unsigned phase = 0; phase < heat->plant->machine->phases; phase++) {
        const double temperature_C = heat->winding.temperature_C[phase];
        if (fabs(temperature_C - heat->resistance_C[phase]) >= FOLLOWED_K) {
            heat->resistance_C[phase] = temperature_C;
            changed = true;
        }
    }
    if (changed) {
        plant_set_winding_temperatures(heat->plant, heat->resistance_C);
    }
}

void heat_step(heat_t *heat) {
    const plant_t *plant = heat->plant;
    if (plant->time_ns - heat->time_ns < STEP_NS) {
        return;
    }
    const double step_s = (double)(plant->time_ns - heat->time_ns) * S_PER_NS;
    const thermal_data_t *data = &plant->machine->thermal;
    step(&heat->winding, plant->phase_copper_J, data->winding_capacity_J_K, data->winding_resistance_K_W,
         heat->ambient_C, step_s);
    step(&heat->inverter, plant->phase_converter_J, data->inverter_capacity_J_K, data->inverter_resistance_K_W,
         heat->ambient_C, step_s);
    heat->time_ns = plant->time_ns;
    follow_resistances(heat);
    convert(heat);
}

static double hottest_C(const heat_t *heat, const heat_bodies_t *bodies) {
    double hottest_C = bodies->temperature_C[0];
    for (unsigned phase = 1; phase < heat->plant->machine->phases; phase++) {
        hottest_C = fmax(hottest_C, bodies->temperature_C[phase]);
    }
    return hottest_C;
}

double heat_winding_C(const heat_t *heat) {
    return hottest_C(heat, &heat->winding);
}

double heat_inverter_C(const heat_t *heat) {
    return hottest_C(heat, &heat->inverter);
}
