"""C enumerations from the value tables (VAL_) of a CAN database.

A signal names its enumeration by the attribute CEnumeration, "TYPE PREFIX": the type, and the prefix of its constants.
Signals that name the same type must have the same value table. Other value tables give no enumeration.
"""

from __future__ import annotations

import re

from cantools.database.can.database import Database

from salient.dbc import attributes
from salient.generate.error import CodecError


def enumerations_header(database: Database, prefix: str, dbc_name: str) -> str:
    """Text of <prefix>_enumerations.h: a typedef per enumeration and PREFIX_COUNT, the number of its values."""
    types: dict[str, tuple[str, dict[int, str], str]] = {}
    for message in database.messages:
        for signal in message.signals:
            name = str(attributes(signal).get("CEnumeration", ""))
            if not name:
                continue
            if not re.fullmatch(r"[a-z_]\w* [A-Z]\w*", name):
                raise CodecError(f"signal {signal.name}: CEnumeration '{name}' must be a type and a prefix")
            type_name, constants = name.split()
            values = {int(number): str(text) for number, text in sorted((signal.choices or {}).items())}
            if list(values) != list(range(len(values))) or not values:
                raise CodecError(f"signal {signal.name}: the values of {type_name} must be 0, 1, 2 and so on")
            if types.setdefault(type_name, (constants, values, signal.name))[:2] != (constants, values):
                raise CodecError(f"signal {signal.name}: its value table differs from another one of {type_name}")
    guard = f"{prefix.upper()}_ENUMERATIONS_H"
    text = [f"/* Enumerations of {dbc_name}; generated. */\n#ifndef {guard}\n#define {guard}\n"]
    for type_name, (constants, values, signal_name) in types.items():
        lines = [f"    {constants}_{text.upper()} = {number}," for number, text in values.items()]
        text.append(f"/* Values of the signal {signal_name}. */")
        text.append("typedef enum {\n" + "\n".join(lines) + f"\n}} {type_name};\n")
        text.append(f"#define {constants}_COUNT {len(values)}\n")
    return "\n".join([*text, "#endif\n"])
