"""Names of machines: the bundled ones, the examples', and files of the user.

Standard library only: a machine whose image is in the cache starts without NumPy and pydantic, which take longer to
import than the drive to start.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from salient.config import CONDITIONS
from salient.errors import UsageError
from salient.paths import EXAMPLE_MACHINES, MACHINES, bundled_or_path


class MachineError(UsageError, ValueError):
    """A machine file that cannot be used; the text is one line that begins with the file."""


def machine_path(name_or_path: str) -> Path:
    """The file meant by the name of a machine, bundled or of the examples, or by a path; MachineError when there is
    none."""
    try:
        return bundled_or_path(name_or_path, MACHINES, ".toml", "machine", EXAMPLE_MACHINES)
    except UsageError as error:
        raise MachineError(str(error)) from None


def stated_conditions(path: Path) -> dict[str, Any]:
    """Control rate and sensors that the table [drive] of a machine file states, by the name of their option. The file
    must be a checked one, as the file of a machine_image is."""
    drive = tomllib.loads(path.read_text(encoding="utf-8-sig")).get("drive", {})
    return {name: value for name, value in drive.items() if name in CONDITIONS}
