"""Worker processes that end with the process which has started them, whatever ends it (salient.guard)."""

from __future__ import annotations

import multiprocessing
import os
import signal
from concurrent.futures import ProcessPoolExecutor

from salient.guard import begin


def process_pool(jobs: int | None = None) -> ProcessPoolExecutor:
    """A pool of worker processes; jobs: their number, by default as many as there are cores."""
    begin()
    context = multiprocessing.get_context("fork")  # they start with the modules that this process has loaded
    return ProcessPoolExecutor(jobs or len(os.sched_getaffinity(0)), context, _begin)


def _begin() -> None:
    """Ctrl-C reaches the whole process group, and only the parent handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
