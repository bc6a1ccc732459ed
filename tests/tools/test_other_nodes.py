"""A bus with nodes of other makers beside two drives: their signals, load, cycle times, and what stops."""

from __future__ import annotations

import csv
import math
import re
import struct
from collections import defaultdict

import can
import cantools
import numpy as np
import pytest
from full_load import FILLER, record, watch
from other_nodes import CLASSES, CYCLES_MS, NODES, databases, options, schedule, write_databases
from visitor import Visitor, nothing_is_cut_off, picture

from salient.bench.bench import Bench
from salient.bus.databases import load_databases
from salient.bus.frame_bits import BitRates
from salient.bus.log import write_logs
from salient.bus.signals import drive_database
from salient.bus.traffic import Traffic
from salient.machine.cache import bench_config

STOP_S = 0.61
DURATION_S = 0.95


@pytest.fixture(scope="module")
def bus_log(tmp_path_factory):
    """Folder with can.blf and the databases, the frames, and those that were sent: two drives, and three nodes of which
    the battery stops."""
    folder = tmp_path_factory.mktemp("bus")
    bench = Bench(bench_config({"drives": 2}), f"unix:{folder}/bus.sock")
    try:
        bench.drives[0].speed_reference_rpm = 600.0
        sent = []
        for time_ns, message in schedule(DURATION_S, dict.fromkeys(NODES["BMS"], STOP_S)):
            bench.run_for(max(0.0, time_ns * 1e-9 - bench.time_s))
            bench.send(message)
            sent.append((time_ns, message))
        bench.run_for(DURATION_S - bench.time_s)
        log = list(bench.log)
    finally:
        bench.close()
    write_logs(log, folder / "can.blf")
    write_databases(folder)
    return folder, log, sent


def of_files(folder):
    return options([folder / "brake.dbc", folder / "battery.dbc"])


def expected_values(log):
    """Values by MESSAGE.SIGNAL, in the order of the bus, as cantools decodes each frame."""
    found = defaultdict(list)
    for number, database in enumerate(databases()):
        for message in database.messages:
            name = f"battery:{message.name}" if number and message.name == "STATUS" else message.name
            for time_ns, frame in log:
                if (frame.arbitration_id, frame.is_extended_id) == (message.frame_id, message.is_extended_frame):
                    decoded = message.decode(bytes(frame.data), decode_choices=False)
                    for signal, value in decoded.items():
                        found[f"{name}.{signal}"].append((time_ns, float(value)))
    return found


def test_every_signal_of_the_other_nodes_is_decoded_as_cantools_does(salient_without_build, bus_log, tmp_path):
    folder, log, sent = bus_log
    second = tmp_path / "second.dbc"
    salient_without_build("machine", "saturating", "--dbc", second, "--node", "1", "--out", tmp_path)
    path = tmp_path / "can.csv"
    done = salient_without_build("log", "--convert", folder / "can.blf", "--out", path, *of_files(folder),
                                 "--dbc", second)
    assert (done.returncode, done.stderr) == (0, "")
    found = defaultdict(list)
    with path.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            seconds, _, nanoseconds = row["time_s"].partition(".")
            found[f"{row['message']}.{row['signal']}"].append(
                (int(seconds) * 10**9 + int(nanoseconds), float(row["value"]), row["name"], row["unit"]))
    expected = expected_values(log)
    assert len(expected) == 15 and sum(map(len, expected.values())) > 5 * len(sent) // 2
    for name, values in expected.items():
        assert [entry[0] for entry in found[name]] == [time_ns for time_ns, _ in values], name
        assert np.array([entry[1] for entry in found[name]]) == pytest.approx(
            np.array([value for _, value in values]), rel=1e-9), name
    assert {entry[2] for entry in found["WHEELS.quality"]} == {"bad", "fair", "good", "invalid"}
    assert {entry[3] for entry in found["WHEELS.front_left"]} == {"km/h"}
    speeds = [entry[1] for entry in found["DRIVE_MOTION.speed_rpm"]]
    assert speeds[-1] == pytest.approx(600.0, rel=0.005)
    of_second = {name for name in found if name.startswith("second:")}
    assert len(of_second) > 50 and len(found["second:DRIVE_STATUS.state"]) == len(found["DRIVE_STATUS.state"])


def test_mf4_has_the_signals_of_the_other_nodes(salient_without_build, bus_log, tmp_path):
    asammdf = pytest.importorskip("asammdf")
    folder, log, _ = bus_log
    path = tmp_path / "can.mf4"
    assert salient_without_build("log", "--convert", folder / "can.blf", "--out", path,
                                 *of_files(folder)).returncode == 0
    expected = expected_values(log)
    groups = {}
    with asammdf.MDF(path) as mdf:
        for index, group in enumerate(mdf.groups):
            for channel in group.channels[1:]:
                groups[f"{group.channel_group.acq_name}.{channel.name}"] = mdf.get(channel.name, index, raw=True)
    for name, values in expected.items():
        assert groups[name].samples.astype(float) == pytest.approx(np.array([value for _, value in values])), name
    assert groups["STATUS.torque"].unit == "N m"


