"""Logs of every format, damaged at random: bytes changed, lost, repeated, zeroed by a power cut, numbers replaced by
extreme ones. Each is read to its end or its damage, with bounded work and memory, one line that says where, and the
frames before the damage as they were.

    build/venv/bin/python tests/tools/log_mutations.py [COUNT] [FORMAT...]

tries COUNT mutations (10^4) of each format, under limits of memory and processor time, and goes on where a former run
ended: `build/log_mutations/FORMAT` counts. A mutation is repeated by its number: mutated(format, number).
"""

from __future__ import annotations

import gzip
import random
import resource
import struct
import sys
import tempfile
import zlib
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path

import can
from can.io import MF4Writer, blf
from mf4_files import START_NS as MF4_START_NS
from mf4_files import Layout, bus_logging

from salient.bus.log import AscLog, BlfLog, CandumpLog
from salient.bus.log_reader import LogDamaged, read_log
from salient.errors import UsageError
from salient.paths import BUILD

COUNT = 10_000
FRAMES = 60
START_NS = 1_700_000_000_123_456_000
MEMORY_MAX = 3 << 30
CPU_S_EACH = 2
"""Processor time of a mutation in the mean, with a multiple of what one takes; one that does not end exceeds it."""
ORDER = ("arbitration_id", "is_extended_id", "is_remote_frame", "is_error_frame", "is_fd", "bitrate_switch",
         "error_state_indicator", "dlc", "data")
NUMBERS = (0, 1, 0x7F, 0x80, 0xFF, 0xFFF0, 0x7FFFFFFF, 0xFFFFFFF0, 0xFFFFFFFF, 1 << 62, (1 << 64) - 1)

Timed = tuple[int, list[object]]


def content(message: can.Message) -> list[object]:
    """Content of a frame, without time and channel."""
    return [getattr(message, name) for name in ORDER]


def frames(classic: bool = False) -> Iterator[tuple[int, can.Message]]:
    """Frames of every kind, 1.001 ms apart. classic: without frames of flexible data rate."""
    for number in range(FRAMES):
        kind = number % 6
        yield START_NS + number * 1_001_000, can.Message(
            arbitration_id=0x180 + number % 16 + (0x1F000000 if kind == 1 else 0), is_extended_id=kind == 1,
            is_remote_frame=kind == 2, is_fd=kind == 3 and not classic, bitrate_switch=kind == 3 and not classic,
            dlc=3 if kind == 2 else 8, data=b"" if kind == 2 else bytes((number + i) % 256 for i in range(8)))


