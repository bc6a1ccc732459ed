"""A failing seed: its shortest list of events, and the replay on the usual test bench, to the bit."""

from __future__ import annotations

import json
import resource
import tempfile
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import can

from salient.bench import failure
from salient.bench.bench import Bench
from salient.bench.programs import EmulatorError
from salient.bench.session import SessionError
from salient.bus.clock import open_bus
from salient.config import BenchConfig
from salient.errors import UsageError, reason
from salient.experiments.campaign import names
from salient.experiments.campaign.machines import files
from salient.experiments.campaign.runner import ALL_EVENTS, FAULTS, KINDS, Programs, Result, run_world, world

_STEP_NS = 1_000_000
_EXTENDED, _REMOTE = 0x80000000, 0x40000000
"""Bits of an identifier, as Linux has them."""
_FEW = 3
_CRASH_MAX_S = 60
"""Processor time of a bench that is to crash: it may do so by not ending."""
_HASH_START, _HASH_PRIME, _HASH_MASK = 14695981039346656037, 1099511628211, 2**64 - 1
_TRUTH = range(0x1F000010, 0x1F000014)
TELEMETRY_PERIOD_MS = 4


def classes(result: Result) -> list[str]:
    """Classes of the violations of a run."""
    return [names.violation(violation) for violation in result["violations"]]


def shrink(seed: int, violation: str, kind: str = FAULTS, programs: Programs | None = None) -> int:
    """The events, as bits, of a short list that still has a violation of this class: no event of it can be left out.
    Leaves out halves, quarters, ... first (A. Zeller, R. Hildebrandt, "Simplifying and isolating failure-inducing
    input", 2002). Of what is left with more than _FEW events every list of at most so many is tried."""
    every = [event["index"] for event in world(seed, kind=kind)["events"]]
    events = every

    def fails(kept: list[int]) -> bool:
        return violation in classes(run_world(seed, sum(1 << index for index in kept), kind, programs=programs))

    part = len(events)
    while part >= 1:
        at = 0
        while at < len(events):
            fewer = events[:at] + events[at + part:]
            if fails(fewer):
                events = fewer
            else:
                at += part
        part //= 2
    if len(events) > _FEW:
        lists = (list(few) for count in range(_FEW + 1) for few in combinations(every, count))
        events = next((few for few in lists if fails(few)), events)
    return sum(1 << index for index in events)


@dataclass(frozen=True)
class Replay:
    """hash: of the frames on the bus and of the true state; empty when the bench's program crashed. campaign: the
    result of the campaign's own program, without a hash when it crashed."""

    hash: str
    campaign: Result

    @property
    def equal(self) -> bool:
        """Both programs had the same bits."""
        return self.hash == str(self.campaign.get("hash", ""))


def replay(seed: int, kept: int = ALL_EVENTS, kind: str = FAULTS, folder: Path | None = None,
           build: str = "host", programs: Programs | None = None) -> Replay:
    """Runs a world again, and its frames once more on a test bench of salient_host, or of a target's build. folder: for
    log and plots of the bench, around the first violation or, without one, the end."""
    described = world(seed, kept, kind)
    with tempfile.TemporaryDirectory(prefix="salient-") as temporary:
        frames = Path(temporary) / "frames"
        result = run_world(seed, kept, kind, frames, programs)
        path = next(path for path in files() if path.stem == described["machine"])
        config = BenchConfig(machine=str(path), controller=described["controller"], seed=seed, build=build,
                             control_rate_hz=described["control_rate_hz"], encoder_bits=described["encoder_bits"],
                             adc_bits=described["adc_bits"], encoder_edges=described["encoder_edges"],
                             initial_angle_deg=described["initial_angle_deg"],
                             telemetry_period_ms=TELEMETRY_PERIOD_MS,
                             protocol="canopen" if described["client"] == "canopen" else "salient",
                             program=programs.host if programs else None)
        lines = frames.read_text(encoding="ascii").rpartition("\n")[0].splitlines()
        try:
            with Bench(config, f"unix:{temporary}/can.sock") as bench:
                if "hash" not in result:
                    resource.prlimit(bench.simulator.pid, resource.RLIMIT_CPU, (_CRASH_MAX_S, _CRASH_MAX_S))
                send_frames(bench, lines)
                if folder is not None:
                    whole = kept == ALL_EVENTS and programs is None
                    again = f"{seed}{'' if kind == FAULTS else f' --{kind}'}" if whole else folder
                    notes = {"replay": f"tools/salient replay {again}", "world": f"Campaign, seed {seed}"}
                    _save_bench(bench, folder, notes, result, config)
                computed = f"{_hash(bench.log):016x}"
        except EmulatorError:
            if "hash" in result:
                raise
            computed = ""
        return Replay(computed, result)


