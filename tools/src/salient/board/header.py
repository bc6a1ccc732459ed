"""The header of the registers that the port uses (hal/stm32g4/registers.h), read back from its text."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from salient.errors import UsageError
from salient.paths import ROOT

PORT = ROOT / "hal" / "stm32g4"
HEADER = PORT / "registers.h"
FACTS = PORT / "facts.json"

_BASE = re.compile(r"#define (\w+)_BASE (0x[0-9A-F]+)u$")
_INTERRUPT = re.compile(r"#define (\w+)_IRQ (\d+)$")
_REGISTER = re.compile(r"#define (([A-Z]+)_(\w+?))(?:\((\w+)\))? REGISTER\((\w+), (0x[0-9A-F]+)\)\s*"
                       r"/\* (r|w|rw) (0x[0-9A-F]+|-)(?: (w1c|w0c) (0x[0-9A-F]+))? \*/$")
_FIELD = re.compile(r"#define (\w+) (?:BIT\((\d+)\)|BITS\((\d+), (\d+)\))$")


@dataclass(frozen=True)
class Register:
    """block: prefix of its name. base: name of its block's address, or None where the address is an argument. access:
    r, w or rw. reset: None where it depends on the instance or the kind of reset. one_clears, zero_clears: bits."""

    name: str
    block: str
    base: str | None
    offset: int
    access: str
    reset: int | None
    one_clears: int
    zero_clears: int
    fields: dict[str, tuple[int, int]]


@dataclass(frozen=True)
class Header:
    """bases: addresses of the instances by name. interrupts: numbers by name. registers: with their fields, each a
    first bit and a width."""

    bases: dict[str, int]
    interrupts: dict[str, int]
    registers: list[Register]


def read_header(path: Path) -> Header:
    """Reads the header. UsageError: a definition that has another form than these."""
    header = Header({}, {}, [])
    begun = False
    for number, line in enumerate(path.read_text().splitlines(), 1):
        begun = begun or line.startswith("/* ---")
        if not begun or not line.startswith("#define"):
            continue
        if base := _BASE.match(line):
            header.bases[base[1]] = int(base[2], 16)
        elif interrupt := _INTERRUPT.match(line):
            header.interrupts[interrupt[1]] = int(interrupt[2])
        elif register := _REGISTER.match(line):
            name, block, _, argument, base_name, offset, access, reset, kind, bits = register.groups()
            cleared = int(bits, 16) if bits else 0
            header.registers.append(Register(
                name, block, None if argument else base_name.removesuffix("_BASE"), int(offset, 16), access,
                None if reset == "-" else int(reset, 16), cleared if kind == "w1c" else 0,
                cleared if kind == "w0c" else 0, {}))
        elif field := _FIELD.match(line):
            owner = header.registers[-1] if header.registers else None
            if owner is None or not field[1].startswith(f"{owner.name}_"):
                raise UsageError(f"{path}:{number}: {field[1]} is no field of the register above")
            first, width = (int(field[2]), 1) if field[2] else (int(field[3]), int(field[4]))
            owner.fields[field[1].removeprefix(f"{owner.name}_")] = (first, width)
        else:
            raise UsageError(f"{path}:{number}: no address, interrupt, register or field: {line}")
    return header
