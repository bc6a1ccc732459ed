"""Machine image of a drive that is set up for one machine file and runs another machine: the firmware's tables of the
one, the plant of the other.

Motor, converter, DC link, supply and sensor errors are the true machine's. The board is the firmware's:
full scales of its sensors, from which the firmware's units follow, and threshold of the comparators.
"""

from __future__ import annotations

from pathlib import Path

from salient.machine.file import Machine, MachineError, load_machine
from salient.machine.flux_map import FluxMap
from salient.machine.image import FLUX_MAP, HEADER, PLANT, TABLES, joined
from salient.machine.scaling import Scaling, scaling_of

_OF_THE_BOARD = ("ranges.current_A", "ranges.dc_link_V", "ranges.load_torque_Nm", "trip_current_A")


def image_of_pair(image: bytes, path: Path, true_path: Path) -> bytes:
    """The image of the file `path` with the machine of `true_path` as the emulator's. MachineError: they cannot be of
    one drive (check_pair), or a mistake in a file."""
    machine, true = load_machine(path), load_machine(true_path)
    scaling, own = scaling_of(path, machine), scaling_of(true_path, true)
    check_pair(path, machine, scaling, true_path, true)
    tables = image[HEADER.size:HEADER.size + TABLES.size]
    plant = b"".join(member.array(true, scaling if member.name in _OF_THE_BOARD else own).tobytes()
                     for member in PLANT.members)
    flux_map = FLUX_MAP.packed(true.magnetics) if isinstance(true.magnetics, FluxMap) else b""
    return joined([tables, plant, flux_map, machine.name.encode("ascii") + b"\0"])


def check_pair(path: Path, machine: Machine, scaling: Scaling, true_path: Path, true: Machine) -> None:
    """MachineError, one line that names both files: phases or rotor poles differ, for which no firmware of the one runs
    the other; or the true supply is beyond the voltages at which the drive works, so that it never could."""
    for name, of_file, of_true in (("phases", machine.phases, true.phases),
                                   ("rotor poles", machine.rotor_poles, true.rotor_poles)):
        if of_file != of_true:
            raise MachineError(f"{true_path}: {of_true} {name}, but {path} has {of_file}: machine and true machine "
                               "must have the same number")
    low_V, high_V = (scaling.data.parameters[name] for name in ("under_voltage_V", "over_voltage_V"))
    if not low_V < true.supply_voltage_V < high_V:
        raise MachineError(f"{true_path}: converter.supply_voltage_V: {true.supply_voltage_V:g}: must be above "
                           f"{low_V:g} and below {high_V:g}, the limits of the drive of {path}")
