// Closed loop in one process: emulated machine, sensors and a drive, which is either the firmware's control interrupt
// or the reference model. Records true torque and speed every microsecond and computes metrics from them.
#ifndef TESTS_UNIT_CLOSED_LOOP_H
#define TESTS_UNIT_CLOSED_LOOP_H

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <map>
#include <numeric>
#include <vector>

extern "C" {
#include "interrupts/configure.h"
#include "interrupts/control_step.h"
#include "interrupts/deferred.h"
#include "plant/machine.h"
#include "plant/plant.h"
#include "plant/sensors.h"
}

#include "support/deferred_step.h"
#include "support/salient_reference.h"
#include "support/whole_sample.h"

namespace closed_loop {

struct setup_t {
    uint32_t rate_hz = 40000;
    unsigned encoder_bits = 17, adc_bits = 12; // 32 and 16: ideal
    bool edges = false;
    double rotor_deg = 0.0;
    std::map<parameter_index_t, double> parameters; // other than default, in their units
    plant_gains_t plant{1.0, 1.0, 1.0, 1.0};
    const machine_t *machine = &machine_plant;
    reference_model::units_t units = reference_model::units_of(machine_tables);

    control_parameters_t configured() const {
        parameters_t values;
        parameters_init(&values);
        parameters_set_controller(&values, DRIVE_CONTROLLER_SALIENT);
        for (const auto &[index, value] : parameters) {
            values.values[index] =
                fixed_point::to_fixed(value, std::ldexp(1.0, machine_tables.parameter_fraction_bits[index]));
        }
        return configure_control(&values, &machine_tables, rate_hz, encoder_bits, adc_bits,
                                 fixed_point::TIMER_CLOCK_HZ);
    }
};

// The firmware.
struct fixed_drive_t {
    control_parameters_t parameters;
    control_state_t state{};

    explicit fixed_drive_t(const setup_t &setup) : parameters(setup.configured()) {
        control_reset(&parameters, &state);
    }

    bool step(const control_sample_t &sample, const command_t &command, hal_pwm_compare_t *compare) {
        const bool run = control_step(&parameters, &state, &sample, &command, compare);
        deferred_step(&parameters, &state, &command);
        return run;
    }
};

// The reference model, with duties rounded to ticks of the PWM timer.
struct reference_drive_t {
    reference_model::salient_t model;
    unsigned phases;
    bool interleaved_pwm;
    double period_ticks;

    explicit reference_drive_t(const setup_t &setup) : reference_drive_t(setup, setup.configured()) {}

    bool step(const control_sample_t &sample, const command_t &command, hal_pwm_compare_t *compare) {
        const bool run = command.request == COMMAND_RUN;
        const auto duties = model.step(sample, command);
        *compare = hal_pwm_compare_t{};
        for (unsigned phase = 0; phase < phases && run; phase++) {
            const double duty = duties[phase];
            if (interleaved_pwm) {
                const int both = int(std::lround((1.0 + duty) * period_ticks));
                compare->upper[phase] = uint16_t(both / 2);
                compare->lower[phase] = uint16_t(both - both / 2);
            } else {
                compare->upper[phase] = uint16_t(duty >= 0.0 ? std::lround(duty * period_ticks) : 0);
                compare->lower[phase] = uint16_t(duty >= 0.0 ? period_ticks : std::lround((1.0 + duty) * period_ticks));
            }
        }
        return run;
    }

  private:
    reference_drive_t(const setup_t &setup, const control_parameters_t &p)
        : model(p, *setup.machine, setup.units, setup.rate_hz), phases(setup.machine->phases),
          interleaved_pwm(p.interleaved_pwm), period_ticks(p.period_ticks) {}
};

// Ground truth, one value per microsecond from first_us on.
struct trace_t {
    uint64_t first_us = 0;
    std::vector<double> torque_Nm, speed_rad_s;

    size_t index(double time_s) const {
        const auto us = uint64_t(std::llround(time_s * 1e6));
        return std::min(size_t(us > first_us ? us - first_us : 0), torque_Nm.size());
    }

    double mean_torque_Nm(double from_s, double to_s) const { return mean(torque_Nm, from_s, to_s); }
    double mean_speed_rad_s(double from_s, double to_s) const { return mean(speed_rad_s, from_s, to_s); }

