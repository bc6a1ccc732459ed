"""Equal bits of worlds: run twice by the campaign's program, on the usual test bench, and on a target.

    python -m salient.experiments.campaign.same_bits DIR [FIRST [SEEDS [TARGET]]]

from seed FIRST (1), SEEDS (100) of them, on TARGET (cortex-m4): compares the hashes over all frames on the bus and the
true state. Results are JSON lines in DIR; those that it has are not run again. Writes DIR/summary.json. Exit code 1
when any differ.

On stm32g4, the board's image in the register-level model of its part, the machines have the board's converters,
encoder, control rate and clock, and the frames of a seed's clients meet an image and a host executable of that clock:
compared are their frames and the true state (salient.experiments.board_same_bits). Seeds of machines that the board
cannot drive are left out.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from salient.config import BOARD_BUILD
from salient.errors import exit_code
from salient.experiments.board_same_bits import SOURCES, board_hashes
from salient.experiments.campaign.arguments import count
from salient.experiments.campaign.arguments import parser as parser_of
from salient.experiments.campaign.failure import replay
from salient.experiments.campaign.runner import commit, digest, run_world
from salient.experiments.tasks import Task, run, sources_digest

SUMMARY = "summary.json"


def hashes(task: tuple[int, str]) -> dict[str, Any]:
    """Hashes of a seed, one for each run; task: seed, target. For workers."""
    seed, target = task
    if target == BOARD_BUILD:
        return board_hashes(seed)
    first = str(run_world(seed).get("hash", "crash"))
    bench, on_target = replay(seed), replay(seed, build=target)
    again = str(bench.campaign.get("hash", "crash"))
    return {"seed": seed, "target": target, "hash": first, "again": again, "bench": bench.hash,
            "on_target": on_target.hash}


def equal(result: dict[str, Any]) -> bool:
    """All hashes of a seed are one."""
    return len({result[name] for name in ("hash", "again", "bench", "on_target") if name in result}) <= 1


def main(arguments: list[str]) -> int:
    parser = parser_of("same_bits", __doc__)
    parser.add_argument("first", type=count, nargs="?", default=1, metavar="FIRST", help="seed (default 1)")
    parser.add_argument("seeds", type=count, nargs="?", default=100, metavar="SEEDS", help="number (default 100)")
    parser.add_argument("target", nargs="?", default="cortex-m4", choices=("cortex-m4", "rv32", BOARD_BUILD),
                        metavar="TARGET", help=f"cortex-m4, rv32 or {BOARD_BUILD} (default cortex-m4)")
    parser.add_argument("--jobs", type=count, metavar="N", help="processes at once (default as many as cores)")
    options = parser.parse_args(arguments)
    first, seeds, target = options.first, options.seeds, options.target
    sources = sources_digest(*SOURCES)[:16] if target == BOARD_BUILD else ""
    depended = f"{digest()} {sources}".strip()
    tasks = [Task(f"{target} {seed} {depended}", (seed, target)) for seed in range(first, first + seeds)]
    results = [result for _, result in run(tasks, hashes, options.out, jobs=options.jobs)]
    left_out = sorted(result["seed"] for result in results if "left_out" in result)
    different = sorted(result["seed"] for result in results if not equal(result))
    note: dict[str, Any] = {"first": first, "seeds": seeds, "target": target, "commit": commit(),
                            "program_and_machines": digest(), "different": different}
    if target == BOARD_BUILD:
        virtual_us = sum(result["virtual_us"] for result in results if "left_out" not in result)
        note |= {"left_out": left_out, "virtual_s": round(1e-6 * virtual_us, 3)}
    out: Path = options.out
    (out / SUMMARY).write_text(json.dumps(note, indent=2) + "\n", encoding="utf-8")
    where = "on the host of its clock" if target == BOARD_BUILD else "run twice on the host, on the bench"
    run_seeds = seeds - len(left_out)
    print(f"seeds {first} to {first + seeds - 1}: {where} and on {target}: {run_seeds - len(different)} of {run_seeds} "
          "with equal bits")
    if left_out:
        print(f"left out: {', '.join(map(str, left_out))}")
    if different:
        print(f"different: {', '.join(map(str, different))}")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
