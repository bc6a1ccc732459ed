"""Faults by place through the bench: each kind in the true state or in what the drive measures, from the stated
microsecond to the stated microsecond; errors; several at once; equal runs."""

from __future__ import annotations

import numpy as np
import pytest

from salient.bench.bench import Bench
from salient.bench.faults import FaultError, FaultKind, fault_kinds
from salient.experiments.scenario import FaultStep, LoadStep, Record, Scenario, SpeedStep, run_scenario

pytestmark = pytest.mark.bench_options(controller="traditional")

BEGIN_S, END_S = 0.050_123, 0.052_457


def arguments_of(kind: FaultKind) -> dict[str, float | str]:
    """A place, and a small value of the attribute."""
    arguments: dict[str, float | str] = {}
    if kind.has_phase:
        arguments["phase"] = "b"
    if kind.has_leg:
        arguments["leg"] = "low"
    if kind.attribute:
        name, signal = kind.attribute
        arguments[name] = "c" if kind.choices else max(signal.minimum or 0.0, 0.02 * (signal.maximum or 0.0))
    return arguments


UNSUPPORTED = ("chopper_open", "code_flipped", "stack_guard_flipped")
"""By this machine, which has no chopper, and by the host."""


@pytest.mark.parametrize("kind", [name for name in fault_kinds() if name not in UNSUPPORTED])
def test_every_kind_begins_and_ends_at_its_microsecond(bench: Bench, kind: str) -> None:
    bench.drive.speed_reference_rpm = 300
    bench.at(BEGIN_S).fault(kind, duration_s=END_S - BEGIN_S, **arguments_of(fault_kinds()[kind]))
    bench.run_for(0.06)
    present = bench.truth["RIG_TRUTH_FAULT.present"]
    assert list(present.time_s) == pytest.approx([BEGIN_S, END_S], abs=1e-9)
    assert list(present.value) == [1, 0]
    assert bench.truth["RIG_TRUTH_FAULT.kind"].last_name == kind
    if fault_kinds()[kind].has_phase:
        assert bench.truth["RIG_TRUTH_FAULT.phase"].last_name == "b"


# --- The true state and the measured values ---


def recording_of(tmp_path, fault: FaultStep, **changes) -> np.ndarray:
    """The true state around a fault, every microsecond, at 600 r/min from standstill."""
    scenario = Scenario(**({"name": "fault", "duration_s": 0.06, "controller": "traditional", "fault": (fault,),
                            "speed": (SpeedStep(0.0, 600.0),), "record": Record(step_us=1.0, from_s=0.045)} | changes))
    return np.array(run_scenario(scenario, tmp_path).recording)


def row(recording: np.ndarray, time_s: float) -> int:
    return int(np.flatnonzero(np.isclose(recording["time_s"], time_s, atol=1e-7))[0])


def first_difference_s(one: np.ndarray, other: np.ndarray) -> float:
    """Time of the first row that differs by more than the last bits."""
    columns = [name for name in one.dtype.names if name != "time_s"]
    differs = np.any([np.abs(one[name] - other[name]) > 1e-5 for name in columns], axis=0)
    return float(one["time_s"][np.argmax(differs)]) if differs.any() else np.inf


PLANT = {
    "winding_open": {"phase": "b"},
    "switch_shorted": {"phase": "b", "leg": "high"},
    "switch_open": {"phase": "b", "leg": "low"},
    "gate_supply_lost": {"phase": "b"},
    "winding_shorted": {"phase": "b", "turns_percent": 10.0},
    "shaft_locked": {},
    "coulomb_friction": {"torque_Nm": 3.0},
    "supply_lost": {},
    "supply_sagged": {"depth_percent": 50.0},
    "supply_surged": {"height_percent": 50.0},
    "supply_ripple": {"amplitude_V": 30.0},
}


@pytest.mark.parametrize("kind", PLANT)
def test_the_true_state_changes_at_the_stated_microsecond(tmp_path, kind: str) -> None:
    """The recordings with and without a fault are equal until it begins, and differ within two control periods after
    it, at a time at which the phase carries current."""
    healthy = recording_of(tmp_path / "healthy", FaultStep("background_hung", 0.0599))
    at = (healthy["time_s"] > 0.0501) & (healthy["current_b_A"] > 10.0)
    begin_s = round(float(healthy["time_s"][at][25]), 6)
    faulty = recording_of(tmp_path / "faulty", FaultStep(kind, begin_s, 0.002, dict(PLANT[kind])))
    assert begin_s - 1e-9 <= first_difference_s(healthy, faulty) <= begin_s + 52e-6


