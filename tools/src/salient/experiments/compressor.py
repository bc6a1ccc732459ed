"""Torque of a reciprocating compressor over the crank angle: the load profiles of tools/loads.

    build/venv/bin/python -m salient.experiments.compressor tools/loads

Slider-crank of radius r and rod length l = r / RATIO, angle a from top dead centre (J. E. Shigley, J. J. Uicker,
"Theory of Machines and Mechanisms", McGraw-Hill, 1980):

    x / r = 1 - cos a + (1 - sqrt(1 - RATIO^2 sin^2 a)) / RATIO
    dx/da / r = sin a + RATIO sin a cos a / sqrt(1 - RATIO^2 sin^2 a)

Ideal cycle of a single-acting cylinder, valves without losses: with the volume V = x / (2 r) + CLEARANCE in swept
volumes, p V^EXPONENT is constant while both valves are closed. On the way down the gas left in the clearance expands
from the discharge pressure to the suction pressure, on the way up it is compressed from the suction pressure to the
discharge pressure. The crankcase is at suction pressure, so the torque against the shaft is

    T = -(p - p_suction) area dx/da

Inertia of the piston and friction are left out. Profiles are divided by their mean, so that load_profile_Nm is the mean
torque; several cylinders are equally spaced.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

RATIO = 0.25  # crank radius / rod length
CLEARANCE = 0.05  # of the swept volume
EXPONENT = 1.25  # polytropic, cooled cylinder
PRESSURE_RATIO = 4.0  # discharge / suction
VALUES = 256

PROFILES = {"compressor_one_cylinder": 1, "compressor_two_cylinders": 2}


def cylinder_torque(angle_rad: np.ndarray) -> np.ndarray:
    """Torque against the shaft of one cylinder, in suction pressure * area * crank radius; 0 at top dead centre."""
    sine, cosine = np.sin(angle_rad), np.cos(angle_rad)
    root = np.sqrt(1.0 - (RATIO * sine) ** 2)
    volume = (1.0 - cosine + (1.0 - root) / RATIO) / 2.0 + CLEARANCE
    expansion = np.maximum(1.0, PRESSURE_RATIO * (CLEARANCE / volume) ** EXPONENT)
    compression = np.minimum(PRESSURE_RATIO, ((1.0 + CLEARANCE) / volume) ** EXPONENT)
    pressure = np.where(angle_rad % (2.0 * np.pi) < np.pi, expansion, compression)
    torque: np.ndarray = -(pressure - 1.0) * (sine + RATIO * sine * cosine / root)
    return torque


def compressor_torque(cylinders: int, values: int = VALUES) -> np.ndarray:
    """Torque over one turn at equal steps of the angle, divided by its mean."""
    angle_rad = np.arange(values) * 2.0 * np.pi / values
    torque = sum(cylinder_torque(angle_rad + 2.0 * np.pi * n / cylinders) for n in range(cylinders))
    return np.asarray(torque / np.mean(torque))


def main(folder: Path) -> None:
    """Writes the bundled profiles."""
    for name, cylinders in PROFILES.items():
        torque = compressor_torque(cylinders)
        rows = "\n".join(f"{360.0 * n / VALUES:.5f},{value:.6f}" for n, value in enumerate(torque))
        (folder / f"{name}.csv").write_text(
            f"# Load torque of a reciprocating compressor, cylinders: {cylinders}, over the mechanical rotor angle"
            " from\n"
            "# top dead centre of the first; divided by its mean: load_profile_Nm (rig.dbc) is the mean torque."
            " Model:\n"
            f"# slider-crank, crank / rod {RATIO:g}, polytropic compression with exponent {EXPONENT:g} to"
            f" {PRESSURE_RATIO:g} times the suction\n"
            f"# pressure, clearance {100 * CLEARANCE:g} %; tools/src/salient/experiments/compressor.py. Made by\n"
            "#     build/venv/bin/python -m salient.experiments.compressor tools/loads\n"
            f"angle_deg,torque\n{rows}\n", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
