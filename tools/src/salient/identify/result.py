"""The machine that the experiments show, with the uncertainty of each quantity and a verdict on it; and its file.

Intervals are of 95 %, by resampling whole pulses (salient.identify.fit.resampled) or runs of windows (shaft). The
map's also have the difference to a rougher fit. They do not hold what no pulse shows. How many hold the truth:
salient.experiments.identified_intervals.
"""

from __future__ import annotations

import glob
import hashlib
import math
import shutil
import tempfile
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from salient.identify import fit as electrical
from salient.identify.fit import Fit
from salient.identify.link import IdentifyError
from salient.identify.sequence import Findings
from salient.identify.shaft import Shaft, shaft_of
from salient.machine.contradictions import EDDY_TIME_CONSTANT_S
from salient.machine.file import Machine, MachineError, load_machine
from salient.machine.flux_map import ANGLE_INTERVALS, CURRENT_INTERVALS
from salient.machine.scaling import scaling_of

SAMPLES = 16
INTERVAL = 2.131
"""Half width of an interval of 95 % by the standard deviation of SAMPLES values: Student's t with 15 degrees."""
_NEIGHBOURS = (12, 5)
"""Parts of the angles and of the currents of a map within which points are neighbours."""
_NORMAL = 1.96
"""Likewise of the many samples of the shaft, and of what a map's smoothness hides."""
MAP_ANGLES, MAP_CURRENTS = ANGLE_INTERVALS + 1, CURRENT_INTERVALS
"""Points of the map in the file: angles and currents of the loader's grid, whose points are met exactly."""
_REST_FLUX = 1e-6
"""Least rise between two points of a map, of its largest flux linkage."""
_LEAST_SLOPE = 0.1
"""Least incremental inductance by the one of the unaligned phase, as in the fit."""
_FLAT_RESISTANCE, _FLAT_INERTIA, _FLAT_ANGLE_DEG, _FLAT_FLUX = 0.005, 0.02, 0.02, 0.001
"""Half widths of intervals up to which a quantity counts as determined."""
_NEAR_LIMIT = 0.8
"""Largest current of most pulses, part of the limit, from which the map goes to it; else it ends there."""
_EVENINGS = 6
"""Means over neighbouring currents until the loader's curve through the points rises everywhere."""
_DIGEST = 8
"""Digits of a map's content in the name of its file."""
_MODEL_PART = 0.008
"""Part by which inertia and friction are wrong without any noise (salient.experiments.identified); cause not known."""
CONDUCTANCE = "conductance of the iron for eddy currents"
NOT_OBSERVABLE = (
    ("gain of the current sensors", "a common error scales flux linkage, torque and resistance down, inertia up: the "
     "pulses would be the same; by a meter in series"),
    ("gain of the DC-link voltage", "scales flux linkage and resistance alike; by a voltmeter"),
    ("drop of a switch less that of a diode", "acts as a change of the DC-link voltage"),
    ("mutual coupling of the phases", "one phase alone carries current in each pulse"),
    ("hysteresis", "not in the model of the fit; it shows as its residual"),
    ("differences of the phases", "the map is one of all phases; their aligned angles are not"),
)


@dataclass(frozen=True)
class Quantity:
    """A row of the result: value and half width of the interval, in the unit; verdict: determined, uncertain, or a
    reason in words."""

    name: str
    unit: str
    value: float
    half_width: float
    verdict: str


@dataclass(frozen=True)
class _Maps:
    flux_Wb: np.ndarray
    flux_deviation: np.ndarray
    torque_Nm: np.ndarray
    torque_deviation: np.ndarray


@dataclass(frozen=True)
class Result:
    """flux_Wb, torque_Nm: on angles and currents of the map; ..._deviation: standard deviations there."""

    found: Findings
    fit: Fit
    shaft: Shaft
    rows: electrical.Rows
    log: np.ndarray
    limit_A: float
    supply_V: float
    angle_rad: np.ndarray
    current_A: np.ndarray
    flux_Wb: np.ndarray
    flux_deviation: np.ndarray
    torque_Nm: np.ndarray
    torque_deviation: np.ndarray
    corrected_Wb: float
    quantities: Sequence[Quantity]
    warnings: Sequence[str]