def test_an_open_winding_ends_its_current_and_carries_none(tmp_path) -> None:
    """The arc takes twice the supply: the current falls by at least 2 * 240 V / aligned inductance until it is 0."""
    healthy = recording_of(tmp_path / "healthy", FaultStep("background_hung", 0.0599))
    at = (healthy["time_s"] > 0.0501) & (healthy["current_b_A"] > 15.0)
    begin_s = round(float(healthy["time_s"][at][25]), 6)
    faulty = recording_of(tmp_path / "faulty", FaultStep("winding_open", begin_s, None, {"phase": "b"}))
    start = row(faulty, begin_s)
    current_A = faulty["current_b_A"][start:]
    assert current_A[0] > 10.0
    ended = int(np.argmax(current_A == 0.0))
    assert 0 < ended < 1500
    assert not current_A[ended:].any()
    assert np.all(np.diff(current_A[: ended + 1]) < 0.0)


def test_a_locked_shaft_stands_still_and_turns_again(tmp_path) -> None:
    recording = recording_of(tmp_path, FaultStep("shaft_locked", 0.05, 0.004), bench={"held_speed_rpm": 300.0},
                             speed=())
    begin, end = row(recording, 0.05), row(recording, 0.054)
    assert recording["speed_rpm"][begin] == 300.0
    assert not recording["speed_rpm"][begin + 1 : end + 1].any()
    assert len(set(recording["rotor_angle_deg"][begin + 1 : end + 1])) == 1
    assert recording["speed_rpm"][end + 500] == pytest.approx(5.0, rel=1e-3), "the dynamometer accelerates it again"


@pytest.mark.parametrize(("kind", "attribute", "expected_V"), [
    ("supply_lost", {}, 0.0),
    ("supply_sagged", {"depth_percent": 25.0}, 180.0),
    ("supply_surged", {"height_percent": 25.0}, 300.0),
])
def test_the_link_follows_the_supply_for_the_duration(tmp_path, kind: str, attribute: dict, expected_V: float) -> None:
    link_V = (recording := recording_of(tmp_path, FaultStep(kind, 0.05, 0.004, attribute)))["bus_voltage_V"]
    begin, end = row(recording, 0.05), row(recording, 0.054)
    assert set(link_V[:begin]) == set(link_V[end + 1 :]) == {240.0}
    assert set(link_V[begin + 1 : end]) == {expected_V}


def test_ripple_is_a_sine_of_300_Hz(tmp_path) -> None:
    recording = recording_of(tmp_path, FaultStep("supply_ripple", 0.05, 0.01, {"amplitude_V": 12.0}))
    begin = row(recording, 0.05)
    time_s, link_V = recording["time_s"][begin:-1] - 0.05, recording["bus_voltage_V"][begin:-1]
    sine_V = 240.0 + 12.0 * np.sin(2 * np.pi * 300.0 * time_s)
    assert np.max(np.abs(link_V[1:] - sine_V[1:])) < 12.0 * 2 * np.pi * 300.0 * 11e-6  # half a step of 20 us
    assert np.max(link_V) > 251.5 and np.min(link_V) < 228.5


def measured(bench: Bench, name: str) -> float:
    bench.run_for(0.012)
    return bench.telemetry[name].last


def test_faults_of_the_sensor_of_the_link_voltage(bench: Bench) -> None:
    bench.run_for(0.02)
    true_V = measured(bench, "bus_voltage_V")
    assert true_V == pytest.approx(240.0, abs=0.5)
    for kind, attribute, low_V, high_V in (
        ("dc_link_sensor_open", {}, 0.0, 0.0),
        ("dc_link_sensor_low_rail", {}, 0.0, 0.0),
        ("dc_link_sensor_high_rail", {}, 300.0, 10_000.0),
        ("dc_link_sensor_gain", {"gain": 0.9}, 215.5, 216.5),
        ("dc_link_sensor_offset", {"offset_V": 20.0}, 259.5, 260.5),
        ("dc_link_sensor_stuck", {"code": 0}, 0.0, 0.0),
    ):
        fault = bench.fault(kind, **attribute)
        assert low_V <= measured(bench, "bus_voltage_V") <= high_V, kind
        assert bench.truth["bus_voltage_V"].last == 240.0
        fault.clear()
        assert measured(bench, "bus_voltage_V") == pytest.approx(true_V), kind


