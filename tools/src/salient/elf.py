"""Content of an ELF image of the firmware: instructions, their source locations, symbols and sections, read with the
binutils of its processor."""

from __future__ import annotations

import re
import shutil
import struct
import subprocess
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

from salient.errors import UsageError
from salient.paths import BUILD, ROOT

_RISCV = 243
_LOADED = 1
_PROCESSORS = {40: ("arm-none-eabi-", "binutils-arm-none-eabi", 36),
               _RISCV: ("riscv64-unknown-elf-", "binutils-riscv64-unknown-elf", 0)}  # fmt: skip
"""By the machine of the ELF header: prefix of the tools' names, their Debian package, size of the exception frame in
bytes (Cortex-M4: eight words, and one for alignment)."""

_INSTRUCTION = re.compile(r"\s*([0-9a-f]+):\t([a-z][a-z0-9]*(?:\.[a-z0-9]+)*)(?:\s+(.*))?$")
_TARGET = re.compile(r"\b([0-9a-f]+) <([^>+]+)>")


@dataclass(frozen=True)
class SourceLocation:
    """Source of an instruction. file: relative to the repository's root if it is inside, "?" if unknown; line: 0 if
    unknown."""

    function: str
    file: str
    line: int


@dataclass(frozen=True)
class Instruction:
    """operands: in the syntax of the disassembler. function: name of the linker's symbol. goes_to: the function that it
    calls, or whose first instruction it jumps to."""

    address: int
    mnemonic: str
    operands: str
    function: str
    goes_to: str | None


class ElfImage:
    """path: an ELF file, of which symbols, instructions and locations are read once. UsageError when its processor is
    unknown."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with path.open("rb") as file:
            machine = int.from_bytes(file.read(20)[18:], "little")
        if machine not in _PROCESSORS:
            raise UsageError(f"{path}: ELF machine {machine}: must be one of {', '.join(map(str, _PROCESSORS))}")
        self._prefix, self._package, self.exception_frame_bytes = _PROCESSORS[machine]
        self.is_riscv = machine == _RISCV
        self._locations: dict[int, list[SourceLocation]] = {}

    def run(self, tool: str, *arguments: str, given: str | None = None) -> str:
        """Output of one of the binutils, called with the arguments followed by the image."""
        return subprocess.run([self._tool(tool), *arguments, str(self.path)], input=given, text=True, check=True,
                              stdout=subprocess.PIPE).stdout

    def _tool(self, tool: str) -> str:
        name = self._prefix + tool
        if shutil.which(name) is None:
            raise UsageError(f"{name} is missing: install the Debian package {self._package}")
        return name

    def copy_to(self, path: Path, kind: str) -> None:
        """Writes the loaded content in a format of objcopy, as binary or ihex."""
        subprocess.run([self._tool("objcopy"), "-O", kind, str(self.path), str(path)], check=True)

    def symbols(self) -> dict[str, int]:
        """Addresses of the symbols by name."""
        return self._symbols

    @cached_property
    def _symbols(self) -> dict[str, int]:
        rows = (line.split() for line in self.run("nm").splitlines())
        return {row[2]: int(row[0], 16) for row in rows if len(row) == 3}

    def sections(self) -> dict[str, int]:
        """Sizes of the sections in bytes by name."""
        rows = (line.split() for line in self.run("objdump", "-h").splitlines())
        return {row[1]: int(row[2], 16) for row in rows if len(row) == 7 and row[0].isdigit()}

    def read(self, address: int, size: int) -> bytes:
        """Bytes of a loaded section; UsageError outside of all sections."""
        content = self._loaded()
        for begin, loaded in content.items():
            if begin <= address and address + size <= begin + len(loaded):
                return loaded[address - begin: address - begin + size]
        raise UsageError(f"{self.path}: no content at {address:#x}")

    def file_offset(self, address: int) -> int:
        """Offset in the file of the content at an address; UsageError outside of all segments."""
        for begin, start, length in self._segments(self.path.read_bytes()):
            if begin <= address < begin + length:
                return start + address - begin
        raise UsageError(f"{self.path}: no content at {address:#x}")

    @lru_cache  # noqa: B019 an image is read a few times in a process
    def _loaded(self) -> dict[int, bytes]:
        """Content of the loaded segments by address."""
        content = self.path.read_bytes()
        return {begin: content[start: start + length] for begin, start, length in self._segments(content)}

    @staticmethod
    def _segments(content: bytes) -> list[tuple[int, int, int]]:
        """Address, offset in the file and length of each loaded segment: 32-bit little-endian ELF, System V ABI,
        program header."""
        offset, = struct.unpack_from("<I", content, 28)
        size, count = struct.unpack_from("<HH", content, 42)
        rows = (struct.unpack_from("<5I", content, at) for at in range(offset, offset + size * count, size))
        return [(address, start, length) for kind, start, address, _, length in rows if kind == _LOADED]

    def stack(self) -> tuple[int, int]:
        """Lowest address of the stack, after the variables, and the address below which it starts."""
        symbols = self.symbols()
        return symbols["bss_end"], symbols["stack_top"]

    def instructions(self) -> list[Instruction]:
        """Instructions of all functions, by address."""
        return self._instructions

    @cached_property
    def _instructions(self) -> list[Instruction]:
        rows = (line.split() for line in self.run("readelf", "-sW").splitlines())
        functions = {row[7] for row in rows if len(row) == 8 and row[3] == "FUNC"}
        found, function = [], ""
        for line in self.run("objdump", "-d", "--no-show-raw-insn").splitlines():
            if head := re.fullmatch(r"[0-9a-f]+ <(.*)>:", line):
                function = head[1]
            elif function in functions and (row := _INSTRUCTION.match(line)):
                address, mnemonic, operands = row.groups(default="")
                target = _TARGET.search(operands)
                goes_to = target[2] if target and target[2] in functions else None
                found.append(Instruction(int(address, 16), mnemonic, operands, function, goes_to))
        return found

    def locations(self, addresses: list[int]) -> dict[int, list[SourceLocation]]:
        """By address: the location in which the instruction is written, then those into which it is inlined."""
        unknown = [address for address in addresses if address not in self._locations]
        self._locations |= self._read_locations(unknown) if unknown else {}
        return {address: self._locations[address] for address in addresses if address in self._locations}

    def _read_locations(self, addresses: list[int]) -> dict[int, list[SourceLocation]]:
        given = "".join(f"{address:#x}\n" for address in addresses)
        lines = self.run("addr2line", "-a", "-f", "-i", "-e", given=given).splitlines()
        locations: dict[int, list[SourceLocation]] = {}
        of: list[SourceLocation] = []
        i = 0
        while i < len(lines):
            if lines[i].startswith("0x"):
                of = locations.setdefault(int(lines[i], 16), [])
                i += 1
            else:
                file, _, line = lines[i + 1].partition(" (")[0].rpartition(":")
                function = lines[i].partition(".")[0]  # without the suffixes of the compiler's copies
                of.append(SourceLocation(function, _short(file), int(line) if line.isdigit() else 0))
                i += 2
        return locations


@lru_cache
def _short(file: str) -> str:
    if not file.startswith("/"):
        return "?"
    path, build = Path(file).resolve(), BUILD.resolve()
    if path.is_relative_to(build):
        return f"build/{path.relative_to(build).as_posix()}"  # wherever it was built
    return path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else str(path)
