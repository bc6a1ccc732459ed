"""Shows the progress of a command: in place on a terminal, elsewhere one line per step."""

from __future__ import annotations

import os
import shutil
from typing import TextIO

_BAR_WIDTH = 24
_ERASE_LINE = "\r\x1b[K"
_LINES_MAX = 20


def steps_of(items: int, stream: TextIO) -> int:
    """Number of steps for the items of a list that may be long: all of them in place, _LINES_MAX lines at most."""
    return items if _is_in_place(stream) else min(items, _LINES_MAX)


def _is_in_place(stream: TextIO) -> bool:
    """Whether a stream is a terminal that can erase a line."""
    return stream.isatty() and os.environ.get("TERM", "dumb") != "dumb"


class Progress:
    """Counts `total` steps on `stream`. Use as a context manager: leaving it clears the line in place. items: length of
    a list whose equal parts are the steps, for item()."""

    def __init__(self, total: int, stream: TextIO, items: int = 0) -> None:
        self._total, self._done, self._stream = total, 0, stream
        self._items, self._items_done = items, 0
        self._in_place = _is_in_place(stream)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._in_place:
            self._write(_ERASE_LINE)

    def item(self, what: str) -> None:
        """Counts an item, and a step when it is the last one of its part; see step."""
        self._items_done += 1
        done = self._items_done
        if done * self._total // self._items > (done - 1) * self._total // self._items:
            self.step(what)

    def step(self, what: str) -> None:
        """Counts a step; `what` names it in a few words."""
        self._done += 1
        if self._in_place:
            filled = _BAR_WIDTH * self._done // self._total
            bar = "#" * filled + "." * (_BAR_WIDTH - filled)
            line = f"[{bar}] {self._done}/{self._total} {what}"
            # One that is as wide as the terminal would go on in the next, which is not erased.
            self._write(f"{_ERASE_LINE}{line[: shutil.get_terminal_size().columns - 1]}")
        else:
            self._write(f"{self._done}/{self._total} {what}\n")

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()
