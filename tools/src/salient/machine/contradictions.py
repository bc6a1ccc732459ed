"""Contradictions of a machine file: one table of rules, each with the two keys that cannot both be right.

A rule bounds one value by what another one leaves it. The line of a refusal names both keys, with values and units, and
says why. Where three quantities are bound by one law, as voltage, resistance and current, the reason names the third.
Rules are in the order of the derivation, so that the first one that is broken is nearest to the cause.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from salient.machine.drive_data import SAMPLES_PER_TURN_MIN, sampled_speed_rpm
from salient.machine.facts import MAP_FILE, Facts, unit_of
from salient.machine.fold_back import field_J
from salient.machine.magnetics import Formula
from salient.machine.torque_speed import mean_torque_Nm, smooth_torque_Nm, torque_bound_Nm

FALL_MAX = 0.01
"""By which the torque may fall as the current rises, of the largest torque; tables with more are refused."""
INDUCTANCE_RATIO_MAX = 150.0
"""Aligned to unaligned. Leakage keeps built machines between 3 and 40; a unit is wrong by 1000."""
PEAK_CURRENT_A = (0.2, 5000.0)
"""Range for a machine whose peak current follows from its saturation."""
DROP_MAX = 0.9
"""Part of the supply in winding and devices: the base speed is derived with a tenth left."""
RISE_MAX = 2.0
"""Rise of the current in a control period by the full voltage, in peak currents."""
GAIN_MAX = 0.25
"""Speed gained in a control period with the peak torque, in base speeds."""
EDDY_TIME_CONSTANT_S = (1e-7, 1e-4)
"""Time in which the flux of an open, unaligned phase decays. Laminations of 0.2 to 0.65 mm have 0.5 to 20 us; what is
far below a switching edge has no effect."""
BASE_SPEED_MIN_RPM = 10.0
"""The least over_speed_rpm (firmware/storage/parameters.def)."""
CURRENT_RANGE_MAX, VOLTAGE_RANGE_MAX = 32.0, 16.0
"""Full scales of the sensors, in peak currents and largest supplies: the ranges of limit and trip begin there."""
NOISE_MAX = 0.03
"""Standard deviation of a current, in current limits: 0.02 are no fault, with 0.06 a healthy phase is a phase_open."""
FLUX_DENSITY_T = (0.05, 3.0)
"""Range for saturated poles; steel saturates at 1.5 to 2.4 T, ferrite at 0.4."""
TIME_CONSTANT_MAX = 2.0
"""The drive's time constant of the winding, in time constants of the winding's heat path."""
AMBIENT_C, LIMITED_BELOW_K = 25.0, 20.0
"""As AMBIENT_C of emulator/rig/heat.c; the torque is limited from LIMITED_BELOW_K below a limit of temperature on."""
FIELDS_MAX = 30.0
"""Field of a phase at the current limit, aligned, in what the capacitor takes between supply and over-voltage."""
_RAD_S = math.pi / 30.0

Value = Callable[[Facts], float]
Name = str | Callable[[Facts], str]


@dataclass(frozen=True)
class Rule:
    """The value of `key` is at most a bound that the value of `other` sets, or with `least` at least."""

    key: Name
    bound: Value
    """In the unit of the key; not finite: none."""
    reason: str
    """Between the bound and the other key; {name} is replaced by name, value and unit, with / for each point."""
    other: Name
    least: bool = False
    strict: bool = False
    """The bound itself is refused."""
    when: Callable[[Facts], bool] = lambda of: True

    def names(self, of: Facts) -> tuple[str, str]:
        """Names of the two values; a key or a name of the drive's data."""
        key, other = (name if isinstance(name, str) else name(of) for name in (self.key, self.other))
        return key, other

    def mistake(self, of: Facts) -> str | None:
        """The line of a refusal; None where the two agree or the file does not have them."""
        key, other = self.names(of)
        if key not in of or other not in of or not self.when(of):
            return None
        bound, value = self.bound(of), of[key]
        excess = bound - value if self.least else value - bound
        margin = 1e-9 * max(abs(bound), abs(value)) * (-1.0 if self.strict else 1.0)
        if not math.isfinite(bound) or excess <= margin:
            return None
        must = {(False, False): "not be above", (False, True): "be below",
                (True, False): "not be below", (True, True): "be above"}[self.least, self.strict]
        reason = self.reason.format_map(_Shown(of))
        return f"{of.shown(key, ': ')}: must {must} {bound:.4g}{unit_of(key)}, {reason} {of.shown(other)}"


