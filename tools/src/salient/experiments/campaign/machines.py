"""The machines of a campaign: the repository's and random ones, drawn beforehand."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from salient.experiments.compare.every_machine import EXAMPLES, random_files
from salient.machine.cache import machine_image
from salient.machine.file import load_machine
from salient.machine.scaling import SPEED_LSB_RPM, scaling_of
from salient.paths import BUILD, MACHINES, keep_text

RANDOM = range(10)
"""Numbers of the random machines: 0.1 to 500 N m."""


@lru_cache
def files() -> tuple[Path, ...]:
    """Machine files by number; the first is the paper's."""
    first = MACHINES / "saturating.toml"
    bundled = [path for path in sorted(MACHINES.glob("*.toml")) if path != first]
    return (first, *bundled, *sorted(EXAMPLES.glob("*.toml")), *random_files(RANDOM))


@lru_cache
def pool_file() -> Path:
    """The machines as salient_campaign reads them (emulator/campaign/main.c), which do not change while this process
    lasts."""
    lines = [pool_line(path) for path in files()]
    path = BUILD / "campaign" / "machines.txt"
    keep_text(path, "".join(f"{line}\n" for line in lines))
    return path


TORQUE_COMMAND_FRACTION_BITS = 16
"""Bits of DRIVE_TORQUE_COMMAND.torque_reference_Nm, where the unit is 1 N m."""
CURRENT_FRACTION_BITS = 9
"""Bits of currents in telemetry, where the unit is 1 A."""
VOLTAGE_FRACTION_BITS = 6
"""Bits of voltages in telemetry, where the unit is 1 V."""


def pool_line(path: Path) -> str:
    """The line of a machine in a file of machines."""
    machine = load_machine(path)
    scaling = scaling_of(path, machine)
    data = scaling.data
    lsb_rpm = float(SPEED_LSB_RPM) * 2.0**scaling.exponents.speed
    values = (data.speed_base_rpm, data.torque_rated_Nm, data.parameters["torque_max_Nm"], data.over_speed_rpm,
              data.over_voltage_V, data.under_voltage_V, data.current_trip_A, lsb_rpm,
              scaling.speed_reference_max * lsb_rpm, 2.0**(scaling.exponents.torque - TORQUE_COMMAND_FRACTION_BITS),
              2.0**(scaling.exponents.current - CURRENT_FRACTION_BITS),
              2.0**(scaling.exponents.voltage - VOLTAGE_FRACTION_BITS))
    rate_min_hz = max(scaling.control_rate_min_hz(machine), data.control_rate_hz if data.control_rate_hz > 50000 else 0)
    return " ".join([str(machine_image(str(path))), *(f"{value:.17g}" for value in values), str(rate_min_hz),
                     machine.name])
