"""Failures outside the tools, as a full disk, an interrupt or a lost connection, are one line and an exit code."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import pytest

from salient import __main__ as salient_main
from salient.bench.parameter_file import save
from salient.errors import UsageError
from salient.paths import ROOT

SALIENT = (sys.executable, "-m", "salient")


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 kB that has no room left."""
    folder = tmp_path / "full"
    folder.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", folder], capture_output=True, text=True)
    if done.returncode != 0:
        pytest.skip(f"a file system cannot be mounted: {done.stderr.strip()}")
    (folder / "filler").write_bytes(bytes(32 * 1024))
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


def assert_one_line(errors: str, *texts: str) -> None:
    assert errors.startswith("salient: ") and errors.count("\n") == 1, errors
    assert all(text in errors for text in texts), errors


@pytest.mark.in_turns
@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc", ".mf4"])
def test_full_disk_ends_a_log_with_one_line(make_bench: Callable, full_disk: Path, suffix: str) -> None:
    bench, path = make_bench(), full_disk / f"can{suffix}"
    with subprocess.Popen([*SALIENT, "log", "--can", bench.address, "--out", path], stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE, text=True) as logger:
        assert logger.stdout.readline()
        bench.run_for(1.0)
        bench.simulator.close()
        errors = logger.communicate()[1]
    assert logger.returncode == 2
    assert_one_line(errors, str(path), "No space left on device")