@pytest.mark.parametrize(("kind", "attribute", "expected_A"), [
    ("current_sensor_open", {}, (0.0, 0.0)),
    ("current_sensor_low_rail", {}, (0.0, 0.0)),
    ("current_sensor_high_rail", {}, (75.0, 1000.0)),
    ("current_sensor_stuck", {"code": 1024}, (19.9, 20.1)),
    ("current_sensor_gain", {"gain": 0.5}, (4.9, 5.1)),
    ("current_sensor_offset", {"offset_A": 15.0}, (24.9, 25.1)),
    ("current_sensor_swapped", {"with_phase": "c"}, (9.9, 10.1)),
])
def test_one_current_sensor_errs_and_the_others_do_not(bench: Bench, kind: str, attribute: dict, expected_A: tuple
                                                       ) -> None:
    """All sensors read 10 A at standstill by the offset that the bench gives to all."""
    bench.rig.current_sensor_offset_A = 10.0
    bench.run_for(0.02)
    with_fault = bench.fault(kind, phase="b", **attribute)
    bench.run_for(0.012)
    for phase in "ac":
        assert bench.telemetry[f"current_{phase}_A"].last == pytest.approx(10.0, abs=0.1)
    assert expected_A[0] <= bench.telemetry["current_b_A"].last <= expected_A[1]
    with_fault.clear()
    bench.run_for(0.012)
    assert bench.telemetry["current_b_A"].last == pytest.approx(10.0, abs=0.1)


def test_swapped_sensors_show_each_other_s_phase(bench: Bench) -> None:
    bench.fault("current_sensor_offset", phase="a", offset_A=5.0)
    bench.fault("current_sensor_offset", phase="c", offset_A=20.0)
    bench.fault("current_sensor_swapped", phase="a", with_phase="c")
    bench.run_for(0.02)
    shown = [bench.telemetry[f"current_{phase}_A"].last for phase in "abc"]
    assert shown == pytest.approx([20.0, 0.0, 5.0], abs=0.1)


def encoder_error_deg(bench: Bench) -> float:
    """Deviation of the drive's angle from the true one, -180 to 180 deg, of the same instants to 0.1 deg."""
    bench.rig.truth_period_us = 25
    bench.run_for(0.012)
    angle, truth = bench.telemetry["rotor_angle_deg"], bench.truth["rotor_angle_deg"]
    true_deg = np.interp(angle.time_s[-1], truth.time_s, np.unwrap(truth.value, period=360.0))
    return float((angle.last - true_deg + 180.0) % 360.0 - 180.0)


@pytest.mark.parametrize(("kind", "attribute", "low_deg", "high_deg"), [
    ("encoder_jump", {"angle_deg": 30.0}, 29.0, 31.0),
    ("encoder_jump", {"angle_deg": -30.0}, -31.0, -29.0),
    ("encoder_slip", {"slip_deg_s": 200.0}, 19.0, 25.0),
    ("encoder_lost_counts", {"counts_per_turn": 20_000}, -6.5, -5.0),
    ("encoder_stuck", {}, -45.0, -37.0),
    ("encoder_reversed", {}, -90.0, -74.0),
])
def test_the_encoder_s_reading_departs_from_the_angle_as_stated(bench: Bench, kind: str, attribute: dict,
                                                                low_deg: float, high_deg: float) -> None:
    """The shaft turns by 360 deg/s for 0.112 s: by 40.3 deg, of which 0 to 3 deg are not in the last frame."""
    bench.held_speed_rpm = 60.0
    bench.run_for(0.1)
    assert encoder_error_deg(bench) == pytest.approx(0.0, abs=0.5)
    with_fault = bench.fault(kind, **attribute)
    bench.run_for(0.1)
    assert low_deg <= encoder_error_deg(bench) <= high_deg
    with_fault.clear()
    assert encoder_error_deg(bench) == pytest.approx(0.0, abs=0.5)


@pytest.mark.bench_options(controller="traditional", initial_angle_deg=77.0)
def test_an_encoder_that_is_stuck_before_the_start_shows_the_angle_of_the_start(bench: Bench) -> None:
    bench.fault("encoder_stuck")
    bench.held_speed_rpm = 60.0
    bench.run_for(0.1)
    assert bench.telemetry["rotor_angle_deg"].last == pytest.approx(77.0, abs=0.1)
    assert bench.truth["rotor_angle_deg"].last > 100.0


def test_a_dropped_load_is_off_the_shaft_for_the_duration(tmp_path) -> None:
    recording = recording_of(tmp_path, FaultStep("load_dropped", 0.05, 0.004), load=(LoadStep(0.04, 5.0),))
    begin, end = row(recording, 0.05), row(recording, 0.054)
    load_Nm = recording["load_torque_Nm"]
    assert set(load_Nm[:begin]) == set(load_Nm[end + 1 :]) == {5.0}
    assert not load_Nm[begin + 1 : end].any()


