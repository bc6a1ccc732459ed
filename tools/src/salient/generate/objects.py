"""The object dictionary (firmware/comms/objects.toml) as a C table, a build step, and as a reference page.

    python -m salient.generate.objects OUTDIR     writes canopen_dictionary.h and canopen_dictionary.c
    python -m salient.generate.objects            writes docs/reference/objects.md
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from salient.generate.files import cell, write_files
from salient.machine.object_dictionary import (
    BITS,
    PARAMETER,
    PARAMETER_BASE,
    TYPES,
    Dictionary,
    DictionaryError,
    Entry,
    read_dictionary,
)
from salient.machine.parameter_table import read_table
from salient.paths import REFERENCE

PAGE = REFERENCE / "objects.md"
NAME = "canopen_dictionary"
_HEAD = "/* Generated from firmware/comms/objects.toml by salient.generate.objects. */\n"
_DECLARATIONS = """#ifndef CANOPEN_DICTIONARY_H
#define CANOPEN_DICTIONARY_H

#include <stdint.h>

#include "drive_enumerations.h"

typedef enum {{
{values}
    CANOPEN_VALUE_COUNT = {value_count}
}} canopen_value_t;

/* Functions that compute the value of an entry that is neither a variable nor a constant. */
typedef enum {{
{sources}
}} canopen_from_t;

enum {{
{types}
}};

/* Bits of canopen_row_t.access. */
enum {{
    CANOPEN_WRITE = 2,
    CANOPEN_RPDO = 4,
    CANOPEN_TPDO = 8,
    CANOPEN_FROM = 16,          /* `value` is a canopen_from_t */
    CANOPEN_CONSTANT = 32,      /* `initial` is the value */
    CANOPEN_COMMUNICATION = 64, /* a variable that reset communication resets */
}};

/* Entries alike: `count` sub-indices from `first` on of `instances` indices from `index` on. A variable of instance i
 * and sub-index first + s is values[value + i * count + s]. Limits are of what can be written, as bits of its type. */
typedef struct {{
    uint16_t index;
    uint8_t instances, first, count, type, access, value;
    int32_t minimum, maximum, initial;
}} canopen_row_t;

#define CANOPEN_ROWS {rows}u
#define CANOPEN_PARAMETERS {base:#06x}u /* index of the first parameter */
#define CANOPEN_VENDOR {vendor:#010x}u
#define CANOPEN_PRODUCT {product:#010x}u

/* By ascending index and sub-index. */
extern const canopen_row_t canopen_rows[CANOPEN_ROWS];

/* Error code of a fault. */
extern const uint16_t canopen_error_codes[FAULT_COUNT];

/* Text of an entry of type string: its `initial`. */
extern const char *const canopen_strings[];

