"""Computed bounds of all variants and both interrupts, and their report for a terminal."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from salient.bench.programs import image
from salient.config import either
from salient.elf import ElfImage
from salient.errors import UsageError
from salient.target.bound import CONTROL, Bound, Model
from salient.target.bound_facts import read_facts
from salient.target.long_run import VARIANTS
from salient.target.trace import Stack, Trace

HANDLERS = {"interrupt": CONTROL, "deferred": "deferred_handler"}
"""Symbols of the handlers by section of the baseline; images without a deferred interrupt have only the first."""
RECORDER = "sampler_record"
"""Function of the triggered buffer, which by the facts never runs."""
_ALL = "all"
_FUNCTIONS_SHOWN = 30


@lru_cache
def bound(variant: str, build: str, section: str = "interrupt") -> Bound | None:
    """Bound of an interrupt in the present build; None when the image does not have the interrupt."""
    of = VARIANTS[variant]
    elf = _image_of(image(of.machine, build))
    handler = HANDLERS[section]
    if handler not in elf.symbols() and handler != CONTROL:
        return None
    return Model(elf, _facts(), of.controller, handler).solve()


@lru_cache
def armed_bound(variant: str, build: str) -> int:
    """Instructions of the control interrupt of a drive whose triggered buffer is armed, with any number of channels and
    any trigger."""
    of = VARIANTS[variant]
    facts = _facts()
    never = [fact for fact in facts.never if RECORDER not in fact.functions]
    if len(never) == len(facts.never):
        raise UsageError(f"{RECORDER}: no fact says that it never runs")
    return Model(_image_of(image(of.machine, build)), facts.model_copy(update={"never": never}),
                 of.controller).solve().instructions


_image_of = lru_cache(ElfImage)
_facts = lru_cache(read_facts)


def bounds(build: str) -> dict[str, dict[str, int]]:
    """Instructions by section of the baseline and by variant."""
    found = {section: {variant: bound(variant, build, section) for variant in VARIANTS} for section in HANDLERS}
    return {section: {variant: of.instructions for variant, of in variants.items() if of}
            for section, variants in found.items() if any(variants.values())}


def run(variant: str, build: str, longest_runs: Mapping[str, int]) -> int:
    """Prints the bounds of all variants, or one of them in detail. longest_runs: of the control interrupt, by variant.
    Returns 0; UsageError for an unknown variant."""
    if variant not in (*VARIANTS, _ALL):
        raise UsageError(f"--bound {variant}: must be {either(tuple(VARIANTS))}")
    for name in VARIANTS if variant == _ALL else (variant,):
        for section, handler in HANDLERS.items():
            found = bound(name, build, section)
            if found:
                longest = longest_runs.get(name) if section == "interrupt" else None
                print(_line(f"{VARIANTS[name].label}, {handler}", found.instructions, longest), flush=True)
                if section == "interrupt":
                    more = armed_bound(name, build) - found.instructions
                    print(f"{VARIANTS[name].label}, {handler}, triggered buffer armed: {more} more", flush=True)
                if variant != _ALL:
                    print(details(found))
    return 0


def _line(label: str, instructions: int, longest: int | None) -> str:
    line = f"{label}: at most {instructions} instructions"
    if longest is None:
        return line
    return f"{line}, {100 * (instructions / longest - 1):.0f} % above the longest run of {longest}"


def details(found: Bound) -> str:
    """The longest path by module and by function."""
    modules = ", ".join(f"{name} {count}" for name, count in by_module(found).items())
    lines = [f"  by module: {modules}", "  instructions  executions  function"]
    functions = found.by_function()
    for function, count, times in functions[:_FUNCTIONS_SHOWN]:
        lines.append(f"  {count:12}  {times:10}  {function}")
    rest = sum(count for _, count, _ in functions[_FUNCTIONS_SHOWN:])
    return "\n".join([*lines, *([f"  {rest:12}  {'':10}  others"] if rest else [])])


def by_module(found: Bound) -> dict[str, int]:
    """The longest path by module of the firmware, as Trace.longest_by_module."""
    path: Path = found.model.image.path
    counts = np.array([found.executed[one.address] for one in found.model.image.instructions()])
    modules = Trace(path, counts, counts, counts, Stack(0, 0, 0)).longest_by_module()
    return {name: count for name, count in modules.most_common() if count}
