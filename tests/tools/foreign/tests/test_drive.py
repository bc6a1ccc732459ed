"""Duties of every drive here. Without --salient-program: the one that comes with the package."""

import pytest


@pytest.mark.bench_options(controller="traditional")
def test_drive_reaches_its_speed(bench):
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.2)
    assert 594 < bench.truth["speed_rpm"].last < 606


@pytest.mark.bench_options(controller="traditional")
def test_load_is_compensated(bench):
    bench.drive.speed_reference_rpm = 150
    bench.at(0.13).load_torque_Nm = 8
    bench.run_for(0.4)
    assert 147 < bench.truth["speed_rpm"].last < 153


@pytest.mark.bench_options(controller="traditional")
def test_torque_stays_within_its_limit(bench):
    bench.drive.parameters["torque_max_Nm"] = 5
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.05)
    reference = bench.telemetry["torque_reference_Nm"].value
    assert 4.9 < reference.max() <= 5.01


def test_lost_encoder_stops_the_drive(bench):
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.1)
    bench.rig.encoder_fault = 1
    bench.run_until(lambda: bench.drive.state == "fault", timeout=0.1)
    assert bench.drive.fault == "encoder"


def test_drive_stops_when_commands_stop(bench):
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.1)
    bench.drive.silence()
    bench.run_until(lambda: bench.drive.state == "fault", timeout=0.6)
    assert bench.drive.fault == "command_timeout"


def test_equal_seeds_give_equal_runs(make_bench):
    benches = [make_bench(seed=3) for _ in range(2)]
    for bench in benches:
        bench.rig.current_noise_A = 0.05
        bench.drive.speed_reference_rpm = 300
        bench.run_for(0.05)
    logs = [[(time_ns, bytes(frame.data)) for time_ns, frame in bench.log] for bench in benches]
    assert logs[0] == logs[1]
