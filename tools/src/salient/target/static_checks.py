"""Static checks of an ELF image or object of the firmware: size, forbidden instructions and symbols, stack bound."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass

from salient.elf import ElfImage, Instruction

_FLOATING_POINT = re.compile(r"v[a-z]|f(?!ence)[a-z]+\.|f[ls]w\b")
"""Floating-point mnemonics of the Cortex-M4 and of RISC-V."""
_SOFT_FLOAT = re.compile(r"__aeabi_(c?[fd]|u?[il]2[fd]|h2f).*|__(fix|float|extend|trunc)\w+"
                         r"|__(add|sub|mul|div|neg|eq|ne|lt|le|gt|ge|unord|cmp|pow)[sdt]f\d?\w?")  # fmt: skip
_LIBRARY = {"memcpy", "memset"}
"""The only functions of the C library that the firmware may call."""
_HEAP = re.compile(r"_?(malloc|calloc|realloc|free|sbrk)(_r)?")
_INDIRECT = re.compile(r"(blx|bx)\s+(?!lr)|jalr\s")
"""Without RISC-V's jr, which implements the jump table of a switch, as tbb does on the Cortex-M4."""
_PUSHED = re.compile(r"(?:push(?:\.w)?\s+|stmdb(?:\.w)?\s+sp!,\s*)\{([^}]*)\}")
_LOWERED = re.compile(r"sub(?:\.w|w|s)?\s+sp,\s*(?:sp,\s*)?#(\d+)|str(?:d|\.w)?\s+.*\[sp, #-(\d+)\]!"
                      r"|addi?\s+sp,\s*sp,\s*-(\d+)")
_WORD_BYTES = 4


@dataclass(frozen=True)
class Size:
    """Bytes. flash: code, constants and initial values; ram: variables, without the stack."""

    flash: int
    ram: int


def size(image: ElfImage) -> Size:
    """Size of an image or object."""
    rows = [line.split() for line in image.run("size", "-A").splitlines()]
    sections = {row[0]: int(row[1]) for row in rows if len(row) == 3 and row[1].isdigit()}

    def total(*prefixes: str) -> int:
        return sum(count for name, count in sections.items() if name.startswith(prefixes))

    data = total(".data", ".sdata")
    return Size(flash=total(".text", ".rodata", ".ARM.exidx", ".srodata") + data, ram=data + total(".bss", ".sbss"))


def forbidden(image: ElfImage) -> list[str]:
    """Forbidden content of an image: hardware or software floating point, a heap."""
    symbols = image.symbols()
    return ([f"{one.function}: {one.mnemonic} {one.operands}".strip() for one in image.instructions()
             if _FLOATING_POINT.match(one.mnemonic)]
            + [name for name in symbols if _SOFT_FLOAT.fullmatch(name) or _HEAP.fullmatch(name)])


def undefined_symbols(image: ElfImage) -> set[str]:
    """Undefined symbols of the firmware, linked with the compiler's helpers only, besides the HAL and _LIBRARY."""
    names = {line.split()[-1] for line in image.run("nm", "--undefined-only").splitlines() if line.strip()}
    return {name for name in names if not name.startswith("hal_")} - _LIBRARY


def indirect_calls(image: ElfImage) -> list[str]:
    """Calls and jumps with the target in a register."""
    return [f"{one.function}: {one.mnemonic} {one.operands}" for one in image.instructions()
            if _INDIRECT.match(f"{one.mnemonic} {one.operands}")]


_RESTARTS = {("board_restart", "program_start")}
"""Jumps with the stack pointer at its initial value: the stack is empty again."""


def deepest_stack(image: ElfImage, function: str) -> tuple[int, list[str]]:
    """Upper bound of the stack of a function and its callees, in bytes, and the call path that reaches it. Each
    function counts with everything that it pushes on any path.

    ValueError for recursion, which has no bound.
    """
    frames: dict[str, int] = defaultdict(int)
    calls: dict[str, set[str]] = defaultdict(set)
    for one in image.instructions():
        frames[one.function] += _lowers_by(one)
        if one.goes_to and one.goes_to != one.function and (one.function, one.goes_to) not in _RESTARTS:
            calls[one.function].add(one.goes_to)
        elif one.goes_to and one.mnemonic in ("bl", "jal"):
            raise ValueError(f"{one.function} calls itself")
    known: dict[str, tuple[int, list[str]]] = {}

    def depth(name: str, above: tuple[str, ...]) -> tuple[int, list[str]]:
        if name in above:
            raise ValueError(f"recursion: {' > '.join((*above, name))}")
        if name not in known:
            below, path = max((depth(callee, (*above, name)) for callee in sorted(calls[name])),
                             default=(0, []), key=lambda found: found[0])
            known[name] = frames[name] + below, [name, *path]
        return known[name]

    return depth(function, ())


def _lowers_by(one: Instruction) -> int:
    text = f"{one.mnemonic} {one.operands}"
    if pushed := _PUSHED.match(text):
        return _WORD_BYTES * len(pushed[1].split(","))
    lowered = _LOWERED.match(text)
    return next(int(bytes_) for bytes_ in lowered.groups() if bytes_) if lowered else 0
