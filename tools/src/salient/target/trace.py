"""What the processor did in a run: instructions by the part of the firmware that they serve, coverage of the object
code, depth of the stack. Read from what the target writes on --execution, and from its image."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from salient.elf import Image, Instruction, Place

PORT = "port"
"""The part that is not firmware: handler, HAL."""
_HELPERS = ("firmware/fixed/", "hal/qemu/rv32_virt/memory.c", "/", "?")
"""What counts for the part that uses it, by the beginning of the source's path: arithmetic, memcpy and memset where the
board has its own, and what is not in the repository, the compiler's and the C library's."""
_NOT_FIRMWARE = ("hal/", "/", "?")


@dataclass(frozen=True)
class Stack:
    """Bytes. thread: deepest of the background; interrupt: deepest of a control interrupt, with the processor's frame;
    reserved: what the linker script leaves at least. Depths are those of bytes that were written to."""

    thread: int
    interrupt: int
    reserved: int

    @property
    def deepest(self) -> int:
        """When the interrupt comes where the background is deepest."""
        return self.thread + self.interrupt

    def __or__(self, other: Stack) -> Stack:
        """The deeper of both runs of one image."""
        return Stack(max(self.thread, other.thread), max(self.interrupt, other.interrupt), self.reserved)


@dataclass
class Execution:
    """How often each instruction was executed, in all, in control interrupts and in the dearest of them, in the image's
    order."""

    image: Path
    executed: np.ndarray
    inside: np.ndarray
    in_worst: np.ndarray
    stack: Stack

    def __add__(self, other: Execution) -> Execution:
        """Both runs of one image."""
        return Execution(self.image, self.executed + other.executed, self.inside + other.inside,
                         max(self.in_worst, other.in_worst, key=np.sum), self.stack | other.stack)

    def by_part(self) -> Counter[str]:
        """Instructions of all control interrupts by the part of the firmware that they serve.

        A part is a source file; what is inlined counts for the file that it was written in. Helpers (_HELPERS) count
        for their callers; where they are functions of their own, in proportion to the calls.
        """
        return self._by_part(self.inside)

    def worst_by_part(self) -> Counter[str]:
        """The same of the dearest interrupt."""
        return self._by_part(self.in_worst)

    def _by_part(self, counts: np.ndarray) -> Counter[str]:
        known = _known(self.image)
        parts: Counter[str] = Counter()
        helpers: Counter[str] = Counter()
        callers: dict[str, Counter[tuple[str | None, str]]] = defaultdict(Counter)
        for instruction, part, count in zip(known.instructions, known.parts, counts.tolist(), strict=True):
            if count == 0:
                continue
            if part is None:
                helpers[instruction.function] += count
            else:
                parts[part] += count
            if instruction.goes_to and instruction.goes_to != instruction.function:
                callers[instruction.goes_to][part, instruction.function] += count
        exact: defaultdict[str, float] = defaultdict(float, parts)
        while helpers:
            function, count = helpers.popitem()
            calls = callers[function]
            if not calls:
                exact[PORT] += count
            for (part, caller), times in calls.items():
                share = count * times / calls.total()
                if part is None:
                    helpers[caller] += share
                else:
                    exact[part] += share
        return Counter({part: round(count) for part, count in exact.items()})

    def coverage(self) -> Coverage:
        """Of the firmware, generated sources included; port and libraries are left out."""
        known = _known(self.image)
        files: dict[str, FileCoverage] = {}
        for places, executed, inside in zip(known.places, self.executed.tolist(), self.inside.tolist(), strict=True):
            place = places[0]
            if not place.file.startswith(_NOT_FIRMWARE):
                of = files.setdefault(place.file, FileCoverage())
                of.instructions += 1
                of.executed += executed > 0
                of.in_interrupts += inside > 0
                of.lines.add(place.line)
                if executed:
                    of.lines_executed.add(place.line)
        return Coverage(dict(sorted(files.items())))


@dataclass
class FileCoverage:
    """Of a source file: its instructions in the image, how many of them were executed, in all and in interrupts, and
    the lines that they are of. What is inlined counts for the file that it was written in, each time."""

    instructions: int = 0
    executed: int = 0
    in_interrupts: int = 0
    lines: set[int] = field(default_factory=set)
    lines_executed: set[int] = field(default_factory=set)

    def missed_lines(self) -> list[int]:
        """Lines none of whose instructions was executed."""
        return sorted(self.lines - self.lines_executed - {0})


@dataclass(frozen=True)
class Coverage:
    """By source file."""

    files: Mapping[str, FileCoverage]

    def totals(self) -> dict[str, int]:
        """Instructions of the firmware, those executed, those executed in interrupts."""
        return {name: sum(getattr(of, name) for of in self.files.values())
                for name in ("instructions", "executed", "in_interrupts")}

    def as_json(self) -> dict[str, Any]:
        """For a results file."""
        return {**self.totals(),
                "files": {file: {"instructions": of.instructions, "executed": of.executed,
                                 "in_interrupts": of.in_interrupts, "missed_lines": of.missed_lines()}
                          for file, of in self.files.items()}}


def read_execution(path: Path, image: Path) -> Execution:
    """What a run of the image has written to path (emulator/qemu/trace.h)."""
    known = _known(image)
    place_of = {instruction.address: i for i, instruction in enumerate(known.instructions)}
    counts = np.zeros((3, len(known.instructions) + 1), dtype=np.int64)
    begin = known.stack_begin
    thread_low, interrupt_bytes = begin, 0
    for line in path.read_text(encoding="utf-8").splitlines():
        kind, *words = line.split()
        if kind == "block":
            address, size = int(words[0], 16), int(words[1])
            if address not in place_of:
                continue  # the board's own, before the image
            first = place_of[address]
            times = [int(word) for word in words[2:]]
            counts[:, first] += times
            counts[:, first + size] -= times
        elif words[0] == "thread":
            thread_low = min(begin, int(words[1], 16))
        else:
            interrupt_bytes = int(words[1])
    stack = Stack(begin - thread_low, interrupt_bytes + known.exception_frame_bytes, known.stack_reserved)
    return Execution(image, *counts.cumsum(axis=1)[:, :-1], stack)


@dataclass(frozen=True)
class _Known:
    instructions: list[Instruction]
    places: list[list[Place]]
    parts: list[str | None]
    """None: a helper."""
    stack_begin: int
    stack_reserved: int
    exception_frame_bytes: int


def _known(image: Path) -> _Known:
    return _read_image(image, image.stat().st_mtime_ns)


@lru_cache
def _read_image(path: Path, mtime_ns: int) -> _Known:
    image = Image(path)
    instructions = image.instructions()
    places = image.places([instruction.address for instruction in instructions])
    ordered = [places[instruction.address] for instruction in instructions]
    return _Known(instructions, ordered, [_part(of) for of in ordered], image.stack()[1], image.sections()[".stack"],
                  image.exception_frame_bytes)


def _part(places: Iterable[Place]) -> str | None:
    for place in places:
        if not place.file.startswith(_HELPERS):
            return PORT if place.file.startswith("hal/") else Path(place.file).stem
    return None
