"""Execution trace of a run on a target: instructions by module of the firmware, coverage of the machine code, stack
depth. Read from the file of --execution and from the ELF image."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from salient.elf import ElfImage, Instruction, SourceLocation

PORT = "port"
"""Module name of everything outside the firmware: handler, HAL."""
_HELPERS = ("firmware/fixed/", "hal/qemu/rv32_virt/memory.c", "/", "?")
"""Code that counts for its caller, by prefix of the source path: arithmetic, memcpy and memset of boards that define
them, and code from outside the repository (compiler and C library)."""
_NOT_FIRMWARE = ("hal/", "/", "?")


@dataclass(frozen=True)
class Stack:
    """Bytes. thread: depth of the background; interrupt: depth of a control interrupt, with the exception frame;
    reserved: minimum of the linker script. Depths count bytes that were written to."""

    thread: int
    interrupt: int
    reserved: int

    @property
    def deepest(self) -> int:
        """Depth when the interrupt occurs at the deepest point of the background."""
        return self.thread + self.interrupt

    def __or__(self, other: Stack) -> Stack:
        """Maximum depths of two runs of the same image."""
        return Stack(max(self.thread, other.thread), max(self.interrupt, other.interrupt), self.reserved)


@dataclass
class Trace:
    """Number of executions of each instruction, in the order of the image: in all, in control interrupts, and in the
    longest of them."""

    image: Path
    executed: np.ndarray
    inside: np.ndarray
    in_longest: np.ndarray
    stack: Stack

    def __add__(self, other: Trace) -> Trace:
        """Both runs of the same image."""
        return Trace(self.image, self.executed + other.executed, self.inside + other.inside,
                     max(self.in_longest, other.in_longest, key=np.sum), self.stack | other.stack)

    def by_module(self) -> Counter[str]:
        """Instructions of all control interrupts by module of the firmware.

        A module is a source file; inlined code counts for the file in which it is written. Helpers (_HELPERS) count for
        their callers; those that are not inlined, in proportion to the calls.
        """
        return self._by_module(self.inside)

    def longest_by_module(self) -> Counter[str]:
        """Instructions of the longest control interrupt by module."""
        return self._by_module(self.in_longest)

    def _by_module(self, counts: np.ndarray) -> Counter[str]:
        known = _known(self.image)
        modules: Counter[str] = Counter()
        helpers: defaultdict[str, float] = defaultdict(float)
        callers: dict[str, Counter[tuple[str | None, str]]] = defaultdict(Counter)
        for instruction, module, count in zip(known.instructions, known.modules, counts.tolist(), strict=True):
            if count == 0:
                continue
            if module is None:
                helpers[instruction.function] += count
            else:
                modules[module] += count
            if instruction.goes_to and instruction.goes_to != instruction.function:
                callers[instruction.goes_to][module, instruction.function] += count
        exact: defaultdict[str, float] = defaultdict(float, modules)
        while helpers:
            function, count = helpers.popitem()
            calls = callers[function]
            if not calls:
                exact[PORT] += count
            for (module, caller), times in calls.items():
                share = count * times / calls.total()
                if module is None:
                    helpers[caller] += share
                else:
                    exact[module] += share
        return Counter({module: round(count) for module, count in exact.items()})

    def coverage(self) -> Coverage:
        """Coverage of the firmware with its generated sources, without port and libraries."""
        known = _known(self.image)
        files: dict[str, FileCoverage] = {}
        for locations, executed, inside in zip(known.locations, self.executed.tolist(), self.inside.tolist(),
                                               strict=True):
            location = locations[0]
            if not location.file.startswith(_NOT_FIRMWARE):
                of = files.setdefault(location.file, FileCoverage())
                of.instructions += 1
                of.executed += executed > 0
                of.in_interrupts += inside > 0
                of.lines.add(location.line)
                if executed:
                    of.lines_executed.add(location.line)
        return Coverage(dict(sorted(files.items())))


@dataclass
class FileCoverage:
    """Coverage of a source file: its instructions in the image, those executed in all and in interrupts, and their
    lines. Inlined code counts for the file in which it is written, once per copy."""

    instructions: int = 0
    executed: int = 0
    in_interrupts: int = 0
    lines: set[int] = field(default_factory=set)
    lines_executed: set[int] = field(default_factory=set)

    def missed_lines(self) -> list[int]:
        """Lines without an executed instruction."""
        return sorted(self.lines - self.lines_executed - {0})


@dataclass(frozen=True)
class Coverage:
    """Coverage by source file."""

    files: Mapping[str, FileCoverage]

    def totals(self) -> dict[str, int]:
        """Number of instructions of the firmware: all, executed, executed in interrupts."""
        return {name: sum(getattr(of, name) for of in self.files.values())
                for name in ("instructions", "executed", "in_interrupts")}

    def as_json(self) -> dict[str, Any]:
        """Content for a results file."""
        return {**self.totals(),
                "files": {file: {"instructions": of.instructions, "executed": of.executed,
                                 "in_interrupts": of.in_interrupts, "missed_lines": of.missed_lines()}
                          for file, of in self.files.items()}}


def read_trace(path: Path, image: Path) -> Trace:
    """Reads the trace of a run of the ELF image; format: emulator/qemu/trace.h."""
    known = _known(image)
    index_of = {instruction.address: i for i, instruction in enumerate(known.instructions)}
    counts = np.zeros((3, len(known.instructions) + 1), dtype=np.int64)
    begin = known.stack_begin
    thread_low, interrupt_bytes = begin, 0
    for line in path.read_text(encoding="utf-8").splitlines():
        kind, *words = line.split()
        if kind == "block":
            address, size = int(words[0], 16), int(words[1])
            if address not in index_of:
                continue  # boot code of the board, outside the image
            first = index_of[address]
            times = [int(word) for word in words[2:]]
            counts[:, first] += times
            counts[:, first + size] -= times
        elif words[0] == "thread":
            thread_low = min(begin, int(words[1], 16))
        else:
            interrupt_bytes = int(words[1])
    stack = Stack(begin - thread_low, interrupt_bytes + known.exception_frame_bytes, known.stack_reserved)
    executed, inside, in_longest = counts.cumsum(axis=1)[:, :-1]
    return Trace(image, executed, inside, in_longest, stack)


@dataclass(frozen=True)
class _Known:
    instructions: list[Instruction]
    locations: list[list[SourceLocation]]
    modules: list[str | None]
    """None for helpers."""
    stack_begin: int
    stack_reserved: int
    exception_frame_bytes: int


def _known(image: Path) -> _Known:
    return _read_image(image, image.stat().st_mtime_ns)


@lru_cache
def _read_image(path: Path, mtime_ns: int) -> _Known:
    image = ElfImage(path)
    instructions = image.instructions()
    locations = image.locations([instruction.address for instruction in instructions])
    ordered = [locations[instruction.address] for instruction in instructions]
    return _Known(instructions, ordered, [_module(of) for of in ordered], image.stack()[1], image.sections()[".stack"],
                  image.exception_frame_bytes)


def _module(locations: Iterable[SourceLocation]) -> str | None:
    for location in locations:
        if not location.file.startswith(_HELPERS):
            return PORT if location.file.startswith("hal/") else Path(location.file).stem
    return None
