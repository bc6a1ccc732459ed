"""tools/salient log and monitor: recordings, output and termination."""

from __future__ import annotations

import itertools
import re
import signal
import socket
import subprocess
import sys
import threading

import can
import pytest

from salient.bus import clock, monitor, signals


@pytest.fixture
def listen(make_bench):
    """A drive on a local bus, and a function that starts a listening command on it and waits for its first line."""
    bench = make_bench()
    commands = []

    def start(command, *options, activity):
        line = [sys.executable, "-u", "-m", "salient", command, "--can", bench.address, *map(str, options)]
        process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        commands.append(process)
        assert process.stdout.readline() == f"{activity} {bench.address}\n"
        return process

    start.bench = bench
    yield start
    for process in commands:
        process.kill()
        process.communicate()


def finish(process):
    """Standard output, standard error and exit code."""
    output, errors = process.communicate()
    return output, errors, process.returncode


def kill(bench):
    """Ends the emulator without an orderly shutdown."""
    bench.simulator._process.kill()
    bench.simulator._process.wait()
    bench.simulator._process.returncode = 0  # expected here: closing the bench is no failure


@pytest.mark.parametrize("suffix", [".blf", ".log"])
def test_log_holds_every_frame_with_its_virtual_time(listen, tmp_path, suffix):
    path = tmp_path / f"log{suffix}"
    bench = listen.bench
    bench.run_for(0.001)
    seen = len(bench.log)
    logger = listen("log", "--out", path, activity="recording")
    bench.run_for(0.02)
    bench.simulator.close()
    assert finish(logger) == (f"{len(bench.log) - seen} frames: {path}\n",
                              f"salient: {bench.address}: the drive's bus closed: the drive was stopped\n", 0)
    with can.LogReader(path) as log:
        logged = [(m.timestamp, m.arbitration_id, bytes(m.data)) for m in log]
    expected = [(t * 1e-9, m.arbitration_id, bytes(m.data)) for t, m in bench.log[seen:]]
    assert [entry[1:] for entry in logged] == [entry[1:] for entry in expected]
    # The candump format has a resolution of one microsecond.
    assert max(abs(a[0] - b[0]) for a, b in zip(logged, expected, strict=True)) < (1e-9 if suffix == ".blf" else 1e-6)


def test_log_is_complete_when_interrupted(listen, tmp_path):
    path = tmp_path / "log.blf"
    logger = listen("log", "--out", path, activity="recording")
    listen.bench.run_for(0.02)
    logger.send_signal(signal.SIGTERM)
    assert finish(logger)[1:] == ("", 0)
    with can.LogReader(path) as log:
        times = [m.timestamp for m in log]
    assert times == sorted(times)


def test_monitor_prints_one_line_per_interval(listen):
    bench = listen.bench
    monitor = listen("monitor", "--every-s", "0.02", activity="monitoring")
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.2)
    bench.simulator.close()
    output, errors, code = finish(monitor)
    lines = output.splitlines()
    assert code == 0
    assert errors == f"salient: {bench.address}: the drive's bus closed: the drive was stopped\n"
    assert 8 <= len(lines) <= 10
    assert all("state        run" in line and "reference    600.00 r/min" in line for line in lines[1:])


def lines_of_log(salient_without_build, path, spans):
    """Times of the lines of a monitor over a log of a drive's torque each millisecond, in spans of milliseconds."""
    identifier = signals.drive_database().get_message_by_name("DRIVE_TORQUE").frame_id
    path.write_text("".join(f"({at_ms / 1000:.6f}) can0 {identifier:03X}#{'00' * 8}\n"
                            for span in spans for at_ms in span))
    result = salient_without_build("monitor", "--replay", path)
    assert result.returncode == 0
    return [float(line.split()[0]) for line in result.stdout.splitlines()]


def test_pause_of_a_log_has_one_line_at_its_end_and_the_period_goes_on(salient_without_build, tmp_path):
    times_s = lines_of_log(salient_without_build, tmp_path / "pause.log", [range(251), range(99_960, 100_151)])
    assert times_s == [0.1, 0.2, 99.96, 100.0, 100.1]


