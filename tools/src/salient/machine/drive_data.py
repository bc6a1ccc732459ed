"""The drive's data of a machine: from the table [drive] of its file, and derived by one rule for all machines.

`derive` fills in what the file leaves out. Every formula is written once, here, and displayed by `salient machine`.
The reasons and the meaning of the keys are in docs/machines/data.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from salient.config import DEFAULTS
from salient.machine.definition import Machine
from salient.machine.least_current import WINDOW_SHARE, least_current_deg
from salient.machine.parameter_table import SAME_UNITS, ParameterDefinition, read_table
from salient.machine.torque_speed import (
    current_of_torque_A,
    knee_A,
    smooth_torque_Nm,
    torque_per_flux_Nm_Wb,
)

FILE, DERIVED, OVERRIDDEN, DEFAULT = "file", "derived", "overridden", "default"
"""Sources of a value: the table [drive] or another table of the machine file, a formula, [drive.parameters], the row of
firmware/storage/parameters.def."""

SAMPLES_PER_TURN_MIN = 25
"""Control periods of an electrical revolution at speed_max_rpm."""

PEAK_OF_KNEE = 3.0
PEAK_OF_MAP = 0.65
"""Part of a flux-linkage map's largest current: search and over-current need the rest."""
KNEELESS_SPEED_RPM = 1500.0
SMOOTH_SHARE = 0.8
"""Part of the torque of the tables that is left when currents rise and fall with finite voltage."""
PEAK_OF_RATED = 1.2
TORQUE_MIN_NM = 1e-4
"""Torque of magnetics that make none: they have data, too, which contradictions.py compares."""
CURRENT_RANGE_A = 80.0
"""Largest current of the firmware's tables, in the machine's unit of current, a power of two."""
_CURRENT_SEARCHED_A = 10_000.0
_MORE_CURRENT = 0.01
"""Increase of the square of the current, relatively, for which a window is wider."""
_RPM = 30.0 / math.pi


@dataclass(frozen=True)
class Derivation:
    """One value, for display."""

    name: str
    value: float
    unit: str
    formula: str
    source: str
    """FILE, DERIVED, OVERRIDDEN or DEFAULT."""


@dataclass(frozen=True)
class DriveData:
    """SI units, r/min where the name has it."""

    supply_min_V: float
    supply_max_V: float
    current_rated_A: float
    current_peak_A: float
    torque_rated_Nm: float
    torque_peak_Nm: float
    speed_base_rpm: float
    speed_max_rpm: float
    thermal_time_constant_s: float
    control_rate_hz: int
    encoder_bits: int
    encoder_edges: bool
    adc_bits: int
    adc_current_A: float
    """Full scale of the current sensors."""
    adc_voltage_V: float
    """Full scale of the DC link's divider."""
    torque_step_Nm: float
    """Torque of a phase that the highest voltage changes within a control period."""
    parameters: dict[str, float]
    """Default of every parameter of firmware/storage/parameters.def by name."""
    derivations: tuple[Derivation, ...] = field(repr=False)

    @property
    def current_trip_A(self) -> float:
        return self.parameters["current_trip_A"]

    @property
    def comparator_trip_A(self) -> float:
        """Threshold of the comparators in the gate drivers: above every current that the sampled trip lets pass on a
        healthy machine."""
        return 1.1 * self.current_trip_A

    @property
    def over_speed_rpm(self) -> float:
        return self.parameters["over_speed_rpm"]

    @property
    def over_voltage_V(self) -> float:
        return self.parameters["over_voltage_V"]

    @property
    def under_voltage_V(self) -> float:
        return self.parameters["under_voltage_V"]


def derive(machine: Machine) -> DriveData:
    """The data of a machine."""
    derived = _Values(machine.drive)
    _derive_ratings(machine, derived)
    parameters = _Values(machine.drive_parameters, OVERRIDDEN)
    _derive_parameters(machine, derived.values, parameters)
    return DriveData(**derived.values, parameters={row.name: parameters.values[row.name] for row in read_table()},
                     derivations=(*derived.derivations, *parameters.derivations))


