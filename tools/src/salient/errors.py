"""Mistakes of the user, as opposed to failures."""

import difflib
import sys
from collections.abc import Callable, Iterable


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


def exit_code(command: Callable[[], int]) -> int:
    """Runs a command; returns its exit code, and after one line for what it raises 1 (RunFailed), 2 (UsageError) or 130
    (Ctrl-C)."""
    try:
        return command()
    except UsageError as error:
        print(f"salient: {error}", file=sys.stderr)
        return 2
    except RunFailed as error:
        print(f"salient: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def cannot_write(where: str, error: OSError) -> UsageError:
    """The error of a folder or file, named by an option or its path, in which nothing can be written."""
    return UsageError(f"{where}: cannot write there ({error.strerror}); choose a writable folder")
