"""Torque ripple that the reference model of the controller salient in double precision reaches on a machine: with the
same plant, sensors, voltage and control period, what the firmware's arithmetic and tables cost is the difference
(tests/reference)."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

from salient.bench.programs import EmulatorError, reference_executable
from salient.machine.cache import machine_image

DRIVES = ("firmware", "reference")


def measure(machine: str, **conditions: float) -> dict[str, dict[str, float]]:
    """Both drives' ripple, torque_mean_Nm and speed_mean_rpm of one run under a constant load. conditions: the
    program's arguments."""
    image: Path = machine_image(machine)
    arguments = [f"{name}={float(value)!r}" for name, value in conditions.items()]
    done = subprocess.run([reference_executable(), image, *arguments], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise EmulatorError(f"the reference model of {machine}: {done.stderr.strip() or done.returncode}")
    measured: dict[str, Any] = json.loads(done.stdout)
    return {drive: measured[drive] for drive in DRIVES}
