"""Names of machines: the bundled ones, and files of the user.

Standard library only: a machine whose image is in the cache starts without NumPy and pydantic, which take longer to
import than the drive to start.
"""

from __future__ import annotations

from pathlib import Path

from salient.errors import UsageError
from salient.paths import MACHINES, bundled_or_path


class MachineError(ValueError):
    """A machine file that cannot be used; the text is one line that begins with the file."""


def machine_path(name_or_path: str) -> Path:
    """The file meant by the name of a bundled machine or by a path; MachineError when there is none."""
    try:
        return bundled_or_path(name_or_path, MACHINES, ".toml", "machine")
    except UsageError as error:
        raise MachineError(str(error)) from None
