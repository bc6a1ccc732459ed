"""Mistakes of the user, as opposed to failures."""

import contextlib
import difflib
import errno
import importlib
import os
import select
import signal
import sys
from collections.abc import Callable, Iterable
from typing import Any

from salient.guard import guarded


class UsageError(Exception):
    """A mistake of the caller; the text is one line that names the mistake and the values allowed. Exit code 2."""


SHOWN_MAX = 60  # characters of a wrong value in a message


def shown(value: object) -> str:
    """A wrong value in a message, short and on one line."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):
        return "a value too long to show"
    return text if len(text) <= SHOWN_MAX else f"{text[:SHOWN_MAX]}..."


def reason(error: Exception) -> str:
    """Text of an error in a line that names the file already, as an OSError does by itself."""
    if isinstance(error, KeyError):
        return f"no {error}"
    return (error.strerror if isinstance(error, OSError) else None) or str(error) or type(error).__name__


NAMES_MAX = 8
"""As many names a message lists in full."""
_NEAREST = 3


def close_names(name: object, known: Iterable[str]) -> str:
    """The end of a message about a name that does not exist: all names where they are few, else the nearest three.
    Nearest first: those that contain the name, then by the share of characters that agree, without regard to case."""
    names = list(dict.fromkeys(known))
    if len(names) <= NAMES_MAX:
        listed = f"must be {'one of ' if names[1:] else ''}{', '.join(names)}"
        return listed if names else "there is none"
    wanted = str(name)[:SHOWN_MAX].lower()

    def distance(candidate: str) -> tuple[bool, float]:
        text = candidate.lower()
        return (not wanted or wanted not in text, -difflib.SequenceMatcher(None, wanted, text, autojunk=False).ratio())

    return f"the nearest of {len(names)} are {', '.join(sorted(names, key=distance)[:_NEAREST])}"


class RunFailed(Exception):
    """The thing tested failed; one line. Exit code 1."""


_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
"""Errors of a write, which names no file."""


def optional_package(name: str, needed_by: str) -> Any:
    """A module of a package that only some commands need. UsageError, a line that needed_by begins: it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        raise UsageError(f"{needed_by} requires the Python package {package} (pip install {package})") from None


def exit_code(command: Callable[[], int], out: Callable[[], object] = lambda: None) -> int:
    """Runs a command; returns its exit code, and after one line for what it raises 1 (RunFailed, a connection), 2
    (UsageError, files and folders) or 130 (Ctrl-C). A reader of the output that has enough, as head, is no failure.

    This is the only place that ends a command for what lies outside it; what the command has started and its temporary
    files end with it (salient.guard). out: the value of --out, which stands for the
    file of a write that failed.
    """
    _open_streams()
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # blocked by the launcher while modules are loaded
        with guarded():
            try:
                code = command()
            except SystemExit as end:  # of the command line
                code = end.code if isinstance(end.code, int) else 0
            if sys.stdout is not None:
                sys.stdout.flush()
            return code
    except UsageError as error:
        return _end(str(error), 2)
    except RunFailed as error:
        return _end(str(error), 1)
    except KeyboardInterrupt:
        return _end("interrupted", 130)
    except OSError as error:
        if isinstance(error, BrokenPipeError) and _output_has_no_reader():
            _discard_output()
            return 0
        where = error.filename if error.filename is not None else out() if error.errno in _FULL else None
        text = error.strerror or str(error) or type(error).__name__
        is_file = error.filename is not None or error.errno in _FULL
        is_connection = isinstance(error, ConnectionError | TimeoutError) or not is_file
        _discard_output()  # what could not be written is not tried again at the end of the process
        return _end(text if where is None else f"{where}: {text}", 1 if is_connection else 2)


def _open_streams() -> None:
    """Gives standard streams that the caller has closed (`>&-`) the null device, for this process and what it executes:
    else the next file or socket that is opened gets their number, and what is printed."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            null = os.open(os.devnull, os.O_RDWR)  # the lowest number that is free: this one
            os.set_inheritable(null, True)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))  # noqa: SIM115


def _end(line: str, code: int) -> int:
    with contextlib.suppress(OSError, ValueError):  # standard error may be closed or full, too
        print(f"salient: {' '.join(line.splitlines())}", file=sys.stderr, flush=True)
    return code


def _output_has_no_reader() -> bool:
    """Whether standard output is a pipe whose reader has closed it; else the pipe belongs to a bus or a child."""
    poll = select.poll()
    poll.register(1, 0)
    return any(events & select.POLLERR for _, events in poll.poll(0))


def _discard_output() -> None:
    with contextlib.suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def cannot_write(where: str, error: OSError) -> UsageError:
    """The error of a folder or file, named by an option or its path, in which nothing can be written."""
    return UsageError(f"{where}: cannot write there ({error.strerror}); choose a writable folder")
