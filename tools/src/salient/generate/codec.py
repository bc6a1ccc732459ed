"""Writes the C codec of a CAN database: cantools' pack and unpack functions, and setters that saturate.

    python -m salient.generate.codec [--integer] [--phases N] [--node NODE] FILE.dbc OUTDIR

writes OUTDIR/FILE_codec.h and OUTDIR/FILE_codec.c, every name in them with the prefix `FILE_` once: message FILE_STATUS
is `struct file_status_t`. cantools' pack functions truncate a value to the bits of its signal; the setters added here
saturate at the ends of its range. With --node also OUTDIR/FILE_enumerations.h and OUTDIR/FILE_telemetry.h and .c: the
named value tables, and the messages that the node sends cyclically. The output depends on the database alone: it has
no date, version or path.
"""

import argparse
import re
import sys
from pathlib import Path

import cantools
from cantools.database.can.c_source import camel_to_snake_case, generate
from cantools.database.can.database import Database
from cantools.database.can.signal import Signal
from cantools.database.errors import UnsupportedDatabaseFormatError

from salient.dbc import PHASES_MAX, attributes, database_hash, drive_dbc_of_phases
from salient.generate.enumerations import enumerations_header
from salient.generate.error import CodecError
from salient.generate.files import write_files
from salient.generate.ranges import raw_range
from salient.generate.telemetry import message_c_name, telemetry


def integer_literal(value: int) -> str:
    """C literal of a 64-bit integer; the most negative one has no literal."""
    return f"(-{-value - 1}ll - 1)" if value < 0 else f"{value}ll"


def c_type(signal: Signal) -> str:
    """The type of a signal's field in cantools' structures."""
    bits = next(width for width in (8, 16, 32, 64) if signal.length <= width)
    return f"{'' if signal.is_signed else 'u'}int{bits}_t"


_SATURATE = {
    f"saturate{bits}": "/* raw, limited to low..high. */\n"
    f"static int{bits}_t saturate{bits}(int64_t raw, int{bits}_t low, int{bits}_t high)\n{{\n"
    f"    return raw < low ? low : raw > high ? high : (int{bits}_t)raw;\n}}\n"
    for bits in (32, 64)
}


def setters(database: Database, prefix: str, integer: bool) -> tuple[str, str]:
    """Declarations and definitions of the saturating setters of all integer signals."""
    declarations, definitions, used = [], [], set()
    for message in database.messages:
        message_name = message_c_name(message, prefix)
        for signal in message.signals:
            if signal.is_float:
                continue
            low, high = raw_range(signal)
            field = camel_to_snake_case(signal.name)
            unit = f", LSB {signal.scale} {signal.unit or ''}".rstrip() + (
                f", offset {signal.offset}" * (signal.offset != 0)
            )
            prototype = f"void {message_name}_set_{field}(struct {message_name}_t *message, int64_t raw)"
            declarations.append(
                f"/* {message.name}.{signal.name} = raw, saturated to {low}..{high}{unit}. */\n{prototype};\n"
            )
            saturate = "saturate32" if low >= -(2**31) and high < 2**31 else "saturate64"
            used.add(saturate)
            definitions.append(
                f"{prototype}\n{{\n    message->{field} = ({c_type(signal)}){saturate}(raw, {integer_literal(low)}, "
                f"{integer_literal(high)});\n}}\n"
            )
            if integer:
                continue
            physical = f"void {message_name}_set_physical_{field}(struct {message_name}_t *message, double value)"
            declarations.append(
                f"/* The same from a value in {signal.unit or 'its unit'}: rounded to the nearest raw value,\n"
                f" * saturated; not-a-number gives the lower end. */\n{physical};\n"
            )
            definitions.append(
                f"{physical}\n{{\n"
                f"    double raw = (value - {float(signal.offset)!r}) / {float(signal.scale)!r};\n"
                f"    raw = raw < {float(high)!r} ? raw : (isnan(raw) ? {float(low)!r} : {float(high)!r});\n"
                f"    raw = raw > {float(low)!r} ? raw : {float(low)!r};\n"
                f"    {message_name}_set_{field}(message, llround(raw));\n}}\n"
            )
    return "\n".join(declarations), "\n".join([*(_SATURATE[name] for name in sorted(used)), *definitions])