class _Values:
    """Values in order: those given, and what `add` derives otherwise."""

    def __init__(self, given: dict[str, Any], kind: str = FILE) -> None:
        self.given, self.kind = given, kind
        self.values: dict[str, Any] = {}
        self.derivations: list[Derivation] = []

    def add(self, name: str, unit: str, value: Any, formula: str, source: str = DERIVED) -> Any:
        if name in self.given:
            value, source = self.given[name], self.kind
        self.values[name] = value
        self.derivations.append(Derivation(name, value, unit, formula, source))
        return value


def sampled_speed_rpm(control_rate_hz: float, machine: Machine) -> float:
    """The speed with SAMPLES_PER_TURN_MIN control periods in an electrical revolution."""
    return 60.0 * control_rate_hz / (SAMPLES_PER_TURN_MIN * machine.rotor_poles)


def _derive_ratings(machine: Machine, data: _Values) -> None:
    magnetics, phases, supply_V = machine.magnetics, machine.phases, machine.supply_voltage_V
    minimum_V = data.add("supply_min_V", "V", min(supply_V, data.given.get("supply_max_V", supply_V)),
                         "converter.supply_voltage_V")
    maximum_V = data.add("supply_max_V", "V", max(supply_V, minimum_V), "converter.supply_voltage_V")
    rate_hz = data.add("control_rate_hz", "Hz", DEFAULTS["control_rate_hz"], "the board's", DEFAULT)
    data.add("encoder_bits", "", DEFAULTS["encoder_bits"], "the board's; 0 ideal", DEFAULT)
    data.add("encoder_edges", "", DEFAULTS["encoder_edges"], "the board's", DEFAULT)
    data.add("adc_bits", "", DEFAULTS["adc_bits"], "the board's", DEFAULT)

    peak_A = data.add("current_peak_A", "A", *_peak_current(machine, data.given))
    peak_Nm = data.add("torque_peak_Nm", "N m",
                       max(SMOOTH_SHARE * smooth_torque_Nm(magnetics, phases, peak_A),
                           data.given.get("torque_rated_Nm", TORQUE_MIN_NM)),
                       f"{SMOOTH_SHARE:g} * least torque over a stroke of all phases at current_peak_A")
    if "current_rated_A" in data.given:
        rated_Nm = SMOOTH_SHARE * smooth_torque_Nm(magnetics, phases, data.given["current_rated_A"])
        formula = "as torque_peak_Nm, at current_rated_A"
    else:
        rated_Nm, formula = peak_Nm / PEAK_OF_RATED, f"torque_peak_Nm / {PEAK_OF_RATED:g}"
    rated_Nm = data.add("torque_rated_Nm", "N m", max(min(rated_Nm, peak_Nm), TORQUE_MIN_NM), formula)
    rated_A = data.add("current_rated_A", "A",
                       current_of_torque_A(magnetics, phases, rated_Nm / SMOOTH_SHARE, peak_A),
                       "current whose smooth torque, as for torque_peak_Nm, is torque_rated_Nm")

    sampled_rpm = sampled_speed_rpm(rate_hz, machine)
    data.add("speed_base_rpm", "r/min",
             min(_base_speed_rpm(machine, minimum_V, rated_A), sampled_rpm,
                 data.given.get("speed_max_rpm", math.inf)),
             "full voltage builds up the aligned flux linkage of current_rated_A within the overlap of two phases, "
             "half a pole pitch less a stroke: (supply_min_V - R I) * angle / psi; at most speed_max_rpm")
    data.add("speed_max_rpm", "r/min", min(2.0 * data.values["speed_base_rpm"], sampled_rpm),
             f"2 * speed_base_rpm, with at least {SAMPLES_PER_TURN_MIN} control periods in an electrical revolution")
    data.add("thermal_time_constant_s", "s", 60.0, "a winding without forced cooling", DEFAULT)

    rise_A = maximum_V / magnetics.unaligned_inductance_H / rate_hz
    data.add("adc_current_A", "A", _current_range_A(machine, peak_A, rise_A),
             "16/15 max(1.5 current_peak_A, 1.1 current_peak_A + 2.2 V Ts / Lu), or 80 A times a power of two below it "
             "that has room for 80/79 (1.01 current_peak_A + 2.4 V Ts / Lu) and 10/9 current_peak_A")
    over_V, _ = _over_voltage(machine, maximum_V)
    data.add("adc_voltage_V", "V", 1.25 * over_V, "1.25 over_voltage_V")
    data.add("torque_step_Nm", "N m",
             maximum_V / rate_hz * torque_per_flux_Nm_Wb(magnetics, 0.5 * peak_A),
             "supply_max_V Ts dT/dpsi at half of current_peak_A")


