"""`python -m salient.vm.run` runs a command in a VM with a real vcan0 and the files of the host, and returns its output
and exit code."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from salient.paths import ROOT

# Standard library only, because imports are slow in the VM.
SCRIPT = """
import os, socket, struct, sys
from pathlib import Path

sender, receiver = (socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) for _ in range(2))
for can in (sender, receiver):
    can.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
    can.bind(("vcan0",))
    can.settimeout(20)
standard = struct.pack("=IB3x8s", 0x123, 3, b"abc")
extended = struct.pack("=IB3x8s", 0x1F000001 | socket.CAN_EFF_FLAG, 8, b"12345678")
flexible = struct.pack("=IBB2x64s", 0x1ABCDEF0 | socket.CAN_EFF_FLAG, 64, 5, bytes(range(64)))
# Flags: 1 bit rate switch, 4 FD format, which the kernel sets.
for frame in (standard, extended, flexible):
    sender.send(frame)
    assert receiver.recv(72) == frame, frame

assert Path.cwd() == Path(sys.argv[1]) and os.environ["SALIENT_TEST"] == "it's\\nhere"
try:
    (Path.cwd() / "README.md").touch()
    raise SystemExit("the repository is writable")
except OSError:
    pass
Path(sys.argv[2]).write_text("written in the VM")
print(sys.argv[3])
print("to stderr", file=sys.stderr)
sys.exit(7)
"""


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "salient.vm.run", "--force-vm", *arguments],
        cwd=ROOT,
        env={**os.environ, "SALIENT_TEST": "it's\nhere"},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.in_turns
def test_command_has_vcan0_and_files_and_returns_output_and_exit_code(tmp_path: Path) -> None:
    result_file = tmp_path / "result, of the VM"
    python = os.path.realpath(sys.executable)  # the virtual environment may be in a folder that the VM does not mount
    odd = "a  b'c\"$d"
    outcome = run("--write", str(tmp_path), "--", python, "-I", "-c", SCRIPT, str(ROOT), str(result_file), odd)
    assert outcome.returncode == 7, outcome.stderr
    assert outcome.stdout == odd + "\n"
    assert outcome.stderr.splitlines()[-1] == "to stderr"
    assert result_file.read_text() == "written in the VM"


def test_time_limit_ends_the_vm_with_one_line() -> None:
    outcome = run("--timeout-s", "0.1", "--", "true")  # far less than the kernel needs
    assert outcome.returncode == 1
    assert outcome.stderr.splitlines()[-1] == (
        "salient vm: the command did not end within --timeout-s 0.1: VM killed"
    )


def test_missing_folder_is_named() -> None:
    outcome = run("--write", "/no/such/folder", "--", "true")
    assert outcome.returncode == 2
    assert "--write /no/such/folder: not a folder" in outcome.stderr
