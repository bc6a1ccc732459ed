"""salient machine: checks a machine file, prints its data sheet, plots its magnetics."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from salient.dbc import drive_dbc_of_node
from salient.errors import UsageError
from salient.machine.drive_report import drive_json, drive_lines, pulse_lines
from salient.machine.file import Converter, Machine, MachineError, Sensors, load_machine, machine_path
from salient.machine.firmware_tables import machine_phase_map
from salient.machine.scaling import scaling_of

# Currents in the machine's unit (scaling.py): up to the end of the firmware's tables.
CURRENT_MAX = 80.0
SHOWN = (5.0, 10.0, 20.0, 30.0, 50.0, 80.0)
SHOWN_PITCHES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)


def run(name_or_path: str, out: Path, json_path: Path | None = None, dbc_path: Path | None = None,
        node: int = 0, table: Path | None = None) -> int:
    """Checks the file, prints its data sheet and the drive's data, plots its magnetics; returns 0. UsageError.

    json_path: the drive's data are also written there; dbc_path: the CAN database of its drive
    with a node number. table: file of flux linkages; the machine file with it as its map is written first, and is the
    one that is checked.
    """
    try:
        path = machine_path(name_or_path)
        if table is not None:
            from salient.machine.map_import.command import import_map  # SciPy's splines: most of a second

            path, corrections = import_map(path, table, out)
            print("\n".join([f"imported: {table}", *(f"  {line}" for line in corrections),
                             f"machine file: {path}, with its map beside it"]))
        machine = load_machine(path)
        scaling = scaling_of(path, machine)
        machine_phase_map(path, machine, scaling.exponents)
    except MachineError as error:
        raise UsageError(str(error)) from None
    print("\n".join([*describe(machine), *drive_lines(machine), *pulse_lines(machine, scaling.data)]))
    plot_path = out / f"{machine.name}.png"
    try:
        out.mkdir(parents=True, exist_ok=True)
        plot(machine).savefig(plot_path, dpi=110, metadata={"Software": None})
    except OSError as error:
        raise UsageError(f"--out {out}: {error.strerror}") from None
    print(f"plot: {plot_path}")
    if json_path is not None:
        _write("--json", json_path, drive_json(machine))
    if dbc_path is not None:
        _write("--dbc", dbc_path, drive_dbc_of_node(scaling.dbc(), node))
    return 0


def _write(option: str, path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{option} {path}: {error.strerror}") from None


def _ampere(machine: Machine) -> float:
    """The machine's unit of current, A."""
    return float(2.0**scaling_of(machine.name, machine).exponents.current)


def _saturation(machine: Machine) -> str:
    """How much of its aligned inductance a machine has left at the largest current shown."""
    current_A = min(SHOWN[-1] * _ampere(machine), machine.magnetics.current_max_A)
    small_A = 1e-3
    left = float(machine.magnetics.flux_linkage_Wb(0.0, current_A)) / current_A
    left /= float(machine.magnetics.flux_linkage_Wb(0.0, small_A)) / small_A
    if left > 0.99:
        return "; no saturation"
    return f"; saturation leaves {100.0 * left:.0f} % aligned at {current_A:g} A"


def describe(machine: Machine) -> list[str]:
    """The lines of a data sheet."""
    magnetics, half = machine.magnetics, machine.pitch_rad / 2.0
    small_A = 1e-3
    aligned_H = float(magnetics.flux_linkage_Wb(0.0, small_A)) / small_A
    angles = np.linspace(half, 2.0 * half, 361)[:, None]
    shown_A = np.array(SHOWN) * _ampere(machine)
    torques_Nm = magnetics.torque_Nm(angles, shown_A)
    lines = [
        f"{machine.name}: {machine.stator_poles}/{machine.rotor_poles} poles, {machine.phases} phases,"
        f" magnetics {magnetics.form}",
        f"  winding     {machine.resistance_ohm:g} ohm; {aligned_H * 1e3:.2f} mH aligned,"
        f" {magnetics.unaligned_inductance_H * 1e3:.2f} mH unaligned at small currents{_saturation(machine)}",
        f"  shaft       {machine.inertia_kg_m2:g} kg m^2, {machine.friction_Nm_s:g} N m s",
        f"  supply      {machine.supply_voltage_V:g} V"
        + (f" through {machine.dc_link['source_resistance_ohm']:g} ohm, link {machine.dc_link['capacitance_F'] * 1e6:g}"
           " uF" if machine.dc_link else ", regenerative"),
        "  torque      maximum of one phase: "
        + ", ".join(f"{torque:.3g} N m at {i:g} A" for torque, i in zip(torques_Nm.max(axis=0), shown_A, strict=True)),
    ]
    for title, values, table in (("converter", machine.converter, Converter), ("sensors", machine.sensors, Sensors)):
        stated = [f"{key} {value:g}" for key, value in values.items() if value != table.model_fields[key].default]
        lines.append(f"  {title:<11} {', '.join(stated) if stated else 'ideal'}")
    return lines


def plot(machine: Machine) -> Figure:
    """Flux linkage over current, torque over angle."""
    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    _plot_flux(left, machine)
    _plot_torque(right, machine)
    figure.suptitle(f"{machine.name}: magnetics of one phase ({machine.magnetics.form})", x=0.01, ha="left")
    return figure


def _plot_flux(axes: Axes, machine: Machine) -> None:
    current_A = np.linspace(0.0, CURRENT_MAX * _ampere(machine), 321)
    colours = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.9, len(SHOWN_PITCHES)))
    for pitches, colour in zip(SHOWN_PITCHES, colours, strict=True):
        angle_rad = pitches * machine.pitch_rad
        flux_Wb = machine.magnetics.flux_linkage_Wb(angle_rad, current_A)
        axes.plot(current_A, flux_Wb, color=colour)
        position = {0.0: " aligned", 0.5: " unaligned"}.get(pitches, "")
        axes.annotate(f"{math.degrees(angle_rad):.0f} deg{position}", (current_A[-1], flux_Wb[-1]), color=colour,
                      xytext=(3, 0), textcoords="offset points", va="center", fontsize=8)
    axes.set(xlabel="current / A", ylabel="flux linkage / Wb", xlim=(0.0, 1.3 * current_A[-1]), ylim=(0.0, None))
    axes.set_title("flux linkage by angle", loc="left", fontsize=10)
    axes.grid(color="#e6e6e6")


def _plot_torque(axes: Axes, machine: Machine) -> None:
    angle_rad = np.linspace(0.0, machine.pitch_rad, 721)
    colours = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.9, len(SHOWN)))
    for current_A, colour in zip(np.array(SHOWN) * _ampere(machine), colours, strict=True):
        torque_Nm = machine.magnetics.torque_Nm(angle_rad, current_A)
        axes.plot(np.degrees(angle_rad), torque_Nm, color=colour, label=f"{current_A:g} A")
    axes.set(xlabel="angle of the phase / deg (0 aligned)", ylabel="torque / N m",
             xlim=(0.0, math.degrees(machine.pitch_rad)))
    axes.set_title("torque by current", loc="left", fontsize=10)
    axes.legend(frameon=False, fontsize=8)
    axes.grid(color="#e6e6e6")