class _Shown(dict[str, str]):
    """Name, value and unit, by name."""

    def __init__(self, of: Facts) -> None:
        super().__init__()
        self._of = of

    def __missing__(self, name: str) -> str:
        return self._of.shown(name.replace("/", "."))


def contradiction(of: Facts) -> str | None:
    """The line of the first rule that a machine breaks."""
    return next((text for rule in RULES if (text := rule.mistake(of)) is not None), None)


# --- quantities -----------------------------------------------------------------------------------------------------

def _times(factor: float, name: str) -> Value:
    return lambda of: factor * of[name]


def _stated(*names: str) -> Callable[[Facts], bool]:
    return lambda of: any(of.key(name) for name in names)


def _half_pitch_deg(of: Facts) -> float:
    return 180.0 / of.machine.rotor_poles


def _smooth_Nm(of: Facts) -> float:
    return smooth_torque_Nm(of.machine.magnetics, of.machine.phases, _any_current_A(of))


def _any_current_A(of: Facts) -> float:
    """A current that a phase may carry, before any is derived."""
    largest_A = of.machine.magnetics.current_max_A
    return largest_A if math.isfinite(largest_A) else 1.0


def _rising_H(of: Facts) -> float:
    """The unaligned inductance up to which the torque rises with the current up to the full scale of the sensors, but
    for FALL_MAX: above, the iron of the aligned position saturates more than the unaligned flux linkage takes to
    overtake it."""
    magnetics = of.machine.magnetics
    assert isinstance(magnetics, Formula)
    current_A = np.linspace(0.0, of["adc_current_A"], 200)

    def rises(inductance_H: float) -> bool:
        changed = replace(magnetics, parameters={**magnetics.parameters, "unaligned_inductance_H": inductance_H})
        torque_Nm = changed.torque_Nm(0.75 * magnetics.pitch_rad, current_A)
        return float(torque_Nm.max()) * (1.0 - FALL_MAX) <= float(torque_Nm[-1])

    low_H, high_H = magnetics.parameters["saturated_inductance_H"], magnetics.unaligned_inductance_H
    if rises(high_H):
        return math.inf
    for _ in range(20):
        middle_H = 0.5 * (low_H + high_H)
        low_H, high_H = (middle_H, high_H) if rises(middle_H) else (low_H, middle_H)
    return low_H


def _mean_Nm(name: str) -> Value:
    return lambda of: mean_torque_Nm(of.machine.magnetics, of.machine.phases, of[name])


def _drops_V(of: Facts) -> dict[str, float]:
    """Loss of the supply at the current for the rated torque, by the key that it is in proportion to."""
    current_A = of["current_rated_A"]
    return {"winding.resistance_ohm": of["winding.resistance_ohm"] * current_A,
            "converter.switch_drop_V": 2.0 * of["converter.switch_drop_V"],
            "converter.switch_resistance_ohm": 2.0 * of["converter.switch_resistance_ohm"] * current_A}


def _largest_drop(of: Facts) -> str:
    drops_V = _drops_V(of)
    return max(drops_V, key=lambda name: drops_V[name])


def _drop_bound(of: Facts) -> float:
    """Bound of the key of the largest drop; the others are as they are."""
    drops_V, key = _drops_V(of), _largest_drop(of)
    return of[key] * (1.0 - (sum(drops_V.values()) - DROP_MAX * of["supply_min_V"]) / drops_V[key])


def _rise_A(of: Facts) -> float:
    return of["supply_max_V"] / of.machine.magnetics.unaligned_inductance_H / of["control_rate_hz"]