def test_load_and_cycle_times_are_those_of_the_bus(bus_log):
    """The truth: frames that follow each other at once on the emulated bus are as far apart as they are long."""
    folder, log, _ = bus_log
    rates = BitRates(1_000_000)
    on_bus = [(time_ns, frame) for time_ns, frame in log if not 0x1F000000 <= frame.arbitration_id < 0x1F000800]
    gaps_ns = np.diff([time_ns for time_ns, _ in on_bus])
    lengths_ns = np.array([rates.duration_ns(frame) for _, frame in on_bus])
    assert np.all(gaps_ns >= lengths_ns[1:] - 0.5)
    assert np.count_nonzero(np.abs(gaps_ns - lengths_ns[1:]) < 0.5) > 0.3 * len(gaps_ns)
    traffic = Traffic(rates, load_databases([folder / "brake.dbc", folder / "battery.dbc"]))
    for time_ns, frame in log:
        traffic.add(time_ns, frame)
    report = traffic.total()
    assert report.load == pytest.approx(lengths_ns.sum() / (log[-1][0] - on_bus[0][0]), rel=0.01)
    assert report.frames == len(on_bus) and not report.unknown and report.errors == 0
    messages = {message.identifier: message for node in report.nodes for message in node.messages}
    for (identifier, is_extended), cycle_ms in CYCLES_MS.items():
        message = messages[f"{identifier:0{8 if is_extended else 3}X}"]
        assert message.expected_ns == cycle_ms * 1_000_000
        assert message.cycle_ns == pytest.approx(cycle_ms * 1e6, rel=0.01), message
    for identifier in ("180", "190"):  # DRIVE_STATUS of both drives
        assert messages[identifier].expected_ns == 4_000_000
        assert messages[identifier].cycle_ns == pytest.approx(4e6, rel=0.01)
    nodes = {node.name: node for node in report.nodes}
    assert {"ABS", "ESP", "BMS", "DRIVE", "DRIVE (node 1)", "HOST"} <= nodes.keys()
    assert [name for name, node in nodes.items() if node.is_silent] == ["BMS"]
    assert sum(node.share for node in report.nodes) == pytest.approx(report.load, rel=1e-9)


def test_a_node_that_stops_is_named_within_three_cycles(salient_without_build, bus_log):
    folder, log, _ = bus_log
    done = salient_without_build("monitor", "--replay", folder / "can.blf", *of_files(folder), "--signals",
                                 "WHEELS.front_left", "DIAGNOSIS", "battery:STATUS.state_of_charge")
    assert (done.returncode, done.stderr) == (0, "")
    events = re.findall(r"^ *([0-9.]+) s  (\w+): (.*)$", done.stdout, re.MULTILINE)
    assert [(node, text.partition(" since")[0]) for _, node, text in events] == [
        ("BMS", "battery:STATUS is missing"), ("BMS", "LIMITS is missing"), ("BMS", "the node is silent")]
    for (time_s, _, _), key in zip(events, NODES["BMS"], strict=False):
        last_s = max(time_ns for time_ns, frame in log if (frame.arbitration_id, frame.is_extended_id) == key) * 1e-9
        assert last_s < float(time_s) <= last_s + 0.003 * CYCLES_MS[key]
    times_s = [float(time_s) for time_s in re.findall(r"^ *([0-9.]+) s  ", done.stdout, re.MULTILINE)]
    assert times_s == sorted(times_s) and len(times_s) == 3 + 9  # events are between the lines of their time
    shown = " ".join(done.stdout.split())
    assert re.search(r"WHEELS.front_left +[0-9.]+ km/h DIAGNOSIS.page +[0-9]+ DIAGNOSIS.voltage [0-9.]+ V ", shown)
    assert re.search(r"bus +[0-9.]+ %, 2 missing$", done.stdout, re.MULTILINE)
    assert re.search(r"^ +136 battery:STATUS +[0-9]+ frames .* expected +20 ms, .* missing$", done.stdout, re.MULTILINE)




def write(path, messages="BO_ 300 WHEELS: 8 ABS\n SG_ speed : 0|8@1+ (1,0) [0|0] \"\" ABS\n", nodes="ABS", more=""):
    """A DBC of a file."""
    path.write_text(f'VERSION ""\nBU_: {nodes}\n{messages}{CLASSES}BA_ "GenMsgCycleTime" BO_ 300 10;\n{more}',
                    encoding="utf-8")
    return path


