"""The pins of the board (hal/stm32g4/pins.toml): header of the port, table and picture of the documents.

    python -m salient.board.pins OUTDIR

is the build step that writes stm32g4/pins.h.
"""

from __future__ import annotations

import re
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

from salient.board.header import PORT
from salient.errors import UsageError
from salient.generate.files import write_files
from salient.paths import ROOT

PINS = PORT / "pins.toml"
PAGE = ROOT / "docs" / "board" / "pins.md"
PICTURE = ROOT / "docs" / "images" / "board.svg"
MODES = {"input": 0, "alternate": 2, "analogue": 3}
PULLS = {"none": 0, "up": 1, "down": 2}
_HEAD = """# Pins of the NUCLEO-G474RE

Generated from `hal/stm32g4/pins.toml` by `tools/salient docs --generate`; do not edit.

For those who wire a power stage to the board. A test compares the table with the alternate functions of the chip.

![Pins of the board, by group](../images/board.svg)

| signal | pin | header | function | pull | |
| --- | --- | --- | --- | --- | --- |"""
_RULES = """
## Rules of the stage

- Gate drivers: on when high. A pull-down resistor at each input keeps them off while the processor is in reset.
- Current sensors: 0 V at 0 A, 3.3 V at `adc_current_A` of the machine file. DC link: 3.3 V at `adc_voltage_V`.
- Temperature sensors: linear, 0 V at -100 degrees Celsius, 3.3 V at 300 degrees Celsius, pulled up when open.
- `BREAK_1` and `BREAK_2`: both on the output of one AND gate of `STO_1`, `STO_2` and `DRIVER_FAULT`. An open wire is
  low, and opens the switches.
- The STO lines also cut the supply of the gate drivers: the safety function does not rest on the processor.
- PC13 to PC15, PF0, PF1, PA13 and PA14 are the button, the crystals and the debugger of the board.
- The pins of the headers are from ST's user manual UM2505: compare them with the revision of your board.
"""
_KEYS = {"signal", "pin", "functions", "mode", "pull", "connector", "group", "text"}


@dataclass(frozen=True)
class Pin:
    """A row of the table. functions: as "TIM1_CH1:2" and "ADC1_IN1"."""

    signal: str
    pin: str
    functions: tuple[str, ...]
    mode: str
    pull: str
    connector: str
    group: str
    text: str

    @property
    def alternate(self) -> int:
        """Number of the alternate function, 0 without one."""
        return next((int(name.partition(":")[2]) for name in self.functions if ":" in name), 0)

    @property
    def channel(self) -> int | None:
        """Channel of the converter, None without one."""
        return next((int(found[1]) for name in self.functions if (found := re.match(r"ADC\d_IN(\d+)$", name))), None)


def read_pins(path: Path = PINS) -> list[Pin]:
    """The rows. UsageError: an unknown key or value, or a pin, signal or connector that is used twice."""
    try:
        rows = tomllib.loads(path.read_text(encoding="utf-8")).get("pin", [])
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"{path}: not TOML: {error}") from None
    pins: list[Pin] = []
    for row in rows:
        name = row.get("signal", "a row without signal")
        if wrong := _KEYS ^ set(row):
            raise UsageError(f"{path}: {name}: unknown or missing key {', '.join(sorted(wrong))}")
        for key, allowed in (("mode", MODES), ("pull", PULLS)):
            if row[key] not in allowed:
                raise UsageError(f"{path}: {name}: {key} '{row[key]}': must be one of {', '.join(allowed)}")
        if re.fullmatch(r"P[A-G](1[0-5]|[0-9])", row["pin"]) is None:
            raise UsageError(f"{path}: {name}: pin '{row['pin']}': must be PA0 to PG15")
        pin = Pin(**row | {"functions": tuple(row["functions"])})
        numbered = any(":" in function for function in pin.functions)
        if (pin.mode == "alternate") != numbered or (pin.mode == "analogue") != (pin.channel is not None):
            raise UsageError(f"{path}: {name}: mode {pin.mode} does not fit the functions {list(pin.functions)}")
        pins.append(pin)
    for key in ("signal", "pin", "connector"):
        values = [getattr(pin, key) for pin in pins]
        for value in values:
            if values.count(value) > 1:
                raise UsageError(f"{path}: {key} {value} is used twice")
    return pins


