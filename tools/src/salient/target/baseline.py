"""The committed figures of the target: what the firmware takes of flash, RAM and stack in each build, and what a
control interrupt costs. `salient pil --figures` measures them again and writes them here and in the README;
tests/target holds the builds against them."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from salient.bench.config import CONTROLLERS, TARGET_BUILDS
from salient.bench.emulator import image
from salient.elf import Image
from salient.errors import UsageError
from salient.paths import BUILD, ROOT
from salient.target import worst_case
from salient.target.control_period import CYCLES_PER_INSTRUCTION, RATES_HZ, fits
from salient.target.isr_profile import Cost, measure
from salient.target.static_checks import deepest_stack, size

FILE = ROOT / "tests" / "target" / "baseline.toml"
MACHINE = "saturating"
README = ROOT / "README.md"
FLASH_MAX_BYTES = 32 * 1024
"""Of the firmware with one machine's tables; cmake/check_size.cmake holds the builds to it."""
RAM_MAX_BYTES = 8 * 1024
"""Variables and stack."""

_PART_SHOWN = 100
"""Instructions; what takes less everywhere is added up."""

Figures = dict[str, dict[str, dict[str, int]]]


def sizes(build: str) -> dict[str, int]:
    """Bytes of a build's image and, where the build makes it, of the firmware alone (firmware.elf: linked as the
    image is, without port and C library). The stack is the most that background and interrupt can take together."""
    whole = Image(image(MACHINE, build))
    of = size(whole)
    alone = firmware_alone(build)
    background, interrupt = (deepest_stack(whole, function)[0] for function in ("program_start", "control_handler"))
    figures = {"flash": of.flash, "ram": of.ram, "stack_background": background,
               "stack_interrupt": interrupt + whole.exception_frame_bytes}
    return ({"firmware": size(Image(alone)).flash} if alone.exists() else {}) | figures


def firmware_alone(build: str) -> Path:
    """The firmware linked with one machine's tables and open ends to the HAL; not made by every build."""
    return BUILD / build / "firmware" / "firmware.elf"


def cost_figures(cost: Cost, dearest: Cost) -> dict[str, int]:
    """Of the paper's two experiments and of the dearest input known."""
    return cost.figures() | {"searched": dearest.figures()["worst"]}


def measured() -> tuple[Figures, dict[str, Cost], dict[str, Cost]]:
    """All figures, and the costs that they are from: of the two experiments by controller, of the dearest inputs by
    kind."""
    costs = {controller: measure(controller) for controller in CONTROLLERS}
    dearest = {kind: worst_case.replay(worst_case.read_input(worst_case.committed(kind))) for kind in worst_case.KINDS}
    interrupts = {controller: cost_figures(cost, dearest[controller]) for controller, cost in costs.items()}
    interrupts |= {kind: {"searched": cost.figures()["worst"]} for kind, cost in dearest.items() if kind not in costs}
    return {"size": {build: sizes(build) for build in TARGET_BUILDS}, "interrupt": interrupts}, costs, dearest


def read() -> Figures:
    """The committed ones."""
    with FILE.open("rb") as file:
        return tomllib.load(file)


def measure_and_write() -> int:
    """Builds all targets, measures, writes FILE and the README's tables and prints them; 0. UsageError when a build
    fails."""
    from salient.test_runner import build_preset

    for build in TARGET_BUILDS:
        if not build_preset(build):
            raise UsageError(f"{build}: the build failed")
    figures, costs, dearest = measured()
    lines = ["# Bytes by build, instructions of a control interrupt by controller: by tools/salient pil --figures."]
    for kind, tables in figures.items():
        for name, values in tables.items():
            lines += ["", f"[{kind}.{name}]", *(f"{key} = {value}" for key, value in values.items())]
    FILE.write_text("\n".join(lines) + "\n", encoding="utf-8")
    tables = [*tables_of(figures), part_table(costs, dearest)]
    text = README.read_text(encoding="utf-8")
    for table in tables:
        text = with_table(text, table)
    README.write_text(text, encoding="utf-8")
    print("\n\n".join(tables))
    print(f"\nwritten to {FILE.relative_to(ROOT)} and {README.relative_to(ROOT)}")
    return 0


def with_table(text: str, table: str) -> str:
    """A Markdown text with the table in the place of the one that has the same heads. UsageError: it has none."""
    head = table.partition("\n")[0]
    before, found, rest = text.partition(f"{head}\n")
    if not found:
        raise UsageError(f"{README.name}: no table with the heads {head}")
    lines = rest.splitlines(keepends=True)
    length = next((i for i, line in enumerate(lines) if not line.startswith("|")), len(lines))
    return before + table + "\n" + "".join(lines[length:])


def tables_of(figures: Figures) -> list[str]:
    """Those that the committed figures make."""
    return [size_table(figures["size"]), cost_table(figures["interrupt"]), rate_table(figures["interrupt"])]


def size_table(of: Mapping[str, Mapping[str, int]]) -> str:
    """Bytes by build."""
    rows = [(build, values.get("firmware", "–"), values["flash"], values["ram"], values["stack_background"],
             values["stack_interrupt"], values["ram"] + values["stack_background"] + values["stack_interrupt"])
            for build, values in of.items()]
    return _table(("bytes", "firmware with a machine's tables", "image", "variables", "stack: background",
                   "interrupt", "RAM in all"), rows)


def cost_table(of: Mapping[str, Mapping[str, int]]) -> str:
    """Instructions of an interrupt by controller."""
    names = ("typical", "of_99_percent", "worst", "searched")
    return _table(("instructions", "typical", "99 in 100 up to", "worst", "dearest known"),
                  [(worst_case.KINDS[kind].label, *(values.get(name, "–") for name in names))
                   for kind, values in of.items()])


def part_table(costs: Mapping[str, Cost], dearest: Mapping[str, Cost]) -> str:
    """Instructions by part, in the mean of the experiments and in the dearest interrupt known."""
    columns: list[Mapping[str, float]] = []
    for controller, cost in costs.items():
        columns += [cost.mean_by_part(), dearest[controller].execution.worst_by_part()]
    largest = {name: max(column.get(name, 0) for column in columns) for name in set().union(*columns)}
    shown = sorted((name for name, most in largest.items() if most >= _PART_SHOWN), key=lambda name: -largest[name])
    rows = [(name, *(round(column.get(name, 0)) for column in columns)) for name in shown]
    rows.append(("all else", *(round(sum(count for name, count in column.items() if name not in shown))
                               for column in columns)))
    return _table(("instructions by part", *(f"{controller}, {what}" for controller in costs
                                             for what in ("mean", "dearest"))), rows)


def rate_table(of: Mapping[str, Mapping[str, int]]) -> str:
    """Which control rate the dearest interrupt known fits in."""
    low, high = CYCLES_PER_INSTRUCTION
    rows = []
    for kind, values in of.items():
        verdicts = fits(values["searched"])
        rows.append((worst_case.KINDS[kind].label, f"{low * values['searched']:.0f} to {high * values['searched']:.0f}",
                     *(verdicts[rate] for rate in RATES_HZ)))
    return _table(("at 170 MHz", "cycles of the dearest", *(f"{rate // 1000} kHz" for rate in RATES_HZ)), rows)


def _table(heads: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    lines = [heads, ("---",) * len(heads), *rows]
    return "\n".join(f"| {' | '.join(map(str, row))} |" for row in lines)
