"""Worker processes that end with the process which has started them, whatever ends it."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
from concurrent.futures import ProcessPoolExecutor

_PR_SET_PDEATHSIG = 1


def process_pool(jobs: int | None = None) -> ProcessPoolExecutor:
    """A pool of worker processes; jobs: their number, by default as many as there are cores."""
    context = multiprocessing.get_context("fork")  # workers of a fork server are not children of this process
    return ProcessPoolExecutor(jobs or len(os.sched_getaffinity(0)), context, _begin, (os.getpid(),))


def _begin(parent: int) -> None:
    """Ctrl-C reaches the whole process group, and only the parent handles it; a worker ends with its parent, even when
    that is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it has died before
        os._exit(1)
