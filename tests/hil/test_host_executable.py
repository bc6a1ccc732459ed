"""The host executable without the launcher: command line, socket file, termination."""

from __future__ import annotations

import json
import re
import signal
import socket
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from salient.bench.programs import executable
from salient.config import DEFAULTS, FLAG, OPTIONS, flag_of
from salient.machine.cache import machine_image

TIMEOUT_S = 20
RUN_UNTIL_ID = 0x9F000001  # includes the extended flag


@pytest.fixture
def program() -> list[str]:
    return [str(executable()), "--machine-image", str(machine_image("saturating"))]


@pytest.fixture
def start(program: list[str], tmp_path: Path) -> Iterator:
    """Starts the executable on tmp_path/bus and waits for its ready line; ends remaining processes."""
    processes = []

    def run(*arguments: str) -> tuple[subprocess.Popen[str], dict]:
        process = subprocess.Popen(
            [*program, "--can", f"unix:{tmp_path}/bus", *arguments],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        processes.append(process)
        return process, json.loads(process.stdout.readline())

    yield run
    for process in processes:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout, process.stderr):
            pipe.close()


@pytest.mark.parametrize(
    ("arguments", "expected_texts"),
    [
        ([], ["--can", "unix:PATH"]),
        (["--can"], ["--can", "requires a value"]),
        (["--can", "tcp:1"], ["tcp:1", "must be unix:PATH or socketcan:INTERFACE"]),
        (["--can", "unix:/no/such/folder/bus"], ["/no/such/folder/bus"]),
        (["--can", "socketcan:nosuch0"], ["socketcan:nosuch0"]),
        (["--can", "BUS", "--pace", "fast"], ["--pace fast", "must be lockstep, realtime, free or xN"]),
        (["--can", "BUS", "--pace", "x0"], ["--pace x0", "0.01 to 1000"]),
        (["--can", "BUS", "--controller", "pid"], ["--controller pid", "must be traditional, paper or salient"]),
        (["--can", "BUS", "--control-rate-hz", "44000"], ["44000", "must be 20000, 40000, 50000, 100000 or 1000000"]),
        (["--can", "BUS", "--encoder-bits", "7"], ["--encoder-bits 7", "8 to 24"]),
        (["--can", "BUS", "--adc-bits", "11"], ["--adc-bits 11", "12 to 16"]),
        (["--can", "BUS", "--adc-bits", "17"], ["--adc-bits 17", "12 to 16"]),
        (["--can", "BUS", "--encoder-edges=1"], ["--encoder-edges"]),
        (["--can", "BUS", "--immediate-pwm", "1"], ["1"]),
        (["--can", "BUS", "--seed", "-1"], ["--seed -1"]),
        (["--can", "BUS", "--initial-angle-deg", "nan"], ["--initial-angle-deg nan", "-360 to 360"]),
        (["--can", "BUS", "--record", "/no/such/folder/x.npy"], ["/no/such/folder/x.npy"]),
        (["--can", "BUS", "--record-switches", "/no/such/folder/x"], ["/no/such/folder/x"]),
        (["--can", "BUS", "--record-step-ns", "1000"], ["--record"]),
        (["--can", "BUS", "--record", "x.npy", "--record-step-ns", "99"],
         ["--record-step-ns 99", "100 to 1000000000"]),
        (["--can", "BUS", "--bit-rate", "1000001"], ["--bit-rate 1000001", "10000 to 1000000"]),
        (["--can", "BUS", "--pace", "lockstep", "--stop-at-s", "1"], ["--stop-at-s", "lockstep"]),
        (["--can", "BUS", "--record", ""], ["--record", "requires a value"]),
        (["--can", "BUS", "--bogus"], ["--bogus", "unrecognised"]),
        (["--can", "BUS", "extra"], ["extra", "unrecognised argument"]),
    ],
)
def test_usage_error_is_one_line_and_exit_code_2(
    program: list[str], tmp_path: Path, arguments: list[str], expected_texts: list[str]
) -> None:
    bus = tmp_path / "bus"
    line = [f"unix:{bus}" if argument == "BUS" else argument for argument in arguments]
    command = [*program, *line]
    result = subprocess.run(command, check=False, capture_output=True, text=True, cwd=tmp_path, timeout=TIMEOUT_S)
    assert result.returncode == 2
    assert result.stdout == ""
    assert re.fullmatch(r"salient: [^\n]+\n", result.stderr), result.stderr
    for expected in expected_texts:
        assert expected in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_missing_machine_image_is_named(tmp_path: Path) -> None:
    result = subprocess.run([executable(), "--can", f"unix:{tmp_path}/bus"], check=False, capture_output=True,
                            text=True, timeout=TIMEOUT_S)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr == "salient: --machine-image: missing; must be the name of a file\n"
    assert list(tmp_path.iterdir()) == []


