"""Do the stated intervals of an identification hold the truth? python -m salient.experiments.identified_intervals

Samples of pulses of a motor that is known in closed form, with noise, quantisation and errors of the sensors, go into
the fit of the identification, without a drive. Prints, by quantity over seeds, how many of the intervals of 95 % hold
the truth, of a seed at least and at most, and root mean squares of the errors and of the stated deviations.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from salient.errors import exit_code
from salient.identify import fit as electrical
from salient.identify.link import CHARGES, OFF, ON, RECORD, ZERO
from salient.identify.result import INTERVAL, SAMPLES, deviation_of, map_deviation
from salient.identify.sequence import Findings, Pulse

LIMIT_A, SUPPLY_V, PERIOD_S = 50.0, 240.0, 25e-6
ANGLES, CURRENTS = 48, 16
"""Steps of the spline: half of the angles of a drive's, so that many seeds take minutes."""
_RECORD_PART, _RECORD_PERIODS = 1.0 / 32.0, 16
"""As the drive's records: after that part of the limit, or so many periods."""
_FREEWHEEL_S = 0.008
_LSB_A, _COUNTS, _NONE_A = 80.0 / 4096.0, 1 << 17, 1e-3


@dataclass(frozen=True)
class Motor:
    """psi = Lu i + (La - Lu) g(theta) Is tanh(i / Is), g from 1 (aligned) to 0: a cosine, or with corners a trapezoid.
    delta_rad: of the aligned angles from the rough ones."""

    corners: bool = False
    rotor_poles: int = 4
    unaligned_H: float = 2e-3
    aligned_H: float = 10e-3
    saturation_A: float = 25.0
    resistance_ohm: float = 0.3
    drop_V: float = 0.8
    delta_rad: tuple[float, ...] = (0.004, -0.003, 0.001)
    eccentricity_rad: tuple[float, float] = (6e-4, -4e-4)
    delay_s: float = 2e-6
    offset_A: tuple[float, ...] = (0.02, -0.03, 0.01)
    """Current of the motor when its sensor reads none."""
    rises: tuple[float, float] = field(default=(0.15, 0.75))
    """Ends of the trapezoid's slope, of half an electrical period."""

    def overlap(self, angle_rad: np.ndarray, derivative: int = 0) -> np.ndarray:
        """g, or its derivative by the angle."""
        electrical_rad = self.rotor_poles * np.asarray(angle_rad, float)
        if not self.corners:
            if derivative:
                return np.asarray(-self.rotor_poles * np.sin(electrical_rad) / 2.0)
            return np.asarray((1.0 + np.cos(electrical_rad)) / 2.0)
        folded = np.abs(np.mod(electrical_rad + math.pi, 2.0 * math.pi) - math.pi) / math.pi
        begin, end = self.rises
        if derivative:
            sign = np.where(np.mod(electrical_rad, 2.0 * math.pi) < math.pi, -1.0, 1.0)
            inside = (folded > begin) & (folded < end)
            return np.asarray(sign * inside * self.rotor_poles / math.pi / (end - begin))
        return np.clip((end - folded) / (end - begin), 0.0, 1.0)

    def flux_Wb(self, angle_rad: np.ndarray, current_A: np.ndarray) -> np.ndarray:
        """Flux linkage at an angle from aligned."""
        saturates = self.saturation_A * np.tanh(np.asarray(current_A) / self.saturation_A)
        return np.asarray(self.unaligned_H * current_A
                          + (self.aligned_H - self.unaligned_H) * self.overlap(angle_rad) * saturates)

    def torque_Nm(self, angle_rad: np.ndarray, current_A: np.ndarray) -> np.ndarray:
        """Derivative of the co-energy by the angle."""
        coenergy = self.saturation_A**2 * np.log(np.cosh(np.asarray(current_A) / self.saturation_A))
        return np.asarray((self.aligned_H - self.unaligned_H) * self.overlap(angle_rad, 1) * coenergy)

    def current_A(self, angle_rad: np.ndarray, flux_Wb: np.ndarray, near_A: np.ndarray) -> np.ndarray:
        """Inverse of flux_Wb, by Newton's method."""
        current = near_A
        rise = (self.aligned_H - self.unaligned_H) * self.overlap(angle_rad)
        for _ in range(3):
            slope = self.unaligned_H + rise / np.cosh(current / self.saturation_A) ** 2
            current = np.maximum(current - (self.flux_Wb(angle_rad, current) - flux_Wb) / slope, 0.0)
        return current


