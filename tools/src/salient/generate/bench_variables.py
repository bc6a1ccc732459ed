"""Writes the C table of the bench variables: the multiplexed signals of RIG_SET in a CAN database.

    python -m salient.generate.bench_variables FILE.dbc OUTDIR

writes OUTDIR/bench_variables.h: an enumeration of the multiplex numbers, and for each number the signal's name, scale
and range of raw values. All the signals share one bit field, so that one function extracts the raw value of any.
"""

import argparse
import sys
from pathlib import Path

import cantools
from cantools.database.can.c_source import camel_to_snake_case
from cantools.database.can.database import Database
from cantools.database.can.signal import Signal
from cantools.database.errors import UnsupportedDatabaseFormatError

from salient.generate.error import CodecError
from salient.generate.files import write_files
from salient.generate.ranges import raw_range

_MESSAGE = "RIG_SET"
_HEADER = """\
/* Bench variables: multiplexed signals of {message} in {source}, from which this file was generated. */
#ifndef BENCH_VARIABLES_H
#define BENCH_VARIABLES_H

#include <stdint.h>

/* Multiplex numbers. */
enum {{
{enumerators}
    BENCH_VARIABLE_COUNT /* one above the largest */
}};

typedef struct {{
    const char *name; /* NULL: no variable has this number */
    double scale;     /* value in the DBC's unit = raw * scale */
    int32_t raw_minimum, raw_maximum;
}} bench_variable_t;

static const bench_variable_t bench_variables[BENCH_VARIABLE_COUNT] = {{
{rows}
}};

/* Raw value of the variable that a {message} carries, whichever it is. */
static inline int32_t bench_variable_raw(const uint8_t *data) {{
    const uint32_t bits = {bits};
    return {value};
}}

#endif
"""


def _check(signals: list[Signal]) -> None:
    """CodecError when one bit field, one multiplex number each and no offset is not what the database has."""
    first = signals[0]
    for signal in signals:
        if signal.is_float or signal.offset != 0 or signal.byte_order != "little_endian":
            raise CodecError(f"signal {signal.name}: a bench variable must be a little-endian integer without offset")
        if signal.start % 8 or signal.length % 8 or signal.length > 32:
            raise CodecError(f"signal {signal.name}: a bench variable must be 1 to 4 whole bytes")
        if (signal.start, signal.length, signal.is_signed) != (first.start, first.length, first.is_signed):
            raise CodecError(f"signal {signal.name}: must have the bits and the sign of {first.name}")
        _number(signal)


def _number(signal: Signal) -> int:
    """Multiplex number; CodecError unless there is exactly one."""
    numbers = signal.multiplexer_ids or []
    if len(numbers) != 1:
        raise CodecError(f"signal {signal.name}: must have one multiplex number")
    return numbers[0]


def generate_table(dbc: Path) -> str:
    """C text of the table; CodecError, in one line."""
    try:
        database = cantools.database.load_file(dbc, encoding="cp1252")
        assert isinstance(database, Database)  # as every DBC gives
        signals = [s for s in database.get_message_by_name(_MESSAGE).signals if s.multiplexer_ids]
    except OSError as error:
        raise CodecError(f"{dbc}: {error.strerror}") from error
    except KeyError as error:
        raise CodecError(f"{dbc}: has no message {_MESSAGE}") from error
    except (UnsupportedDatabaseFormatError, cantools.Error, UnicodeDecodeError) as error:
        raise CodecError(f"{dbc}: {' '.join(str(error).split())}") from error
    if not signals:
        raise CodecError(f"{dbc}: {_MESSAGE} has no multiplexed signal")
    try:
        _check(signals)
        ranges = [raw_range(signal) for signal in signals]
    except CodecError as error:
        raise CodecError(f"{dbc}: {error}") from error
    variables = sorted(zip(signals, ranges, strict=True), key=lambda variable: _number(variable[0]))
    names = [f"BENCH_VARIABLE_{camel_to_snake_case(signal.name).upper()}" for signal, _ in variables]
    first = signals[0]
    octets = range(first.length // 8)
    bits = " | ".join(f"(uint32_t)data[{first.start // 8 + i}]" + (f" << {8 * i}" if i else "") for i in octets)
    sign = 1 << (first.length - 1)
    # Flipping the sign bit and subtracting its weight extends the sign without relying on shifts of negative numbers.
    value = f"(int32_t)((int64_t)(bits ^ {sign}u) - {sign})" if first.is_signed else "(int32_t)bits"
    enumerators = "\n".join(
        f"    {name} = {_number(signal)}," for name, (signal, _) in zip(names, variables, strict=True)
    )
    rows = "\n".join(
        f'    [{name}] = {{"{signal.name}", {float(signal.scale)!r}, {low}, {high}}},'
        for name, (signal, (low, high)) in zip(names, variables, strict=True)
    )
    return _HEADER.format(
        message=_MESSAGE, source=dbc.name, enumerators=enumerators, rows=rows, bits=bits, value=value
    )


def main(arguments: list[str] | None = None) -> int:
    """Exit code 0, or 2 after one line on stderr when the database or the folder cannot be used."""
    parser = argparse.ArgumentParser(prog="salient.generate.bench_variables", description="C table of bench variables")
    parser.add_argument("dbc", type=Path, metavar="DBC")
    parser.add_argument("folder", type=Path, metavar="OUTDIR")
    options = parser.parse_args(arguments)
    return write_files("salient.generate.bench_variables", options.folder,
                       lambda: {"bench_variables.h": generate_table(options.dbc)}, CodecError)


if __name__ == "__main__":
    sys.exit(main())