def test_monitor_goes_on_with_a_recording_that_follows_in_a_log_with_earlier_times(salient_without_build, tmp_path):
    times_s = lines_of_log(salient_without_build, tmp_path / "two.log", [range(5_000, 5_301), range(301)])
    assert times_s == [5.1, 5.2, 5.3, 0.1, 0.2, 0.3]


@pytest.mark.parametrize(("command", "activity"), [("log", "recording"), ("monitor", "monitoring")])
def test_requested_duration_ends_the_command(listen, tmp_path, command, activity):
    options = ["--out", tmp_path / "can.log"] if command == "log" else []
    process = listen(command, *options, "--duration-s", "0.01", activity=activity)
    listen.bench.run_for(0.02)
    assert finish(process)[1:] == ("", 0)


@pytest.mark.parametrize(("command", "activity"), [("log", "recording"), ("monitor", "monitoring")])
def test_killed_emulator_is_reported(listen, tmp_path, command, activity):
    bench = listen.bench
    options = ["--out", tmp_path / "can.log"] if command == "log" else []
    process = listen(command, *options, activity=activity)
    bench.run_for(0.02)
    kill(bench)
    output, errors, code = finish(process)
    assert (errors, code) == (
        f"salient: {bench.address}: the drive's bus closed: the emulator was killed or crashed\n", 1)
    if command == "log":
        assert output == f"{len((tmp_path / 'can.log').read_text().splitlines())} frames: {tmp_path / 'can.log'}\n"


def test_drive_stopped_before_the_requested_duration_is_reported(listen):
    process = listen("monitor", "--duration-s", "10", activity="monitoring")
    listen.bench.run_for(0.02)
    listen.bench.simulator.close()
    assert finish(process)[1:] == (f"salient: {listen.bench.address}: the drive's bus closed before --duration-s 10 had"
                                   " passed: the drive was stopped\n", 1)


def test_node_without_a_drive_is_told_once_with_the_nodes_that_are_heard(listen):
    process = listen("monitor", "--node", "2", "--duration-s", "1.5", activity="monitoring")
    listen.bench.run_for(1.2)
    line = f"salient: {listen.bench.address}: no frame of a drive with node number 2 (--node), but of node 0"
    assert process.stderr.readline() == f"{line}; listening on\n"
    listen.bench.run_for(0.5)
    assert finish(process) == ("", "", 1)


@pytest.mark.in_turns
@pytest.mark.parametrize("end", ["duration", "interrupt", "bus"])
def test_node_that_was_never_heard_is_exit_code_1(listen, end):
    process = listen("monitor", "--node", "2", "--signals", "DRIVE_STATUS.state", "--duration-s", "0.5",
                     activity="monitoring")
    listen.bench.run_for(0.4)  # frames are shown when no identity has come for 0.25 s
    text = f"salient: {listen.bench.address}: no frame of a drive with node number 2 (--node), but of node 0\n"
    if end == "duration":
        listen.bench.run_for(0.15)
    elif end == "interrupt":
        assert process.stdout.readline()  # frames have come
        process.send_signal(signal.SIGTERM)  # as an interrupt, which a shell's background ignores
    else:
        listen.bench.simulator.close()
        early = "closed before --duration-s 0.5 had passed: the drive was stopped"
        text = f"salient: {listen.bench.address}: the drive's bus {early}\n{text}"
    assert finish(process)[1:] == (text, 1)


def test_drive_that_comes_later_is_present():
    heard = monitor._Nodes("unix:x", 1)
    frame = can.Message(arbitration_id=0x080, is_extended_id=False, data=bytes(8))
    ids = {node: next(key for key, value in clock.nodes_of_drives().items() if value == node) for node in (0, 1)}
    for node, time_s in ((0, 0.0), (0, 1.1), (1, 1.2)):
        frame.arbitration_id = ids[node]
        heard.add(round(time_s * 1e9), frame)
        assert heard.absent == (node == 0)


def test_mf4_file_of_a_node_without_a_drive_is_exit_code_1(listen, tmp_path):
    path = tmp_path / "log.mf4"
    process = listen("log", "--node", "2", "--out", path, "--duration-s", "0.02", activity="recording")
    listen.bench.run_for(0.05)
    text = f"salient: {listen.bench.address}: no frame of a drive with node number 2 (--node), but of node 0\n"
    assert finish(process)[1:] == (text, 1)


