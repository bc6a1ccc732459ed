"""Nodes of other makers for tests of a bus: their DBCs, and senders that keep their cycles in the time of a bench."""

from __future__ import annotations

import heapq
import random
from collections.abc import Iterator
from pathlib import Path

import can
import cantools

CLASSES = """BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ BO_ "GenMsgSendType" ENUM "Cyclic","OnChange","CyclicIfActive","NoMsgSendType";
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "GenMsgSendType" "NoMsgSendType";
"""
BRAKE = f"""VERSION ""
BU_: ABS ESP
BO_ 300 WHEELS: 8 ABS
 SG_ front_left : 7|16@0+ (0.01,0) [0|655.35] "km/h" ESP
 SG_ front_right : 18|11@0- (0.5,-10) [0|0] "km/h" ESP
 SG_ yaw_rate : 28|17@1- (0.25,3) [0|0] "deg/s" ESP
 SG_ quality : 56|2@1+ (1,0) [0|3] "" ESP
BO_ 301 STATUS: 5 ABS
 SG_ temperature : 0|8@1- (1,-40) [0|0] "degC" ESP
 SG_ torque : 8|32@1- (1,0) [0|0] "N m" ESP
BO_ 2566844926 DIAGNOSIS: 8 ESP
 SG_ page M : 0|4@1+ (1,0) [0|15] "" ABS
 SG_ voltage m0 : 15|16@0+ (0.1,0) [0|0] "V" ABS
 SG_ part m1M : 8|4@1+ (1,0) [0|15] "" ABS
 SG_ serial m0 : 16|20@1+ (1,0) [0|0] "" ABS
 SG_ current m1 : 16|32@1- (0.001,0) [0|0] "A" ABS
BO_ 2566844927 REQUEST: 2 ESP
 SG_ what : 0|16@1+ (1,0) [0|0] "" ABS
CM_ BO_ 300 "Speeds of the wheels";
{CLASSES}BA_ "GenMsgCycleTime" BO_ 300 10;
BA_ "GenMsgSendType" BO_ 300 0;
BA_ "GenMsgCycleTime" BO_ 301 100;
BA_ "GenMsgCycleTime" BO_ 2566844926 25;
BA_ "GenMsgSendType" BO_ 2566844927 1;
BA_ "GenMsgCycleTime" BO_ 2566844927 5;
SIG_VALTYPE_ 301 torque : 1;
VAL_ 300 quality 0 "bad" 1 "fair" 2 "good" 3 "invalid" ;
VAL_ 301 temperature 127 "sensor_fault" ;
SG_MUL_VAL_ 2566844926 serial part 2-3;
SG_MUL_VAL_ 2566844926 part page 1-1;
SG_MUL_VAL_ 2566844926 voltage page 0-0;
SG_MUL_VAL_ 2566844926 current page 2-5, 7-7;
"""
"""Big-endian, signed, floating-point, multiplexed, doubly multiplexed signals, named values, extended identifiers."""
BATTERY = f"""VERSION ""
BU_: BMS DRIVE
BO_ 310 STATUS: 8 BMS
 SG_ state_of_charge : 0|10@1+ (0.1,0) [0|100] "%" DRIVE
 SG_ counter : 12|4@1+ (1,0) [0|15] "" DRIVE
 SG_ energy : 23|48@0+ (0.001,0) [0|0] "Wh" DRIVE
BO_ 311 LIMITS: 8 BMS
 SG_ power : 0|64@1- (1,0) [0|0] "W" DRIVE
{CLASSES}BA_ "GenMsgCycleTime" BO_ 310 20;
BA_ "GenMsgCycleTime" BO_ 311 50;
"""
"""Its STATUS is another one than the first file's."""
CYCLES_MS = {(300, False): 10, (301, False): 100, (2566844926 & 0x1FFFFFFF, True): 25, (310, False): 20,
             (311, False): 50}
NODES = {"ABS": [(300, False), (301, False)], "ESP": [(2566844926 & 0x1FFFFFFF, True)],
         "BMS": [(310, False), (311, False)]}


def write_databases(folder: Path) -> list[Path]:
    """The two files."""
    paths = [folder / "brake.dbc", folder / "battery.dbc"]
    for path, text in zip(paths, (BRAKE, BATTERY), strict=True):
        path.write_text(text, encoding="cp1252")
    return paths


def databases() -> list[cantools.database.can.Database]:
    """As cantools reads them."""
    return [cantools.database.load_string(text, "dbc", strict=False) for text in (BRAKE, BATTERY)]


def options(paths: list[Path]) -> list[str | Path]:
    """--dbc of each."""
    return [word for path in paths for word in ("--dbc", path)]


def schedule(duration_s: float, stops_s: dict[tuple[int, bool], float] | None = None, seed: int = 1
             ) -> Iterator[tuple[int, can.Message]]:
    """Time in ns at which a frame is sent, and frame, of both nodes in their cycles; stops_s: when a message ends."""
    generator = random.Random(seed)
    lengths = {(m.frame_id, m.is_extended_frame): m.length for each in databases() for m in each.messages}
    due = [(1_000_000 + 137_000 * number, number, key) for number, key in enumerate(CYCLES_MS)]
    heapq.heapify(due)
    while due[0][0] < duration_s * 1e9:
        time_ns, number, key = heapq.heappop(due)
        if time_ns >= (stops_s or {}).get(key, duration_s + 1.0) * 1e9:
            if not due:
                return
            continue
        data = bytearray(generator.randbytes(lengths[key]))
        if key[1]:
            data[0] = data[0] & 0xF0 | generator.choice((0, 1, 2, 3, 4, 5, 7))  # pages that are defined
            data[1] = data[1] & 0xF0 | generator.choice((2, 3))
        if key == (301, False):
            data[1:5] = b"\0\0" + data[3:5].replace(b"\x7f", b"\x40").replace(b"\xff", b"\x41")  # a number
        yield time_ns, can.Message(arbitration_id=key[0], is_extended_id=key[1], data=data)
        heapq.heappush(due, (time_ns + CYCLES_MS[key] * 1_000_000, number, key))
