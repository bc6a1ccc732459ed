"""The kinds of faults: rig.dbc is their one place, from which the page and the C table follow."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from salient.bench.faults import PAGE, fault_kinds, fault_signals, page
from salient.bus.signals import rig_database, value_numbers
from salient.generate.error import CodecError
from salient.generate.fault_kinds import generate_table, main
from salient.paths import RIG_DBC, ROOT


def test_page_is_generated_from_the_database() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run python -m salient.bench.faults"


def test_value_tables_name_the_kinds() -> None:
    numbers = {kind.name: kind.number for kind in fault_kinds().values()}
    assert len(numbers) == len(set(numbers.values())) == 56
    for message in ("RIG_FAULT", "RIG_FAULT_REPLY", "RIG_TRUTH_FAULT"):
        assert value_numbers(rig_database(), message, "kind") == numbers


def test_every_kind_is_described_and_has_an_effect_in_the_bench() -> None:
    table = re.search(r"effects\[FAULT_COUNT\] = \{(.*?)\};", (ROOT / "emulator/rig/faults.c").read_text(), re.DOTALL)
    assert table
    effects = set(re.findall(r"\[FAULT_(\w+)\]", table[1]))
    assert effects == {name.upper() for name in fault_kinds()}
    for kind in fault_kinds().values():
        assert kind.text.endswith("."), kind.name
        if kind.attribute:
            assert kind.attribute[1].comment.endswith("."), kind.name


def test_a_frame_has_place_and_attribute_in_its_bits() -> None:
    message = rig_database().get_message_by_name("RIG_FAULT")
    data = message.encode(fault_signals("current_sensor_offset", {"phase": "c", "offset_A": -1.5}, True, 70_000))
    assert data == bytes([15, (-1500 & 0xF) << 4 | 1 << 3 | 1, -1500 >> 4 & 0xFF, -1500 >> 12 & 0xFF, 0x70, 0x11, 1, 0])
    data = message.encode(fault_signals("switch_open", {"phase": "b", "leg": "high"}, False, 0))
    assert data == bytes([1 << 7 | 2, 1 << 2, 0, 0, 0, 0, 0, 0])


def test_table_has_every_kind_with_its_range() -> None:
    table = generate_table(RIG_DBC)
    assert '[FAULT_WINDING_SHORTED] = {"winding_shorted", true, false, true, 0.01, 100, 5000},' in table
    assert '[FAULT_SHAFT_LOCKED] = {"shaft_locked", false, false, false, 0.0, 0, 0},' in table
    for name in fault_kinds():
        assert f"FAULT_{name.upper()} =" in table


@pytest.mark.parametrize(("old", "new", "text"), [
    ("SG_ winding_open m1 : 11|1@1+", "SG_ winding_open m1 : 13|1@1+", "signal winding_open: must be bit 11"),
    ("SG_ encoder_slip_slip_deg_s m35 : 12|20", "SG_ encoder_slip_slip_deg_s m35 : 12|16",
     "signal encoder_slip_slip_deg_s: must be in the bits of phase, leg or attribute"),
    ("RIG_FAULT:", "RIG_FAULTS:", "has no message RIG_FAULT"),
])
def test_a_database_that_does_not_fit_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str,
                                                  new: str, text: str) -> None:
    path = tmp_path / "rig.dbc"
    shutil.copy(RIG_DBC, path)
    content = path.read_text()
    assert old in content
    path.write_text(content.replace(old, new))
    with pytest.raises(CodecError, match=re.escape(text)):
        generate_table(path)
    assert main([str(path), str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