class UnpluggedBus:
    """A SocketCAN interface that goes away after a frame."""

    def __init__(self, address):
        self.frames = [can.Message(timestamp=1.6e9, arbitration_id=0x180, is_extended_id=False, data=bytes(8))] * 2

    def recv(self, timeout):
        if self.frames:
            return self.frames.pop(0)
        raise can.CanOperationError("Failed to receive: No such device [Error Code 19]")

    def shutdown(self):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        pass


def test_interface_without_any_drive_is_told(salient_without_build, monkeypatch):
    class SilentBus(UnpluggedBus):
        """An interface without a frame, until it goes away."""

        def __init__(self, address):
            super().__init__(address)
            self.frames = [None] * 3

    monkeypatch.setattr(monitor, "open_bus", SilentBus)
    monkeypatch.setattr(monitor.signal, "signal", lambda *_: None)
    done = salient_without_build("monitor", "--can", "socketcan:can0")
    assert done.returncode == 1
    assert done.stderr.splitlines()[0] == ("salient: socketcan:can0: no frame of a drive with node number 0 (--node) "
                                           "or of any other drive; listening on")
    assert len(done.stderr.splitlines()) == 2


@pytest.mark.parametrize(("command", "early"), [("log", ""), ("monitor", " before --duration-s 10 had passed")])
def test_interface_that_goes_away_is_reported(salient_without_build, monkeypatch, tmp_path, command, early):
    monkeypatch.setattr(monitor, "open_bus", UnpluggedBus)
    monkeypatch.setattr(monitor.signal, "signal", lambda *_: None)
    options = ["--out", tmp_path / "can.log"] if command == "log" else ["--duration-s", "10"]
    done = salient_without_build(command, "--can", "socketcan:can0", *options)
    assert (done.returncode, done.stderr) == (1, f"salient: socketcan:can0: the interface failed{early}: Failed to "
                                                 "receive: No such device [Error Code 19]\n")


def test_parameters_of_a_bus_without_a_drive_end_with_one_line(salient_without_build, monkeypatch, tmp_path):
    monkeypatch.setattr("salient.bench.session._ALIVE_CHECK_S", 0.01)
    monkeypatch.setattr("salient.bench.parameter_file.SILENCE_MAX_S", 0.02)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
        server.bind(f"{tmp_path}/bus.sock")
        server.listen()
        done = salient_without_build("parameters", "faults", "--can", f"unix:{tmp_path}/bus.sock")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == f"salient: unix:{tmp_path}/bus.sock: no frame of a drive for 0.02 s; is there one?\n"


def test_reader_of_a_bus_of_other_nodes_ends_after_its_timeout(monkeypatch):
    class Bus:
        """A SocketCAN interface that always has a frame of another node."""

        def recv(self, timeout):
            return can.Message(timestamp=1.6e9, arbitration_id=0x7F0, is_extended_id=False, data=bytes(8))

    now_s = itertools.count(100.0, 0.25)
    monkeypatch.setattr(clock.time, "monotonic", lambda: next(now_s))
    assert clock.VirtualTimeReader(Bus()).receive(1.0) is None
    assert next(now_s) == 101.25


def test_parameters_of_a_bus_that_ends_are_one_line(salient_without_build, tmp_path):
    def end() -> None:
        server.accept()[0].close()

    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
        server.bind(f"{tmp_path}/bus.sock")
        server.listen()
        threading.Thread(target=end, daemon=True).start()
        done = salient_without_build("parameters", "faults", "--can", f"unix:{tmp_path}/bus.sock")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == f"salient: unix:{tmp_path}/bus.sock: the drive has ended\n"


