"""The end of a command, whatever ends it: no process of it goes on, and nothing temporary is left.

    with guarded():
        ...

A process that ends by SIGKILL can do nothing about what it has started and written, and one that ends by SIGTERM or
SIGHUP is no better. Therefore a second process, which this file is when it is executed, waits for the end of the
first. It then ends all processes that belong to the run, and removes the folder of the run, and what removes() and
removes_socket() name.

A process belongs to a run when its environment names the folder of the run, or when it has this folder open, as what
is forked without being executed has. Runs can be nested, as the commands that a test suite starts: a process belongs
to all of them. Standard library only: the launcher imports this module before anything is installed.
"""

from __future__ import annotations

import fcntl
import os
import select
import signal
import sys
import tempfile
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

RUNS = "SALIENT_RUNS"
"""Environment variable: the folders of the runs that a process belongs to, the outermost first."""
_LIST, _SOCKETS = "removed_at_the_end", "sockets_removed_at_the_end"
_PIDFD = 3
_TERM_GRACE_S = 5.0
"""Time in which a process may end its recordings and remove its files before it is killed."""
_LOOK_S = 0.05
_CLIENTS_LOOK_S = 2.0
"""Time in which the clients of a bus may find the socket that tells them that its server was killed."""
_held: list[int] = []
"""The descriptor of the folder of the run that this process has begun, which what it forks has, too."""


@contextmanager
def guarded() -> Generator[None, None, None]:
    """All that this process starts ends with it, at the latest; its temporary files are in a folder of its own, which
    is removed. Within another guarded() without effect."""
    if _held or not begin():
        yield
        return
    try:
        yield
    finally:
        _end()


def removes(path: Path) -> None:
    """A file, folder or socket of this name is removed when the run has ended; a socket only without a server."""
    _note(_LIST, path)


def removes_socket(path: Path) -> None:
    """A socket of this name, which the user has chosen, is removed when the run has ended, without a server; a file or
    a folder of this name is not of the run."""
    _note(_SOCKETS, path)


def _note(name: str, path: Path) -> None:
    if folder := _folder():
        with suppress(OSError), (folder / name).open("ab") as file:
            file.write(os.fsencode(path.absolute()) + b"\0")


def _noted(name: str, folder: Path) -> list[Path]:
    try:
        return [Path(os.fsdecode(path)) for path in (folder / name).read_bytes().split(b"\0") if path]
    except OSError:
        return []


def outside() -> Path:
    """Folder of temporary files that no run removes."""
    outermost = os.environ.get(RUNS, "").partition(os.pathsep)[0]
    return Path(outermost).parent if outermost else Path(tempfile.gettempdir())


def _folder() -> Path | None:
    """The folder of the innermost run."""
    runs = os.environ.get(RUNS)
    return Path(runs.rpartition(os.pathsep)[2]) if runs else None


def begin() -> bool:
    """As guarded(), until the process ends. False where that cannot be done: temporary files have no place, or the
    system is no Linux with pidfd_open."""
    if _held:
        return True
    folder = _folder()
    if folder is None or not folder.name.startswith(f"salient-{os.getpid()}-") or not folder.is_dir():
        try:
            pidfd = os.pidfd_open(os.getpid())
        except (AttributeError, OSError):
            return False
        folder = None
        try:
            # Beside the folders of the runs around it: a path within all of them is too long for sockets.
            folder = Path(tempfile.mkdtemp(prefix=f"salient-{os.getpid()}-", dir=outside())).absolute()
            _start(pidfd, folder)
        except (OSError, NotImplementedError):
            if folder:
                folder.rmdir()
            return False
        finally:
            os.close(pidfd)
        os.environ[RUNS] = os.pathsep.join(filter(None, (os.environ.get(RUNS), str(folder))))
        os.environ["TMPDIR"] = tempfile.tempdir = str(folder)
    # Else this process has been guarded before it executed another program, as the launcher does.
    _held.append(os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC))
    return True