def _peak_current(machine: Machine, given: dict[str, Any]) -> tuple[float, str]:
    """current_peak_A and its formula."""
    magnetics, phases = machine.magnetics, machine.phases
    if "torque_peak_Nm" in given or "torque_rated_Nm" in given:
        peak_Nm = given.get("torque_peak_Nm", PEAK_OF_RATED * given.get("torque_rated_Nm", 0.0))
        current_A = current_of_torque_A(magnetics, phases, peak_Nm / SMOOTH_SHARE, _CURRENT_SEARCHED_A)
        return current_A, "current whose smooth torque is torque_peak_Nm"
    if "current_rated_A" in given:
        return PEAK_OF_RATED * given["current_rated_A"], f"{PEAK_OF_RATED:g} current_rated_A"
    if math.isfinite(magnetics.current_max_A):
        knee = knee_A(magnetics, magnetics.current_max_A)
        return (min(PEAK_OF_KNEE * knee, PEAK_OF_MAP * magnetics.current_max_A),
                f"{PEAK_OF_KNEE:g} * knee of the aligned flux linkage, {PEAK_OF_MAP:g} * largest current of the map")
    knee = knee_A(magnetics, _CURRENT_SEARCHED_A)
    if knee < _CURRENT_SEARCHED_A:
        return PEAK_OF_KNEE * knee, f"{PEAK_OF_KNEE:g} * knee of the aligned flux linkage"
    aligned_H = float(magnetics.flux_linkage_Wb(0.0, 1.0))
    flux_Wb = machine.supply_voltage_V * 60.0 / (2.0 * machine.rotor_poles * KNEELESS_SPEED_RPM)
    return flux_Wb / aligned_H, ("without saturation: the supply builds up the aligned flux linkage in half an "
                                 f"electrical revolution at {KNEELESS_SPEED_RPM:g} r/min")


def _current_range_A(machine: Machine, peak_A: float, rise_A: float) -> float:
    """Full scale of the current sensors. The tables' columns are as far apart for one of 41 A as for one of 80 A: less
    headroom halves their distance, and the errors of interpolation between them become a quarter."""
    wanted_A = max(1.5 * peak_A, 1.1 * peak_A + 2.2 * rise_A) / 0.9375
    below_A = math.ldexp(CURRENT_RANGE_A, math.floor(math.log2(wanted_A / CURRENT_RANGE_A)))
    given = machine.drive_parameters
    trip_A = given.get("current_trip_A", _least_trip_A(max(peak_A, given.get("current_limit_A", 0.0)), rise_A))
    return below_A if max(trip_A / 0.9875, peak_A / 0.9) <= below_A else wanted_A


def _least_trip_A(limit_A: float, rise_A: float) -> float:
    """Value that no current of a healthy machine reaches: hysteresis, which sees a current a period late and acts a
    period later, exceeds its limit by up to 2.4 periods of rise, measured on machines of all sizes; the hundredth is
    the sensors' error."""
    return 1.01 * limit_A + 2.4 * rise_A


def _base_speed_rpm(machine: Machine, voltage_V: float, current_A: float) -> float:
    overlap_rad = machine.pitch_rad * (0.5 - 1.0 / machine.phases)
    # A winding that takes nearly the whole voltage leaves a tenth of it.
    left_V = max(voltage_V - machine.resistance_ohm * current_A, 0.1 * voltage_V)
    flux_Wb = float(machine.magnetics.flux_linkage_Wb(0.0, current_A))
    return left_V * overlap_rad / flux_Wb * _RPM


def _over_voltage(machine: Machine, supply_max_V: float) -> tuple[float, str]:
    chopper_on_V = (machine.dc_link or {}).get("chopper_on_V", 0.0)
    return max(1.25 * supply_max_V, 1.03 * chopper_on_V), "1.25 supply_max_V, at least 1.03 dc_link.chopper_on_V"


