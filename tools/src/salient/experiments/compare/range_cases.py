"""Runs over the ranges of encoders, misalignment, inertia, speeds with loads, standstill and control rates."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from salient.config import CONTROLLERS
from salient.experiments.compare.case import (
    LOAD_NM,
    MACHINES,
    STEP_AT_S,
    Case,
    by_controller,
    machine_of,
    make_scenario,
)
from salient.experiments.metrics import stroke_deg
from salient.experiments.scenario import LoadStep, Record, Scenario, SpeedStep
from salient.machine.lowest_speed import COARSE_BITS, lowest_speed_rpm

SALIENT = ("salient",)
TWO_MACHINES = ("saturating", "finite_element")

ENCODER_BITS = (8, 10, 12, 14, 17, 20)
ENCODER_SPEEDS_RPM = (5.0, 10.0, 30.0, 150.0, 600.0, 1500.0)
ENCODER_ANGLES = {"saturating": 24, "finite_element": 6}

COURSE_BITS = (9, 10, 11, 12)
COURSE_SPEEDS_RPM = (0.5, 1.0, 2.0, 5.0, 10.0, 60.0)
COURSE_SETTLING_S, COURSE_COUNTS = 2.0, 40.0

OFFSETS_DEG = (0.1, 0.2, 0.5, 1.0, 2.0, 4.0)
OFFSET_SPEEDS_RPM = (10.0, 20.0, 60.0, 150.0, 600.0, 1500.0)
OFFSET_LOAD_NM = 6.0
LEARNED_S = {"ripple_3s": 3.0, "ripple_6s": 6.0}
MOVING_PERIOD_S, LOW_NM, HIGH_NM = 0.2, 2.0, 10.0

INERTIA_GAINS = (0.2, 0.33, 0.5, 2.0, 5.0)

ERROR_SPEEDS_RPM = (1.0, 10.0, 30.0, 150.0, 600.0)
ERROR_LOADS_NM = (0.0, 2.0, 8.0, 15.0)

HOLD_S, HOLD_QUICK_S = 60.0, 2.0
HOLD_LOADS_NM = (8.0, -8.0)

RATES_HZ = (20_000, 40_000, 50_000, 100_000, 1_000_000)
RATE_NOISE_A = 0.02


def loaded_at_s(speed_rpm: float) -> float:
    """Time of the load: after the acceleration of 0.17 s to 1500 r/min, and after the slow settling of a coarse encoder
    at the lowest speeds."""
    return round(STEP_AT_S + speed_rpm / 5000.0 + (0.2 if speed_rpm < 60.0 else 0.0), 6)


def encoders(quick: bool) -> Iterator[Case]:
    """Load steps with encoders of all resolutions, from several initial angles within a stroke."""
    for machine in TWO_MACHINES[:1] if quick else TWO_MACHINES:
        angles = 2 if quick else ENCODER_ANGLES[machine]
        for edges in (False, True):
            for bits in (10, 17) if quick else ENCODER_BITS:
                for speed_rpm in (10.0, 600.0) if quick else ENCODER_SPEEDS_RPM:
                    if not encoder_allows(machine, bits, speed_rpm):
                        continue
                    condition = f"{machine}, {bits} bits{' and edge stamps' if edges else ''}, {speed_rpm:g} r/min"
                    for number in range(angles):
                        angle_deg = round(number * _stroke_deg(machine) / angles, 3)
                        scenario = _load_step(speed_rpm, machine=machine, encoder_bits=bits, encoder_edges=edges,
                                              initial_angle_deg=angle_deg)
                        yield from by_controller("encoders", condition, "encoder", scenario, f"angle {number:02}",
                                                 SALIENT)
        for bits in COURSE_BITS[:1] if quick else COURSE_BITS:
            for speed_rpm in (10.0,) if quick else COURSE_SPEEDS_RPM:
                allowed = [name for name in CONTROLLERS if encoder_allows(machine, bits, speed_rpm, name)]
                yield from by_controller("encoders", f"{machine}, {bits} bits, {speed_rpm:g} r/min, mean",
                                         "encoder_course", _course(speed_rpm, machine=machine, encoder_bits=bits), "",
                                         allowed)


def encoder_allows(machine: str, bits: int, speed_rpm: float, controller: str = "salient") -> bool:
    """False for a speed that the drive is refused with such an encoder."""
    return speed_rpm >= lowest_speed_rpm(machine, bits, controller)


def _course(speed_rpm: float, encoder_bits: int, **fields: Any) -> Scenario:
    """A load step at a low speed, recorded from the time when it has settled, over COURSE_COUNTS counts or 2 s."""
    assert encoder_bits <= COARSE_BITS
    counts_s = COURSE_COUNTS * 60.0 / speed_rpm / 2**encoder_bits
    settled_s = round(STEP_AT_S + 0.3 + max(COURSE_SETTLING_S, counts_s), 3)
    return make_scenario(duration_s=round(settled_s + max(2.0, counts_s), 3), speed=(SpeedStep(0.0, speed_rpm),),
                         load=(LoadStep(STEP_AT_S + 0.3, LOAD_NM),), encoder_bits=encoder_bits,
                         record=Record(25.0, settled_s), **fields)


def _load_step(speed_rpm: float, **fields: Any) -> Scenario:
    loaded_s = loaded_at_s(speed_rpm)
    return make_scenario(duration_s=loaded_s + 0.3, speed=(SpeedStep(0.0, speed_rpm),),
                         load=(LoadStep(loaded_s, LOAD_NM),), record=Record(5.0, loaded_s), **fields)


def misalignment(quick: bool) -> Iterator[Case]:
    """Ripple of misaligned drives after 3 and 6 s, next to the ripple of aligned ones, which are the first samples."""
    for machine in TWO_MACHINES[:1] if quick else TWO_MACHINES:
        for speed_rpm in (600.0,) if quick else OFFSET_SPEEDS_RPM:
            for offset_deg in (0.5,) if quick else OFFSETS_DEG:
                yield from _misaligned(f"{machine}, {speed_rpm:g} r/min, {offset_deg:g} deg", machine, speed_rpm,
                                       offset_deg, False)
    if not quick:
        for machine in TWO_MACHINES:
            for offset_deg in (0.0, 0.5):
                yield from _misaligned(f"{machine}, 150 r/min, {offset_deg:g} deg, moving load", machine, 150.0,
                                       offset_deg, True)


def _misaligned(condition: str, machine: str, speed_rpm: float, offset_deg: float, moving: bool) -> Iterator[Case]:
    for extractor, from_s in LEARNED_S.items():
        # One electrical revolution: each phase has its own misalignment.
        window_s = max(0.1, _electrical_deg(machine) / (6.0 * speed_rpm))
        loaded_s = loaded_at_s(speed_rpm)
        constant = (LoadStep(loaded_s, OFFSET_LOAD_NM),)
        misaligned = {"encoder_offset_deg": offset_deg}
        samples: dict[str, tuple[tuple[LoadStep, ...], dict[str, float]]] = {
            "aligned": (constant, {}), "misaligned": (constant, misaligned)}
        if moving:
            ramp_Nm_s = (HIGH_NM - LOW_NM) / (MOVING_PERIOD_S / 2.0)
            samples["misaligned"] = (_triangle(loaded_s, from_s - 0.3), {**misaligned, "load_ramp_Nm_s": ramp_Nm_s})
        for sample, (load, bench) in samples.items():
            scenario = make_scenario(machine=machine, duration_s=round(from_s + window_s, 6),
                                     speed=(SpeedStep(0.0, speed_rpm),), load=load, record=Record(1.0, from_s),
                                     bench=bench)
            yield from by_controller("misalignment", condition, extractor, scenario, sample, SALIENT)


def _triangle(from_s: float, until_s: float) -> tuple[LoadStep, ...]:
    """A load that moves between LOW_NM and HIGH_NM along ramps of half a period, and is constant afterwards."""
    count = int((until_s - from_s) / (MOVING_PERIOD_S / 2.0)) // 2 * 2
    steps = [LoadStep(round(from_s + number * MOVING_PERIOD_S / 2.0, 6), (HIGH_NM, LOW_NM)[number % 2])
             for number in range(count)]
    return (*steps, LoadStep(round(until_s, 6), OFFSET_LOAD_NM))


def inertia(quick: bool) -> Iterator[Case]:
    """Load steps and starts of machines whose inertia is not the one of their file, which are the first samples."""
    for machine in MACHINES[:1] if quick else MACHINES:
        for gain in (0.33,) if quick else INERTIA_GAINS:
            for sample, bench in (("nominal", {}), ("changed", {"inertia_gain": gain})):
                step_s = 0.3 * max(1.0, gain)
                step = make_scenario(machine=machine, duration_s=step_s + 0.4, speed=(SpeedStep(0.0, 150.0),),
                                     load=(LoadStep(step_s, LOAD_NM),), record=Record(10.0, step_s), bench=bench)
                start = make_scenario(machine=machine, duration_s=0.3 * max(1.0, gain), bench=bench,
                                      speed=(SpeedStep(0.0, 600.0),), record=Record(10.0, 0.0))
                condition = f"{machine}, inertia x {gain:g}"
                yield from by_controller("inertia", condition, "inertia_step", step, sample)
                yield from by_controller("inertia", condition, "start", start, sample)


def standing_error(quick: bool) -> Iterator[Case]:
    """Mean speed over whole turns, 1.5 s after a load."""
    for machine in MACHINES[:1] if quick else MACHINES:
        for speed_rpm in (600.0,) if quick else ERROR_SPEEDS_RPM:
            for load_Nm in ERROR_LOADS_NM:
                loaded_s = loaded_at_s(speed_rpm)
                turns = max(1, round(speed_rpm / 60.0))
                from_s = round(loaded_s + 1.5, 6)
                scenario = make_scenario(
                    machine=machine, duration_s=round(from_s + turns * 60.0 / speed_rpm, 6),
                    speed=(SpeedStep(0.0, speed_rpm),), load=(LoadStep(loaded_s, load_Nm),),
                    record=Record(100.0, from_s))
                yield from by_controller("standing_error", f"{machine}, {speed_rpm:g} r/min, {load_Nm:g} N m",
                                         "mean_error", scenario, controllers=SALIENT)


def hold(quick: bool) -> Iterator[Case]:
    """A load at standstill, from 1 s after it."""
    for machine in MACHINES[:1] if quick else MACHINES:
        for load_Nm in HOLD_LOADS_NM[:1] if quick else HOLD_LOADS_NM:
            scenario = make_scenario(machine=machine, duration_s=1.1 + (HOLD_QUICK_S if quick else HOLD_S),
                                     speed=(SpeedStep(0.0, 0.0),), load=(LoadStep(0.1, load_Nm),),
                                     record=Record(100.0, 1.1))
            yield from by_controller("hold", f"{machine}, {load_Nm:g} N m", "hold", scenario, controllers=SALIENT)


def rates(quick: bool) -> Iterator[Case]:
    """The paper's load step at all control rates, with a torque reserve and noise of the current sensors; the encoder's
    noise is its quantisation."""
    for machine in MACHINES[:1] if quick else MACHINES:
        for rate_hz in (20_000, 100_000) if quick else RATES_HZ:
            scenario = make_scenario(machine=machine, duration_s=0.4, control_rate_hz=rate_hz,
                                     speed=(SpeedStep(0.0, 150.0),), load=(LoadStep(STEP_AT_S, LOAD_NM),),
                                     record=Record(1.0, STEP_AT_S), parameters={"torque_reserve_Nm": LOAD_NM},
                                     bench={"current_noise_A": RATE_NOISE_A})
            yield from by_controller("rates", f"{machine}, {rate_hz / 1000:g} kHz", "step_and_ripple", scenario,
                                     controllers=SALIENT)


def _stroke_deg(machine: str) -> float:
    return stroke_deg(machine_of(machine))


def _electrical_deg(machine: str) -> float:
    return 360.0 / machine_of(machine).rotor_poles
