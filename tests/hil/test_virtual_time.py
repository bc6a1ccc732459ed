"""The reader returns the same list of (time, frame) with times from records and from RIG_STAMP frames."""

from __future__ import annotations

import can

from salient.bus.clock import RIG_CLOCK_ID, RIG_STAMP_ID, VirtualTimeReader

NEXT, OLDEST_ON_BUS, OLDEST_AT_ONCE = 0, 1, 2
RUN_UNTIL_ID = 0x1F000001
TRUTH_ID = 0x1F000010


class Interface:
    """Replaces a SocketCAN bus: returns the given frames."""

    def __init__(self, *frames: can.Message) -> None:
        self._frames = list(frames)

    def recv(self, timeout: float | None) -> can.Message | None:
        return self._frames.pop(0) if self._frames else None


def frame(identifier: int, *data: int, extended: bool = False, **options) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=extended, **options)


def rig(identifier: int, time_ns: int, last: int) -> can.Message:
    return can.Message(arbitration_id=identifier, data=time_ns.to_bytes(6, "little") + bytes([last]))


def stamp(time_ns: int, subject: int) -> can.Message:
    return rig(RIG_STAMP_ID, time_ns, subject)


def read(*frames: can.Message) -> list[tuple[int, int, bytes]]:
    reader = VirtualTimeReader(Interface(*frames))
    result = []
    while (timed := reader.receive(0)) is not None:
        time_ns, message = timed
        assert message.timestamp == time_ns / 1e9
        result.append((time_ns, message.arbitration_id, bytes(message.data)))
    return result


def test_frames_of_the_emulator_have_the_preceding_timestamp():
    assert read(stamp(10, NEXT), frame(0x180, 1), stamp(20, NEXT), frame(TRUTH_ID, 2, extended=True)) == [
        (10, 0x180, b"\1"),
        (20, TRUTH_ID, b"\2"),
    ]


def test_frames_of_clients_arrive_at_their_completion():
    """A command is on the interface before it completes on the emulated bus."""
    assert read(
        frame(0x80, 1), frame(0x600, 2), stamp(5, NEXT), frame(0x180, 3),
        stamp(7, OLDEST_ON_BUS), stamp(9, OLDEST_ON_BUS),
    ) == [(5, 0x180, b"\3"), (7, 0x80, b"\1"), (9, 0x600, b"\2")]


def test_rig_frames_overtake_frames_for_the_emulated_bus():
    assert read(
        frame(0x80, 1), rig(RUN_UNTIL_ID, 100, 4), stamp(0, OLDEST_AT_ONCE), stamp(50, OLDEST_ON_BUS),
        rig(RIG_CLOCK_ID, 100, 4),
    ) == [
        (0, RUN_UNTIL_ID, b"\x64\0\0\0\0\0\4"),
        (50, 0x80, b"\1"),
        (100, RIG_CLOCK_ID, b"\x64\0\0\0\0\0\4"),
    ]  # fmt: skip


def test_flexible_data_rate_frames_bypass_the_emulated_bus():
    assert read(frame(0x80, 1, is_fd=True), frame(0x80, 2), stamp(1, OLDEST_ON_BUS), stamp(2, OLDEST_AT_ONCE)) == [
        (1, 0x80, b"\2"),
        (2, 0x80, b"\1"),
    ]


def test_client_frame_between_a_timestamp_and_its_frame_is_handled():
    assert read(stamp(10, NEXT), frame(0x80, 1), frame(0x180, 2), stamp(11, OLDEST_ON_BUS)) == [
        (10, 0x180, b"\2"),
        (11, 0x80, b"\1"),
    ]


def test_timestamps_of_frames_before_the_reader_connected_are_ignored():
    assert read(stamp(1, OLDEST_ON_BUS), stamp(2, OLDEST_AT_ONCE), frame(0x80, 1), stamp(3, OLDEST_ON_BUS)) == [
        (3, 0x80, b"\1")
    ]
