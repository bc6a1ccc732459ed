"""Names of machines: the bundled ones, and files of the user.

Standard library only: a machine whose image is in the cache starts without NumPy and pydantic, which take longer to
import than the drive to start.
"""

from __future__ import annotations

from pathlib import Path

from salient.paths import MACHINES

_SHOWN_MAX = 60  # characters of a name in a message


class MachineError(ValueError):
    """A machine file that cannot be used; the text is one line that begins with the file."""


def machine_path(name_or_path: str) -> Path:
    """The file meant by the name of a bundled machine or by a path; MachineError when there is none."""
    bundled, path = MACHINES / f"{name_or_path}.toml", Path(name_or_path)
    try:
        if bundled.is_file():
            return bundled
        if path.is_file():
            return path.resolve()
    except OSError:
        pass  # a name too long for a file: there is none
    names = ", ".join(sorted(p.stem for p in MACHINES.glob("*.toml")))
    text = repr(name_or_path)
    shown = text if len(text) <= _SHOWN_MAX else f"{text[:_SHOWN_MAX]}..."
    raise MachineError(f"machine {shown}: no such file, and no bundled machine of that name ({names})")
