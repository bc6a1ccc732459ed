"""Machine images: complete, made once by content, by any number of processes at once, without a compiler, and refused
in one line when they are not what the program reads."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from flux_map_files import csv_text, formula, rows, write_machine

from salient.bench.programs import executable
from salient.errors import UsageError
from salient.generate import machine as generate_machine
from salient.machine import cache, image, sources
from salient.machine.cache import machine_image
from salient.paths import MACHINES, ROOT

TIMEOUT_S = 120
BUNDLED = sorted(path.stem for path in MACHINES.glob("*.toml"))


def variation(folder: Path, stem: str, *changes: tuple[str, str], of: str = "saturating") -> Path:
    """A bundled machine with changes of its text."""
    text = (MACHINES / f"{of}.toml").read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / f"{stem}.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cache"
    monkeypatch.setattr(cache, "FOLDER", folder)
    return folder


# --- the list of members --------------------------------------------------------------------------------------------

NESTED = ("machine_format_t", "magnetics_t", "converter_t", "dc_link_t", "sensor_errors_t", "sensor_ranges_t",
          "thermal_data_t", "circuit_t")


def members_of(structure: str) -> list[str]:
    """Names of the members in the C headers, members of nested structures with both names."""
    headers = ("firmware/control/machine_tables.h", "emulator/plant/machine.h", "emulator/plant/magnetics.h",
               "emulator/plant/flux_map.h")
    text = "".join((ROOT / name).read_text(encoding="utf-8") for name in headers)
    text = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    (body,) = re.findall(r"typedef struct \{([^}]*)\} " + structure + ";", text)
    found = []
    for kind, names in re.findall(r"\s*(?:const )?(\w+) ([^;]*);", body):
        for name in names.split(","):
            bare = re.match(r"\s*\*?(\w+)", name)[1]
            found += [f"{bare}.{inner}" for inner in members_of(kind)] if kind in NESTED else [bare]
    return found


@pytest.mark.parametrize(("structure", "apart"), [
    (image.TABLES, []), (image.PLANT, ["name", "magnetics.map"]), (image.FLUX_MAP, []),
])  # fmt: skip
def test_every_member_of_the_c_structures_is_in_the_image(structure: image.Structure, apart: list[str]):
    assert sorted(members_of(structure.type)) == sorted([*apart, *(member.name for member in structure.members)])
    assert len(structure.members) >= 4


def test_a_value_that_its_type_cannot_hold_is_an_error():
    for kind, value in (("uint8_t", 256), ("int16_t", -32769), ("uint32_t", -1)):
        with pytest.raises(OverflowError):
            image.Member("member", kind, lambda value=value: value).array()


# --- the cache ------------------------------------------------------------------------------------------------------

@pytest.mark.in_turns
def test_image_is_made_once_and_again_when_file_or_map_change(empty_cache: Path, tmp_path: Path):
    path = write_machine(tmp_path, "mapped", csv_text(rows(formula("saturating"), range(0, 46, 5), range(10, 101, 10))))
    first = machine_image(str(path))
    stamp = first.stat().st_mtime_ns
    assert machine_image(str(path)) == first and first.stat().st_mtime_ns == stamp
    copied = tmp_path / "elsewhere"
    copied.mkdir()
    for suffix in (".toml", ".csv"):
        shutil.copy(path.with_suffix(suffix), copied)
    assert machine_image(str(copied / path.name)) == first  # by content
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("inertia_kg_m2 = 0.02", "inertia_kg_m2 = 0.03"), encoding="utf-8")
    second = machine_image(str(path))
    flux_map = path.with_suffix(".csv")
    flux_map.write_text(csv_text(rows(formula("linear_cosine"), range(0, 46, 5), range(10, 101, 10))))
    third = machine_image(str(path))
    contents = {made.read_bytes() for made in (first, second, third)}
    assert len(contents) == 3
    assert {entry.name for entry in empty_cache.glob(f"*{cache.IMAGE_SUFFIX}")} == {
        made.name for made in (first, second, third)}
    path.write_text(text, encoding="utf-8")
    flux_map.write_bytes((copied / flux_map.name).read_bytes())
    assert machine_image(str(path)) == first


@pytest.mark.in_turns
def test_c_sources_and_image_are_made_once_for_all_and_again_when_the_file_changes(empty_cache, tmp_path, monkeypatch):
    path = variation(tmp_path, "compiled")
    runs = []

    def files_of(file: Path) -> tuple[str, str, bytes]:
        runs.append(file)
        return original(file)

    original = sources.files_of
    monkeypatch.setattr(sources, "files_of", files_of)
    names = ("machine_tables.c", "machine_plant.c", "machine.image", "machine.d")
    of_the_drive = machine_image(str(path)).read_bytes()
    for build in ("host", "cortex-m4"):
        assert generate_machine.main([str(path), str(tmp_path / build)]) == 0
    host, target = ([(tmp_path / build / name).read_bytes() for name in names] for build in ("host", "cortex-m4"))
    assert host[:3] == target[:3] and of_the_drive == host[2]
    assert host[3].startswith(str(tmp_path / "host").encode())
    assert target[3].startswith(str(tmp_path / "cortex-m4").encode())
    assert len(runs) == 1
    path.write_text(path.read_text(encoding="utf-8").replace("inertia_kg_m2 = 0.02", "inertia_kg_m2 = 0.03"),
                    encoding="utf-8")
    assert generate_machine.main([str(path), str(tmp_path / "host")]) == 0
    assert len(runs) == 2 and (tmp_path / "host" / names[0]).read_bytes() != host[0]


@pytest.mark.in_turns
def test_image_of_a_file_that_changes_meanwhile_is_that_of_its_content(empty_cache, tmp_path, monkeypatch):
    path = variation(tmp_path, "changing")
    before = path.read_text(encoding="utf-8")
    made = []

    def files_of(file: Path) -> tuple[str, str, bytes]:
        result = original(file)
        if not made:  # an editor writes the file between reading and naming
            path.write_text(before.replace("inertia_kg_m2 = 0.02", "inertia_kg_m2 = 0.04"), encoding="utf-8")
        made.append(result[2])
        return result

    original = sources.files_of
    monkeypatch.setattr(sources, "files_of", files_of)
    assert machine_image(str(path)).read_bytes() == made[1] != made[0]
    assert len(list(empty_cache.glob(f"*{cache.IMAGE_SUFFIX}"))) == 1


def test_rejected_file_leaves_no_image(empty_cache: Path, tmp_path: Path):
    path = variation(tmp_path, "wrong", ("resistance_ohm = 0.05", "resistance_ohm = -1"))
    for _ in range(2):
        with pytest.raises(UsageError, match=r"wrong\.toml: winding\.resistance_ohm: -1: must be"):
            machine_image(str(path))
    assert not empty_cache.exists()


def test_cache_that_cannot_be_written_is_named(empty_cache: Path):
    empty_cache.write_text("a file")
    with pytest.raises(UsageError, match=re.escape(f"{empty_cache}: ")) as caught:
        machine_image("saturating")
    assert "\n" not in str(caught.value)
    assert empty_cache.read_text() == "a file"


# --- drives ---------------------------------------------------------------------------------------------------------

RUN = """
import sys
from pathlib import Path
from salient.machine import cache
cache.FOLDER = Path(sys.argv[1])
from salient.bench.bench import Bench
from salient.config import BenchConfig
import tempfile, json
with tempfile.TemporaryDirectory() as folder, Bench(BenchConfig(machine=sys.argv[2]), f"unix:{folder}/can") as bench:
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.05)
    print(json.dumps([bench.simulator.ready["machine"], bench.truth["speed_rpm"].last, bench.drive.fault]))
