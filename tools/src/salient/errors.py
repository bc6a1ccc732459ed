"""Mistakes of the user, as opposed to failures."""


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


def cannot_write(where: str, error: OSError) -> UsageError:
    """The error of a folder or file, named by an option or its path, in which nothing can be written."""
    return UsageError(f"{where}: cannot write there ({error.strerror}); choose a writable folder")
