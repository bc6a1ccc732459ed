"""Logs as other tools, power cuts and transfers leave them: all frames, or those before the damage and one line."""

from __future__ import annotations

import gzip
import itertools
import struct
import zlib

import can
import pytest
from can.io import MF4Reader
from log_mutations import ORIGINALS, check, content, frames, in_containers, original
from log_mutations import START_NS as FRAMES_NS
from mf4_files import START_NS, Layout, bus_logging

from salient.bus.log import CandumpLog, RotatingLog, open_log, write_logs
from salient.bus.log_reader import LogDamaged, read_log
from salient.config import Rotation
from salient.errors import RunFailed, UsageError

FRAME_DATA = bytes(range(8))
PRINTED = (b"", b"\1\2", b"AB", FRAME_DATA)
ASC_HEADER = "date Mon Feb 3 08:15:00.000 am 2025\nbase {}  timestamps {}\ninternal events logged\n"
FD = "CANFD  1 Rx 181   1 0 8 08 01 02 03 04 05 06 07 08 0 0 {} 0 0 0 0 0"


def found(tmp_path, name, data):
    """Times, identifiers and data of the frames, and the line at the damage."""
    (tmp_path / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    read, line = [], ""
    try:
        for time_ns, message in read_log(tmp_path / name):
            read.append((time_ns, message.arbitration_id, bytes(message.data)))
    except LogDamaged as error:
        line = str(error)
    return read, line


S = 1_000_000_000


@pytest.mark.parametrize(
    ("name", "text", "frames"),
    [
        ("a.log", "(1.5) can0 123#0102\r\n(2.5) can0 123#0103\r\n",
         [(3 * S // 2, 0x123, b"\1\2"), (5 * S // 2, 0x123, b"\1\3")]),
        ("a.log", "# c\n\n(1700000000.123456789) can1 123#01.02\n", [(1_700_000_000_123_456_789, 0x123, b"\1\2")]),
        ("a.log", "(1.0) can0 123#0102\n(2.0) can0 123#0103", [(S, 0x123, b"\1\2"), (2 * S, 0x123, b"\1\3")]),
        ("a.log", " (1.000000)  vcan0  123   [2]  01 02\n", [(S, 0x123, b"\1\2")]),
        ("a.txt", " (1.000000)  vcan0  RX B -  123   [02]  01 02\n", [(S, 0x123, b"\1\2")]),
        ("A.LOG", "\ufeff(1.0) can0 123#\n", [(S, 0x123, b"")]),
        ("a.asc", ASC_HEADER.format("dec", "absolute") + " 0.5 1  385 Rx   d 2 16 255\n",
         [(S // 2, 385, b"\x10\xff")]),
        ("a.asc", ASC_HEADER.format("hex", "relative") + " 0.5 1 11 Rx d 0\n 0.25 1 Statistic: D\n 0.25 1 12 Rx d 0\n",
         [(S // 2, 0x11, b""), (S, 0x12, b"")]),
        ("a.asc", ASC_HEADER.format("hex", "absolute") + " -0.25 1 11 Rx d 0\n 0.0 Start der Messung\n",
         [(-S // 4, 0x11, b"")]),
        ("a.asc", ASC_HEADER.format("hex", "absolute") + " 1.0 " + FD.format(3000) + "\n",
         [(S, 0x181, bytes(range(1, 9)))]),
        ("a.asc", ASC_HEADER.format("hex", "absolute") + " 1.0 1  J1939TP FEE3p 6 0 0 - Rx d 9 A0 0F A6 60 3B D 4 1 2\n"
         " 1.5 1 11 Rx d 1 a5 Length = 1 BitCount = 2 ID = 17\n", [(3 * S // 2, 0x11, b"\xa5")]),
        ("a.asc", ASC_HEADER.format("hex", "absolute") + " 1.0 1 11 Rx d 10" + 16 * " 2a" + "\n",
         [(S, 0x11, 16 * b"*")]),
        ("a.asc", ASC_HEADER.format("hex", "absolute") + " 1.0 CANFD 1 Rx 11 0 1 9 12" + 12 * " 2a" + " 1 1 0 0 0\n",
         [(S, 0x11, 12 * b"*")]),
        ("a.asc", "date x\nbase hex  no internal events logged\n30000.5 1 0ABCDEF1x Rx d 1 a5\n",
         [(30_000_500_000_000, 0xABCDEF1, b"\xa5")]),
        ("a.trc", ";$FILEVERSION=1.1\n;$STARTTIME=25569.5\n 1) 1.5 Rx 0123 2 01 02\n",
         [(43_200 * S + 1_500_000, 0x123, b"\1\2")]),
        ("a.trc", ";$FILEVERSION=1.2\n;$STARTTIME=25569\n 1) 1.5 1 Rx 00000123 1 01\n", [(1_500_000, 0x123, b"\1")]),
        ("a.trc", ";$FILEVERSION=1.3\n;$STARTTIME=25569\n 1) 1.5 1 Rx 0123 - 1 01\n 2) 2.0 1 Event  a user's remark\n"
         " 3) 2.5 1 Rx 0123 - 1 02\n", [(1_500_000, 0x123, b"\1"), (2_500_000, 0x123, b"\2")]),
        ("a.trc", ";$FILEVERSION=2.0\n;$STARTTIME=25569,5\n;$COLUMNS=N,O,T,I,d,l,D\n 1 1,5 DT 0123 Rx 1 01\n"
         " 2 2 EV a remark of a user\n 3 2,5 DT 0123 Rx 1 02\n",
         [(43_200 * S + 1_500_000, 0x123, b"\1"), (43_200 * S + 2_500_000, 0x123, b"\2")]),
        ("a.csv", "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"
         "1500000,0000021A,false,Rx,0,12,00,01,02,03,04,05,06,07,08,09,0A,0B,\n1600000,0000021A,false,Rx,0,1,2A,\n",
         [(3 * S // 2, 0x21A, bytes(range(12))), (8 * S // 5, 0x21A, b"*")]),
        ("a.csv", "TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS;DataBytes\n"
         "1600000000.123450;1;14A;0;8;8;0;0;0;0102030405060708\n"
         "1600000000.223450;2;18FEF100;1;9;12;1;1;1;0102030405060708090A0B0C\n",
         [(1_600_000_000_123_450_000, 0x14A, bytes(range(1, 9))),
          (1_600_000_000_223_450_000, 0x18FEF100, bytes(range(1, 13)))]),
        ("a.txt", "".join(f"{can.Message(timestamp=number, arbitration_id=0x123, is_extended_id=number > 1, data=of)}\n"
                          for number, of in enumerate(PRINTED)),
         [(number * S, 0x123, data) for number, data in enumerate(PRINTED)]),
        ("a.csv", "timestamp,arbitration_id,extended,remote,error,dlc,data\n1.5,0x12,1,0,0,1,Kg==\n",
         [(3 * S // 2, 0x12, b"*")]),
        ("a.log", "***BUSMASTER Ver 3***\n***HEX***\n23:59:59:0000 Rx 1 0x12 s 1 2A\n00:00:01:0000 Rx 1 0x12 s 1 2B\n",
         [(86_399 * S, 0x12, b"*"), (86_401 * S, 0x12, b"+")]),
    ],
)  # fmt: skip
def test_text_of_other_tools_is_read_with_all_frames(tmp_path, name, text, frames):
    assert found(tmp_path, name, text) == (frames, "")
    assert found(tmp_path, f"{name}.gz", gzip.compress(text.encode())) == (frames, "")


@pytest.mark.parametrize(
    ("name", "text", "count", "where"),
    [
        ("a.log", "(1.0) can0 123#0102\nhello\n(2.0) can0 123#0102\n", 1, "line 2"),
        ("a.log", "(1.0) can0 123#0102\n(2.0) can0 123#01", 1, "truncated: line 2"),
        ("a.asc", ASC_HEADER.format("hex", "absolute") + "Begin TriggerBlock x\n 0.5 1 11 Rx d 1 05\n",
         1, "after line 5"),
        ("a.asc", ASC_HEADER.format("hex", "absolute") + " 0.5 1 11 Rx d 1 05\n 0.6 1 11 Rx d 2 05\n", 1, "line 5"),
        ("a.asc", ASC_HEADER.format("hex", "absolute") + " 0.5 1 11 Rx d 1 05\n 0.6 1 Engine Rx d 0\n", 1, "line 5"),
        ("a.csv", "Time Stamp,ID,Extended,Dir,Bus,LEN,D1\n1,1,false,Rx,0,1,05\n2,1,false,Rx,0,80000000,05\n",
         1, "line 3"),
        ("a.txt", f"{can.Message(data=b'1')}\n{can.Message(data=b'12')}"[:-30], 1,
         "truncated: line 2: it has 1 data bytes and states 2"),
        ("a.csv", "TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS;DataBytes\n"
         "1;1;1;0;1;1;0;0;0;01\n2;1;1;0;2;2;0;0;0;01\n", 1, "line 3"),
        ("a.trc", ";$FILEVERSION=1.1\n 1) 1.5 Rx 0123 1 01\n 2) 1.6 Rx 0123 2 01\n", 1, "line 3"),
    ],
)
def test_damaged_text_is_read_up_to_the_line(tmp_path, name, text, count, where):
    read, line = found(tmp_path, name, text)
    assert len(read) == count
    assert where in line and "\n" not in line


def blf_objects(change=None):
    """A BLF file of 20 frames, the sixth of which is changed."""
    objects = b""
    for number in range(20):
        item = bytearray(struct.pack("<4sHHLLLHHQHBBL8s", b"LOBJ", 32, 1, 48, 1, 2, 0, 0, number * 10_000_000, 1, 0, 8,
                                     0x123, bytes([number] * 8)))
        if change is not None and number == 5:
            change(item)
        objects += bytes(item)
    return in_containers(original("blf_objects")[:144], objects, 1 << 17)


@pytest.mark.parametrize(
    ("offset", "form", "value", "count"),
    [(8, "<L", 0, 5), (8, "<L", 0xFFFFFFF0, 5), (8, "<L", 96, 5), (6, "<H", 0, 5), (12, "<L", 5, 19),
     (12, "<L", 999, 19), (16, "<L", 0, 5), (24, "<Q", 1 << 63, 5), (35, "<B", 200, 20), (35, "<B", 15, 20)],
)  # fmt: skip
def test_damaged_object_of_blf_costs_no_frame_before_it(tmp_path, offset, form, value, count):
    read, line = found(tmp_path, "a.blf", blf_objects(lambda item: struct.pack_into(form, item, offset, value)))
    assert len(read) == count
    assert [frame[0] for frame in read[:5]] == [number * 10_000_000 for number in range(5)]
    assert ("byte 240 " in line or "after frame 5" in line) if count < 20 else line == ""


@pytest.mark.parametrize("reserved", [0, 4])
def test_flexible_data_rate_frame_of_blf_may_end_with_reserved_bytes(tmp_path, reserved):
    content = struct.pack("<HBBLLBBB5x64s", 1, 0, 15, 0x80000123, 0, 0, 3, 64, bytes(range(64))) + bytes(reserved)
    item = struct.pack("<4sHHLLLHHQ", b"LOBJ", 32, 1, 32 + len(content), 100, 2, 0, 0, 5_000) + content
    read, line = found(tmp_path, "a.blf", in_containers(original("blf_objects")[:144], item, 1 << 17))
    assert (read, line) == ([(5_000, 0x123, bytes(range(64)))], "")


@pytest.mark.parametrize("suffix", [".blf", ".csv", ".db", ".log", ".mf4", ".txt"])
def test_all_that_python_can_writes_is_read(tmp_path, suffix):
    sent = [message for _, message in frames()]
    with can.Logger(tmp_path / f"a{suffix}") as log:
        for number, message in enumerate(sent):
            message.timestamp = 1_700_000_000.0 + 0.01 * number
            log(message)
    read = list(read_log(tmp_path / f"a{suffix}"))
    assert [(message.arbitration_id, message.is_remote_frame, bytes(message.data)) for _, message in read] == [
        (message.arbitration_id, message.is_remote_frame, bytes(message.data)) for message in sent]
    assert [1e-9 * time_ns for time_ns, _ in read] == pytest.approx([message.timestamp for message in sent], abs=2e-6)


def test_frame_of_flexible_data_rate_is_read_from_a_database_of_python_can(tmp_path):
    with can.Logger(tmp_path / "a.db") as log:
        log(can.Message(timestamp=1.0, is_fd=True, data=bytes(12), dlc=12))
    assert [(message.is_fd, len(message.data)) for _, message in read_log(tmp_path / "a.db")] == [(True, 12)]


def test_frame_without_a_time_is_told(tmp_path):
    with pytest.raises(UsageError, match="line 1: a frame without a time; candump writes it with -L or -ta"):
        found(tmp_path, "a.txt", "  can0  123   [2]  01 02\n")


@pytest.mark.parametrize("suffix", [".blf", ".mf4"])
def test_times_since_1970_keep_their_nanoseconds(tmp_path, suffix):
    times_ns = [1_700_000_000_123_456_789 + 1_001 * number for number in range(5)]
    message = can.Message(arbitration_id=0x180, is_extended_id=False, data=FRAME_DATA)
    if suffix == ".mf4":
        found_ns = [time_ns for time_ns, _ in read_log(written(tmp_path / "a.mf4"))]
        assert found_ns == sorted(found_ns) and len(found_ns) == len(list(frames()))
        return
    write_logs([(time_ns, message) for time_ns in times_ns], tmp_path / "a.blf")
    assert [time_ns for time_ns, _ in read_log(tmp_path / "a.blf")] == times_ns


def written(path):
    """The MF4 file of the mutations."""
    path.write_bytes(original("mf4"))
    return path


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".log"])
def test_times_before_0_are_kept(tmp_path, suffix):
    write_logs([(-250_000_000, can.Message(data=b"")), (S, can.Message(data=b""))], tmp_path / f"a{suffix}")
    assert [time_ns for time_ns, _ in read_log(tmp_path / f"a{suffix}")] == [-250_000_000, S]


def test_time_that_blf_cannot_have_is_one_line(tmp_path):
    log = open_log(tmp_path / "a.blf")
    log.write(0, can.Message(data=b""))
    with pytest.raises(RunFailed, match=r"a\.blf: BLF has no time before its start"):
        log.write(-S, can.Message(data=b""))
    log.discard()


@pytest.mark.parametrize(("target", "exists"), [("b.log", True), ("b.blf", True), ("b.mf4", False), ("b.csv", False)])
def test_log_without_a_frame_of_a_drive_says_so(salient_without_build, tmp_path, target, exists):
    (tmp_path / "a.log").write_text("(1.0) can0 7FF#00\n")
    result = salient_without_build("log", "--convert", "a.log", "--out", target)
    assert (result.stdout, result.returncode, result.stderr.count("\n")) == ("", 1, 1)
    assert "none of 1 frames is of a drive" in result.stderr
    assert (tmp_path / target).exists() is exists
    assert salient_without_build("view", "--replay", "a.log").returncode == 1
    assert salient_without_build("monitor", "--replay", "a.log").returncode == 1


def test_damaged_log_is_converted_up_to_the_damage(salient_without_build, tmp_path):
    (tmp_path / "a.log").write_text("(1.0) can0 180#0102030405060708\n(2.0) can0 18")
    result = salient_without_build("log", "--convert", "a.log", "--out", "b.log")
    assert (result.stdout, result.returncode, result.stderr.count("\n")) == ("", 1, 1)
    assert "truncated: line 2" in result.stderr and "1 frames before" in result.stderr
    assert (tmp_path / "b.log").read_text() == "(1.000000) can0 180#0102030405060708\n"


@pytest.mark.parametrize(("text", "suffix"), [("2kB", ".log"), ("10 s", ".log"), ("100kB", ".blf"), ("10s", ".blf"),
                                              ("2kB", ".asc")])
def test_rotated_log_has_each_frame_once_and_each_file_is_complete(tmp_path, text, suffix):
    log = open_log(tmp_path / f"a{suffix}", rotation=Rotation.parse(text))
    message = can.Message(arbitration_id=0x180, is_extended_id=False, data=FRAME_DATA)
    times_ns = [number * 10_000_000 for number in range(10_000 if suffix == ".blf" else 3000)]
    for time_ns in times_ns:
        log.write(time_ns, message)
    log.close()
    paths = sorted(tmp_path.iterdir())
    assert len(paths) > 1 and paths[0].name == f"a_0001{suffix}"
    assert log.place == f"{paths[0]} to {paths[-1].name}"
    assert [time_ns for path in paths for time_ns, _ in read_log(path)] == times_ns
    if text == "2kB":
        assert all(2000 <= path.stat().st_size < 2200 for path in paths[:-1])


def test_rotation_of_one_frame_a_file_ends(tmp_path):
    log = RotatingLog(tmp_path / "a.log", Rotation(1, False), CandumpLog)
    for time_ns in (1, 1, 1):
        log.write(time_ns, can.Message(data=b""))
    log.close()
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize("text", ["0MB", "MB", "10", "10 parsecs", "-1s", "1e9s"])
def test_rotation_that_means_nothing_is_refused(text):
    with pytest.raises(ValueError, match="as 100MB or 10min"):
        Rotation.parse(text)


def test_every_kind_of_frame_is_read_from_mf4(tmp_path):
    assert [content(message) for _, message in read_log(written(tmp_path / "a.mf4"))] == [
        content(message) for _, message in frames()]


LAYOUTS = [
    Layout(unsorted, beside, block_bytes, compression, is_finished, big_endian)
    for unsorted, beside, big_endian in itertools.product((True, False), repeat=3)
    for block_bytes, compression, is_finished in ((0, None, True), (0, None, False), (300, None, True), (300, 0, True),
                                                  (300, 1, True))
    if is_finished or unsorted
]


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_every_layout_of_mf4_is_read_as_by_asammdf(tmp_path, layout):
    sent = [(START_NS + (time_ns - FRAMES_NS) // 100 * 100, message) for time_ns, message in frames()]
    path = tmp_path / "a.mf4"
    path.write_bytes(bus_logging(sent, layout)[0])
    read = list(read_log(path))
    assert [(time_ns, content(message)) for time_ns, message in read] == [
        (time_ns, content(message)) for time_ns, message in sent]
    with MF4Reader(path) as reader:
        others = list(reader)
    assert [content(message) for message in others] == [content(message) for _, message in read]
    assert [message.timestamp for message in others] == pytest.approx([time_ns * 1e-9 for time_ns, _ in read], abs=1e-6)


@pytest.mark.parametrize("layout", [Layout(), Layout(block_bytes=600, compression=0), Layout(is_finished=False)],
                         ids=str)
def test_mf4_that_is_cut_off_is_read_up_to_the_cut(tmp_path, layout):
    sent = [(START_NS + (time_ns - FRAMES_NS) // 100 * 100, message) for time_ns, message in frames()]
    data, ends = bus_logging(sent, layout)
    cut = ends[40] + 5 if layout.compression is None else data.rindex(b"##DZ") + 100
    (tmp_path / "a.mf4").write_bytes(data[:cut])
    whole = sum(end <= cut for end in ends)
    if layout.compression is not None:  # the list is behind its blocks
        with pytest.raises(UsageError, match="truncated: byte"):
            found(tmp_path, "a.mf4", data[:cut])
        return
    read, line = found(tmp_path, "a.mf4", data[:cut])
    assert [time_ns for time_ns, _, _ in read] == [time_ns for time_ns, _ in sent[:whole]]
    assert "truncated: byte" in line and f"{whole} frames before" in line


def test_container_that_grows_without_bound_is_refused(tmp_path):
    bomb = zlib.compress(bytes(1 << 22))
    container = struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, 32 + len(bomb), 10, 2, 48)
    data = original("blf_objects")[:144] + container + bomb
    (tmp_path / "a.blf").write_bytes(data)
    with pytest.raises(Exception, match="byte 144") as refused:
        list(read_log(tmp_path / "a.blf"))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ORIGINALS)
def test_mutated_log_ends_with_one_line_and_the_frames_before(tmp_path, name):
    ends = [check(tmp_path, name, number) for number in range(60)]
    assert sum(map(bool, ends)) > len(ends) // 3
