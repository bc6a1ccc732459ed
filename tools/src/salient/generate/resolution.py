"""Writes the table of resolutions and ranges in firmware/README.md: the firmware's formats, the bus and the sensors, in
the units of the smallest, the paper's and the largest machine.

    python -m salient.generate.resolution
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path

from salient.machine.file import load_machine
from salient.machine.scaling import FLUX_LINKAGE_RANGE_WB, LOAD_TORQUE_RANGE_NM, SPEED_LSB_RPM, Scaling, scaling_of
from salient.paths import MACHINES, ROOT

PAGE = ROOT / "firmware" / "README.md"
FILES = (ROOT / "tests" / "machines" / "smallest.toml", MACHINES / "saturating.toml",
         ROOT / "tests" / "machines" / "largest.toml")
_BEGIN, _END = "<!-- resolutions: python -m salient.generate.resolution -->\n", "<!-- end of resolutions -->\n"
_ADC_COUNTS = 4096
"""Of the default converter, 12 bits."""


@dataclass(frozen=True)
class Quantity:
    """A quantity as the drive represents it: LSB and largest magnitude, in the SI unit (speeds on the bus: r/min)."""

    name: str
    format: str
    unit: str
    lsb: float
    maximum: float


def quantities(scaling: Scaling) -> list[Quantity]:
    """All quantities of a drive that have a unit."""
    def scaled(name: str, text: str, unit: str, lsb: float, maximum: float) -> Quantity:
        exponent = scaling.exponents.of_unit({"rad/s": "r/min"}.get(unit, unit))
        return Quantity(name, text, unit, math.ldexp(lsb, exponent), math.ldexp(maximum, exponent))

    data = scaling.data
    return [
        scaled("current", "Q7.9", "A", 2.0**-9, 80.0),
        scaled("voltage", "Q9.6", "V", 2.0**-6, 512.0),
        scaled("flux linkage", "Q2.29", "Wb", 2.0**-29, FLUX_LINKAGE_RANGE_WB),
        scaled("torque", "Q7.24", "N m", 2.0**-24, 128.0),
        scaled("speed", "Q9.22", "rad/s", 2.0**-22, 512.0),
        scaled("inertia", "Q1.30", "kg m^2", 2.0**-30, 1.9),
        scaled("friction", "Q1.30", "N m s", 2.0**-30, 1.9),
        scaled("resistance", "Q7.24", "ohm", 2.0**-24, 20.0),
        scaled("current on the bus", "16 bits", "A", 2.0**-9, 128.0),
        scaled("voltage on the bus", "16 bits", "V", 2.0**-6, 1024.0),
        scaled("torque on the bus", "16 bits", "N m", 2.0**-8, 128.0),
        scaled("speed on the bus", "24 bits", "r/min", float(SPEED_LSB_RPM), 8388.608),
        Quantity("current sensor", "ADC, 12 bits", "A", data.adc_current_A / _ADC_COUNTS, data.adc_current_A),
        Quantity("DC-link divider", "ADC, 12 bits", "V", data.adc_voltage_V / _ADC_COUNTS, data.adc_voltage_V),
        scaled("torque transducer", "ADC, 12 bits", "N m", 2.0 * LOAD_TORQUE_RANGE_NM / _ADC_COUNTS,
               LOAD_TORQUE_RANGE_NM),
    ]


def scaling_of_file(path: Path) -> Scaling:
    """The units of a machine file's machine."""
    return scaling_of(path, load_machine(path))


def table() -> str:
    """The table, in Markdown."""
    scalings = [scaling_of_file(path) for path in FILES]
    titles = [f"{path.stem}: {scaling.data.torque_peak_Nm:g} N m, {scaling.data.supply_max_V:g} V,"
              f" {scaling.data.current_peak_A:g} A" for path, scaling in zip(FILES, scalings, strict=True)]
    units = ["exponents a, v, t, w", "", *(
        ", ".join(map(str, (s.exponents.current, s.exponents.voltage, s.exponents.torque, s.exponents.speed)))
        for s in scalings)]
    lines = [_row(["quantity", "format", *titles]), _row(["---"] * (2 + len(titles))), _row(units)]
    lines += [_row([of[0].name, of[0].format, *(f"{q.lsb:.2g} to {q.maximum:.4g} {q.unit}" for q in of)])
              for of in zip(*map(quantities, scalings), strict=True)]
    return "".join(lines)


def _row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |\n"


def page() -> str:
    """The README with the table of today."""
    head, _, rest = PAGE.read_text(encoding="utf-8").partition(_BEGIN)
    return head + _BEGIN + "\n" + table() + "\n" + _END + rest.partition(_END)[2]


def main() -> int:
    """Writes the page; returns the exit code."""
    PAGE.write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
