"""The same firmware, the same bits: what the host executable and the Cortex-M4 do, control period by control period.

Compared are the compare values of every control period, every CAN frame with its time, and the recorded true state.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from salient.arguments import CONTROLLERS
from salient.bench import Bench
from salient.simulator import TARGET_BUILDS

MACHINES = ("saturating", "linear_cosine", "linear_trapezoid", "finite_element")
ROW_BYTES = 16
"""Of recorded compare values: two for each of four phases."""


def start_600(bench: Bench) -> None:
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.4)


def load_step_150(bench: Bench) -> None:
    bench.at(0.13).load_torque_Nm = 8
    bench.drive.speed_reference_rpm = 150
    bench.run_for(0.5)


def tour(bench: Bench) -> None:
    """Parameters, start, stop, start in the other direction, a burst of commands, a fault, its end, silence."""
    bench.rig.set("current_noise_A", 0.05)
    bench.drive.parameters["speed_ramp_rpm_s"] = 8000
    assert bench.drive.parameters["torque_max_Nm"] > 1
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.1)
    bench.drive.stop()
    bench.run_for(0.1)
    bench.drive.speed_reference_rpm = -200
    for _ in range(100):
        bench.drive.send_command()
    bench.run_for(0.1)
    bench.rig.encoder_fault = 2
    bench.run_for(0.02)
    assert bench.drive.fault == "encoder"
    bench.rig.encoder_fault = 0
    bench.drive.off()
    bench.drive.clear_fault()
    bench.drive.speed_reference_rpm = 100
    bench.run_for(0.05)
    bench.rig.interrupt_time_us = 30
    bench.run_for(0.01)
    bench.rig.interrupt_time_us = 0
    bench.drive.silence()
    bench.run_for(0.2)


RUNS = {run.__name__: run for run in (start_600, load_step_150, tour)}


@pytest.fixture
def trace(make_bench, tmp_path: Path) -> Callable[..., tuple]:
    """What a drive does in a run: compare values, frames, true state; and in how many control periods."""

    def run(build: str, name: str, **options) -> tuple[int, bytes, list, bytes]:
        switches, recording = tmp_path / f"{build}.switches", tmp_path / f"{build}.npy"
        bench = make_bench(build=build, record=recording, record_step_ns=10_000, record_switches=switches, **options)
        RUNS[name](bench)
        frames = [(time, message.arbitration_id, message.is_extended_id, bytes(message.data))
                  for time, message in bench.log]
        bench.close()
        rows = switches.read_bytes()
        return len(rows) // ROW_BYTES, rows, frames, recording.read_bytes()

    return run


@pytest.mark.parametrize("machine", MACHINES)
@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("name", RUNS)
def test_host_and_cortex_m4_do_the_same_in_every_control_period(trace, request, name, controller, machine):
    options = {"controller": controller, "machine": machine, "seed": 3, "initial_angle_deg": 12.0}
    host = trace("host", name, **options)
    periods = host[0]
    assert 15_000 < periods < 30_000
    assert any(host[1])  # it did switch
    for build in TARGET_BUILDS:
        target = trace(build, name, **options)
        assert target[0] == periods
        assert target[1] == host[1], f"{build}: compare values differ"
        assert target[2] == host[2], f"{build}: CAN frames differ"
        assert target[3] == host[3], f"{build}: the true state differs"
    request.node.user_properties.append(("control_periods", periods * len(TARGET_BUILDS)))


@pytest.mark.parametrize("board", [{"adc_bits": 16, "encoder_edges": True}, {"encoder_bits": 0, "immediate_pwm": True},
                                   {"control_rate_hz": 100_000, "encoder_bits": 24}])
def test_another_board_is_the_same_on_both(trace, board):
    host = trace("host", "load_step_150", controller="salient", **board)
    assert trace("cortex-m4", "load_step_150", controller="salient", **board) == host


def test_another_seed_is_another_run(trace):
    """So that the equality above says something."""
    first, second = (trace("cortex-m4", "tour", controller="paper", seed=seed) for seed in (1, 2))
    assert first[1] != second[1] and first[2] != second[2] and first[3] != second[3]
