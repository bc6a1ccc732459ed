"""The script that runs every command in a fresh clone, on a small repository; CI runs one command by turns."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from fresh_clones import all_commands, documented, run

from salient.paths import ROOT

SALIENT = """#!/bin/sh
echo "$@" >> ran
test "$(wc -l < ran)" = 1 || exit 4 # something has run here before
test "$1" != bad
"""


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    folder = tmp_path / "repository"
    (folder / "tools").mkdir(parents=True)
    (folder / "tools" / "salient").write_text(SALIENT)
    (folder / "tools" / "salient").chmod(0o755)
    commit(folder)
    return folder


def commit(folder: Path) -> None:
    git = ["git", "-c", "user.name=A", "-c", "user.email=a@example.org"]
    for arguments in (["init", "--quiet"], ["add", "."], ["commit", "--quiet", "--allow-empty", "-m", "some"]):
        subprocess.run([*git, *arguments], cwd=folder, check=True)


def test_every_command_has_documented_lines() -> None:
    assert sorted(documented(ROOT)) == all_commands()


def test_each_command_has_a_clone_of_its_own_and_failures_are_told(repository, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    assert run(repository, out, {"good": ["good"], "bad": ["bad", "never"], "other": ["other"]}) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "2 passed, 1 failed"
    assert f"FAILED  bad: exit code 1 of `tools/salient bad`, see {out}/bad.log" in lines
    assert (out / "bad" / "ran").read_text() == "bad\n"
    assert [path.name for path in out.iterdir() if path.is_dir()] == ["bad"]
    assert not (repository / "ran").exists()


def test_what_has_passed_at_a_commit_is_not_repeated(repository, tmp_path, capsys) -> None:
    out, cases = tmp_path / "out", {"good": ["good"], "bad": ["bad"]}
    for expected in (1, 1):
        assert run(repository, out, cases) == expected
    assert "passed  good (earlier)\nFAILED  bad" in capsys.readouterr().out
    commit(repository)
    assert run(repository, out, {"good": ["good"]}) == 0
    assert "(earlier)" not in capsys.readouterr().out


def test_changes_that_are_not_committed_are_told(repository, tmp_path, capsys) -> None:
    (repository / "tools" / "salient").write_text("#!/bin/sh\nexit 3\n")
    assert run(repository, tmp_path / "out", {"good": ["good"]}) == 0
    assert "changes that are not committed are in no clone" in capsys.readouterr().out
