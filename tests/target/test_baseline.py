"""The committed figures of the target are those of the builds, and the firmware keeps to its limits. When a change is
meant, tools/salient pil --figures writes them anew."""

from __future__ import annotations

import functools
import operator
from functools import lru_cache

import pytest

from salient.bench.config import CONTROLLERS, TARGET_BUILDS
from salient.errors import UsageError
from salient.target import worst_case
from salient.target.baseline import (
    FLASH_MAX_BYTES,
    RAM_MAX_BYTES,
    README,
    read,
    size_table,
    sizes,
    tables_of,
    with_table,
)
from salient.target.isr_profile import Cost, measure
from salient.target.trace import Execution

LIMITED_BUILDS = ("cortex-m4", "cortex-m4-Os")
"""That anybody would flash."""
FLASH_TOLERANCE_BYTES = 64
RAM_TOLERANCE_BYTES = 32
COUNT_TOLERANCE = 0.01

measure_once = lru_cache(measure)


@lru_cache
def dearest(kind: str) -> Cost:
    return worst_case.replay(worst_case.read_input(worst_case.committed(kind)))


@pytest.mark.parametrize("build", TARGET_BUILDS)
def test_sizes_are_those_committed(request, build):
    made, committed = sizes(build), read()["size"][build]
    request.node.user_properties.append(("size", (build, made)))
    assert made.keys() == committed.keys()
    for name, value in made.items():
        tolerance = FLASH_TOLERANCE_BYTES if name in ("firmware", "flash") else RAM_TOLERANCE_BYTES
        table = size_table({"made": made, "committed": committed})
        assert abs(value - committed[name]) <= tolerance, f"{name}\n{table}"


@pytest.mark.parametrize("build", LIMITED_BUILDS)
def test_flash_and_ram_are_within_their_limits(build):
    made = sizes(build)
    assert 20_000 < made["firmware"] <= FLASH_MAX_BYTES
    ram = made["ram"] + made["stack_background"] + made["stack_interrupt"]
    assert 3_000 < ram <= RAM_MAX_BYTES


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_an_interrupt_of_the_two_experiments_costs_what_is_committed(controller):
    made, committed = measure_once(controller).figures(), read()["interrupt"][controller]
    assert made["typical"] <= made["of_99_percent"] <= made["worst"] <= committed["searched"]
    for name, value in made.items():
        assert value == pytest.approx(committed[name], rel=COUNT_TOLERANCE), name


@pytest.mark.parametrize("kind", worst_case.KINDS)
def test_the_dearest_interrupt_known_costs_what_is_committed(kind):
    made = dearest(kind).figures()["worst"]
    assert made == pytest.approx(read()["interrupt"][kind]["searched"], rel=COUNT_TOLERANCE)


@pytest.mark.parametrize("kind", worst_case.KINDS)
def test_no_directed_input_is_dearer_than_the_dearest_known(kind):
    worst = [worst_case.dearest_count(given) for given in worst_case.directed(kind)]
    assert len(worst) >= 12
    assert max(worst) <= (1 + COUNT_TOLERANCE) * read()["interrupt"][kind]["searched"]
    assert max(worst) > 0.7 * read()["interrupt"][kind]["searched"]


def test_an_input_that_was_found_is_the_same_when_written_and_read_again(tmp_path):
    for given in worst_case.directed(worst_case.NETWORK):
        worst_case.write_input(tmp_path / "input.toml", given)
        assert worst_case.read_input(tmp_path / "input.toml") == given


def test_a_search_finds_dearer_interrupts_than_it_begins_with():
    cheap = worst_case.Input("saturating", "traditional", 1, 0.0, 2.0, (worst_case.Action(0.0, "off"),))
    begin = worst_case.replay(cheap).figures()["worst"]
    count, found = worst_case.search("traditional", [cheap], seconds=1.0, seed=1)
    assert count > 1.2 * begin
    assert worst_case.replay(found).figures()["worst"] == count


def all_runs() -> Execution:
    """Of one image."""
    kinds = [kind for kind, of in worst_case.KINDS.items() if of.machine == "saturating"]
    costs = [*map(measure_once, CONTROLLERS), *map(dearest, kinds)]
    return functools.reduce(operator.add, (cost.execution for cost in costs))


def test_no_run_takes_more_stack_than_the_image_says_and_none_much_less():
    bound, stack = sizes("cortex-m4"), all_runs().stack
    assert 0.7 * bound["stack_background"] < stack.thread <= bound["stack_background"]
    assert 0.7 * bound["stack_interrupt"] < stack.interrupt <= bound["stack_interrupt"]
    assert bound["stack_background"] + bound["stack_interrupt"] <= stack.reserved


def test_these_runs_execute_nearly_every_instruction_of_the_laws():
    files = all_runs().coverage().files
    laws = [of for file, of in files.items() if file.startswith(("firmware/control/", "firmware/fixed/"))]
    assert 0.94 < sum(of.executed for of in laws) / sum(of.instructions for of in laws) <= 1
    background = [of for file, of in files.items() if file.startswith("firmware/comms/")]
    assert not any(of.in_interrupts for of in background)
    assert sum(of.executed for of in background) > 0


def test_the_tables_of_the_readme_are_the_committed_figures():
    text = README.read_text(encoding="utf-8")
    for table in tables_of(read()):
        assert table in text


def test_a_table_is_written_in_the_place_of_the_one_with_its_heads():
    text = "a\n| x | y |\n| --- | --- |\n| 1 | 2 |\n| 3 | 4 |\n\nb\n"
    assert with_table(text, "| x | y |\n| --- | --- |\n| 5 | 6 |") == "a\n| x | y |\n| --- | --- |\n| 5 | 6 |\n\nb\n"
    with pytest.raises(UsageError, match="no table with the heads \\| z \\|"):
        with_table(text, "| z |\n| --- |\n| 5 |")
