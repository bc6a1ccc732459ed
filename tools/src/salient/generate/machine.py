"""Build step: a machine as C sources, `machine_tables.c` for the firmware and `machine_plant.c` for the emulator, and
as an image, `machine.image`, for programs that read it when they start. All follow from salient.machine.image, once for
all builds (salient.machine.cache).

    python -m salient.generate.machine FILE.toml OUTDIR
"""

from __future__ import annotations

import sys
from pathlib import Path

from salient.errors import UsageError
from salient.generate.files import write_files
from salient.machine.cache import IMAGE_SUFFIX, PLANT_SUFFIX, TABLES_SUFFIX, files_by_content
from salient.machine.content import map_of
from salient.machine.path import MachineError
from salient.paths import DRIVE_DBC, PARAMETERS

_NAMES = {TABLES_SUFFIX: "machine_tables.c", PLANT_SUFFIX: "machine_plant.c", IMAGE_SUFFIX: "machine.image"}


def machine_files(file: Path, folder: Path) -> dict[str, str | bytes]:
    """Contents of machine_tables.c, machine_plant.c, machine.image and their dependency file machine.d, to be written
    to `folder`; MachineError, UsageError."""
    kept = files_by_content(file, tuple(_NAMES))
    made: dict[str, str | bytes] = {name: path.read_bytes() for name, path in zip(_NAMES.values(), kept, strict=True)}
    outputs = " ".join(_escaped(folder / name) for name in made)
    # Never empty: CMake drops a dependency file without inputs, and Ninja would regenerate on every build.
    inputs = [file.resolve(), PARAMETERS, DRIVE_DBC, *map_of(file.absolute(), file.read_bytes())]
    return made | {"machine.d": f"{outputs}: {' '.join(map(_escaped, inputs))}\n"}


def _escaped(path: Path) -> str:
    """For a dependency file, as make reads it."""
    return str(path).replace(" ", "\\ ")


def main(arguments: list[str]) -> int:
    if len(arguments) != 2:
        print("usage: python -m salient.generate.machine FILE.toml OUTDIR", file=sys.stderr)
        return 2
    folder = Path(arguments[1])
    return write_files("salient", folder, lambda: machine_files(Path(arguments[0]), folder), MachineError, UsageError)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
