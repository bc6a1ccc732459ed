"""The image of the board in the model of its part is bit-identical with the host executable of the same clock.

Compared are the recorded true state (currents, flux linkages, speed and torque) and the CAN frames with their times, as
salient.experiments.board_same_bits has them.
"""

from __future__ import annotations

import contextlib

import pytest
from test_same_bits import load_step_150, start_600

from salient.bench import programs
from salient.bench.drive import DriveError
from salient.config import CONTROLLERS
from salient.experiments.board_same_bits import board_hashes, pair

CLOCKS = (programs.BOARD_CLOCK_MHZ, pytest.param(170, marks=pytest.mark.in_turns))
"""Clocks of the processor and the PWM timer: whole nanoseconds a tick, and the board's own, a tick of 5.88 ns."""


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("run", [start_600, load_step_150])
@pytest.mark.parametrize("clock_mhz", CLOCKS)
def test_image_and_host_agree_in_frames_and_true_state(make_bench, monkeypatch, tmp_path, clock_mhz, run, controller):
    made = []
    monkeypatch.setattr(programs, "BOARD_CLOCK_MHZ", clock_mhz)
    for number, options in enumerate(pair(clock_mhz)):
        recording = tmp_path / f"{number}.npy"
        bench = make_bench(can=f"unix:{tmp_path}/{number}.sock", record=recording, record_step_ns=10_000,
                           controller=controller, telemetry_period_ms=4, seed=3, initial_angle_deg=12.0, **options)
        run(bench)
        frames = [(time, message.arbitration_id, bytes(message.data)) for time, message in bench.log]
        speed_rpm = bench.truth["speed_rpm"].last
        bench.close()
        made.append((frames, recording.read_bytes(), speed_rpm))
    host, image = made
    assert host[2] > 100.0
    assert image[1] == host[1], "true state"
    assert len(host[0]) > 2000
    assert [pair for pair in zip(image[0], host[0], strict=True) if pair[0] != pair[1]] == []


def start_again(bench, speed_rpm: float) -> None:
    bench.drive.off()
    bench.run_for(0.02)
    bench.drive.clear_fault()
    bench.run_for(0.05)
    bench.drive.speed_reference_rpm = speed_rpm
    bench.run_for(0.05)


def faults(bench) -> list[object]:
    """Each line of STO, a bus that is off and free again, late interrupts: causes of the faults, the speed after."""
    seen: list[object] = []
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.05)
    for line in ("sto_1", "sto_2"):
        setattr(bench.rig, line, 0)
        bench.run_for(0.002)
        setattr(bench.rig, line, 1)
        bench.run_for(0.01)
        seen.append((bench.drive.state, bench.drive.fault))
        start_again(bench, 300)
        seen.append(bench.drive.state)
    bench.rig.transmit_error_counter = 256
    bench.run_for(0.3)
    seen.append((bench.drive.state, bench.drive.fault))
    start_again(bench, -200)
    bench.rig.interrupt_time_us = 30
    bench.run_for(0.01)
    bench.rig.interrupt_time_us = 0
    bench.run_for(0.02)
    return [*seen, (bench.drive.state, bench.drive.fault), round(bench.truth["speed_rpm"].last, 3)]


def power_cuts(bench) -> list[object]:
    """Power fails at operations of a write of parameters: the set that the next start has."""
    bench.rig.truth_period_us = 0
    parameters = bench.drive.parameters
    parameters.save()
    seen: list[object] = []
    for operation in range(1, 40, 4):
        parameters["over_speed_rpm"] = parameters.row("over_speed_rpm").minimum + 10 + operation
        bench.rig.memory_cut_kind = operation // 4 % 3
        bench.rig.memory_cut_operation = operation
        with contextlib.suppress(DriveError):  # of a drive that has started again and stores nothing
            parameters.save()
        bench.run_for(0.02)
        bench.rig.memory_cut_operation = 0
        bench.rig.drive_reset = 1
        bench.run_for(0.02)
        seen.append((operation, parameters["over_speed_rpm"], bench.drive.state))
    return seen


@pytest.mark.in_turns
@pytest.mark.parametrize("run", [faults, power_cuts])
def test_image_and_host_meet_faults_and_power_cuts_alike(make_bench, tmp_path, run):
    made = []
    for number, options in enumerate(pair(programs.BOARD_CLOCK_MHZ)):
        recording = tmp_path / f"{number}.npy"
        bench = make_bench(can=f"unix:{tmp_path}/{number}.sock", record=recording, record_step_ns=10_000,
                           telemetry_period_ms=4, seed=5, **options)
        seen = run(bench)
        bench.close()
        made.append((seen, recording.read_bytes()))
    assert made[1][0] == made[0][0]
    if run is faults:  # the first answers after a restart come a control period apart
        assert made[1][1] == made[0][1], "true state"
    assert len({str(each) for each in made[0][0]}) > 2


@pytest.mark.in_turns
@pytest.mark.parametrize("seed", [
    1324,  # STO falls, the watchdog resets the drive, STO rises: its cause is named
    1443,  # a reset ends bus-off
    3585,  # a frame ends on the bus in the control period in which the drive goes bus-off
    5641,  # a drift is found by a second clock with steps
    7077,  # a pulse of STO within a control period
    13272,  # a fault is logged before the background hangs: its words are no kick of the watchdog
    6412,  # a temperature sensor recovers while the temperatures are converted, after a reset
])
def test_worlds_of_the_campaign_are_equal_to_the_bit(seed):
    hashes = board_hashes(seed)
    assert hashes["on_target"] == hashes["bench"]
    assert hashes["frames_on_target"] == hashes["frames_bench"] > 1000
