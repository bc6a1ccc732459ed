"""Decoded signals as a table of one row for each value: CSV, and Parquet for what reads columns."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import can
from cantools.database.can import Database

from salient.bus.decoded_log import DecodedLog
from salient.bus.identity import Carrier
from salient.bus.signals import Signal, drive_database
from salient.errors import optional_package

_BATCH_FRAMES = 20_000
_HELD_MAX = 1_000_000
"""Frames, of 16 bytes each, that wait until the drive says which machine it carries; it does each 100 ms."""
_VALUE = 3  # its column
_WHOLE_MAX = 1 << 53
_COLUMNS = ("time_s", "message", "signal", "value", "unit", "name")

Row = tuple[int, str, str, float, str, str]
"""Time in ns, message, signal, value (whole where a float would round it), unit, and the name of the value where it has
one."""


class TableLog(DecodedLog):
    """A table of signals, in the order of time within each 20,000 frames."""

    _finished_bytes = 0

    def write(self, time_ns: int, message: can.Message) -> None:
        """Takes a frame."""
        known = self._take(time_ns, message)
        if self._waiting >= (_BATCH_FRAMES if known else _HELD_MAX):
            self._finished_bytes += self._waiting_bytes
            self._write_kept()

    def _write_kept(self) -> None:
        self._tables[0].decode_with(drive_database(self._carrier.likely, self._node))
        self.put_rows(sorted(self._rows(), key=lambda row: row[0]))
        self._tables = self._new_tables()

    def _rows(self) -> Iterator[Row]:
        for table in self._tables:
            for full_name in table:
                message, dot, name = full_name.partition(".")
                if not dot or not len(signal := table[full_name]):
                    continue
                values = table.exact(full_name) or signal.value.tolist()
                times_ns = table.times_ns(full_name).tolist()
                for time_ns, value, text in zip(times_ns, values, _names(signal), strict=True):
                    yield time_ns, message, name, value, signal.unit, text

    def put_rows(self, rows: list[Row]) -> None:
        """Appends rows."""
        raise NotImplementedError

    @property
    def size(self) -> int:
        return self._finished_bytes + self._waiting_bytes


def _names(signal: Signal) -> list[str]:
    if not signal.choices:
        return [""] * len(signal)
    return [signal.name_of(value) for value in signal.value.tolist()]


class CsvLog(TableLog):
    """CSV with the columns time_s, message, signal, value, unit and name."""

    def __init__(self, path: Path, carrier: Carrier, node: int, source: str, others: Sequence[Database] = ()) -> None:
        super().__init__(path, carrier, node, source, others)
        self._file = path.open("w", encoding="utf-8", newline="")
        self._write(",".join(_COLUMNS) + "\n")

    _bytes = 0

    def _write(self, text: str) -> None:
        self._bytes += self._file.write(text)

    def put_rows(self, rows: list[Row]) -> None:
        text = StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerows((_seconds(time_ns), message, signal, _text(value), unit, name)
                        for time_ns, message, signal, value, unit, name in rows)
        self._write(text.getvalue())

    @property
    def size(self) -> int:
        return self._bytes

    def _finish(self) -> None:
        self._file.close()


def _text(value: float) -> str:
    """All digits that a value has, without the rounding of its factor."""
    if isinstance(value, int) or (value.is_integer() and abs(value) < _WHOLE_MAX):
        return str(int(value))
    short = f"{value:.10g}"
    return short if abs(float(short) - value) <= 1e-14 * abs(value) else repr(value)


def _seconds(time_ns: int) -> str:
    seconds, nanoseconds = divmod(abs(time_ns), 1_000_000_000)
    return f"{'-' if time_ns < 0 else ''}{seconds}.{nanoseconds:09d}"


class ParquetLog(TableLog):
    """Parquet with the columns time_ns (whole), message, signal, value, unit and name."""

    def __init__(self, path: Path, carrier: Carrier, node: int, source: str, others: Sequence[Database] = ()) -> None:
        super().__init__(path, carrier, node, source, others)
        pyarrow: Any = optional_package("pyarrow", f"--out {path}: Parquet")
        parquet: Any = optional_package("pyarrow.parquet", f"--out {path}: Parquet")
        self._arrow = pyarrow
        types = (pyarrow.int64(), pyarrow.string(), pyarrow.string(), pyarrow.float64(), pyarrow.string(),
                 pyarrow.string())
        names = ("time_ns", *_COLUMNS[1:])
        self._schema: Any = pyarrow.schema(list(zip(names, types, strict=True)))
        self._writer = parquet.ParquetWriter(path, self._schema)

    def put_rows(self, rows: list[Row]) -> None:
        if rows:
            columns = [list(column) for column in zip(*rows, strict=True)]
            columns[_VALUE] = [float(value) for value in columns[_VALUE]]
            self._writer.write_table(self._arrow.table(columns, schema=self._schema))

    def _finish(self) -> None:
        self._writer.close()
