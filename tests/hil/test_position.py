"""Position mode: moves, holding, cyclic positions, homing, limits, following error, lost commands, hostile frames."""

import math

import numpy as np
import pytest

from salient.bench.drive import DriveError, position_command_frame
from salient.bus.signals import drive_database

COUNT_DEG = 360 / 2**17
POSITION = "DRIVE_POSITION.position_deg"
STATE = "DRIVE_POSITION.position_state"


def running(make_bench, **options):
    """A bench whose drive holds its position."""
    bench = make_bench(telemetry_period_ms=1, **options)
    bench.drive.halt()
    bench.run_until(lambda: bench.drive.mode == "position", timeout=0.1)
    bench.run_for(0.02)
    return bench


def angle_deg(bench):
    """True angle over turns since the start of the record, and its times."""
    angle = bench.truth["rotor_angle_deg"]
    return np.unwrap(np.asarray(angle.value, dtype=float), period=360.0), np.asarray(angle.time_s)


def move(bench, target_deg, timeout_s=2.0):
    bench.drive.position_deg = target_deg
    bench.run_for(0.005)
    bench.run_until(lambda: bench.telemetry[STATE].last_name == "in_position", timeout=timeout_s)


@pytest.mark.parametrize("target_deg", [0.1, -7.5, 90, 1000])
def test_moves_end_in_position_with_two_counts_of_overshoot(make_bench, target_deg):
    bench = running(make_bench)
    begin_s = bench.time_s
    move(bench, target_deg)
    bench.run_for(0.1)
    angle, time_s = angle_deg(bench)
    moved = (angle - angle[0])[time_s >= begin_s] * math.copysign(1, target_deg)
    assert moved.max() <= abs(target_deg) + 2 * COUNT_DEG
    assert moved[-50:] == pytest.approx(abs(target_deg), abs=COUNT_DEG)
    assert bench.telemetry[POSITION].last == pytest.approx(target_deg, abs=2 * COUNT_DEG)
    assert (bench.drive.state, bench.drive.fault) == ("run", "none")


@pytest.mark.parametrize("bits", [10, 12, 14, 18])
def test_any_encoder_holds_within_its_count_and_a_half(make_bench, bits):
    bench = running(make_bench, encoder_bits=bits)
    move(bench, 45)
    bench.run_for(0.3)
    angle, time_s = angle_deg(bench)
    held = angle[time_s > bench.time_s - 0.2]
    assert abs(bench.telemetry[POSITION].last - 45) <= 360 / 2**bits + 0.01
    assert np.ptp(held) <= (1.5 if bits < 13 else 1.2) * 360 / 2**bits


@pytest.mark.parametrize("target_deg", [5, 30, 33.3, 45.1])
def test_a_target_between_coarse_counts_is_reached_by_a_rotor_in_its_count(make_bench, target_deg):
    """A count of 10 bits is seven times as wide as position_window_deg."""
    bench = running(make_bench, encoder_bits=10)
    move(bench, target_deg, timeout_s=0.5)
    assert abs(bench.telemetry[POSITION].last - target_deg) <= 360 / 2**10


def test_a_load_step_is_held_and_returned_from_within_a_count(make_bench):
    bench = running(make_bench)
    move(bench, 30)
    bench.run_for(0.05)
    before_deg, _ = angle_deg(bench)
    bench.load_torque_Nm = 8
    bench.run_for(0.3)
    angle, _ = angle_deg(bench)
    deviation = np.abs(angle - before_deg[-1])[len(before_deg):]
    assert COUNT_DEG < deviation.max() < 0.08
    assert deviation[-100:].max() < COUNT_DEG


