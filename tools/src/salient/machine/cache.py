"""Machine images and C sources by the content of their machine files, in the build folder: a drive starts with an
image, a drive of one machine is compiled with the sources.

They are made once and never changed: their name is a hash of what they are made of. Any number of processes may make
and use them at the same time. The folder may be removed while no drive is started. With an image the machine file is
kept, under the hash of the drive's DBC, which a drive sends: its frames can be decoded when the file has been changed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from salient.config import DEFAULTS, BenchConfig
from salient.errors import UsageError, close_names
from salient.machine.content import content_of, map_of
from salient.machine.path import MachineError, machine_path, stated_conditions
from salient.paths import (
    BUILD,
    DRIVE_DBC,
    EXAMPLE_MACHINES,
    IS_WHEEL,
    MACHINES,
    PARAMETERS,
    PYTHON_PACKAGES,
    write_whole,
)

FOLDER = BUILD / "machines"
IMAGE_SUFFIX = ".machine"
TABLES_SUFFIX, PLANT_SUFFIX = ".tables.c", ".plant.c"


def machine_image(name_or_path: str, true_machine: str | None = None) -> Path:
    """The image of a bundled machine or a machine file; with a true machine its firmware's tables beside the plant of
    that one (salient.machine.pair). UsageError: a mistake in a file, or two that do not fit; one line that names it."""
    try:
        path = machine_path(name_or_path)
        if true_machine is None:
            return files_by_content(path)[0]
        return _image_of_pair(path, machine_path(true_machine))
    except MachineError as error:
        raise UsageError(str(error)) from None


def files_by_content(path: Path, suffixes: Sequence[str] = (IMAGE_SUFFIX,)) -> list[Path]:
    """Files of these suffixes of a machine file; all are made at once (files_of of salient.machine.sources).
    MachineError: a mistake in the file; UsageError: they cannot be kept."""
    while True:
        key = content_key(path)
        kept = [FOLDER / f"{key}{suffix}" for suffix in suffixes]
        if all(file.exists() for file in kept):
            return kept
        made = _make(path)
        if content_key(path) == key:  # else the file was changed meanwhile
            for suffix, content in made.items():
                _write(FOLDER / f"{key}{suffix}", content)


def _image_of_pair(path: Path, true_path: Path) -> Path:
    """MachineError: the machines do not fit together, or a mistake in a file."""
    while True:
        image, _ = files_by_content(path)[0], files_by_content(true_path)  # checks both
        keys = (content_key(path), content_key(true_path))
        kept = FOLDER / f"{hashlib.sha256(' '.join(keys).encode()).hexdigest()[:32]}{IMAGE_SUFFIX}"
        if kept.exists():
            return kept
        from salient.machine.pair import image_of_pair  # NumPy and pydantic, as in _make

        made = image_of_pair(image.read_bytes(), path, true_path)
        if image.stem == keys[0] and keys == (content_key(path), content_key(true_path)):  # else one changed meanwhile
            _write(kept, made)
            return kept


def _make(path: Path) -> Mapping[str, bytes]:
    from salient.machine.sources import files_of  # NumPy and pydantic: half of the time of a start

    tables, plant, image = files_of(path)
    return {**_copy(path), TABLES_SUFFIX: tables.encode(), PLANT_SUFFIX: plant.encode(), IMAGE_SUFFIX: image}


def _copy(path: Path) -> Mapping[str, bytes]:
    """A machine file of the user and its map, in a folder of their own whose name has the hash of the drive's DBC; none
    of a file with a map elsewhere, which it would not find from there."""
    from salient.dbc import database_hash
    from salient.machine.file import load_machine
    from salient.machine.scaling import database_of, scaling_of

    content = content_of(path)
    maps = map_of(path, content)
    if path.parent in (MACHINES, EXAMPLE_MACHINES) or any(file.parent != path.parent for file in maps):
        return {}
    machine = load_machine(path)
    folder = _copy_folder(database_hash(database_of(scaling_of(path, machine).dbc())))
    return {**{f"{folder}/{file.name}": content_of(file) for file in maps}, f"{folder}/{machine.name}.toml": content}


def _copy_folder(dbc_hash: int) -> str:
    return f".{dbc_hash:08x}"


def kept_machines(dbc_hash: int) -> list[Path]:
    """The machine files of the user with which drives of this DBC have been started, the newest first."""
    found = [(file.stat().st_mtime_ns, file) for file in FOLDER.glob(f"*{_copy_folder(dbc_hash)}/*.toml")]
    return [file for _, file in sorted(found, reverse=True)]


def check_options(given: Iterable[str]) -> None:
    """UsageError for a name that no option of a bench has."""
    for name in given:
        if name not in DEFAULTS:
            raise UsageError(f"bench option '{name}': no such option; {close_names(name, DEFAULTS)}")


def bench_config(given: Mapping[str, Any]) -> BenchConfig:
    """The options of a bench: those given, control rate and sensors that [drive] of the machine file states otherwise,
    else the defaults. UsageError: no such option; as machine_image."""
    check_options(given)
    machine = given.get("machine", DEFAULTS["machine"])
    image = given.get("machine_image") or machine_image(machine, given.get("true_machine"))  # checks the file
    return BenchConfig(**{**stated_conditions(machine_path(machine)), **given, "machine_image": image})


def content_key(path: Path) -> str:
    """Hash of a machine file, of the map that it names, and of the generator. A file that cannot be used has one too:
    loading it reports the mistake."""
    machine = content_of(path)
    digest = hashlib.sha256(_generator())
    for content in (machine, *map(content_of, map_of(path, machine))):
        digest.update(len(content).to_bytes(8, "little") + content)
    return digest.hexdigest()[:32]


@lru_cache
def _generator() -> bytes:
    """Hash of everything that the image and the C sources of a given file depend on."""
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
    try:
        write_whole(path, content)
    except OSError as error:
        raise UsageError(f"{path.parent}: {error.strerror}; machine images are kept there") from None