def test_lost_interrupts_and_a_hung_background_are_seen_in_the_drive(bench: Bench) -> None:
    """The drive counts lost triggers by the frames that its background sends; a hung background sends none, here
    for less than the watchdog's time."""
    bench.run_for(0.02)
    frames = bench.telemetry.count("DRIVE_STATUS")
    bench.fault("background_hung", duration_s=0.016)
    bench.run_for(0.0159)
    assert bench.telemetry.count("DRIVE_STATUS") - frames <= 1
    bench.run_for(0.02)
    assert bench.telemetry.count("DRIVE_STATUS") > frames + 1
    bench.fault("interrupt_lost", duration_s=0.001)
    bench.run_for(0.02)
    assert bench.telemetry["skipped_periods"].last >= 39 or bench.drive.fault == "interrupt_overrun"


# --- Several at once, errors, determinism ---


def test_several_faults_are_present_together_and_end_each_by_itself(bench: Bench) -> None:
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.02)
    first = bench.fault("switch_open", phase="a", leg="low")
    bench.fault("switch_open", phase="a", leg="high")
    bench.fault("current_sensor_gain", phase="c", gain=0.5)
    bench.run_for(0.001)
    first.clear()
    bench.clear_fault("current_sensor_gain", phase="c")
    table = {name: bench.truth[f"RIG_TRUTH_FAULT.{name}"].value for name in ("kind", "phase", "leg", "present")}
    assert [list(map(int, column)) for column in table.values()] == [
        [2, 2, 14, 2, 14], [0, 0, 2, 0, 2], [0, 1, 0, 0, 0], [1, 1, 1, 0, 0]]


@pytest.mark.parametrize(("kind", "arguments", "text"), [
    ("winding_opened", {}, "no fault 'winding_opened'; the nearest of .* are winding_open, [a-z_]+, [a-z_]+$"),
    ("winding_open", {}, "winding_open: phase missing: must be a, b, c, d, e or f"),
    ("winding_open", {"phase": "g"}, "winding_open: phase 'g': must be a, b, c, d, e or f"),
    ("winding_open", {"phase": "d"}, "winding_open d: no_such_place, a phase that the machine does not have"),
    ("winding_open", {"phase": "a", "leg": "low"}, "winding_open has no leg; it has phase"),
    ("switch_open", {"phase": "a", "leg": "top"}, "leg 'top': must be high or low"),
    ("encoder_stuck", {"gain": 1}, "encoder_stuck has no gain; it has no place and no attribute"),
    ("current_sensor_gain", {"phase": "a"}, "gain missing: must be 0 to 10"),
    ("current_sensor_gain", {"phase": "a", "gain": 11}, "gain 11: must be 0 to 10"),
    ("current_sensor_gain", {"phase": "a", "gain": float("nan")}, "gain nan: must be 0 to 10"),
    ("current_sensor_swapped", {"phase": "a", "with_phase": "d"}, "current_sensor_swapped a: no_such_place, a phase"),
    ("chopper_open", {}, "chopper_open: unsupported"),
])
def test_what_does_not_exist_is_an_error_that_names_what_does(bench: Bench, kind: str, arguments: dict, text: str
                                                              ) -> None:
    with pytest.raises(FaultError, match=text):
        bench.fault(kind, **arguments)
    assert len(bench.truth["RIG_TRUTH_FAULT.kind"]) == 0


def test_a_fault_in_the_past_is_refused_and_at_most_64_changes_wait(bench: Bench) -> None:
    bench.run_for(0.01)
    with pytest.raises(FaultError, match="in_the_past"):
        bench.at(0.005).fault("encoder_stuck")
    for index in range(64):
        bench.at(0.02 + index * 1e-6).fault("encoder_stuck")
    with pytest.raises(FaultError, match="queue_full"):
        bench.at(0.03).fault("encoder_stuck")


def test_equal_faults_give_identical_files(tmp_path) -> None:
    faults = (FaultStep("encoder_noise", 0.01, 0.02, {"deviation_deg": 0.1}),
              FaultStep("winding_shorted", 0.02, 0.01, {"phase": "a", "turns_percent": 5.0}),
              FaultStep("switch_open", 0.0251, 0.003, {"phase": "b", "leg": "low"}),
              FaultStep("supply_ripple", 0.01, None, {"amplitude_V": 10.0}))
    contents = []
    for name in ("one", "two"):
        scenario = Scenario(name="faults", duration_s=0.04, controller="salient", fault=faults,
                            speed=(SpeedStep(0.0, 300.0),), record=Record(step_us=10.0))
        run_scenario(scenario, tmp_path / name)
        contents.append([(tmp_path / name / file).read_bytes() for file in ("can.blf", "can.log", "recording.npy")])
    assert contents[0] == contents[1]
