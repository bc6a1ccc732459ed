"""What a control interrupt costs on the Cortex-M4, and that it is one: counted by QEMU, the same on every computer."""

from __future__ import annotations

import os
import re
import subprocess
from collections import Counter
from pathlib import Path

import pytest

from salient.bench.config import CONTROLLERS, BenchConfig
from salient.bench.emulator import command_line
from salient.benchmark import command as benchmark
from salient.elf import Image
from salient.target.isr_profile import Cost, measure, read_cost

TIMEOUT_S = 60
CONTROL_EXCEPTION = 16 + 31


def test_equal_runs_take_equal_instructions():
    first, second = (measure("salient") for _ in range(2))
    assert (first.interrupts == second.interrupts).all()
    assert first.execution.by_part() == second.execution.by_part()


LAWS = {
    "traditional": {"speed_pi", "ditc_hysteresis"},
    "paper": {"speed_smc", "bp_pid", "bp_network", "pwm_ditc"},
    "salient": {"speed_smc", "torque_sharing", "predictive_torque", "flux_observer", "misalignment"},
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


def test_arithmetic_counts_for_the_laws_also_where_it_is_functions_of_its_own():
    cost = measure("paper", "cortex-m4-Os")
    functions = {one.function for one in Image(cost.execution.image).instructions()}
    assert {"exp2_negative_q31", "memcpy"} <= functions
    parts = cost.execution.by_part()
    assert abs(parts.total() - int(cost.interrupts.sum())) <= len(parts)
    assert not set(parts) & {"fixed", "exp2", "sigmoid", "interpolate", "libgcc2", "memcpy-armv7m"}
    assert 0.1 < parts["bp_network"] / parts.total() < 0.6


@pytest.fixture
def run_qemu(tmp_path: Path):
    """Runs a drive for a while with options of QEMU's own before ours; gives back what it cost."""

    def run(name: str, *qemu_options: str | Path) -> Cost:
        folder = tmp_path / name
        folder.mkdir()
        wrapper = folder / "qemu-system-arm"
        wrapper.write_text("#!/bin/sh\n" + f"PATH={os.environ['PATH']}\n"
                           + f'exec qemu-system-arm {" ".join(map(str, qemu_options))} "$@"\n')
        wrapper.chmod(0o755)
        options = BenchConfig(build="cortex-m4", controller="salient", pace="free", can=f"unix:{folder}/bus",
                              stop_at_s=0.005, instructions=folder / "instructions", execution=folder / "execution")
        subprocess.run(command_line(options), check=True, timeout=TIMEOUT_S, stdin=subprocess.DEVNULL,
                       stdout=subprocess.DEVNULL, env={**os.environ, "PATH": f"{folder}:{os.environ['PATH']}"})
        return read_cost(options.instructions, options.execution, options.machine, options.build)

    return run


def test_counts_are_the_same_when_every_block_is_one_instruction(run_qemu):
    whole, single = run_qemu("whole"), run_qemu("single", "-singlestep")
    assert len(whole.interrupts) == 200
    assert (whole.interrupts == single.interrupts).all()
    assert (whole.execution.inside == single.execution.inside).all()
    assert (whole.execution.in_worst == single.execution.in_worst).all()
    # The counts are written in the middle of the last block, when all of it is counted.
    assert 0 <= (whole.execution.executed - single.execution.executed).sum() <= 1
    assert whole.execution.stack == single.execution.stack


def test_counts_are_those_of_the_trace_in_all_and_by_instruction(run_qemu, tmp_path):
    """QEMU's own log of what it runs, an instruction a line with its address, between the handler's two ends."""
    log = tmp_path / "trace"
    cost = run_qemu("traced", "-singlestep", "-d", "exec,nochain", "-D", log)
    lengths, length, addresses = [], None, Counter()
    with log.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            trace = re.match(r"Trace .*\[[0-9a-f]+/([0-9a-f]+)/.*\] ?(.*)", line)
            if not trace:
                continue
            if trace[2] == "control_handler":
                length = 0
            if length is not None:
                length += 1
                addresses[int(trace[1], 16)] += 1
            if trace[2] == "control_handler_return":
                lengths.append(length)
                length = None
    assert lengths == list(cost.interrupts)
    instructions = Image(cost.execution.image).instructions()
    counted = {one.address: count for one, count in zip(instructions, cost.execution.inside, strict=True) if count}
    assert counted == addresses


def test_each_control_interrupt_is_an_exception_of_the_processor(run_qemu, tmp_path):
    log = tmp_path / "log_of_exceptions"
    cost = run_qemu("exceptions", "-d", "int", "-D", log)
    taken = re.findall(r"taking pending \w+ exception (\d+)", log.read_text(encoding="utf-8"))
    assert taken == [str(CONTROL_EXCEPTION)] * len(cost.interrupts)


def test_the_speed_of_the_loop_can_be_measured():
    assert benchmark.measure("paper", "cortex-m4") > 0.0
