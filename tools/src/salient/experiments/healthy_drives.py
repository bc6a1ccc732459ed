"""False faults of healthy drives of the whole range of machines, measured.

    python -m salient.experiments.healthy_drives [--drives N] [--first NUMBER] [--jobs N]

Drive n has the random machine n of random_machines.WHOLE_RANGE, 0.05 to 2000 N m and 12 to 1000 V, with device drops
and current sensors as real ones have them, and is in the healthy world of seed n of the campaign (emulator/campaign):
controller, rate, encoder, winding from -40 to 155 C, flux linkage, inertia, friction, speeds, loads, torques. Prints a
line for each drive that reports a fault, and for each machine that is refused, and the number of false ones: those
without a reason in the plant, or with one that is the drive's own work, as a light rotor that torque mode lets exceed
its speed; exit code 1 when there is one.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys

from salient.errors import exit_code
from salient.experiments.campaign import names
from salient.experiments.campaign.machines import pool_line
from salient.experiments.campaign.runner import Result, program
from salient.experiments.compare.random_machines import WHOLE_RANGE, random_machine
from salient.machine.path import MachineError
from salient.paths import BUILD
from salient.workers import process_pool

FOLDER = BUILD / "healthy_drives"


def run_drive(number: int) -> tuple[Result, Result] | MachineError:
    """World and result of a drive, number 0 or more; a machine that a drive refuses."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    machine, pool = FOLDER / f"drive_{number:03}.toml", FOLDER / f"drive_{number:03}.txt"
    machine.write_text(random_machine(number, WHOLE_RANGE), encoding="utf-8")
    try:
        pool.write_text(f"{pool_line(machine)}\n", encoding="utf-8")
    except MachineError as refusal:
        return refusal
    command = [str(program()), "--machines", str(pool), "--healthy", "--first", str(number)]
    described, result = (json.loads(subprocess.run([*command, *options], capture_output=True, text=True, check=True)
                                    .stdout) for options in (["--describe"], []))
    return described, result


def description(described: Result, result: Result) -> str:
    """A line: what a drive is, and its faults."""
    sets = ", ".join(f"{event['event']} {event['value']:.4g} at {1e-6 * event['begin_us']:.3g} s"
                     for event in described["events"])
    causes = ", ".join(names.causes()[cause] for cause in result["causes"])
    return (f"drive {described['seed']}: {causes} with {described['controller']}, {described['control_rate_hz']} Hz, "
            f"{described['encoder_bits']} bits; {sets}")


def is_false(result: Result) -> bool:
    """True when a drive reports what the judge of the campaign does not find in the plant."""
    return any(violation["rule"] in ("false_alarm", "wrong_cause", "not_first") for violation in result["violations"])


def main() -> int:
    """Runs the drives and prints what they report."""
    parser = argparse.ArgumentParser(prog="python -m salient.experiments.healthy_drives", description=__doc__)
    parser.add_argument("--drives", type=int, default=500, help="number of drives (default 500)")
    parser.add_argument("--first", type=int, default=0, help="number of the first one (default 0)")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="simultaneous runs")
    options = parser.parse_args()
    numbers = range(options.first, options.first + options.drives)
    drives, faults, virtual_s = 0, 0, 0.0
    with process_pool(options.jobs) as pool:
        for done in pool.map(run_drive, numbers):
            if isinstance(done, MachineError):
                print(f"refused: {done}")
                continue
            drives += 1
            virtual_s += 1e-6 * done[1]["virtual_us"]
            if done[1]["causes"]:
                faults += is_false(done[1])
                print(description(*done), flush=True)
    print(f"{drives} healthy drives, {virtual_s:.0f} s of virtual time: {faults} false faults")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