def _speed_rpm(torque_Nm: Callable[[Facts, float], float]) -> Value:
    """The speed up to which the supply makes a torque, which may depend on the speed in rad/s: by bisection."""

    def speed_rpm(of: Facts) -> float:
        low, high = 0.0, 2e4
        for _ in range(30):
            middle = 0.5 * (low + high)
            made_Nm = torque_bound_Nm(of.machine.magnetics, of.machine.phases, of["current_peak_A"],
                                      of["supply_max_V"] / middle)
            low, high = (middle, high) if made_Nm >= torque_Nm(of, middle) else (low, middle)
        return low / _RAD_S

    return speed_rpm


def _base_rad_s(of: Facts) -> float:
    return of["speed_base_rpm"] * _RAD_S


def _source_ohm(of: Facts) -> float:
    """With it the rated power pulls the link down to the threshold of under-voltage."""
    sagged_V = of["under_voltage_V"]
    return (of["supply_min_V"] - sagged_V) * sagged_V / (of["torque_rated_Nm"] * _base_rad_s(of))


def _capacitance_F(of: Facts) -> float:
    """Its room from the supply to over-voltage takes a FIELDS_MAX-th of the field of a phase, aligned: most of a field
    becomes torque or heat before it returns."""
    room_V2 = of["over_voltage_V"] ** 2 - of["supply_max_V"] ** 2
    return 2.0 * field_J(of.machine, of["current_limit_A"]) / room_V2 / FIELDS_MAX


def _flux_Wb(of: Facts) -> float:
    return float(of.machine.magnetics.flux_linkage_Wb(0.0, of["current_peak_A"]))


def _heated_K_W(current: str, limit: str, resistance_ohm: Value) -> Value:
    """The thermal resistance with which a continuous current ends at a limit of temperature."""
    return lambda of: (of[limit] - AMBIENT_C) / (resistance_ohm(of) * of[current] ** 2)


def _switch_ohm(of: Facts) -> float:
    """Resistance of the two switches of a phase at their continuous current."""
    return 2.0 * (of["converter.switch_drop_V"] / of["switch_current_A"] + of["converter.switch_resistance_ohm"])


# --- rules ----------------------------------------------------------------------------------------------------------

_RULES_OF_MAGNETICS = (
    Rule("magnetics.aligned_inductance_H", _times(1.0, "magnetics.unaligned_inductance_H"),
         "as the gap of aligned poles is smaller:", "magnetics.unaligned_inductance_H", least=True, strict=True),
    Rule("magnetics.saturated_inductance_H", _times(1.0, "magnetics.unaligned_inductance_H"),
         "as saturated iron is no better than the gap of unaligned poles:", "magnetics.unaligned_inductance_H"),
    Rule("magnetics.flux_linkage_max_Wb",
         lambda of: of["magnetics.saturated_inductance_H"] * of["magnetics.current_at_flux_linkage_max_A"],
         "which {magnetics/saturated_inductance_H} gives without iron at",
         "magnetics.current_at_flux_linkage_max_A", least=True, strict=True),
    Rule("magnetics.flux_linkage_max_Wb",
         lambda of: of["magnetics.aligned_inductance_H"] * of["magnetics.current_at_flux_linkage_max_A"],
         "which {magnetics/aligned_inductance_H} gives without saturation at",
         "magnetics.current_at_flux_linkage_max_A"),
    Rule("magnetics.aligned_inductance_H", _times(INDUCTANCE_RATIO_MAX, "magnetics.unaligned_inductance_H"),
         f"{INDUCTANCE_RATIO_MAX:g} times", "magnetics.unaligned_inductance_H"),
    Rule("magnetics.flat_deg", lambda of: 0.5 * _half_pitch_deg(of) - _half_pitch_deg(of) / of.machine.phases,
         "or a phase makes torque for less than a stroke of {poles/stator} and", "poles.rotor", strict=True),
    Rule("magnetics.blend_deg", lambda of: 0.5 * _half_pitch_deg(of) - of["magnetics.flat_deg"],
         "as flats and blends do not fit into half a rotor pitch, {poles/rotor}, with", "magnetics.flat_deg",
         strict=True),
    Rule("poles.stator", lambda of: of["poles.stator"] if _smooth_Nm(of) > 0.0 else 0.0,
         "as no phase makes torque at some angle, which the strokes of {poles/rotor} leave to",
         MAP_FILE),
    Rule("magnetics.flux_linkage_max_Wb",
         lambda of: of["magnetics.flux_linkage_max_Wb"] * PEAK_CURRENT_A[0] / of["current_peak_A"],
         f"or less than {PEAK_CURRENT_A[0]:g} A saturates", "magnetics.aligned_inductance_H", least=True,
         when=lambda of: of.origin("current_peak_A") == "magnetics.flux_linkage_max_Wb"),
    Rule("magnetics.flux_linkage_max_Wb",
         lambda of: of["magnetics.flux_linkage_max_Wb"] * PEAK_CURRENT_A[1] / of["current_peak_A"],
         f"or more than {PEAK_CURRENT_A[1]:g} A saturates", "magnetics.aligned_inductance_H",
         when=lambda of: of.origin("current_peak_A") == "magnetics.flux_linkage_max_Wb"),
)

