"""Common parts of all logs that are being written."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import can


class Log(Protocol):
    """A log that is being written."""

    def write(self, time_ns: int, message: can.Message) -> None:
        """Appends a frame."""

    def close(self) -> None:
        """Completes the file."""

    def discard(self) -> None:
        """Completes and removes what was written."""

    @property
    def size(self) -> int:
        """Bytes until now; of a format that is compressed later, those before it is."""

    @property
    def place(self) -> str:
        """The file, or the first and the last of several."""


class FileLog:
    """A log in one file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def place(self) -> str:
        return str(self.path)

    def close(self) -> None:
        raise NotImplementedError

    def discard(self) -> None:
        """Completes and removes the file."""
        self.close()
        self.path.unlink(missing_ok=True)
