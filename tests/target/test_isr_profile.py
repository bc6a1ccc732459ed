"""Instructions of the interrupts on the Cortex-M4, counted by QEMU, are exact and reproducible."""

from __future__ import annotations

import os
import re
import subprocess
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from salient.bench.programs import command_line, deferred_instructions, executable
from salient.benchmark import command as benchmark
from salient.config import CONTROLLERS, BenchConfig
from salient.elf import ElfImage
from salient.machine.cache import machine_image
from salient.paths import BUILD
from salient.target.isr_profile import IsrProfile, measure, read_profile

TIMEOUT_S = 60
CONTROL_EXCEPTION = 16 + 31
PENDSV = 14


@pytest.mark.in_turns
def test_equal_runs_execute_equal_instructions():
    first, second = (measure("salient") for _ in range(2))
    assert (first.interrupts == second.interrupts).all()
    assert (first.deferred == second.deferred).all()
    assert first.trace.by_module() == second.trace.by_module()


LAWS = {
    "traditional": {"ditc_hysteresis"},
    "paper": {"speed_smc", "bp_pid", "pwm_ditc"},
    "salient": {"speed_smc", "torque_sharing", "predictive_torque", "flux_observer"},
}
DEFERRED = {
    "traditional": {"speed_pi"},
    "paper": {"bp_network", "bp_tuner"},
    "salient": {"misalignment"},
}
"""Modules of which only the deferred interrupt executes instructions."""


@pytest.mark.in_turns
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_modules_account_for_every_instruction_and_belong_to_the_controller(controller):
    profile = measure(controller)
    modules = profile.trace.by_module()
    assert abs(modules.total() - int(profile.interrupts.sum())) <= len(modules)  # each is rounded
    executed = {name for name, mean in profile.mean_by_module().items() if mean > 5}
    others = set().union(*LAWS.values()) - LAWS[controller]
    assert executed >= LAWS[controller] | {"control_step", "load_observer", "protection", "state_machine", "modulator"}
    assert not executed & others
    files = profile.trace.coverage().files
    for name in DEFERRED[controller]:
        of = files[f"firmware/control/{name}.c"]
        assert of.executed > 0.5 * of.instructions and of.in_interrupts == 0, name


@pytest.mark.in_turns
def test_arithmetic_that_is_not_inlined_counts_for_its_callers():
    profile = measure("paper", "cortex-m4-Os")
    functions = {one.function for one in ElfImage(profile.trace.image).instructions()}
    assert {"sigmoid_symmetric_q27", "memcpy"} <= functions
    modules = profile.trace.by_module()
    assert abs(modules.total() - int(profile.interrupts.sum())) <= len(modules)
    assert not set(modules) & {"fixed", "exp2", "sigmoid", "interpolate", "libgcc2", "memcpy-armv7m"}
    assert 0.02 < modules["pwm_ditc"] / modules.total() < 0.4


@pytest.fixture
def run_qemu(tmp_path: Path):
    """Runs a drive with additional options of QEMU; returns its profile."""

    def run(name: str, *qemu_options: str | Path) -> IsrProfile:
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
        return read_profile(options.instructions, options.execution, options.machine, options.build)

    return run


def test_counts_are_independent_of_the_translation_block_size(run_qemu):
    whole, single = run_qemu("whole"), run_qemu("single", "-singlestep")
    assert len(whole.interrupts) == 200
    assert (whole.interrupts == single.interrupts).all()
    assert len(whole.deferred) == 200
    assert (whole.deferred == single.deferred).all()
    assert (whole.trace.inside == single.trace.inside).all()
    assert (whole.trace.in_longest == single.trace.in_longest).all()
    # The counts are written within the last block, which is already counted in full.
    assert 0 <= (whole.trace.executed - single.trace.executed).sum() <= 1
    assert whole.trace.stack == single.trace.stack


def interrupts_in(log: Path) -> tuple[dict[str, list[int]], Counter[int]]:
    """From QEMU's log of single instructions: instructions of each control and each deferred interrupt, where one that
    pre-empts another is not part of it, and how often control interrupts executed each address."""
    lengths: dict[str, list[int]] = {"control": [], "deferred": []}
    active: list[tuple[str, int]] = []  # the innermost last: its name and its instructions so far
    addresses: Counter[int] = Counter()
    with log.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if line.startswith("Stopped execution") and active:  # the instruction was interrupted
                active[-1] = (active[-1][0], active[-1][1] - 1)
            trace = re.match(r"Trace .*\[[0-9a-f]+/([0-9a-f]+)/.*\] ?(.*)", line)
            if not trace:
                continue
            name, _, end = trace[2].partition("_handler")
            if name in lengths and trace[2] == f"{name}_handler":
                active.append((name, 0))
            if active:
                active[-1] = (active[-1][0], active[-1][1] + 1)
                addresses[int(trace[1], 16)] += active[-1][0] == "control"
            if name in lengths and end == "_return":
                lengths[name].append(active.pop()[1])
    return lengths, addresses


@pytest.mark.in_turns
def test_counts_match_the_log_of_qemu_by_instruction(run_qemu, tmp_path):
    """QEMU's log has one line per instruction with its address; compared between the handler's entry and return."""
    log = tmp_path / "trace"
    profile = run_qemu("traced", "-singlestep", "-d", "exec,nochain", "-D", log)
    lengths, addresses = interrupts_in(log)
    assert lengths["control"] == list(profile.interrupts)
    assert lengths["deferred"] == list(profile.deferred)
    instructions = ElfImage(profile.trace.image).instructions()
    counted = {one.address: count for one, count in zip(instructions, profile.trace.inside, strict=True) if count}
    assert counted == +addresses


@pytest.mark.in_turns
def test_control_interrupt_that_preempts_the_deferred_one_is_not_part_of_its_count(tmp_path):
    """race.c requests control interrupts in its deferred step."""
    log, control = tmp_path / "trace", tmp_path / "control"
    wrapper = tmp_path / "qemu-system-arm"
    wrapper.write_text(f"#!/bin/sh\nPATH={os.environ['PATH']}\n"
                       f'exec qemu-system-arm -singlestep -d exec,nochain -D {log} "$@"\n')
    wrapper.chmod(0o755)
    counts = {"control": control, "deferred": deferred_instructions(control)}
    command = [executable("cortex-m4"), BUILD / "cortex-m4" / "bin" / "race_protected.elf",
               "--instructions", counts["control"], "--deferred-instructions", counts["deferred"], "--pace", "free",
               "--can", f"unix:{tmp_path}/bus", "--machine-image", machine_image("saturating"),
               "--stop-at-s", "0.003"]
    subprocess.run(command, check=True, timeout=TIMEOUT_S, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                   env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"})
    lengths, _ = interrupts_in(log)
    assert len(lengths["deferred"]) > 90
    assert len(lengths["control"]) > 1.2 * len(lengths["deferred"])  # the others interrupted one
    for name, path in counts.items():
        assert lengths[name] == list(np.fromfile(path, "<u4")), name


def test_each_control_interrupt_and_its_deferred_one_are_processor_exceptions(run_qemu, tmp_path):
    log = tmp_path / "log_of_exceptions"
    profile = run_qemu("exceptions", "-d", "int", "-D", log)
    taken = re.findall(r"taking pending \w+ exception (\d+)", log.read_text(encoding="utf-8"))
    assert taken == [str(CONTROL_EXCEPTION), str(PENDSV)] * len(profile.interrupts)


@pytest.mark.in_turns
def test_speed_of_the_target_loop_can_be_measured():
    assert benchmark.measure("paper", "cortex-m4") > 0.0