_RULES_OF_VOLTAGE = (
    Rule("dc_link.chopper_off_V", _times(1.0, "dc_link.chopper_on_V"), "as it ends below", "dc_link.chopper_on_V",
         strict=True),
    Rule("dc_link.chopper_off_V", _times(1.0, "converter.supply_voltage_V"), "or it never ends:",
         "converter.supply_voltage_V", least=True, strict=True),
    Rule("dc_link.chopper_off_V", _times(1.0, "drive.supply_max_V"), "or it never ends:", "drive.supply_max_V",
         least=True, strict=True),
    Rule("supply_min_V", _times(1.0, "converter.supply_voltage_V"), "which is", "converter.supply_voltage_V"),
    Rule("converter.supply_voltage_V", _times(1.0, "supply_max_V"), "which is", "supply_max_V"),
    Rule("under_voltage_V", _times(0.98, "supply_min_V"), "0.98 of", "supply_min_V"),
    Rule("supply_max_V", _times(0.98, "over_voltage_V"), "0.98 of", "over_voltage_V"),
    Rule("dc_link.chopper_on_V", _times(1.0, "over_voltage_V"), "which trips before:", "over_voltage_V"),
    Rule("over_voltage_V", _times(0.995, "adc_voltage_V"), "0.995 of the full scale", "adc_voltage_V"),
    Rule("adc_voltage_V", _times(VOLTAGE_RANGE_MAX, "supply_max_V"),
         f"which resolves its trip: {VOLTAGE_RANGE_MAX:g} times", "supply_max_V"),
)

_RULES_OF_CURRENT = (
    Rule("current_peak_A", lambda of: of.machine.magnetics.current_max_A, "the largest current of", MAP_FILE),
    Rule("current_limit_A", lambda of: of.machine.magnetics.current_max_A, "the largest current of", MAP_FILE),
    Rule("current_rated_A", _times(1.0, "current_peak_A"), "which is", "current_peak_A"),
    Rule("current_peak_A", _times(0.9, "adc_current_A"), "0.9 of the full scale", "adc_current_A"),
    Rule("current_limit_A", _times(0.98, "current_trip_A"), "0.98 of", "current_trip_A"),
    Rule("current_trip_A", _times(0.9875, "adc_current_A"), "0.9875 of the full scale", "adc_current_A"),
    Rule("adc_current_A", _times(CURRENT_RANGE_MAX, "current_peak_A"),
         f"which resolves its limit: {CURRENT_RANGE_MAX:g} times", "current_peak_A"),
    Rule("winding_current_A", _times(1.0, "current_limit_A"), "as no winding carries more than", "current_limit_A"),
    Rule("switch_current_A", _times(1.0, "current_limit_A"), "as no switch carries more than", "current_limit_A",
         when=_stated("switch_current_A")),
    Rule("sensors.current_limit_A", lambda of: of["sensors.current_gain"] * of["current_limit_A"],
         "or the sensor saturates below", "current_limit_A", least=True),
    Rule("sensors.current_gain", lambda of: of["current_trip_A"] / of["current_limit_A"],
         "or {current_limit_A} is measured as", "current_trip_A", strict=True),
    Rule("sensors.current_gain", lambda of: of["current_limit_A"] / (1.1 * of["current_trip_A"]),
         "or currents within {current_limit_A} are in truth above the comparators, 1.1 times", "current_trip_A",
         least=True),
    Rule("sensors.current_noise_A", _times(NOISE_MAX, "current_limit_A"),
         f"{NOISE_MAX:g} of", "current_limit_A"),
)

