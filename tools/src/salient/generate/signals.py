"""Writes the reference pages of all messages and signals on CAN from the DBCs.

    python -m salient.generate.signals

writes docs/reference/drive-signals.md and docs/reference/rig-signals.md.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from cantools.database.can import Message, Signal

from salient.dbc import attributes, load_database
from salient.generate.files import cell
from salient.paths import DRIVE_DBC, REFERENCE, RIG_DBC, ROOT

_HEAD = """# {title}

Generated from `{source}` by `python -m salient.generate.signals`; do not edit.

{text}

| column | meaning |
| --- | --- |
| bits | first bit and length; little endian, `s` signed |
| LSB | factor, in the unit |
| range | least and largest value, or the named values |
"""


@dataclass(frozen=True)
class Page:
    """A reference page of a database."""

    path: Path
    title: str
    source: Path
    text: str


DRIVE = Page(REFERENCE / "drive-signals.md", "Signals of the drive", DRIVE_DBC,
             "Identifiers, factors and ranges hold for node 0 and the machine `saturating`. This writes another DBC:\n"
             "`tools/salient machine NAME --node N --dbc FILE.dbc`.")
RIG = Page(REFERENCE / "rig-signals.md", "Signals of the test bench", RIG_DBC,
           "The *rig* is the emulator's test bench: clock, load, faults, true state. Its identifiers have 29 bits; a\n"
           "real drive has no such messages. Signals of `RIG_SET` are the variables `bench.rig.NAME` of a test.")


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.10g}"


def _named(signal: Signal) -> str:
    return ", ".join(f"{value} `{name}`" for value, name in sorted((signal.choices or {}).items()))


def _row(signal: Signal) -> str:
    limits = f"{_number(signal.minimum)} to {_number(signal.maximum)}" if signal.minimum is not None else ""
    bits = f"{signal.start}, {signal.length}{' s' if signal.is_signed else ''}"
    selected = f" ({signal.multiplexer_signal} {', '.join(map(str, signal.multiplexer_ids))})" \
        if signal.multiplexer_ids else ""
    return " | ".join((f"| `{signal.name}`{selected}", bits, _number(signal.scale) if not signal.choices else "",
                       signal.unit or "", _named(signal) or limits, f"{cell(signal.comment or '')} |"))


def _section(message: Message) -> str:
    cycle = f", each {message.cycle_time} ms" if message.cycle_time else ""
    protected = f", E2E data ID 0x{int(attributes(message)['E2EDataId']):04X}" \
        if "E2EDataId" in attributes(message) else ""
    facts = f"Identifier `0x{message.frame_id:03X}`, {message.length} bytes{cycle}{protected}."
    rows = "\n".join(map(_row, message.signals))
    return (f"\n## {message.name}\n\n{facts} {cell(message.comment or '')}\n\n"
            f"| signal | bits | LSB | unit | range | meaning |\n|{' --- |' * 6}\n{rows}\n")


def pages() -> dict[Path, str]:
    """The text of each page."""
    return {of.path: _HEAD.format(title=of.title, source=of.source.relative_to(ROOT), text=of.text)
            + "".join(map(_section, load_database(of.source).messages)) for of in (DRIVE, RIG)}


def main() -> int:
    """Writes the pages; returns the exit code."""
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
