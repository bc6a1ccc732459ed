"""Memory of the drive on a target: power cuts with the firmware compiled for the Cortex-M4, and a reset in QEMU."""

from __future__ import annotations

import subprocess

import pytest

from salient.config import TARGETS
from salient.paths import BUILD

IMAGE = BUILD / "cortex-m4" / "bin" / "power_cuts.elf"


@pytest.mark.in_turns
def test_power_cut_at_every_operation_loses_and_mixes_nothing_on_the_cortex_m4():
    """A page of sets and of faults and the first write that erases; every pair of cuts of that one."""
    command = ["qemu-system-arm", "-nodefaults", "-display", "none", "-nic", "none", "-machine", "mps2-an386",
               "-semihosting-config", "enable=on,target=native", "-bios", "none", "-kernel", IMAGE]
    result = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL, check=True)
    numbers = [int(word) for word in result.stderr.splitlines()[-1].split()]
    for what, (cuts, pairs, *wrong) in zip(("sets", "faults"), (numbers[:5], numbers[5:]), strict=True):
        print(f"{what}: {cuts} single cuts, {pairs} pairs of cuts, {wrong[0]} losses, {wrong[1]} mixed")
        assert wrong == [0, 0, 0]
        assert cuts > 900 and pairs > 1000


@pytest.mark.in_turns
@pytest.mark.parametrize("build", TARGETS[1:])
def test_reset_keeps_the_memory_and_sends_the_frames_of_the_host(make_bench, build: str):
    logs = []
    for used in ("host", build):
        bench = make_bench(build=used)
        bench.drive.parameters["over_speed_rpm"] = 1234
        bench.drive.parameters.save()
        bench.drive.parameters["over_speed_rpm"] = 2000
        bench.rig.drive_reset = 1
        bench.run_for(0.02)
        assert bench.drive.parameters["over_speed_rpm"] == 1234
        bench.drive.speed_reference_rpm = 300
        bench.run_for(0.05)
        logs.append([(time, message.arbitration_id, bytes(message.data)) for time, message in bench.log])
        assert bench.drive.state == "run"
    assert logs[0] == logs[1]
