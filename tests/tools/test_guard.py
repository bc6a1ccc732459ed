"""Nothing of a run is left, whatever ends its first process: salient.guard."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from kills import left_of, wait_until_nothing

BEGIN = """
import os, signal, socket, subprocess, sys, tempfile
from pathlib import Path
from salient.guard import guarded, removes, removes_socket

def start(code, **options):
    subprocess.Popen([sys.executable, "-c", "import signal; " + code], **options)

DEAF = "signal.signal(signal.SIGTERM, signal.SIG_IGN); signal.pause()"
context = guarded()
context.__enter__()
tempfile.mkstemp()
"""
WAKES = """
woken, wakes = os.pipe()
os.set_blocking(wakes, False)
signal.set_wakeup_fd(wakes)
"""
WAIT = "while True: os.read(woken, 1)"
"""Not signal.pause(): an interrupt that comes after Python's last look for one and before the call would be lost."""
CHILDREN = """
removes(Path("partial"))
Path("partial").write_text("half")
server = socket.socket(socket.AF_UNIX)
removes_socket(Path("server.sock"))
server.bind("server.sock")
start("signal.pause()")
start(DEAF, start_new_session=True)
start("import tempfile; from salient.guard import begin; begin(); tempfile.mkstemp(); signal.pause()")
if os.fork() == 0:
    os.setsid()
    exec(DEAF)
print(1, flush=True)
"""
"""A file, a socket, and a process of each kind: an ordinary one, a deaf one of another session, one with a run of its
own, and one that is forked and executes nothing."""
MARK = "SALIENT_GUARD_TEST"


def start(code: str, folder: Path) -> subprocess.Popen[str]:
    temporary = folder / "tmp"
    temporary.mkdir()
    return subprocess.Popen([sys.executable, "-c", code], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                            text=True, env={**os.environ, MARK: str(folder), "TMPDIR": str(temporary)})


def left_in(folder: Path) -> list[str]:
    """After the run and its second process have ended."""
    return wait_until_nothing(lambda: left_of(f"{MARK}={folder}", folder / "tmp", folder))


@pytest.mark.in_turns
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_nothing_is_left_after_a_signal(tmp_path: Path, number: signal.Signals) -> None:
    with start(BEGIN + WAKES + CHILDREN + WAIT, tmp_path) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "1\n"
        process.send_signal(number)
        process.stdout.read()  # to the end of all that write into it
    assert process.returncode == -number
    assert left_in(tmp_path) == []
    assert [path.name for path in tmp_path.iterdir()] == ["tmp"]


def test_nothing_is_left_after_an_end_in_order(tmp_path: Path) -> None:
    with start(BEGIN + CHILDREN + "context.__exit__(None, None, None)", tmp_path) as process:
        process.communicate()
    assert process.returncode == 0
    assert left_in(tmp_path) == []
    assert [path.name for path in tmp_path.iterdir()] == ["tmp"]


def test_socket_that_another_process_serves_stays(tmp_path: Path) -> None:
    path = tmp_path / "other.s"
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        with start(BEGIN + "removes(Path('other.s'))", tmp_path) as process:
            process.communicate()
        assert left_in(tmp_path) == []
        assert path.is_socket()


def test_file_or_folder_in_the_place_of_a_bus_stays_when_sim_refuses_it(tmp_path: Path) -> None:
    (tmp_path / "tmp").mkdir()
    (tmp_path / "folder").mkdir()
    for name in ("file", "folder/file"):
        (tmp_path / name).write_text("of the user")
    for name in ("file", "folder"):
        done = subprocess.run([sys.executable, "-m", "salient", "sim", "--can", f"unix:{tmp_path / name}"],
                              capture_output=True, text=True, check=False,
                              env={**os.environ, MARK: str(tmp_path), "TMPDIR": str(tmp_path / "tmp")})
        assert done.returncode == 2
        assert done.stderr == f"salient: --can unix:{tmp_path / name}: exists and is not a socket\n"
    assert left_in(tmp_path) == []
    assert (tmp_path / "file").read_text() == (tmp_path / "folder" / "file").read_text() == "of the user"


def test_temporary_files_are_gone_when_the_process_has_ended_in_order(tmp_path: Path) -> None:
    with start(BEGIN + "context.__exit__(None, None, None)", tmp_path) as process:
        process.communicate()
    assert list((tmp_path / "tmp").iterdir()) == []


def test_process_of_no_run_goes_on(tmp_path: Path) -> None:
    """As the installation of a Debian package, which must not be cut off."""
    code = BEGIN + ("sleeper = subprocess.Popen(['env', '-u', RUNS, '-u', 'TMPDIR', sys.executable, '-c', "
                    "'import signal; signal.pause()'])\nprint(sleeper.pid)")
    with start(code.replace("guarded, removes,", "RUNS, guarded, removes,"), tmp_path) as process:
        assert process.stdout is not None
        other = int(process.stdout.readline())
        process.wait()
    guards = wait_until_nothing(lambda: [str(path) for path in (tmp_path / "tmp").iterdir()])
    try:
        assert guards == []
        os.kill(other, 0)
    finally:
        os.kill(other, signal.SIGKILL)
