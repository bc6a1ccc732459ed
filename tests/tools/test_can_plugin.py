"""The python-can interface "salient", used as by any python-can program."""

from __future__ import annotations

import asyncio
import queue
import select
import socket
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import can
import pytest

from salient.bus import interface
from salient.bus.interface import SalientBus, frame_bytes, message_of

TIMEOUT_S = 10.0


@pytest.fixture
def connect(make_bench):
    """Starts a drive on a local bus; returns a function that opens clients."""
    bench = make_bench()
    clients = []

    def open_client(**options) -> can.BusABC:
        clients.append(can.Bus(interface="salient", channel=bench.address, **options))
        return clients[-1]

    open_client.bench = bench
    yield open_client
    for client in clients:
        client.shutdown()


def received(bus: can.BusABC, expected: can.Message) -> can.Message:
    """The next frame with the identifier of `expected`."""
    while True:
        message = bus.recv(TIMEOUT_S)
        assert message is not None
        if message.arbitration_id == expected.arbitration_id and message.is_extended_id == expected.is_extended_id:
            return message


FRAMES = [
    can.Message(arbitration_id=0x123, is_extended_id=False, data=b""),
    can.Message(arbitration_id=0x7FF, is_extended_id=False, data=bytes(range(8))),
    can.Message(arbitration_id=0x080 | 1 << 18, is_extended_id=True, data=b"\xff"),
    can.Message(arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=3),
    can.Message(arbitration_id=0x123, is_extended_id=False, is_fd=True, bitrate_switch=True, data=bytes(range(64))),
    can.Message(arbitration_id=0x123, is_extended_id=True, is_fd=True, error_state_indicator=True, data=b""),
    can.Message(arbitration_id=0x123, is_extended_id=False, dlc=15, data=bytes(8)),
    can.Message(arbitration_id=0x020, is_error_frame=True, is_extended_id=False, dlc=8, data=bytes(8)),
]


@pytest.mark.parametrize("frame", FRAMES, ids=lambda frame: f"{len(frame.data)}-bytes-{frame.arbitration_id:X}")
def test_packed_frame_is_unpacked_unchanged(frame):
    again = message_of(frame_bytes(frame), 1_234_567_891, "unix:x")
    assert again.equals(frame, timestamp_delta=None, check_channel=False)
    assert again.time_ns == 1_234_567_891
    assert again.timestamp == pytest.approx(1.234567891, abs=1e-12)


@pytest.mark.parametrize("frame", FRAMES, ids=lambda frame: f"{len(frame.data)}-bytes-{frame.arbitration_id:X}")
def test_frame_reaches_the_other_client_unchanged(connect, frame):
    sender, listener = connect(), connect()
    sender.send(frame)
    connect.bench.run_for(0.001)
    assert received(listener, frame).equals(frame, timestamp_delta=None, check_channel=False)


def test_own_frames_are_received_only_if_enabled(connect):
    silent, curious = connect(), connect(receive_own_messages=True)
    # Different identifiers: two nodes that transmit the same bits at once transmit one frame.
    for bus, identifier in ((silent, 0x123), (curious, 0x124)):
        bus.send(can.Message(arbitration_id=identifier, is_extended_id=False, data=b"\1"))
    connect.bench.run_for(0.001)
    assert [m.arbitration_id for m in drained(silent) if m.arbitration_id in (0x123, 0x124)] == [0x124]
    assert [m.arbitration_id for m in drained(curious) if m.arbitration_id in (0x123, 0x124)] == [0x123, 0x124]


def drained(bus: can.BusABC) -> list[can.Message]:
    """Frames received so far; in lock-step none follow the response of the clock."""
    messages = []
    while (message := bus.recv(0)) is not None:
        messages.append(message)
    return messages


def test_timestamp_is_the_completion_of_the_frame(connect):
    """At 1 Mbit/s a bit takes one microsecond; a frame of 8 bytes has 111 to 135 bits, depending on stuffing."""
    bus = connect(receive_own_messages=True)
    connect.bench.run_for(0.0105)
    drained(bus)
    for _ in range(2):
        bus.send(can.Message(arbitration_id=0x001, is_extended_id=False, data=b"\xaa" * 8))
    connect.bench.run_for(0.001)
    first, second = (m.time_ns for m in drained(bus) if m.arbitration_id == 0x001)
    assert 10_500_000 + 108_000 <= first <= 10_500_000 + 2 * 135_000
    assert 108_000 <= second - first <= 135_000


def test_filters_select_by_identifier(connect):
    bus = connect(can_filters=[{"can_id": 0x181, "can_mask": 0x7FF, "extended": False}])
    connect.bench.run_for(0.01)
    messages = drained(bus)
    assert len(messages) >= 9
    assert {m.arbitration_id for m in messages} == {0x181}


def test_end_of_the_drive_is_reported(connect):
    bus = connect()
    connect.bench.simulator.close()
    with pytest.raises(can.CanOperationError, match="can0.sock: the drive has ended"):  # noqa: PT012 - after any number
        for _ in range(1000):
            bus.recv(TIMEOUT_S)
    with pytest.raises(can.CanOperationError, match="can0.sock: the drive has ended"):
        bus.send(can.Message(arbitration_id=1))


