"""Mistakes of the user, as opposed to failures."""

import sys
from collections.abc import Callable


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
