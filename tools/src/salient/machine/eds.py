"""The electronic data sheet (CiA 306) of a drive as a CANopen device: its objects with types, access, limits and
initial values, made of firmware/comms/objects.toml, the parameters and the machine's units; never edited."""

from __future__ import annotations

from pathlib import Path

from salient.errors import UsageError
from salient.machine.content import machine_hash
from salient.machine.file import load_machine
from salient.machine.object_dictionary import (
    BITS,
    PARAMETER_BASE,
    TYPES,
    Entry,
    Object,
    parameter_entries,
    read_dictionary,
)
from salient.machine.parameter_table import read_table
from salient.machine.path import machine_path
from salient.machine.scaling import scaling_of
from salient.version import VERSION

_OBJECT_TYPES = {"var": 7, "array": 8, "record": 9}
_DOMAIN = 2
_MANDATORY = (0x1000, 0x1001, 0x1018)
_BIT_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)
_PDOS = 4


def eds_of(machine: str, node: int = 0) -> str:
    """The file's text. machine: name or file; node: of the board's switches, from which node-ID and identifiers follow.
    UsageError: no such machine."""
    path = machine_path(machine)
    content = load_machine(path)
    scaling = scaling_of(path, content)
    dictionary = read_dictionary()
    parameters = {entry.index: entry for entry in parameter_entries()}
    defaults = scaling.raw_parameters()
    objects = [each for of in dictionary.objects for each in _instances(of)]
    sections = [_head(path.stem, dictionary.device, node + 1)]
    for title, indices in _groups([of.index for of in objects] + list(parameters)):
        lines = [f"SupportedObjects={len(indices)}", *(f"{i}=0x{index:04X}" for i, index in enumerate(indices, 1))]
        sections.append("\n".join([f"[{title}]", *lines]))
    identity = {(0x1018, 3): machine_hash(path), (0x1018, 4): node + 1}
    sections += [_object(of, node + 1, identity) for of in objects]
    for row, bits in zip(read_table(), scaling.fraction_bits(), strict=True):
        entry = parameters[PARAMETER_BASE + row.index]
        unit = f"; {row.unit}" if row.unit else ""
        sections.append(f"; raw value: 2^{-bits}{unit}\n" + _entry(entry, f"{entry.index:04X}", defaults[row.index]))
    return "\n\n".join(sections) + "\n"


def write_eds(file: Path, machine: str, node: int = 0) -> None:
    """Writes the file of a drive. UsageError: it cannot be written, or as eds_of."""
    try:
        file.write_text(eds_of(machine, node), encoding="ascii")
    except OSError as error:
        raise UsageError(f"--eds {file}: {error.strerror}") from None


def _instances(of: Object) -> list[Object]:
    return [Object(of.index + i, of.name, of.kind, 1, of.entries) for i in range(of.instances)]


def _groups(indices: list[int]) -> list[tuple[str, list[int]]]:
    rest = sorted(index for index in indices if index not in _MANDATORY)
    return [("MandatoryObjects", list(_MANDATORY)),
            ("OptionalObjects", [index for index in rest if not 0x2000 <= index < 0x6000]),
            ("ManufacturerObjects", [index for index in rest if 0x2000 <= index < 0x6000])]


def _head(name: str, device: dict[str, int], node_id: int) -> str:
    rates = "\n".join(f"BaudRate_{rate}=1" for rate in _BIT_RATES)
    return f"""[FileInfo]
FileName={name}.eds
FileVersion=1
FileRevision=0
EDSVersion=4.0
Description=Switched reluctance drive, machine {name}, salient {VERSION}

[DeviceInfo]
VendorName=Salient
VendorNumber=0x{device["vendor"]:X}
ProductName=Salient
ProductNumber=0x{device["product"]:X}
{rates}
SimpleBootUpMaster=0
SimpleBootUpSlave=1
Granularity=8
DynamicChannelsSupported=0
GroupMessaging=0
NrOfRXPDO={_PDOS}
NrOfTXPDO={_PDOS}
LSS_Supported=1

[DeviceComissioning]
NodeID={node_id}

[DummyUsage]
Dummy0001=0
""" + "\n".join(f"Dummy{number:04X}=1" for number in range(2, 8))


def _object(of: Object, node_id: int, known: dict[tuple[int, int], int]) -> str:
    key = f"{of.index:04X}"
    if of.kind == "var":
        return _entry(of.entries[0], key, _initial(of.entries[0], of.index, node_id, 0, known))
    numbers = sum(entry.count for entry in of.entries)
    head = f"[{key}]\nParameterName={of.name}\nObjectType=0x{_OBJECT_TYPES[of.kind]:X}\nSubNumber={numbers}"
    parts = [_entry(entry, f"{key}sub{entry.sub + i:X}", _initial(entry, of.index, node_id, i, known), number=i)
             for entry in of.entries for i in range(entry.count)]
    return "\n\n".join([head, *parts])


def _initial(entry: Entry, index: int, node_id: int, element: int, known: dict[tuple[int, int], int]
             ) -> int | None:
    """The value after a reset; None for one that the drive computes."""
    pdo = index % _PDOS
    receives = {"RPDO_ID": 0x200, "TPDO_ID": 0x180 | 0x40000000}
    if entry.value in receives:
        return receives[entry.value] + 0x100 * pdo + node_id
    if entry.value in ("RPDO_COUNT", "TPDO_COUNT"):
        return 1 if pdo == 0 else 2
    if entry.value == "TPDO_INHIBIT":
        return 0 if pdo < 2 else 100
    maps = {"RPDO_MAP": (0x60400010, (0, 0x60600008, 0x60FF0020, 0x60710010)),
            "TPDO_MAP": (0x60410010, (0, 0x60610008, 0x606C0020, 0x60770010))}
    if entry.value in maps and element < 2:
        return maps[entry.value][0] if element == 0 else maps[entry.value][1][pdo]
    sources = {"EMERGENCY_ID": 0x80, "SDO_REQUEST_ID": 0x600, "SDO_RESPONSE_ID": 0x580}
    if entry.source in sources:
        return sources[entry.source] + node_id
    if entry.source in ("STORE", "RESTORE"):
        return 1
    return known.get((index, entry.sub + element), None if entry.source else entry.initial)


def _entry(entry: Entry, key: str, initial: int | None, number: int | None = None) -> str:
    name = f"{entry.name} {number + 1}" if number is not None and entry.count > 1 else entry.name
    is_domain = entry.type == "domain"
    lines = [f"[{key}]", f"ParameterName={name}", f"ObjectType=0x{_DOMAIN if is_domain else 7:X}",
             f"DataType=0x{TYPES[entry.type]:04X}", f"AccessType={entry.access}",
             f"PDOMapping={1 if entry.pdo else 0}"]
    if entry.type in BITS:
        lines += [f"DefaultValue={initial}"] if initial is not None else []
        if entry.access == "rw":
            lines += [f"LowLimit={entry.minimum}", f"HighLimit={entry.maximum}"]
    elif entry.string:
        lines.append(f"DefaultValue={entry.string.replace('@VERSION', VERSION)}")
    return "\n".join(lines)
