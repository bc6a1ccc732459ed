"""Runs of the board's image on the model of its part, compared with a host executable whose PWM timer has its clock.

Compared are the frames on the bus with their times, and the true state.
"""

from __future__ import annotations

import hashlib
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

from salient.bench import programs
from salient.bench.bench import Bench
from salient.builder import build_preset
from salient.config import BOARD_BUILD
from salient.errors import RunFailed, UsageError
from salient.experiments.campaign.failure import TELEMETRY_PERIOD_MS, send_frames
from salient.experiments.campaign.machines import files
from salient.experiments.campaign.runner import ALL_EVENTS, run_world, world
from salient.machine.cache import bench_config
from salient.paths import BUILD, ROOT, build_lock, from_root

_RECORD_STEP_NS = 10_000

SOURCES = ("emulator", "firmware", "hal", "tools/machines", "tools/src/salient/board",
           "tools/src/salient/experiments/board_same_bits.py")
"""Sources of the image, of its model, of the host's program and of the comparison, on which a result depends."""

_LEFT_OUT = ("interrupt_time_us", "interrupt_late", "interrupt_storm", "interrupt_lost")
"""Events of a world that the image meets otherwise: its instructions take no time on the bench, and its main program
sleeps until an interrupt comes."""


@cache
def programs_of_the_clock(clock_mhz: int) -> Path:
    """Folder of the host executable, and of the model, whose PWM timer has a clock. RunFailed: the build fails."""
    folder = BUILD / f"clock-{clock_mhz}" / "host"
    log = folder.parent / "build.log"
    options = (f"-DSALIENT_PWM_CLOCK_MHZ={clock_mhz}", f"-DSALIENT_PYTHON={sys.executable}")
    with build_lock():
        folder.parent.mkdir(parents=True, exist_ok=True)
        if not build_preset(ROOT, folder, ("salient_host", "salient_stm32g4"), log, _notice, options):
            raise RunFailed(f"building the host's program for {clock_mhz} MHz failed: see {from_root(log)}")
    return folder / "bin"


def _notice() -> None:
    print("salient: building the host's program for another clock", file=sys.stderr, flush=True)


def pair(clock_mhz: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Options of BenchConfig for the host and for the board at a clock."""
    folder = programs_of_the_clock(clock_mhz)
    return {"program": folder / "salient_host"}, {"program": folder / "salient_stm32g4", "build": BOARD_BUILD}


def modelled(described: dict[str, Any]) -> int:
    """Mask of the events of a world that host and image meet alike. Flipped bits have a place in the host's memory
    alone."""
    left_out: list[int] = [event["index"] for event in described["events"]
                           if event["event"].endswith("_flipped") or event["event"] in _LEFT_OUT]
    return ALL_EVENTS & ~sum(1 << index for index in left_out)


def board_hashes(seed: int) -> dict[str, Any]:
    """Hashes of a seed of the campaign on both; left_out: why the board has no such machine. Control rate and encoder
    are the machine's, which the image has."""
    described = world(seed)
    made: dict[str, Any] = {"seed": seed, "target": BOARD_BUILD, "virtual_us": described["duration_us"]}
    with tempfile.TemporaryDirectory(prefix="salient-") as temporary:
        run_world(seed, modelled(described), frames=Path(temporary) / "frames")
        lines = (Path(temporary) / "frames").read_text(encoding="ascii").rpartition("\n")[0].splitlines()
        machine = next(path for path in files() if path.stem == described["machine"])
        for name, options in zip(("bench", "on_target"), pair(programs.BOARD_CLOCK_MHZ), strict=True):
            recording = Path(temporary) / f"{name}.npy"
            config = bench_config({"machine": str(machine), "controller": described["controller"], "seed": seed,
                                   "initial_angle_deg": described["initial_angle_deg"],
                                   "telemetry_period_ms": TELEMETRY_PERIOD_MS, "record": recording,
                                   "record_step_ns": _RECORD_STEP_NS, **options})
            try:
                with Bench(config, f"unix:{temporary}/{name}.sock") as bench:
                    send_frames(bench, lines)
                    frames = [(time, message.arbitration_id, bytes(message.data)) for time, message in bench.log]
            except UsageError as error:
                return {"seed": seed, "target": BOARD_BUILD, "left_out": str(error)}
            digest = hashlib.sha256(repr(frames).encode())
            digest.update(recording.read_bytes())
            made[name] = digest.hexdigest()[:16]
            made[f"frames_{name}"] = len(frames)
    return made
