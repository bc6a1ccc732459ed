"""salient machine, and the documentation of the machine file."""

from __future__ import annotations

import re
import tomllib

import pytest

from salient.machine import file as machine
from salient.machine.report import describe
from salient.paths import MACHINES, ROOT

PAGE = (ROOT / "docs" / "machines" / "file.md").read_text(encoding="utf-8")


def test_reference_lists_exactly_the_keys_of_a_machine_file():
    tables = [machine.Poles, machine.Winding, machine.Mechanics, machine.Converter, machine.DcLink, machine.Sensors,
              machine.Coupling, machine.EddyCurrent, machine.Spread, machine.IronLoss, machine.Thermal, machine.Drive,
              *machine.MAGNETICS.values()]
    keys = {key for table in tables for key in table.model_fields} | {"name"}
    table = PAGE.partition("## Keys")[2].partition("\n## ")[0]
    rows = [row.split("|")[2] for row in table.splitlines() if row.startswith("| ") and "---" not in row]
    assert set(re.findall(r"`(\w+)`", "".join(rows))) == keys


def test_reference_lists_exactly_the_bundled_machines():
    table = PAGE.partition("| bundled |")[2].partition("## Keys")[0]
    rows = [row.split("|")[1] for row in table.splitlines() if row.startswith("| `")]
    assert set(re.findall(r"`(\w+)`", "".join(rows))) == {path.stem for path in MACHINES.glob("*.toml")}


@pytest.mark.in_turns
def test_bundled_machine_is_described_and_plotted(salient, tmp_path):
    result = salient("machine", "saturating", "--out", tmp_path / "view")
    assert result.returncode == 0, result.stderr
    # Check values from the source of the machine.
    assert "6/4 poles, 3 phases" in result.stdout
    assert "23.60 mH aligned, 0.67 mH unaligned" in result.stdout
    assert "1.82 N m at 10 A, 6.17 N m at 20 A, 11.9 N m at 30 A, 25.3 N m at 50 A" in result.stdout
    # A pulse of the largest torque, at half of the last speed.
    found = re.search(r"2250 r/min +([\d.]+) N m +(\d+) to (\d+) deg +([\d.]+) N m +(\d+) to (\d+) deg", result.stdout)
    assert [float(value) for value in found.groups()] == pytest.approx([26.1, 176, 342, 26.1, 290, 536], rel=0.02)
    picture = tmp_path / "view" / "saturating.png"
    assert picture.read_bytes().startswith(b"\x89PNG") and picture.stat().st_size > 20_000


def test_converter_and_sensors_of_a_file_are_described():
    for path in MACHINES.glob("*.toml"):
        data = tomllib.loads(path.read_text())
        text = "\n".join(describe(machine.load_machine(path)))
        stated = {**data["converter"], **data.get("sensors", {})}
        del stated["supply_voltage_V"]
        assert all(f"{key} {value:g}" in text for key, value in stated.items())
        assert ("converter   ideal" in text) == (len(data["converter"]) == 1)


@pytest.mark.in_turns
def test_invalid_file_is_one_line_and_exit_code_2(salient, tmp_path):
    wrong = tmp_path / "wrong.toml"
    wrong.write_text((MACHINES / "saturating.toml").read_text().replace("stator = 6", "stator = 7"))
    result = salient("machine", wrong, "--out", tmp_path / "view")
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1 and str(wrong) in result.stderr
    assert "poles.stator, poles.rotor: 7/4" in result.stderr
    assert not (tmp_path / "view").exists()
