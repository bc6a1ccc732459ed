"""Execution of many runs: once for each key, resumable, in shards, whatever is killed. The functions are the
standard library's where a worker has to import them."""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from salient.errors import RunFailed, UsageError
from salient.experiments.tasks import RESULTS, Task, read_results, run

SQUARE_ROOTS = {f"root of {n}": math.sqrt(n) for n in range(40)}


def tasks() -> list[Task]:
    return [Task(f"root of {n}", n) for n in range(40)]


def results(out: Path, **options) -> dict[str, float]:
    return {task.key: result for task, result in run(tasks(), math.sqrt, out, **options)}


def never(_: object) -> None:
    raise AssertionError("executed again")


def log_and_root(arguments: tuple[str, int]) -> float:
    """Appends a line for each execution; the first one of number 7 kills its worker."""
    path, number = arguments
    first = f"{number}\n" not in Path(path).read_text()
    with Path(path).open("a") as file:
        file.write(f"{number}\n")
    if number == 7 and first:
        os.kill(os.getpid(), signal.SIGKILL)
    return math.sqrt(number)


def die(_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_results_are_those_of_the_function_and_in_the_file(tmp_path):
    assert results(tmp_path, jobs=2) == SQUARE_ROOTS == read_results(tmp_path)


def test_finished_tasks_are_not_executed_again(tmp_path):
    results(tmp_path, jobs=2)
    assert {task.key: result for task, result in run(tasks(), never, tmp_path)} == SQUARE_ROOTS


def test_interrupted_run_continues_and_a_cut_line_is_done_again(tmp_path):
    results(tmp_path, jobs=1)
    path = tmp_path / RESULTS
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:5]) + lines[5][:-4])
    assert len(read_results(tmp_path)) == 5
    assert results(tmp_path, jobs=2) == SQUARE_ROOTS
    keys = [json.loads(line)["key"] for line in path.read_text().splitlines()]
    assert sorted(keys) == sorted(SQUARE_ROOTS)


@pytest.mark.parametrize("line", [b"not JSON", b'["key", 1]', b'{"result": 1}', b"\xff\xfe"])
def test_a_line_that_is_no_result_is_named_and_the_file_kept(line, tmp_path):
    path = tmp_path / RESULTS
    path.write_bytes(b'{"key": "4", "result": 2}\n' + line + b"\n")
    with pytest.raises(UsageError, match=r"runs.jsonl, line 2: not the result of a run; choose another folder"):
        results(tmp_path, jobs=1)
    assert path.read_bytes().endswith(line + b"\n")


def test_shards_are_disjoint_and_together_complete(tmp_path):
    parts = [results(tmp_path / "a", shard=(i, 3), jobs=1) for i in (1, 2, 3)]
    assert sorted(key for part in parts for key in part) == sorted(SQUARE_ROOTS)
    assert [len(part) for part in parts] == [14, 13, 13]
    assert read_results(tmp_path / "a") == SQUARE_ROOTS


def test_killed_worker_loses_nothing(tmp_path):
    log = tmp_path / "executions"
    log.write_text("")
    listed = [Task(f"root of {n}", (str(log), n)) for n in range(40)]
    found = {task.key: result for task, result in run(listed, log_and_root, tmp_path, jobs=2)}
    assert found == SQUARE_ROOTS
    executed = log.read_text().split()
    assert executed.count("7") == 2
    assert len(executed) <= 40 + 2 * 4  # only what was handed out and not finished is done again


def test_tasks_that_always_kill_their_worker_end_the_run(tmp_path):
    with pytest.raises(RunFailed, match="killed 3 times in succession; the next task was root of 0"):
        list(run(tasks(), die, tmp_path, jobs=2))