def test_a_new_target_in_a_move_is_taken_over_without_a_step(make_bench):
    bench = running(make_bench)
    bench.drive.position_deg = 360
    bench.run_for(0.06)
    bench.drive.position_deg = -90
    bench.run_for(0.005)
    bench.run_until(lambda: bench.telemetry[STATE].last_name == "in_position", timeout=2.0)
    error = np.abs(bench.telemetry["DRIVE_POSITION.following_error_deg"].value)
    assert error.max() < 0.1
    assert bench.telemetry[POSITION].last == pytest.approx(-90, abs=2 * COUNT_DEG)


@pytest.mark.parametrize("cycle_ms", [1, 4, 10, 20])
def test_a_cyclic_sine_is_followed_a_cycle_later(make_bench, cycle_ms):
    bench = running(make_bench)
    bench.drive.parameters["position_cycle_ms"] = cycle_ms
    begin_s, amplitude_deg, frequency_Hz = bench.time_s, 3.4, 5.0
    while bench.time_s < begin_s + 0.6:
        time_s = bench.time_s - begin_s
        bench.drive.follow_position(amplitude_deg * min(1, 5 * time_s) * math.sin(2 * math.pi * frequency_Hz * time_s))
        bench.run_for(cycle_ms * 1e-3)
    angle, time_s = angle_deg(bench)
    angle, since_s = angle - angle[0], time_s - begin_s
    late = since_s > 0.3
    expected = amplitude_deg * np.sin(2 * math.pi * frequency_Hz * (since_s[late] - (cycle_ms + 1) * 1e-3))
    assert np.abs(angle[late] - expected).max() < 0.12


@pytest.mark.parametrize("cycle_ms", [2, 10, 20])
def test_cyclic_positions_that_come_late_or_after_a_jump_are_followed_on(make_bench, cycle_ms):
    """A ramp of 300 r/min from a place 40 degrees away, every fourth position a millisecond late: the speed stays, and
    the rotor is no further behind than a cycle and the delays."""
    bench = running(make_bench)
    bench.drive.parameters["position_cycle_ms"] = cycle_ms
    begin_s, rate_deg_s, late_s = bench.time_s, 1800.0, 0.0
    for number in range(round(0.8e3 / cycle_ms)):
        bench.drive.follow_position(40.0 + rate_deg_s * number * cycle_ms * 1e-3)
        next_s = 1e-3 if number % 4 == 3 else 0.0
        bench.run_for(cycle_ms * 1e-3 + next_s - late_s)
        late_s = next_s
    angle, time_s = angle_deg(bench)
    since_s = time_s - begin_s
    behind_s = since_s - (angle - angle[0] - 40.0) / rate_deg_s
    settled = since_s > 0.5
    assert behind_s[settled].min() > 0.8e-3 * cycle_ms
    assert behind_s[settled].max() < (cycle_ms + 4) * 1e-3
    speed_rpm = bench.truth["speed_rpm"].value[bench.truth["speed_rpm"].time_s > begin_s + 0.5]
    assert np.abs(speed_rpm - 300).max() < 45
    assert (bench.drive.state, bench.drive.fault) == ("run", "none")


@pytest.mark.parametrize("inertia_gain", [0.3, 2.0, 5.0])
def test_an_inertia_far_from_its_parameter_is_known_within_the_first_move(make_bench, inertia_gain):
    bench = running(make_bench)
    bench.rig.inertia_gain = inertia_gain
    for target_deg in (90, 1, -200):
        before_deg = angle_deg(bench)[0][-1] - angle_deg(bench)[0][0]
        begin_s = bench.time_s
        move(bench, target_deg, timeout_s=0.4)
        bench.run_for(0.05)
        angle, time_s = angle_deg(bench)
        beyond = (angle - angle[0] - target_deg)[time_s >= begin_s] * math.copysign(1, target_deg - before_deg)
        assert beyond.max() < 3 * COUNT_DEG
        assert abs(beyond[-1]) < COUNT_DEG
    assert (bench.drive.state, bench.drive.fault) == ("run", "none")


