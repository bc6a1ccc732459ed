"""What can be said of an image or object of the firmware without running it: size, what it must not contain, and the
most stack that it can take."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass

from salient.elf import Image, Instruction

_FLOATING_POINT = re.compile(r"v[a-z]|f(?!ence)[a-z]+\.|f[ls]w\b")
"""Mnemonics of the Cortex-M4's unit, and of RISC-V's."""
_SOFT_FLOAT = re.compile(r"__aeabi_(c?[fd]|u?[il]2[fd]|h2f).*|__(fix|float|extend|trunc)\w+"
                         r"|__(add|sub|mul|div|neg|eq|ne|lt|le|gt|ge|unord|cmp|pow)[sdt]f\d?\w?")  # fmt: skip
_LIBRARY = {"memcpy", "memset"}
"""All that the firmware may call of the C library."""
_HEAP = re.compile(r"_?(malloc|calloc|realloc|free|sbrk)(_r)?")
_INDIRECT = re.compile(r"(blx|bx)\s+(?!lr)|jalr\s")
"""RISC-V's jr is left out: so a switch jumps through its table, as the Cortex-M4's does by tbb."""
_PUSHED = re.compile(r"(?:push(?:\.w)?\s+|stmdb(?:\.w)?\s+sp!,\s*)\{([^}]*)\}")
_LOWERED = re.compile(r"sub(?:\.w|w|s)?\s+sp,\s*(?:sp,\s*)?#(\d+)|str(?:d|\.w)?\s+.*\[sp, #-(\d+)\]!"
                      r"|addi?\s+sp,\s*sp,\s*-(\d+)")
_WORD_BYTES = 4


@dataclass(frozen=True)
class Size:
    """Bytes. flash: code, constants and initial values; ram: variables, without the stack."""

    flash: int
    ram: int


def size(image: Image) -> Size:
    """Of an image or object."""
    rows = [line.split() for line in image.run("size", "-A").splitlines()]
    sections = {row[0]: int(row[1]) for row in rows if len(row) == 3 and row[1].isdigit()}

    def total(*prefixes: str) -> int:
        return sum(count for name, count in sections.items() if name.startswith(prefixes))

    data = total(".data", ".sdata")
    return Size(flash=total(".text", ".rodata", ".ARM.exidx", ".srodata") + data, ram=data + total(".bss", ".sbss"))


def forbidden(image: Image) -> list[str]:
    """What an image has and must not: floating point in hardware or software, a heap."""
    symbols = image.symbols()
    return ([f"{one.function}: {one.mnemonic} {one.operands}".strip() for one in image.instructions()
             if _FLOATING_POINT.match(one.mnemonic)]
            + [name for name in symbols if _SOFT_FLOAT.fullmatch(name) or _HEAP.fullmatch(name)])


def needed(image: Image) -> set[str]:
    """What the firmware, linked with the compiler's helpers and nothing else, calls beside the HAL and _LIBRARY."""
    names = {line.split()[-1] for line in image.run("nm", "--undefined-only").splitlines() if line.strip()}
    return {name for name in names if not name.startswith("hal_")} - _LIBRARY


def indirect_calls(image: Image) -> list[str]:
    """Calls and jumps whose target is in a register."""
    return [f"{one.function}: {one.mnemonic} {one.operands}" for one in image.instructions()
            if _INDIRECT.match(f"{one.mnemonic} {one.operands}")]


def deepest_stack(image: Image, function: str) -> tuple[int, list[str]]:
    """Bytes that a function of an image takes of the stack at most, with all that it calls, and the way
    there. An upper bound: a function counts with everything that it ever pushes, whichever way through it is taken.

    ValueError for recursion, which has no bound.
    """
    frames: dict[str, int] = defaultdict(int)
    calls: dict[str, set[str]] = defaultdict(set)
    for one in image.instructions():
        frames[one.function] += _lowers_by(one)
        if one.goes_to and one.goes_to != one.function:
            calls[one.function].add(one.goes_to)
        elif one.goes_to and one.mnemonic in ("bl", "jal"):
            raise ValueError(f"{one.function} calls itself")
    known: dict[str, tuple[int, list[str]]] = {}

    def depth(name: str, above: tuple[str, ...]) -> tuple[int, list[str]]:
        if name in above:
            raise ValueError(f"recursion: {' > '.join((*above, name))}")
        if name not in known:
            below, way = max((depth(callee, (*above, name)) for callee in sorted(calls[name])),
                             default=(0, []), key=lambda found: found[0])
            known[name] = frames[name] + below, [name, *way]
        return known[name]

    return depth(function, ())


def _lowers_by(one: Instruction) -> int:
    text = f"{one.mnemonic} {one.operands}"
    if pushed := _PUSHED.match(text):
        return _WORD_BYTES * len(pushed[1].split(","))
    lowered = _LOWERED.match(text)
    return next(int(bytes_) for bytes_ in lowered.groups() if bytes_) if lowered else 0
