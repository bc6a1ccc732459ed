"""A checkout that cannot be written is told in one line, and SALIENT_BUILD builds elsewhere."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from fresh_clones import all_commands, documented

from salient import paths
from salient.paths import BUILD, ROOT
from salient.test_runner import _test_preset

# Root ignores permissions, but without these capabilities.
OBEYS_PERMISSIONS = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] if os.geteuid() == 0 else []
LAUNCHER = "import sys; sys.path.insert(0, 'tools'); import launcher; from launcher import exit_code; "
EVERY_COMMAND = """
for line in sys.stdin.read().splitlines():
    sys.argv[1:] = line.split()
    print(exit_code(launcher.main))
"""
# The environment takes minutes to install: the present one is used. Of the programs a small one is built.
PREPARED = """
launcher.install_packages = launcher.make_environment = lambda *_: None
launcher.host_targets = lambda *_: ["drive_codec"]
sys.exit(exit_code(launcher.main))
"""
SCENARIO = """
machine = "saturating"
controllers = ["paper"]
duration_s = 0.01
"""


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A copy of the sources in which nothing can be written."""
    folder = tmp_path_factory.mktemp("read only") / "check out"
    listed = subprocess.run(["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], cwd=ROOT,
                            capture_output=True, text=True, check=True).stdout
    for name in listed.split("\0"):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    subprocess.run(["chmod", "-R", "a-w", folder], check=True)
    before = contents(folder)
    yield folder
    assert contents(folder) == before
    subprocess.run(["chmod", "-R", "u+w", folder], check=True)  # pytest removes it


def contents(folder: Path) -> dict[str, int]:
    return {str(path): path.lstat().st_mtime_ns for path in folder.rglob("*")}


def launch(code: str, checkout: Path, *arguments: str, build: str = "", text: str = ""
           ) -> subprocess.CompletedProcess[str]:
    """Runs the launcher of a checkout, in it, with a value of SALIENT_BUILD."""
    environment = {**os.environ, "SALIENT_BUILD": build, "PYTHONPATH": str(checkout / "tools" / "src"),
                   "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run([*OBEYS_PERMISSIONS, sys.executable, "-c", LAUNCHER + code, *arguments], cwd=checkout,
                          env=environment, input=text, capture_output=True, text=True, check=False)


def test_every_command_tells_in_one_line_that_the_checkout_cannot_be_written(checkout: Path) -> None:
    lines = documented(ROOT)
    assert sorted(lines) == all_commands()
    done = launch(EVERY_COMMAND, checkout, text="\n".join(of[0] for of in lines.values()))
    assert done.stdout.split() == ["2"] * len(lines)
    assert done.stderr.splitlines() == len(lines) * [
        f"salient: {checkout}/build: Permission denied; everything is built there, or in a writable folder that "
        "SALIENT_BUILD names"]


def test_run_from_it_builds_and_writes_elsewhere(checkout: Path, tmp_path: Path) -> None:
    """In a folder with a space, named by a relative path; the other tests name absolute ones."""
    there = checkout.parents[1] / "made here" / "build"
    for name, content in (("venv/bin/python", f'#!/bin/sh\nexec "{sys.executable}" "$@"\n'),
                          ("host/bin/salient_host", f'#!/bin/sh\nexec "{BUILD}/host/bin/salient_host" "$@"\n')):
        (there / name).parent.mkdir(parents=True)
        (there / name).write_text(content)
        (there / name).chmod(0o755)
    (tmp_path / "some.toml").write_text(SCENARIO)
    done = launch(PREPARED, checkout, "run", str(tmp_path / "some.toml"), build="../../made here/build")
    assert done.returncode == 0, done.stderr
    assert done.stderr == f"salient: building {there}/host\n"
    assert done.stdout.endswith(f"results: {there}/out/some/results.json\n")
    assert (there / "out" / "some" / "results.json").exists()
    assert any((there / "machines").glob("*.machine"))
    assert any((there / "pycache").rglob("*.pyc"))


def test_folder_that_cannot_be_used_is_told_in_one_line(checkout: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "closed").mkdir(mode=0o555)
    (tmp_path / "nowhere").symlink_to("none")
    others = tmp_path / "others"
    others.mkdir()
    (others / "clone").write_bytes(os.fsencode(ROOT))
    for build, reason in (("file", "not a folder"), ("file/below", "not a folder"), ("closed", "Permission denied"),
                          ("closed/below", "Permission denied"), ("nowhere", "not a folder"),
                          ("others", f"another clone is built there, {ROOT}; each needs a folder of its own")):
        done = launch(PREPARED, checkout, "machine", "saturating", build=f"{tmp_path}/{build}")
        assert done.returncode == 2
        assert done.stderr.startswith("salient: ") and done.stderr.count("\n") == 1, done.stderr
        assert f"{tmp_path}/{build}: {reason}" in done.stderr
    assert not any((tmp_path / "closed").iterdir())


def test_folder_of_a_clone_that_is_gone_is_taken_over(checkout: Path, tmp_path: Path) -> None:
    (tmp_path / "clone").write_bytes(os.fsencode(tmp_path / "gone"))
    (tmp_path / "venv" / "bin").mkdir(parents=True)
    (tmp_path / "venv" / "bin" / "python").symlink_to("/bin/true")
    done = launch(PREPARED, checkout, "machine", "saturating", build=str(tmp_path))
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "clone").read_bytes() == os.fsencode(checkout)


def test_command_tells_that_it_waits_for_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                 capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(paths, "BUILD", tmp_path)
    monkeypatch.setattr(paths, "_LOCK_TOLD_S", 0.1)
    with paths.build_lock():
        assert capsys.readouterr().err == ""
    with (tmp_path / "launcher.lock").open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        waiting = threading.Timer(1.0, fcntl.flock, (other, fcntl.LOCK_UN))
        waiting.start()
        with paths.build_lock():
            waiting.join()
    assert capsys.readouterr().err == (
        f"salient: waiting for another command, which installs or builds in {tmp_path}\n")


def test_what_pytest_leaves_goes_there(pytestconfig: pytest.Config) -> None:
    assert pytestconfig.getini("cache_dir") == str(BUILD / "pytest_cache")
    assert pytestconfig.getoption("--salient-failures") == BUILD / "failures"


def test_unit_tests_elsewhere_have_the_options_of_their_preset() -> None:
    options, environment = _test_preset("sanitize")
    assert options == ["--output-on-failure", "--exclude-regex=_linear_(cosine|trapezoid)$"]
    assert environment == {"UBSAN_OPTIONS": "print_stacktrace=1"}
    assert _test_preset("host") == (["--output-on-failure"], {})
