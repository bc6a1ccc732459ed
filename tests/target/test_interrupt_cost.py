"""What a control interrupt costs on the Cortex-M4, and that it is one: counted by QEMU, the same on every computer."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from salient.arguments import CONTROLLERS
from salient.interrupt_cost import measure
from salient.simulator import SimulatorOptions

TIMEOUT_S = 60
CONTROL_EXCEPTION = 16 + 31


def test_equal_runs_take_equal_instructions():
    first, second = (measure("salient") for _ in range(2))
    assert (first.interrupts == second.interrupts).all()
    assert first.execution.by_part() == second.execution.by_part()


LAWS = {
    "traditional": {"speed_pi", "ditc_hysteresis"},
    "paper": {"speed_smc", "bp_pid", "bp_network", "ditc_duty"},
    "salient": {"speed_smc", "torque_share", "predictive_torque", "flux_observer", "misalignment"},
}


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_the_parts_account_for_every_instruction_and_are_those_of_the_controller(controller):
    cost = measure(controller)
    parts = cost.execution.by_part()
    assert abs(parts.total() - int(cost.interrupts.sum())) <= len(parts)  # each is rounded
    taken = {name for name, mean in cost.mean_by_part().items() if mean > 5}
    foreign = set().union(*LAWS.values()) - LAWS[controller]
    assert taken >= LAWS[controller] | {"control", "load_observer", "protection", "state_machine", "pwm"}
    assert not taken & foreign


@pytest.fixture
def run_qemu(tmp_path: Path):
    """Runs a drive for a while with options of QEMU's own before ours; gives back its counts."""

    def run(name: str, *qemu_options: str | Path) -> np.ndarray:
        folder = tmp_path / name
        folder.mkdir()
        wrapper = folder / "qemu-system-arm"
        wrapper.write_text("#!/bin/sh\n" + f"PATH={os.environ['PATH']}\n"
                           + f'exec qemu-system-arm {" ".join(map(str, qemu_options))} "$@"\n')
        wrapper.chmod(0o755)
        options = SimulatorOptions(build="cortex-m4", controller="salient", pace="free",
                                   instructions=folder / "instructions")
        command = [*options.arguments(f"unix:{folder}/bus"), "--stop-at-s", "0.005"]
        subprocess.run(command, check=True, timeout=TIMEOUT_S, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                       env={**os.environ, "PATH": f"{folder}:{os.environ['PATH']}"})
        return np.fromfile(folder / "instructions", "<u4")

    return run


def test_counts_are_the_same_when_every_block_is_one_instruction(run_qemu):
    whole, single = run_qemu("whole"), run_qemu("single", "-singlestep")
    assert len(whole) == 200
    assert (whole == single).all()


def test_a_count_is_the_number_of_instructions_in_the_trace(run_qemu, tmp_path):
    """QEMU's own log of what it runs, an instruction a line, between the handler's two ends."""
    log = tmp_path / "trace"
    counts = run_qemu("traced", "-singlestep", "-d", "exec,nochain", "-D", log)
    lengths, length = [], None
    with log.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if not line.startswith("Trace"):
                continue
            name = line.split("]")[-1].strip()
            if name == "control_handler":
                length = 0
            if length is not None:
                length += 1
            if name == "control_handler_return":
                lengths.append(length)
                length = None
    assert lengths == list(counts)


def test_each_control_interrupt_is_an_exception_of_the_processor(run_qemu, tmp_path):
    log = tmp_path / "log_of_exceptions"
    counts = run_qemu("exceptions", "-d", "int", "-D", log)
    taken = re.findall(r"taking pending \w+ exception (\d+)", log.read_text(encoding="utf-8"))
    assert taken == [str(CONTROL_EXCEPTION)] * len(counts)