def wheels(length=8):
    return can.Message(arbitration_id=300, is_extended_id=False, data=bytes(length))


def rows(traffic):
    return {message.name: message for node in traffic.total().nodes for message in node.messages}


def test_a_message_that_is_back_is_told_and_its_pause_is_no_cycle(tmp_path):
    traffic = Traffic(BitRates(500_000), load_databases([write(tmp_path / "a.dbc")]))
    for time_ms in (0, 10, 20, 30, 80, 90, 110, 140):
        traffic.add(time_ms * 1_000_000, wheels())
    assert [(event.time_ns, event.text) for event in traffic.take_events()] == [
        (55_000_000, "ABS: WHEELS is missing since 0.0300 s (cycle 10 ms)"),
        (80_000_000, "ABS: WHEELS is back after 0.0500 s"),
        (135_000_000, "ABS: WHEELS is missing since 0.1100 s (cycle 10 ms)"),
        (140_000_000, "ABS: WHEELS is back after 0.0300 s")]
    found = rows(traffic)["WHEELS"]
    assert (found.cycle_ns, found.shortest_ns, found.longest_ns) == (12_000_000, 10_000_000, 20_000_000)
    traffic.advance(200_000_000)  # of a bus without any frame
    assert [event.time_ns for event in traffic.take_events()] == [165_000_000]
    traffic.add(10_000_000_000, wheels())
    traffic.add(0, wheels())  # another recording
    traffic.add(10_000_000, wheels())
    assert [event.text for event in traffic.take_events()] == ["ABS: WHEELS is back after 9.8600 s",
                                                               "time went back from 10.0000 s"]


@pytest.mark.parametrize("send_type", ["OnChange", "CyclicIfActive"])
def test_a_message_that_may_pause_is_not_missing(tmp_path, send_type):
    number = ["Cyclic", "OnChange", "CyclicIfActive"].index(send_type)
    path = write(tmp_path / "a.dbc", more=f'BA_ "GenMsgSendType" BO_ 300 {number};\n')
    traffic = Traffic(BitRates(500_000), load_databases([path]))
    for time_ms in (0, 10, 500):
        traffic.add(time_ms * 1_000_000, wheels())
    assert traffic.take_events() == []
    assert rows(traffic)["WHEELS"].expected_ns == 10_000_000


def test_a_period_of_the_drive_that_is_set_becomes_the_expected_one():
    status = drive_database().get_message_by_name("DRIVE_STATUS")
    frame = can.Message(arbitration_id=status.frame_id, is_extended_id=False, data=bytes(8))
    traffic = Traffic(BitRates(1_000_000))
    times_ms = [0, 4, 8, 12, 16, 20, *range(120, 1121, 100)]
    for time_ms in times_ms:
        traffic.add(time_ms * 1_000_000, frame)
    assert rows(traffic)["DRIVE_STATUS"].expected_ns == 100_000_000
    assert [event.text for event in traffic.take_events()] == [
        "DRIVE: DRIVE_STATUS is missing since 0.0200 s (cycle 4 ms)", "DRIVE: DRIVE_STATUS is back after 0.1000 s"]
    traffic.advance(1_371_000_000)
    assert [event.time_ns for event in traffic.take_events()] == [1_370_000_000]


def test_unknown_identifiers_and_wrong_lengths_are_counted_in_bounded_memory(tmp_path):
    traffic = Traffic(BitRates(500_000), load_databases([write(tmp_path / "a.dbc")]))
    for number in range(5000):
        traffic.add(number * 1_000_000, can.Message(arbitration_id=0x10000 + number, is_extended_id=True, data=b"1"))
    traffic.add(6_000_000_000, can.Message(arbitration_id=0x7E8, is_extended_id=False, data=b""))
    traffic.add(6_000_000_000, wheels(7))
    report = traffic.total()
    assert len(report.unknown) == 4096 and report.further_unknown == 5000 - 4096 + 1
    assert rows(traffic)["WHEELS"].state == "wrong length"