@pytest.mark.in_turns
def test_workers_end_with_a_runner_that_is_killed(tmp_path):
    code = ("import sys, time, pathlib\nfrom salient.experiments.tasks import Task, run\n"
            "out = pathlib.Path(sys.argv[1])\n"
            "for n, _ in enumerate(run([Task(str(n), 0.02) for n in range(10**6)], time.sleep, out, jobs=2)):\n"
            "    print(n, flush=True)\n")
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        for _ in range(4):
            process.stdout.readline()
        process.kill()
        process.stdout.read()  # ends when no process has the pipe any more: the workers have ended, too
    assert len(read_results(tmp_path)) >= 4


def test_workers_are_children_whatever_the_default_of_python_is(tmp_path):
    """From 3.14 on it is a fork server, whose workers have another parent."""
    code = ("import math, multiprocessing, pathlib, sys\n"
            "from salient.experiments.tasks import Task, run\n"
            "if __name__ == '__main__':\n"
            "    multiprocessing.set_start_method('forkserver')\n"
            "    print([result for _, result in run([Task('4', 4)], math.sqrt, pathlib.Path(sys.argv[1]), jobs=1)])\n")
    script = tmp_path / "script.py"
    script.write_text(code)
    done = subprocess.run([sys.executable, str(script), str(tmp_path / "out")], capture_output=True, text=True,
                          check=False)
    assert (done.stdout, done.stderr) == ("[2.0]\n", "")


def test_folder_in_use_is_refused(tmp_path):
    running = run(tasks(), math.sqrt, tmp_path, jobs=1)
    next(running)
    with pytest.raises(UsageError, match="runs.jsonl: another process writes it"):
        results(tmp_path)
    running.close()
    assert results(tmp_path) == SQUARE_ROOTS


def test_a_run_afresh_forgets_its_own_file_only_and_not_while_another_process_writes_it(tmp_path):
    results(tmp_path, shard=(1, 3), jobs=1)
    running = run(tasks(), math.sqrt, tmp_path, jobs=1)
    for _ in range(20):
        next(running)
    written = (tmp_path / RESULTS).read_bytes()
    with pytest.raises(UsageError, match="runs.jsonl: another process writes it"):
        results(tmp_path, afresh=True)
    assert (tmp_path / RESULTS).read_bytes() == written != b""
    running.close()
    assert results(tmp_path, afresh=True, jobs=1) == SQUARE_ROOTS
    keys = [json.loads(line)["key"] for line in (tmp_path / RESULTS).read_text().splitlines()]
    assert sorted(keys) == sorted(list(SQUARE_ROOTS)[n] for n in range(40) if n % 3)


def test_unwritable_folder_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match=r"file/runs.jsonl: cannot write there \(.*\); choose a writable folder"):
        results(tmp_path / "file")


def test_exception_of_the_function_ends_the_run(tmp_path):
    with pytest.raises(ValueError, match="math domain error"):
        list(run([Task("1", 1), Task("-1", -1)], math.sqrt, tmp_path, jobs=1))
    with pytest.raises(FileNotFoundError):
        list(run([Task("of the system", "/nowhere")], os.listdir, tmp_path, jobs=1))


# --- Dask -----------------------------------------------------------------------------------------------------------

def test_missing_scheduler_is_named(tmp_path):
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # and does not listen
        address = f"tcp://127.0.0.1:{unused.getsockname()[1]}"
        with pytest.raises(UsageError, match=f"--scheduler {address}: no Dask scheduler answers"):
            results(tmp_path, scheduler=address)


@pytest.mark.in_turns
def test_scheduler_gives_the_same_results_when_a_worker_is_killed(tmp_path, dask_cluster):
    log = tmp_path / "executions"
    log.write_text("")
    listed = [Task(f"root of {n}", (str(log), n)) for n in range(40)]
    found = {task.key: result for task, result in run(listed, log_and_root, tmp_path, scheduler=dask_cluster.address)}
    assert found == SQUARE_ROOTS
    assert log.read_text().split().count("7") == 2
    assert [worker.poll() for worker in dask_cluster.workers].count(-signal.SIGKILL) == 1
