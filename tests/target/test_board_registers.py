"""The header of the board's registers and its pins agree with two independent descriptions of the chip, and the check
sees every fact that is wrong."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from salient.board.check import DECIDED, differences, pin_differences, undecided
from salient.board.header import FACTS, HEADER, Header, Register, read_header
from salient.board.pins import read_pins
from salient.errors import UsageError

WHOLE = read_header(HEADER)
FACTS_OF_THE_CRATES = json.loads(FACTS.read_text())


def found(header: Header) -> list[str]:
    return list(differences(header, FACTS_OF_THE_CRATES))


def with_register(changed: Register, name: str) -> Header:
    return Header(WHOLE.bases, WHOLE.interrupts,
                  [changed if register.name == name else register for register in WHOLE.registers])


def test_header_agrees_with_both_crates():
    assert found(WHOLE) == []
    assert len(WHOLE.registers) > 100
    assert sum(len(register.fields) for register in WHOLE.registers) > 180


def test_both_crates_describe_most_of_it():
    """A fact that one crate lacks rests on the other alone: the decided ones and few more."""
    by_source = {source: {block for block, registers in FACTS_OF_THE_CRATES[source]["registers"].items()
                          if registers} for source in ("metapac", "svd")}
    blocks = {register.block for register in WHOLE.registers}
    assert by_source["svd"] == blocks
    assert blocks - by_source["metapac"] == {"COMP", "LPTIM"}  # comparators are instances of one register there


def test_every_decision_has_a_case():
    assert undecided(WHOLE, FACTS_OF_THE_CRATES) == set()
    assert all(len(reason) > 20 for reason in DECIDED.values())


@pytest.mark.parametrize("name", sorted(WHOLE.bases))
def test_a_wrong_address_is_found(name):
    assert found(Header(WHOLE.bases | {name: WHOLE.bases[name] + 0x400}, WHOLE.interrupts, [])) != []


@pytest.mark.parametrize("name", sorted(WHOLE.interrupts))
def test_a_wrong_interrupt_is_found(name):
    assert found(Header({}, WHOLE.interrupts | {name: WHOLE.interrupts[name] + 1}, [])) != []


@pytest.mark.parametrize("register", WHOLE.registers, ids=lambda register: register.name)
def test_wrong_facts_of_a_register_are_found(register: Register):
    access = "r" if register.access != "r" else "rw"
    wrong = [replace(register, access=access), replace(register, offset=register.offset + 0x800)]
    known = FACTS_OF_THE_CRATES["svd"]["registers"][register.block].values()
    if all(value["offset"] != register.offset for value in known):  # the other crate has no values and no bits to clear
        assert register.name in {"GPIO_IDR", "GPIO_AFRL", "GPIO_AFRH"}
        assert all(found(with_register(changed, register.name)) for changed in wrong)
        return
    if register.reset is not None and f"{register.name}.reset" not in DECIDED:
        wrong.append(replace(register, reset=register.reset ^ 0x10))
    if f"{register.name}.one_clears" not in DECIDED:
        wrong.append(replace(register, one_clears=register.one_clears ^ 2))
    if f"{register.name}.zero_clears" not in DECIDED:
        wrong.append(replace(register, zero_clears=register.zero_clears ^ 2))
    for changed in wrong:
        assert found(with_register(changed, register.name)) != [], changed


@pytest.mark.parametrize("register", [register for register in WHOLE.registers if register.fields],
                         ids=lambda register: register.name)
def test_a_shifted_or_wider_field_is_found(register: Register):
    for field, (first, width) in register.fields.items():
        if f"{register.name}.{field}" in DECIDED:
            continue
        for place in ((first + 1, width), (first - 1, width), (first, width + 1)):
            changed = replace(register, fields=register.fields | {field: place})
            assert found(with_register(changed, register.name)) != [], (field, place)


def test_a_line_of_another_form_is_named(tmp_path):
    path = tmp_path / "registers.h"
    path.write_text("/* --- RCC */\n#define RCC_BASE 0x40021000u\n#define RCC_CR REGISTER(RCC_BASE, 0x00)\n")
    with pytest.raises(UsageError, match=r"registers\.h:3: .*RCC_CR"):
        read_header(path)


def test_a_field_below_another_register_is_named(tmp_path):
    path = tmp_path / "registers.h"
    path.write_text("/* --- RCC */\n#define RCC_BASE 0x40021000u\n"
                    "#define RCC_CR REGISTER(RCC_BASE, 0x00) /* rw 0x63 */\n#define RCC_CFGR_SW BITS(0, 2)\n")
    with pytest.raises(UsageError, match="RCC_CFGR_SW is no field of the register above"):
        read_header(path)


def test_pins_have_their_functions():
    assert list(pin_differences(read_pins(), FACTS_OF_THE_CRATES)) == []


@pytest.mark.parametrize("pin", [pin for pin in read_pins() if pin.functions], ids=lambda pin: pin.signal)
def test_a_wrong_function_of_a_pin_is_found(pin):
    def other(function: str) -> str:
        name, colon, number = function.partition(":")
        return f"{name}:{(int(number) + 1) % 16}" if colon else f"{name}9"

    for i, function in enumerate(pin.functions):
        functions = (*pin.functions[:i], other(function), *pin.functions[i + 1:])
        assert len(list(pin_differences([replace(pin, functions=functions)], FACTS_OF_THE_CRATES))) == 1
    assert list(pin_differences([replace(pin, pin="PA13")], FACTS_OF_THE_CRATES)) != []
