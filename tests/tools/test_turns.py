"""Turns of the tests that take long: a commit runs one, all of them together run everything once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from salient.paths import ROOT
from salient.turns import TURNS, turn_of_commit, turn_of_name

FILE = """
import pytest

{whole}

@pytest.mark.in_turns
@pytest.mark.parametrize("case", range(24))
def test_long(case):
    pass

def test_short():
    pass
"""


def collected(file: Path, *options: str) -> list[str]:
    """Names of the tests that are run of a file, with the hooks of tests/conftest.py."""
    done = subprocess.run([sys.executable, "-m", "pytest", "-q", "--collect-only", "-p", "no:cacheprovider",
                           f"--rootdir={file.parent}",
                           *options, str(file)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return [line.rpartition("::")[2] for line in done.stdout.splitlines() if "::" in line]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "conftest.py").write_bytes((ROOT / "tests" / "conftest.py").read_bytes().replace(
        b"def pytest_sessionstart", b"def not_started"))  # nothing to build
    return tmp_path


def test_each_case_has_one_turn_and_a_short_test_every_one(folder):
    file = folder / "test_some.py"
    file.write_text(FILE.format(whole=""))
    everything = collected(file)
    cases = {name: turn_of_name(f"test_some.py::{name}") for name in everything if name != "test_short"}
    assert len(cases) == 24 and set(cases.values()) == set(range(TURNS))
    assert collected(file, "--turn=2") == [name for name in everything if cases.get(name, 2) == 2]


def test_a_marked_file_is_run_as_a_whole_in_its_turn(folder):
    file = folder / "test_some.py"
    file.write_text(FILE.format(whole="pytestmark = pytest.mark.in_turns"))
    turn = turn_of_name("test_some.py")
    assert len(collected(file, f"--turn={turn}")) == 25
    done = subprocess.run([sys.executable, "-m", "pytest", "-q", "--collect-only", "-p", "no:cacheprovider",
                           f"--rootdir={file.parent}",
                           f"--turn={(turn + 1) % TURNS}", str(file)], capture_output=True, text=True, check=False)
    assert "no tests collected (25 deselected)" in done.stdout, done.stdout + done.stderr


CACHES = """
from functools import lru_cache

from salient.turns import turn_of_name

@lru_cache
def made_here(name):
    return object()

imported_and_wrapped = lru_cache(turn_of_name)

def test_one():
    made_here(1), imported_and_wrapped("a")

def test_two():
    assert made_here.cache_info().currsize == imported_and_wrapped.cache_info().currsize == 1
"""
NEXT_FILE = """
from test_a import imported_and_wrapped, made_here

def test_next():
    assert made_here.cache_info().currsize == imported_and_wrapped.cache_info().currsize == 0
    made_here(2)

def test_last():
    assert made_here.cache_info().currsize == 1
"""


def test_cached_results_of_a_file_are_kept_for_its_tests_and_freed_after_the_last_of_them(folder):
    (folder / "test_a.py").write_text(CACHES)
    (folder / "test_b.py").write_text(NEXT_FILE)
    done = subprocess.run([sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--rootdir={folder}",
                           str(folder)], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "4 passed" in done.stdout, done.stdout + done.stderr


def test_turn_of_a_commit_is_one_of_all():
    assert turn_of_commit() in range(TURNS)
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert turn_of_commit() == int(head, 16) % TURNS


def test_turn_that_does_not_exist_is_refused(folder):
    done = subprocess.run([sys.executable, "-m", "pytest", "-q", f"--turn={TURNS}", str(folder)], capture_output=True,
                          text=True, check=False)
    assert done.returncode == 4 and "--turn" in done.stderr
