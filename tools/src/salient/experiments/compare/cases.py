"""The runs of a comparison, by group.

A group consists of conditions, each with one or more rows of the table; the runs of a condition differ by controller
and, where a metric is a statistic, by sample. Identical runs are executed once (compare/runner.py).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from salient.config import CONDITIONS, CONTROLLERS
from salient.experiments.compare import (
    count_cases,
    every_machine,
    mismatch,
    random_cases,
    range_cases,
    speed_range,
)
from salient.experiments.compare.case import (
    LOAD_NM,
    MACHINES,
    MAGNETICS,
    STEP_AT_S,
    Case,
    Group,
    by_controller,
    make_scenario,
)
from salient.experiments.scenario import LoadStep, Record, Scenario, SpeedStep
from salient.toml_file import toml_value

# Parameters of the drive that conditions set, by meaning; the numbers are in docs/reference/parameters.md.
LOAD_KNOWN: dict[str, float] = {"load_source": 1}
PULSES: dict[int, dict[str, float]] = {1: {"pulses_per_period": 1}, 2: {"pulses_per_period": 2}}
RESERVE = {"torque_reserve_Nm": 8.0}

RIPPLE_RPM = 150.0
RIPPLE_FROM_S = 0.3
LONG_S = 1.0

MOVING_MACHINES = ("saturating", "finite_element")
SINE_NM = 4.0
SINES_HZ = (1.0, 5.0, 20.0, 50.0, 100.0)
FAST_SINES_HZ = (150.0, 200.0, 300.0, 500.0)
"""Frequencies that only `salient` is measured at."""
SINE_WINDOW_S = 0.15
"""Two periods of the load where they are longer."""
RAMPS_MS = (1, 5, 20, 50, 100, 200, 500)

COMPRESSORS = {"one cylinder": ("compressor_one_cylinder", 1.5), "two cylinders": ("compressor_two_cylinders", 3.0)}
"""Load profile and its mean torque in N m, which with 5 N m more is at most 14.6 N m."""
COMPRESSOR_BASE_NM = 5.0
COMPRESSOR_RPM = (150.0, 600.0, 1500.0)
COMPRESSOR_TURNS = 20

IMPERFECTIONS: dict[str, dict[str, float]] = {
    "20 mA of noise": {"current_noise_A": 0.02},
    "0.05 deg off": {"encoder_offset_deg": 0.05},
    "flux linkage +5 %": {"flux_linkage_gain": 1.05},
    "resistance +20 %": {"resistance_gain": 1.2},
    "minimum pulse 200 ns": {"minimum_pulse_ns": 200.0},
}
ALL_IMPERFECTIONS = {name: value for one in IMPERFECTIONS.values() for name, value in one.items()}

SENSING: dict[str, dict[str, Any]] = {
    "17 bits": {},
    "17 bits and edge stamps": {"encoder_edges": True},
    "ideal sensing": {"encoder_bits": 0, "adc_bits": 16},
}
PAPER_CONDITIONS = {"control_rate_hz": 1_000_000, "encoder_bits": 0, "adc_bits": 16, "immediate_pwm": True}
PAPER_PARAMETERS: dict[str, float] = {**LOAD_KNOWN, "observer_bandwidth_rad_s": 8000, "torque_band_inner_Nm": 0.01,
                    "torque_band_outer_Nm": 0.02, "outgoing_off_angle_deg": 356}
"""Parameters for the paper's conditions. The speed observer does not know the load torque and overestimates the speed
until it has converged; exact sensing permits a high bandwidth. The default bands are for 40 kHz, where the torque
changes by newton metres per period. A phase switched off at its default angle of 87 degrees (348 electrical) still
carries current and leaves a torque dip that is visible at this scale; at 89 degrees the current has decayed."""

ANGLES, ANGLES_QUICK = 24, 6
STROKE_DEG = 30.0
_STROKE_S = STROKE_DEG / (6.0 * RIPPLE_RPM)


def _ripple(quick: bool) -> Iterator[Case]:
    def cases(condition: str, traced: bool = False, **fields: Any) -> Iterator[Case]:
        yield from _steady("ripple", condition, RIPPLE_RPM, RIPPLE_FROM_S, quick, traced, **fields)

    for rate_hz in (40_000,) if quick else (40_000, 20_000, 100_000):
        for machine in MACHINES:
            for pulses in PULSES:
                condition = f"{machine}, {_khz(rate_hz)}, {_pulses(pulses)}"
                traced = machine == "saturating" and rate_hz == 40_000
                yield from cases(condition, traced, machine=machine, control_rate_hz=rate_hz, pulses=pulses)
    for machine in MAGNETICS if quick else MACHINES:
        for pulses in PULSES:
            yield from cases(f"{machine}, 40 kHz, {_pulses(pulses)}, all imperfections", machine=machine,
                             pulses=pulses, bench=ALL_IMPERFECTIONS)
    if not quick:
        for name, bench in IMPERFECTIONS.items():
            yield from cases(f"saturating, 40 kHz, one pulse, {name}", machine="saturating", pulses=1, bench=bench)


def _speeds(quick: bool) -> Iterator[Case]:
    # The load step follows the acceleration: at 19.1 N m the start to 3000 r/min takes 0.42 s.
    machines = [("saturating", None)] if quick else [(machine, None) for machine in MAGNETICS] + [("saturating", 1)]
    for machine, pulses in machines:
        for speed_rpm, loaded_s in ((600.0, 0.2), (1500.0, 0.4), (3000.0, 0.8)):
            condition = f"{machine}{f' with {_pulses(pulses)}' if pulses else ''}, {speed_rpm:g} r/min"
            yield from _steady("speeds", condition, speed_rpm, loaded_s + 0.5, quick, loaded_s=loaded_s,
                             machine=machine, pulses=pulses)
    yield from count_cases.sampled(quick)


def _loads(quick: bool) -> Iterator[Case]:
    for machine in ("saturating",) if quick else MAGNETICS:
        for load_Nm in (2.0, 15.0) if quick else (1.0, 2.0, 4.0, 8.0, 12.0, 15.0):
            yield from _steady("loads", f"{machine}, {load_Nm:g} N m", RIPPLE_RPM, RIPPLE_FROM_S, quick,
                             load_Nm=load_Nm, machine=machine)


def _start(quick: bool) -> Iterator[Case]:
    for machine in ("saturating",) if quick else MACHINES:
        yield from by_controller("start", machine, "start", start_scenario(machine=machine))


def _dip(quick: bool) -> Iterator[Case]:
    angles = ANGLES_QUICK if quick else ANGLES
    conditions = [("saturating", sensing) for sensing in SENSING]
    if not quick:
        conditions += [(machine, sensing) for machine in MAGNETICS[1:] for sensing in list(SENSING)[1:]]
    for machine, sensing in conditions:
        for number in range(angles):
            step_s = STEP_AT_S + number * _STROKE_S / angles
            scenario = make_scenario(machine=machine, duration_s=step_s + 0.3, speed=(SpeedStep(0.0, RIPPLE_RPM),),
                                 load=(LoadStep(step_s, LOAD_NM),), record=Record(10.0, 0.09), **SENSING[sensing])
            sample = f"angle {number:02}"
            strokes = number / angles
            yield from by_controller("dip", f"{machine}, {sensing}", "load_step", scenario, sample, strokes=strokes)
            if machine == "saturating" and sensing != "17 bits" and not quick:
                yield Case("dip", f"{machine}, {sensing}, reserve of 8 N m", "salient", "load_step",
                           replace(scenario, controller="salient", parameters=RESERVE), sample, strokes=strokes)


def _moving(quick: bool) -> Iterator[Case]:
    conditions: list[tuple[float, float, Sequence[str]]] = [
        (RIPPLE_RPM, frequency_Hz, CONTROLLERS) for frequency_Hz in ((5.0, 20.0) if quick else SINES_HZ)]
    if not quick:
        conditions += [(speed_rpm, frequency_Hz, ("salient",)) for speed_rpm in (30.0, 600.0, 1500.0)
                       for frequency_Hz in (1.0, 20.0)]
        conditions += [(RIPPLE_RPM, frequency_Hz, ("salient",)) for frequency_Hz in FAST_SINES_HZ]
    for machine in MOVING_MACHINES[:1] if quick else MOVING_MACHINES:
        for speed_rpm, frequency_Hz, controllers in conditions:
            scenario = _sine_scenario(speed_rpm, frequency_Hz, machine=machine)
            yield from by_controller("moving", f"{machine}, {speed_rpm:g} r/min, {frequency_Hz:g} Hz", "moving",
                                      scenario, controllers=controllers)


def _sine_scenario(speed_rpm: float, frequency_Hz: float, **fields: Any) -> Scenario:
    """A load of 8 N m after the acceleration, with a sine from time 0; recorded at the end, in the steady state."""
    loaded_s = 0.2 + 0.6 * speed_rpm / 3000.0
    from_s = round(loaded_s + max(0.3, 1.0 / frequency_Hz), 6)
    return make_scenario(duration_s=from_s + max(SINE_WINDOW_S, 2.0 / frequency_Hz), speed=(SpeedStep(0.0, speed_rpm),),
                     load=(LoadStep(loaded_s, LOAD_NM),), record=Record(10.0, from_s),
                     bench={"load_sine_amplitude_Nm": SINE_NM, "load_sine_frequency_Hz": frequency_Hz}, **fields)


def _ramps(quick: bool) -> Iterator[Case]:
    for machine in MOVING_MACHINES:
        for ramp_ms in (20, 200) if quick else RAMPS_MS:
            ramp_s = ramp_ms / 1000.0
            scenario = make_scenario(machine=machine, duration_s=STEP_AT_S + ramp_s + 0.3,
                                 speed=(SpeedStep(0.0, RIPPLE_RPM),), load=(LoadStep(STEP_AT_S, LOAD_NM),),
                                 record=Record(10.0, STEP_AT_S), bench={"load_ramp_Nm_s": LOAD_NM / ramp_s})
            yield from by_controller("ramps", f"{machine}, {ramp_ms} ms", "load_step", scenario)


def _compressor(quick: bool) -> Iterator[Case]:
    for machine in MOVING_MACHINES[:1] if quick else MOVING_MACHINES:
        for speed_rpm in (600.0,) if quick else COMPRESSOR_RPM:
            for name, (profile, mean_Nm) in COMPRESSORS.items():
                loaded_s = 0.2 + 0.6 * speed_rpm / 3000.0
                turn_s = 60.0 / speed_rpm
                duration_s = round(loaded_s + (COMPRESSOR_TURNS + 3) * turn_s, 6)
                scenario = make_scenario(machine=machine, duration_s=duration_s,
                                         speed=(SpeedStep(0.0, speed_rpm),), load_profile=profile,
                                         load=(LoadStep(loaded_s, COMPRESSOR_BASE_NM, mean_Nm),),
                                         record=Record(10.0, round(loaded_s + COMPRESSOR_TURNS * turn_s, 6)))
                condition = f"{machine}, {name}, {speed_rpm:g} r/min"
                yield from by_controller("compressor", condition, "moving", scenario, controllers=("paper", "salient"))
                if not quick:
                    yield Case("compressor", f"{condition}, not learned", "salient", "moving",
                               replace(scenario, controller="salient", parameters={"periodic_load": 0}))


def _paper_conditions(quick: bool) -> Iterator[Case]:
    for machine in ("saturating",) if quick else MAGNETICS:
        step = replace(step_scenario(machine=machine, **PAPER_CONDITIONS), duration_s=0.5)
        # At 10 ms, after the parameters have been written over CAN.
        start = replace(start_scenario(machine=machine, **PAPER_CONDITIONS), speed=(SpeedStep(0.01, 600.0),))
        for condition, scenario, extractor, parameters in (
            ("load step", step, "step_and_ripple", PAPER_PARAMETERS),
            ("load step, usual parameters", step, "step_and_ripple", LOAD_KNOWN),
            ("start", start, "start", PAPER_PARAMETERS)):
            for controller in ("traditional", "paper"):
                yield Case("paper_conditions", f"{machine}, {condition}", controller, extractor,
                           replace(scenario, controller=controller, parameters=parameters))


def _machines(quick: bool) -> Iterator[Case]:
    for scenario in every_machine.scenarios(quick):
        yield Case("machines", Path(scenario.machine).stem, scenario.controller, "every_machine", scenario)
    for path in every_machine.machine_files(quick):
        yield from speed_range.of_any_machine(quick, str(path))


_STEP_RIPPLE = (("ripple_step", "median"), ("ripple_step", "worst"), ("ripple_step", "spread"),
                ("speed_dip_rpm", "median"))

GROUPS: dict[str, Group] = {
    "ripple": Group("torque ripple at 150 r/min, 8 N m", _ripple, (("ripple", ""), ("ripple_long", ""))),
    "speeds": Group("torque ripple over speed, 8 N m, 40 kHz; load steps of half the rated torque at speeds near and"
                    " far from ratios of counts in a control period, 20 to 100 kHz", _speeds,
                    (("ripple", ""), ("ripple_long", ""), ("speed_error_percent", ""), *_STEP_RIPPLE),
                    worst=("ripple_step",)),
    "every_speed": Group("the same load steps at 2,016 speeds of eight machines, 10 to 18 bits", count_cases.every,
                         _STEP_RIPPLE, long=True, worst=("ripple_step",)),
    "loads": Group("torque ripple over load, 150 r/min, 40 kHz", _loads,
                   (("ripple", ""), ("ripple_long", ""))),
    "start": Group("start to 600 r/min, no load, 40 kHz", _start, (("settling_time_s", ""), ("overshoot_percent", ""))),
    "dip": Group("load step of 8 N m at 150 r/min, over the rotor's angle, 40 kHz", _dip,
                 (("speed_dip_rpm", "median"), ("speed_dip_rpm", "worst"), ("recovery_time_s", "median"),
                  ("speed_after_rpm", "worst"), ("copper_W", "median"), ("step_angle_deg", "gap"))),
    "moving": Group("load of 8 N m and a sine of 4 N m, 40 kHz", _moving,
                    (("speed_swing_rpm", ""), ("swing_of_free", ""))),
    "ramps": Group("load ramp to 8 N m at 150 r/min, 40 kHz", _ramps, (("speed_dip_rpm", ""),)),
    "torque_speed": Group("largest torque over the speed of a held shaft, 0.25 to 2 times the base speed, 40 kHz",
                          speed_range.torque_speed,
                          (("torque_mean_Nm", ""), ("torque_bound_Nm", ""), *speed_range.JUDGED, ("ripple", ""))),
    "torque_speed_random": Group("largest torque over the speed of a held shaft, ten random machines, 40 kHz",
                                 speed_range.torque_speed_random,
                                 (("torque_mean_Nm", ""), ("torque_bound_Nm", ""), *speed_range.JUDGED,
                                  ("ripple", "")), long=True),
    "partial_torque": Group("parts of the largest torque on a held shaft above base speed, 40 kHz",
                            speed_range.partial_torque,
                            (("rms_to_best", ""), ("phase_rms_A", ""), ("torque_error_percent", ""), ("ripple", "")),
                            long=True),
    "copper": Group("parts of the rated torque on a held shaft up to base speed, 40 kHz", speed_range.copper,
                    (("copper_to_least", ""), ("ripple", ""), ("torque_error_percent", ""))),
    "copper_random": Group("parts of the rated torque on a held shaft up to base speed, random machines of narrow pole"
                           " arcs, 40 kHz", speed_range.copper_random,
                           (("copper_to_least", ""), ("ripple", ""), ("torque_error_percent", "")), long=True),
    "transition": Group("load steps at 1.5 and 0.5 times the base speed, ramps between 0.5 and 2 times under load, 40"
                        " kHz", speed_range.transition,
                        (("dip_ratio", ""), ("speed_dip_rpm", ""), ("recovery_time_s", ""), ("torque_step_percent", ""),
                         ("highest_speed_percent", "")), long=True),
    "torque_conditions": Group("largest torque of a held shaft at 1.5 times the base speed, by control rate, encoder"
                               " and supply", speed_range.torque_conditions,
                               (("torque_mean_Nm", ""), ("torque_bound_Nm", ""), *speed_range.JUDGED, ("ripple", "")),
                               long=True),
    "compressor": Group("reciprocating compressor, turns 21 to 23 under load, 40 kHz", _compressor,
                        (("speed_swing_rpm", ""),)),
    "paper_conditions": Group("the paper's conditions: 1 MHz, no delay, exact sensing, load torque known",
                              _paper_conditions,
                              (("settling_time_s", ""), ("overshoot_percent", ""), ("speed_dip_rpm", ""),
                               ("recovery_time_s", ""), ("speed_after_rpm", ""), ("torque_mean_Nm", ""),
                               ("ripple", ""))),
    "inertia": Group("inertia other than assumed: load step of 8 N m at 150 r/min, start to 600 r/min, 40 kHz",
                     range_cases.inertia,
                     (("speed_dip_rpm", "worst"), ("recovery_ratio", ""), ("swing_percent", "worst"),
                      ("settling_time_s", "worst"), ("overshoot_percent", "worst")),
                     ratios={"recovery_time_s": "recovery_ratio"}),
    "rates": Group("control rates: load step of 8 N m at 150 r/min, torque reserve of 8 N m, 20 mA of noise",
                   range_cases.rates, (("ripple", ""), ("speed_dip_rpm", ""), ("recovery_time_s", ""))),
    "encoders": Group("encoders: load step of 8 N m, 40 kHz", range_cases.encoders,
                      (("failed", "count"), ("against_periods", "worst"), ("speed_dip_rpm", "worst"),
                       ("mean_error_percent", "worst"), ("course_counts", "worst")), long=True),
    "misalignment": Group("misalignment of encoder and poles, 6 N m, 40 kHz", range_cases.misalignment,
                          (("ripple_3s_ratio", ""), ("ripple_6s_ratio", ""), ("ripple_6s", "worst")), long=True,
                          ratios={"ripple_3s": "ripple_3s_ratio", "ripple_6s": "ripple_6s_ratio"}),
    "standing_error": Group("mean speed over whole turns, 40 kHz", range_cases.standing_error,
                            (("mean_error_rpm", ""),), long=True),
    "hold": Group("load at standstill, 40 kHz", range_cases.hold, (("drift_deg", ""),), long=True),
    "mismatch": Group("wrong machine file in the drive, right motor: load step of 8 N m at 150 r/min and 1 s after it"
                      " (salient: 6 s), start to 600 r/min, half of the torque on a held shaft at 0.1 and 1.5 times the"
                      " base speed, 40 kHz", mismatch.mismatch,
                      (("failed", "count"), ("ripple", ""), ("ripple_to_right", ""), ("ripple_step", ""),
                       ("ripple_step_to_right", ""), ("speed_dip_rpm", ""), ("dip_to_right", ""),
                       ("recovery_time_s", ""), ("recovery_to_right", ""), ("settling_time_s", ""),
                       ("settling_to_right", ""), ("overshoot_percent", ""), ("torque_error_percent", ""),
                       ("torque_to_right", ""), ("torque_error_2s_percent", ""), ("torque_error_fast_percent", ""),
                       ("torque_fast_to_right", ""), ("torque_error_fast_2s_percent", "")),
                      long=True,
                      ratios={"ripple": "ripple_to_right", "ripple_step": "ripple_step_to_right",
                              "speed_dip_rpm": "dip_to_right", "recovery_time_s": "recovery_to_right",
                              "settling_time_s": "settling_to_right", "torque_mean_Nm": "torque_to_right",
                              "torque_fast_Nm": "torque_fast_to_right"}),
    "robustness": Group("random drives: start to 150 or 600 r/min, then 8 N m; random machines, speeds and loads; 40"
                        " kHz", random_cases.robustness,
                        (("failed", "count"), ("mean_error_percent", "worst"), ("deviation_rpm", "worst"),
                         ("swing_ratio", "worst"), ("settling_time_s", "median"), ("settling_time_s", "worst"),
                         ("peak_current_A", "median"), ("peak_current_A", "worst"),
                         ("highest_speed_percent", "median"), ("highest_speed_percent", "worst"),
                         ("speed_dip_rpm", "median"), ("speed_dip_rpm", "worst"),
                         ("speed_error_percent", "median"), ("speed_error_percent", "worst"),
                         ("cycle_percent", "median"), ("cycle_percent", "worst")), long=True),
}

GROUPS["machines"] = Group(
    "machines of all sizes: start to 0.4 of the base speed, half of the rated torque at a quarter of it, reversal;"
    " largest torque over the speed",
    _machines, (("start_to_bound", ""), ("brake_to_bound", ""), ("reverse_to_bound", ""), ("late_s", ""),
                ("dip_percent", ""), ("recovery_time_s", ""), ("hold_percent", ""), ("ripple", ""),
                ("ripple_reference", ""), ("ripple_to_allowed", ""), ("torque_mean_Nm", ""),
                ("torque_bound_Nm", ""), *speed_range.JUDGED), long=True)
TITLES = {name: group.title for name, group in GROUPS.items()}


# --- scenarios ------------------------------------------------------------------------------------------------------

def start_scenario(**fields: Any) -> Scenario:
    """From standstill to 600 r/min without load."""
    return make_scenario(duration_s=0.5, speed=(SpeedStep(0.0, 600.0),), record=Record(10.0, 0.0), **fields)


def step_scenario(**fields: Any) -> Scenario:
    """The paper's load step, recorded from the step to the end of the ripple window."""
    return make_scenario(duration_s=RIPPLE_FROM_S + 0.1, speed=(SpeedStep(0.0, RIPPLE_RPM),),
                     load=(LoadStep(STEP_AT_S, LOAD_NM),), record=Record(1.0, STEP_AT_S), **fields)


