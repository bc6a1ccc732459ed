"""Machine images by the content of their machine files, in the build folder: what a drive starts with.

An image is made once and never changed: its name is a hash of what it is made of. Any number of processes may make and
use images at the same time. The folder may be removed while no drive is started.
"""

from __future__ import annotations

import hashlib
import os
import tomllib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from salient.config import DEFAULTS, BenchConfig
from salient.errors import UsageError
from salient.machine.path import MachineError, machine_path, stated_conditions
from salient.paths import BUILD, DRIVE_DBC, IS_WHEEL, PARAMETERS, PYTHON_PACKAGES

FOLDER = BUILD / "machines"
_BYTES_MAX = 30_000_000
"""More than machine files and maps may have."""


def machine_image(name_or_path: str) -> Path:
    """The image of a bundled machine or a machine file. UsageError: a mistake in the file, one line that names it."""
    try:
        path = machine_path(name_or_path)
        while True:
            key = content_key(path)
            cached = FOLDER / f"{key}.machine"
            if cached.exists():
                return cached
            from salient.machine.image import image_of  # NumPy and pydantic: half of the time of a start

            image = image_of(path)
            if content_key(path) == key:  # else the file was changed meanwhile
                _write(cached, image)
    except MachineError as error:
        raise UsageError(str(error)) from None


def bench_config(given: Mapping[str, Any]) -> BenchConfig:
    """The options of a bench: those given, control rate and sensors that [drive] of the machine file states otherwise,
    else the defaults. UsageError: as machine_image."""
    machine = given.get("machine", DEFAULTS["machine"])
    image = given.get("machine_image") or machine_image(machine)  # checks the file
    return BenchConfig(**{**stated_conditions(machine_path(machine)), **given, "machine_image": image})


def content_key(path: Path) -> str:
    """Hash of a machine file, of the map that it names, and of the generator. A file that cannot be used has one too:
    loading it reports the mistake."""
    machine = _content(path)
    digest = hashlib.sha256(_generator())
    for content in (machine, *map(_content, _map_of(path, machine))):
        digest.update(len(content).to_bytes(8, "little") + content)
    return digest.hexdigest()[:32]


def _content(path: Path) -> bytes:
    try:
        if path.is_file() and path.stat().st_size <= _BYTES_MAX:
            return path.read_bytes()
    except OSError:
        pass
    return b"none"


def _map_of(path: Path, machine: bytes) -> list[Path]:
    """The flux-linkage map of a machine file."""
    try:
        return [path.parent / tomllib.loads(machine.decode("utf-8-sig"))["magnetics"]["file"]]
    except (ValueError, RecursionError, KeyError, TypeError):
        return []


@lru_cache
def _generator() -> bytes:
    """Hash of everything that the image of a given file depends on."""
    folder = Path(__file__).parent
    digest = hashlib.sha256()
    others = [*map(folder.with_name, ("toml_file.py", "config.py", "dbc.py")), DRIVE_DBC, PARAMETERS]
    if IS_WHEEL:
        from importlib.metadata import version  # takes as long as the rest of a start

        digest.update(" ".join(map(version, ("numpy", "scipy"))).encode())
    else:
        others.append(PYTHON_PACKAGES)
    for source in [*sorted(folder.glob("*.py")), *others]:
        digest.update(source.name.encode() + b"\0" + source.read_bytes())
    return digest.digest()


def _write(path: Path, content: bytes) -> None:
    """Another process sees the whole file or none."""
    temporary = path.with_name(f"{path.name}.{os.urandom(8).hex()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.write_bytes(content)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise UsageError(f"{path.parent}: {error.strerror}; machine images are kept there") from None
