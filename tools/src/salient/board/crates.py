"""Facts about the microcontroller from two independent crates, for the check of the port's header and pin map.

    python -m salient.board.crates FOLDER

reads the crates `stm32-metapac` 21.0.0 and `stm32g4` 0.16.0 below a folder (of `cargo vendor --versioned-dirs`, or
the registry's of `cargo fetch`) and writes hal/stm32g4/facts.json: addresses, offsets, fields, reset values and access
of the registers in the header, interrupt numbers, and the functions of the pins. The crates take 310 MB and are not
needed for the check itself.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any

from salient.board.header import FACTS, HEADER, Header, read_header
from salient.errors import UsageError, exit_code

CRATES = {"metapac": "stm32-metapac-21.0.0", "svd": "stm32g4-0.16.0"}
CHIP = "stm32g474re"

BLOCKS = {
    "RCC": ("rcc_g4", "Rcc", "rcc"),
    "PWR": ("pwr_g4", "Pwr", "pwr"),
    "FLASH": ("flash_g4c3", "Flash", "flash"),
    "GPIO": ("gpio_v2", "Gpio", "gpiob"),
    "SYSCFG": ("syscfg_g4", "Syscfg", "syscfg"),
    "EXTI": ("exti_v1", "Exti", "exti"),
    "TIM": ("timer_v2", "TimAdv", "tim1"),
    "ADC": ("adc_g4", "Adc", "adc1"),
    "ADCC": ("adccommon_g4", "AdcCommon", "adc12_common"),
    "COMP": ("comp_v2", "Comp", "comp"),
    "DAC": ("dac_v7", "Dac", "dac1"),
    "DMA": ("bdma_v1", "Dma", "dma1"),
    "DMAMUX": ("dmamux_v1", "Dmamux", "dmamux"),
    "FDCAN": ("can_fdcan_v1", "Fdcan", "fdcan"),
    "IWDG": ("iwdg_v2", "Iwdg", "iwdg"),
    "RNG": ("rng_v1", "Rng", "rng"),
    "LPTIM": ("lptim_v1b_g4", "LptimBasic", "lptimer1"),
}
"""By the prefix of a register's name: file and structure of the first crate, module of the second."""

OTHER_NAMES = {"COMP": "COMP1", "DMAMUX": "DMAMUX1"}
"""Instances whose name in the first crate has a number."""

_REGISTER = re.compile(
    r"pub const fn (\w+)\(self(?:, n: usize)?\)\s*-> crate::common::Reg<([\w:]+), crate::common::(RW|R|W)>"
    r" \{\s*(?:assert!\(n < (\d+)usize\);\s*)?unsafe \{\s*"
    r"crate::common::Reg::from_ptr\(\s*self\.ptr\.add\((0x[0-9a-f]+)usize(?: \+ n \* (\d+)usize)?\)")
_NESTED = re.compile(
    r"pub const fn (\w+)\(self, n: usize\) -> (\w+) \{\s*assert!\(n < (\d+)usize\);\s*unsafe \{ "
    r"\2::from_ptr\(self\.ptr\.add\((0x[0-9a-f]+)usize \+ n \* (\d+)usize\)")
_FIELD = re.compile(
    r"pub const fn (\w+)\(&self(?:, n: usize)?\)[^{]*\{\s*(?:assert!\(n < (\d+)usize\);\s*)?"
    r"(?:let offs = (\d+)usize \+ n \* (\d+)usize;\s*)?let val = \(self\.0 >> (?:(\d+)usize|offs)\) & (0x[0-9a-f]+);")

_DOCUMENTED = r"[^\n]*(?:\n *///[^\n]*)*\n\s*#\[inline\(always\)\]\n\s*pub "
_ACCESSOR = re.compile(r"///(0x[0-9a-f]+)(?:\.\.(0x[0-9a-f]+))? - " + _DOCUMENTED
                       + r"const fn (\w+)\(&self(, n: usize)?\) -> &([\w:]+) \{")
_BITS = re.compile(r"///Bits? (\d+)(?::(\d+))? - " + _DOCUMENTED + r"(?:const )?fn (\w+)\(&(?:mut )?self\)")


def _expand(name: str, count: str | None, start: int, step: str | None) -> list[tuple[str, int]]:
    """The elements of an array, or the single one."""
    if count is None:
        return [(name, start)]
    return [(f"{name}[{n}]", start + n * int(step or 0)) for n in range(int(count))]


