"""The error of the generators."""


class CodecError(Exception):
    """The database cannot be used; the message names it and the reason, in one line."""
