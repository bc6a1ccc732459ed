// salient_reference: a constant load at a constant speed on any machine, once by the firmware and once by its reference
// model in double precision, with the same plant, sensors, voltage and control period. Prints torque ripple, mean
// torque and mean speed of both as one JSON line.
//
//   salient_reference IMAGE control_rate_hz=40000 speed_rpm=150 load_Nm=8 load_at_s=0.1 from_s=0.25 window_s=0.1 ...
//
// The run starts at standstill without load. Exit code 2 after one line on stderr for a wrong argument.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>

extern "C" {
#include "control/machine_tables.h"
#include "host/machine_image.h"

machine_tables_t machine_tables;
}

#include "support/closed_loop.h"

namespace {

using closed_loop::Bench;
using closed_loop::fixed_drive_t;
using closed_loop::reference_drive_t;
using closed_loop::setup_t;

constexpr int EXIT_USAGE = 2;

// `value`: the default; `whole`: without a fraction.
struct argument_t {
    const char *name;
    double value, minimum, maximum;
    bool whole;
};

enum { RATE, ENCODER_BITS, ENCODER_EDGES, ADC_BITS, SPEED, LOAD, LOAD_AT, FROM, WINDOW, ARGUMENTS };

argument_t arguments[ARGUMENTS] = {
    {"control_rate_hz", 40000, 20000, 1000000, true},
    {"encoder_bits", 17, 0, 24, true}, // 0: ideal
    {"encoder_edges", 0, 0, 1, true},
    {"adc_bits", 12, 12, 16, true},
    {"speed_rpm", 150, -100000, 100000, false},
    {"load_Nm", 8, -100000, 100000, false},
    {"load_at_s", 0.13, 0, 100, false},
    {"from_s", 0.3, 0, 100, false},
    {"window_s", 0.1, 0.001, 100, false},
};

// One NAME=VALUE; false after one line on stderr.
bool read_argument(const char *text) {
    const char *equals = std::strchr(text, '=');
    for (argument_t &argument : arguments) {
        if (equals == nullptr || std::string(text, equals) != argument.name) {
            continue;
        }
        char *end;
        const double value = std::strtod(equals + 1, &end);
        if (end == equals + 1 || *end != '\0' || !(value >= argument.minimum && value <= argument.maximum) ||
            (argument.whole && value != std::floor(value))) {
            std::fprintf(stderr, "salient_reference: %s: must be a %snumber from %g to %g\n", text,
                         argument.whole ? "whole " : "", argument.minimum, argument.maximum);
            return false;
        }
        argument.value = value;
        return true;
    }
    std::fprintf(stderr, "salient_reference: %s: must be NAME=VALUE, NAME one of", text);
    for (const argument_t &argument : arguments) {
        std::fprintf(stderr, " %s", argument.name);
    }
    std::fputc('\n', stderr);
    return false;
}

template <typename drive_t> void measure(const char *name, const setup_t &setup) {
    Bench<drive_t> bench(setup);
    const double from_s = arguments[FROM].value, to_s = from_s + arguments[WINDOW].value;
    bench.reference_rpm = arguments[SPEED].value;
    bench.run_until(std::min(arguments[LOAD_AT].value, from_s));
    bench.plant.load_torque_Nm = arguments[LOAD].value;
    bench.run_until(from_s);
    bench.restart_trace();
    bench.run_until(to_s);
    const double mean_rpm = 30.0 / fixed_point::PI * bench.trace.mean_speed_rad_s(from_s, to_s);
    std::printf("\"%s\": {\"ripple\": %.6g, \"torque_mean_Nm\": %.6g, \"speed_mean_rpm\": %.8g}", name,
                bench.trace.ripple(from_s, to_s), bench.trace.mean_torque_Nm(from_s, to_s), mean_rpm);
}

machine_image_t image; // large

} // namespace

int main(int argc, char *argv[]) {
    if (argc < 2) {
        std::fprintf(stderr, "salient_reference: usage: salient_reference IMAGE [NAME=VALUE...]\n");
        return EXIT_USAGE;
    }
    for (int i = 2; i < argc; i++) {
        if (!read_argument(argv[i])) {
            return EXIT_USAGE;
        }
    }
    const auto rate_hz = uint32_t(arguments[RATE].value);
    const auto encoder_bits = unsigned(arguments[ENCODER_BITS].value);
    if (encoder_bits > 0 && encoder_bits < 8) {
        std::fprintf(stderr, "salient_reference: encoder_bits=%u: must be 0, an ideal one, or 8 to 24\n", encoder_bits);
        return EXIT_USAGE;
    }
    if (!configure_rate_allowed(rate_hz, fixed_point::TIMER_CLOCK_HZ)) {
        std::fprintf(stderr, "salient_reference: control_rate_hz=%u: must be 20000, 40000, 50000, 100000 or 1000000\n",
                     unsigned(rate_hz));
        return EXIT_USAGE;
    }
    if (!machine_image_open(&image, argv[1]) ||
        !machine_image_tables(&image, &machine_tables_structure, &machine_tables)) {
        return EXIT_USAGE;
    }
    setup_t setup{.rate_hz = rate_hz,
                  .encoder_bits = encoder_bits > 0 ? encoder_bits : 32,
                  .adc_bits = unsigned(arguments[ADC_BITS].value),
                  .edges = arguments[ENCODER_EDGES].value != 0.0,
                  .machine = &image.machine};
    std::printf("{");
    measure<fixed_drive_t>("firmware", setup);
    // The load is constant: the reference is that without the detector of a moving load, which the ripple of a light
    // machine may trigger. The detector withholds nothing when the bandwidth for it is the steady one.
    setup.parameters[PARAMETER_OBSERVER_MOVING_RAD_S] = 100.0;
    std::printf(", ");
    measure<reference_drive_t>("reference", setup);
    std::printf("}\n");
    machine_image_close(&image);
    return 0;
}