def _interrupts(text: str) -> dict[str, int]:
    """Numbers by name, of the enumeration that both crates have."""
    return {name: int(number) for name, number in re.findall(r"^    (\w+) = (\d+),$", text, re.MULTILINE)}


def _body(text: str, head: str) -> str:
    """The text after a head up to the closing brace at its indentation."""
    found = re.search(rf"^( *){re.escape(head)} \{{\n", text, re.MULTILINE)
    if found is None:
        return ""
    end = text.find(f"\n{found[1]}}}", found.end())
    return text[found.end(): end + 1]


class Metapac:
    """The crate stm32-metapac."""

    def __init__(self, folder: Path) -> None:
        self._source = folder / CRATES["metapac"] / "src"
        chip = (self._source / "chips" / CHIP / "pac.rs").read_text()
        self.addresses = {name: int(address.replace("_", ""), 16) for name, address in
                          re.findall(r"pub const (\w+): [^=]*= unsafe \{[^(]*\((0x[0-9a-f_]+)usize as _\)", chip)}
        self.interrupts = _interrupts(chip)
        included = re.search(r'include!\("\.\./(metadata_\d+\.rs)"\)',
                             (self._source / "chips" / CHIP / "metadata.rs").read_text())
        if included is None:
            raise UsageError(f"{self._source}: {CHIP} has no metadata")
        self._metadata = (self._source / "chips" / included[1]).read_text()

    def registers(self, block: str) -> dict[str, dict[str, Any]]:
        """By name: offset, access, fields as [name, first bit, width]. No reset values: the crate has none."""
        file, structure, _ = BLOCKS[block]
        text = (self._source / "peripherals" / f"{file}.rs").read_text()
        return self._structure(text, structure, 0, "")

    def _structure(self, text: str, structure: str, base: int, prefix: str) -> dict[str, dict[str, Any]]:
        found = {}
        body = _body(text, f"impl {structure}")
        for name, kind, access, count, offset, step in _REGISTER.findall(body):
            fields = self._fields(text, kind)
            for label, at in _expand(name, count or None, int(offset, 16), step):
                found[prefix + label] = {"offset": base + at, "access": access.lower(), "fields": fields}
        for name, kind, count, offset, step in _NESTED.findall(body):
            for label, at in _expand(name, count, int(offset, 16), step):
                found |= self._structure(text, kind, base + at, f"{prefix}{label}.")
        return found

    @staticmethod
    def _fields(text: str, kind: str) -> list[list[Any]]:
        fields = []
        for name, count, first, step, alone, mask in _FIELD.findall(_body(text, f"impl {kind.rpartition(':')[2]}")):
            width = int(mask, 16).bit_length()
            for label, at in _expand(name, count or None, int(first or alone), step):
                fields.append([label, at, width])
        return sorted(fields, key=lambda field: field[1])

    def pins(self, names: set[str]) -> dict[str, list[str]]:
        """By pin its functions: "TIM1_CH1:2" with the number of the alternate function, "ADC1_IN2" without."""
        found: dict[str, set[str]] = {name: set() for name in names}
        for part in self._metadata.split("    Peripheral {\n")[1:]:
            peripheral = re.search(r'name: "(\w+)"', part)
            for pin, signal, function in re.findall(
                    r'PeripheralPin \{\s*pin: "(\w+)",\s*signal: "(\w+)",\s*af: (None|Some\(\d+\)),', part):
                if pin in found and peripheral is not None:
                    number = "" if function == "None" else f":{function[5:-1]}"
                    found[pin].add(f"{peripheral[1]}_{signal}{number}")
        return {name: sorted(functions) for name, functions in sorted(found.items())}


