"""The databases of other node numbers."""

from __future__ import annotations

import pytest

from salient.bus.e2e import check, data_id, protect
from salient.bus.signals import drive_database, rig_database
from salient.config import NODE_MAX
from salient.dbc import RIG_OF_ALL, attributes, load_database
from salient.machine.report import run

NODES = range(NODE_MAX + 1)


def all_data_ids() -> list[int]:
    messages = [m for node in NODES for m in drive_database(node=node).messages]
    return [data_id(m) for m in messages if "E2EDataId" in attributes(m)]


@pytest.mark.parametrize("node", NODES)
def test_database_of_a_node_differs_by_identifiers_and_data_ids_only(node):
    base, shifted = drive_database(), drive_database(node=node)
    assert len(base.messages) == len(shifted.messages) > 20
    for message in base.messages:
        other = shifted.get_message_by_name(message.name)
        assert other.frame_id == message.frame_id + 16 * node
        expected = attributes(message) | (
            {"E2EDataId": data_id(message) + 16 * node} if "E2EDataId" in attributes(message) else {})
        assert attributes(other) == expected
        assert (other.comment, other.length, other.cycle_time) == (message.comment, message.length, message.cycle_time)
        for signal, same in zip(message.signals, other.signals, strict=True):
            assert (same.name, same.start, same.scale, same.minimum, same.maximum, same.choices, same.comment) == (
                signal.name, signal.start, signal.scale, signal.minimum, signal.maximum, signal.choices, signal.comment)


def test_no_identifier_and_no_data_id_belongs_to_two_nodes():
    identifiers = [m.frame_id for node in NODES for m in drive_database(node=node).messages]
    assert len(set(identifiers)) == len(identifiers) and max(identifiers) < 0x800
    data_ids = all_data_ids()
    assert len(set(data_ids)) == len(data_ids) >= 3 * len(NODES)


def test_frame_of_a_node_has_a_wrong_checksum_for_every_other():
    data_ids = all_data_ids()
    for payload in (bytes(4), bytes([1, 0xC0, 0x27, 9]), b"\xff" * 4):
        for sender in data_ids:
            frame = protect(sender, 7, payload)
            assert [receiver for receiver in data_ids if check(receiver, frame)] == [sender]


def test_rigs_differ_but_for_time():
    for node in NODES:
        for message in rig_database().messages:
            shift = 0 if message.name in RIG_OF_ALL else 0x100 * node
            assert rig_database(node).get_message_by_name(message.name).frame_id == message.frame_id + shift


def test_machine_writes_the_database_of_a_node(tmp_path, capsys):
    path = tmp_path / "drive_3.dbc"
    assert run("saturating", tmp_path, None, path, 3) == 0
    assert load_database(path).get_message_by_name("DRIVE_STATUS").frame_id == 0x1B0
    assert "node number 3." in path.read_text(encoding="ascii")
