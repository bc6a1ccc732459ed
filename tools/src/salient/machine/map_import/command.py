"""salient machine MACHINE --import FILE: writes a machine file with the imported map."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from salient.errors import UsageError
from salient.machine.file import Named, Poles, poles_and_phases
from salient.machine.flux_map import FluxMapError
from salient.machine.flux_map_csv import FILE_BYTES_MAX, map_of_text
from salient.machine.map_import.correct import Imported, Supply, correct
from salient.machine.map_import.layouts import Points, points_of
from salient.machine.map_import.mat import is_mat, is_octave, mat_points, octave_points
from salient.machine.map_import.text import blocks, decode
from salient.paths import keep_sources
from salient.toml_file import TextFileError, read_bytes, read_text, read_toml, validate

_BINARY = {b"PK\x03\x04": ("a spreadsheet or another ZIP file", "save the table as CSV"),
           b"\xd0\xcf\x11\xe0": ("a spreadsheet of an old Excel", "save the table as CSV"),
           b"\x93NUMPY": ("an array of NumPy", "write it with numpy.savetxt"),
           b"%PDF": ("a PDF", "export the table as CSV")}
"""By their first bytes."""


def import_map(machine: Path, table: Path, out: Path) -> tuple[Path, list[str]]:
    """Writes NAME.csv and NAME.toml to a folder: the map of the table, and the machine file with it for its magnetics.
    Returns the machine file and the lines that say what was corrected. UsageError."""
    try:
        data = read_toml(machine)
        stator, rotor, phases = poles_and_phases(validate(Poles, data.get("poles", {}), "poles"))
        # It is a part of the paths that are written, which must not lead out of the folder.
        name = validate(Named, {key: value for key, value in data.items() if key == "name"}).name
        supply = Supply(_number(data, "converter", "supply_voltage_V"), _number(data, "winding", "resistance_ohm"))
        source = read_text(machine, 1_000_000)
    except TextFileError as error:
        raise UsageError(f"{machine}: {error}") from None
    try:
        imported = correct(read_points(table), rotor, phases, supply)
        text = map_text(imported, table.name, stator, rotor)
        map_of_text(text, rotor)
    except FluxMapError as error:
        raise UsageError(f"{table}: {error}") from None
    paths = (out / f"{name}.csv", out / f"{name}.toml")
    keep_sources(f"--out {out}", paths, machine, table)
    try:
        machine_text = with_map(source, data, paths[0].name, table.name)
    except TextFileError as error:
        raise UsageError(f"{machine}: {error}") from None
    try:
        out.mkdir(parents=True, exist_ok=True)
        paths[0].write_text(text, encoding="utf-8")
        paths[1].write_text(machine_text, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"--out {out}: {error.strerror}") from None
    return paths[1], imported.lines


def read_points(table: Path) -> Points:
    """The points of a CSV, text or MAT file. FluxMapError."""
    try:
        data = read_bytes(table, FILE_BYTES_MAX)
    except TextFileError as error:
        raise FluxMapError(str(error)) from None
    if is_mat(data, table.suffix):
        return mat_points(data)
    for sign, (kind, way) in _BINARY.items():
        if data.startswith(sign):
            raise FluxMapError(f"{kind}, which is not read; {way}")
    text = decode(data)
    return octave_points(text) if is_octave(text) else points_of(blocks(text))


def map_text(imported: Imported, source: str, stator_poles: int, rotor_poles: int) -> str:
    """The map as a machine file reads it, with its source and corrections in comments."""
    rows = [f"{angle:.9g},{current:.9g},{flux:.9g}"
            for angle, fluxes in zip(imported.angle_deg, imported.flux_Wb, strict=True)
            for current, flux in zip(imported.current_A, fluxes, strict=True)]
    head = [f"Imported from {source!r} by tools/salient machine --import, for {stator_poles}/{rotor_poles} poles."]
    comments = [f"# {line}" for line in [*head, *imported.lines]]
    return "\n".join([*comments, "angle_deg,current_A,flux_linkage_Wb", *rows, ""])


def with_map(source: str, data: dict[str, Any], map_name: str, table_name: str) -> str:
    """The text of a machine file with a map for its table [magnetics]; the rest as it is, comments included."""
    magnetics = (f"[magnetics] # map imported from {table_name!r}, corrections: top of {map_name}\n"
                 f'form = "map"\nfile = "{map_name}"\n')
    text, count = re.subn(r"(?ms)^[ \t]*\[[ \t]*magnetics[ \t]*\].*?(?=^[ \t]*\[|\Z)", lambda _: magnetics + "\n",
                          source)
    if count == 0:
        text = f"{source.rstrip()}\n\n{magnetics}"
    try:
        result = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        result = {}
    if result != data | {"magnetics": {"form": "map", "file": map_name}}:
        raise TextFileError("magnetics: write it as a table of its own, [magnetics], which the import can replace")
    return text


def _number(data: dict[str, Any], table: str, key: str) -> float:
    value = data.get(table, {}).get(key) if isinstance(data.get(table, {}), dict) else None
    if not isinstance(value, int | float) or isinstance(value, bool) or value <= 0.0:
        raise TextFileError(f"{table}.{key}: missing, or not a number above 0")
    return float(value)
