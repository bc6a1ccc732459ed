"""Starts a drive and its test bench in one process: the host executable, or QEMU with an image for a board."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

from salient.bench.drive import ParameterRow, read_parameter_table
from salient.bench.programs import EmulatorError, command_line
from salient.bench.session import Session
from salient.config import BenchConfig
from salient.errors import UsageError


class EmulatorProcess:
    """A running executable, ended with this process or by close().

    prefix: a command that runs the executable's, such as a profiler.
    config: with the bus that it is on. command: its command line. ready: its JSON line. UsageError when it refuses its
    options, EmulatorError when it fails.
    """

    def __init__(self, config: BenchConfig, can: str, prefix: Sequence[str] = ()) -> None:
        self.config = replace(config, can=can)
        self.command = [*prefix, *command_line(self.config)]
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - read until close()
        self._error_text = ""
        self._process = subprocess.Popen(
            [*self.command, "--follow-stdin"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
        )
        assert self._process.stdin is not None and self._process.stdout is not None  # pipes
        self._stdin, self._stdout = self._process.stdin, self._process.stdout
        line = self._stdout.readline()
        if not line:
            self._raise_failure(self._process.wait())
        self.ready = json.loads(line)

    @property
    def pid(self) -> int:
        """Process number."""
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        """It has not ended; one that a debugger has stopped is alive."""
        return self._process.poll() is None

    @property
    def errors(self) -> str:
        """Its standard error so far."""
        if not self._errors.closed:
            self._errors.seek(0)
            self._error_text = self._errors.read().decode(errors="replace").strip()
        return self._error_text

    def close(self) -> None:
        """Ends it and waits: recording finished, socket removed. EmulatorError when its exit code is not 0."""
        if self.is_alive:
            self._stdin.close()
            self._process.wait()
        self._stdout.close()
        self._error_text = self.errors
        self._errors.close()
        if self._process.returncode != 0:
            self._raise_failure(self._process.returncode)

    def __enter__(self) -> EmulatorProcess:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _raise_failure(self, code: int) -> None:
        errors = self.errors
        if code == 2:
            raise UsageError(errors.removeprefix("salient: "))
        raise EmulatorError(f"{self.command[0]} ended with {code}: {errors or 'its standard error is empty'}")


def parameter_table(config: BenchConfig) -> list[ParameterRow]:
    """The parameters of the drive of a test bench, read from a second drive, so that reading takes no time on the bus
    of an experiment."""
    return _parameter_table(replace(config, can="auto", pace="lockstep", node=0, drives=1, memory=None, record=None,
                                    record_step_ns=1000, record_from_us=0, record_switches=None, instructions=None,
                                    execution=None, instruction_ns=None))


@lru_cache
def _parameter_table(config: BenchConfig) -> list[ParameterRow]:
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        can = f"unix:{folder}/can.sock"
        with EmulatorProcess(config, can) as process, Session(
                can, is_alive=lambda: process.is_alive, machine=config.machine) as session:
            session.rig.truth_period_us = 0
            return read_parameter_table(session)