@pytest.mark.parametrize(("machine", "counts"), [("saturating", 2), ("finite_element", 20)])
def test_a_first_move_of_36_counts_shows_a_light_rotor_while_it_lasts(make_bench, machine, counts):
    """With a torque that was too little for its inertia to be found, it passed the target by 12 and by 57 counts."""
    bench = running(make_bench, machine=machine)
    bench.rig.inertia_gain = 0.3
    move(bench, 0.1)
    bench.run_for(0.1)
    angle, _ = angle_deg(bench)
    moved = angle - angle[0]
    assert 0.1 - COUNT_DEG < moved.max() < 0.1 + counts * COUNT_DEG
    assert moved[-20:] == pytest.approx(0.1, abs=1.5 * COUNT_DEG)


@pytest.mark.parametrize("machine", ["saturating", "linear_trapezoid"])
def test_a_load_step_makes_no_rotor_of_another_inertia_swing(make_bench, machine):
    """Before it has moved: with 0.3 times the parameter's it swung by 20 to 60 counts as long as it rested."""
    bench = running(make_bench, machine=machine)
    bench.rig.inertia_gain = 0.3
    bench.load_torque_Nm = 4
    bench.run_for(0.4)
    angle, time_s = angle_deg(bench)
    assert np.ptp(angle[time_s > bench.time_s - 0.1]) < 2 * COUNT_DEG
    assert (bench.drive.state, bench.drive.fault) == ("run", "none")


def test_a_client_that_ceases_is_a_stop_and_then_no_torque(make_bench):
    bench = running(make_bench)
    bench.drive.parameters["position_cycle_ms"] = 4
    for step in range(60):
        bench.drive.follow_position(0.4 * step * step / 10)
        bench.run_for(0.004)
    speed_rpm = bench.truth["speed_rpm"].last
    bench.drive.silence()
    bench.run_for(0.045)
    assert speed_rpm > 150
    assert abs(bench.truth["speed_rpm"].last) < speed_rpm / 4  # two cycles on, then braked, before the timeout of 50 ms
    bench.run_for(0.6)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "command_timeout")
    assert abs(bench.truth["speed_rpm"].last) < 1


def test_end_stops_limit_the_target(make_bench):
    bench = make_bench()
    bench.drive.parameters["position_max_rev"] = 1
    bench.drive.position_deg = 700
    bench.run_for(0.6)
    assert bench.telemetry[POSITION].last == pytest.approx(360, abs=2 * COUNT_DEG)
    assert bench.telemetry["DRIVE_POSITION.target_limited"].last == 1


def test_reversed_end_stops_are_refused(make_bench):
    bench = make_bench()
    with pytest.raises(DriveError, match="position_min_rev"):
        bench.drive.parameters.update({"position_min_rev": 5, "position_max_rev": -5})


@pytest.mark.parametrize(("method", "expected_deg"), [(0, 0.0), (1, 360.0), (2, 0.0)])
def test_homing_calls_its_place_the_position(make_bench, method, expected_deg):
    bench = running(make_bench)
    move(bench, 100)
    bench.drive.parameters["homing_method"] = method
    bench.drive.home(25)
    bench.run_for(2.0)
    angle, _ = angle_deg(bench)
    expected_deg = 100.0 if method == 0 else expected_deg
    assert angle[-1] - angle[0] == pytest.approx(expected_deg, abs=2 * COUNT_DEG)
    assert bench.telemetry[POSITION].last == pytest.approx(25, abs=2 * COUNT_DEG)
    assert bench.telemetry["DRIVE_POSITION.homed"].last == 1
    move(bench, 35)
    angle, _ = angle_deg(bench)
    assert angle[-1] - angle[0] == pytest.approx(expected_deg + 10, abs=3 * COUNT_DEG)