def result_of(found: Findings, log: np.ndarray, limit_A: float, samples: int = SAMPLES) -> Result:
    """The machine by the experiments. IdentifyError: they do not determine it."""
    pulses = [pulse for pulse in found.pulses if pulse.log["time_us"][-1] <= found.mapped_us]
    phases, common_A = len(found.phases), electrical.common_current_A(pulses)
    largest_A = limit_A if common_A >= _NEAR_LIMIT * limit_A else common_A
    rows = electrical.rows_of(found, pulses)
    fit = electrical.solve(rows, phases, found.rotor_poles, largest_A)
    others = electrical.resampled(rows, phases, fit, samples)
    rough = electrical.rougher(rows, phases, fit)
    shaft = shaft_of(found, fit, log)
    angle, current = np.meshgrid(np.linspace(0.0, math.pi / found.rotor_poles, MAP_ANGLES),
                                 np.linspace(0.0, largest_A, MAP_CURRENTS + 1)[1:], indexing="ij")
    raw, torque = fit.flux_Wb(angle, current), fit.torque_Nm(angle, current)
    flux = rising(raw)
    flux_deviation = map_deviation([other.flux_Wb(angle, current) for other in others], raw,
                                   rough.flux_Wb(angle, current))
    torque_deviation = map_deviation([other.torque_Nm(angle, current) for other in others], torque,
                                     rough.torque_Nm(angle, current))
    quiet = log[log["time_us"] < log["time_us"][0] + 20_000]
    maps = _Maps(flux, flux_deviation, torque, torque_deviation)
    return Result(found, fit, shaft, rows, log, limit_A, float(np.median(quiet["dc_link_V"])), angle, current, flux,
                  flux_deviation, torque, torque_deviation, float(np.abs(flux - raw).max()),
                  _quantities(found, fit, others, shaft, maps),
                  _warnings(found, fit))


def deviation_of(samples: Sequence[Any]) -> np.ndarray:
    """Standard deviation of resampled values, about their own mean."""
    return np.asarray(np.std(np.asarray(samples, float), axis=0, ddof=1))


