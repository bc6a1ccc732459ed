"""The program that starts QEMU behaves as the host executable does: usage errors, ready line, termination."""

from __future__ import annotations

import json
import re
import signal
import subprocess
from pathlib import Path

import pytest

from salient.bench.programs import executable, image
from salient.machine.cache import machine_image

TIMEOUT_S = 20


@pytest.fixture
def program() -> list[str]:
    return [str(executable("cortex-m4")), str(image("saturating", "cortex-m4"))]


@pytest.mark.parametrize(
    ("arguments", "expected_texts"),
    [
        ([], ["--can", "unix:PATH"]),
        (["--can", "unix:/no/such/folder/bus"], ["/no/such/folder/bus"]),
        (["--can", "BUS", "--controller", "pid"], ["--controller pid", "traditional, paper or salient"]),
        (["--can", "BUS", "--record", "/no/such/folder/x.npy"], ["/no/such/folder/x.npy"]),
        (["--instructions", "/no/such/folder/x", "--can", "BUS"], ["--instructions /no/such/folder/x"]),
        (["--execution", "/no/such/folder/x", "0-1", "--can", "BUS"], ["--execution /no/such/folder/x"]),
        (["--execution", "x", "8-8", "--can", "BUS"], ["--execution 8-8", "END-BEGIN"]),
        (["--instruction-ns", "9", "--can", "BUS"], ["--instruction-ns 9", "must be 1, 2, 4, 8, 16, 32 or 64"]),
        (["--can", "BUS", "--bogus"], ["--bogus"]),
    ],
)
def test_usage_error_is_one_line_and_exit_code_2(
    program, tmp_path: Path, arguments: list[str], expected_texts: list[str]
):
    line = [f"unix:{tmp_path}/bus" if argument == "BUS" else argument for argument in arguments]
    result = subprocess.run([*program, *line, "--machine-image", machine_image("saturating")], capture_output=True,
                            text=True, cwd=tmp_path, timeout=TIMEOUT_S)
    assert result.returncode == 2
    assert result.stdout == ""
    assert re.fullmatch(r"salient: [^\n]+\n", result.stderr), result.stderr
    for expected in expected_texts:
        assert expected in result.stderr


def test_missing_image_is_named(program, tmp_path: Path):
    result = subprocess.run([program[0], "none.elf", "--can", f"unix:{tmp_path}/bus"], capture_output=True, text=True,
                            cwd=tmp_path, timeout=TIMEOUT_S)
    assert result.returncode == 2
    assert result.stderr == "salient: none.elf: No such file or directory\n"


def test_file_that_is_not_an_image_is_named(program, tmp_path: Path):
    result = subprocess.run([program[0], program[0], "--can", f"unix:{tmp_path}/bus"], capture_output=True, text=True,
                            timeout=TIMEOUT_S)
    assert result.returncode == 2
    assert result.stderr == f"salient: {program[0]}: not an image of a drive for a board of QEMU\n"


@pytest.mark.parametrize(("build", "qemu", "package"), [("cortex-m4", "qemu-system-arm", "qemu-system-arm"),
                                                        ("rv32", "qemu-system-riscv32", "qemu-system-misc")])
def test_missing_qemu_is_reported_with_its_package(tmp_path: Path, build: str, qemu: str, package: str):
    program = [executable(build), image("saturating", build)]
    result = subprocess.run([*program, "--can", f"unix:{tmp_path}/bus"], capture_output=True, text=True,
                            env={"PATH": str(tmp_path)}, timeout=TIMEOUT_S)
    assert result.returncode == 2
    assert result.stderr == f"salient: {qemu} (Debian package {package}): No such file or directory\n"


@pytest.mark.in_turns
@pytest.mark.parametrize("pace", ["lockstep", "realtime", "free"])
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM, "stdin"])
def test_ready_line_then_a_clean_end_without_the_socket(program, tmp_path: Path, pace: str, end):
    bus = tmp_path / "with,comma"
    process = subprocess.Popen([*program, "--machine-image", machine_image("saturating"), "--can", f"unix:{bus}",
                                "--pace", pace, "--follow-stdin"],
                               stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    with process:
        ready = json.loads(process.stdout.readline())
        assert ready == {"ready": True, "can": f"unix:{bus}", "pid": process.pid, "machine": "saturating",
                         "controller": "salient", "control_rate_hz": 40000, "pace": pace, "seed": 1, "node": 0,
                         "drives": 1}
        if end == "stdin":
            process.stdin.close()
        else:
            process.send_signal(end)
        assert process.wait(TIMEOUT_S) == 0
        assert process.stderr.read() == ""
    assert not bus.exists()
