"""Machine and half bridges as circuits for ngspice, an independent solver: spice/*.cir, and how to run a deck."""

from __future__ import annotations

import resource
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from salient.machine.file import Machine
from salient.machine.magnetics import Formula

_NETLISTS = Path(__file__).resolve().parent / "spice"

OPTIONS = ".options method=gear reltol=1e-3 abstol=1e-6 chgtol=1 itl4=100"
"""Gear's method because with the trapezoidal rule the phase voltage rings without end after the current has ended.
chgtol is the smallest charge, here the smallest flux linkage, that relative errors are taken of: at its default of
1e-14 the step would shrink to nothing in a phase without current. The length of the step is .tran's."""


class NgspiceError(Exception):
    """ngspice is missing or failed; the text includes its output."""


@dataclass(frozen=True)
class Waveforms:
    """The waveforms that the deck saves, by name, at ngspice's time points; and the processor time of the run."""

    time_s: np.ndarray
    values: dict[str, np.ndarray]
    processor_s: float


def machine_lines(machine: Machine, bridge: str) -> list[str]:
    """The machine's numbers, its link `dc`, and its phase: the subcircuit that spice/winding.cir describes. bridge:
    half_bridge or series_diode. Machines by formula only."""
    assert isinstance(machine.magnetics, Formula)
    numbers = {
        "resistance_ohm": machine.resistance_ohm,
        "rotor_poles": machine.rotor_poles,
        **machine.magnetics.parameters,
    }
    return [
        *(f".param {name} = {value!r}" for name, value in numbers.items()),
        f"Vdc dc 0 {machine.supply_voltage_V!r}",
        ".subckt phase dc gate_upper gate_lower turns initial_flux_linkage_Wb=0",
        *(f'.include "{_NETLISTS / f"{name}.cir"}"' for name in (bridge, "winding", machine.magnetics.form)),
        ".ends",
    ]


def run(folder: Path, lines: list[str], processor_limit_s: int) -> Waveforms:
    """Runs a deck (its first line is a title) in a folder; NgspiceError with the output of ngspice. The limit is one of
    processor time, which does not depend on the load of the computer."""
    (folder / "deck.cir").write_text("\n".join(lines) + "\n")
    raw = folder / "deck.raw"
    raw.unlink(missing_ok=True)
    command = ["ngspice", "--batch", "--no-spiceinit", "--rawfile=deck.raw", "deck.cir"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    try:
        process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    except FileNotFoundError:
        raise NgspiceError("ngspice is missing: install the Debian package ngspice") from None
    with process:
        resource.prlimit(process.pid, resource.RLIMIT_CPU, (processor_limit_s, processor_limit_s))
        output, _ = process.communicate()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if process.returncode != 0 or not raw.exists() or "aborted" in output:
        raise NgspiceError(f"ngspice failed on {folder / 'deck.cir'}:\n{output[-2000:]}")
    header, _, values = raw.read_bytes().partition(b"Binary:\n")
    variables = header.decode().partition("Variables:\n")[2].split()[1::3]
    columns = dict(zip(variables, np.frombuffer(values).reshape(-1, len(variables)).T, strict=True))
    processor_s = (after.ru_utime - before.ru_utime) + (after.ru_stime - before.ru_stime)
    return Waveforms(columns.pop("time"), columns, processor_s)
