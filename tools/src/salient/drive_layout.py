"""Members of drive_t by their place in memory and by name, from the debug information of a build."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from inspect import signature
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from salient.errors import UsageError
from salient.paths import BUILD

if TYPE_CHECKING:
    from elftools.elf.elffile import ELFFile

_ALIASES = {"DW_TAG_typedef", "DW_TAG_const_type", "DW_TAG_volatile_type"}
_VARIABLE = b"drive_layout"
_BYTES_MAX = 4
_WASM = b"\0asm\1\0\0\0"
"""Start of a WebAssembly module."""
_CUSTOM_SECTION = 0
_SIGNED = {5, 6}
"""DW_ATE_signed and DW_ATE_signed_char."""


def layout_file(build: str = "host") -> Path:
    """The layout of a build, as a file for Layout."""
    return BUILD / build / "firmware" / "drive_layout.elf"


@dataclass(frozen=True)
class Variable:
    """A number in the drive's memory. path: as of Layout.bits, with the indices of arrays; address: of its first byte,
    from the start of the drive; names: of an enumeration, by value."""

    path: str
    address: int
    bytes: int
    is_signed: bool
    names: dict[int, str]


class Layout:
    """program: a file with the variable drive_layout, a pointer to the type (firmware/layout/drive_layout.c).
    size: of the type in bytes; hash: of the layout, 0 in a file without. UsageError: the file has no such variable."""

    def __init__(self, program: Path) -> None:
        if not program.exists():
            raise UsageError(f"{program} is missing: cmake --build {program.parent.parent} makes it")
        from elftools.elf.elffile import ELFFile  # the pytest plugin loads this module where it is not installed

        with program.open("rb") as file:
            is_wasm = file.read(len(_WASM)) == _WASM
            elf = None if is_wasm else ELFFile(file)
            dwarf = _wasm_dwarf(file.read()) if elf is None else _elf_dwarf(elf)
            found = None if dwarf is None else _find(dwarf)
            if found is None:
                raise UsageError(f"{program}: no debug information of the drive")
            self._type = _described(_target(_target(found)))
            self.hash = _hash_beside(program) if elf is None else _word_at(elf, "drive_layout_hash")
        self.size: int = self._type["bytes"]

    def variables(self) -> Iterator[Variable]:
        """Every number of at most 4 bytes, in the order of the memory. Neither pointers nor bit-fields."""
        return _variables(self._type, 0, "")

    def member(self, bit: int) -> str:
        """Name of the member that has a bit, counted from the lowest of the first byte, with the indices of arrays;
        "padding of" a structure where no member has it."""
        return _member(self._type, bit, "")

    def pointers(self) -> list[str]:
        """Names of the members that are pointers, without the indices of arrays."""
        return pointers(self._type)

    def bits(self, path: str) -> range:
        """Bits of a member, by the names from the outermost one on, joined by points. UsageError: there is none."""
        of, first, length = self._type, 0, 8 * self.size
        for wanted in path.split("."):
            found = [member for member in of.get("members", ()) if member[2] == wanted]
            if not found:
                raise UsageError(f"{path}: drive_t has no member '{wanted}' there")
            begin, length, _, of = found[0]
            first += begin
        return range(first, first + length)


def _elf_dwarf(elf: ELFFile) -> Any:
    return elf.get_dwarf_info() if elf.has_dwarf_info() else None


def _wasm_dwarf(sections: bytes) -> Any:
    """Debug information of a WebAssembly module, which has it in sections with the names that ELF gives them.
    pyelftools opens ELF files only, and reads the sections of any."""
    from elftools.dwarf.dwarfinfo import DebugSectionDescriptor, DwarfConfig, DWARFInfo

    found = {}
    at = 0
    while at < len(sections):
        kind = sections[at]
        size, begin = _leb128(sections, at + 1)
        at = begin + size
        if kind == _CUSTOM_SECTION:
            length, begin = _leb128(sections, begin)
            name, content = sections[begin:begin + length].decode(), sections[begin + length:at]
            found[name.lstrip(".") + "_sec"] = DebugSectionDescriptor(BytesIO(content), name, 0, len(content), 0)
    names = [name for name in signature(DWARFInfo).parameters if name != "config"]
    if "debug_info_sec" not in found:
        return None
    return DWARFInfo(DwarfConfig(little_endian=True, machine_arch="", default_address_size=4),
                     **{name: found.get(name) for name in names})


def _leb128(data: bytes, at: int) -> tuple[int, int]:
    """An unsigned number in groups of seven bits, and where it ends."""
    value = shift = 0
    while True:
        value |= (data[at] & 0x7F) << shift
        shift += 7
        at += 1
        if data[at - 1] < 0x80:  # the last group
            return value, at


def _hash_beside(program: Path) -> int:
    """The hash with which a WebAssembly module was built: its symbols have no addresses in the file."""
    header = program.parent / "layout" / "layout_hash.h"
    found = re.search(r"LAYOUT_HASH 0x(\w+?)u", header.read_text(encoding="utf-8"))
    return int(found[1], 16) if found else 0


def _word_at(elf: ELFFile, symbol: str) -> int:
    from elftools.elf.sections import SymbolTableSection

    table = elf.get_section_by_name(".symtab")
    for found in (table.get_symbol_by_name(symbol) or ()) if isinstance(table, SymbolTableSection) else ():
        section = elf.get_section(found["st_shndx"])
        begin = found["st_value"] - section["sh_addr"]
        return int.from_bytes(section.data()[begin:begin + 4], "little")
    return 0


def pointers(of: dict[str, Any], path: str = "") -> list[str]:
    """Names of the pointers within a type, as Layout describes it."""
    if "elements" in of:
        return pointers(of["elements"][1], path)
    found = [path] if of.get("pointer") else []
    for _, _, name, inner in of.get("members", ()):
        found += pointers(inner, f"{path}.{name}" if path and name else path or name)
    return found


def _find(dwarf: Any) -> Any:
    for unit in dwarf.iter_CUs():
        for entry in unit.get_top_DIE().iter_children():
            name = entry.attributes.get("DW_AT_name")
            if entry.tag == "DW_TAG_variable" and name is not None and name.value == _VARIABLE:
                return entry
    return None


def _target(entry: Any) -> Any:
    """Type of an entry without its aliases."""
    of = entry.get_DIE_from_attribute("DW_AT_type")
    while of.tag in _ALIASES:
        of = of.get_DIE_from_attribute("DW_AT_type")
    return of


def _number(entry: Any, attribute: str) -> int:
    return int(entry.attributes[attribute].value) if attribute in entry.attributes else 0


def _described(entry: Any) -> dict[str, Any]:
    """A type as bytes, and either members (first bit, bits, name, type) or elements (count, type)."""
    if entry.tag == "DW_TAG_array_type":
        of = _described(_target(entry))
        for dimension in reversed([each for each in entry.iter_children() if each.tag == "DW_TAG_subrange_type"]):
            count = "DW_AT_count"  # as Clang has it
            length = (_number(dimension, count) if count in dimension.attributes
                      else _number(dimension, "DW_AT_upper_bound") + 1)
            of = {"bytes": length * of["bytes"], "elements": (length, of)}
        return of
    if entry.tag not in ("DW_TAG_structure_type", "DW_TAG_union_type"):
        names = {_number(each, "DW_AT_const_value"): each.attributes["DW_AT_name"].value.decode()
                 for each in entry.iter_children() if each.tag == "DW_TAG_enumerator"}
        is_number = entry.tag in ("DW_TAG_base_type", "DW_TAG_enumeration_type")
        return {"bytes": _number(entry, "DW_AT_byte_size"), "is_number": is_number, "names": names,
                "pointer": entry.tag == "DW_TAG_pointer_type",
                "is_signed": _number(entry, "DW_AT_encoding") in _SIGNED or any(value < 0 for value in names)}
    members = []
    for each in entry.iter_children():
        if each.tag != "DW_TAG_member":
            continue
        of = _described(_target(each))
        name = each.attributes["DW_AT_name"].value.decode() if "DW_AT_name" in each.attributes else ""
        bits = _number(each, "DW_AT_bit_size") or 8 * of["bytes"]
        first = _number(each, "DW_AT_data_bit_offset") or 8 * _number(each, "DW_AT_data_member_location")
        members.append((first, bits, name, of))
    return {"bytes": _number(entry, "DW_AT_byte_size"), "members": members}


def _member(of: dict[str, Any], bit: int, path: str) -> str:
    if "elements" in of:
        _, element = of["elements"]
        index, rest = divmod(bit, 8 * element["bytes"])
        return _member(element, rest, f"{path}[{index}]")
    for first, bits, name, inner in of.get("members", ()):
        if first <= bit < first + bits:
            return _member(inner, bit - first, f"{path}.{name}" if path and name else path or name)
    return f"padding of {path or 'drive_t'}" if "members" in of else path


def _variables(of: dict[str, Any], address: int, path: str) -> Iterator[Variable]:
    if "elements" in of:
        count, element = of["elements"]
        for index in range(count):
            yield from _variables(element, address + index * element["bytes"], f"{path}[{index}]")
    elif "members" in of:
        for first, bits, name, inner in of["members"]:
            if bits == 8 * inner["bytes"]:
                yield from _variables(inner, address + first // 8, f"{path}.{name}" if path and name else path or name)
    elif of.get("is_number") and of["bytes"] <= _BYTES_MAX:
        yield Variable(path, address, of["bytes"], of["is_signed"], of["names"])
