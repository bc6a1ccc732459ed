"""The port of the board on the register-level model of its part, with a program in the place of the drive that checks
every function of the HAL (stm32g4/port): every compare value at many instants of the period, breaks with the processor
halted, samples, priorities, bus, memory and watchdog. And some of the mistakes of tests/board_mistakes.toml, planted
into port and model: `python -m salient.experiments.board_mistakes` plants all."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

from salient.board import port_program
from salient.experiments import board_mistakes
from salient.turns import turn_of_commit

MISTAKES = board_mistakes.mistakes()
FOUND = [bug for bug in MISTAKES if not board_mistakes.left_to_checklist(bug)]
OF_A_COMMIT = 8


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("port")


@pytest.mark.parametrize("clock_mhz", [170, 100])
def test_port_keeps_the_contract_of_the_hal(folder: Path, clock_mhz: int) -> None:
    image = port_program.build(folder / str(clock_mhz), clock_mhz)
    assert port_program.verdict(image, clock_mhz) == ""


@pytest.mark.parametrize("number", range(OF_A_COMMIT))
def test_planted_mistake_is_found(number: int) -> None:
    chosen = FOUND[number::OF_A_COMMIT]
    bug = chosen[turn_of_commit(len(chosen))]
    assert board_mistakes.look(bug) != "", bug.name


def test_an_edge_a_tick_from_its_place_is_found() -> None:
    period = 1250
    lines = []
    for switch, pin in enumerate(port_program.gates()):
        ticks = [5000 + tick for tick in port_program.expected_edges(switch, period)]
        lines.append([f"0 {pin} 0", *(f"{tick} {pin} {(k + 1) % 2}" for k, tick in enumerate(ticks))])
    trace = "\n".join(line for each in lines for line in each)
    assert port_program.wrong_edges(trace, 100) == ""
    first, *rest = lines[6][10].split()
    lines[6][10] = " ".join([str(int(first) + 1), *rest])
    trace = "\n".join(line for each in lines for line in each)
    assert "an edge 1 ticks from its place" in port_program.wrong_edges(trace, 100)


@cache
def checklist() -> str:
    return board_mistakes.CHECKLIST.read_text(encoding="utf-8")


def test_the_table_fits_the_sources_and_names_no_two_mistakes_alike() -> None:
    assert len({(bug.file, "".join(bug.text().split())) for bug in MISTAKES}) == len(MISTAKES)
    assert sum(board_mistakes.of_port(bug) for bug in FOUND) >= 60
    assert sum(not board_mistakes.of_port(bug) for bug in FOUND) >= 20


@pytest.mark.parametrize("bug", [bug for bug in MISTAKES if bug not in FOUND], ids=lambda bug: bug.name)
def test_a_mistake_that_nothing_here_finds_is_in_the_checklist(bug) -> None:
    step = bug.found_by[0].removeprefix("step ")
    assert re.search(rf"^\| {step} \|", checklist(), re.MULTILINE)
    row = re.search(rf"^\| {re.escape(bug.name)} \| (.+?) \|$", checklist(), re.MULTILINE)
    assert row is not None and step in re.findall(r"\d+", row[1]), bug.name
