"""How good is a machine that its drive has measured: python -m salient.experiments.identified [MACHINE...]

For each machine a name plate whose magnetics, resistance, inertia and friction are others than the motor's; the drive
identifies the motor over CAN (salient.identify.command.identify), and only then the truth is read: errors of the file,
and ripple, dip and start of the drive on the measured file and on the true one, both on the true motor.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from salient.bench.bench import Bench
from salient.experiments import metrics
from salient.experiments.compare.case import MACHINES, make_scenario
from salient.experiments.scaled import scale_of
from salient.experiments.scenario import LoadStep, Record, SpeedStep, run_all
from salient.identify.command import TELEMETRY_PERIOD_MS, identify
from salient.identify.result import Result, machine_text, write_machine
from salient.machine.cache import bench_config
from salient.machine.drive_data import DriveData
from salient.machine.file import Machine, load_machine
from salient.machine.path import machine_path, stated_conditions
from salient.machine.scaling import scaling_of
from salient.paths import OUT, make_folder

_SENSORS = {"noise_lsb": 2, "offset_lsb": 5, "encoder_eccentricity_deg": 0.05, "coulomb": 0.02}
CONDITIONS: Mapping[str, Mapping[str, float]] = {
    "ideal": {},
    "17 bits": _SENSORS,
    "14 bits": {**_SENSORS, "bits": 14},
    "load": {"load": 0.2},
    "17 bits, load": {**_SENSORS, "load": 0.2},
    "eddy 1 mS": {"eddy_S": 1e-3},
    "eddy 2 mS": {"eddy_S": 2e-3},
    "17 bits, eddy 1 mS": {**_SENSORS, "eddy_S": 1e-3},
}
"""Noise and offset of the currents in LSB of the converter, Coulomb friction and load as parts of the rated torque;
conductance of the iron."""
STEP_RPM, LOAD_NM, START_RPM = 150.0, 8.0, 600.0
_BINS, _REPEATS = 36, 2


def plate_of(path: Path, folder: Path) -> Path:
    """A name plate: poles, converter, ratings and full scales of a machine, and a motor that has not been measured."""
    machine = load_machine(path)
    data = scaling_of(path, machine).data
    table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    peak_A = data.current_peak_A
    aligned_H = 1.2 * float(machine.magnetics.flux_linkage_Wb(0.0, peak_A)) / peak_A
    tables: dict[str, Mapping[str, Any]] = {
        "poles": table["poles"],
        "winding": {"resistance_ohm": 1.5 * machine.resistance_ohm},
        "mechanics": {"inertia_kg_m2": 0.6 * machine.inertia_kg_m2, "friction_Nm_s": 2.0 * machine.friction_Nm_s},
        "magnetics": {"form": "linear_cosine", "aligned_inductance_H": aligned_H,
                      "unaligned_inductance_H": aligned_H / 10.0},
        "converter": table["converter"],
        **{name: table[name] for name in ("dc_link",) if name in table},
        "drive": {**{name: value for name, value in table.get("drive", {}).items() if name != "parameters"},
                  "current_peak_A": peak_A, "adc_current_A": data.adc_current_A, "adc_voltage_V": data.adc_voltage_V},
    }
    plate = folder / f"plate_{machine.name}.toml"
    plate.write_text(machine_text("Name plate.", plate.stem, tables), encoding="utf-8")
    return plate


def identified(path: Path, condition: Mapping[str, float], folder: Path, tell: Any, label: str = "") -> tuple[
        Result, Path, float]:
    """Result, machine file and virtual time of an identification under a condition. label: part of the file's name; a
    process reads a machine file once."""
    plate = plate_of(path, folder)
    machine = load_machine(plate)
    data = scaling_of(path, load_machine(path)).data
    if "eddy_S" in condition:
        path = _with_eddy_currents(path, condition["eddy_S"], folder)
    config = bench_config({"machine": str(plate), "true_machine": str(path), "controller": "salient",
                           "telemetry_period_ms": TELEMETRY_PERIOD_MS,
                           **({"encoder_bits": int(condition["bits"])} if "bits" in condition else {})})
    with tempfile.TemporaryDirectory() as socket:
        bench = Bench(config, f"unix:{socket}/bus")
        try:
            disturb(bench, condition, data)
            result = identify(bench, machine, _BINS, _REPEATS, tell)
            time_s = bench.time_s
        finally:
            bench.close()
    file = folder / f"measured_{path.stem}{label and '_'}{'_'.join(label.replace(',', '').split())}.toml"
    write_machine(result, plate, file)
    return result, file, time_s


def _with_eddy_currents(path: Path, conductance_S: float, folder: Path) -> Path:
    """A machine file with another conductance of its iron, and its map."""
    other = folder / f"eddy_{1e6 * conductance_S:.0f}" / path.name
    other.parent.mkdir(parents=True, exist_ok=True)
    table = tomllib.loads(path.read_text(encoding="utf-8-sig"))["magnetics"].get("file")
    if table:
        shutil.copyfile(path.parent / table, other.parent / table)
    other.write_text(f"{path.read_text(encoding='utf-8-sig')}\n[eddy_current]\nconductance_S = {conductance_S}\n",
                     encoding="utf-8")
    return other


def disturb(bench: Bench, condition: Mapping[str, float], data: DriveData) -> None:
    """Sensors, friction and load of a condition; data: of the drive."""
    lsb_A = data.adc_current_A / 4096.0
    settings = {"current_noise_A": condition.get("noise_lsb", 0.0) * lsb_A,
                "current_sensor_offset_A": condition.get("offset_lsb", 0.0) * lsb_A,
                "encoder_eccentricity_deg": condition.get("encoder_eccentricity_deg", 0.0),
                "load_torque_Nm": condition.get("load", 0.0) * data.torque_rated_Nm}
    for name, value in settings.items():
        if value:
            setattr(bench.rig, name, value)
    if condition.get("coulomb"):
        bench.fault("coulomb_friction", torque_Nm=condition["coulomb"] * data.torque_rated_Nm)


def errors(found: Machine, true: Machine, result: Result) -> dict[str, float]:
    """Errors of a measured machine in % of the largest flux linkage and torque, or of the quantity; RMS and largest."""
    peak_A = float(found.drive["current_peak_A"])
    angle, current = np.meshgrid(np.linspace(0.0, math.pi / true.rotor_poles, 91), np.linspace(0.02, 1.0, 50) * peak_A,
                                 indexing="ij")
    flux, torque = true.magnetics.flux_linkage_Wb(angle, current), true.magnetics.torque_Nm(angle, current)
    flux_error = 100.0 * (found.magnetics.flux_linkage_Wb(angle, current) - flux) / float(flux.max())
    torque_error = 100.0 * (found.magnetics.torque_Nm(angle, current) - torque) / float(np.abs(torque).max())
    aligned_deg = [math.degrees(math.remainder(2.0 * math.pi * (result.found.position[phase] - row / len(
        result.found.phases) / true.rotor_poles) + result.fit.delta_rad[row], 2.0 * math.pi / true.rotor_poles))
        for row, phase in enumerate(result.found.phases)]
    return {"flux_rms": float(np.sqrt(np.mean(flux_error**2))), "flux_max": float(np.abs(flux_error).max()),
            "torque_rms": float(np.sqrt(np.mean(torque_error**2))), "torque_max": float(np.abs(torque_error).max()),
            "angle_deg": max(map(abs, aligned_deg)),
            "resistance": 100.0 * (found.resistance_ohm / true.resistance_ohm - 1.0),
            "inertia": 100.0 * (found.inertia_kg_m2 / true.inertia_kg_m2 - 1.0),
            "friction": 100.0 * (found.friction_Nm_s / true.friction_Nm_s - 1.0),
            "eddy_mS": 1e3 * result.fit.conductance_S,
            "peak": 100.0 * float(result.log["current_A"].max()) / result.limit_A}


def driven(file: str, path: Path, folder: Path) -> dict[str, float | None]:
    """Ripple, dip and start of the drive `salient` on a file, with the motor of the true one."""
    scale, stated = scale_of(load_machine(path)), stated_conditions(path)
    speed_rpm, load_Nm, start_rpm = scale.rpm(STEP_RPM), scale.Nm(LOAD_NM), scale.rpm(START_RPM)
    window_s, step_s = scale.window_s(speed_rpm), round(0.3 + scale.delay_s(speed_rpm, 0.3), 6)
    of = {"machine": file, "true_machine": None if file == str(path) else str(path), "controller": "salient", **stated}
    step = make_scenario(duration_s=round(step_s + 0.4 + window_s, 6), speed=(SpeedStep(0.0, speed_rpm),),
                         load=(LoadStep(step_s, load_Nm),), record=Record(1.0, step_s - 0.01), **of)
    run_all([step], folder / "step", progress=lambda _: None)
    recording = np.load(folder / "step" / "salient" / "recording.npy")
    torque = metrics.torque_metrics(recording["time_s"], recording["torque_Nm"],
                                    (step_s + 0.4, step_s + 0.4 + window_s))
    after = metrics.speed_after_step(recording, speed_rpm, step_s)
    begin = replace(step, duration_s=round(0.5 + scale.delay_s(start_rpm, 0.5), 6), speed=(SpeedStep(0.0, start_rpm),),
                    load=(), record=Record(10.0, 0.0))
    run_all([begin], folder / "start", progress=lambda _: None)
    speeds = np.load(folder / "start" / "salient" / "recording.npy")
    reached = np.nonzero(speeds["speed_rpm"] >= 0.995 * start_rpm)[0]
    return {"K_t": torque["torque_ripple"], "dip_rpm": after["speed_dip_rpm"],
            "start_s": float(speeds["time_s"][reached[0]]) if len(reached) else None}


def main(arguments: Sequence[str]) -> int:
    """Judges machines under conditions; a line and an entry of identified.json for each. Returns the number of those
    that were not identified."""
    parser = argparse.ArgumentParser(prog="python -m salient.experiments.identified", description=__doc__)
    parser.add_argument("machines", nargs="*", default=list(MACHINES), help="names or files (default the bundled ones)")
    parser.add_argument("--condition", action="append", choices=list(CONDITIONS), help="may be repeated (default all)")
    parser.add_argument("--drive", action="store_true", help="also run the drive on the measured file")
    parser.add_argument("--out", type=Path, default=OUT / "identified")
    options = parser.parse_args(arguments)
    make_folder(options.out, ("identified.json",))
    found: list[dict[str, Any]] = []
    failed = 0
    for name in options.machines:
        path = machine_path(name)
        for condition in options.condition or CONDITIONS:
            entry: dict[str, Any] = {"machine": path.stem, "condition": condition}
            try:
                result, file, time_s = identified(path, CONDITIONS[condition], options.out, lambda _: None, condition)
                entry |= {"time_s": time_s, **errors(load_machine(file), load_machine(path), result)}
                if options.drive:
                    for label, of in (("measured", str(file)), ("true", str(path))):
                        entry |= {f"{key}_{label}": value for key, value in
                                  driven(of, path, options.out / f"{path.stem}_{label}").items()}
            except Exception as error:
                failed += 1
                entry["failed"] = f"{type(error).__name__}: {error}"
            found.append(entry)
            print("  ".join(f"{key} {value:.4g}" if isinstance(value, float) else f"{value}"
                            for key, value in entry.items()), flush=True)
            (options.out / "identified.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return failed


if __name__ == "__main__":
    sys.exit(min(main(sys.argv[1:]), 1))