_RULES_OF_TORQUE = (
    Rule("magnetics.unaligned_inductance_H", _rising_H,
         "or the torque falls with the current before {adc_current_A} by saturation:", "magnetics.flux_linkage_max_Wb"),
    Rule("torque_rated_Nm", _times(1.0, "torque_peak_Nm"), "which is", "torque_peak_Nm"),
    Rule("torque_peak_Nm", _mean_Nm("current_peak_A"), "the mean torque at", "current_peak_A"),
    Rule("torque_rated_Nm", _mean_Nm("current_peak_A"), "the mean torque at", "current_peak_A"),
    Rule("torque_rated_Nm", _mean_Nm("current_limit_A"), "the mean torque at", "current_limit_A"),
    Rule("torque_band_inner_Nm", _times(1.0, "torque_band_outer_Nm"), "which is", "torque_band_outer_Nm"),
    Rule(_largest_drop, _drop_bound,
         f"at which winding and devices take {DROP_MAX:g} of the supply at {{current_rated_A}}:", "supply_min_V"),
    Rule(lambda of: of.inductance_key, lambda of: of.machine.magnetics.unaligned_inductance_H
         * _rise_A(of) / (RISE_MAX * of["current_peak_A"]),
         f"or the current rises by more than {RISE_MAX:g} times {{current_peak_A}} in a period of {{control_rate_hz}}"
         " at", "supply_max_V", least=True, when=lambda of: not of.is_map),
    Rule("mechanics.inertia_kg_m2",
         lambda of: of["torque_peak_Nm"] / of["control_rate_hz"] / (GAIN_MAX * _base_rad_s(of)),
         f"or the speed changes by {GAIN_MAX:g} times {{speed_base_rpm}} in a period of {{control_rate_hz}} by",
         "torque_peak_Nm", least=True),
)

_RULES_OF_SPEED = (
    Rule("speed_base_rpm", _times(1.0, "speed_max_rpm"), "which is", "speed_max_rpm"),
    Rule("speed_max_rpm", _times(1.0, "over_speed_rpm"), "which trips before:", "over_speed_rpm"),
    Rule("speed_max_rpm", lambda of: sampled_speed_rpm(of["control_rate_hz"], of.machine),
         f"for {SAMPLES_PER_TURN_MIN} control periods in an electrical revolution at", "control_rate_hz"),
    Rule("speed_base_rpm", lambda of: BASE_SPEED_MIN_RPM, "as no drive is slower, but so slowly the flux linkage is"
         " built up by", "supply_min_V", least=True),
    Rule("speed_base_rpm", _speed_rpm(lambda of, speed: of["torque_rated_Nm"]),
         "up to where the voltage makes {torque_rated_Nm} from", "supply_max_V"),
    Rule("mechanics.friction_Nm_s", lambda of: of["torque_peak_Nm"] / _base_rad_s(of),
         "which takes all torque at {speed_base_rpm}:", "torque_peak_Nm"),
    Rule("speed_max_rpm", _speed_rpm(lambda of, speed: of["mechanics.friction_Nm_s"] * speed),
         "up to where the voltage makes the torque of {mechanics/friction_Nm_s} from", "supply_max_V",
         when=_stated("speed_max_rpm")),
    Rule("dc_link.source_resistance_ohm", _source_ohm,
         "with which the power of {torque_rated_Nm} at {speed_base_rpm} pulls the link below {under_voltage_V} from",
         "supply_min_V"),
    Rule("dc_link.capacitance_F", _capacitance_F,
         f"or the field of a phase at {{current_limit_A}} is {FIELDS_MAX:g} times what it takes up to",
         "over_voltage_V", least=True, when=lambda of: "dc_link.chopper_on_V" not in of),
)

