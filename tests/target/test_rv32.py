"""On RV32 both interrupts are processor exceptions, and their instructions are counted."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

from salient.bench.programs import command_line
from salient.config import BenchConfig
from salient.elf import ElfImage
from salient.target.isr_profile import read_profile

TIMEOUT_S = 60
MACHINE_SOFTWARE_INTERRUPT = 3
MACHINE_TIMER_INTERRUPT = 7
HANDLER_INSTRUCTIONS = 38
"""Instructions of the control interrupt's handler: stack pointer, 16 registers saved and restored, request cleared, a
call, the return."""


def test_each_control_interrupt_and_its_deferred_one_are_processor_exceptions_and_counted(tmp_path: Path):
    log, instructions, executed = tmp_path / "log", tmp_path / "instructions", tmp_path / "executed"
    wrapper = tmp_path / "qemu-system-riscv32"
    wrapper.write_text(f'#!/bin/sh\nPATH={os.environ["PATH"]}\nexec qemu-system-riscv32 -d int -D {log} "$@"\n')
    wrapper.chmod(0o755)
    options = BenchConfig(build="rv32", controller="salient", pace="free", can=f"unix:{tmp_path}/bus", stop_at_s=0.005,
                          instructions=instructions, execution=executed)
    subprocess.run(command_line(options), check=True, timeout=TIMEOUT_S,
                   stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                   env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"})
    profile = read_profile(instructions, executed, options.machine, options.build)
    taken = re.findall(r"async:(\d), cause:([0-9a-f]+)", log.read_text(encoding="utf-8"))
    assert len(profile.interrupts) == 200
    assert len(profile.deferred) == 200
    assert ([(int(interrupt), int(cause, 16)) for interrupt, cause in taken]
            == [(1, MACHINE_SOFTWARE_INTERRUPT), (1, MACHINE_TIMER_INTERRUPT)] * 200)
    assert profile.trace.inside.sum() == profile.interrupts.sum()
    instructions_of = zip(ElfImage(profile.trace.image).instructions(), profile.trace.inside, strict=True)
    handler = sum(count for one, count in instructions_of if one.function.startswith("control_handler"))
    assert handler == HANDLER_INSTRUCTIONS * len(profile.interrupts)
