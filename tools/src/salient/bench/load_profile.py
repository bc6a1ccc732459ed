"""Load profiles: load torque over the rotor angle, from CSV files.

Lines that start with # and blank lines are ignored. The first other line is the header `angle_deg,torque`; then follow
8 to 256 rows at equal steps of the mechanical angle, which cover one turn from 0: the last is one step below 360. The
torque is a factor of the rig variable load_profile_Nm, between the rows it is linear.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from salient.errors import UsageError, shown
from salient.paths import LOADS, bundled_or_path
from salient.toml_file import TextFileError, read_text

_HEADER = "angle_deg,torque"
LOAD_PROFILE_VALUES_MAX = 256
LOAD_PROFILE_VALUE_MAX = 1000.0
_VALUES_MIN = 8
_FILE_BYTES_MAX = 1_000_000
_ANGLE_TOLERANCE_DEG = 0.01


def load_profile_path(name_or_path: str) -> Path:
    """The file meant by the name of a bundled profile or by a path; UsageError when there is none."""
    return bundled_or_path(name_or_path, LOADS, ".csv", "load_profile")


@lru_cache
def read_load_profile(path: Path) -> tuple[float, ...]:
    """The values of a file. UsageError: one line with the file, where possible its line, and what is allowed."""
    try:
        return _values(read_text(path, _FILE_BYTES_MAX))
    except TextFileError as error:
        raise UsageError(f"{path}: {error}") from None


def _values(text: str) -> tuple[float, ...]:
    lines = [(number, line.strip()) for number, line in enumerate(text.split("\n"), start=1)
             if line.strip() and not line.lstrip().startswith("#")]
    if not lines or lines[0][1].replace(" ", "") != _HEADER:
        raise TextFileError(f"the header must be {_HEADER}")
    rows = lines[1:]
    if not _VALUES_MIN <= len(rows) <= LOAD_PROFILE_VALUES_MAX:
        raise TextFileError(f"{len(rows)} rows; must be {_VALUES_MIN} to {LOAD_PROFILE_VALUES_MAX}")
    return tuple(_value(number, row, 360.0 * n / len(rows)) for n, (number, row) in enumerate(rows))


def _value(number: int, row: str, expected_deg: float) -> float:
    try:
        angle_deg, torque = (float(cell) for cell in row.split(","))
    except ValueError:
        raise TextFileError(f"line {number}: {shown(row)}: must be two numbers, {_HEADER}") from None
    if not abs(angle_deg - expected_deg) <= _ANGLE_TOLERANCE_DEG:
        raise TextFileError(f"line {number}: angle_deg {angle_deg:g}: must be {expected_deg:g}, for equal steps over "
                            "one turn")
    if not abs(torque) <= LOAD_PROFILE_VALUE_MAX:
        raise TextFileError(f"line {number}: torque {torque:g}: must be a number from {-LOAD_PROFILE_VALUE_MAX:g} to "
                            f"{LOAD_PROFILE_VALUE_MAX:g}")
    return torque
