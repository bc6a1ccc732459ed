"""Formats of a log, recorded and converted: the frames that each keeps, and files that cannot be read."""

from __future__ import annotations

import csv
import sys

import can
import pytest

from salient.bus.log import write_logs
from salient.bus.log_reader import read_log
from salient.bus.signals import drive_database, rig_database
from salient.cli import make_parser

FRAMES = [
    can.Message(arbitration_id=0x180, is_extended_id=False, data=bytes(range(8))),
    can.Message(arbitration_id=0x1F000010, data=b""),
    can.Message(arbitration_id=0x7FF, is_extended_id=False, data=b"\x01", is_fd=True),
    can.Message(arbitration_id=0x1ABCDEF0, data=bytes(64), is_fd=True, bitrate_switch=True),
    can.Message(arbitration_id=5, data=b"", is_fd=True, error_state_indicator=True),
    can.Message(arbitration_id=0x10, is_extended_id=False, is_remote_frame=True, dlc=4),
    can.Message(arbitration_id=0x11, is_remote_frame=True, dlc=0),
    can.Message(arbitration_id=0x12, is_extended_id=False, dlc=13, data=bytes(8)),
]
ERROR = can.Message(arbitration_id=0x88, is_extended_id=False, is_error_frame=True, dlc=8, data=bytes(range(8)))
TIMES_NS = [0, 1, 999, 1000, 1_234_567_891, 86_400_000_000_123, 281_474_976_710_655, 281_474_976_710_655]
ORDER = ("arbitration_id", "is_extended_id", "is_remote_frame", "is_error_frame", "is_fd", "bitrate_switch",
         "error_state_indicator", "dlc", "data")


def content(message: can.Message) -> list[object]:
    """Content of a frame, without time and channel."""
    return [getattr(message, name) for name in ORDER]


@pytest.mark.parametrize(("suffix", "step_ns"), [(".blf", 1), (".asc", 1000), (".log", 1000)])
def test_every_kind_of_frame_is_read_back_as_written(tmp_path, suffix, step_ns):
    path = tmp_path / f"frames{suffix}"
    write_logs(zip(TIMES_NS, FRAMES, strict=True), path)
    found = list(read_log(path))
    assert [content(message) for _, message in found] == [content(message) for message in FRAMES]
    assert [time_ns for time_ns, _ in found] == [time_ns // step_ns * step_ns for time_ns in TIMES_NS]


@pytest.mark.parametrize(("suffix", "kept"), [(".blf", True), (".log", True), (".asc", False)])
def test_content_of_an_error_frame_is_lost_in_asc_only(tmp_path, suffix, kept):
    path = tmp_path / f"frames{suffix}"
    write_logs([(5000, ERROR)], path)
    [(time_ns, found)] = read_log(path)
    assert time_ns == 5000
    assert found.is_error_frame
    assert (content(found) == content(ERROR)) is kept


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".log"])
def test_python_can_reads_the_frames_of_a_drive_from_every_format(make_bench, tmp_path, suffix):
    bench = make_bench()
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.03)
    path = tmp_path / f"drive{suffix}"
    write_logs(bench.log, path)
    with can.LogReader(path) as reader:
        found = list(reader)
    assert [content(message) for message in found] == [content(message) for _, message in bench.log]
    late_s = [time_ns * 1e-9 - message.timestamp for (time_ns, _), message in zip(bench.log, found, strict=True)]
    assert -1e-9 < min(late_s) <= max(late_s) < (1e-9 if suffix == ".blf" else 1e-6)


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".log"])
def test_equal_frames_give_equal_bytes(tmp_path, suffix):
    paths = [tmp_path / f"{name}{suffix}" for name in ("first", "second")]
    write_logs(zip(TIMES_NS, FRAMES, strict=True), *paths)
    assert paths[0].read_bytes() == paths[1].read_bytes()


@pytest.fixture
def drive_log(make_bench, tmp_path):
    """A short run of a drive as a BLF file, and its bench."""
    bench = make_bench()
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.05)
    bench.rig.encoder_fault = 1
    bench.run_for(0.05)
    path = tmp_path / "drive.blf"
    write_logs(bench.log, path)
    return path, bench


