"""A bus at full load for any time: recorded in files that rotate, watched, and read again, with nothing lost and memory
that does not grow.

    build/venv/bin/python tests/tools/full_load.py FOLDER [SECONDS]

runs an hour and prints what it has measured."""

from __future__ import annotations

import heapq
import sys
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import can
from other_nodes import CYCLES_MS, databases, write_databases

from salient.bus import monitor
from salient.bus.databases import load_databases
from salient.bus.frame_bits import BitRates
from salient.bus.interface import VirtualMessage
from salient.bus.log_reader import read_log
from salient.bus.traffic import Traffic
from salient.config import Rotation

BIT_RATE = 1_000_000
FILLER = range(0x400, 0x480)
"""Identifiers of no database, which fill the time between the frames of the nodes."""
_LOOK_FRAMES = 65_536


def frames(duration_s: float) -> Iterator[VirtualMessage]:
    """Frames that follow each other without a gap: the nodes' when they are due, else others. Each has its
    number in its first bytes."""
    rates = BitRates(BIT_RATE)
    lengths = {(m.frame_id, m.is_extended_frame): m.length for each in databases() for m in each.messages}
    due = [(137_000 * number, key) for number, key in enumerate(CYCLES_MS)]
    heapq.heapify(due)
    number, now_ns, end_ns = 0, 0, duration_s * 1e9
    while now_ns < end_ns:
        if due[0][0] <= now_ns:
            due_ns, key = due[0]
            heapq.heapreplace(due, (due_ns + CYCLES_MS[key] * 1_000_000, key))
            (identifier, is_extended), length = key, lengths[key]
        else:
            identifier, is_extended, length = FILLER[number % len(FILLER)], False, 8
        data = (number * 0x9E3779B97F4A7C15 & ~0xFFFFFFFF | number).to_bytes(12, "little")[:length]
        message = VirtualMessage.data_frame(0, identifier, is_extended, data, "full")
        now_ns += round(rates.duration_ns(message))
        message.time_ns = now_ns
        number += 1
        yield message


class FullBus:
    """The bus, as a monitor opens it; it ends after a time. memory_bytes: resident, at times. digest: of all frames."""

    receive_own_messages = True  # of a local bus, whose frames have virtual time

    def __init__(self, duration_s: float) -> None:
        self._frames = frames(duration_s)
        self.count, self.digest = 0, 0
        self.memory_bytes: list[int] = []

    def recv(self, timeout: float | None) -> can.Message:
        if self.count % _LOOK_FRAMES == 0:
            self.memory_bytes.append(resident_bytes())
        message = next(self._frames, None)
        if message is None:
            raise can.CanOperationError("the bus has ended")
        self.count += 1
        self.digest = digest_of(message.time_ns, message, self.digest)
        return message

    def shutdown(self) -> None:
        pass

    def __enter__(self) -> FullBus:
        return self

    def __exit__(self, *exception: object) -> None:
        pass


def digest_of(time_ns: int, message: can.Message, before: int) -> int:
    """Digest of a frame and those before it."""
    return zlib.crc32(b"%d %d %s" % (time_ns, message.arbitration_id, message.data), before)


def resident_bytes() -> int:
    """Memory of this process."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * 4096


def record(folder: Path, duration_s: float, rotation: str, suffix: str = ".blf") -> tuple[FullBus, list[Path]]:
    """Records the bus as `log --rotate` does; the bus, and the files."""
    bus = FullBus(duration_s)
    open_bus, monitor.open_bus = monitor.open_bus, lambda address: bus
    try:
        others = load_databases(write_databases(folder))
        code = monitor.record(f"unix:{folder}/none", folder / f"can{suffix}", None, None, 0, Rotation.parse(rotation),
                              others if suffix == ".csv" else ())
    finally:
        monitor.open_bus = open_bus
    assert code == 0
    return bus, sorted(folder.glob(f"can_*{suffix}"))


def watch(folder: Path, files: list[Path]) -> tuple[Traffic, int, int, list[int]]:
    """Reads the files again; the traffic, number and digest of the frames, and the memory at times."""
    traffic = Traffic(BitRates(BIT_RATE), load_databases(write_databases(folder)))
    count, digest, memory_bytes = 0, 0, []
    for path in files:
        for time_ns, message in read_log(path):
            digest = digest_of(time_ns, message, digest)
            traffic.add(time_ns, message)
            if count % _LOOK_FRAMES == 0:
                memory_bytes.append(resident_bytes())
            count += 1
    return traffic, count, digest, memory_bytes


def main() -> None:
    """As in the text above."""
    folder, duration_s = Path(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else 3600.0
    folder.mkdir(parents=True, exist_ok=True)
    begin_s = time.process_time()
    bus, files = record(folder, duration_s, "100MB")
    recorded_s = time.process_time()
    print(f"{bus.count} frames recorded", flush=True)
    traffic, count, digest, memory_bytes = watch(folder, files)
    report = traffic.total()
    print(f"{bus.count} frames in {len(files)} files of {sum(path.stat().st_size for path in files) / 1e6:.0f} MB, "
          f"{count} read again, {'equal' if digest == bus.digest else 'DIFFERENT'}, load {report.load:.4f}, "
          f"unknown {len(report.unknown)}")
    for name, found, seconds in (("recorded", bus.memory_bytes, recorded_s - begin_s),
                                 ("watched", memory_bytes, time.process_time() - recorded_s)):
        print(f"{name}: {seconds:.0f} s of processor time; memory {found[1] / 1e6:.1f} MB after {_LOOK_FRAMES} frames, "
              f"at most {max(found) / 1e6:.1f} MB, at the end {found[-1] / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
