"""The firmware is bit-identical on the host, the Cortex-M4, RV32 and in WebAssembly, in every control period.

Compared are the compare values of every control period, every CAN frame with its time, and the recorded true state.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

from salient.bench.bench import Bench
from salient.config import CONTROLLERS, TARGET_BUILDS, TARGETS, WASM_BUILD
from salient.paths import BUILD, ROOT
from salient.paths import MACHINES as MACHINE_FILES

MACHINES = ("saturating", "linear_cosine", "linear_trapezoid", "finite_element")
ALL = (*TARGETS, WASM_BUILD)
BUILDS = {"saturating": (*TARGET_BUILDS, WASM_BUILD), "linear_cosine": ALL[1:], "linear_trapezoid": ALL[1:],
          "finite_element": (*TARGET_BUILDS, WASM_BUILD)}
"""Builds of a machine: every optimisation level with three and with four phases; a table changes no code but constants,
which the linked -O2 builds fold."""
ROW_BYTES = 24
"""Columns of recorded compare values: two for each of six phases."""


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


def start_of_any_machine(bench: Bench) -> None:
    """To a quarter of the speed limit, a load step of a third of the torque; then backwards, if the controller can."""
    rows = bench.drive.parameters.rows
    bench.at(0.3).load_torque_Nm = rows["torque_max_Nm"].default / 3.0
    bench.drive.speed_reference_rpm = rows["over_speed_rpm"].default / 4.0
    bench.run_for(0.4)
    bench.drive.speed_reference_rpm = -rows["over_speed_rpm"].default / 8.0
    bench.run_for(0.1)


COMMON_RUNS = {run.__name__: run for run in (start_600, load_step_150, tour)}
RUNS = COMMON_RUNS | {start_of_any_machine.__name__: start_of_any_machine}


@dataclass(frozen=True)
class Trace:
    """Recorded behaviour of a drive in a run."""

    compare_values: bytes
    frames: list
    true_state: bytes

    @property
    def periods(self) -> int:
        """Number of control periods."""
        return len(self.compare_values) // ROW_BYTES


@pytest.fixture
def traces(make_bench, tmp_path: Path) -> Callable[..., dict[str, Trace]]:
    """Recorded behaviour in a run, by build; builds run in parallel."""

    def trace(name: str, number: int, **options) -> Trace:
        switches, recording = tmp_path / f"{number}.switches", tmp_path / f"{number}.npy"
        bench = make_bench(can=f"unix:{tmp_path}/{number}.sock", record=recording, record_step_ns=10_000,
                           record_switches=switches, **options)
        RUNS[name](bench)
        frames = [(time, message.arbitration_id, message.is_extended_id, bytes(message.data))
                  for time, message in bench.log]
        bench.close()
        return Trace(switches.read_bytes(), frames, recording.read_bytes())

    def run(builds: Sequence[str], name: str, **options) -> dict[str, Trace]:
        # Each drive is a separate process in virtual time, so parallel runs cannot influence each other.
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            made = pool.map(lambda each: trace(name, each[0], build=each[1], **options), enumerate(builds))
            return dict(zip(builds, made, strict=True))

    return run


@pytest.mark.in_turns
@pytest.mark.parametrize("machine", MACHINES)
@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("name", COMMON_RUNS)
def test_host_and_targets_agree_in_every_control_period(traces, request, name, controller, machine):
    made = traces(("host", *BUILDS[machine]), name, controller=controller, machine=machine, seed=3,
                  initial_angle_deg=12.0)
    host = made["host"]
    assert 15_000 < host.periods < 30_000
    assert any(host.compare_values)  # the drive switched
    for build in BUILDS[machine]:
        assert made[build].periods == host.periods
        for what in ("compare_values", "frames", "true_state"):
            assert getattr(made[build], what) == getattr(host, what), f"{build}: {what} differ"
    request.node.user_properties.append(("control_periods", host.periods * len(BUILDS[machine])))


@pytest.mark.in_turns
@pytest.mark.parametrize("board", [{"adc_bits": 16, "encoder_edges": True}, {"encoder_bits": 0, "immediate_pwm": True},
                                   {"control_rate_hz": 100_000, "encoder_bits": 24}])
def test_other_board_options_agree_on_host_and_targets(traces, board):
    made = traces(ALL, "load_step_150", controller="salient", **board)
    for build in ALL:
        assert made[build] == made["host"], build


def machine_file(folder: Path, stem: str, inertia: float) -> Path:
    text = (MACHINE_FILES / "linear_cosine.toml").read_text(encoding="utf-8")
    assert "inertia_kg_m2 = 0.02" in text
    path = folder / f"{stem}.toml"
    path.write_text(text.replace("inertia_kg_m2 = 0.02", f"inertia_kg_m2 = {inertia}"), encoding="utf-8")
    return path


@pytest.mark.in_turns
def test_machine_file_of_the_user_agrees_on_host_and_targets(traces, tmp_path):
    """The host reads the tables, in the targets they are compiled in; the file has the name of another machine."""
    made = traces(ALL, "start_600", machine=str(machine_file(tmp_path, "saturating", 0.013)))
    bundled = traces(["host"], "start_600", machine="linear_cosine")["host"]
    for build in ALL:
        assert made[build] == made["host"], build
    assert made["host"].compare_values != bundled.compare_values


@pytest.mark.in_turns
@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("name", ["smallest", "largest", "fastest", "five_phases", "six_phases"])
def test_machine_at_the_end_of_the_range_agrees_on_host_and_targets(traces, name, controller):
    """Machines whose formats have other units or which have more phases, compiled in."""
    file = ROOT / "tests" / "machines" / f"{name}.toml"
    made = traces(ALL, "start_of_any_machine", machine=str(file), controller=controller, seed=3)
    assert any(made["host"].compare_values)
    for build in ALL:
        assert made[build] == made["host"], build


@pytest.mark.in_turns
def test_processes_that_build_firmware_for_machine_files_at_once_do_not_collide(tmp_path):
    """Each of two files by two processes, one build per file."""
    files = [machine_file(tmp_path, name, inertia) for name, inertia in (("my light", 0.01), ("my heavy", 0.03))]
    code = "import sys; from salient.bench.programs import image; print(image(sys.argv[1], 'cortex-m4'))"
    processes = [subprocess.Popen([sys.executable, "-c", code, file], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                                  text=True) for file in files * 2]
    outputs = [process.communicate() for process in processes]
    assert [process.returncode for process in processes] == [0] * 4, outputs
    images = [Path(output.strip()) for output, _ in outputs]
    assert images[:2] == images[2:] and images[0].parents[2] != images[1].parents[2]
    assert all(made.is_file() and made.is_relative_to(BUILD) for made in images)
    assert [sum("building the firmware for" in errors for _, errors in outputs[at::2]) for at in (0, 1)] == [1, 1]


@pytest.mark.in_turns
def test_different_seeds_give_different_runs(traces):
    """Shows that the comparison above can fail."""
    first, second = (traces(["cortex-m4"], "tour", controller="paper", seed=seed)["cortex-m4"] for seed in (1, 2))
    assert first.compare_values != second.compare_values
    assert first.frames != second.frames
    assert first.true_state != second.true_state
