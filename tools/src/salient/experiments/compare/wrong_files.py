"""Machine files with a stated error, beside the right one: a file of the firmware for the motor of another.

The error of the magnetics is one of the flux linkage psi(theta, i) as a whole, so that torque, co-energy and inductance
agree with each other and the loader takes them for a machine's. psi_a, psi_u: rotor aligned, unaligned.

- saturation s: psi' = s psi(theta, i / s); the iron saturates at s times the current and flux linkage, inductances
  without saturation stay
- flux k: psi' = psi_u + k (psi - psi_u)
- unaligned inductance u: psi' = psi + (u - 1) psi_u (psi_a - psi) / (psi_a - psi_u); nothing changes aligned

A formula stays a formula, of other keys. A map is read at the knots of its model, where the model meets its points.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from salient.machine.definition import Machine, MachineError
from salient.machine.file import load_machine
from salient.machine.flux_map import ANGLE_INTERVALS, CURRENT_INTERVALS, FluxMap
from salient.machine.magnetics import Formula
from salient.paths import BUILD
from salient.toml_file import read_toml, toml_text

FOLDER = BUILD / "mismatch"


@dataclass(frozen=True)
class Fault:
    """Error of a machine file: factors of its values, by the motor's. angle_deg: by which the encoder's zero is
    displaced from the aligned position, mechanical; no key of a file has it."""

    flux: float = 1.0
    saturation: float = 1.0
    unaligned: float = 1.0
    resistance: float = 1.0
    inertia: float = 1.0
    friction: float = 1.0
    angle_deg: float = 0.0

    @property
    def in_magnetics(self) -> bool:
        """The flux linkage is another one."""
        return (self.flux, self.saturation, self.unaligned) != (1.0, 1.0, 1.0)

    @property
    def in_file(self) -> bool:
        """The file is another one."""
        return self != Fault(angle_deg=self.angle_deg)


FAULTS: dict[str, Fault] = {
    **{f"flux linkage x {factor:g}": Fault(flux=factor) for factor in (0.8, 0.9, 1.1, 1.2)},
    **{f"saturation current x {factor:g}": Fault(saturation=factor) for factor in (0.8, 1.25)},
    **{f"unaligned inductance x {factor:g}": Fault(unaligned=factor) for factor in (0.9, 1.1)},
    **{f"angle {angle_deg:g} deg": Fault(angle_deg=angle_deg) for angle_deg in (0.5, 1.0)},
    **{f"resistance x {factor:g}": Fault(resistance=factor) for factor in (0.7, 1.3)},
    **{f"inertia x {factor:g}": Fault(inertia=factor) for factor in (0.5, 2.0)},
    **{f"friction x {factor:g}": Fault(friction=factor) for factor in (0.2, 5.0)},
}
"""One error each, by its name."""
SEED, DRAWS = 50, 5


def random_fault(number: int) -> Fault:
    """All errors at once, within the range of the single ones, reproducible by number."""
    draw = np.random.default_rng((SEED, number))

    def factor(most: float, least: float) -> float:
        return float(f"{math.exp(draw.uniform(math.log(least), math.log(most))):.4g}")

    return Fault(flux=factor(1.2, 0.8), saturation=factor(1.25, 0.8), unaligned=factor(1.1, 0.9),
                 resistance=factor(1.3, 0.7), inertia=factor(2.0, 0.5), friction=factor(5.0, 0.2),
                 angle_deg=round(float(draw.uniform(-1.0, 1.0)), 3))


def every_fault() -> dict[str, Fault]:
    """The single errors and the random samples of all of them, by name."""
    return FAULTS | {f"all at random {number}": random_fault(number) for number in range(1, DRAWS + 1)}


def wrong_file(right: Path, fault: Fault, name: str, folder: Path) -> Path | None:
    """The machine file with the error, written with its map to a folder when it is not there yet; the right one where
    the error is not one of the file. None: saturation of a machine that has none. MachineError: the loader refuses it,
    one line that names the file and the key; then nothing is left in the folder."""
    if not fault.in_file:
        return right
    machine = _loaded(right)
    if fault == Fault(saturation=fault.saturation) and isinstance(machine.magnetics, Formula) and (
            machine.magnetics.form != "saturating"):
        return None
    stem = f"{machine.name}_{_word(name)}"
    texts = _texts(machine, right, fault, name, stem)
    paths = {folder / file: text for file, text in texts.items()}
    toml = folder / f"{stem}.toml"
    if any(not path.exists() or path.read_text(encoding="utf-8") != text for path, text in paths.items()):
        folder.mkdir(parents=True, exist_ok=True)
        _put_in_place(texts, toml)
    return toml


def _put_in_place(texts: dict[str, str], toml: Path) -> None:
    """The files, whole and taken by the loader, beside the machine file: another process that reads or writes the same
    ones never sees half of one. MachineError: nothing is there."""
    with tempfile.TemporaryDirectory(dir=toml.parent) as temporary:
        for file, text in texts.items():
            (Path(temporary) / file).write_text(text, encoding="utf-8")
        try:
            load_machine(Path(temporary) / toml.name)
        except MachineError as error:
            raise MachineError(str(error).replace(temporary, str(toml.parent))) from error
        for file in texts:
            (Path(temporary) / file).replace(toml.parent / file)


@lru_cache(maxsize=16)
def _loaded(right: Path) -> Machine:
    """The right machine; a map takes half a second."""
    return load_machine(right)


def _word(name: str) -> str:
    return name.replace(" x ", " ").replace(" ", "_").replace(".", "")


def _texts(machine: Machine, right: Path, fault: Fault, name: str, stem: str) -> dict[str, str]:
    """The texts of the machine file and, where it has one, of its map, by the name of the file."""
    data = read_toml(right)
    data["name"] = stem
    for table, key, factor in (("winding", "resistance_ohm", fault.resistance),
                               ("mechanics", "inertia_kg_m2", fault.inertia),
                               ("mechanics", "friction_Nm_s", fault.friction)):
        data[table][key] = _rounded(data[table][key] * factor)
    about = f"# {machine.name} with {name}: wrong on purpose, by `compare mismatch`. {_shown(fault)}\n"
    maps: dict[str, str] = {}
    if isinstance(machine.magnetics, FluxMap):
        file = data["magnetics"]["file"] = f"{stem}.csv"
        maps[file] = about + _map_text(wrong_map(machine.magnetics, fault)) if fault.in_magnetics else (
            Path(str(machine.magnetics.file)).read_text(encoding="utf-8-sig"))
    else:
        data["magnetics"] |= wrong_formula(machine.magnetics, fault)
    return {**maps, f"{stem}.toml": about + toml_text(data)}


def _shown(fault: Fault) -> str:
    factors = [f"{key} {value:g}" for key, value in vars(fault).items() if value != getattr(Fault(), key)]
    return "; ".join(factors)


def _rounded(value: float) -> float:
    return float(f"{value:.9g}")


def wrong_formula(formula: Formula, fault: Fault) -> dict[str, float]:
    """The keys of the formula with the error that differ."""
    keys = formula.parameters
    unaligned_H = keys["unaligned_inductance_H"]

    def scaled_H(key: str) -> float:
        return unaligned_H + fault.flux * (keys[key] - unaligned_H)

    wrong = {"unaligned_inductance_H": fault.unaligned * unaligned_H,
             "aligned_inductance_H": scaled_H("aligned_inductance_H")}
    if formula.form == "saturating":
        saturated_H, point_A = keys["saturated_inductance_H"], keys["current_at_flux_linkage_max_A"]
        iron_Wb = keys["flux_linkage_max_Wb"] - saturated_H * point_A
        wrong["saturated_inductance_H"] = scaled_H("saturated_inductance_H")
        wrong["current_at_flux_linkage_max_A"] = fault.saturation * point_A
        wrong["flux_linkage_max_Wb"] = fault.saturation * (
            wrong["saturated_inductance_H"] * point_A + fault.flux * iron_Wb)
    return {key: value for key, value in ((key, _rounded(value)) for key, value in wrong.items())
            if not math.isclose(value, keys[key], rel_tol=1e-8)}


def wrong_map(flux_map: FluxMap, fault: Fault) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles in rad from aligned to unaligned, currents in A above 0, and flux linkages in Wb by angle and current."""
    angle_rad = np.linspace(0.0, flux_map.pitch_rad / 2.0, ANGLE_INTERVALS + 1)
    current_A = np.linspace(0.0, flux_map.current_max_A, CURRENT_INTERVALS + 1)[1:]
    flux_Wb = fault.saturation * flux_map.flux_linkage_Wb(angle_rad[:, None], current_A)
    unaligned_Wb = flux_Wb[-1]
    flux_Wb = unaligned_Wb + fault.flux * (flux_Wb - unaligned_Wb)
    aligned_Wb = flux_Wb[0]
    away = (aligned_Wb - flux_Wb) / (aligned_Wb - unaligned_Wb)
    return angle_rad, fault.saturation * current_A, flux_Wb + (fault.unaligned - 1.0) * unaligned_Wb * away


def _map_text(points: tuple[np.ndarray, np.ndarray, np.ndarray]) -> str:
    angle_rad, current_A, flux_Wb = points
    rows = [f"{angle:.9g},{current:.9g},{flux:.9g}"
            for angle, fluxes in zip(np.degrees(angle_rad), flux_Wb, strict=True)
            for current, flux in zip(current_A, fluxes, strict=True)]
    return "\n".join(["angle_deg,current_A,flux_linkage_Wb", *rows, ""])