#endif
"""


def _slots(entries: list[Entry]) -> dict[str, int]:
    slots, end = {}, 0
    for entry in entries:
        if entry.value:
            slots[entry.value] = end
            end += entry.instances * entry.count
    if end > 256:
        raise DictionaryError(f"{end} variables: a row has 8 bits for the first one")
    slots[""] = end
    return slots


def header(dictionary: Dictionary) -> str:
    """canopen_dictionary.h."""
    entries = dictionary.entries()
    slots = _slots(entries)
    sources = [*dict.fromkeys(entry.source for entry in entries if entry.source), PARAMETER]
    return _HEAD + _DECLARATIONS.format(
        values="\n".join(f"    CANOPEN_VALUE_{name} = {slot}," for name, slot in slots.items() if name),
        value_count=slots[""], sources="\n".join(f"    CANOPEN_FROM_{name}," for name in sources),
        types="\n".join(f"    CANOPEN_{name.upper()} = {number}," for name, number in TYPES.items()),
        rows=len(entries), base=PARAMETER_BASE, vendor=dictionary.device["vendor"],
        product=dictionary.device["product"])


def _access(entry: Entry) -> str:
    bits = [name for name, has in (
        ("CANOPEN_WRITE", entry.access == "rw"), ("CANOPEN_RPDO", "r" in entry.pdo),
        ("CANOPEN_TPDO", "t" in entry.pdo), ("CANOPEN_FROM", entry.source),
        ("CANOPEN_CONSTANT", not entry.source and not entry.value),
        ("CANOPEN_COMMUNICATION", entry.reset == "communication")) if has]
    return " | ".join(bits) or "0"


def _bits(value: int) -> str:
    """As int32_t."""
    value = value - (1 << 32) if value >= 1 << 31 else value
    return "INT32_MIN" if value == -(1 << 31) else str(value)


def source(dictionary: Dictionary) -> str:
    """canopen_dictionary.c."""
    rows: list[str] = []
    strings: list[str] = []
    for entry in dictionary.entries():
        value = f"CANOPEN_FROM_{entry.source}" if entry.source else f"CANOPEN_VALUE_{entry.value}" if entry.value else 0
        initial = entry.initial
        if entry.string:
            initial = len(strings)
            strings.append("VERSION" if entry.string == "@VERSION" else json.dumps(entry.string))
        rows.append(f"    {{{entry.index:#06x}, {entry.instances}, {entry.sub}, {entry.count}, "
                    f"CANOPEN_{entry.type.upper()}, {_access(entry)}, {value}, {_bits(entry.minimum)}, "
                    f"{_bits(entry.maximum)}, {_bits(initial)}}},")
    codes = [f"    [FAULT_{name.upper()}] = {code:#06x}," for name, code in dictionary.error_codes.items()]
    return "\n".join([
        _HEAD + f'#include "{NAME}.h"', "", "#define TEXT_OF(number) #number", "#define TEXT(number) TEXT_OF(number)",
        "#define VERSION TEXT(SALIENT_VERSION_MAJOR) \".\" TEXT(SALIENT_VERSION_MINOR) \".\" "
        "TEXT(SALIENT_VERSION_PATCH)", "",
        "const canopen_row_t canopen_rows[CANOPEN_ROWS] = {", *rows, "};", "",
        "const uint16_t canopen_error_codes[FAULT_COUNT] = {", *codes, "};", "",
        "const char *const canopen_strings[] = {", *(f"    {text}," for text in strings), "};", ""])


_PAGE_HEAD = """# Objects of the drive

Generated from `firmware/comms/objects.toml` by `python -m salient.generate.objects`; do not edit.

Object dictionary of the drive with the parameter `protocol` above 0: [CANopen](../can/canopen.md).

- *Access*: `const` and `ro` are read, `rw` is read and written. *PDO*: may be mapped to receive (R), transmit (T) PDOs.
- *Range*: values beyond it are refused with 0x06090031 or 0x06090032. *Initial*: after a reset.
- `0x{base:04X}` to `0x{end:04X}`: the {parameters} parameters, in the order of [their table](parameters.md), as
  INTEGER32 in raw values, TPDO. They are written by the checks of [a set](../can/parameters.md#a-set-of-parameters).

| index | sub | name | type | access | PDO | range | initial | meaning |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |
"""


def _page_row(entry: Entry) -> str:
    index = f"0x{entry.index:04X}" + (f" to {entry.index + entry.instances - 1:04X}" if entry.instances > 1 else "")
    sub = f"{entry.sub}" + (f" to {entry.sub + entry.count - 1}" if entry.count > 1 else "")
    pdo = ", ".join(name for letter, name in (("r", "R"), ("t", "T")) if letter in entry.pdo)
    span = f"{entry.minimum} to {entry.maximum}" if entry.access == "rw" and entry.type in BITS else ""
    initial = entry.string.replace("@VERSION", "the version") if entry.string else \
        "" if entry.source else f"0x{entry.initial:X}" if entry.initial > 100000 else f"{entry.initial}"
    cells = (index, sub, entry.name, entry.type, entry.access, pdo, span, initial, cell(entry.text))
    return f"| {' | '.join(cells)} |"


def page() -> str:
    """The reference page."""
    count = len(read_table())
    head = _PAGE_HEAD.format(base=PARAMETER_BASE, end=PARAMETER_BASE + count - 1, parameters=count)
    return head + "\n".join(map(_page_row, read_dictionary().entries())) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Writes the table to a folder, or without one the page; exit code 0, or 2 after one line on stderr."""
    if not arguments:
        PAGE.write_text(page(), encoding="utf-8")
        return 0
    return write_files("salient.generate.objects", Path(arguments[0]), lambda: {
        f"{NAME}.h": header(read_dictionary()), f"{NAME}.c": source(read_dictionary())}, DictionaryError)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
