"""Random machines by flux-linkage map, of stator and rotor pole arcs of 0.3 to 0.5 of a pitch, reproducible by number:
machine files without a table [drive], with their maps.

The inductance follows the overlap of the poles, rounded by their fringing fields; aligned poles saturate. Torque arises
over the overlap only, which with three phases is little more than a stroke: an arc is at least 0.345 of a pitch there.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from salient.paths import BUILD, keep_text

SEED = 20261127
COUNT = 20
FOLDER = BUILD / "random_maps"

_POLES = ((6, 4, 3), (8, 6, 4), (12, 8, 3))
_SUPPLIES_V = (24.0, 48.0, 110.0, 240.0, 400.0, 700.0)
_ARC = {3: (0.345, 0.45), 4: (0.3, 0.45)}
"""Arcs of the stator poles, in pitches, by phases."""
_ANGLES, _CURRENTS = 97, 17
_CURRENT_OVER = 2.0
"""Largest current of the map over the machine's."""


def random_map(number: int) -> tuple[str, str]:
    """The texts of a machine file and of its map, number 0 or more."""
    draw = np.random.default_rng((SEED, number))

    def between(low: float, high: float) -> float:
        return float(draw.uniform(low, high))

    def logarithmic(low: float, high: float) -> float:
        return math.exp(between(math.log(low), math.log(high)))

    stator, rotor, phases = _POLES[number % len(_POLES)]
    supply_V = _SUPPLIES_V[int(draw.integers(len(_SUPPLIES_V)))]
    arc = between(*_ARC[phases])
    rotor_arc = min(arc + between(0.0, 0.05), 0.5)
    base_rpm, power_W = logarithmic(300.0, 4000.0), logarithmic(0.5, 60.0) * supply_V
    base_rad_s = base_rpm * math.pi / 30.0
    torque_Nm = power_W / base_rad_s
    # The voltage builds up the aligned flux linkage in a fifth of an electrical revolution.
    flux_Wb = supply_V * 2.0 * math.pi / rotor / 5.0 / base_rad_s
    current_A = 2.0 * math.pi * torque_Nm / (phases * rotor) / (0.6 * flux_Wb)
    saturation, saturated_share = between(1.5, 3.5), between(0.1, 0.25)
    saturated_H = saturated_share * flux_Wb / current_A
    knee_Wb = (1.0 - saturated_share) * flux_Wb / (1.0 - math.exp(-saturation))
    aligned_H = saturated_H + knee_Wb * saturation / current_A
    unaligned_H = max(aligned_H / between(6.0, 14.0), 1.05 * saturated_H)
    resistance_ohm = between(0.01, 0.06) * supply_V / current_A

    angle_deg = np.linspace(0.0, 180.0, _ANGLES)  # electrical, from aligned
    overlap = _overlap(angle_deg, 360.0 * arc, 360.0 * rotor_arc, between(3.0, 10.0))
    lines = ["angle_deg,current_A,flux_linkage_Wb"]
    for angle, part in zip(angle_deg / rotor, overlap, strict=True):
        for ampere in np.arange(1, _CURRENTS + 1) / _CURRENTS * _CURRENT_OVER * current_A:
            aligned_Wb = saturated_H * ampere + knee_Wb * (1.0 - math.exp(-saturation * ampere / current_A))
            value_Wb = unaligned_H * ampere + part * max(aligned_Wb - unaligned_H * ampere, 0.0)
            lines.append(f"{angle:.6f},{ampere:.6g},{value_Wb:.8g}")
    name = f"random_map_{number:02}"
    return f"""\
# Random machine {number} of seed {SEED}: pole arcs of {arc:.3f} and {rotor_arc:.3f} of a pitch, {torque_Nm:.3g} N m at
# {base_rpm:.0f} r/min, {current_A:.3g} A.
name = "{name}"
[poles]
stator = {stator}
rotor = {rotor}
[winding]
resistance_ohm = {resistance_ohm:.4g}
[mechanics]
inertia_kg_m2 = {logarithmic(2e-5, 2e-4) * torque_Nm ** (5.0 / 3.0):.4g}
friction_Nm_s = {logarithmic(0.001, 0.01) * torque_Nm / base_rad_s:.4g}
[magnetics]
form = "map"
file = "{name}.csv"
[converter]
supply_voltage_V = {supply_V:g}
""", "\n".join(lines) + "\n"


def _overlap(angle_deg: np.ndarray, stator_deg: float, rotor_deg: float, fringe_deg: float) -> np.ndarray:
    """From 1 aligned to 0 unaligned, smoothed by a Gaussian of the width of the fringing field."""
    grid_deg = np.arange(-540.0, 540.5, 0.5)
    distance_deg = np.abs((grid_deg + 180.0) % 360.0 - 180.0)
    begin_deg, full_deg = 0.5 * (stator_deg + rotor_deg), 0.5 * abs(rotor_deg - stator_deg)
    sharp = np.clip((begin_deg - distance_deg) / (begin_deg - full_deg), 0.0, 1.0)
    kernel = np.exp(-0.5 * (np.arange(-60.0, 60.5, 0.5) / fringe_deg) ** 2)
    smooth = np.convolve(sharp, kernel / kernel.sum(), mode="same")
    part = np.interp(angle_deg, grid_deg, smooth)
    result: np.ndarray = (part - part[-1]) / (part[0] - part[-1])
    return result


def random_map_files(numbers: range = range(COUNT)) -> list[Path]:
    """Files of random machines, written when they are missing."""
    files = []
    for number in numbers:
        texts = random_map(number)
        paths = [FOLDER / f"random_map_{number:02}.{suffix}" for suffix in ("toml", "csv")]
        for path, text in zip(paths, texts, strict=True):
            keep_text(path, text)
        files.append(paths[0])
    return files