def test_chain_of_conversions_keeps_every_frame_of_a_drive(salient_without_build, drive_log, tmp_path):
    source, bench = drive_log
    for step, suffix in enumerate((".asc", ".log", ".blf", ".log")):
        target = tmp_path / f"{step}{suffix}"
        result = salient_without_build("log", "--convert", source, "--out", target)
        assert (result.stdout, result.stderr, result.returncode) == (f"{len(bench.log)} frames: {target}\n", "", 0)
        source = target
    expected = tmp_path / "expected.log"
    write_logs(bench.log, expected)
    assert source.read_bytes() == expected.read_bytes()


def test_mf4_has_names_units_states_and_times_of_both_databases(salient_without_build, drive_log, tmp_path):
    asammdf = pytest.importorskip("asammdf")
    source, bench = drive_log
    target = tmp_path / "drive.mf4"
    assert salient_without_build("log", "--convert", source, "--out", target).returncode == 0
    groups = {"DRIVE_STATUS", "DRIVE_MOTION", "DRIVE_FAULT_CAUSE", "DRIVE_COMMAND", "RIG_TRUTH_MOTION", "RIG_SET"}
    compared, states = 0, set()
    with asammdf.MDF(target) as mdf:
        assert groups <= {group.channel_group.acq_name for group in mdf.groups}
        for index, group in enumerate(mdf.groups):
            name = group.channel_group.acq_name
            database = rig_database() if name.startswith("RIG_") else drive_database()
            message = database.get_message_by_name(name)
            assert group.channel_group.comment == message.comment
            signals = {signal.name: signal for signal in message.signals}
            for channel in group.channels[1:]:  # after the time
                found, signal = mdf.get(channel.name, group=index), signals[channel.name]
                assert (found.unit, found.comment) == (signal.unit or "", signal.comment or "")
                table = next((t for t in (bench.telemetry, bench.truth) if f"{name}.{signal.name}" in t), None)
                if table is None:
                    continue  # what this bench has sent
                expected = table[f"{name}.{signal.name}"]
                assert found.timestamps == pytest.approx(expected.time_s, abs=1e-12)
                if signal.choices:
                    states |= set(found.samples.tolist()) if signal.name == "state" else set()
                    raw = mdf.get(channel.name, group=index, raw=True).samples
                    assert raw.tolist() == expected.value.tolist()
                    names = {int(number): str(text) for number, text in signal.choices.items()}
                    assert [text.decode() for text in found.samples] == [names.get(value, "") for value in raw.tolist()]
                else:
                    assert found.samples.tolist() == expected.value.tolist()
                compared += 1
    assert {b"run", b"fault"} <= states
    assert compared > 50