class CountingListener(can.Listener):
    """Handles errors, so that a Notifier goes on."""

    def __init__(self) -> None:
        self.errors: list[Exception] = []

    def on_message_received(self, msg: can.Message) -> None:
        pass

    def on_error(self, exc: Exception) -> None:
        self.errors.append(exc)


@pytest.mark.in_turns
@pytest.mark.parametrize("cause", ["drive", "client"])
def test_listener_that_handles_the_end_is_not_called_without_pause(connect, monkeypatch, cause):
    """One call, and one more per timeout of the Notifier: 1 s. The test holds each pause until it has looked."""
    bus, listener = connect(), CountingListener()
    pauses, go_on = queue.Queue(), threading.Semaphore(0)

    def pause(duration_s: float) -> None:
        pauses.put((duration_s, len(listener.errors)))
        go_on.acquire()

    monkeypatch.setattr(interface, "time", SimpleNamespace(sleep=pause, monotonic=time.monotonic))
    with can.Notifier(bus, [listener]) as notifier:
        if cause == "drive":
            connect.bench.simulator.close()
        else:
            bus.shutdown()
        seen = []
        for _ in range(3):
            seen.append(pauses.get(timeout=TIMEOUT_S))
            go_on.release()
        go_on.release(1000)
        notifier.stop()
    before = seen[0][1]  # calls ahead of the first pause: the end may come while the Notifier listens, or before
    assert before in (0, 1)
    assert seen == [(1.0, before), (1.0, before + 1), (1.0, before + 2)]
    reason = {"drive": "the drive has ended", "client": "this client was shut down"}[cause]
    assert all(str(error).endswith(reason) for error in listener.errors)


def test_shutdown_by_another_thread_while_a_receiver_begins_to_wait_is_told_as_such(connect, monkeypatch):
    bus = connect()
    while bus.recv(0) is not None:
        pass

    def shut_down_first(*arguments):
        bus.shutdown()
        return select.select(*arguments)

    monkeypatch.setattr(interface, "select", SimpleNamespace(select=shut_down_first))
    with pytest.raises(can.CanOperationError, match="this client was shut down"):
        bus.recv(0.0)


def test_event_loop_reports_the_end_once(connect):
    """A descriptor that stays ready would be called back in each of the turns that the loop makes after the report."""
    bus = connect()
    reported = []

    async def wait_for_the_end() -> None:
        loop, has_ended = asyncio.get_running_loop(), asyncio.Event()

        def report(_: asyncio.AbstractEventLoop, context: dict) -> None:
            reported.append(context["exception"])
            has_ended.set()

        loop.set_exception_handler(report)
        with can.Notifier(bus, [can.AsyncBufferedReader()], loop=loop):
            connect.bench.simulator.close()
            await asyncio.wait_for(has_ended.wait(), TIMEOUT_S)
            for _ in range(100):
                await asyncio.sleep(0)  # a turn of the loop

    asyncio.run(wait_for_the_end())
    assert [str(error).endswith("can0.sock: the drive has ended") for error in reported] == [True]


def test_frames_ahead_of_the_end_are_received(tmp_path):
    """A server that ends with a frame of this client unread: the system reports a reset ahead of what was delivered."""
    path = f"{tmp_path}/can.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
        server.bind(path)
        server.listen()
        with SalientBus(f"unix:{path}") as bus:
            served, _ = server.accept()
            bus.send(FRAMES[0])
            for _ in range(3):
                served.send(bytes(8) + frame_bytes(FRAMES[1]))
            served.close()
            assert [bus.recv(TIMEOUT_S).arbitration_id for _ in range(3)] == [0x7FF] * 3
            with pytest.raises(can.CanOperationError, match="the drive has ended"):
                bus.recv(TIMEOUT_S)


def test_flush_leaves_what_was_sent_on_its_way(connect):
    sender, listener = connect(), connect()
    sender.send(FRAMES[1])
    sender.flush_tx_buffer()
    connect.bench.run_for(0.001)
    assert received(listener, FRAMES[1]).data == FRAMES[1].data


def test_absent_drive_is_reported(tmp_path):
    with pytest.raises(can.CanInitializationError, match="no drive answers there"):
        SalientBus(f"unix:{tmp_path}/nothing")


def test_asyncio_notifier_receives_frames(connect):
    bus = connect()

    async def first_heartbeat() -> can.Message:
        reader = can.AsyncBufferedReader()
        with can.Notifier(bus, [reader], loop=asyncio.get_running_loop()):
            connect.bench.run_for(0.01)
            while (message := await asyncio.wait_for(reader.get_message(), TIMEOUT_S)).arbitration_id != 0x701:
                pass
            return message

    assert asyncio.run(first_heartbeat()).dlc == 8


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".log"])
def test_python_can_logger_records_the_bus(connect, tmp_path, suffix):
    """The standard logger of python-can records a bus until the drive ends."""
    path = tmp_path / f"log{suffix}"
    bench = connect.bench
    command = [sys.executable, "-u", "-m", "can.logger", "-i", "salient", "-c", bench.address, "-f", str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as logger:
        for line in logger.stdout:
            if line.startswith("Connected to SalientBus"):
                break
        bench.run_for(0.02)
        bench.simulator.close()
        logger.stdout.read()
        logger.wait()
    with can.LogReader(path) as log:
        identifiers = [m.arbitration_id for m in log]
    assert identifiers.count(0x180) == bench.telemetry.count("DRIVE_STATUS") == 20
    assert 0x1F000010 in identifiers