def test_homing_ends_at_a_held_shaft_with_its_torque_limit(make_bench):
    bench = running(make_bench)
    bench.drive.parameters.update({"homing_method": 3, "homing_torque_Nm": 2.5})
    bench.held_speed_rpm = 0
    begin_s = bench.time_s
    bench.drive.home(10)
    bench.run_for(0.5)
    assert bench.telemetry["DRIVE_POSITION.homed"].last == 1
    assert bench.telemetry[POSITION].last == pytest.approx(10, abs=0.01)
    torque = bench.telemetry["DRIVE_TORQUE.torque_reference_Nm"].between(begin_s + 0.01, bench.time_s).value
    assert np.abs(torque).max() <= 2.52
    assert bench.drive.state == "run"


def test_a_following_error_is_a_stop_that_a_halt_acknowledges(make_bench):
    bench = running(make_bench)
    bench.drive.parameters["following_error_deg"] = 2
    bench.load_torque_Nm = 30  # beyond the drive's torque
    bench.run_until(lambda: bench.telemetry[STATE].last_name == "following_error", timeout=0.2)
    bench.load_torque_Nm = 0
    bench.drive.position_deg = 90
    bench.run_for(0.3)
    assert bench.telemetry[STATE].last_name == "following_error"
    assert abs(bench.truth["speed_rpm"].last) < 1
    bench.drive.halt()
    bench.run_for(0.02)
    move(bench, 90)
    assert bench.drive.state == "run"


def test_modes_change_in_a_run(make_bench):
    bench = running(make_bench)
    bench.drive.speed_reference_rpm = 200
    bench.run_for(0.2)
    assert (bench.drive.mode, bench.truth["speed_rpm"].last) == ("speed", pytest.approx(200, abs=2))
    move(bench, 0)
    assert bench.drive.mode == "position"
    bench.drive.torque_reference_Nm = 1
    bench.run_for(0.02)
    assert bench.drive.mode == "torque"
    bench.drive.stop()
    bench.run_until(lambda: bench.drive.state == "ready", timeout=1.0)


@pytest.mark.parametrize("controller", ["traditional", "paper"])
def test_a_controller_of_one_quadrant_stands(make_bench, controller):
    bench = make_bench(controller=controller)
    bench.drive.position_deg = 90
    bench.run_for(0.3)
    assert (bench.drive.state, bench.drive.mode) == ("run", "speed")
    assert abs(bench.truth["speed_rpm"].last) < 1


def test_extreme_and_invalid_frames_are_safe(make_bench):
    bench = running(make_bench)
    with pytest.raises(DriveError, match="position_deg"):
        bench.drive.position_deg = 3e6
    message = drive_database().get_message_by_name("DRIVE_POSITION_COMMAND")
    low, high = message.get_signal_by_name("position_deg").minimum, message.get_signal_by_name("position_deg").maximum
    bench.drive.parameters["over_speed_rpm"]  # readable in a run
    counter = 1
    bench.drive.halt()
    begin_s = bench.time_s
    for order in ("cyclic", "profile", "home", "halt") * 6:
        for target in (low, high):
            bench.drive._order_position(order, target)
            bench.run_for(0.003)
    assert bench.drive.state == "run"
    speed = np.abs(bench.truth["speed_rpm"].between(begin_s, bench.time_s).value)
    assert speed.max() < 3200
    rejected = bench.telemetry["DRIVE_COMMAND_COUNTERS.wrong_checksum"].last
    frame = position_command_frame(counter, "run", "profile", 0)
    frame.data[7] ^= 1
    bench.send(frame)
    bench.run_for(0.15)
    assert bench.telemetry["DRIVE_COMMAND_COUNTERS.wrong_checksum"].last == rejected + 1


def test_sto_in_a_move_is_its_fault(make_bench):
    bench = running(make_bench)
    bench.drive.position_deg = 3600
    bench.run_for(0.1)
    bench.rig.sto_1 = 1
    bench.run_for(0.1)
    assert bench.drive.state == "fault"
    assert bench.drive.fault.startswith("sto")