def _save_bench(bench: Bench, folder: Path, notes: dict[str, Any], result: Result, config: BenchConfig) -> None:
    found = sorted((violation["at_us"], names.violation(violation)) for violation in result["violations"])
    known = found and found[0][0] > 0  # not the time of a crash
    moment = (1e-6 * found[0][0], "violation") if known else (bench.time_s, "end")
    failure.save(bench, folder, notes, config, "\n".join(f"{name} at {at_us} us" for at_us, name in found), moment)


def send_frames(bench: Bench, lines: list[str]) -> None:
    """Sends the frames of both clients, each at its time, as long as the emulator runs: how it ended shows when the
    bench is closed."""
    other = open_bus(bench.address)
    try:
        for line in lines:
            time, client, identifier, *data = line.split()
            number = int(identifier, 16)
            extended, remote = bool(number & _EXTENDED), bool(number & _REMOTE)
            message = can.Message(arbitration_id=number & 0x1FFFFFFF, is_extended_id=extended, is_remote_frame=remote,
                                  data=bytes.fromhex(data[0] if data else ""))
            if extended and message.arbitration_id == 0x1F000001:  # RIG_RUN_UNTIL
                bench.advance_to(int(time) + _STEP_NS)
                while other.recv(0) is not None:
                    pass
            elif client == "1":
                bench.send(message)
            else:
                other.send(message)
    except (SessionError, can.CanError):
        pass
    finally:
        other.shutdown()


def _hash(log: list[tuple[int, can.Message]]) -> int:
    """As the campaign's program computes it (emulator/campaign/sender.c)."""
    value = _HASH_START
    for time_ns, message in log:
        identifier = message.arbitration_id
        if message.is_extended_id:
            if 0x1F000000 <= identifier <= 0x1F0007FF and identifier not in _TRUTH:
                continue
            identifier |= _EXTENDED
        identifier |= _REMOTE if message.is_remote_frame else 0
        data = bytes(message.data)
        for byte in time_ns.to_bytes(8, "little") + identifier.to_bytes(4, "little") + bytes([len(data)]) + data:
            value = (value ^ byte) * _HASH_PRIME & _HASH_MASK
    return value


def save(seed: int, violation: str, folder: Path, kind: str = FAULTS, bug: str | None = None,
         programs: Programs | None = None) -> dict[str, Any]:
    """Shrinks a failing seed and writes its folder: failure.json with the events that are left, log and plot. bug: name
    of the planted one that the programs have."""
    folder.mkdir(parents=True, exist_ok=True)
    kept = shrink(seed, violation, kind, programs)
    again = replay(seed, kept, kind, folder, programs=programs)
    note = {"seed": seed, "kind": kind, "bug": bug, "kept": f"{kept:#x}", "violation": violation,
            "hash": again.hash, "equal": again.equal, "world": world(seed, kept, kind), "result": again.campaign,
            "replay": f"tools/salient replay {folder}"}
    (folder / "failure.json").write_text(json.dumps(note, indent=2) + "\n", encoding="utf-8")
    return note


@dataclass(frozen=True)
class Failure:
    """Run that a failure's folder asks for. bug: name of the planted one that its programs had."""

    seed: int
    kept: int
    kind: str
    bug: str | None


def _kind(text: str) -> str:
    if text not in KINDS:
        raise ValueError(f"kind {text}")
    return text


def load(folder: Path) -> Failure:
    """The failure of a folder; UsageError."""
    path = folder / "failure.json"
    try:
        note = json.loads(path.read_text(encoding="utf-8"))
        bug = note.get("bug")
        return Failure(int(note["seed"]), int(note["kept"], 16), _kind(note["kind"]),
                       None if bug is None else str(bug))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UsageError(f"{path}: not the note of a failure ({reason(error)}); give a seed or the folder of a "
                         "failure that a campaign has left") from None
