"""A Dask scheduler and workers on the loopback, as real processes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Cluster:
    """A scheduler and its worker processes."""

    address: str
    workers: list[subprocess.Popen[str]]


@contextmanager
def cluster(folder: Path, environment: Mapping[str, str] | None = None) -> Generator[Cluster, None, None]:
    """A Dask scheduler and two workers of one thread on the loopback. environment: variables besides this
    process's. They end with the context."""
    processes: list[subprocess.Popen[str]] = []

    def start(module: str, *options: str) -> subprocess.Popen[str]:
        line = [sys.executable, "-m", f"distributed.cli.{module}", *options, "--no-dashboard"]
        processes.append(subprocess.Popen(line, cwd=folder, env={**os.environ, **(environment or {})}, text=True,
                                          stderr=subprocess.PIPE))
        return processes[-1]

    try:
        scheduler = start("dask_scheduler", "--host", "tcp://127.0.0.1", "--port", "0")
        assert scheduler.stderr is not None  # a pipe
        address = next(match[1] for line in scheduler.stderr if (match := re.search(r"Scheduler at: +(tcp:\S+)", line)))
        workers = [start("dask_worker", address, "--host", "127.0.0.1", "--no-nanny", "--nthreads", "1",
                         "--local-directory", str(folder / f"worker{number}")) for number in range(2)]
        from distributed import Client

        with Client(address, set_as_default=False) as client:  # type: ignore[no-untyped-call]
            client.wait_for_workers(2)
        yield Cluster(address, workers)
    finally:
        for process in processes:
            process.kill()
            process.communicate()
