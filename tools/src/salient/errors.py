"""Mistakes of the user, as opposed to failures."""


class UsageError(Exception):
    """A mistake of the caller; the text is one line that names the mistake and the values allowed. Exit code 2."""


class RunFailed(Exception):
    """The thing tested failed; one line. Exit code 1."""