# --- parameters -----------------------------------------------------------------------------------------------------

def _derive_parameters(machine: Machine, data: dict[str, Any], parameters: _Values) -> None:
    """Every parameter of the drive, those without a formula with the default of their row."""
    formulae = _parameter_formulae(machine, data)
    for row in read_table():
        default = row.default / (1 << row.fraction_bits)
        value, formula = formulae.get(row.name, (None, ""))
        if value is None:
            parameters.add(row.name, row.unit, default, "the same for every machine", DEFAULT)
        else:
            source = FILE if row.name in ("inertia_kg_m2", "friction_Nm_s", "resistance_ohm") else DERIVED
            parameters.add(row.name, row.unit, _within(row, value), formula, source)


def _within(row: ParameterDefinition, value: float) -> float:
    """A derived value within the range of its parameter, if that is the same for every machine."""
    low, high = row.limits
    return min(max(value, low), high) if row.unit in SAME_UNITS else value


def _torque_max(machine: Machine, data: dict[str, Any]) -> tuple[float, str]:
    """torque_max_Nm and its formula."""
    peak_Nm = data["torque_peak_Nm"]
    # A DC link has room for the fields of torque_peak_Nm (fold_back.py).
    if machine.dc_link is not None or "torque_peak_Nm" in machine.drive or "torque_rated_Nm" in machine.drive:
        return peak_Nm, "torque_peak_Nm"
    limit_A = machine.drive_parameters.get("current_limit_A", data["current_peak_A"])
    window_Nm = WINDOW_SHARE * smooth_torque_Nm(machine.magnetics, machine.phases, limit_A)
    return max(peak_Nm, window_Nm), (
        f"{WINDOW_SHARE:g} * least torque over a stroke of all phases at current_limit_A, at least torque_peak_Nm; "
        "torque_peak_Nm where the file states torques or has a DC link")


def _commutation_deg(machine: Machine, data: dict[str, Any]) -> tuple[float, float]:
    """Turn-on and turn-off of the window of torque sharing for the rated torque, of which the latter stays the same:
    the outgoing phase is switched off as a whole. 180 unaligned, 360 aligned."""
    on_deg, off_deg = least_current_deg(machine.magnetics, machine.phases, data["torque_rated_Nm"],
                                        data["current_peak_A"], _MORE_CURRENT)
    flux_Wb = machine.magnetics.unaligned_inductance_H * data["current_rated_A"]
    built_deg = math.degrees(0.5 * data["speed_base_rpm"] / _RPM * machine.rotor_poles
                             * flux_Wb / machine.supply_voltage_V)
    return max(180.0 + float(on_deg) - built_deg, 180.0), 180.0 + float(off_deg)