def _start(pidfd: int, folder: Path) -> None:
    null = os.open(os.devnull, os.O_RDWR)
    kept = fcntl.fcntl(pidfd, fcntl.F_DUPFD_CLOEXEC, 10)  # not one that is about to become standard input or output
    try:
        os.posix_spawn(sys.executable, [sys.executable, "-I", "-S", __file__, str(os.getpid()), str(folder)], {},
                       file_actions=[*((os.POSIX_SPAWN_DUP2, null, number) for number in range(3)),
                                     (os.POSIX_SPAWN_DUP2, kept, _PIDFD)], setsid=True)
    finally:
        os.close(kept)
        os.close(null)


def _end() -> None:
    """Removes the folder at once, so that it is gone when the process has ended in order; the list is needed yet."""
    os.close(_held.pop())
    folder = _folder()
    if folder is None:
        return
    runs = os.environ[RUNS].rpartition(os.pathsep)[0]
    os.environ[RUNS] = runs
    if not runs:
        del os.environ[RUNS]
    os.environ["TMPDIR"] = tempfile.tempdir = str(_folder() or folder.parent)
    if not any((folder / name).exists() for name in (_LIST, _SOCKETS)):
        _remove(folder)


# --- the second process ---------------------------------------------------------------------------------------------

def main(pid: int, folder: Path) -> None:
    """Waits for the end of the process of descriptor _PIDFD, and ends the run of that folder."""
    for request in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(request, signal.SIG_IGN)
    for number in [int(path.name) for path in Path("/proc/self/fd").iterdir()]:
        if number > _PIDFD:
            with suppress(OSError):
                os.close(number)  # a pipe of the caller must not stay open for this process
    os.chdir("/")
    begin = _begin_of(pid)
    select.select([_PIDFD], [], [])
    _end_processes(str(folder), begin)
    named, chosen = _noted(_LIST, folder), _noted(_SOCKETS, folder)
    _remove(folder)
    for path in named:
        if not path.is_socket():
            _remove(path)
    if sockets := [path for path in (*named, *chosen) if path.is_socket()]:
        time.sleep(_CLIENTS_LOOK_S)
        served = Path("/proc/net/unix").read_bytes().split()
        for path in sockets:
            if os.fsencode(path) not in served:
                _remove(path)


def _end_processes(folder: str, begin: int) -> None:
    """Requests all processes of the run to end, and kills those that do not. Two looks without any are the end: one
    that is about to execute another program may for a moment show neither of its signs."""
    asked: set[int] = set()
    killed_from_s = time.monotonic() + _TERM_GRACE_S
    looks_left = 2
    while looks_left:
        looks_left -= 1
        for pid in _processes(folder, begin):
            looks_left = 2
            must_die = time.monotonic() > killed_from_s
            if must_die or pid not in asked:
                asked.add(pid)
                with suppress(OSError):
                    os.kill(pid, signal.SIGKILL if must_die else signal.SIGTERM)
        if looks_left:
            time.sleep(_LOOK_S)


def _processes(folder: str, begin: int) -> Iterator[int]:
    """Processes of a run that are not older than its first one."""
    wanted = os.fsencode(folder)
    for entry in os.scandir("/proc"):
        if entry.name.isdigit() and int(entry.name) != os.getpid() and _begin_of(int(entry.name)) >= begin:
            with suppress(OSError):
                if _has(wanted, Path(entry.path)):
                    yield int(entry.name)


def _has(folder: bytes, process: Path) -> bool:
    for variable in (process / "environ").read_bytes().split(b"\0"):
        name, _, value = variable.partition(b"=")
        if name == RUNS.encode() and folder in value.split(os.pathsep.encode()):
            return True
    for entry in os.scandir(process / "fd"):
        with suppress(OSError):
            if os.fsencode(os.readlink(entry.path)) == folder:  # noqa: PTH115 - a Path costs more than the call
                return True
    return False


def _begin_of(pid: int) -> int:
    """Start of a process in clock ticks since the system's; -1: it has ended."""
    try:
        text = Path(f"/proc/{pid}/stat").read_bytes()
    except OSError:
        return -1
    state, *fields = text.rpartition(b")")[2].split()
    return -1 if state in b"ZX" else int(fields[18])


def _remove(path: Path) -> None:
    """Removes a file, a socket or a folder with all that is in it; what cannot be removed stays."""
    try:
        path.unlink(missing_ok=True)
    except OSError:
        import shutil  # takes longer than the rest of this module

        shutil.rmtree(path, ignore_errors=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]))