def header(pins: list[Pin]) -> str:
    """Text of pins.h."""
    lines = ["/* Generated from hal/stm32g4/pins.toml. */", "#ifndef STM32G4_PINS_H", "#define STM32G4_PINS_H", "",
             "/* Number in its port. */"]
    lines += [f"#define BOARD_PIN_{pin.signal} {int(pin.pin[2:])}" for pin in pins if pin.mode == "input"]
    lines += ["", "/* Channel of its converter. */"]
    lines += [f"#define BOARD_CHANNEL_{pin.signal} {pin.channel}" for pin in pins if pin.channel is not None]
    lines += ["", "/* PIN(address of the port, number, mode, alternate function, pull) of each pin. */",
              "#define BOARD_PINS(PIN) \\"]
    rows = [f"    PIN(GPIO{pin.pin[1]}_BASE, {pin.pin[2:]}, {MODES[pin.mode]}, {pin.alternate}, {PULLS[pin.pull]})"
            for pin in pins]
    return "\n".join([*lines, " \\\n".join(rows), "", "#endif", ""])


def page(pins: list[Pin]) -> str:
    """Text of the document."""
    lines = [_HEAD]
    for pin in pins:
        function = ", ".join(name.partition(":")[0] for name in pin.functions) or "input"
        lines.append(f"| `{pin.signal}` | {pin.pin} | {pin.connector} | {function} | {pin.pull} | {pin.text} |")
    return "\n".join([*lines, _RULES])


_WIDTH, _ROW, _TOP, _COLUMN = 1180, 24, 78, 392


def picture(pins: list[Pin]) -> str:
    """The SVG: the pins by group, in three columns."""
    groups: dict[str, list[Pin]] = {}
    for pin in pins:
        groups.setdefault(pin.group, []).append(pin)
    columns: list[list[str]] = [[], [], []]
    for name in groups:
        min(columns, key=lambda column: sum(len(groups[other]) + 2 for other in column)).append(name)
    height = _TOP + max(sum(len(groups[name]) + 2 for name in column) for column in columns) * _ROW
    out = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" font-family="sans-serif" '
           'font-size="13">', f'<rect width="{_WIDTH}" height="{height}" fill="#ffffff"/>',
           f'<text x="{_WIDTH // 2}" y="38" text-anchor="middle" font-size="20" fill="#1a1a1a">NUCLEO-G474RE: pins of '
           'the asymmetric half-bridge stage</text>']
    for number, column in enumerate(columns):
        left, top = 16 + number * _COLUMN, _TOP
        for name in column:
            out.append(f'<text x="{left}" y="{top}" font-weight="bold" fill="#1a1a1a">{escape(name)}</text>')
            for i, pin in enumerate(groups[name], 1):
                y = top + i * _ROW
                function = pin.functions[0].partition(":")[0] if pin.functions else "input"
                out += [f'<rect x="{left}" y="{y - 16}" width="{_COLUMN - 30}" height="{_ROW - 4}" rx="3" '
                        'fill="#eef2f7" stroke="#8a99ad"/>',
                        f'<text x="{left + 8}" y="{y - 1}" fill="#1a1a1a">{escape(pin.signal)}</text>',
                        f'<text x="{left + 140}" y="{y - 1}" fill="#0b4f8a" font-weight="bold">{pin.pin}</text>',
                        f'<text x="{left + 184}" y="{y - 1}" fill="#1a1a1a">{pin.connector}</text>',
                        f'<text x="{left + 252}" y="{y - 1}" fill="#555555">{escape(function)}</text>']
            top += (len(groups[name]) + 2) * _ROW
    return "\n".join([*out, "</svg>", ""])


def write_documents() -> list[Path]:
    """Writes page and picture; returns their paths."""
    pins = read_pins()
    PAGE.write_text(page(pins), encoding="utf-8")
    PICTURE.write_text(picture(pins), encoding="utf-8")
    return [PAGE, PICTURE]


def main(arguments: list[str]) -> int:
    """Writes the header; exit code 2 after one line."""
    if len(arguments) != 1:
        print("usage: python -m salient.board.pins OUTDIR", file=sys.stderr)
        return 2
    return write_files("salient", Path(arguments[0]) / "stm32g4", lambda: {"pins.h": header(read_pins())}, UsageError)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