def _parameter_formulae(machine: Machine, data: dict[str, Any]) -> dict[str, tuple[float, str]]:
    peak_A, peak_Nm, rated_Nm = data["current_peak_A"], data["torque_peak_Nm"], data["torque_rated_Nm"]
    period_s, inertia = 1.0 / data["control_rate_hz"], machine.inertia_kg_m2
    rise_A = data["supply_max_V"] / machine.magnetics.unaligned_inductance_H * period_s
    adc_A, step_Nm = data["adc_current_A"], data["torque_step_Nm"]
    trip_A = min(max(0.9375 * adc_A, min(_least_trip_A(peak_A, rise_A), 0.9875 * adc_A)),
                 max(1.5 * peak_A, 1.1 * peak_A + 2.2 * rise_A))
    # The gains of the BP-PID are those at 40 kHz.
    step_40_kHz_Nm = step_Nm / period_s / 40_000.0
    base_rad_s = data["speed_base_rpm"] / _RPM
    over_V, over_V_formula = _over_voltage(machine, data["supply_max_V"])
    largest_Nm, largest_text = _torque_max(machine, data)
    stroke_deg = 360.0 / machine.phases
    on_deg, off_deg = _commutation_deg(machine, data)
    acceleration = largest_Nm / inertia
    torque_removed_s = (largest_Nm / step_Nm + 3.0) * period_s
    kp = min(1000.0 * inertia, peak_Nm / (0.015 * base_rad_s))
    gain = min(8.0 / rated_Nm, 0.6 / step_40_kHz_Nm)
    gain_text = "min(8 / torque_rated_Nm, 0.6 / torque_step_Nm at 40 kHz)"
    return {
        "torque_max_Nm": (largest_Nm, largest_text),
        "current_limit_A": (peak_A, "current_peak_A"),
        "current_trip_A": (trip_A,
                           "max(1.5 current_peak_A, 1.1 current_peak_A + 2.2 V Ts / Lu), at most 15/16 of "
                           "adc_current_A, or up to 79/80 of it for at least 1.01 current_peak_A + 2.4 V Ts / Lu"),
        "over_voltage_V": (over_V, over_V_formula),
        "under_voltage_V": (0.625 * data["supply_min_V"], "0.625 supply_min_V"),
        "over_speed_rpm": (1.2 * data["speed_max_rpm"], "1.2 speed_max_rpm"),
        "turn_on_angle_deg": (on_deg, "180 + on less the angle in which V builds up Lu current_rated_A at half of "
                              "speed_base_rpm, at least 180"),
        "turn_off_angle_deg": (on_deg + stroke_deg, "turn_on_angle_deg + stroke"),
        "outgoing_off_angle_deg": (max(off_deg, on_deg + stroke_deg), "180 + off"),
        "hand_over_angle_deg": (max(off_deg - stroke_deg, on_deg), "outgoing_off_angle_deg - stroke"),
        "torque_band_inner_Nm": (max(rated_Nm / 160.0, step_Nm / 40.0),
                                 "max(torque_rated_Nm / 160, torque_step_Nm / 40)"),
        "torque_band_outer_Nm": (max(rated_Nm / 16.0, step_Nm / 4.0),
                                 "max(torque_rated_Nm / 16, torque_step_Nm / 4)"),
        "speed_kp": (kp, "min(1000/s * inertia, torque_peak_Nm / 1.5 % of speed_base_rpm)"),
        "speed_ki": (50.0 * kp, "50/s * speed_kp"),
        "smc_k": (min(max(0.0275 / period_s, 40.0 * acceleration / base_rad_s), 0.12 / period_s),
                  "max(0.0275 / Ts, 40 torque_max_Nm / (inertia * speed_base_rpm)), at most 0.12 / Ts"),
        "smc_delta": (min(max(1.0, 0.1 * acceleration / base_rad_s), 8.0 / (acceleration * torque_removed_s)),
                      "max(1, 0.1 s a / speed_base_rpm), at most 8 / (a (torque_max_Nm / torque_step_Nm + 3) Ts)"),
        "observer_bandwidth_rad_s": (min(0.025 / period_s, 8000.0), "0.025 / Ts"),
        "observer_transient_rad_s": (min(0.225 / period_s, 10_000.0), "0.225 / Ts, at most 10000"),
        "observer_moving_rad_s": (min(0.045 / period_s, 10_000.0), "0.045 / Ts, at most 10000"),
        "bp_error_scale_Nm": (max(rated_Nm / 8.0, 3.0 * step_40_kHz_Nm),
                              "max(torque_rated_Nm / 8, 3 torque_step_Nm at 40 kHz)"),
        "bp_assist_band_Nm": (rated_Nm / 8.0, "torque_rated_Nm / 8"),
        "bp_kp_max": (gain, gain_text),
        "bp_ki_max": (0.24 * gain, "0.24 bp_kp_max"),
        "bp_kd_max": (0.4 * gain, "0.4 bp_kp_max"),
        "inertia_kg_m2": (inertia, "mechanics.inertia_kg_m2"),
        "friction_Nm_s": (machine.friction_Nm_s, "mechanics.friction_Nm_s"),
        "resistance_ohm": (machine.resistance_ohm, "winding.resistance_ohm"),
        "winding_current_A": (0.8 * data["current_rated_A"],
                              "0.8 current_rated_A: a turning machine has each phase on for about half of the time"),
        "winding_time_constant_s": (round(data["thermal_time_constant_s"]), "thermal_time_constant_s"),
        "switch_current_A": (peak_A / math.sqrt(1.5), "current_peak_A / sqrt(1.5)"),
    }