def _written(make: Callable[[Path], BlfLog | AscLog | CandumpLog], suffix: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"log{suffix}"
        log = make(path)
        for timed in frames():
            log.write(*timed)
        log.close()
        return path.read_bytes()


def _objects() -> tuple[bytes, bytes]:
    """The header of a BLF file, and its objects without containers."""
    data = _written(BlfLog, ".blf")
    return data[:144], zlib.decompress(data[144 + 32 :])


def in_containers(header: bytes, objects: bytes, size: int = 300) -> bytes:
    """A BLF file with containers of a size."""
    body = b""
    for begin in range(0, len(objects), size):
        part = zlib.compress(objects[begin : begin + size])
        length = 32 + len(part)
        body += blf.OBJ_HEADER_BASE_STRUCT.pack(b"LOBJ", 16, 1, length, blf.LOG_CONTAINER)
        body += blf.LOG_CONTAINER_STRUCT.pack(blf.ZLIB_DEFLATE, len(objects[begin : begin + size])) + part
        body += bytes(length % 4)
    return header[:16] + struct.pack("<Q", len(header) + len(body)) + header[24:] + body


def _trc() -> bytes:
    lines = [";$FILEVERSION=2.1", ";$STARTTIME=45244.9259", ";$COLUMNS=N,O,T,B,I,d,R,L,D", ";"]
    for number, (time_ns, message) in enumerate(frames(), 1):
        identifier = f"{message.arbitration_id:0{8 if message.is_extended_id else 4}X}"
        kind = "RR" if message.is_remote_frame else "FB" if message.is_fd else "DT"
        lines.append(f"{number:7} {(time_ns - START_NS) / 1e6:13.3f} {kind} 1 {identifier:>8} Rx -  {message.dlc:<4} "
                     f"{bytes(message.data).hex(' ').upper()}".rstrip())
    return "\r\n".join([*lines, ""]).encode()


def _busmaster() -> bytes:
    lines = ["***BUSMASTER Ver 3.2.2***", "***PROTOCOL CAN***", "***HEX***", "***SYSTEM MODE***",
             "***<Time><Tx/Rx><Channel><CAN ID><Type><DLC><DataBytes>***"]
    for number, (_, message) in enumerate(frames(classic=True)):
        kind = ("x" if message.is_extended_id else "s") + ("r" if message.is_remote_frame else "")
        lines.append(f"11:08:{number // 100:02}:{number * 100:04} Rx 1 0x{message.arbitration_id:X} {kind} "
                     f"{message.dlc} {bytes(message.data).hex(' ').upper()}".rstrip())
    return "\r\n".join([*lines, "***[STOP LOGGING SESSION]***", ""]).encode()


def _savvycan() -> bytes:
    lines = ["Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8"]
    for time_ns, message in frames(classic=True):
        if not message.is_remote_frame:
            lines.append(f"{time_ns // 1000},{message.arbitration_id:08X},{str(message.is_extended_id).lower()},Rx,0,8,"
                         f"{bytes(message.data).hex(',').upper()},")
    return "\n".join([*lines, ""]).encode()


def _canedge() -> bytes:
    lines = ["TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS;DataBytes"]
    for time_ns, message in frames():
        if not message.is_remote_frame:
            lines.append(f"{time_ns // 1_000_000_000}.{time_ns % 1_000_000_000 // 1000:06};1;"
                         f"{message.arbitration_id:X};{message.is_extended_id:d};8;8;0;{message.is_fd:d};{message.bitrate_switch:d};"
                         f"{bytes(message.data).hex().upper()}")
    return "\n".join([*lines, ""]).encode()


def _printed() -> bytes:
    lines = []
    for time_ns, message in frames():
        message.timestamp = (time_ns - START_NS) * 1e-9
        lines.append(f"{message}\n")
    return "".join(lines).encode()


def _mf4() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mf4"
        with MF4Writer(path) as log:
            for time_ns, message in frames():
                message.timestamp = time_ns * 1e-9
                log.on_message_received(message)
        return path.read_bytes()


def _mf4_of(layout: Layout) -> tuple[bytes, list[int]]:
    """As loggers write it, structure first, and the end of each frame."""
    return bus_logging([(MF4_START_NS + time_ns - START_NS, message) for time_ns, message in frames()], layout)


def _mf4_mixed() -> tuple[bytes, list[int]]:
    return _mf4_of(Layout(is_finished=False))


ORIGINALS: dict[str, tuple[str, Callable[[], bytes]]] = {
    "candump": (".log", lambda: _written(CandumpLog, ".log")),
    "asc": (".asc", lambda: _written(AscLog, ".asc")),
    "trc": (".trc", _trc),
    "busmaster": (".log", _busmaster),
    "savvycan": (".csv", _savvycan),
    "canedge": (".csv", _canedge),
    "printed": (".txt", _printed),
    "blf": (".blf", lambda: in_containers(*_objects())),
    "blf_objects": (".blf", lambda: b"".join(_objects())),
    "gz": (".log.gz", lambda: gzip.compress(_written(CandumpLog, ".log"), mtime=0)),
    "mf4": (".mf4", _mf4),
    "mf4_mixed": (".mf4", lambda: _mf4_mixed()[0]),
    "mf4_compressed": (".mf4", lambda: _mf4_of(Layout(block_bytes=600, compression=1))[0]),
}
"""Format: suffix and an intact log. The objects of blf_objects are mutated before they are compressed; the second of
MF4 is the log of a logger whose power was cut."""


@lru_cache
def original(name: str) -> bytes:
    """An intact log."""
    return ORIGINALS[name][1]()


def mutated(name: str, number: int) -> tuple[bytes, int]:
    """A damaged log, and the first byte that is another one."""
    chance = random.Random(f"{name} {number}")
    data = original(name)
    first = len(data)
    for _ in range(chance.choice((1, 1, 1, 2, 5))):
        at = chance.randrange(144 if name == "blf_objects" else 0, len(data) or 1)
        data = chance.choice((_change, _change, _number, _cut, _lose, _repeat, _zero))(data, at, chance)
        first = min(first, at)
        if len(data) <= 200:
            break
    if name == "blf_objects":
        data = in_containers(data[:144], data[144:], chance.choice((300, 5000)))
    return data, first


def _change(data: bytes, at: int, chance: random.Random) -> bytes:
    return data[:at] + bytes([data[at] ^ 1 << chance.randrange(8) if chance.random() < 0.5 else chance.randrange(256)]
                             ) + data[at + 1 :]


def _number(data: bytes, at: int, chance: random.Random) -> bytes:
    size = chance.choice((1, 2, 4, 8))
    return data[:at] + (chance.choice(NUMBERS) % (1 << 8 * size)).to_bytes(size, "little") + data[at + size :]


def _cut(data: bytes, at: int, chance: random.Random) -> bytes:
    return data[:at]


def _lose(data: bytes, at: int, chance: random.Random) -> bytes:
    return data[:at] + data[at + chance.randrange(1, 200) :]


def _repeat(data: bytes, at: int, chance: random.Random) -> bytes:
    size = chance.randrange(1, 200)
    return data[: at + size] + data[at:]


def _zero(data: bytes, at: int, chance: random.Random) -> bytes:
    size = chance.choice((1, 16, 512, 1 << 20))
    return data[:at] + bytes(min(size, len(data) - at)) + data[at + size :]


@lru_cache
def expected(name: str) -> list[Timed]:
    """The frames of an intact log."""
    with tempfile.TemporaryDirectory() as folder:
        data = original(name)
        found, end = read(Path(folder), name, data if name != "blf_objects" else in_containers(data[:144], data[144:]))
    assert not end and len(found) >= FRAMES * 5 // 6, (name, end, len(found))
    return found


def read(folder: Path, name: str, data: bytes) -> tuple[list[Timed], str]:
    """The frames of a log, and the line at its damage."""
    suffix = ORIGINALS[name][0]
    path = folder / f"log{suffix}"
    path.write_bytes(data)
    found: list[Timed] = []
    # A frame takes some bytes of each format; deflate has at most 1032 for one.
    limit = len(data) * (1032 if name in ("blf", "blf_objects", "gz") or suffix == ".mf4" else 1) // 8 + 1
    try:
        for time_ns, message in read_log(path):
            found.append((time_ns, content(message)))
            assert len(found) <= limit, "more frames than the file has bytes for"
    except (UsageError, LogDamaged) as error:
        return found, str(error)
    return found, ""


def intact(name: str, first: int) -> int:
    """The number of frames before a byte."""
    data = original(name)
    if name in ("candump", "asc", "trc", "busmaster", "savvycan", "canedge", "printed"):
        before = data[:first].split(b"\n")[:-1]
        in_all = sum(_is_frame(name, line) for line in data.split(b"\n"))
        assert in_all == len(expected(name)), (in_all, name)
        return sum(_is_frame(name, line) for line in before)
    at, objects = 144, 0
    if name == "blf_objects":
        while at < len(data) and (at := at + struct.unpack_from("<L", data, at + 8)[0]) <= first:
            objects += 1
        return objects
    if name == "blf":
        whole = 0
        while at < len(data):
            size = struct.unpack_from("<L", data, at + 8)[0]
            at += size + size % 4
            if at > first:
                break
            whole += 300
        sizes = _objects()[1]
        end = 0
        while end < len(sizes) and (end := end + struct.unpack_from("<L", sizes, end + 8)[0]) <= whole:
            objects += 1
        return objects
    if name == "mf4_mixed":
        return sum(end <= first for end in _mf4_mixed()[1])
    return 0  # a checksum covers the whole file, or the structure is behind the frames


def _is_frame(name: str, line: bytes) -> bool:
    return {"candump": b"#" in line, "asc": b" Rx " in line, "trc": b" Rx " in line, "busmaster": b" Rx " in line,
            "savvycan": b",Rx," in line, "canedge": line[:1].isdigit(), "printed": b"ID: " in line}[name]


def check(folder: Path, name: str, number: int) -> str:
    """Tries a mutation; AssertionError with its number. Returns the line at the damage."""
    data, first = mutated(name, number)
    found, end = read(folder, name, data)
    where = f"{name} {number}: {end}"
    whole = expected(name)
    same = min(intact(name, first), len(whole))
    if name.startswith("mf4"):  # in the order of the times, one of which may be damaged
        rest = iter(found)
        assert all(timed in rest for timed in whole[:same]), where
    assert found[:same] == whole[:same] or name.startswith("mf4"), where
    assert "\n" not in end and len(end) < 500, where
    places = ("line ", "byte ", "record ", "after frame ", "its ", "it has ")
    assert not end or any(place in end for place in places), where
    return end


def main(count: int, names: list[str]) -> None:
    """Tries the mutations; goes on where a former run ended."""
    progress = BUILD / "log_mutations"
    progress.mkdir(parents=True, exist_ok=True)
    for name in names or list(ORIGINALS):
        file = progress / name
        done = int(file.read_text()) if file.exists() else 0
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_MAX, MEMORY_MAX))
        told = 0
        with tempfile.TemporaryDirectory() as folder:
            for number in range(done, count):
                used_s = int(sum(resource.getrusage(resource.RUSAGE_SELF)[:2]))
                hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
                resource.setrlimit(resource.RLIMIT_CPU, (used_s + 60 * CPU_S_EACH, hard))
                told += bool(check(Path(folder), name, number))
                if (number + 1) % 500 == 0 or number + 1 == count:
                    file.write_text(str(number + 1))
        print(f"{name}: {count} mutations, {told} of {max(count - done, 0)} with a line", flush=True)


if __name__ == "__main__":
    numbers = [int(word) for word in sys.argv[1:] if word.isdigit()]
    main(numbers[0] if numbers else COUNT, [word for word in sys.argv[1:] if not word.isdigit()])