"""


def started(folder: Path, machine: str | Path, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-c", RUN, folder, machine], stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, text=True, env={**os.environ, **environment})


def result_of(process: subprocess.Popen[str]) -> list:
    output, errors = process.communicate()
    assert (process.returncode, errors) == (0, "")
    return json.loads(output)


@pytest.mark.in_turns
def test_16_processes_start_8_machines_at_once_from_an_empty_cache(tmp_path: Path):
    inertia = "inertia_kg_m2 = 0.02"
    files: list[str | Path] = [
        *BUNDLED,
        *(variation(tmp_path, f"lighter_{number}", (inertia, f"inertia_kg_m2 = 0.01{number}")) for number in range(4)),
    ]
    assert len(files) == 8
    folder = tmp_path / "cache"
    processes = [started(folder, file) for file in files * 2]
    results = [result_of(process) for process in processes]
    assert results[:8] == results[8:]  # equal bits, from whichever process the image is
    assert all(fault == "none" and speed_rpm > 30.0 for _, speed_rpm, fault in results)
    assert [name for name, *_ in results[:4]] == BUNDLED
    kept = {entry.name for entry in folder.iterdir()}
    images = {name for name in kept if re.fullmatch(r"[0-9a-f]{32}\.machine", name)}
    generated = {name.replace(".machine", suffix) for name in images for suffix in (".tables.c", ".plant.c")}
    copies = {name for name in kept if re.fullmatch(r"[0-9a-f]{32}\.[0-9a-f]{8}", name)}
    assert len(images) == 8 and len(copies) == 4  # the machine files that are not bundled, by the hash of their DBC
    assert kept == images | generated | copies


def test_machine_file_starts_without_a_compiler(tmp_path: Path):
    path = variation(tmp_path, "mine", ("inertia_kg_m2 = 0.02", "inertia_kg_m2 = 0.017"))
    name, speed_rpm, fault = result_of(started(tmp_path / "cache", path, PATH="/nonexistent"))
    assert (name, fault) == ("saturating", "none")
    assert 30.0 < speed_rpm < 310.0


@pytest.mark.parametrize("stem", ["saturating", "half the inertia", "-motor.2"])
def test_machine_file_of_any_name_is_the_machine_that_runs(make_bench: Callable, tmp_path: Path, stem: str):
    """Half the inertia: accelerates about twice as fast, also under the name of a bundled machine."""
    path = variation(tmp_path, stem, ("inertia_kg_m2 = 0.02", "inertia_kg_m2 = 0.01"))
    speeds = []
    for machine in (str(path), "saturating"):
        bench = make_bench(machine=machine, controller="paper")
        bench.drive.speed_reference_rpm = 3000
        bench.run_for(0.05)
        speeds.append(bench.truth["speed_rpm"].last)
    assert speeds[0] / speeds[1] == pytest.approx(2.0, abs=0.3)


@pytest.mark.parametrize(("change", "expected"), [
    (lambda content: content[:-1], "damaged machine image"),
    (lambda content: content[:20], "not a machine image"),
    (lambda content: b"", "not a machine image"),
    (lambda content: b"name = 'a machine file'" + content, "not a machine image"),
    (lambda content: content[:8] + b"\1\2\3\4" + content[12:], "machine image of another version"),
    (lambda content: content[:4000] + bytes([content[4000] ^ 1]) + content[4001:], "damaged machine image"),
    (lambda content: content + content, "damaged machine image"),
])  # fmt: skip
def test_wrong_image_is_one_line_and_exit_code_2(tmp_path: Path, change: Callable[[bytes], bytes], expected: str):
    path = tmp_path / "wrong.machine"
    path.write_bytes(change(machine_image("saturating").read_bytes()))
    result = subprocess.run([executable(), "--can", f"unix:{tmp_path}/bus", "--machine-image", path],
                            capture_output=True, text=True, timeout=TIMEOUT_S)
    assert (result.returncode, result.stdout) == (2, "")
    assert re.fullmatch(rf"salient: {re.escape(str(path))}: {expected}[^\n]*\n", result.stderr), result.stderr
    assert [entry.name for entry in tmp_path.iterdir()] == ["wrong.machine"]