def test_a_flexible_data_rate_frame_is_decoded_and_takes_its_time(salient_without_build, tmp_path):
    """40 bytes: 17 + 12 bits of arbitration and end at 0.5 Mbit/s, 5 + 320 + 32 + 1 at 2 Mbit/s, and stuff bits."""
    database = write(tmp_path / "fd.dbc", "BO_ 300 WIDE: 40 ABS\n SG_ last : 304|16@1- (1,0) [0|0] \"\" ABS\n"
                                          " SG_ across : 70|60@0+ (1,0) [0|0] \"\" ABS\n")
    data = bytes([0x5A] * 38) + (-5).to_bytes(2, "little", signed=True)
    frame = can.Message(arbitration_id=300, is_extended_id=False, is_fd=True, bitrate_switch=True, data=data, dlc=40)
    write_logs([(10_000_000 * number, frame) for number in range(50)], tmp_path / "can.blf")
    done = salient_without_build("log", "--convert", tmp_path / "can.blf", "--out", tmp_path / "can.csv", "--dbc",
                                 database)
    assert (done.returncode, done.stderr) == (0, "")
    text = (tmp_path / "can.csv").read_text(encoding="utf-8")
    message = databases_of(database).get_message_by_name("WIDE")
    assert text.count("WIDE,last,-5,") == 50
    assert text.count(f"WIDE,across,{message.decode(data)['across']},") == 50
    duration_ns = BitRates(500_000, 2_000_000).duration_ns(frame)
    assert 29 * 2000 + 358 * 500 <= duration_ns <= (29 + 5) * 2000 + (358 + 4) * 500
    assert BitRates(500_000).duration_ns(frame) == pytest.approx(duration_ns + 1500 * 358, abs=1500 * 4)


def databases_of(path):
    return cantools.database.load_file(path, strict=False)


