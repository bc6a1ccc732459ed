"""Reads a text file that somebody else wrote: never waits, never takes more than it may."""

from __future__ import annotations

import stat
import tomllib
from pathlib import Path

TOML_BYTES_MAX = 1_000_000


class TextFileError(Exception):
    """A file that cannot be read; the text is the rest of a line that begins with its path."""


def read_text(path: Path, bytes_max: int) -> str:
    """The whole file, UTF-8 with or without a mark at its start."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise TextFileError("not a file")  # a pipe would make us wait, a device may never end
        if status.st_size > bytes_max:
            raise TextFileError(f"larger than {bytes_max // 1_000_000} MB")
        return path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise TextFileError("no such file") from None
    except OSError as error:
        raise TextFileError(f"cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise TextFileError(f"not UTF-8 at byte {error.start + 1}") from None


def read_toml(path: Path) -> dict:
    """The tables of a TOML file of at most TOML_BYTES_MAX."""
    try:
        return tomllib.loads(read_text(path, TOML_BYTES_MAX))
    except tomllib.TOMLDecodeError as error:
        raise TextFileError(f"not TOML: {error}") from None
    except (ValueError, RecursionError):  # what tomllib lets through
        raise TextFileError("not TOML: a number too long or tables too deep") from None