    // (maximum - minimum) / mean.
    double ripple(double from_s, double to_s) const {
        const auto [minimum, maximum] =
            std::minmax_element(torque_Nm.begin() + long(index(from_s)), torque_Nm.begin() + long(index(to_s)));
        return (*maximum - *minimum) / mean_torque_Nm(from_s, to_s);
    }

    // Time from from_s to the last sample outside +-0.5 % of a speed; 0 when all are inside.
    double last_exit_s(double speed, double from_s, double to_s) const {
        for (size_t i = index(to_s); i > index(from_s); i--) {
            if (std::fabs(speed_rad_s[i - 1] - speed) > 0.005 * std::fabs(speed)) {
                return double(i - index(from_s)) * 1e-6;
            }
        }
        return 0.0;
    }

    double min_speed(double from_s, double to_s) const {
        return *std::min_element(speed_rad_s.begin() + long(index(from_s)), speed_rad_s.begin() + long(index(to_s)));
    }
    double max_speed(double from_s, double to_s) const {
        return *std::max_element(speed_rad_s.begin() + long(index(from_s)), speed_rad_s.begin() + long(index(to_s)));
    }

  private:
    double mean(const std::vector<double> &values, double from_s, double to_s) const {
        const auto first = values.begin() + long(index(from_s)), last = values.begin() + long(index(to_s));
        return std::accumulate(first, last, 0.0) / double(last - first);
    }
};

template <typename drive_t> class Bench {
  public:
    explicit Bench(const setup_t &setup)
        : drive(setup), rate_hz(setup.rate_hz), speed_unit_rad_s(setup.units.speed_rad_s) {
        plant_init(&plant, setup.machine, setup.rotor_deg * fixed_point::PI / 180.0);
        plant_set_gains(&plant, &setup.plant);
        sensors_init(&sensors, &setup.machine->sensors, setup.encoder_bits, setup.adc_bits, 1);
        sensors.encoder_edges = setup.edges;
        restart_trace();
    }

    // Copies state and continues independently; the trace starts empty.
    Bench(const Bench &other)
        : plant(other.plant), sensors(other.sensors), drive(other.drive), reference_rpm(other.reference_rpm),
          running(other.running), rate_hz(other.rate_hz), speed_unit_rad_s(other.speed_unit_rad_s),
          buffered(other.buffered) {
        restart_trace();
    }
    Bench &operator=(const Bench &) = delete;

    void run_until(double time_s) {
        const uint64_t period_ns = 1000000000u / rate_hz;
        const auto ticks = uint16_t(fixed_point::TIMER_CLOCK_HZ / (2u * rate_hz));
        const auto to_ns = uint64_t(std::llround(time_s * 1e9));
        while (plant.time_ns + period_ns <= to_ns) {
            plant_advance(&plant, plant.time_ns + period_ns);
            whole_sample_t sample{};
            sensors_sample_encoder(&sensors, &plant, &sample.encoder);
            sensors_sample_adc(&sensors, &plant, &sample.adc);
            sample.time_us = uint32_t(plant.time_ns / 1000);
            const command_t command = {
                .request = plant.time_ns > 1100000 ? COMMAND_RUN : COMMAND_OFF, // after the initialisation
                .speed_reference_q22 =
                    fixed_point::to_fixed(fixed_point::rad_s(reference_rpm) / speed_unit_rad_s, fixed_point::Q22),
                .time_us = sample.time_us,
            };
            plant_set_switches(&plant, &buffered, ticks);
            running = drive.step(sample, command, &buffered);
            if (!running) {
                buffered = hal_pwm_compare_t{};
                plant_open_all(&plant);
            }
        }
    }

    // Discards the trace and records from now on.
    void restart_trace() {
        trace = trace_t{};
        trace.first_us = (plant.time_ns + 999) / 1000;
        plant_observe(&plant, trace.first_us * 1000, 1000, observe, &trace);
    }

    double now_s() const { return double(plant.time_ns) * 1e-9; }

    plant_t plant;
    sensors_t sensors;
    drive_t drive;
    double reference_rpm = 0.0;
    bool running = false;
    trace_t trace;

  private:
    uint32_t rate_hz;
    double speed_unit_rad_s;
    hal_pwm_compare_t buffered{};

    static void observe(void *context, const plant_t *plant) {
        auto *trace = static_cast<trace_t *>(context);
        trace->torque_Nm.push_back(plant_torque_Nm(plant));
        trace->speed_rad_s.push_back(plant->speed_rad_s);
    }
};

} // namespace closed_loop

#endif
