"""Compares the drives of two checkouts bit by bit:

    build/venv/bin/python tests/target/compare_builds.py OTHER [--builds NAME ...] [--redefined IDENTIFIER ...]

OTHER is a checkout whose builds host, cortex-m4 and rv32 are complete. Each machine and controller makes the runs of
test_same_bits.py on each build. Compared are the compare values of every control period, the recorded true state, and
the CAN payloads of each identifier in sequence. Exit code 1 when anything differs but the identifiers that --redefined
names.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

BUILDS = ("host", "cortex-m4", "rv32")


def digest_of_run(name: str, build: str, machine: str, controller: str) -> dict[str, Any]:
    """Hashes of a run by the checkout that the package is imported from."""
    from test_same_bits import ROW_BYTES, RUNS

    from salient.bench.bench import Bench
    from salient.config import BenchConfig

    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        switches, recording = Path(folder) / "switches", Path(folder) / "recording.npy"
        options = BenchConfig(record=recording, record_step_ns=10_000, record_switches=switches, build=build,
                                   machine=machine, controller=controller, seed=3, initial_angle_deg=12.0)
        with Bench(options, f"unix:{folder}/can.sock") as bench:
            RUNS[name](bench)
        payloads: dict[str, Any] = {}
        for _, message in bench.log:
            entry = payloads.setdefault(f"{message.arbitration_id:#x}", [0, hashlib.sha256()])
            entry[0] += 1
            entry[1].update(bytes(message.data))
        return {
            "periods": switches.stat().st_size // ROW_BYTES,
            "compare_values": hashlib.sha256(switches.read_bytes()).hexdigest(),
            "true_state": hashlib.sha256(recording.read_bytes()).hexdigest(),
            "payloads": {identifier: [count, sha.hexdigest()] for identifier, (count, sha) in payloads.items()},
        }


def run_all(options: argparse.Namespace) -> None:
    """Prints the digests of every run as JSON."""
    from test_same_bits import MACHINES, RUNS

    from salient.config import CONTROLLERS

    runs = [(name, build, machine, controller) for name in options.runs or RUNS for build in options.builds
            for machine in MACHINES for controller in CONTROLLERS]
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        digests = pool.map(lambda run: digest_of_run(*run), runs)
        json.dump({" ".join(run): digest for run, digest in zip(runs, digests, strict=True)}, sys.stdout)


def digests_of(root: Path, arguments: list[str]) -> dict[str, Any]:
    """Digests of the runs by a checkout: its programs, and its package, which makes the machine images that they
    read."""
    done = subprocess.run([sys.executable, __file__, *arguments, "--print"], stdout=subprocess.PIPE, check=True,
                          env={**os.environ, "PYTHONPATH": str(root / "tools" / "src")})
    return json.loads(done.stdout)


def main() -> int:
    parser = argparse.ArgumentParser(description="Compares the drives of two checkouts bit by bit.")
    parser.add_argument("other", type=Path, help="checkout to compare with")
    parser.add_argument("--builds", nargs="+", choices=BUILDS, default=BUILDS)
    parser.add_argument("--runs", nargs="+", help="default: all of test_same_bits.py")
    parser.add_argument("--redefined", nargs="+", default=[], metavar="0x185",
                        help="identifiers that may differ")
    parser.add_argument("--print", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.print:
        run_all(options)
        return 0
    root = Path(__file__).resolve().parents[2]
    theirs, ours = (digests_of(folder, sys.argv[1:]) for folder in (options.other.resolve(), root))
    periods = frames = differences = 0
    for run, old in theirs.items():
        new = ours[run]
        periods += old["periods"]
        unequal = [what for what in ("periods", "compare_values", "true_state") if old[what] != new[what]]
        for identifier in sorted({*old["payloads"], *new["payloads"]}):
            before, after = (digest["payloads"].get(identifier, [0, ""]) for digest in (old, new))
            if before == after:
                frames += before[0]
            elif identifier not in options.redefined:
                unequal.append(f"{identifier} ({before[0]} and {after[0]} frames)")
        differences += len(unequal)
        if unequal:
            print(f"{run}: {', '.join(unequal)} differ")
    print(f"{len(theirs)} runs, {periods:,} control periods, {frames:,} frames of equal payload; "
          f"{differences} differences; redefined: {', '.join(options.redefined) or 'none'}")
    return 1 if differences else 0


if __name__ == "__main__":
    sys.exit(main())