def test_monitor_shows_chosen_signals_of_both_databases_with_units_and_names(listen):
    bench = listen.bench
    names = ["DRIVE_STATUS.state", "load_torque_estimate_Nm", "RIG_TRUTH_MOTION.speed_rpm", "DRIVE_HEARTBEAT.state",
             "DRIVE_COMMAND.request", "RIG_SET.load_torque_Nm"]
    monitor = listen("monitor", "--every-s", "0.02", "--signals", *names, activity="monitoring")
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.08)
    bench.load_torque_Nm = 2.5
    bench.run_for(0.12)
    bench.simulator.close()
    output, _, code = finish(monitor)
    assert code == 0
    lines = output.splitlines()
    assert max(map(len, lines)) <= 120
    assert all(line[12:].startswith("  ") for line in lines)
    entries = re.split(r"\n(?= +[0-9.]+ s  )", output.strip())
    assert 8 <= len(entries) <= 10
    assert len({tuple(map(len, entry.split("\n"))) for entry in entries[1:]}) == 1  # columns do not move
    first, last = " ".join(entries[0].split()), " ".join(entries[-1].split())
    assert "DRIVE_STATUS.state run load_torque_estimate_Nm " in last
    assert re.search(r"load_torque_estimate_Nm -?[0-9]+\.[0-9]+ N m RIG_TRUTH_MOTION.speed_rpm [0-9.]+ r/min ", last)
    assert "DRIVE_HEARTBEAT.state run" in last  # sent every 100 ms, shown every 20 ms
    assert "DRIVE_COMMAND.request run" in last
    assert "RIG_SET.load_torque_Nm - N m" in first
    assert last.endswith("RIG_SET.load_torque_Nm 2.5000 N m")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("sped_rpm", ["no such signal; the nearest of ", " are speed_rpm, held_speed_rpm, "]),
        ("DRIVE_MOTOIN.speed_rpm", ["no such signal; the nearest of ", " are DRIVE_MOTION.speed_rpm, "]),
        ("nonsense", ["no such signal; the nearest of "]),
        ("DRIVE_MOTION.nonsense", ["no such signal", "DRIVE_MOTION.speed_rpm", "DRIVE_MOTION.rotor_angle_deg"]),
        ("speed_rpm", ["in several messages", "DRIVE_MOTION.speed_rpm", "RIG_TRUTH_MOTION.speed_rpm"]),
    ],
)
def test_unknown_or_ambiguous_signal_is_one_line_with_the_nearest(salient_without_build, name, words):
    result = salient_without_build("monitor", "--can", "unix:none", "--signals", "DRIVE_STATUS.state", name)
    assert (result.stdout, result.returncode) == ("", 2)
    assert result.stderr.count("\n") == 1
    assert all(word in result.stderr for word in [f"--signals {name}: ", *words]), result.stderr


@pytest.mark.parametrize("controller", ["paper", "salient"])
def test_monitor_names_the_direction_of_the_torque_that_would_hold_the_load(make_bench, controller):
    """One quadrant has no torque backwards, but this load is beyond the torque forwards."""
    bench = make_bench(controller=controller)
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.5)
    bench.rig.load_torque_Nm = 25
    bench.run_until(lambda: bench.telemetry["DRIVE_AVAILABLE_TORQUE.load_exceeds"].last, timeout=0.3)
    shown = monitor._MainSignals(monitor.drive_database("saturating"))
    for time_ns, message in bench.log:
        shown.add(time_ns, message)
    assert "load exceeds the torque forward, 19.1" in shown.line(bench.time_ns)
    assert shown.line(bench.time_ns) == ""


def test_monitor_tells_that_a_load_exceeds_the_torque_and_what_limits_it(make_bench):
    bench = make_bench(machine="finite_element", controller="salient")
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.5)
    bench.fault("chopper_open")
    bench.rig.load_torque_Nm = -8
    bench.run_for(0.15)
    shown = monitor._MainSignals(monitor.drive_database("finite_element"))
    lines = []
    for time_ns, message in bench.log:
        shown.add(time_ns, message)
        if message.arbitration_id == 0x182 and not message.is_extended_id:  # DRIVE_TORQUE
            lines.append((time_ns * 1e-9, shown.line(time_ns)))
    telling = [(time_s, line) for time_s, line in lines if "load exceeds the torque backward, " in line]
    assert 0.5 < telling[0][0] < 0.61
    assert all(line.endswith("by dc_link") for _, line in telling) and telling[-1] == lines[-1]
