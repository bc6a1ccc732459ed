"""The saturating machine, its converter and its shaft as a circuit for ngspice: what the emulated plant is compared
with.

A source and a diode are the half bridge of a phase (spice/series_diode.cir). Speed is the voltage of a capacitor of J
farads that the torque charges, 1 A for 1 N m; angle likewise, of one farad that the speed charges. The gate signals are
XSPICE's digital source, whose file is read as time advances: a PWL source searches all its points at every evaluation.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from salient.benchmark.switching_pattern import TICK_NS, SwitchingPattern, Trajectory
from salient.machine.file import load_machine, machine_path
from salient.reference import ngspice

_RAMP_NS = 0.1  # rise and fall of a gate signal, from the edge on


def run_ngspice(pattern: SwitchingPattern, step_ns: int, processor_limit_s: int = 600) -> Trajectory:
    """The saturating machine through a recorded pattern, in steps of step_ns at most. NgspiceError."""
    with tempfile.TemporaryDirectory(prefix="salient-") as name:
        folder = Path(name)
        (folder / "gates.txt").write_text("\n".join(_gate_lines(pattern)) + "\n")
        waveforms = ngspice.run(folder, _deck(pattern, step_ns), processor_limit_s)
    ends_s = (np.arange(pattern.periods) + 1) * pattern.period_ns * 1e-9
    values = {key: np.interp(ends_s, waveforms.time_s, column) for key, column in waveforms.values.items()}
    phases = range(pattern.phases)
    return Trajectory(
        angle_rad=values["v(angle)"],
        speed_rad_s=values["v(speed)"],
        torque_Nm=np.sum([values[f"v(xphase{phase}.torque)"] for phase in phases], axis=0),
        current_A=np.stack([values[f"i(v.xphase{phase}.vcurrent)"] for phase in phases], axis=1),
        processor_s=waveforms.processor_s,
    )


def _deck(pattern: SwitchingPattern, step_ns: int) -> list[str]:
    machine = load_machine(machine_path(pattern.machine))
    if machine.magnetics.form != "saturating":
        raise ValueError(f"magnetics {machine.magnetics.form}: only saturating has a torque in its netlist")
    phases = range(pattern.phases)
    digital = " ".join(f"digital_{switch}" for switch in _switches(pattern))
    analog = " ".join(f"gate_{switch}" for switch in _switches(pattern))
    flux_linkage_Wb = [
        float(machine.magnetics.flux_linkage_Wb(
            pattern.angle_rad - phase * machine.pitch_rad / pattern.phases, current))
        for phase, current in enumerate(pattern.current_A)
    ]
    torques = " + ".join(f"V(xphase{phase}.torque)" for phase in phases)
    end_ns = pattern.periods * pattern.period_ns
    return [
        "Three phases and a shaft",
        *ngspice.machine_lines(machine, "series_diode"),
        f"Agates [{digital}] gate_pattern",
        '.model gate_pattern d_source(input_file="gates.txt")',
        f"Abridges [{digital}] [{analog}] gate_level",
        f".model gate_level dac_bridge(out_low=0 out_high=1 t_rise={_RAMP_NS}n t_fall={_RAMP_NS}n)",
        *(f"Xphase{phase} dc gate_upper{phase} gate_lower{phase} turns{phase} phase "
          f"initial_flux_linkage_Wb={flux_linkage_Wb[phase]!r}" for phase in phases),
        *(f"Bturns{phase} turns{phase} 0 V = V(angle) * rotor_poles / (2 * pi) - {phase} / {pattern.phases}"
          for phase in phases),
        f"Btorque 0 speed I = {torques} - {machine.friction_Nm_s!r} * V(speed) - {pattern.load_torque_Nm!r}",
        f"Cspeed speed 0 {machine.inertia_kg_m2!r} IC={pattern.speed_rad_s!r}",
        "Gangle 0 angle speed 0 1",
        f"Cangle angle 0 1 IC={pattern.angle_rad!r}",
        ngspice.OPTIONS,
        ".save v(speed) v(angle) "
        + " ".join(f"i(v.xphase{phase}.vcurrent) v(xphase{phase}.torque)" for phase in phases),
        f".tran {pattern.period_ns}n {end_ns}n 0 {step_ns}n uic",
        ".end",
    ]


def _switches(pattern: SwitchingPattern) -> list[str]:
    return [f"{leg}{phase}" for leg in ("upper", "lower") for phase in range(pattern.phases)]


def _gate_lines(pattern: SwitchingPattern) -> list[str]:
    """Time and state of all switches, a line for each instant at which one changes."""
    lines, last = [], ""
    for period in range(pattern.periods):
        upper, lower = (np.minimum(values[period], pattern.period_ticks) for values in (pattern.upper, pattern.lower))
        for start_ns, end_ns, _ in pattern.segments(period):
            from_middle = abs((start_ns + end_ns) / (2 * TICK_NS) - pattern.period_ticks)
            states = [*(from_middle < upper), *(pattern.period_ticks - from_middle < lower)]
            text = " ".join("1s" if on else "0s" for on in states)
            if text != last:
                lines.append(f"{period * pattern.period_ns + start_ns}n {text}")
                last = text
    return lines