def generate_codec(dbc: Path, integer: bool, node: str | None = None, phases: int = PHASES_MAX) -> dict[str, str]:
    """File name -> C text of the codec of `dbc`; `integer` leaves every floating-point conversion out. `node`: with
    the enumerations and what this node sends cyclically. `phases`: without messages of machines of more phases."""
    try:
        # cantools passes over an incomplete last statement; one more statement after it makes that an error.
        text = drive_dbc_of_phases(dbc.read_text(encoding="cp1252"), phases) + "\nVAL_TABLE_ end_of_file ;\n"
        database = cantools.database.load_string(text, database_format="dbc")
    except OSError as error:
        raise CodecError(f"{dbc}: {error.strerror}") from error
    except (UnsupportedDatabaseFormatError, cantools.Error, UnicodeDecodeError) as error:
        raise CodecError(f"{dbc}: {' '.join(str(error).split())}") from error
    assert isinstance(database, Database)  # as every DBC gives
    if not database.messages:
        raise CodecError(f"{dbc}: describes no CAN messages")
    prefix = camel_to_snake_case(dbc.stem)
    if not re.fullmatch(r"[a-z][a-z0-9_]*", prefix):
        raise CodecError(f"{dbc}: its name must begin a C identifier (letters, digits and _, no digit first)")
    name = f"{prefix}_codec"
    header, source, _, _ = generate(
        database, prefix, f"{name}.h", f"{name}.c", "", floating_point_numbers=not integer, use_round=not integer
    )
    files = {}
    try:
        declarations, definitions = setters(database, prefix, integer)
        if node is not None:
            files[f"{prefix}_enumerations.h"] = enumerations_header(database, prefix, dbc.name)
            files[f"{prefix}_telemetry.h"], files[f"{prefix}_telemetry.c"] = telemetry(
                database, prefix, dbc.name, node
            )
    except CodecError as error:
        raise CodecError(f"{dbc}: {error}") from error

    header, source = (_prefix_once(database, prefix, dbc.name, text) for text in (header, source))
    # cantools' include guard is <PREFIX>_H, which a hand-written <prefix>.h has a better right to.
    header = re.sub(rf"\b{prefix.upper()}_H\b", f"{name.upper()}_H", header)
    closing = "\n#ifdef __cplusplus\n}\n"
    head, found, tail = header.rpartition(closing)
    if not found:
        raise CodecError(f"{dbc}: cantools' header has no closing extern block; the pinned version 41.0.2 is expected")
    constants = _constants(database, prefix)
    files[f"{name}.h"] = f"{head}\n{constants}\n{declarations}{found}{tail}"
    files[f"{name}.c"] = f"{source.rstrip()}\n\n{definitions}"
    return files


def _prefix_once(database: Database, prefix: str, dbc_name: str, text: str) -> str:
    """cantools' text without its version, and without its second prefix where the message's name has the first."""
    if len({message_c_name(message, prefix) for message in database.messages}) != len(database.messages):
        raise CodecError(f"{dbc_name}: two messages have the same name without the prefix {prefix}_")
    text = re.sub(r"file was generated by cantools version .*", f"file was generated from {dbc_name}.", text)
    text = re.sub(rf"\b{prefix}_{prefix}_", f"{prefix}_", text)
    return re.sub(rf"\b{prefix.upper()}_{prefix.upper()}_", f"{prefix.upper()}_", text)


def _constants(database: Database, prefix: str) -> str:
    """Constants of the database that are no signals: its hash, data IDs of the end-to-end protection."""
    lines = [
        "/* Hash of the database in normal form, as tools compute it. */",
        f"#define {prefix.upper()}_DBC_HASH {database_hash(database):#010x}u",
    ]
    for message in database.messages:
        if "E2EDataId" in attributes(message):
            lines += [
                f"/* Data ID of {message.name}: part of its checksum, not transmitted. */",
                f"#define {message_c_name(message, prefix).upper()}_E2E_DATA_ID "
                f"{int(attributes(message)['E2EDataId']):#06x}u",
            ]
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Exit code 0, or 2 after one line on stderr when the database or the folder cannot be used."""
    parser = argparse.ArgumentParser(prog="salient.generate.codec", description="C codec of a CAN database (DBC)")
    parser.add_argument("--integer", action="store_true", help="no floating-point conversions")
    parser.add_argument("--node", help="also enumerations, and the cyclic messages of this node")
    parser.add_argument("--phases", type=int, default=PHASES_MAX, help="without messages of machines of more phases")
    parser.add_argument("dbc", type=Path, metavar="DBC")
    parser.add_argument("folder", type=Path, metavar="OUTDIR")
    options = parser.parse_args(arguments)
    return write_files("salient.generate.codec", options.folder,
                       lambda: generate_codec(options.dbc, options.integer, options.node, options.phases),
                       CodecError)


if __name__ == "__main__":
    sys.exit(main())
