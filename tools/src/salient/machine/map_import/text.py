"""Splits a text of any separator, decimal sign and encoding into blocks of rows."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?")
_MISSING = {"", "nan", "-", "--", "n/a", "na", "null"}
_GROUPED = {",": re.compile(r"[+-]?\d{1,3}(,\d{3})+(\.\d*)?"), ".": re.compile(r"[+-]?\d{1,3}(\.\d{3})+(,\d*)?")}
_DECIMAL = {",": re.compile(r"[+-]?\d*,\d+([eEdD].*)?"), ".": re.compile(r"[+-]?\d*\.\d+([eEdD].*)?")}
_NOTE = re.compile(r"\s+(#|%|!|//)\s.*")
_AXIS_MIN = 3  # cells with digits of a header that a line of units below it does not replace
_SEPARATORS = (";", "\t", ",", None)
"""None: blanks. The first of those that split equally many lines into numbers is used."""


@dataclass(frozen=True)
class Row:
    line: int
    cells: tuple[str, ...]
    values: tuple[float, ...]
    """Cells as numbers; NaN where a cell is empty."""


@dataclass
class Block:
    """Rows of numbers under the lines of text that precede them; the last of several cells is the header."""

    titles: list[str] = field(default_factory=list)
    header: tuple[str, ...] = ()
    rows: list[Row] = field(default_factory=list)


def decode(data: bytes) -> str:
    """UTF-8, UTF-16 with a byte order mark as spreadsheets write it, or a code page of Western Europe."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")


def number(cell: str) -> float | None:
    """A number with a decimal point or comma, NaN for a missing one, None for text."""
    text = cell.strip().strip("'")
    if text.lower() in _MISSING:
        return float("nan")
    if text.count(",") == 1 and "." not in text:
        text = text.replace(",", ".")
    if not _NUMBER.fullmatch(text):
        return None
    return float(re.sub("[dD]", "e", text))


def blocks(text: str) -> list[Block]:
    """The blocks of a text. A line of text after numbers begins a new one, and so does a blank line."""
    lines = [re.sub(r"^\s*-->\s*", "", line) for line in text.splitlines()]  # FEMM's console
    lines = [_without_note(line) for line in lines]
    separator = max(_SEPARATORS, key=lambda by: sum(_is_numbers(_cells(line, by)) for line in lines))
    grouping = _grouping(lines, separator)
    found = [Block()]
    for number_of, line in enumerate(lines, start=1):
        stripped = line.strip()
        comment = re.match(r"[#%!*]+|//", stripped)
        if not stripped or comment:
            if found[-1].rows:
                found.append(Block())
            if comment:
                rest = stripped[comment.end():].strip()
                _head(found[-1], rest, _ungrouped(_cells(rest, separator), grouping), comment=True)
            continue
        cells = _ungrouped(_cells(line, separator), grouping)
        if _is_numbers(cells):
            found[-1].rows.append(Row(number_of, tuple(cells), tuple(number(cell) or 0.0 for cell in cells)))
            continue
        if found[-1].rows:
            found.append(Block())
        _head(found[-1], stripped, cells, comment=False)
    return [block for block in found if block.rows]


def _without_note(line: str) -> str:
    """A row of numbers without a remark behind it."""
    short = _NOTE.sub("", line)
    return short if short != line and any(_is_numbers(_cells(short, by)) for by in _SEPARATORS) else line


def _grouping(lines: Sequence[str], separator: str | None) -> str:
    """The sign that groups the thousands of numbers, where others show that it is not the decimal sign; else empty."""
    cells = [cell for line in lines for cell in _cells(line, separator)]
    decimal = [sign for sign, pattern in _DECIMAL.items()
               if any(pattern.fullmatch(cell) and not _GROUPED[sign].fullmatch(cell) for cell in cells)]
    return {",": ".", ".": ","}[decimal[0]] if len(decimal) == 1 else ""


def _ungrouped(cells: list[str], grouping: str) -> list[str]:
    if not grouping:
        return cells
    return [cell.replace(grouping, "") if _GROUPED[grouping].fullmatch(cell) else cell for cell in cells]


def _head(block: Block, line: str, cells: Sequence[str], *, comment: bool) -> None:
    is_axis = sum(bool(re.search(r"\d", cell)) for cell in block.header) >= _AXIS_MIN
    is_units = is_axis and not re.search(r"\d", line)
    if sum(1 for cell in cells if cell) > 1 and not is_units and not (comment and block.header):
        block.header = tuple(cells)
    block.titles.append(line)


def _cells(line: str, separator: str | None) -> list[str]:
    if separator is None:
        if '"' in line:
            return [quoted or plain for quoted, plain in re.findall(r'"([^"]*)"|(\S+)', line)]
        return line.split()
    cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    cells = [cell.strip() for cell in cells]
    while len(cells) > 1 and not cells[-1]:
        cells.pop()
    return cells


def _is_numbers(cells: Sequence[str]) -> bool:
    values = [number(cell) for cell in cells]
    known = [value for value in values if value is not None and not math.isnan(value)]
    return None not in values and len(cells) >= 2 and len(known) >= 2