@pytest.mark.in_turns
@pytest.mark.parametrize("arguments", [
    ("machine", "saturating", "--out"), ("machine", "saturating", "--out", "machine", "--dbc"),
    ("run", "start_600", "--out"),
], ids=lambda arguments: f"{arguments[0]}{arguments[-1]}")
def test_full_disk_ends_other_commands_with_one_line(full_disk: Path, tmp_path: Path, arguments: tuple[str, ...]
                                                     ) -> None:
    (full_disk / "rest").write_bytes(bytes(24 * 1024))
    target = full_disk / "x.dbc" if arguments[-1] == "--dbc" else full_disk
    done = subprocess.run([*SALIENT, *arguments, target], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    assert_one_line(done.stderr, str(full_disk), "No space left on device")


@pytest.mark.parametrize("arguments", [("machine", "saturating"), ("--help",), ("sim", "--help")])
def test_full_standard_output_is_one_line(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run([*SALIENT, *arguments], cwd=tmp_path, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    assert_one_line(done.stderr, "No space left on device")


@pytest.mark.parametrize("arguments", [("machine", "saturating"), ("--help",)])
def test_output_without_a_reader_is_no_failure(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([*SALIENT, *arguments], cwd=tmp_path, stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_standard_stream_becomes_the_null_device(tmp_path: Path, closed: str) -> None:
    """Else the next file or socket that is opened has its number, and gets what is printed; for programs that the
    command starts, too."""
    code = ("import os, sys; from salient.errors import exit_code\n"
            "def command():\n"
            "    print('to nobody'); print('to nobody', file=sys.stderr)\n"
            "    of = [os.path.realpath(f'/proc/self/fd/{n}') for n in range(3) if os.get_inheritable(n)]\n"
            "    with open('found', 'w') as file:\n"
            "        file.write(' '.join(of))\n"
            "    return 3\n"
            "sys.exit(exit_code(command))")
    done = subprocess.run(["sh", "-c", f'exec "$0" -c "$1" {closed}', sys.executable, code], cwd=tmp_path,
                          capture_output=True, text=True)
    assert done.returncode == 3
    assert "to nobody" not in (done.stdout if ">&-" in closed.split() else done.stderr if "2>&-" in closed else "")
    found = (tmp_path / "found").read_text().split()
    assert len(found) == 3
    for number, sign in enumerate(("<&-", ">&-", "2>&-")):
        assert sign not in closed.split() or found[number] == os.devnull


def test_message_does_not_go_to_the_output_where_there_are_no_errors(tmp_path: Path) -> None:
    done = subprocess.run(["sh", "-c", 'exec "$@" 2>&-', "sh", *SALIENT, "run", "nonesuch"], cwd=tmp_path,
                          capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "")


@pytest.mark.parametrize("build", ["", "relative", "/tmp/absolute"])
def test_working_folder_that_is_gone_is_no_traceback(tmp_path: Path, build: str) -> None:
    code = ("import os, sys; os.rmdir(os.getcwd()); from salient.errors import exit_code; "
            "from salient.cli import make_parser; sys.argv[1:] = ['sim', '--pace', 'x']; "
            "sys.exit(exit_code(lambda: make_parser().parse_args() and 0))")
    folder = tmp_path / "gone"
    folder.mkdir()
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True,
                          env={**os.environ, "SALIENT_BUILD": build})
    assert done.returncode == 2
    assert_one_line(done.stderr, "--pace x")


def test_parameters_that_cannot_be_saved_leave_the_file(full_disk: Path) -> None:
    class Parameters(dict):
        rows: ClassVar[dict] = {}

    path = full_disk / "mine.toml"
    path.write_text("# of yesterday\n")
    (full_disk / "link.toml").symlink_to(path)
    session = SimpleNamespace(drive=SimpleNamespace(parameters=Parameters()))
    save(session, full_disk / "link.toml")
    assert (path.read_text(), (full_disk / "link.toml").is_symlink()) == ("# parameters of a drive\n", True)
    path.write_text("# of yesterday\n")
    with pytest.raises(OSError, match="No space"):
        (full_disk / "rest").write_bytes(bytes(64 * 1024))
    with pytest.raises(UsageError, match="No space left on device"):
        save(session, path)
    assert path.read_text() == "# of yesterday\n"
    assert {each.name for each in full_disk.iterdir()} == {"filler", "rest", "mine.toml", "link.toml"}
    save(session, Path("/dev/null"))
    assert Path("/dev/null").is_char_device()


@pytest.mark.parametrize(("error", "code", "line"), [
    (PermissionError(errno.EACCES, "Permission denied", "mine.toml"), 2, "mine.toml: Permission denied"),
    (OSError(errno.ENOSPC, "No space left on device"), 2, "--out here: No space left on device"),
    (ConnectionResetError(errno.ECONNRESET, "Connection reset by peer"), 1, "Connection reset by peer"),
    (BrokenPipeError(errno.EPIPE, "Broken pipe"), 1, "Broken pipe"),
    (TimeoutError(), 1, "TimeoutError"),
    (KeyboardInterrupt(), 130, "interrupted"),
], ids=lambda value: type(value).__name__)
def test_failure_of_the_outside_is_one_line(salient_without_build: Callable, monkeypatch: pytest.MonkeyPatch,
                                            error: BaseException, code: int, line: str) -> None:
    def fail(_: object) -> int:
        raise error

    monkeypatch.setitem(salient_main._COMMANDS, "machine", fail)
    done = salient_without_build("machine", "saturating", "--out", "here")
    assert (done.returncode, done.stderr) == (code, f"salient: {line}\n")


def test_mistake_in_the_tools_keeps_its_traceback(salient_without_build: Callable, monkeypatch: pytest.MonkeyPatch
                                                  ) -> None:
    monkeypatch.setitem(salient_main._COMMANDS, "machine", lambda _: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        salient_without_build("machine", "saturating")


def test_interrupt_while_modules_are_loaded_is_one_line(tmp_path: Path) -> None:
    """As the launcher executes the command: with the signal blocked, which has come before it can be handled."""
    code = ("import os, signal, sys; signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}); "
            "os.kill(os.getpid(), signal.SIGINT); os.execv(sys.argv[1], sys.argv[1:])")
    done = subprocess.run([sys.executable, "-c", code, *SALIENT, "machine", "saturating"], cwd=tmp_path,
                          capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "salient: interrupted\n")


def test_interrupt_of_the_preparation_is_one_line(tmp_path: Path) -> None:
    """A pip that takes its time, in a copy of what the launcher needs."""
    code = ("import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
            "sys.path.insert(0, sys.argv[1]); import launcher, subprocess; "
            "launcher.install_packages = lambda *_: None; "
            "launcher.make_environment = lambda *_: subprocess.run([sys.executable, '-c', "
            "'import time; print(1, flush=True); time.sleep(60)']); "
            "sys.argv[1:] = ['machine', 'saturating']; sys.exit(launcher.exit_code(launcher.main))")
    with subprocess.Popen([sys.executable, "-c", code, ROOT / "tools"], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                          text=True, cwd=tmp_path, start_new_session=True) as launcher:
        assert launcher.stdout.readline() == "1\n"
        os.killpg(launcher.pid, signal.SIGINT)
        errors = launcher.communicate()[1]
    assert launcher.returncode == 130
    assert errors.endswith("salient: interrupted\n")
