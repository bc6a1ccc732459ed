"""Documented commands work as written.

In docs/, every README.md and CONTRIBUTING.md, the fenced blocks marked `sh` are run, a section's in order and
in the root of the repository. A block that starts `tools/salient sim` keeps running until the end of its section, as it
would in a second terminal. Blocks marked `sh untested` are not run: a debugger, builds and measurements of minutes, the
tests themselves. Commands that select tests of this suite list them only: the suite runs them. Buses get a path in the
test's folder, so that tests can run in parallel.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from pathlib import Path

import pytest

from salient.paths import ROOT

BUS = "/tmp/salient.sock"
FOLDERS = ("firmware", "hal", "emulator", "tools", "tests")
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")),
             *sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("README.md"))]
# The suite itself, and every experiment with its report (tests/tools/test_demo.py) but on a measured motor.
NOT_TO_BE_RUN = re.compile(r"^tools/salient (test|demo)\b(?!.*--true-machine)", re.MULTILINE)

STARTS_A_DRIVE = re.compile(r"^tools/salient sim\b", re.MULTILINE)
SELECTIONS = ((re.compile(r"(\bctest [^&|\n]*)"), r"\1 -N | grep 'Total Tests: [1-9]'"),
              (re.compile(r"(\bbuild/venv/bin/pytest [^&|\n]*)"), r"\1 --collect-only"))


def listed(block: str) -> str:
    """A block whose selections of this suite are listed instead of run; an empty selection fails."""
    for selection, replacement in SELECTIONS:
        block = selection.sub(replacement, block)
    return block


def sections(path: Path) -> list[tuple[str, list[str]]]:
    """(title, blocks marked `sh`) of each section that has any. One that uses the bus of a drive which an earlier
    section of the page has started begins with that start."""
    found: list[tuple[str, list[str]]] = [(path.name, [])]
    fence: str | None = None
    for line in path.read_text(encoding="utf-8").splitlines(keepends=True):
        if line.startswith("```"):
            fence = line[3:].strip() if fence is None else None
            if fence == "sh":
                found[-1][1].append("")
        elif fence == "sh":
            found[-1][1][-1] += line
        elif fence is None and line.startswith("#"):
            found.append((line.strip("# \n"), []))
    start: list[str] = []
    for _, blocks in found:
        own = [block for block in blocks if STARTS_A_DRIVE.search(block)]
        if not own and any(BUS in block for block in blocks):
            blocks[:0] = start
        start = own[-1:] or start
    return [(title, blocks) for title, blocks in found if blocks]


CASES = [pytest.param(blocks, id=f"{path.relative_to(ROOT)}: {title}")
         for path in DOCUMENTS if path.exists() for title, blocks in sections(path)]


def test_main_readme_has_commands_and_starts_a_drive() -> None:
    blocks = [block for _, blocks in sections(ROOT / "README.md") for block in blocks]
    assert any("tools/salient sim" in block and BUS in block for block in blocks)


@pytest.mark.in_turns
@pytest.mark.parametrize(("command", "exit_code"), [
    ("ctest --test-dir build/host -R test_control_speed_smc --output-on-failure", 0),
    ("ctest --test-dir build/host -R none_of_this_name", 1),
    ("build/venv/bin/pytest -q tests/hil/test_identity.py", 0),
    ("build/venv/bin/pytest -q tests/hil/test_identity.py -k none_of_this_name", 5),
    ("true && ctest --preset host -R speed_smc", 0)])
def test_a_selection_is_listed_and_must_not_be_empty(command: str, exit_code: int) -> None:
    shell = ["bash", "-euo", "pipefail", "-c", listed(command)]
    result = subprocess.run(shell, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    assert result.returncode == exit_code, result.stdout
    assert "Passed" not in result.stdout and " passed" not in result.stdout


@pytest.mark.in_turns
@pytest.mark.parametrize("blocks", CASES)
def test_commands_of_a_section_succeed(tmp_path: Path, blocks: list[str]) -> None:
    simulators: list[subprocess.Popen[str]] = []
    try:
        for block in blocks:
            assert not NOT_TO_BE_RUN.search(block), f"mark it `sh untested`:\n{block}"
            shell = ["bash", "-euo", "pipefail", "-c", listed(block).replace(BUS, f"{tmp_path}/salient.sock")]
            if STARTS_A_DRIVE.search(block):
                simulator = subprocess.Popen(shell, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                                             text=True, start_new_session=True)
                simulators.append(simulator)
                assert simulator.stdout is not None
                assert json.loads(simulator.stdout.readline())["ready"], block
                continue
            result = subprocess.run(shell, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, text=True)
            assert result.returncode == 0, f"{block}\n{result.stdout}\n{result.stderr}"
    finally:
        for simulator in simulators:
            os.killpg(simulator.pid, signal.SIGTERM)
            assert simulator.wait() in (0, -signal.SIGTERM)