def test_usage_text_has_every_option_and_controller(program: list[str]) -> None:
    result = subprocess.run([*program, "--help"], check=False, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert (result.returncode, result.stderr) == (0, "")
    described = re.findall(r"^  (--[a-z-]+)", result.stdout, re.MULTILINE)
    assert described == [flag_of(name) for name, option in OPTIONS.items() if option.argument]
    assert "traditional, paper or salient (default salient)" in result.stdout


def test_defaults_are_those_of_bench_config(start, tmp_path: Path) -> None:
    """An executable without options and one with every default written out leave the same recording."""
    recordings = []
    for name in ("without", "with"):
        file = tmp_path / f"{name}.npy"
        written = [] if name == "without" else [
            expected for field, option in OPTIONS.items()
            if option.argument and option.kind != FLAG and field not in ("can", "pace") and DEFAULTS[field] is not None
            for expected in (flag_of(field), str(DEFAULTS[field]))
        ]  # fmt: skip
        process, ready = start("--pace", "free", "--stop-at-s", "0.005", "--record", str(file), *written)
        assert (ready["controller"], ready["seed"]) == ("salient", 1)
        assert process.wait(TIMEOUT_S) == 0
        recordings.append(file.read_bytes())
    assert recordings[0] == recordings[1]


@pytest.mark.parametrize(("pace", "is_valid"), [
    ("x0.01", True), ("x1000", True), ("x.5", True), ("x0.009", False), ("x1000.1", False), ("x", False), ("1", False),
])  # fmt: skip
def test_paces_are_those_of_bench_config(program: list[str], tmp_path: Path, pace: str, is_valid: bool) -> None:
    line = [*program, "--can", f"unix:{tmp_path}/bus", "--pace", pace, "--stop-at-s", "0.000001"]
    result = subprocess.run(line, check=False, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert result.returncode == (0 if is_valid else 2), result.stderr
    if is_valid:
        assert OPTIONS["pace"].parse(pace) == pace
    else:
        with pytest.raises(ValueError, match="must be lockstep"):
            OPTIONS["pace"].parse(pace)


def test_ready_line_contains_the_conditions(start, tmp_path: Path) -> None:
    process, ready = start("--pace", "lockstep", "--controller", "traditional", "--seed", "18446744073709551615")
    assert ready == {
        "ready": True, "can": f"unix:{tmp_path}/bus", "pid": process.pid, "machine": "saturating",
        "controller": "traditional", "control_rate_hz": 40000, "pace": "lockstep", "seed": 18446744073709551615,
        "node": 0, "drives": 1,
    }  # fmt: skip


@pytest.mark.parametrize(("options", "message"), [
    (["--node", "8"], "--node 8: must be a whole number from 0 to 7"),
    (["--drives", "0"], "--drives 0: must be a whole number from 1 to 8"),
    (["--node", "6", "--drives", "3"], "--drives 3: with --node 6 at most 2"),
])  # fmt: skip
def test_node_numbers_end_at_7(program: list[str], tmp_path: Path, options: list[str], message: str) -> None:
    line = [*program, "--can", f"unix:{tmp_path}/bus", *options]
    result = subprocess.run(line, check=False, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert (result.returncode, result.stderr) == (2, f"salient: {message}\n")


def test_accepts_the_conditions_of_a_simulation(start) -> None:
    board = ["--control-rate-hz", "1000000", "--encoder-bits", "0", "--adc-bits", "16", "--immediate-pwm"]
    process, ready = start("--pace", "free", "--stop-at-s", "0.01", "--encoder-edges", *board)
    assert ready["control_rate_hz"] == 1000000
    assert process.wait(TIMEOUT_S) == 0
    assert process.stderr.read() == ""


@pytest.mark.parametrize("pace", ["lockstep", "realtime", "free"])
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM, "stdin"])
def test_ends_cleanly_and_removes_its_socket(start, tmp_path: Path, pace: str, end: signal.Signals | str) -> None:
    process, _ = start("--pace", pace, "--follow-stdin")
    if end == "stdin":
        process.stdin.close()
    else:
        process.send_signal(end)
    assert process.wait(TIMEOUT_S) == 0
    assert process.stderr.read() == ""
    assert not (tmp_path / "bus").exists()


def test_distant_run_until_does_not_prevent_termination(start, tmp_path: Path) -> None:
    process, _ = start("--pace", "lockstep")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as client:
        client.connect(f"{tmp_path}/bus")
        client.send(struct.pack("<QIBxxx8s", 0, RUN_UNTIL_ID, 7, b"\xff" * 6 + b"\x01"))
        while struct.unpack_from("<QI", client.recv(80))[0] < 1_000_000:
            pass  # free-running
    process.terminate()
    assert process.wait(TIMEOUT_S) == 0


def test_stale_socket_is_replaced_and_a_live_one_is_not(start, program: list[str], tmp_path: Path) -> None:
    process, _ = start("--pace", "lockstep")
    process.kill()
    process.wait()
    assert (tmp_path / "bus").exists()
    start("--pace", "lockstep")
    line = [*program, "--can", f"unix:{tmp_path}/bus"]
    second = subprocess.run(line, check=False, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert second.returncode == 2
    assert re.fullmatch(r"salient: [^\n]*in use[^\n]*\n", second.stderr)
    assert (tmp_path / "bus").exists()


def test_recording_is_complete_after_a_signal(start, tmp_path: Path) -> None:
    import numpy as np
    file = tmp_path / "truth.npy"
    process, _ = start("--pace", "free", "--record", str(file), "--record-from-us", "500", "--stop-at-s", "0.002")
    assert process.wait(TIMEOUT_S) == 0
    times = np.load(file)["time_s"]
    np.testing.assert_allclose(times, np.arange(500, 2001) * 1e-6, atol=1e-12)