def _steady(  # noqa: PLR0913, PLR0917 - each is a condition of the case
          group: str, condition: str, speed_rpm: float, from_s: float, quick: bool, traced: bool = False,
          loaded_s: float = STEP_AT_S, load_Nm: float = LOAD_NM, pulses: int | None = None,
          **fields: Any) -> Iterator[Case]:
    """Constant speed against a load, recorded from from_s. pulses: None for the default parameters."""
    scenario = make_scenario(duration_s=from_s + (0.1 if quick else LONG_S), speed=(SpeedStep(0.0, speed_rpm),),
                         load=(LoadStep(loaded_s, load_Nm),), record=Record(1.0, from_s), **fields)
    for case in by_controller(group, condition, "ripple", scenario):
        parameters = PULSES[pulses] if case.controller == "salient" and pulses else case.scenario.parameters
        yield replace(case, scenario=replace(case.scenario, parameters=parameters), traced=traced)


def scenario_toml(case: Case) -> str:
    """The run as a scenario file for `tools/salient run`."""
    scenario = case.scenario
    lines = [f"# {case.group}: {case.condition} {case.sample}".rstrip(), f'machine = "{scenario.machine}"',
             f'controllers = ["{scenario.controller}"]']
    plain = Scenario(name="", duration_s=0.0)
    tables: list[tuple[str, Mapping[str, float]]] = []
    for key, value in vars(scenario).items():
        if key in ("name", "machine", "controller") or value is None or (
                key not in CONDITIONS and value == getattr(plain, key)):
            continue  # what is left out of the conditions would come from the machine file
        if isinstance(value, Mapping):
            tables.append((f"[{key}]", value))
        elif isinstance(value, tuple):
            tables += [(f"[[{key}]]", {name: item for name, item in vars(step).items() if item is not None})
                       for step in value]
        elif isinstance(value, Record):
            tables.append((f"[{key}]", vars(value)))
        else:
            lines.append(f"{key} = {toml_value(value)}")
    for head, content in tables:
        lines += ["", head, *(f"{key} = {toml_value(value)}" for key, value in content.items())]
    return "\n".join(lines) + "\n"


def _khz(rate_hz: int) -> str:
    return f"{rate_hz / 1000:g} kHz"


def _pulses(pulses: int) -> str:
    return ("one pulse", "two pulses")[pulses - 1]
