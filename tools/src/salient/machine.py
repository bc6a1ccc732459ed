"""Machine files: one TOML file describes a motor to the emulator and to the firmware alike.

`load_machine` reads and checks a file; every mistake is a `MachineError` of one line that names the file and the key.
The magnetics are those of `emulator/plant/magnetics.h`, written here a second time in NumPy because the firmware's
tables are computed from them and the tests compare the emulator with them.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path

SHIPPED = Path(__file__).resolve().parents[2] / "machines"

FORMS = ("linear_cosine", "linear_trapezoid", "saturating")

# Phases by stator and rotor poles.
_PHASES = {(6, 4): 3, (8, 6): 4, (12, 8): 3}

# (minimum, maximum) of every number, both allowed. Wide enough for any machine that the number formats of the firmware
# can carry (inertia and friction are Q1.30 there).
_RANGES: dict[str, dict[str, tuple[float, float]]] = {
    "winding": {"resistance_ohm": (1e-4, 100.0)},
    "mechanics": {"inertia_kg_m2": (1e-4, 1.9), "friction_Nm_s": (0.0, 1.9)},
    "converter": {"supply_voltage_V": (10.0, 500.0)},
}
_INDUCTANCES = {"unaligned_inductance_H": (1e-5, 10.0), "aligned_inductance_H": (1e-5, 10.0)}
_MAGNETICS: dict[str, dict[str, tuple[float, float]]] = {
    "linear_cosine": _INDUCTANCES,
    "linear_trapezoid": _INDUCTANCES | {"flat_deg": (0.0, 20.0), "blend_deg": (0.01, 20.0)},
    "saturating": _INDUCTANCES
    | {
        "saturated_inductance_H": (1e-6, 10.0),
        "flux_linkage_max_Wb": (1e-3, 100.0),
        "current_at_flux_linkage_max_A": (1.0, 10000.0),
    },
}


class MachineError(ValueError):
    """A machine file that cannot be used; the text is one line for the user."""


@dataclass(frozen=True)
class Machine:
    """A motor, its converter's supply and its magnetics, in SI units."""

    name: str
    stator_poles: int
    rotor_poles: int
    phases: int
    resistance_ohm: float
    inertia_kg_m2: float
    friction_Nm_s: float
    supply_voltage_V: float
    form: str
    magnetics: dict[str, float]

    @property
    def pitch_rad(self) -> float:
        """Rotor pole pitch."""
        return 2.0 * math.pi / self.rotor_poles

    @property
    def current_rise_A_s(self) -> float:
        """Current slope at the supply voltage with the rotor unaligned and at rest, A/s."""
        return self.supply_voltage_V / self.magnetics["unaligned_inductance_H"]

    def position_factor(self, angle_rad):
        """f and df/dtheta (1/rad) at a phase angle: f is 1 aligned, 0 unaligned. NumPy arrays welcome."""
        import numpy as np

        half = self.pitch_rad / 2.0
        wrapped = np.mod(np.asarray(angle_rad, dtype=float) + half, self.pitch_rad) - half
        distance, sign = np.abs(wrapped), np.sign(wrapped)
        if self.form == "linear_cosine":
            f = 0.5 * (1.0 + np.cos(self.rotor_poles * distance))
            slope = -0.5 * self.rotor_poles * np.sin(self.rotor_poles * distance)
        elif self.form == "saturating":
            x = distance / half
            f = (2.0 * x - 3.0) * x * x + 1.0
            slope = 6.0 * x * (x - 1.0) / half
        else:
            flat = math.radians(self.magnetics["flat_deg"])
            blend = math.radians(self.magnetics["blend_deg"])
            steep = 1.0 / (half - 2.0 * flat - blend)
            # Slope rises over one blend, stays, falls over another; f is its integral.
            up = np.clip(distance - flat, 0.0, blend)
            straight = np.clip(distance - flat - blend, 0.0, half - 2.0 * flat - 2.0 * blend)
            down = np.clip(distance - (half - flat - blend), 0.0, blend)
            f = 1.0 - steep * (up * up / (2.0 * blend) + straight + down - down * down / (2.0 * blend))
            slope = -steep * (up - down) / blend
        return f, slope * sign

    def coenergy_factor(self, current_A):
        """W(i) in joule: torque is df/dtheta * W(i)."""
        import numpy as np

        m, i = self.magnetics, np.asarray(current_A, dtype=float)
        if self.form != "saturating":
            return 0.5 * (m["aligned_inductance_H"] - m["unaligned_inductance_H"]) * i * i
        amplitude = m["flux_linkage_max_Wb"] - m["saturated_inductance_H"] * m["current_at_flux_linkage_max_A"]
        rate = (m["aligned_inductance_H"] - m["saturated_inductance_H"]) / amplitude
        linear = 0.5 * (m["saturated_inductance_H"] - m["unaligned_inductance_H"]) * i * i
        return linear + amplitude * (i + np.expm1(-rate * i) / rate)

    def torque_Nm(self, angle_rad, current_A):
        """Torque of one phase."""
        return self.position_factor(angle_rad)[1] * self.coenergy_factor(current_A)