def map_deviation(samples: Sequence[np.ndarray], of: np.ndarray, rougher: np.ndarray) -> np.ndarray:
    """Deviation of the points of a map: of resampled ones, and the difference to a rougher one, for what the smoothness
    hides. That is no scatter, so that both add up, and it has a sign: its size is the neighbours', by the
    mean of squares, not where it happens to be 0."""
    near = tuple(max(1, points // parts) for points, parts in zip(of.shape, _NEIGHBOURS, strict=True))
    hidden = np.sqrt(ndimage.uniform_filter((rougher - of) ** 2, near, mode="nearest"))
    return np.asarray(deviation_of(samples) + _NORMAL / INTERVAL * hidden)


def rising(flux_Wb: np.ndarray) -> np.ndarray:
    """The map nearest to a map in its points that falls from aligned to unaligned and rises with the current, as far as
    means of what contradicts it and of its neighbours go: the mean of the upper and the lower monotonic envelope."""
    least = max(_REST_FLUX * float(flux_Wb.max()), _LEAST_SLOPE * float(flux_Wb[-1].max()) / flux_Wb.shape[1])
    ramp = least * np.arange(1, flux_Wb.shape[1] + 1)

    def monotonic(of: np.ndarray, axis: int) -> np.ndarray:
        upper = np.maximum.accumulate(of, axis=axis)
        lower = np.flip(np.minimum.accumulate(np.flip(of, axis), axis=axis), axis)
        return np.asarray((upper + lower) / 2.0)

    inner = np.maximum(flux_Wb, ramp) - ramp
    for _ in range(8):
        inner = monotonic(monotonic(inner, 1)[::-1], 0)[::-1]
    return np.asarray(inner + ramp)


def _verdict(half_width: float, bound: float) -> str:
    return "determined" if half_width <= bound else "uncertain"


def _quantities(found: Findings, fit: Fit, others: Sequence[Fit], shaft: Shaft, maps: _Maps) -> list[Quantity]:
    flux, torque = maps.flux_Wb, maps.torque_Nm
    flux_deviation, torque_deviation = maps.flux_deviation, maps.torque_deviation

    def half(values: Any) -> float:
        return INTERVAL * float(deviation_of(list(values)))

    resistance = half(other.resistance_ohm for other in others)
    conductance = half(other.conductance_S for other in others)
    inertia = math.hypot(_NORMAL * shaft.inertia[1], _MODEL_PART * shaft.inertia[0])
    friction = math.hypot(_NORMAL * shaft.friction[1], _MODEL_PART * shaft.friction[0])
    angle_deg = max(half(math.degrees(other.delta_rad[row]) for other in others) for row in range(len(found.phases)))
    aligned_deg = math.degrees(2.0 * math.pi * found.position[found.phases[0]] + fit.delta_rad[0])
    largest, strongest = float(flux.max()), float(np.abs(torque).max())
    rms = INTERVAL * float(np.sqrt(np.mean(flux_deviation**2))) / largest
    torque_rms = INTERVAL * float(np.sqrt(np.mean(torque_deviation**2))) / strongest
    eccentricity = math.degrees(math.hypot(*fit.eccentricity_rad))
    return [
        Quantity("largest flux linkage", "Wb", largest, rms * largest, _verdict(rms, _FLAT_FLUX)),
        Quantity("largest torque of a phase", "N m", strongest, torque_rms * strongest,
                 _verdict(torque_rms, 4.0 * _FLAT_FLUX)),
        Quantity("resistance of winding and devices", "ohm", fit.resistance_ohm, resistance,
                 _verdict(resistance / max(fit.resistance_ohm, 1e-12), _FLAT_RESISTANCE)),
        Quantity("mean drop of a device", "V", fit.drop_V, half(other.drop_V for other in others), "determined"),
        Quantity("encoder at the aligned position of phase a", "deg", aligned_deg % (360.0 / found.rotor_poles),
                 angle_deg, _verdict(angle_deg, _FLAT_ANGLE_DEG)),
        Quantity("eccentricity of the encoder", "deg", eccentricity,
                 half(math.degrees(math.hypot(*other.eccentricity_rad)) for other in others), "determined"),
        Quantity("delay of the current sensors", "us", 1e6 * fit.delay_s, half(1e6 * other.delay_s for other in others),
                 "determined"),
        Quantity(CONDUCTANCE, "S", fit.conductance_S, conductance,
                 "determined" if abs(fit.conductance_S) > conductance else "within its uncertainty"),
        Quantity("inertia", "kg m^2", shaft.inertia[0], inertia, _verdict(inertia / shaft.inertia[0], _FLAT_INERTIA)),
        Quantity("viscous friction", "N m s", shaft.friction[0], friction,
                 _verdict(friction / max(abs(shaft.friction[0]), 1e-12), 0.1)),
        Quantity("Coulomb friction", "N m", shaft.coulomb[0], _NORMAL * shaft.coulomb[1],
                 "no key of a machine file" if shaft.coulomb[0] else "within its uncertainty"),
        Quantity("constant load", "N m", shaft.load[0], _NORMAL * shaft.load[1],
                 "no key of a machine file" if shaft.load[0] else "within its uncertainty"),
    ]


def _warnings(found: Findings, fit: Fit) -> list[str]:
    """Reasons that keep the drive from running on the file, a line each."""
    lines = []
    order = [found.order[phase] for phase in found.phases]
    if order != list(range(len(order))):
        reverse = order == [-k % len(order) for k in range(len(order))]
        names = ", ".join(f"{'abcdef'[phase]} is {'abcdef'[found.order[phase]]}" for phase in found.phases
                          if found.order[phase] != found.phases.index(phase))
        lines.append("the encoder counts against the order of the phases: exchange two phases, or its direction"
                     if reverse else f"the phases are wired in another order: {names}")
    aligned = math.remainder(math.degrees(2.0 * math.pi * found.position[found.phases[0]] + fit.delta_rad[0]),
                             360.0 / found.rotor_poles)
    if abs(aligned) > 0.5:
        lines.append(f"the encoder reads {aligned:+.3f} degrees where phase a is aligned: set its zero there; the "
                     "drive has no parameter for it")
    return lines


# --- the machine file ------------------------------------------------------------------------------------------------

def write_machine(result: Result, plate: Path, path: Path,
                  page: Callable[[Machine, Path], None] = lambda _, __: None) -> Machine:
    """Writes the machine file with its map beside it: motor by the result, board and ratings by the name plate's file.
    page: writes the page of the machine to a path, which then has the file's name with .html. Returns the machine as
    the loader reads it. IdentifyError: the loader refuses it, by its reason.

    The map has a name by its content, and the machine file is replaced in one step after it: whatever ends this
    process, the file that is there is the old one or the new one, with its own map. What is left by a process that was
    killed here is removed by the next one."""
    machine = load_machine(plate)
    data = scaling_of(plate, machine).data
    board = {"adc_current_A": data.adc_current_A, "adc_voltage_V": data.adc_voltage_V}
    of_plate = tomllib.loads(plate.read_text(encoding="utf-8-sig"))
    path.parent.mkdir(parents=True, exist_ok=True)
    for left in path.parent.glob(f"{glob.escape(_staging(path))}*"):
        shutil.rmtree(left, ignore_errors=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=_staging(path)) as folder:
        staged = Path(folder) / path.name
        flux_Wb = result.flux_Wb
        for evenings in range(_EVENINGS + 1):
            rows = _map_text(result, flux_Wb)
            table = path.with_name(f"{path.stem}_{hashlib.sha256(rows.encode()).hexdigest()[:_DIGEST]}.csv")
            staged.with_name(table.name).write_text(rows, encoding="utf-8")
            staged.write_text(_text(result, of_plate, machine, board, path.stem, table.name), encoding="utf-8")
            try:
                found = load_machine(staged)
                scaling_of(path, found)
                break
            except MachineError as error:
                if evenings == _EVENINGS:
                    reason = str(error).removeprefix(f"{staged}: ")
                    raise IdentifyError(f"the measured machine is refused: {reason}") from None
            flux_Wb = evened(flux_Wb)
        page(found, staged.with_suffix(".html"))
        staged.with_name(table.name).replace(table)
        staged.replace(path)
        if staged.with_suffix(".html").exists():
            staged.with_suffix(".html").replace(path.with_suffix(".html"))
    for other in _earlier_maps(path):
        if other != table:
            other.unlink(missing_ok=True)
    return load_machine(path)


def _earlier_maps(path: Path) -> list[Path]:
    """Maps of earlier identifications into a machine file: their name has the digest of their content, and no other
    file beside them, as a copy that has become the next name plate, names them."""
    others = [each.read_bytes() for each in path.parent.glob("*.toml") if each.name != path.name]
    return [each for each in path.parent.glob(f"{glob.escape(path.stem)}_*.csv")
            if each.stem == f"{path.stem}_{hashlib.sha256(each.read_bytes()).hexdigest()[:_DIGEST]}"
            and not any(each.name.encode() in other for other in others)]


def _staging(path: Path) -> str:
    """Start of the name of the folder in which a machine file is written."""
    return f".{path.name}."


def _map_text(result: Result, flux_Wb: np.ndarray) -> str:
    lines = ["# measured by the drive: tools/salient identify", "angle_deg,current_A,flux_linkage_Wb"]
    lines += [f"{math.degrees(each[0]):.9g},{each[1]:.9g},{each[2]:.9g}" for each in
              zip(result.angle_rad.ravel(), result.current_A.ravel(), flux_Wb.ravel(), strict=True)]
    return "\n".join(lines) + "\n"


def evened(flux_Wb: np.ndarray) -> np.ndarray:
    """A map whose rises over the current are means of their neighbours, weighted 1 2 1."""
    rises = np.diff(flux_Wb, axis=1, prepend=0.0)
    padded = np.hstack([rises[:, :1], rises, rises[:, -1:]])
    return np.asarray(np.cumsum((padded[:, :-2] + 2.0 * padded[:, 1:-1] + padded[:, 2:]) / 4.0, axis=1))


def _text(result: Result, plate: Mapping[str, Any], machine: Machine, board: Mapping[str, float], name: str,
          table: str) -> str:
    fit, shaft = result.fit, result.shaft
    converter = dict(plate.get("converter", {}))
    of_devices = sum(machine.converter.get(name, 0.0) for name in ("switch_resistance_ohm", "diode_resistance_ohm"))
    if not any(name in converter for name in ("switch_drop_V", "diode_drop_V")) and fit.drop_V > 0.0:
        converter |= {"switch_drop_V": round(fit.drop_V, 4), "diode_drop_V": round(fit.drop_V, 4)}
    converter["supply_voltage_V"] = round(result.supply_V, 1)
    drive = {name: value for name, value in plate.get("drive", {}).items() if name != "parameters"}
    drive |= {**board, "current_peak_A": _downwards(float(result.current_A[0, -1]))}
    resistance = fit.resistance_ohm - of_devices
    if resistance <= 0.0:
        raise IdentifyError(f"resistance {fit.resistance_ohm:.4g} ohm: less than that of the devices, {of_devices:.4g}")
    tables: dict[str, Mapping[str, Any]] = {
        "poles": plate["poles"],
        "winding": {"resistance_ohm": float(f"{resistance:.6g}")},
        "mechanics": {"inertia_kg_m2": float(f"{shaft.inertia[0]:.6g}"),
                      "friction_Nm_s": float(f"{max(shaft.friction[0], 0.0):.6g}")},
        "magnetics": {"form": "map", "file": table},
        "converter": converter,
        **_eddy_current(result),
        **{name: plate[name] for name in ("dc_link", "thermal") if name in plate},
        "drive": drive,
    }
    if plate.get("drive", {}).get("parameters"):
        tables["drive.parameters"] = plate["drive"]["parameters"]
    return machine_text("Measured by the drive: tools/salient identify; board and ratings of its name plate.",
                        name, tables)


def _eddy_current(result: Result) -> dict[str, Mapping[str, Any]]:
    """The table of the file, for the emulator alone; none while the conductance is within its uncertainty, or without
    effect by the loader's bounds."""
    found = next(each for each in result.quantities if each.name == CONDUCTANCE)
    decay_s = found.value * float(result.flux_Wb[-1, 0] / result.current_A[-1, 0])
    if found.value <= found.half_width or not EDDY_TIME_CONSTANT_S[0] <= decay_s <= EDDY_TIME_CONSTANT_S[1]:
        return {}
    return {"eddy_current": {"conductance_S": float(f"{found.value:.4g}")}}


def _downwards(value: float) -> float:
    """With six digits, and not above the largest current of the map."""
    digit = 10.0 ** (math.floor(math.log10(value)) - 5)
    return float(f"{math.floor(value / digit * (1.0 + 1e-12)) * digit:.6g}")


def machine_text(about: str, name: str, tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Text of a machine file. about: a comment at its top; tables: keys by the names of their tables."""
    checked = "".join(letter if letter.isascii() and letter.isalnum() else "_" for letter in name)
    lines = [f"# {about}", f'name = "{checked}"']
    for title, keys in tables.items():
        lines += ["", f"[{title}]", *(f"{key} = {_toml(value)}" for key, value in keys.items())]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)
