"""What a user did wrong, as opposed to what went wrong."""


class UsageError(Exception):
    """A mistake of the caller; the text is one line that names the offending thing and what is allowed. Exit code 2."""
