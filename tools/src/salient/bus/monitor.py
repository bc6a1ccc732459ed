"""Commands that only listen: log and monitor."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import can

from salient.bus.clock import VirtualTimeReader, open_bus
from salient.bus.log import open_log
from salient.bus.signals import SignalTable, drive_database
from salient.errors import UsageError

_COLUMNS = (
    ("state", "DRIVE_STATUS.state", "{:>10}"),
    ("fault", "DRIVE_STATUS.fault", "{:>17}"),
    ("speed", "speed_rpm", "{:>9.2f}"),
    ("reference", "DRIVE_MOTION.speed_reference_rpm", "{:>9.2f}"),
    ("torque", "torque_estimate_Nm", "{:>8.2f}"),
    ("asked", "torque_reference_Nm", "{:>8.2f}"),
    ("load", "load_torque_estimate_Nm", "{:>8.2f}"),
    ("bus", "DRIVE_TORQUE.bus_voltage_V", "{:>8.1f}"),
)


def _frames(address: str, duration_s: float | None, what: str) -> Iterator[tuple[int, can.Message]]:
    """Frames until the drive ends, `duration_s` of virtual time have passed, or an interrupt."""
    end_ns = None
    # Whoever started this may end it so; what is written must be complete then.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with open_bus(address) as bus:
        reader = VirtualTimeReader(bus)
        print(f"{what} {address}", flush=True)
        while True:
            try:
                timed = reader.receive(None)
            except (can.CanOperationError, KeyboardInterrupt):
                return
            if timed is None:
                continue
            if end_ns is None and duration_s is not None:
                end_ns = timed[0] + round(duration_s * 1e9)
            if end_ns is not None and timed[0] > end_ns:
                return
            yield timed


def record(address: str, path: Path, duration_s: float | None) -> int:
    """Writes every frame on a bus to a log file, on virtual time; returns 0."""
    open_bus(address).shutdown()  # nothing is left behind when there is no such bus
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {path}: {error.strerror}") from None
    log = open_log(path)
    count = 0
    try:
        for timed in _frames(address, duration_s, "recording"):
            log.write(*timed)
            count += 1
    except KeyboardInterrupt:
        pass
    finally:
        log.close()
    print(f"{count} frames: {path}")
    return 0


def monitor(address: str, every_s: float, duration_s: float | None) -> int:
    """Prints the drive's main values every `every_s` of virtual time; returns 0."""
    telemetry = SignalTable(drive_database(), "DRIVE")
    due_ns = None
    for time_ns, message in _frames(address, duration_s, "watching"):
        telemetry.add(time_ns, message)
        due_ns = time_ns + round(every_s * 1e9) if due_ns is None else due_ns
        if time_ns < due_ns:
            continue
        if telemetry.count("DRIVE_TORQUE"):
            sys.stdout.write(_line(time_ns, telemetry) + "\n")
            sys.stdout.flush()
        telemetry = SignalTable(drive_database(), "DRIVE")
        due_ns += round(every_s * 1e9)
    return 0


def _line(time_ns: int, telemetry: SignalTable) -> str:
    cells = [f"{time_ns * 1e-9:10.4f} s"]
    for title, name, form in _COLUMNS:
        value = telemetry[name]
        cells.append(f"{title} {form.format(value.last_name if value.choices else value.last)} {value.unit}".rstrip())
    return "  ".join(cells)