def test_csv_has_each_value_with_its_time_unit_and_name(salient_without_build, drive_log, tmp_path):
    source, bench = drive_log
    assert salient_without_build("log", "--convert", source, "--out", tmp_path / "drive.csv").returncode == 0
    with (tmp_path / "drive.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["time_s"]) for row in rows] == sorted(float(row["time_s"]) for row in rows)
    for name in ("DRIVE_MOTION.speed_rpm", "DRIVE_STATUS.state"):
        expected = bench.telemetry[name]
        found = [row for row in rows if f"{row['message']}.{row['signal']}" == name]
        assert [float(row["value"]) for row in found] == pytest.approx(expected.value.tolist())
        assert [float(row["time_s"]) for row in found] == pytest.approx(expected.time_s.tolist(), abs=1e-12)
        assert {row["unit"] for row in found} == {expected.unit}
        names = expected.choices or {}
        assert [row["name"] for row in found] == [names.get(value, "") for value in expected.value.tolist()]


def test_parquet_names_the_package_that_it_requires(salient_without_build, drive_log, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    result = salient_without_build("log", "--convert", drive_log[0], "--out", tmp_path / "drive.parquet")
    assert (result.stdout, result.returncode, result.stderr.count("\n")) == ("", 2, 1)
    assert "pip install pyarrow" in result.stderr
    assert not (tmp_path / "drive.parquet").exists()


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("can.pcap", b"", ["can.pcap", ".asc, .blf, "]),
        ("can.mf4", b"", ["can.mf4", "no header of MF4"]),
        ("missing.blf", None, ["missing.blf", "No such file"]),
        ("can.blf", b"", ["can.blf", "not readable as .blf"]),
        ("can.blf", b"(0.0) can0 123#\n" * 20, ["can.blf", "not readable as .blf"]),
        ("can.asc", b"\xff\x00\x01", ["can.asc", "does not begin with a date"]),
        ("can.log", b"hello\n(0.000001) can0 123#11\n", ["can.log", "line 1: 'hello'"]),
        ("can.log", b"(0.000001) can0 123#111\n", ["can.log", "line 1"]),
        ("can.log", b"\xff\n", ["can.log", "not readable as .log"]),
    ],
)
def test_file_that_cannot_be_read_is_one_line_and_no_target(salient_without_build, tmp_path, name, content, words):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    result = salient_without_build("log", "--convert", name, "--out", "target.log")
    assert (result.stdout, result.returncode) == ("", 2)
    assert result.stderr.count("\n") == 1
    assert all(word in result.stderr for word in ["--convert", *words]), result.stderr
    assert not (tmp_path / "target.log").exists()


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".log"])
@pytest.mark.parametrize("lost", [2, 30, 2000])
def test_truncated_file_is_reported(salient_without_build, drive_log, tmp_path, suffix, lost):
    source = tmp_path / f"whole{suffix}"
    write_logs(drive_log[1].log, source)
    (tmp_path / f"cut{suffix}").write_bytes(source.read_bytes()[:-lost])
    result = salient_without_build("log", "--convert", f"cut{suffix}", "--out", "target.log")
    assert (result.stdout, result.returncode) == ("", 1)
    assert result.stderr.startswith(f"salient: --convert cut{suffix}: ")
    assert "truncated" in result.stderr
    assert result.stderr.count("\n") == 1
    found = [content(message) for _, message in read_log(tmp_path / "target.log")]
    assert found == [content(message) for _, message in drive_log[1].log[: len(found)]]
    assert len(found) > len(drive_log[1].log) // 2  # 2000 bytes of BLF have some 300 frames


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--duration-s", "1"], ["--duration-s", "not with --convert"]),
        (["--out", "a.log"], ["--out a.log", "another file"]),
        (["--out", "a.log/b.blf"], ["a.log/b.blf", "exists"]),
        (["--out", "b.mf4", "--machine", "none"], ["none"]),
    ],
)
def test_contradictory_options_are_one_line(salient_without_build, tmp_path, options, words):
    (tmp_path / "a.log").write_text("(0.000001) can0 123#11\n")
    result = salient_without_build("log", "--convert", "a.log", *options)
    assert (result.stdout, result.returncode) == ("", 2)
    assert result.stderr.count("\n") == 1
    assert all(word in result.stderr for word in words), result.stderr


@pytest.mark.parametrize(("source", "options"), [
    ("a.log", ["--out", "a.log"]), ("a.log", ["--out", "link.log"]), ("a.log", ["--out", "same.log"]),
    ("can_0001.log", ["--out", "can.log", "--rotate", "1kB"]), ("can_0002.log", ["--out", "can.log", "--rotate", "1s"]),
])
def test_log_that_is_converted_stays_whatever_name_it_has(salient_without_build, tmp_path, source, options):
    text = "(0.000001) can0 123#11\n" * 5000
    (tmp_path / source).write_text(text)
    (tmp_path / "link.log").symlink_to(source)
    (tmp_path / "same.log").hardlink_to(tmp_path / source)
    result = salient_without_build("log", "--convert", source, *options)
    assert (result.stdout, result.returncode) == ("", 2)
    assert result.stderr == (f"salient: --out {options[1]}: {source} is read, and would be overwritten; name another "
                             "file\n")
    assert (tmp_path / source).read_text() == text
    assert {path.name for path in tmp_path.iterdir()} == {source, "link.log", "same.log"}


def test_suffix_of_no_format_and_two_sources_are_refused(capsys):
    for options, words in ((["--out", "b.txt"], ["b.txt", ".asc, .mf4, .csv, .parquet, .blf or .log"]),
                           (["--convert", "a.log", "--can", "unix:x"], ["--can", "not allowed with", "--convert"])):
        with pytest.raises(SystemExit) as ended:
            make_parser().parse_args(["log", *options])
        message = capsys.readouterr().err
        assert ended.value.code == 2
        assert message.count("\n") == 1
        assert all(word in message for word in words), message
