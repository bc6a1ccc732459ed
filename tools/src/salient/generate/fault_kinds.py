"""Writes the C table of the kinds of faults: the multiplexed signals of RIG_FAULT in a CAN database.

    python -m salient.generate.fault_kinds FILE.dbc OUTDIR

writes OUTDIR/fault_kinds.h: an enumeration of the kinds, and for each its name, the places it has and the scale and
range of its attribute. All kinds have phase, leg, beginning and attribute in the same bits.
"""

import argparse
import sys
from pathlib import Path

import cantools
from cantools.database.can.database import Database
from cantools.database.can.signal import Signal
from cantools.database.errors import UnsupportedDatabaseFormatError

from salient.generate.error import CodecError
from salient.generate.files import write_files
from salient.generate.ranges import raw_range

_MESSAGE = "RIG_FAULT"
_BEGINS, _PHASE, _LEG, _ATTRIBUTE = (11, 1, False), (7, 3, False), (10, 1, False), (12, 20, True)
_HEADER = """\
/* Kinds of faults: multiplexed signals of {message} in {source}, from which this file was generated. */
#ifndef FAULT_KINDS_H
#define FAULT_KINDS_H

#include <stdbool.h>
#include <stdint.h>

/* Multiplex numbers. */
enum {{
{enumerators}
    FAULT_COUNT /* one above the largest */
}};

typedef struct {{
    const char *name; /* NULL: no kind has this number */
    bool has_phase, has_leg, has_attribute;
    double scale; /* attribute in the DBC's unit = raw * scale */
    int32_t raw_minimum, raw_maximum;
}} fault_kind_t;

static const fault_kind_t fault_kinds[FAULT_COUNT] = {{
{rows}
}};

/* Fields of a {message}, the first four bytes of which are `fault_request_bits` in little-endian order. */
typedef struct {{
    uint8_t kind, phase, leg;
    bool begins;
    int32_t raw; /* of the attribute */
    uint32_t at_us;
}} fault_request_t;

static inline uint32_t fault_request_bits(const fault_request_t *request) {{
    return request->kind | (uint32_t)request->phase << 7 | (uint32_t)request->leg << 10 |
           (uint32_t)request->begins << 11 | (uint32_t)request->raw << 12;
}}

static inline fault_request_t fault_request(const uint8_t *data) {{
    const int32_t bits = data[1] >> 4 | data[2] << 4 | data[3] << 12;
    return (fault_request_t){{
        .kind = data[0] & 0x7Fu,
        .phase = (uint8_t)(data[0] >> 7 | (data[1] & 3u) << 1),
        .leg = data[1] >> 2 & 1u,
        .begins = data[1] >> 3 & 1u,
        .raw = (bits ^ 0x80000) - 0x80000,
        .at_us = (uint32_t)data[4] | (uint32_t)data[5] << 8 | (uint32_t)data[6] << 16 | (uint32_t)data[7] << 24,
    }};
}}

#endif
"""


def _place(signal: Signal) -> tuple[int, int, bool]:
    return signal.start, signal.length, signal.is_signed


def _row(kind: Signal, others: list[Signal]) -> str:
    """The row of a kind; CodecError when its signals are not where all kinds have them."""
    if _place(kind) != _BEGINS:
        raise CodecError(f"signal {kind.name}: must be bit 11")
    phase = leg = False
    scale, low, high = 0.0, 0, 0
    attribute = False
    for signal in others:
        if _place(signal) == _PHASE:
            phase = True
        elif _place(signal) == _LEG:
            leg = True
        elif _place(signal) == _ATTRIBUTE and not attribute:
            attribute = True
            scale, (low, high) = float(signal.scale), raw_range(signal)
        else:
            raise CodecError(f"signal {signal.name}: must be in the bits of phase, leg or attribute")
    flags = ", ".join(str(flag).lower() for flag in (phase, leg, attribute))
    return f'    [FAULT_{kind.name.upper()}] = {{"{kind.name}", {flags}, {scale!r}, {low}, {high}}},'


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
    by_number: dict[int, list[Signal]] = {}
    for signal in signals:
        by_number.setdefault((signal.multiplexer_ids or [0])[0], []).append(signal)
    kinds: dict[int, Signal] = {}
    rows = []
    try:
        for number, group in sorted(by_number.items()):
            kinds[number] = min(group, key=lambda signal: len(signal.name))
            rows.append(_row(kinds[number], [signal for signal in group if signal is not kinds[number]]))
    except CodecError as error:
        raise CodecError(f"{dbc}: {error}") from error
    enumerators = "\n".join(f"    FAULT_{kind.name.upper()} = {number}," for number, kind in kinds.items())
    return _HEADER.format(message=_MESSAGE, source=dbc.name, enumerators=enumerators, rows="\n".join(rows))


def main(arguments: list[str] | None = None) -> int:
    """Exit code 0, or 2 after one line on stderr when the database or the folder cannot be used."""
    parser = argparse.ArgumentParser(prog="salient.generate.fault_kinds", description="C table of the kinds of faults")
    parser.add_argument("dbc", type=Path, metavar="DBC")
    parser.add_argument("folder", type=Path, metavar="OUTDIR")
    options = parser.parse_args(arguments)
    return write_files("salient.generate.fault_kinds", options.folder,
                       lambda: {"fault_kinds.h": generate_table(options.dbc)}, CodecError)


if __name__ == "__main__":
    sys.exit(main())
