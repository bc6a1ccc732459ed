"""Compares the port's header and the pins with the two crates (hal/stm32g4/facts.json)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from salient.board.header import Header, Register
from salient.board.pins import Pin

SOURCES = ("metapac", "svd")

DECIDED = {
    "TIM_AF1.reset": "the manual has 0x1: BKIN is enabled after a reset",
    "TIM_AF2.reset": "the manual has 0x1: BKIN2 likewise",
    "FLASH_SR.one_clears": "no annotation; the manual: each flag is cleared by writing 1",
    "FLASH_ECCR.one_clears": "no annotation; the manual: ECCC, ECCD, ECCC2 and ECCD2 are cleared by writing 1",
    "FDCAN_IR.one_clears": "no annotation; the manual: a flag is cleared by writing 1",
    "TIM_SR.zero_clears": "annotated without the four encoder flags of bits 20 to 23; the manual: rc_w0",
    "PWR_CR5.R1MODE": "bit 8 in the manual and one crate, bit 0 in the other",
    "DMAMUX_C0CR.DMAREQ_ID": "7 bits in the manual and one crate, 8 in the other",
    "ADC_CR.one_clears": "annotated because a one sets the bit and the converter clears it",
}
"""Where the crates disagree, with each other or with the manual, and the manual decides."""


def differences(header: Header, facts: dict[str, Any]) -> Iterator[str]:
    """One line for each fact of the header that a crate contradicts, or that neither of them has, apart from those
    decided."""
    for kind, named in (("addresses", header.bases), ("interrupts", header.interrupts)):
        for name, value in named.items():
            found = {facts[source][kind][name] for source in SOURCES if name in facts[source][kind]}
            if found != {value}:
                yield f"{name}: {kind} {value:#x}, the crates have {sorted(map(hex, found))}"
    for register in header.registers:
        for what, line in _register_differences(register, facts):
            if f"{register.name}.{what}" not in DECIDED:
                yield f"{register.name}.{what}: {line}"


def undecided(header: Header, facts: dict[str, Any]) -> set[str]:
    """Decisions of which the header has no case any more."""
    used = {f"{register.name}.{what}" for register in header.registers
            for what, _ in _register_differences(register, facts)}
    return set(DECIDED) - used


def _register_differences(register: Register, facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    known = {source: [value for value in facts[source]["registers"][register.block].values()
                      if value["offset"] == register.offset] for source in SOURCES}
    if not known["metapac"] and not known["svd"]:
        yield "offset", f"no register at {register.offset:#x}"
        return
    for value in known["svd"]:
        for name, written in (("access", register.access), ("reset", register.reset),
                              ("one_clears", register.one_clears), ("zero_clears", register.zero_clears)):
            if written is not None and value[name] != written:
                yield name, f"{written}, the crate has {value[name]}"
    if not known["svd"] and known["metapac"][0]["access"] != register.access:
        yield "access", f"{register.access}, the crate has {known['metapac'][0]['access']}"
    for field, (first, width) in register.fields.items():
        yield from _field_differences(field, first, width, [value["fields"] for values in known.values()
                                                            for value in values])


def _field_differences(field: str, first: int, width: int, lists: list[list[list[Any]]]) -> Iterator[tuple[str, str]]:
    """A field must be in one of the lists, at its bits, and nowhere else in any."""
    places = [(at, bits) for fields in lists for name, at, bits in fields if _same(name, field, at, first)]
    if (first, width) not in places:
        yield field, f"bits {first} to {first + width - 1} are no such field in the crates"
    for at, bits in places:
        if (at, bits) != (first, width):
            yield field, f"{width} bits from {first}, a crate has {bits} from {at}"


def _same(name: str, field: str, at: int, first: int) -> bool:
    """Names without the numbers, which the crates write in their own ways: then only at the place in question."""
    plain, wanted = (re.sub(r"[\[\]\d]|^daccdhr$", "", text.lower()) for text in (name, field))
    if name.lower() == field.lower():
        return True
    return plain == wanted and at == first


def pin_differences(pins: list[Pin], facts: dict[str, Any]) -> Iterator[str]:
    """One line for each function that the chip does not have at its pin."""
    for pin in pins:
        known = facts["pins"].get(pin.pin)
        if known is None:
            yield f"{pin.signal}: {pin.pin} is not in facts.json"
            continue
        for function in pin.functions:
            if function not in known:
                yield f"{pin.signal}: {pin.pin} has no {function}"
