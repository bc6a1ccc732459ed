"""Machine files with a flux-linkage map, sampled from the formulas of the bundled machines."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from salient.machine.file import load_machine
from salient.machine.magnetics import Formula
from salient.paths import MACHINES

HALF_DEG = 45.0
CURRENT_MAX_A = 100.0
REGULAR_DEG = np.linspace(0.0, HALF_DEG, 20)
REGULAR_A = np.linspace(CURRENT_MAX_A / 20, CURRENT_MAX_A, 20)


@cache
def formula(name: str) -> Formula:
    """Magnetics of a bundled machine."""
    magnetics = load_machine(MACHINES / f"{name}.toml").magnetics
    assert isinstance(magnetics, Formula)
    return magnetics


def irregular(angles: int = 20, currents: int = 20) -> tuple[np.ndarray, list[np.ndarray]]:
    """Grid as measured on a bench: angles off by up to 60 % of their spacing; separate currents at each angle, denser
    where the iron saturates, off by up to 20 %, the last within 4 % of the maximum."""
    rng = np.random.default_rng(7)
    inner = np.linspace(0.0, HALF_DEG, angles)[1:-1]
    angles_deg = np.array([0.0, *(inner + HALF_DEG / (angles - 1) * rng.uniform(-0.3, 0.3, len(inner))), HALF_DEG])
    even_A = CURRENT_MAX_A * np.linspace(0.0, 1.0, currents + 1)[1:] ** 1.5
    currents_A = []
    for _ in angles_deg:
        values_A = even_A * rng.uniform(0.9, 1.1, currents)
        values_A[-1] = CURRENT_MAX_A * rng.uniform(1.0, 1.04)
        currents_A.append(np.sort(values_A))
    return angles_deg, currents_A


def rows(magnetics: Formula, angles_deg: Sequence[float], currents_A: Sequence) -> list[tuple[float, float, float]]:
    """Points (angle in deg, current in A, flux linkage in Wb); currents_A: for all angles, or per angle."""
    return [
        (float(angle_deg), float(current_A), float(magnetics.flux_linkage_Wb(math.radians(angle_deg), current_A)))
        for at, angle_deg in enumerate(angles_deg)
        for current_A in (currents_A if np.ndim(currents_A[0]) == 0 else currents_A[at])
    ]


def csv_text(points: Sequence[tuple[float, float, float]]) -> str:
    lines = [f"{angle:.12g},{current:.12g},{flux:.12g}" for angle, current, flux in points]
    return "\n".join(["angle_deg,current_A,flux_linkage_Wb", *lines, ""])


def write_machine(
    folder: Path, name: str, csv: str | bytes, change: Callable[[str], str] = lambda text: text
) -> Path:
    """Writes NAME.csv and NAME.toml, the saturating machine with a map instead of its formula; returns the path."""
    text = (MACHINES / "saturating.toml").read_text(encoding="utf-8")
    before, rest = text.split("[magnetics]\n")
    _, after = rest.split("\n[", 1)
    text = f'{before}[magnetics]\nform = "map"\nfile = "{name}.csv"\n\n[{after}'
    (folder / f"{name}.csv").write_bytes(csv.encode() if isinstance(csv, str) else csv)
    path = folder / f"{name}.toml"
    path.write_text(change(text.replace('name = "saturating"', f'name = "{name}"')), encoding="utf-8")
    return path
