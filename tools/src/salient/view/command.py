"""tools/salient view: the live page of a drive on a bus, or of a log."""

from __future__ import annotations

import argparse
import json
import signal
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import can
from cantools.database.can import Database

from salient.bench.stimulus import STIMULI, Stimulus, act_frames, stimuli
from salient.bus.clock import VirtualTimeReader, open_bus
from salient.bus.databases import load_databases
from salient.bus.frame_bits import BitRates
from salient.bus.identity import IDENTITY_WAIT_NS, Carrier
from salient.bus.log_reader import KnownFrames, LogDamaged, NoKnownFrame, read_log
from salient.bus.traffic import Traffic
from salient.config import DEFAULTS
from salient.errors import UsageError
from salient.version import VERSION
from salient.view.commands import COMMANDS
from salient.view.description import description
from salient.view.frames import Chunk, FrameStore
from salient.view.link import Link
from salient.view.server import Feed, Server
from salient.view.traffic_feed import TrafficFeed

_CHUNK_FRAMES = 100_000
_FAILURE_NOTES = "bench.json"
_SILENCE_S = 1.0
"""Wall time without a frame after which a page begins before the drive has said which machine it carries."""


class BusFeed:
    """The frames of a bus, for each page from the moment at which it was opened."""

    def __init__(self, address: str, machine: str, node: int, others: Sequence[Database], rates: BitRates) -> None:
        """others: databases of other nodes."""
        self.info = {**description(machine, node, others), "kind": "live", "title": address,
                     "commands": ["take", "release", *COMMANDS], "build": f"salient {VERSION}", "period_ms": 0}
        self.store = FrameStore()
        self.traffic = TrafficFeed(Traffic(rates, others, node))
        self.link = Link(address, machine, node, self.store, self.traffic)
        self.link.start()

    @property
    def ended(self) -> str:
        return f"{self.link.address}: the drive has ended" if self.link.ended else ""

    def first_number(self) -> int:
        return self.store.next_number


class LogFeed:
    """The frames of a log, all of them for each page."""

    link = None

    def __init__(self, path: Path, carrier: Carrier, node: int, acts: list[Stimulus] | None = None,
                 others: Sequence[Database] = (), rates: BitRates | None = None) -> None:
        """acts: what was done; without it what the log has of that. others: databases of other nodes. rates: by default
        the emulated bus's. OtherDatabase: see Carrier. NoKnownFrame."""
        self.traffic = TrafficFeed(Traffic(rates or BitRates(DEFAULTS["bit_rate"]), others, node), of_all_time=True)
        self.store = FrameStore(kept=1 << 62)
        chunk = Chunk()
        first_ns, last_ns = None, 0
        of_hosts: list[tuple[int, can.Message]] = []
        relevant = act_frames(None, (node,)) if acts is None else {}
        known = KnownFrames(node, others)
        for time_ns, message in self._frames(path):
            carrier.take(message)
            known.add(message)
            self.traffic.add(time_ns, message)
            if (message.arbitration_id, message.is_extended_id) in relevant:
                of_hosts.append((time_ns, message))
            if chunk.add(time_ns, message):
                first_ns, last_ns = time_ns if first_ns is None else first_ns, time_ns
            if len(chunk) == _CHUNK_FRAMES:
                self.store.put(chunk)
                chunk = Chunk()
        if len(chunk):
            self.store.put(chunk)
        if first_ns is None:
            raise NoKnownFrame(self.damage or f"--replay {path}: the log has no data frame")
        known.require(self.damage or f"--replay {path}")
        self.traffic.finish()
        machine = carrier.likely
        if acts is None:
            acts = stimuli(of_hosts, last_ns, machine, (node,))
        self.ended = f"{path.name}: {self.store.next_number} frames"
        self.info = {**description(machine, node, others), "kind": "replay", "title": str(path), "commands": [],
                     "build": f"salient {VERSION}", "period_ms": 0, "start_ns": first_ns, "end_ns": last_ns,
                     "stimuli": [asdict(stimulus) for stimulus in acts]}

    damage = ""
    """Where the log could not be read, and how many frames are before that."""

    def _frames(self, path: Path) -> Iterator[tuple[int, can.Message]]:
        try:
            yield from read_log(path, "--replay")
        except LogDamaged as error:
            self.damage = str(error)

    def first_number(self) -> int:
        return 0


def run(options: argparse.Namespace) -> int:
    """Serves the page until an interrupt; prints its link. Returns 1 when a log was read up to its damage."""
    feed: Feed
    damage = ""
    rates = BitRates(options.bit_rate, options.data_bit_rate)
    if options.replay is None:
        others = load_databases(options.dbc, options.node or 0)
        carrier = Carrier(options.can, options.machine, options.node or 0)
        _listen(options.can, carrier)
        feed = BusFeed(options.can, carrier.likely, options.node or 0, others, rates)
    else:
        path, notes = _log_of(options.replay)
        node = notes.get("node", 0) if options.node is None else options.node
        others = load_databases(options.dbc, node)
        carrier = Carrier(str(path), options.machine, node, noted=notes.get("machine"))
        feed = LogFeed(path, carrier, node, _acts_of(notes), others, rates)
        damage = feed.damage
        if damage:
            print(f"salient: {damage}", file=sys.stderr, flush=True)
    server = Server(feed)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    print(f"live page: {server.link}", flush=True)
    try:
        server.run()
    finally:
        if feed.link is not None:
            feed.link.close()
    return 1 if damage else 0


def _listen(address: str, carrier: Carrier) -> None:
    """Listens until the drive has said which machine it carries, or does not for IDENTITY_WAIT_NS, or is silent."""
    with open_bus(address) as bus:
        reader = VirtualTimeReader(bus)
        begin_ns = None
        while (timed := reader.receive(_SILENCE_S)) is not None:
            time_ns, message = timed
            begin_ns = time_ns if begin_ns is None else begin_ns
            if carrier.take(message) or time_ns - begin_ns > IDENTITY_WAIT_NS:
                return


def _acts_of(notes: dict[str, Any]) -> list[Stimulus] | None:
    """Those that the report of a failure has; None in notes without them."""
    try:
        return [Stimulus(float(act["time_s"]), str(act["text"])) for act in notes[STIMULI]]
    except (KeyError, TypeError, ValueError):
        return None


def _log_of(path: Path) -> tuple[Path, dict[str, Any]]:
    """The log, and the notes beside it in the folder of a failed test; a folder of benches stands for its first."""
    if not path.is_dir():
        return path, {}
    folder = path if (path / _FAILURE_NOTES).is_file() else path / "0"
    log = folder / "can.blf"
    if not log.is_file():
        raise UsageError(f"--replay {path}: a folder must have can.blf, as that of a failed test has")
    try:
        notes = json.loads((folder / _FAILURE_NOTES).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        notes = {}
    return log, notes if isinstance(notes, dict) else {}
