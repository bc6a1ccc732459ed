"""A drive and its test bench on a bus for them alone, in lock-step: the value of the pytest fixture `bench`.

    bench.drive.speed_reference_rpm = 600
    bench.at(0.13).load_torque_Nm = 8
    bench.run_for(0.2)
    assert bench.truth["speed_rpm"].last == pytest.approx(600, abs=3)
"""

from __future__ import annotations

from dataclasses import replace

from salient.bench.emulator import EmulatorProcess, parameter_table
from salient.bench.session import Session
from salient.config import BenchConfig
from salient.machine.lowest_speed import lowest_speed_rpm

TELEMETRY_PERIOD_MS = 1
"""Telemetry of a bench, unless its configuration states one; a bus with one drive alone has room for it."""


class Bench(Session):
    """A session with an emulator that it starts and ends.

    config: its pace is not used, a bench is in lock-step; its telemetry_period_ms is 1 unless stated,
    with several drives the parameter's. can: "unix:PATH" or "socketcan:INTERFACE", one bench at
    a time on an interface. options: the configuration. simulator: the process.
    """

    options: BenchConfig
    simulator: EmulatorProcess

    def __init__(self, config: BenchConfig, can: str) -> None:
        period_ms = config.telemetry_period_ms or (TELEMETRY_PERIOD_MS if config.drives == 1 else None)
        self.options = replace(config, pace="lockstep", telemetry_period_ms=period_ms)
        self.simulator = EmulatorProcess(self.options, can)
        try:
            super().__init__(can, parameter_table=lambda: parameter_table(config),
                             is_alive=lambda: self.simulator.is_alive, machine=config.machine, node=config.node,
                             drives=config.drives)
            for drive in self.drives:
                drive.lowest_speed_rpm = lowest_speed_rpm(config.machine, config.encoder_bits, config.controller)
        except BaseException:
            self.simulator.close()
            raise

    def close(self) -> None:
        """Ends session and emulator; EmulatorError when the exit code of the emulator is not 0."""
        try:
            super().close()
        finally:
            self.simulator.close()
