"""Execution of many independent runs: on the cores of this computer or on a Dask scheduler, in shards, resumable.

    for task, result in run([Task("seed 1", 1), Task("seed 2", 2)], function, Path("out")):
        ...

function(task.arguments) is called once for each key; it is a function of a module, its arguments can be pickled, and
its result is a JSON value. Each result is appended to a file of JSON lines in the folder as soon as it is there, so
that a run that is interrupted, whatever by, continues where it was. A result is the same wherever it was computed. The
module needs nothing of a drive.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import socket
import subprocess
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, TextIO
from urllib.parse import urlsplit

from salient.errors import RunFailed, UsageError, cannot_write
from salient.paths import ROOT
from salient.workers import process_pool

RESULTS = "runs.jsonl"
_WAITING_PER_WORKER = 4
"""Tasks handed out in advance; all of them would be kept in the memory of a scheduler."""
_BREAKS_MAX = 3
"""Deaths of local workers one after the other, with no task finished in between, after which the tasks are to blame."""


@dataclass(frozen=True)
class Task:
    """A run. key: identifies everything that its result depends on."""

    key: str
    arguments: Any


def run(tasks: Sequence[Task], function: Callable[[Any], Any], out: Path, shard: tuple[int, int] = (1, 1),
        scheduler: str | None = None, jobs: int | None = None, afresh: bool = False
        ) -> Generator[tuple[Task, Any], None, None]:
    """Yields each task of the shard with its result: first those that the folder has already, then the others as they
    finish.

    shard: (i, n), every n-th task beginning with the i-th, with a file of its own; several may share a folder.
    scheduler: address of a Dask scheduler, whose workers need this package; without it `jobs` processes of this
    computer, by default as many as it has cores. A worker that dies loses nothing: what it did not finish is done
    again. afresh: forgets what the file of this shard has, once no other process writes it. UsageError: the folder is
    in use or cannot be written, no scheduler answers.
    """
    number, count = shard
    mine = list({task.key: task for task in tasks[number - 1::count]}.values())
    with _open_results(out, shard) as file:
        if afresh:
            file.truncate(0)
        finished = read_results(out)
        todo = [task for task in mine if task.key not in finished]
        for task in mine:
            if task.key in finished:
                yield task, finished[task.key]
        if not todo:
            return
        ended = (_on_this_computer(todo, function, jobs or len(os.sched_getaffinity(0))) if scheduler is None else
                 _on_a_cluster(todo, function, scheduler))
        for task, result in ended:
            line = json.dumps({"key": task.key, "result": result}, allow_nan=False)
            file.write(line + "\n")
            file.flush()
            yield task, json.loads(line)["result"]  # as a later run reads it


@lru_cache
def file_digest(file: Path) -> str:
    """SHA-256 of a file, which does not change while this process lasts."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


@lru_cache
def sources_digest(*names: str) -> str:
    """SHA-256 of the sources under names: files and folders of the repository, those that git ignores left out."""
    listed = subprocess.run(["git", "ls-files", "-co", "--exclude-standard", "--deduplicate", *names], cwd=ROOT,
                            capture_output=True, text=True, check=True).stdout
    digest = hashlib.sha256()
    for path in (ROOT / name for name in sorted(listed.splitlines())):
        digest.update(path.name.encode() + path.read_bytes() if path.is_file() else b"")
    return digest.hexdigest()