def pulses_of(motor: Motor, seed: int, count: int = 216, noise_lsb: float = 2.0) -> tuple[Findings, list[Pulse]]:
    """Pulses as a drive's: half of the phases' windows from either side, nine of them with freewheeling."""
    random = np.random.default_rng(seed)
    phases = len(motor.delta_rad)
    found = Findings(list(range(phases)), motor.rotor_poles, np.zeros(phases), np.full(phases, noise_lsb * _LSB_A))
    number = np.arange(count)
    phase = number % phases
    for row in range(phases):
        found.position[row] = random.uniform(0.0, 1.0)
        found.order[row] = row
    position = np.array([found.position[row] for row in range(phases)])[phase]
    windows = count // phases
    place = (number // phases + random.uniform(0.0, 1.0, count)) / windows
    shaft = 2.0 * math.pi * (position + place / motor.rotor_poles) + np.array(motor.delta_rad)[phase]
    speed = random.choice([-1.0, 1.0], count) * random.uniform(3.0, 8.0, count)
    freewheels = number < 3 * phases
    level = np.where(freewheels, np.array([0.25, 0.5, 1.0])[number // phases % 3], 1.0) * 0.98 * LIMIT_A
    logs = _simulated(motor, random, phase, shaft, speed, level, freewheels, position, noise_lsb)
    found.pulses = [Pulse(int(row), log, not free) for row, log, free in zip(phase, logs, freewheels, strict=True)]
    return found, found.pulses


def _simulated(motor: Motor, random: np.random.Generator, phase: np.ndarray, shaft: np.ndarray,  # noqa: PLR0913, PLR0917
               speed: np.ndarray, level: np.ndarray, freewheels: np.ndarray, position: np.ndarray, noise_lsb: float
               ) -> list[np.ndarray]:
    """Records of pulses that run side by side, each as if it were alone."""
    count = len(phase)
    flux, current, sensed = np.zeros(count), np.zeros(count), np.zeros(count)
    action, free_left = np.full(count, ON), np.where(freewheels, round(_FREEWHEEL_S / PERIOD_S), 0)
    aligned = 2.0 * math.pi * position + np.array(motor.delta_rad)[phase]
    ended, samples = np.zeros(count, int), []
    sub = 2
    step_s = PERIOD_S / sub
    samples.append((current, shaft, np.full(count, OFF)))
    for _ in range(4000):
        samples.append((sensed, shaft, np.where(ended > 0, OFF, action)))
        if (ended > 2).all():
            break
        for _ in range(sub):
            voltage = np.select([action == ON, action == ZERO], [SUPPLY_V, 0.0], -SUPPLY_V)
            middle = current
            for _ in range(2):  # the mean of the currents at both ends
                rate = voltage - motor.resistance_ohm * middle - 2.0 * motor.drop_V
                new_flux = np.maximum(flux + rate * step_s, 0.0)
                new_current = motor.current_A(shaft + speed * step_s - aligned, new_flux, current)
                middle = (current + new_current) / 2.0
            slope = (new_current - current) / step_s
            flux, current, shaft = new_flux, new_current, shaft + speed * step_s
        sensed = current - motor.delay_s * slope
        ends = (action == ON) & (current > level - slope * PERIOD_S)
        action = np.where(ends, np.where(freewheels, ZERO, OFF), action)
        free_left = np.where(action == ZERO, free_left - 1, free_left)
        action = np.where((action == ZERO) & (free_left <= 0), OFF, action)
        ended += (action == OFF) & (current < _NONE_A)
    currents, shafts, actions = (np.array(column) for column in zip(*samples, strict=True))
    return [_record(motor, random, int(row), currents[:, k], shafts[:, k], actions[:, k], noise_lsb)
            for k, row in enumerate(phase)]


def _record(motor: Motor, random: np.random.Generator, row: int, current: np.ndarray, shaft: np.ndarray,
            action: np.ndarray, noise_lsb: float) -> np.ndarray:
    """The samples that the drive records, as its sensors have them."""
    measured = np.maximum(current - motor.offset_A[row] + random.normal(0.0, noise_lsb * _LSB_A, len(current)), 0.0)
    measured = np.round(measured / _LSB_A) * _LSB_A
    last = int(np.nonzero(action != OFF)[0][-1]) + 1
    end = min(last + int(np.argmax(current[last:] < _NONE_A)) + 1, len(current) - 1)
    kept = [0]
    for k in range(1, end + 1):
        if (action[k] != action[k - 1] or k - kept[-1] >= _RECORD_PERIODS
                or abs(measured[k] - measured[kept[-1]]) > _RECORD_PART * LIMIT_A):
            kept.append(k)
    log = np.zeros(len(kept), RECORD)
    log["time_us"] = 1000 + np.round(np.array(kept) * PERIOD_S * 1e6)
    log["current_A"], log["action"], log["state"], log["phase"] = measured[kept], action[kept], CHARGES, row
    log["dc_link_V"] = SUPPLY_V + np.round(random.normal(0.0, 1.0, len(kept))) * 0.125
    cosine, sine = motor.eccentricity_rad
    encoder = shaft[kept] + cosine * np.cos(shaft[kept]) + sine * np.sin(shaft[kept])
    log["turn"] = (np.floor(encoder / (2.0 * math.pi) * _COUNTS) + 0.5) / _COUNTS
    return log


def grid_of(motor: Motor) -> tuple[np.ndarray, np.ndarray]:
    """Angles and currents at which maps are compared."""
    return tuple(np.meshgrid(np.linspace(0.0, math.pi / motor.rotor_poles, 61),  # type: ignore[return-value]
                             np.linspace(0.04, 1.0, 25) * 0.95 * LIMIT_A, indexing="ij"))


def of_fit(motor: Motor, seed: int, samples: int = SAMPLES, angles: int = ANGLES, currents: int = CURRENTS
           ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Errors and deviations of the electrical quantities, by name."""
    found, pulses = pulses_of(motor, seed)
    rows = electrical.rows_of(found, pulses)
    phases = len(found.phases)
    fit = electrical.solve(rows, phases, motor.rotor_poles, LIMIT_A, angles, currents)
    others = electrical.resampled(rows, phases, fit, samples, seed)
    rough = electrical.rougher(rows, phases, fit)
    angle, current = grid_of(motor)
    flux, torque = fit.flux_Wb(angle, current), fit.torque_Nm(angle, current)
    values: Mapping[str, tuple[Any, Any, Any]] = {
        "resistance": (fit.resistance_ohm, motor.resistance_ohm, [each.resistance_ohm for each in others]),
        "drop": (fit.drop_V, motor.drop_V, [each.drop_V for each in others]),
        "conductance": (fit.conductance_S, 0.0, [each.conductance_S for each in others]),
        "delay": (fit.delay_s, motor.delay_s, [each.delay_s for each in others]),
        "offset": (fit.offset_A, motor.offset_A, [each.offset_A for each in others]),
        "aligned angle": (fit.delta_rad, motor.delta_rad, [each.delta_rad for each in others]),
        "eccentricity": (fit.eccentricity_rad, motor.eccentricity_rad, [each.eccentricity_rad for each in others]),
    }
    result = {name: (np.atleast_1d(np.subtract(value, true)), np.atleast_1d(deviation_of(drawn)))
              for name, (value, true, drawn) in values.items()}
    result["flux linkage"] = (flux - motor.flux_Wb(angle, current), map_deviation(
        [each.flux_Wb(angle, current) for each in others], flux, rough.flux_Wb(angle, current)))
    result["torque"] = (torque - motor.torque_Nm(angle, current), map_deviation(
        [each.torque_Nm(angle, current) for each in others], torque, rough.torque_Nm(angle, current)))
    return result


def main() -> int:
    """Prints a line for each quantity of a smooth motor and of one with corners."""
    parser = argparse.ArgumentParser(prog="python -m salient.experiments.identified_intervals", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=16)
    options = parser.parse_args()
    for corners in (False, True):
        results = [of_fit(Motor(corners=corners), seed) for seed in range(1, options.seeds + 1)]
        for name in results[0]:
            errors, deviations = (np.array([result[name][k] for result in results]) for k in (0, 1))
            held = (np.abs(errors) < INTERVAL * deviations).reshape(len(results), -1).mean(axis=1)
            print(f"{'corners' if corners else 'smooth':8} {name:14} held {held.mean():.3f} ({held.min():.2f} to "
                  f"{held.max():.2f}), error {np.sqrt(np.mean(errors**2)):.3g}, deviation "
                  f"{np.sqrt(np.mean(deviations**2)):.3g}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
