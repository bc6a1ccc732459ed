"""Arming in two steps over the bus: what arms a drive, and the recordings and second senders that do not. [SR-34]"""

from __future__ import annotations

import can
import pytest

from salient.bench.arming import arm_frame, response_to
from salient.bench.drive import command_frame, torque_command_frame
from salient.bus.clock import open_bus

COMMAND_IDS = (0x080, 0x081)
ARM_ID = 0x082


def sent(bench, *identifiers: int) -> list[tuple[int, can.Message]]:
    """Frames of a host on the bus so far, with their times."""
    return [(time_ns, message) for time_ns, message in bench.log
            if message.arbitration_id in identifiers and not message.is_extended_id]


def replay(bench, frames: list[tuple[int, can.Message]]) -> None:
    """The frames again, at the same distances."""
    begin_ns, first_ns = bench.time_ns, frames[0][0]
    for time_ns, message in frames:
        bench.advance_to(begin_ns + time_ns - first_ns)
        bench.send(message)


def recording(bench) -> list[tuple[int, can.Message]]:
    """A start as its host sends it, 50 ms long."""
    bench.run_for(0.0113)
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.05)
    assert bench.drive.state == "run"
    frames = sent(bench, *COMMAND_IDS, ARM_ID)
    assert len([m for _, m in frames if m.arbitration_id == ARM_ID]) == 2
    return frames


def expect_standstill(bench, duration_s: float) -> None:
    begin_s = bench.time_s
    bench.run_for(duration_s)
    states = bench.telemetry["DRIVE_STATUS.state"].between(begin_s, bench.time_s)
    assert {states.choices[int(value)] for value in states.value} == {"ready"}
    assert abs(bench.truth["speed_rpm"].last) < 1


@pytest.mark.both_transports
def test_sequence_in_raw_frames_starts_the_drive(bench):
    """The sequence of the CAN page."""
    challenge = bench.telemetry

    def commands(number: int) -> None:
        for _ in range(number):
            bench.send(command_frame(commands.counter % 256, "run", 300))
            commands.counter += 1
            bench.run_for(0.01)

    commands.counter = 0
    commands(2)
    assert bench.drive.state == "ready"
    bench.send(arm_frame(17, "request_run"))
    commands(1)
    assert challenge["DRIVE_ARMING.attempt"].last_name == "run"
    bench.send(arm_frame(18, "confirm_run", response_to(int(challenge["challenge"].last))))
    commands(30)
    assert (bench.drive.state, challenge["DRIVE_ARMING.armed"].last_name) == ("run", "yes")
    assert bench.truth["speed_rpm"].last == pytest.approx(300, abs=3)


def test_recording_of_a_start_does_not_start_it_again(bench):
    frames = recording(bench)
    bench.drive.off()
    bench.drive.silence()
    bench.run_until(lambda: abs(bench.truth["speed_rpm"].last) < 0.5, timeout=10, step_s=0.05)
    for distance_s in (0.1, 0.7):
        bench.run_for(distance_s)
        begin_s = bench.time_s
        replay(bench, frames)
        bench.run_for(0.05)
        states = bench.telemetry["DRIVE_STATUS.state"].between(begin_s, bench.time_s)
        assert set(states.value) == {1.0}
    expect_standstill(bench, 0.1)
    assert bench.telemetry["DRIVE_ARMING.refused"].last >= 2


@pytest.mark.parametrize(("seed", "delay_s"), [(2, 0.0113), (1, 0.0114), (1, 0.03)])
def test_recording_does_not_start_another_drive(make_bench, seed, delay_s):
    """The emulated random number generator repeats with the same seed at the same instants only."""
    frames = recording(make_bench())
    other = make_bench(seed=seed)
    other.run_for(delay_s)
    replay(other, frames)
    expect_standstill(other, 0.1)


def test_one_frame_after_a_silence_does_not_start_it(bench):
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.1)
    bench.drive.silence()
    bench.run_for(0.6)
    assert bench.drive.fault == "command_timeout"
    bench.drive.clear_fault()
    bench.drive.silence()
    bench.run_until(lambda: abs(bench.truth["speed_rpm"].last) < 0.5, timeout=10, step_s=0.05)
    for counter in range(100, 120):
        bench.send(command_frame(counter, "run", 600))
        bench.run_for(0.01)
    assert bench.drive.state == "ready"
    expect_standstill(bench, 0.1)


