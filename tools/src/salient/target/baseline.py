"""Baseline of the targets: flash, RAM and stack of each build, and instructions of the control interrupt.
`salient pil --figures` measures it and writes FILE and the tables of PAGE; tests/target compares the builds with
it."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from salient.bench.programs import image
from salient.config import CONTROLLERS, TARGET_BUILDS
from salient.drive_layout import Layout, layout_file
from salient.elf import ElfImage
from salient.errors import UsageError
from salient.paths import BUILD, REFERENCE, ROOT
from salient.target import long_run
from salient.target.bound_report import bounds
from salient.target.control_period import CYCLES_PER_INSTRUCTION, RATES_HZ, fits
from salient.target.isr_profile import IsrProfile, measure
from salient.target.static_checks import deepest_stack, size

FILE = ROOT / "tests" / "target" / "baseline.toml"
MACHINE = "saturating"
PAGE = REFERENCE / "cost.md"
FLASH_MAX_BYTES = 112 * 1024
"""Limit of the firmware with the tables of one machine; cmake/check_size.cmake enforces it."""
RAM_MAX_BYTES = 20 * 1024
"""Limit of variables and stack, with the 2 KiB of the fault trace and without the triggered buffer."""

BOUND_KEYS = {"cortex-m4": "computed_bound", "rv32": "computed_bound_rv32"}
"""Keys of the computed bounds in the tables of the interrupts, by build."""

_MODULE_SHOWN = 100
"""Instructions; modules with fewer in every column are summed up."""

Baseline = dict[str, dict[str, dict[str, int]]]


def sizes(build: str) -> dict[str, int]:
    """Sizes in bytes of a build's ELF image and, where it exists, of the firmware alone (firmware.elf: linked like the
    image, without port and C library). ram: variables without the triggered buffer, whose size is a parameter of the
    build (interrupts/sampler.h). The stack sizes are upper bounds of the background and of each interrupt."""
    whole = ElfImage(image(MACHINE, build))
    image_size = size(whole)
    alone = firmware_alone(build)
    background, interrupt, deferred = (deepest_stack(whole, function)[0]
                                       for function in ("program_start", "control_handler", "deferred_handler"))
    buffer = len(Layout(layout_file(build)).bits("sampler.ring")) // 8
    result = {"flash": image_size.flash, "ram": image_size.ram - buffer, "stack_background": background,
              "stack_deferred": deferred + whole.exception_frame_bytes,
              "stack_interrupt": interrupt + whole.exception_frame_bytes}
    return ({"firmware": size(ElfImage(alone)).flash} if alone.exists() else {}) | result


def ram_needed(of: Mapping[str, int]) -> int:
    """Variables, and the stack when the control interrupt pre-empts the deferred one at its deepest point, and that one
    the background at its deepest."""
    return of["ram"] + of["stack_background"] + of["stack_deferred"] + of["stack_interrupt"]


def firmware_alone(build: str) -> Path:
    """The firmware linked with the tables of one machine and unresolved HAL symbols; some builds do not have it."""
    return BUILD / build / "firmware" / "firmware.elf"


def measure_all() -> tuple[Baseline, dict[str, IsrProfile], dict[str, IsrProfile]]:
    """The baseline, and the profiles that it is from: the two experiments by controller, the long runs by
    variant."""
    profiles = {controller: measure(controller) for controller in CONTROLLERS}
    longest = {variant: long_run.profile(long_run.read_input(long_run.committed(variant)))
               for variant in long_run.VARIANTS}
    interrupts = {controller: profile.metrics() for controller, profile in profiles.items()}
    for variant, profile in longest.items():
        interrupts.setdefault(variant, {}).update(long_run_metrics(profile))
    measured = {"size": {build: sizes(build) for build in TARGET_BUILDS}, "interrupt": interrupts}
    return with_bounds(measured), profiles, longest


def long_run_metrics(profile: IsrProfile) -> dict[str, int]:
    """Instructions of the longest control interrupt, and of the longest period with its deferred interrupt."""
    return {"longest_run": profile.metrics()["max"], "both": profile.sum_metrics()["max"]}


def with_bounds(baseline: Baseline) -> Baseline:
    """A baseline with the computed bounds of the present builds."""
    result = {section: {name: dict(values) for name, values in of.items()} for section, of in baseline.items()}
    for build, key in BOUND_KEYS.items():
        for section, variants in bounds(build).items():
            for variant, instructions in variants.items():
                result.setdefault(section, {}).setdefault(variant, {})[key] = instructions
    return result


def read() -> Baseline:
    """The committed baseline."""
    with FILE.open("rb") as file:
        baseline: Baseline = tomllib.load(file)
        return baseline


def measure_and_write() -> int:
    """Builds and measures all targets, writes FILE and the tables of PAGE, prints the tables; returns 0. UsageError
    when a build fails."""
    from salient.test_runner import build_preset

    for build in TARGET_BUILDS:
        if not build_preset(build):
            raise UsageError(f"{build}: the build failed")
    baseline, profiles, worst = measure_all()
    write(baseline)
    tables = [*tables_of(baseline), module_table(profiles, worst)]
    text = PAGE.read_text(encoding="utf-8")
    for table in tables:
        text = with_table(text, table)
    PAGE.write_text(text, encoding="utf-8")
    print("\n\n".join(tables))
    print(f"\nwritten to {FILE.relative_to(ROOT)} and {PAGE.relative_to(ROOT)}")
    return 0


def write(baseline: Baseline) -> None:
    """Writes FILE."""
    lines = ["# Bytes by build, instructions of the interrupts by variant; by tools/salient pil --figures."]
    for section, tables_by_name in baseline.items():
        for name, values in tables_by_name.items():
            lines += ["", f"[{section}.{name}]", *(f"{key} = {value}" for key, value in values.items())]
    FILE.write_text("\n".join(lines) + "\n", encoding="utf-8")


def with_table(text: str, table: str) -> str:
    """A Markdown text in which the table replaces the one with equal column titles; UsageError without one."""
    head = table.partition("\n")[0]
    before, found, rest = text.partition(f"{head}\n")
    if not found:
        raise UsageError(f"{PAGE.name}: no table with the column titles {head}")
    lines = rest.splitlines(keepends=True)
    length = next((i for i, line in enumerate(lines) if not line.startswith("|")), len(lines))
    return before + table + "\n" + "".join(lines[length:])


def tables_of(baseline: Baseline) -> list[str]:
    """The tables of PAGE that follow from the baseline."""
    return [size_table(baseline["size"]), profile_table(baseline["interrupt"], baseline["deferred"]),
            rate_table(baseline["interrupt"])]


def size_table(of: Mapping[str, Mapping[str, int]]) -> str:
    """Sizes in bytes by build."""
    rows = [(build, values.get("firmware", "–"), values["flash"], values["ram"], values["stack_background"],
             values["stack_deferred"], values["stack_interrupt"], ram_needed(values))
            for build, values in of.items()]
    return _table(("bytes", "firmware with a machine's tables", "image", "variables", "stack: background",
                   "deferred interrupt", "control interrupt", "total RAM"), rows)


def profile_table(of: Mapping[str, Mapping[str, int]], deferred: Mapping[str, Mapping[str, int]]) -> str:
    """Instructions of the control interrupt by variant, alone and with the deferred interrupt of the period."""
    names = ("median", "p99", "max", "longest_run", "computed_bound", "both")
    rows = []
    for variant, values in of.items():
        bound_of_both = values["computed_bound"] + deferred[variant]["computed_bound"]
        rows.append((long_run.VARIANTS[variant].label, *(values.get(name, "–") for name in names), bound_of_both))
    return _table(("instructions", "median", "p99", "max", "longest run", "computed bound",
                   "both interrupts: in the longest run", "computed bound of both"), rows)


def module_table(profiles: Mapping[str, IsrProfile], longest: Mapping[str, IsrProfile]) -> str:
    """Instructions by module: mean of the experiments, and in the longest run."""
    columns: list[Mapping[str, float]] = []
    for controller, profile in profiles.items():
        columns += [profile.mean_by_module(), longest[controller].trace.longest_by_module()]
    largest = {name: max(column.get(name, 0) for column in columns) for name in set().union(*columns)}
    shown = sorted((name for name, most in largest.items() if most >= _MODULE_SHOWN), key=lambda name: -largest[name])
    rows: list[tuple[Any, ...]] = [(name, *(round(column.get(name, 0)) for column in columns)) for name in shown]
    rows.append(("others", *(round(sum(count for name, count in column.items() if name not in shown))
                               for column in columns)))
    return _table(("instructions by module", *(f"{controller}, {column}" for controller in profiles
                                               for column in ("mean", "longest run"))), rows)


def rate_table(of: Mapping[str, Mapping[str, int]]) -> str:
    """Control rates at which the computed bound fits in the period."""
    low, high = CYCLES_PER_INSTRUCTION
    rows = []
    for variant, values in of.items():
        instructions = values["computed_bound"]
        verdicts = fits(instructions)
        rows.append((long_run.VARIANTS[variant].label, f"{low * instructions:.0f} to {high * instructions:.0f}",
                     *(verdicts[rate] for rate in RATES_HZ)))
    return _table(("at 170 MHz", "cycles of the computed bound", *(f"{rate // 1000} kHz" for rate in RATES_HZ)), rows)


def _table(heads: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    lines = [heads, ("---",) * len(heads), *rows]
    return "\n".join(f"| {' | '.join(map(str, row))} |" for row in lines)