def compiled_digest(compiler: Sequence[str], source: str) -> str:
    """SHA-256 of a source and all that it includes. compiler: the command line up to the source, seen from the
    repository's folder, from which `source` is named too. UsageError: the source cannot be preprocessed."""
    listed = subprocess.run([*compiler, "-MM", source], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode != 0:
        raise UsageError(f"{source}: {listed.stderr.strip()[-1000:]}")
    digest = hashlib.sha256()
    for name in listed.stdout.partition(":")[2].replace("\\\n", " ").split():
        digest.update((ROOT / name).read_bytes())
    return digest.hexdigest()


def check_build(present: str, wanted: str) -> None:
    """RunFailed on a worker whose programs have another digest than on the computer that hands out the tasks."""
    if present != wanted:
        raise RunFailed("a worker has another build of the drive than this computer; install the same on all")


def read_results(out: Path) -> dict[str, Any]:
    """The results in a folder, of all shards, by key. The end of a line that was being written is left out. UsageError:
    a line has none."""
    results = {}
    for path in sorted(out.glob("runs*.jsonl")):
        *lines, _ = path.read_bytes().split(b"\n")
        for number, line in enumerate(lines, start=1):
            try:
                entry = json.loads(line)
                results[entry["key"]] = entry["result"]
            except (ValueError, TypeError, KeyError, RecursionError):
                raise UsageError(f"{path}, line {number}: not the result of a run; choose another folder") from None
    return results


def _open_results(out: Path, shard: tuple[int, int]) -> TextIO:
    """The file of a shard, for this process alone until it is closed."""
    path = out / (RESULTS if shard == (1, 1) else f"runs-{shard[0]}-of-{shard[1]}.jsonl")
    try:
        out.mkdir(parents=True, exist_ok=True)
        file = path.open("a", encoding="utf-8")
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _remove_cut_line(path)
    except BlockingIOError:
        raise UsageError(f"{path}: another process writes it; choose another folder or shard") from None
    except OSError as error:
        raise cannot_write(str(path), error) from None
    return file


def _remove_cut_line(path: Path) -> None:
    content = path.read_bytes()
    if not content.endswith(b"\n"):
        os.truncate(path, content.rfind(b"\n") + 1)


# --- execution ------------------------------------------------------------------------------------------------------

def _on_this_computer(tasks: Sequence[Task], function: Callable[[Any], Any], jobs: int
                      ) -> Generator[tuple[Task, Any], None, None]:
    left = {task.key: task for task in tasks}
    breaks = 0
    while left:
        workers = process_pool(jobs)
        try:
            for task, result in _executed(workers, left.values(), function, jobs):
                del left[task.key]
                breaks = 0
                yield task, result
        except BrokenProcessPool:
            breaks += 1
            if breaks == _BREAKS_MAX:
                raise RunFailed(f"worker processes were killed {breaks} times in succession; the next task was "
                                f"{next(iter(left))}") from None
        finally:
            workers.shutdown(wait=True, cancel_futures=True)


def _on_a_cluster(tasks: Sequence[Task], function: Callable[[Any], Any], address: str
                  ) -> Generator[tuple[Task, Any], None, None]:
    try:
        import distributed
    except ImportError:
        raise UsageError(f"--scheduler {address}: the package distributed is missing; "
                         "pip install distributed") from None
    try:
        place = urlsplit(address)
        if place.scheme == "tcp":  # a refusal is known at once; the client would try again for half a minute
            socket.create_connection((place.hostname or "", place.port or 0)).close()
        client: Any = distributed.Client(address, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise UsageError(f"--scheduler {address}: no Dask scheduler answers ({error})") from None
    with client:
        yield from _executed_by(client, distributed, tasks, function)


def _executed_by(client: Any, distributed: Any, tasks: Sequence[Task], function: Callable[[Any], Any]
                 ) -> Generator[tuple[Task, Any], None, None]:
    """As _executed, of a Dask client. Not by its executor, which takes a result that was lost with its worker, between
    the end of the task and its transport, for an exception of the function."""
    waiting = iter(tasks)
    futures: dict[Any, Task] = {}
    ended = distributed.as_completed(loop=client.loop)

    def submit(task: Task) -> None:
        future = client.submit(function, task.arguments, pure=False)
        futures[future] = task
        ended.add(future)

    try:
        for task in islice(waiting, _WAITING_PER_WORKER * max(1, sum(client.ncores().values()))):
            submit(task)
        for future in ended:
            task = futures.pop(future)
            try:
                result = future.result()
            except distributed.CancelledError:  # by the scheduler, which has lost it
                submit(task)
                continue
            yield task, result
            for following in islice(waiting, 1):
                submit(following)
    finally:
        client.cancel(list(futures))


def _executed(workers: Executor, tasks: Iterable[Task], function: Callable[[Any], Any], count: int
              ) -> Generator[tuple[Task, Any], None, None]:
    """Results as they finish. The first exception of the function ends the others."""
    waiting = iter(list(tasks))
    futures: dict[Future[Any], Task] = {}
    try:
        while True:
            while len(futures) < _WAITING_PER_WORKER * count and (task := next(waiting, None)) is not None:
                futures[workers.submit(function, task.arguments)] = task
            if not futures:
                return
            done, _ = wait(futures, return_when=FIRST_COMPLETED)
            for future in done:
                result = future.result()
                yield futures.pop(future), result
    finally:
        for future in futures:
            future.cancel()