class Svd:
    """The crate stm32g4, made of the vendor's SVD file with corrections."""

    def __init__(self, folder: Path) -> None:
        self._source = folder / CRATES["svd"] / "src" / "stm32g474"
        text = (self._source / "mod.rs").read_text()
        self.addresses = {name: int(address.replace("_", ""), 16) for name, address in
                          re.findall(r"pub type (\w+) = crate::Periph<[\w:]+, (0x[0-9a-f_]+)>", text)}
        self.interrupts = _interrupts(text)

    def registers(self, block: str) -> dict[str, dict[str, Any]]:
        """By name: offset, access, reset value, bits that a one or a zero clears, fields."""
        module = BLOCKS[block][2]
        return self._block(module, (self._source / f"{module}.rs").read_text())

    def _block(self, module: str, text: str, base: int = 0) -> dict[str, dict[str, Any]]:
        """Registers, elements of arrays of registers, and registers of clusters."""
        found: dict[str, dict[str, Any]] = {}
        for begin, end, name, index, kind in _ACCESSOR.findall(text):
            offset = base + int(begin, 16)
            cluster = self._source / module / f"{kind.lower()}.rs"
            if "::" not in kind and f"pub use self::{kind.lower()}::{kind};" in text and cluster.exists():
                if not index:
                    inner = self._block(f"{module}/{kind.lower()}", cluster.read_text(), offset)
                    found |= {f"{name}.{key}": value for key, value in inner.items()}
            elif (register := self._register(module, kind, text)) is not None:
                places = range(offset, base + int(end, 16), 4) if index else [offset]
                found |= {f"{name}[{n}]" if index else name: {"offset": at, **register} for n, at in enumerate(places)}
        return found

    def _register(self, module: str, kind: str, text: str) -> dict[str, Any] | None:
        source = re.search(rf"pub type {kind} = crate::Reg<(\w+)::", text)
        path = self._source / module / f"{source[1]}.rs" if source else None
        if path is None or not path.exists():
            return None
        content = path.read_text()
        reset = re.search(r"const RESET_VALUE: u\d+ = (0x[0-9a-f_]+|\d+)", content)
        readable, writable = ("impl crate::Readable" in content), ("impl crate::Writable" in content)
        one, zero = (re.search(rf"const {name}_TO_MODIFY_FIELDS_BITMAP: u\d+ = (0x[0-9a-f_]+|\d+)", content)
                     for name in ("ONE", "ZERO"))
        fields = {}
        for begin, last, name in _BITS.findall(content):
            first = int(begin)
            fields[name] = [name, first, int(last or first) - first + 1]
        return {"access": "r" * readable + "w" * writable, "reset": int(reset[1].replace("_", ""), 0) if reset else 0,
                "one_clears": int(one[1].replace("_", ""), 0) if one else 0,
                "zero_clears": int(zero[1].replace("_", ""), 0) if zero else 0,
                "fields": sorted(fields.values(), key=lambda field: field[1])}


def collect(folder: Path, header: Header, pins: set[str]) -> dict[str, Any]:
    """The facts of both crates about what the header names, and about the pins."""
    metapac, svd = Metapac(folder), Svd(folder)
    facts: dict[str, Any] = {"crates": CRATES}
    for name, source in (("metapac", metapac), ("svd", svd)):
        wanted = {block: {register.offset for register in header.registers if register.block == block}
                  for block in BLOCKS}
        facts[name] = {
            "addresses": {key: source.addresses[found] for key in sorted(header.bases)
                          if (found := OTHER_NAMES.get(key, key) if name == "metapac" else key) in source.addresses},
            "interrupts": {key: source.interrupts[key] for key in sorted(header.interrupts)
                           if key in source.interrupts},
            "registers": {block: {key: value for key, value in source.registers(block).items()
                                  if value["offset"] in offsets}
                          for block, offsets in wanted.items()},
        }
    facts["pins"] = metapac.pins(pins)
    return facts


def _text(facts: dict[str, Any]) -> str:
    """One register or pin a line, so that a difference shows."""
    text = json.dumps(facts, indent=1)
    for _ in range(2):  # lists, then lists of lists
        text = re.sub(r"\[\s+((?:[^\[\]{}]|\[[^\[\]]*\])*?)\s+\]", lambda found: f"[{_one_line(found[1])}]", text)
    return re.sub(r"\{\s*(\"offset\"[^{}]*?)\s*\}", lambda found: f"{{{_one_line(found[1])}}}", text) + "\n"


def _one_line(text: str) -> str:
    return re.sub(r"\s*\n\s*", " ", text)


def main(arguments: list[str] | None = None) -> int:
    """Writes the facts; exit code 2 after one line for a folder without the crates."""
    parser = argparse.ArgumentParser(prog="salient.board.crates", description="facts of two crates about the chip")
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="of cargo vendor, or of the registry's sources")
    options = parser.parse_args(arguments)

    def run() -> int:
        from salient.board.pins import read_pins

        for crate in CRATES.values():
            if not (options.folder / crate).is_dir():
                raise UsageError(f"{options.folder}: no folder {crate}; cargo fetch of these crates makes it")
        pins = {row.pin for row in read_pins()}
        FACTS.write_text(_text(collect(options.folder, read_header(HEADER), pins)))
        return 0

    return exit_code(run)


if __name__ == "__main__":
    sys.exit(main())