# [SR-35] [SR-42]
def test_drive_that_a_fault_has_disarmed_waits_for_a_new_request(bench):
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.1)
    bench.rig.encoder_fault = 2
    bench.run_for(0.02)
    assert bench.drive.fault == "encoder"
    bench.rig.encoder_fault = 0
    bench.run_for(0.2)
    assert not bench.drive.armed
    bench.drive.clear_fault()
    bench.run_for(0.05)
    assert bench.drive.state == "ready"
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.02)
    assert (bench.drive.state, bench.drive.armed) == ("run", True)
    bench.drive.stop()
    bench.run_until(lambda: bench.drive.state == "ready", timeout=2)
    bench.run_for(0.01)
    assert not bench.drive.armed


SECOND_SENDERS = {"1 kHz": 0.001, "the same rate": 0.01, "slower": 0.07}


# [SR-36]
@pytest.mark.parametrize("period_s", SECOND_SENDERS.values(), ids=SECOND_SENDERS)
@pytest.mark.parametrize("frame", [command_frame, torque_command_frame], ids=["speed", "torque"])
def test_second_sender_ends_the_run_and_does_not_take_over(bench, period_s, frame):
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.1535)
    begin_s, reference = bench.time_s, -3000 if frame is command_frame else -19
    for number in range(60):
        bench.send(frame((100 + number) % 256, "run", reference))
        bench.run_for(period_s)
        if bench.drive.state == "fault":
            break
    assert bench.drive.fault == "command_error"
    assert number < 8
    motion = bench.truth["speed_rpm"].between(begin_s, bench.time_s)
    # After the fault it coasts for a period of the second sender at most, 7 % slower.
    assert 550 < motion.value.min() <= motion.value.max() < 605


# [SR-36]
def test_three_recorded_frames_beside_the_living_sender_end_the_run(bench):
    bench.drive.speed_reference_rpm = -900
    bench.run_for(0.2)
    recorded = sent(bench, *COMMAND_IDS)[:3]
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.3)
    begin_s = bench.time_s
    with open_bus(bench.address) as attacker:
        for _ in range(5):
            for _, message in recorded:
                attacker.send(message)
                bench.run_for(0.003)
    assert bench.drive.fault == "command_error"
    assert bench.truth["speed_rpm"].between(begin_s, bench.time_s).value.min() > 500


# [SR-04] [SR-05]
def test_torque_ramps_to_zero_without_commands_and_the_gates_open_after_half_a_second(bench):
    bench.rig.held_speed_rpm = 300
    bench.drive.torque_reference_Nm = 8
    bench.run_for(0.1)
    bench.drive.silence()
    bench.run_for(0.7)
    last_s = sent(bench, *COMMAND_IDS)[-1][0] / 1e9

    def torque_Nm(from_s: float, to_s: float) -> float:
        return float(bench.truth["torque_Nm"].between(last_s + from_s, last_s + to_s).value.mean())

    assert torque_Nm(0.02, 0.05) == pytest.approx(8, abs=0.3)
    assert torque_Nm(0.09, 0.11) == pytest.approx(4, abs=0.4)
    assert torque_Nm(0.155, 0.5) == pytest.approx(0, abs=0.05)
    assert bench.drive.fault == "command_timeout"
    assert bench.telemetry["DRIVE_FAULT_CAUSE.time_us"].last / 1e6 - last_s == pytest.approx(0.5, abs=0.0005)


# [SR-04] [SR-05]
@pytest.mark.parametrize("reference_rpm", [450, -450])
def test_silence_during_an_acceleration_does_not_carry_the_speed_beyond_its_reference(make_bench, reference_rpm):
    bench = make_bench(controller="salient")
    bench.rig.inertia_gain = 2.0  # still at the torque limit when the ramp begins
    bench.drive.speed_reference_rpm = reference_rpm
    bench.run_for(0.03)
    bench.drive.silence()
    bench.run_for(0.4)
    assert 1.0 < abs(bench.truth["speed_rpm"].value).max() / abs(reference_rpm) < 1.15


# [SR-04] [SR-05]
@pytest.mark.parametrize(("pause_s", "fault"),
                         [(0.04, "none"), (0.2, "none"), (0.45, "none"), (0.52, "command_timeout")])
def test_run_goes_on_when_commands_come_back_within_half_a_second(bench, pause_s, fault):
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.2)
    bench.drive.silence()
    bench.run_for(pause_s)
    bench.drive.send_command()  # of the same sender, in sequence
    bench.run_for(0.3)
    assert bench.drive.fault == fault
    if fault == "none":
        assert bench.truth["speed_rpm"].last == pytest.approx(300, abs=3)