@pytest.mark.parametrize(
    ("files", "line"),
    [
        ({"a.dbc": None}, "--dbc a.dbc: no such file"),
        ({"a.dbc": "hello"}, "--dbc a.dbc: no valid DBC: Invalid syntax at line 1, column 1: \">>!<<hello\""),
        ({"a.dbc": "\0\1\2"}, "--dbc a.dbc: no valid DBC: "),
        ({"a.dbc": 'VERSION ""\nBO_ 300 M: 99999999 A\n'},
         "--dbc a.dbc: no valid DBC: M has 99999999 bytes, at most 100000"),
        ({"/dev/zero": None}, "--dbc /dev/zero: not a file"),
        ({"a.dbc": 'VERSION ""\nBU_: A\n'}, "--dbc a.dbc: no valid DBC: it defines no message"),
        ({"a.dbc": 'VERSION ""\nBO_ 1 M: 1 A\n\nBO_ 1 N: 1 A\n'},
         "--dbc a.dbc: no valid DBC: M has the identifier 001 of another message of the file"),
        ({"a.dbc": 'VERSION ""\nBO_ 300 M: 1 A\n', "b.dbc": 'VERSION ""\nBO_ 300 N: 1 B\n'},
         "--dbc b.dbc: N has the identifier 12C of M of a.dbc"),
        ({"a.dbc": 'VERSION ""\nBO_ 384 M: 1 A\n'},
         "--dbc a.dbc: M has the identifier 180 of DRIVE_STATUS of the drive with node number 0 (--node)"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("command", ["monitor", "log", "view", "scope"])
def test_a_database_that_cannot_be_used_is_one_line(salient_without_build, tmp_path, command, files, line):
    for name, text in files.items():
        if text is not None:
            (tmp_path / name).write_text(text, encoding="utf-8")
    done = salient_without_build(command, "--can", "unix:none", *options(list(files)))
    assert (done.stdout, done.returncode) == ("", 2)
    assert done.stderr.startswith(f"salient: {line}") and done.stderr.count("\n") == 1, done.stderr


SELECTED = """VERSION ""
BU_: A
BO_ 300 M: 8 A
 SG_ m M : 0|8@1+ (1,0) [0|0] "" A
 SG_ x m0 : 8|8@1+ (1,0) [0|0] "" A
"""


@pytest.mark.parametrize(
    ("statements", "reason"),
    [
        (('BA_DEF_ BO_ "GenMsgSendType" ENUM "a","b";', 'BA_DEF_DEF_ "GenMsgSendType" "a";',
          'BA_ "GenMsgSendType" BO_ 300 7;'),
         "line 8: the attribute 'GenMsgSendType' is 7: must be 0 to 1, as its list has"),
        (('BA_DEF_ BO_ "GenMsgSendType" ENUM "a","b";', 'BA_DEF_DEF_ "GenMsgSendType" "a";',
          'BA_ "GenMsgSendType" BO_ 300 "b";'),
         "line 8: the attribute 'GenMsgSendType' is 'b': must be a number"),
        (('BA_DEF_ BO_ "VFrameFormat" INT 0 99;', 'BA_DEF_DEF_ "VFrameFormat" 88;'),
         "line 7: the attribute 'VFrameFormat' is 88: must be 0 to 15, as its list has"),
        (('BA_ "Mine" BO_ 300 7;',), "line 6: the attribute 'Mine' is not defined (BA_DEF_)"),
        (('VAL_ 300 x 0 "a" 1.5 "b" ;',), "line 6: VAL_ names '1.5': must be a whole number"),
        (('BA_DEF_ SG_ "GenSigStartValue" STRING;', 'BA_ "GenSigStartValue" SG_ 300 x "abc";',
          'BO_ 301 N: 8 A', ' SG_ y : 0|8@1+ (0.5,0) [0|0] "" A', 'BA_ "GenSigStartValue" SG_ 301 y "abc";'),
         "the parser ends with TypeError: can't multiply sequence"),
        (('BA_DEF_ BO_ "SystemMessageLongSymbol" INT 0 9;', 'BA_ "SystemMessageLongSymbol" BO_ 300 3;'),
         "3 is no name of a message, signal or node"),
        (("SG_MUL_VAL_ 300 x m 0-5000000000;",), "x is there from 0 to 5000000000, at most 4096 values"),
        (("SG_MUL_VAL_ 300 x m " + ", ".join(["0-4000"] * 25) + ";",),
         "100025 values in ranges SG_MUL_VAL_, at most 100000"),
        (("BO_ 301 N: 8 A", ' SG_ y : 99999999999|8@1+ (1,0) [0|0] "" A'),
         "y has 8 bits from bit 99999999999 on, at most 800000"),
    ],
)  # fmt: skip
def test_a_statement_that_the_parser_does_not_take_is_named(salient_without_build, tmp_path, statements, reason):
    """Also of a number for which it would take hours or all memory."""
    (tmp_path / "a.dbc").write_text(SELECTED + "\n".join(statements) + "\n", encoding="utf-8")
    done = salient_without_build("monitor", "--can", "unix:none", "--dbc", "a.dbc")
    assert (done.stdout, done.returncode) == ("", 2)
    assert done.stderr.startswith(f"salient: --dbc a.dbc: no valid DBC: {reason}") and done.stderr.count("\n") == 1


@pytest.fixture
def decoded(salient_without_build, tmp_path):
    """Values of a log by message and signal, as text, and what was said, for a database and frames."""
    def decode(database, frames):
        (tmp_path / "a.dbc").write_bytes(database if isinstance(database, bytes) else database.encode())
        write_logs([(number * 1_000_000, can.Message(arbitration_id=identifier, is_extended_id=identifier > 0x7FF,
                                                     data=data)) for number, (identifier, data) in enumerate(frames)],
                   tmp_path / "can.blf")
        done = salient_without_build("log", "--convert", "can.blf", "--out", "can.csv", "--dbc", "a.dbc")
        assert done.returncode == 0, done.stderr
        found = defaultdict(list)
        with (tmp_path / "can.csv").open(encoding="utf-8") as file:
            for row in csv.DictReader(file):
                found[f"{row['message']}.{row['signal']}"].append(row["value"])
        return found, done.stderr
    return decode


DBC = 'VERSION ""\nBU_: A\nBO_ 300 M: 8 A\n{}'


def test_wide_whole_numbers_keep_all_digits(decoded):
    found, _ = decoded(DBC.format(' SG_ u : 0|64@1+ (1,0) [0|0] "" A\n'
                                  '\nBO_ 301 N: 8 A\n SG_ s : 7|64@0- (2,1) [0|0] "" A\n'
                                  '\nBO_ 302 O: 8 A\n SG_ t : 0|48@1+ (0.001,0) [0|0] "s" A\n'),
                       [(300, b"\xff" * 8), (300, b"\1" + bytes(6) + b"\x80"), (301, b"\x80" + bytes(6) + b"\1"),
                        (302, (170_000_000_123_456).to_bytes(8, "little"))])
    assert found == {"M.u": [str(2**64 - 1), str(2**63 + 1)], "N.s": [str(2 * (1 - 2**63) + 1)],
                     "O.t": ["170000000123.456"]}


def test_signals_of_one_name_are_told_apart(decoded):
    found, said = decoded(DBC.format(' SG_ m M : 0|8@1+ (1,0) [0|0] "" A\n SG_ x m0 : 8|8@1+ (1,0) [0|0] "" A\n'
                                     ' SG_ x m1 : 16|8@1+ (2,0) [0|0] "" A\n'),
                          [(300, bytes([0, 5, 6, 0, 0, 0, 0, 0])), (300, bytes([1, 5, 6, 0, 0, 0, 0, 0]))])
    assert found == {"M.m": ["0", "1"], "M.x": ["5"], "M.x_2": ["12"]}
    assert said == "salient: --dbc a.dbc: M has several signals x; the one of bit 16 is x_2\n"


def test_what_no_frame_carries_is_left_out_with_a_line(decoded):
    found, said = decoded(DBC.format(' SG_ x : 0|8@1+ (1,0) [0|0] "" A\n SG_ y : 60|8@1+ (1,0) [0|0] "" A\n'
                                     '\nBO_ 301 LONG: 200 A\n SG_ z : 0|8@1+ (1,0) [0|0] "" A\n'),
                          [(300, bytes(range(1, 9)))])
    assert found == {"M.x": ["1"]}
    assert sorted(said.splitlines()) == [
        "salient: --dbc a.dbc: LONG has 200 bytes, a frame at most 64, and is left out",
        "salient: --dbc a.dbc: M.y is beyond the 8 bytes of the message and is left out"]


@pytest.mark.parametrize(("signal", "left"), [
    ("x : 0|64@1+ (1e308,0)", {}), ("x : 0|64@1- (1,1e400)", {}), (f"x : 0|8@1+ (1{'0' * 400},0)", {}),
    ("x : 0|8@1+ (1e300,0)", {"M.x": ["2.55e+302"]}),
])
@pytest.mark.filterwarnings("error")
def test_values_beyond_a_float_are_left_out_with_a_line(decoded, signal, left):
    found, said = decoded(DBC.format(f' SG_ {signal} [0|0] "" A\n SG_ y : 0|8@1+ (1,0) [-1e400|1e400] "" A\n')
                          + f'VAL_ 300 y 1{"0" * 400} "never" 255 "all" ;\n', [(300, b"\xff" * 8)])
    assert found == {**left, "M.y": ["255"]}
    assert said == ("" if left else "salient: --dbc a.dbc: M.x has values beyond a floating-point number of 64 bits by "
                    "its factor and offset and is left out\n")


@pytest.mark.filterwarnings("error")
def test_a_float_is_infinite_by_its_bits_and_by_nothing_else(decoded):
    found, said = decoded(DBC.format(' SG_ x : 0|64@1- (3,0) [0|0] "" A\n') + "SIG_VALTYPE_ 300 x : 2;\n",
                          [(300, struct.pack("<d", value)) for value in (1.5, 1e308, math.inf, -math.nan)])
    assert (found, said) == ({"M.x": ["4.5", "inf", "inf", "nan"]}, "")


@pytest.mark.parametrize(("signals", "statement", "out"), [
    (("m M : 60", "x m0 : 8"), "",
     ("M.m is beyond the 8 bytes of the message", "M.x is selected by m, which no frame has,")),
    (("m M : 0", "x m0M : 8", "y m0M : 16"), "SG_MUL_VAL_ 300 x y 0-5;\nSG_MUL_VAL_ 300 y x 0-5;",
     ("M.x is selected by y, which no frame has,", "M.y is selected by x, which no frame has,")),
])  # fmt: skip
def test_signals_without_their_multiplexer_are_left_out_with_a_line(decoded, signals, statement, out):
    found, said = decoded(DBC.format("".join(f' SG_ {each}|8@1+ (1,0) [0|0] "" A\n' for each in (*signals, "z : 24")))
                          + f"{statement}\n", [(300, bytes(8))])
    assert "M.x" not in found and found["M.z"] == ["0"]
    assert said.splitlines() == [f"salient: --dbc a.dbc: {line} and is left out" for line in out]


@pytest.mark.parametrize(("kind", "value", "shown"), [
    ("STRING", '"often"', "'often'"), ("INT -9 9", "-5", "-5"), ("FLOAT 0 9", "1e400", "inf")])
def test_cycle_time_that_is_none_is_left_out_with_a_line(salient_without_build, tmp_path, kind, value, shown):
    (tmp_path / "a.dbc").write_text(DBC.format(' SG_ x : 0|8@1+ (1,0) [0|0] "" A\n')
                                    + f'BA_DEF_ BO_ "GenMsgCycleTime" {kind};\nBA_DEF_DEF_ "GenMsgCycleTime" '
                                    f'{value};\nBA_ "GenMsgCycleTime" BO_ 300 {value};\n')
    write_logs([(number * 1_000_000, can.Message(arbitration_id=300, is_extended_id=False, data=bytes(8)))
                for number in range(3)], tmp_path / "can.blf")
    done = salient_without_build("monitor", "--replay", "can.blf", "--dbc", "a.dbc")
    assert (done.returncode, done.stderr) == (
        0, f"salient: --dbc a.dbc: M has the cycle time {shown}, which is left out; it is a number of ms from 0 to "
        "1000000000\n")
    assert re.search(r"12C M +3 frames  cycle +1.000 ms, 1.000 to 1.000 ms$", done.stdout, re.MULTILINE), done.stdout


def test_frames_that_are_too_short_are_counted(decoded):
    found, said = decoded(DBC.format(' SG_ x : 0|8@1+ (1,0) [0|0] "" A\n'),
                          [(300, bytes(8)), (300, b"\1"), (300, b"\1")])
    assert found == {"M.x": ["0"]}
    assert said == "salient: --convert can.blf: left out as too short for --dbc: 2 frames of M (1 instead of 8 bytes)\n"


def test_a_database_in_utf_16_is_read(decoded):
    assert decoded(DBC.format(' SG_ x : 0|8@1+ (1,0) [0|0] "\u00b0C" A\n').encode("utf-16"), [(300, bytes(8))]) == (
        {"M.x": ["0"]}, "")


J1939 = ('VERSION ""\nBU_: A\nBO_ 2364540158 EEC1: 8 A\n SG_ speed : 24|16@1+ (0.125,0) [0|8031.875] "rpm" A\n\n'
         'BO_ 2348810494 TSC1: 8 A\n SG_ torque : 24|8@1+ (1,-125) [-125|125] "%" A\n\n'
         'BO_ 2566834944 DM1: 8 A\n SG_ lamp : 0|8@1+ (1,0) [0|255] "" A\n'
         'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
         'BA_DEF_DEF_ "VFrameFormat" "J1939PG";\n')
J1939_FRAMES = [(0x0CF00400, bytes([0, 0, 0, 0x40, 0x1F, 0, 0, 0])),  # EEC1 of an engine
                (0x18F00431, bytes([0, 0, 0, 0x80, 0x3E, 0, 0, 0])),  # with another priority
                (0x0C002903, bytes([0, 0, 0, 135, 0, 0, 0, 0])),  # TSC1 to another destination
                (0x0CF00500, bytes(8)), (0x18FECA31, bytes(8))]
"""The last two are of another group, and of another source than the one that the database names."""


def test_j1939_is_decoded_by_its_parameter_group(decoded, salient_without_build, tmp_path):
    frames = J1939_FRAMES * 20
    found, said = decoded(J1939, frames)
    assert found == {"EEC1.speed": ["1000", "2000"] * 20, "TSC1.torque": ["10"] * 20} and said == ""
    done = salient_without_build("monitor", "--replay", "can.blf", "--dbc", "a.dbc", "--bus")
    assert done.returncode == 0
    table = done.stdout.split("\nbus ")[-1]
    assert re.findall(r"^ +(\w+) (EEC1|TSC1|DM1) ", table, re.MULTILINE) == [
        ("0C002903", "TSC1"), ("0CF00400", "EEC1"), ("18F00431", "EEC1")]


def test_the_page_decodes_j1939_by_its_parameter_group(browser, serve, tmp_path):
    (tmp_path / "a.dbc").write_text(J1939, encoding="utf-8")
    write_logs([(number * 1_000_000, can.Message(arbitration_id=identifier, data=data))
                for number, (identifier, data) in enumerate(J1939_FRAMES * 20)], tmp_path / "can.blf")
    visitor = Visitor(browser, serve("--replay", tmp_path / "can.blf", "--dbc", tmp_path / "a.dbc"))
    visitor.wait("salient.store.frames >= 100")
    found = visitor.page.evaluate("""["EEC1.speed", "TSC1.torque", "DM1.lamp"].map((name) => {
        const series = salient.store.watch(name);
        return [...series.value.subarray(0, series.size)];
    })""")
    assert found == [[1000, 2000] * 20, [10] * 20, []]
    visitor.page.close()
    assert visitor.errors == []


def test_a_database_without_a_node_is_told_and_its_messages_are_those_of_the_file(salient_without_build, tmp_path):
    text = 'VERSION ""\nBU_:\nBO_ 300 STATUS: 1 Vector__XXX\n SG_ x : 0|8@1+ (1,0) [0|0] "" Vector__XXX\n'
    for name, identifier in (("one.dbc", 300), ("two.dbc", 301)):
        (tmp_path / name).write_text(text.replace("300", str(identifier)), encoding="utf-8")
    write_logs([(number * 10_000_000, can.Message(arbitration_id=300 + number % 2, is_extended_id=False, data=b"\7"))
                for number in range(50)], tmp_path / "can.log")
    done = salient_without_build("monitor", "--replay", "can.log", *options(["one.dbc", "two.dbc"]), "--bus")
    assert done.returncode == 0
    assert done.stderr == "".join(f"salient: --dbc {name}.dbc: names no node that sends: its messages are those of "
                                  f"{name}\n" for name in ("one", "two"))
    table = done.stdout.split("\nbus ")[-1]
    assert re.search(r"^  one: [0-9.]+ %\n +12C STATUS .*\n  two: [0-9.]+ %\n +12D two:STATUS ", table, re.MULTILINE)


def test_a_log_of_other_nodes_alone_is_converted_and_one_of_nobody_is_not(salient_without_build, tmp_path):
    paths = write_databases(tmp_path)
    write_logs(schedule(0.5), tmp_path / "can.blf")
    write_logs([(0, can.Message(arbitration_id=0x700, data=b"1"))], tmp_path / "none.log")
    done = salient_without_build("log", "--convert", "can.blf", "--out", "can.csv", *options(paths))
    assert (done.returncode, done.stderr) == (0, "")
    assert "ABS" not in done.stdout and "WHEELS,quality" in (tmp_path / "can.csv").read_text(encoding="utf-8")
    for command in (["monitor", "--replay", "none.log"], ["log", "--convert", "none.log", "--out", "none.csv"]):
        done = salient_without_build(*command, *options(paths))
        assert done.returncode == 1
        assert "of a drive with node number 0 (--node) or of the messages of --dbc" in done.stderr
    assert salient_without_build("log", "--convert", "can.blf", "--out", "can.csv").returncode == 1


@pytest.mark.in_turns
@pytest.mark.parametrize(("suffix", "seconds", "rotation"), [(".blf", 12.0, "400kB"), (".csv", 4.0, "1s")])
def test_full_load_with_rotation_loses_nothing_in_constant_memory(tmp_path, suffix, seconds, rotation):
    bus, files = record(tmp_path, seconds, rotation, suffix)
    assert len(files) >= 3
    assert bus.count > 8000 * seconds
    assert bus.memory_bytes[-1] < max(bus.memory_bytes[:2]) + 20e6
    if suffix == ".csv":
        with_values = sum(path.read_text(encoding="utf-8").count(",DIAGNOSIS,page,") for path in files)
        assert with_values == round(seconds * 1000 / 25)
        return
    traffic, count, digest, memory_bytes = watch(tmp_path, files)
    assert (count, digest) == (bus.count, bus.digest)
    assert memory_bytes[-1] < memory_bytes[0] + 20e6
    report = traffic.total()
    assert report.load == pytest.approx(1.0, abs=1e-3) and len(report.unknown) == len(FILLER)
    for message in (message for node in report.nodes for message in node.messages if message.expected_ns):
        if message.name != "REQUEST":  # sent on change
            assert message.cycle_ns == pytest.approx(message.expected_ns, rel=1e-3)


def test_the_page_has_the_signals_of_the_other_nodes_and_the_traffic(browser, serve, bus_log):
    folder, log, _ = bus_log
    visitor = Visitor(browser, serve("--replay", folder / "can.blf", *of_files(folder)))
    visitor.wait(f"salient.store.frames >= {len(log)}")
    page = visitor.page
    found = page.evaluate("""(names) => names.map((name) => {
        const series = salient.store.watch(name);
        return [...series.value.subarray(0, series.size)];
    })""", list(expected := expected_values(log)))
    for values, (name, wanted) in zip(found, expected.items(), strict=True):
        assert values == pytest.approx([value for _, value in wanted], rel=1e-9), name
    visitor.tab("Bus")
    visitor.wait("document.getElementById('bus-messages').innerText.includes('WHEELS')")
    rows = [row.split("\t") for row in page.locator("#bus-messages tbody tr").all_inner_texts()]
    by_name = {" ".join(row[0].split()): row[1:] for row in rows if len(row) == 4}
    assert float(by_name["WHEELS 12C"][1]) == pytest.approx(10.0, rel=0.01) and by_name["WHEELS 12C"][2] == "10"
    assert by_name["battery:STATUS 136"][2] == by_name["LIMITS 137"][2] == "missing"
    assert by_name["DRIVE_STATUS 180"][2] == "4"
    assert any(row[0].startswith("BMS: ") and row[0].endswith(", silent") for row in rows)
    events = page.locator("#bus-events tr").all_inner_texts()
    assert "the node is silent" in events[0] and "battery:STATUS is missing since 0.60" in events[-1]
    page.locator("#bus-events button").last.click()
    visitor.wait("salient.timeline.start_ns < 6.6e8 && salient.timeline.end_ns > 6.6e8")
    visitor.tab("Signals")
    page.fill("#signal-filter", "WHEELS")
    page.get_by_label("front_left").check()
    visitor.tab("Bus")
    assert nothing_is_cut_off(page) == []
    page.screenshot(path=picture("bus"))
    page.set_viewport_size({"width": 390, "height": 844})
    assert nothing_is_cut_off(page) == []
    page.close()
    assert visitor.errors == []


def test_the_page_of_a_bus_shows_the_traffic_of_the_last_half_second(browser, make_bench, serve, tmp_path):
    paths = write_databases(tmp_path)
    bench = make_bench()
    bench.run_for(0.02)
    visitor = Visitor(browser, serve("--can", bench.address, *options(paths)), bench)
    for time_ns, message in schedule(1.4, dict.fromkeys(NODES["ABS"], 0.7)):
        bench.run_for(max(0.0, 0.02 + time_ns * 1e-9 - bench.time_s))
        bench.send(message)
    visitor.catch_up()
    visitor.tab("Bus")
    visitor.wait("/ABS: [0-9.]+ %, silent/.test(document.getElementById('bus-messages').textContent)")
    assert "Load " in visitor.page.inner_text("#bus-load")
    assert "WHEELS is missing since" in visitor.page.inner_text("#bus-events")
    visitor.page.close()
    assert visitor.errors == []
