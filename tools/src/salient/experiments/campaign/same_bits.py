"""Equal bits of worlds: run twice by the campaign's program, on the usual test bench, and on a target in QEMU.

    python -m salient.experiments.campaign.same_bits DIR [FIRST [SEEDS [TARGET]]]

from seed FIRST (1), SEEDS (100) of them, on TARGET (cortex-m4): compares the hashes over all frames on the bus and the
true state. Results are JSON lines in DIR; those that it has are not run again. Exit code 1 when any differ.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from salient.experiments.campaign.failure import replay
from salient.experiments.campaign.runner import digest, run_world
from salient.experiments.tasks import Task, run


def hashes(task: tuple[int, str]) -> dict[str, Any]:
    """Of a seed, one for each run; task: seed, target. For workers."""
    seed, target = task
    first = str(run_world(seed).get("hash", "crash"))
    bench, on_target = replay(seed), replay(seed, build=target)
    again = str(bench.campaign.get("hash", "crash"))
    return {"seed": seed, "target": target, "hash": first, "again": again, "bench": bench.hash,
            "on_target": on_target.hash}


def equal(result: dict[str, Any]) -> bool:
    """All hashes of a seed are one."""
    return len({result["hash"], result["again"], result["bench"], result["on_target"]}) == 1


def main(arguments: list[str]) -> int:
    numbers = arguments[1:3]
    if not 1 <= len(arguments) <= 4 or not all(number.isdigit() for number in numbers):
        print("usage: python -m salient.experiments.campaign.same_bits DIR [FIRST [SEEDS [TARGET]]]", file=sys.stderr)
        return 2
    first, seeds = (*map(int, numbers), *(1, 100)[len(numbers):])
    target = arguments[3] if len(arguments) == 4 else "cortex-m4"
    tasks = [Task(f"{target} {seed} {digest()}", (seed, target)) for seed in range(first, first + seeds)]
    results = [result for _, result in run(tasks, hashes, Path(arguments[0]))]
    different = [result["seed"] for result in results if not equal(result)]
    print(f"seeds {first} to {first + seeds - 1}: run twice on the host, on the bench and on {target}: "
          f"{len(results) - len(different)} of {len(results)} with equal bits")
    if different:
        print(f"different: {', '.join(map(str, different))}")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
