"""The builds match the committed baseline, and the firmware is within its limits. tools/salient pil --figures updates
the baseline after an intended change."""

from __future__ import annotations

import functools
import operator
from functools import lru_cache

import pytest

from salient.config import CONTROLLERS, TARGET_BUILDS
from salient.errors import UsageError
from salient.target import long_run
from salient.target.baseline import (
    BOUND_KEYS,
    FLASH_MAX_BYTES,
    PAGE,
    RAM_MAX_BYTES,
    long_run_metrics,
    profile_table,
    ram_needed,
    read,
    size_table,
    sizes,
    tables_of,
    with_table,
)
from salient.target.bound_report import armed_bound, bounds
from salient.target.isr_profile import IsrProfile, measure
from salient.target.trace import Trace

LIMITED_BUILDS = ("cortex-m4", "cortex-m4-Os")
"""Builds intended for a device."""
FLASH_TOLERANCE_BYTES = 64
RAM_TOLERANCE_BYTES = 32
COUNT_TOLERANCE = 0.01
BOUND_LIMITS = {"traditional": 730, "paper": 1260, "salient": 2080, "salient_four_phases": 2500}
"""Instructions of the control interrupt on the Cortex-M4."""
BOTH_BOUND_LIMITS = {"salient": 2950, "salient_four_phases": 3350}
"""Instructions of both interrupts together."""
ARMED_PERCENT = 3
"""Instructions by which an armed triggered buffer may exceed the budget of both interrupts."""

measure_once = lru_cache(measure)


@lru_cache
def recorded_run(variant: str) -> IsrProfile:
    return long_run.profile(long_run.read_input(long_run.committed(variant)))


@pytest.mark.parametrize("build", TARGET_BUILDS)
def test_sizes_match_the_baseline(request, build):
    measured, committed = sizes(build), read()["size"][build]
    request.node.user_properties.append(("size", (build, measured)))
    assert measured.keys() == committed.keys()
    for name, value in measured.items():
        tolerance = FLASH_TOLERANCE_BYTES if name in ("firmware", "flash") else RAM_TOLERANCE_BYTES
        table = size_table({"measured": measured, "committed": committed})
        assert abs(value - committed[name]) <= tolerance, f"{name}\n{table}"


@pytest.mark.parametrize("build", LIMITED_BUILDS)
def test_flash_and_ram_are_within_their_limits(build):
    measured = sizes(build)
    assert 20_000 < measured["firmware"] <= FLASH_MAX_BYTES
    assert 3_000 < ram_needed(measured) <= RAM_MAX_BYTES


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_isr_profile_of_the_experiments_matches_the_baseline(controller):
    measured, committed = measure_once(controller).metrics(), read()["interrupt"][controller]
    assert measured["median"] <= measured["p99"] <= measured["max"] <= committed["longest_run"]
    for name, value in measured.items():
        assert value == pytest.approx(committed[name], rel=COUNT_TOLERANCE), name


@pytest.mark.parametrize("variant", long_run.VARIANTS)
def test_long_run_matches_the_baseline(variant):
    for name, measured in long_run_metrics(recorded_run(variant)).items():
        assert measured == pytest.approx(read()["interrupt"][variant][name], rel=COUNT_TOLERANCE), name


@pytest.mark.parametrize("build", [pytest.param(build, marks=pytest.mark.in_turns if build == "rv32" else ())
                                   for build in BOUND_KEYS])
def test_computed_bounds_match_the_baseline_and_exceed_every_run(build):
    for section, variants in bounds(build).items():
        assert set(variants) == set(long_run.VARIANTS)
        for variant, instructions in variants.items():
            committed = read()[section][variant]
            assert instructions == pytest.approx(committed[BOUND_KEYS[build]], rel=COUNT_TOLERANCE), variant
            if section == "interrupt" and build == "cortex-m4":
                assert committed["longest_run"] <= instructions, variant


def test_computed_bounds_on_the_cortex_m4_are_within_their_limits():
    found = bounds("cortex-m4")
    for variant, limit in BOUND_LIMITS.items():
        assert 0.5 * limit < found["interrupt"][variant] <= limit, variant
    for variant, limit in BOTH_BOUND_LIMITS.items():
        assert 0.5 * limit < found["interrupt"][variant] + found["deferred"][variant] <= limit, variant


@pytest.mark.parametrize("variant", long_run.VARIANTS)
def test_armed_buffer_takes_at_most_3_percent_of_the_budget(variant):
    more = armed_bound(variant, "cortex-m4") - bounds("cortex-m4")["interrupt"][variant]
    assert 40 < more <= ARMED_PERCENT * 2950 // 100


@pytest.mark.parametrize("variant", long_run.VARIANTS)
def test_computed_bound_of_both_interrupts_exceeds_every_run(variant):
    control, deferred = read()["interrupt"][variant], read()["deferred"][variant]
    assert control["longest_run"] < control["both"] <= control["computed_bound"] + deferred["computed_bound"]


def test_table_shows_the_sum_of_both_bounds():
    interrupt = {"salient": {"longest_run": 1200, "both": 1500, "computed_bound": 1300}}
    table = profile_table(interrupt, {"salient": {"computed_bound": 654}})
    assert table.splitlines()[-1] == "| salient | – | – | – | 1200 | 1300 | 1500 | 1954 |"


def all_runs() -> Trace:
    """Trace of all runs of the same ELF image."""
    variants = [variant for variant, of in long_run.VARIANTS.items() if of.machine == "saturating"]
    profiles = [*map(measure_once, CONTROLLERS), *map(recorded_run, variants)]
    return functools.reduce(operator.add, (profile.trace for profile in profiles))


def test_stack_depth_is_just_below_the_static_bound():
    bound, stack = sizes("cortex-m4"), all_runs().stack
    assert 0.7 * bound["stack_background"] < stack.thread <= bound["stack_background"]
    assert 0.7 * bound["stack_interrupt"] < stack.interrupt <= bound["stack_interrupt"]
    assert bound["stack_background"] + bound["stack_deferred"] + bound["stack_interrupt"] <= stack.reserved


def test_runs_execute_nearly_every_instruction_of_the_control_laws():
    files = all_runs().coverage().files
    laws = [of for file, of in files.items() if file.startswith(("firmware/control/", "firmware/fixed/"))
            and not file.startswith(("firmware/control/position/", "firmware/control/identify."))]
    # Torque mode, single and partial pulses, slow counts, a periodic load that is learned and forgotten, and sets of
    # parameters with other angles of commutation, do not occur in these runs, nor does what position mode has inlined
    # of firmware/fixed, nor its finer inertia in control/inertia.c.
    assert 0.7 < sum(of.executed for of in laws) / sum(of.instructions for of in laws) <= 1
    background = [of for file, of in files.items() if file.startswith("firmware/comms/")]
    assert not any(of.in_interrupts for of in background)
    assert sum(of.executed for of in background) > 0


def test_tables_of_the_page_match_the_baseline():
    text = PAGE.read_text(encoding="utf-8")
    for table in tables_of(read()):
        assert table in text


def test_table_replaces_the_one_with_equal_column_titles():
    text = "a\n| x | y |\n| --- | --- |\n| 1 | 2 |\n| 3 | 4 |\n\nb\n"
    assert with_table(text, "| x | y |\n| --- | --- |\n| 5 | 6 |") == "a\n| x | y |\n| --- | --- |\n| 5 | 6 |\n\nb\n"
    with pytest.raises(UsageError, match="no table with the column titles \\| z \\|"):
        with_table(text, "| z |\n| --- |\n| 5 |")
