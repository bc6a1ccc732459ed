"""A campaign on a Dask scheduler with two workers, processes on the loopback, one of which is killed in the middle.

    python -m salient.experiments.campaign.cluster DIR [FIRST [SEEDS]]

runs SEEDS (10000) from seed FIRST (1) on this computer to DIR/one and on the cluster to DIR/many, kills a worker after
a third of the results, and compares summary.json of both, which has the digest of all results, byte for byte. Both
folders are resumable. Writes DIR/cluster.json. Exit code 1 when they differ.
"""

from __future__ import annotations

import hashlib
import json
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from salient.errors import exit_code
from salient.experiments.campaign.arguments import count
from salient.experiments.campaign.arguments import parser as parser_of
from salient.experiments.campaign.runner import commit
from salient.experiments.local_cluster import cluster

_PARTS = 20
"""Lines of progress of a campaign."""


def _campaign(first: int, seeds: int, out: Path, *options: str) -> subprocess.Popen[str]:
    line = [sys.executable, "-m", "salient", "campaign", "--no-shrink", "--first", str(first), "--seeds", str(seeds),
            "--out", str(out), *options]
    return subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def compare(out: Path, first: int, seeds: int) -> dict[str, Any]:
    """Runs the seeds on this computer and on a cluster that loses a worker."""
    one, many = out / "one", out / "many"
    out.mkdir(parents=True, exist_ok=True)
    note: dict[str, Any] = {"first": first, "seeds": seeds, "commit": commit(), "workers": 2}
    with _campaign(first, seeds, one) as alone:
        alone.communicate()
    with (cluster(out.absolute()) as with_workers,
          _campaign(first, seeds, many, "--scheduler", with_workers.address) as process):
        assert process.stderr is not None  # a pipe
        for line in process.stderr:
            done = int(line.split("/")[0]) * seeds // _PARTS if re.match(r"\d+/", line) else 0
            if done * 3 >= seeds and with_workers.workers[0].poll() is None:
                with_workers.workers[0].kill()
                note["killed_after"] = done
        killed = with_workers.workers[0].wait() == -signal.SIGKILL
    files = [folder / "summary.json" for folder in (one, many)]
    contents = [file.read_bytes() if file.exists() else b"" for file in files]
    note["killed"] = killed and "killed_after" in note
    note["summary_sha256"] = [hashlib.sha256(content).hexdigest() for content in contents]
    note["equal"] = contents[0] == contents[1] != b""
    return note


def main(arguments: list[str]) -> int:
    parser = parser_of("cluster", __doc__)
    parser.add_argument("first", type=count, nargs="?", default=1, metavar="FIRST", help="seed (default 1)")
    parser.add_argument("seeds", type=count, nargs="?", default=10000, metavar="SEEDS", help="number (default 10000)")
    options = parser.parse_args(arguments)
    out: Path = options.out
    first, seeds = options.first, options.seeds
    note = compare(out, first, seeds)
    (out / "cluster.json").write_text(json.dumps(note, indent=2) + "\n", encoding="utf-8")
    print(f"seeds {first} to {first + seeds - 1}: one of two workers killed after {note.get('killed_after')} results, "
          f"summary {'equal to' if note['equal'] else 'NOT'} one computer's, byte for byte")
    return 0 if note["equal"] and note["killed"] else 1


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