_RULES_OF_ANGLES = (
    Rule("turn_on_angle_deg", _times(1.0, "turn_off_angle_deg"), "which is", "turn_off_angle_deg", strict=True),
    Rule("turn_off_angle_deg", _times(1.0, "outgoing_off_angle_deg"), "which is", "outgoing_off_angle_deg"),
    Rule("share_on_angle_deg", _times(1.0, "share_off_angle_deg"), "which is", "share_off_angle_deg", strict=True),
)

_RULES_OF_HEAT = (
    Rule("thermal.winding_resistance_K_W",
         _heated_K_W("winding_current_A", "winding_limit_C", _times(1.0, "winding.resistance_ohm")),
         "at which {winding_current_A} heats the winding from 25 C to", "winding_limit_C"),
    Rule("thermal.inverter_resistance_K_W", _heated_K_W("switch_current_A", "inverter_limit_C", _switch_ohm),
         "at which {switch_current_A} heats the switches from 25 C to", "inverter_limit_C",
         when=lambda of: _switch_ohm(of) > 0.0),
    Rule("drive.parameters.winding_limit_C", lambda of: AMBIENT_C + LIMITED_BELOW_K,
         f"as the torque is limited from {LIMITED_BELOW_K:g} K below it on, at 25 C, the temperature of",
         "winding.resistance_ohm", least=True),
    Rule("winding_time_constant_s",
         lambda of: TIME_CONSTANT_MAX * of["thermal.winding_capacity_J_K"] * of["thermal.winding_resistance_K_W"],
         f"{TIME_CONSTANT_MAX:g} times the time constant of {{thermal/winding_resistance_K_W}} and",
         "thermal.winding_capacity_J_K",
         when=lambda of: "thermal.winding_resistance_K_W" in of),
    Rule("iron_loss.turns_area_m2", lambda of: _flux_Wb(of) / FLUX_DENSITY_T[1],
         f"or {FLUX_DENSITY_T[1]:g} T are in the iron at {{current_peak_A}} by", lambda of: of.flux_key, least=True),
    Rule("iron_loss.turns_area_m2", lambda of: _flux_Wb(of) / FLUX_DENSITY_T[0],
         f"or iron saturates at {FLUX_DENSITY_T[0]:g} T by", lambda of: of.flux_key,
         when=lambda of: of.is_map or "magnetics.saturated_inductance_H" in of),
)

_RULES_OF_EDDY_CURRENTS = (
    Rule("eddy_current.conductance_S", lambda of: EDDY_TIME_CONSTANT_S[1] / of.machine.magnetics.unaligned_inductance_H,
         f"or the flux of an open phase would take more than {EDDY_TIME_CONSTANT_S[1]:g} s to decay, by",
         lambda of: of.inductance_key),
    Rule("eddy_current.conductance_S", lambda of: EDDY_TIME_CONSTANT_S[0] / of.machine.magnetics.unaligned_inductance_H,
         f"or the flux of an open phase would decay within {EDDY_TIME_CONSTANT_S[0]:g} s, without effect, by",
         lambda of: of.inductance_key, least=True, when=lambda of: of["eddy_current.conductance_S"] > 0.0),
    Rule("eddy_current.conductance_S", lambda of: of["current_peak_A"] / of["converter.supply_voltage_V"],
         "or eddy currents alone would be {current_peak_A} at", "converter.supply_voltage_V"),
)

RULES = (*_RULES_OF_MAGNETICS, *_RULES_OF_VOLTAGE, *_RULES_OF_CURRENT, *_RULES_OF_TORQUE, *_RULES_OF_SPEED,
         *_RULES_OF_ANGLES, *_RULES_OF_HEAT,
         *_RULES_OF_EDDY_CURRENTS)