def machine_path(name_or_path: str) -> Path:
    """The file meant by a shipped machine's name or by a path; MachineError when there is none."""
    shipped = SHIPPED / f"{name_or_path}.toml"
    if shipped.is_file():
        return shipped
    path = Path(name_or_path)
    if path.is_file():
        return path.resolve()
    names = ", ".join(sorted(p.stem for p in SHIPPED.glob("*.toml")))
    raise MachineError(f"machine '{name_or_path}': no such file, and no shipped machine of that name ({names})")


def load_machine(path: Path | str) -> Machine:
    """Reads and checks a machine file."""
    path = Path(path)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise MachineError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise MachineError(f"{path}: cannot be read: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise MachineError(f"{path}: not TOML: {error}") from None

    _check_keys(path, "", data, ["name", "poles", "winding", "mechanics", "magnetics", "converter"])
    name = data["name"]
    if not isinstance(name, str) or not name.isidentifier() or not name.isascii():
        raise MachineError(f"{path}: name: {name!r} is not a plain word (letters, digits, underscore)")
    for section in ("poles", "winding", "mechanics", "magnetics", "converter"):
        if not isinstance(data[section], dict):
            raise MachineError(f"{path}: {section}: a table [{section}] is wanted")

    stator, rotor, phases = _poles(path, data["poles"])
    values: dict[str, float] = {}
    for section, ranges in _RANGES.items():
        _check_keys(path, section, data[section], list(ranges))
        values |= {key: _number(path, section, key, data[section][key], ranges[key]) for key in ranges}

    form = data["magnetics"].get("form")
    if form not in FORMS:
        raise MachineError(f"{path}: magnetics.form: {form!r} is not one of {', '.join(FORMS)}")
    ranges = _MAGNETICS[form]
    _check_keys(path, "magnetics", data["magnetics"], ["form", *ranges])
    magnetics = {key: _number(path, "magnetics", key, data["magnetics"][key], ranges[key]) for key in ranges}
    machine = Machine(
        name=name,
        stator_poles=stator,
        rotor_poles=rotor,
        phases=phases,
        form=form,
        magnetics=magnetics,
        **values,
    )
    _check_magnetics(path, machine)
    return machine


def _check_keys(path: Path, section: str, table: dict, wanted: list[str]) -> None:
    prefix = f"{section}." if section else ""
    for key in table:
        if key not in wanted:
            raise MachineError(f"{path}: {prefix}{key}: unknown key; allowed: {', '.join(wanted)}")
    for key in wanted:
        if key not in table:
            raise MachineError(f"{path}: {prefix}{key}: missing")


def _number(path: Path, section: str, key: str, value, limits: tuple[float, float]) -> float:
    low, high = limits
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise MachineError(f"{path}: {section}.{key}: {value!r} is not a number from {low:g} to {high:g}")
    return float(value)


def _poles(path: Path, table: dict) -> tuple[int, int, int]:
    _check_keys(path, "poles", table, ["stator", "rotor"])
    stator, rotor = table["stator"], table["rotor"]
    if type(stator) is int and type(rotor) is int and (stator, rotor) in _PHASES:
        return stator, rotor, _PHASES[stator, rotor]
    names = ", ".join(f"{s}/{r}" for s, r in _PHASES)
    raise MachineError(f"{path}: poles: {stator!r}/{rotor!r} is not one of {names}")


def _check_magnetics(path: Path, machine: Machine) -> None:
    m = machine.magnetics
    if m["aligned_inductance_H"] <= m["unaligned_inductance_H"]:
        raise MachineError(f"{path}: magnetics.aligned_inductance_H: must be above unaligned_inductance_H")
    if machine.form == "linear_trapezoid":
        if 2.0 * (m["flat_deg"] + m["blend_deg"]) >= 180.0 / machine.rotor_poles:
            raise MachineError(f"{path}: magnetics.blend_deg: flats and blends do not fit into half a rotor pitch")
    if machine.form == "saturating":
        if m["saturated_inductance_H"] > m["unaligned_inductance_H"]:
            raise MachineError(f"{path}: magnetics.saturated_inductance_H: must not exceed unaligned_inductance_H")
        if m["saturated_inductance_H"] * m["current_at_flux_linkage_max_A"] >= m["flux_linkage_max_Wb"]:
            raise MachineError(
                f"{path}: magnetics.flux_linkage_max_Wb: must exceed"
                " saturated_inductance_H * current_at_flux_linkage_max_A"
            )
