"""The drive as a CANopen device, with the package `canopen` as master and reader of the EDS."""

from __future__ import annotations

import random
from contextlib import contextmanager

import can
import pytest

from salient.bench import canopen_page
from salient.bench.canopen_network import network_on
from salient.machine.eds import eds_of
from salient.machine.parameter_table import read_table

canopen = pytest.importorskip("canopen")

pytestmark = pytest.mark.bench_options(protocol="canopen")

ABORT_HIGH, ABORT_LOW = 0x06090031, 0x06090032
NO_ACCESS = {0x06010001, 0x06010002}
STATES = {0x40: "switch on disabled", 0x21: "ready", 0x23: "switched on", 0x27: "enabled", 0x07: "quick stop",
          0x08: "fault"}


@contextmanager
def master(bench, tmp_path, node=0):
    """Network and node of the drive, with the EDS of its machine."""
    file = tmp_path / "drive.eds"
    file.write_text(eds_of(bench.machine or "saturating", node), encoding="ascii")
    with network_on(bench) as network:
        remote = canopen.RemoteNode(node + 1, str(file))
        network.add_node(remote)
        bench.run_for(0.01)
        yield network, remote


def state(node):
    word = node.sdo[0x6041].raw
    return STATES[word & (0x4F if not word & 0x20 or word & 0x48 else 0x6F)]


def enable(node, mode=3):
    node.sdo[0x6060].raw = mode
    node.nmt.state = "OPERATIONAL"
    for word in (6, 7, 15):
        node.sdo[0x6040].raw = word
    assert state(node) == "enabled"


def refused(entry, raw):
    """Abort code of a write; 0 without one."""
    try:
        entry.raw = raw
    except canopen.SdoAbortedError as error:
        return error.code
    return 0


def numbers(node):
    """Every number of the EDS."""
    for index, thing in node.sdo.items():
        if index < 0x1000:  # types, for mapping without effect
            continue
        entries = [thing] if isinstance(thing, canopen.sdo.SdoVariable) else list(thing.values())
        for entry in entries:
            if entry.od.data_type in canopen.objectdictionary.INTEGER_TYPES:
                yield entry


@pytest.mark.parametrize("machine", ["saturating", "finite_element"])
def test_the_eds_describes_every_object_truly(make_bench, tmp_path, machine):
    bench = make_bench(protocol="canopen", machine=machine)
    with master(bench, tmp_path) as (_, node):
        seen = written = limits = 0
        for entry in numbers(node):
            seen += 1
            raw = entry.raw
            od = entry.od
            assert od.min is None or od.min <= raw <= od.max or not od.writable, od.qualname
            if od.default is not None:
                started = {"controller": 2, "protocol": 1, "telemetry_period_ms": raw}
                assert raw == started.get(od.name, od.default), od.qualname
            if not od.writable:
                assert refused(entry, raw) in NO_ACCESS, od.qualname
                continue
            written += 1
            low, high = (-1 << len(od) - 1, (1 << len(od) - 1) - 1) if od.data_type in \
                canopen.objectdictionary.SIGNED_TYPES else (0, (1 << len(od)) - 1)
            if od.max < high:
                limits += 1
                assert refused(entry, od.max + 1) == ABORT_HIGH, od.qualname
            if od.min > low:
                limits += 1
                assert refused(entry, od.min - 1) == ABORT_LOW, od.qualname
            if od.index not in (0x1010, 0x1011):
                assert refused(entry, raw) in (0, 0x08000022), od.qualname
                assert entry.raw == raw
        assert seen > 200 and written > 150 and limits > 150


def test_the_objects_of_the_eds_are_all_that_there_are(bench, tmp_path):
    with master(bench, tmp_path) as (_, node):
        known = set(node.object_dictionary)
        for index in [*range(0x1000, 0x1020), *range(0x1400, 0x1406), *range(0x1A00, 0x1A06), *range(0x1F80, 0x1F83),
                      *range(0x2000, 0x2000 + len(read_table()) + 2), *range(0x2F00, 0x2F05),
                      *range(0x6000, 0x6100)]:
            code = 0
            try:
                node.sdo.upload(index, 0)
            except canopen.SdoAbortedError as error:
                code = error.code
            assert code == (0 if index in known else 0x06020000), hex(index)


def test_texts_and_the_parameter_set_by_segments_and_blocks(bench, tmp_path):
    with master(bench, tmp_path) as (_, node):
        assert node.sdo[0x1008].raw == "Salient"
        data = node.sdo.upload(0x2F00, 0)
        assert len(data) == 4 * len(read_table())
        with node.sdo[0x2F00].open("rb", block_transfer=True) as file:
            assert file.read() == data
        row = next(row for row in read_table() if row.name == "over_speed_rpm")
        changed = bytearray(data)
        changed[4 * row.index:4 * row.index + 4] = (1234).to_bytes(4, "little")
        with node.sdo[0x2F00].open("wb", block_transfer=True, size=len(changed)) as file:
            file.write(bytes(changed))
        assert node.sdo[0x2000 + row.index].raw == 1234
        node.sdo.download(0x2F00, 0, data)
        assert node.sdo[0x2000 + row.index].raw == row.default


@pytest.mark.bench_each(machine=["saturating", "linear_trapezoid"], controller=["traditional", "paper", "salient"])
def test_profile_velocity_runs_the_motor_and_a_quick_stop_ends_the_run(make_bench, tmp_path):
    bench = make_bench(protocol="canopen")
    with master(bench, tmp_path) as (network, node):
        enable(node)
        node.sdo[0x6083].raw = 3000
        node.sdo[0x60FF].raw = 600
        network.run_for(0.5)
        assert node.sdo[0x606C].raw == pytest.approx(600, abs=2)
        assert bench.truth["speed_rpm"].last == pytest.approx(600, abs=3)
        assert node.sdo[0x6041].raw & 0x400
        node.sdo[0x6040].raw = 0x02
        network.run_for(2.5)
        assert state(node) == "switch on disabled"
        network.run_for(0.05)


def test_torque_and_cyclic_modes(bench, tmp_path):
    with master(bench, tmp_path) as (network, node):
        enable(node, mode=4)
        node.sdo[0x6087].raw = 10_000
        node.sdo[0x6071].raw = 100
        network.run_for(0.06)
        assert node.sdo[0x6074].raw == pytest.approx(100, abs=1)
        assert bench.truth["speed_rpm"].last > 20
        node.sdo[0x6060].raw = 9
        node.sdo[0x60C2][1].raw = 10
        for speed in range(20, 420, 20):
            node.sdo[0x60FF].raw = speed
            network.run_for(0.008)
        network.run_for(0.1)
        assert node.sdo[0x606C].raw == pytest.approx(400, abs=3)
        node.sdo[0x6060].raw = 10
        node.sdo[0x6071].raw = -50
        network.run_for(0.05)
        assert node.sdo[0x6074].raw == pytest.approx(-50, abs=1)


@pytest.mark.both_transports
def test_pdos_of_the_package_drive_the_motor(bench, tmp_path):
    with master(bench, tmp_path) as (network, node):
        node.rpdo.read()
        node.tpdo.read()
        rpdo, tpdo = node.rpdo[4], node.tpdo[2]
        rpdo.clear()
        for index in (0x6040, 0x60FF):
            rpdo.add_variable(index)
        rpdo.trans_type, rpdo.enabled = 255, True
        tpdo.clear()
        for index in (0x6041, 0x606C, 0x6077):
            tpdo.add_variable(index)
        tpdo.trans_type, tpdo.enabled = 1, True
        rpdo.save()
        tpdo.save()
        node.nmt.state = "OPERATIONAL"
        for word in (6, 7, 15):
            rpdo[0].raw, rpdo[1].raw = word, 500
            rpdo.transmit()
            network.run_for(0.002)
        for _ in range(70):
            rpdo.transmit()
            network.run_for(0.01)
            network.send_message(0x80, b"")
        assert tpdo["Velocity actual value"].raw == pytest.approx(500, abs=2)
        assert tpdo["Statusword"].raw & 0x6F == 0x27


def test_random_mapping_has_the_values_of_sdo(bench, tmp_path):
    drawn = random.Random(4711)
    with master(bench, tmp_path) as (network, node):
        mappable = [entry for entry in numbers(node) if entry.od.pdo_mappable and entry.od.index < 0x6000 and
                    entry.od.index != 0x1001]
        node.tpdo.read()
        for _ in range(20):
            chosen = drawn.sample(mappable, 2)
            number = drawn.randint(1, 4)
            tpdo = node.tpdo[number]
            tpdo.clear()
            for entry in chosen:
                tpdo.add_variable(entry.od.index, entry.od.subindex)
            tpdo.trans_type, tpdo.enabled = 1, True
            node.nmt.state = "PRE-OPERATIONAL"
            tpdo.save()
            node.nmt.state = "OPERATIONAL"
            network.send_message(0x80, b"")
            assert [variable.raw for variable in tpdo] == [entry.raw for entry in chosen]


@pytest.mark.parametrize("option", [1, 2, 3])
def test_a_lost_master_is_a_quick_stop_and_then_open_switches(bench, tmp_path, option):
    with master(bench, tmp_path) as (network, node):
        emergencies = []
        node.emcy.add_callback(emergencies.append)
        node.sdo[0x1016][1].raw = 0x7F << 16 | 50
        node.sdo[0x6007].raw = option
        node.sdo[0x6083].raw = 10_000
        enable(node)
        node.sdo[0x60FF].raw = 300
        for _ in range(20):
            network.send_message(0x77F, b"\x05")
            network.run_for(0.02)
        assert bench.truth["speed_rpm"].last == pytest.approx(300, abs=3)
        network.run_for(0.06)
        assert [emergency.code for emergency in emergencies] == [0x8130]
        network.run_for(1.5)
        assert state(node) == ("fault" if option == 1 else "switch on disabled")
        assert bench.truth["speed_rpm"].last < 300 if option == 2 else abs(bench.truth["speed_rpm"].last) < 15
        node.sdo[0x6040].raw = 15
        network.run_for(0.05)
        assert state(node) != "enabled"


def test_a_fault_is_an_emergency_and_an_entry_of_the_error_field(bench, tmp_path):
    with master(bench, tmp_path) as (network, node):
        emergencies = []
        node.emcy.add_callback(emergencies.append)
        enable(node)
        node.sdo[0x60FF].raw = 300
        network.run_for(0.4)
        bench.fault("switch_open", phase="a", leg="low", duration_s=2.0)
        for _ in range(40):
            network.run_for(0.05)
            node.sdo[0x6041].raw  # noqa: B018 - the master is not silent
            if emergencies:
                break
        assert emergencies and emergencies[0].code == 0x2331
        assert state(node) == "fault" and node.sdo[0x603F].raw == 0x2331
        network.run_for(0.2)
        assert node.sdo[0x1003][0].raw == 1 and node.sdo[0x1003][1].raw & 0xFFFF == 0x2331
        network.run_for(2.5)
        node.sdo[0x6040].raw = 0x80
        network.run_for(0.05)
        assert state(node) == "switch on disabled"
        assert emergencies[-1].code == 0
        node.sdo[0x1003][0].raw = 0
        assert node.sdo[0x1003][0].raw == 0


def test_two_masters_get_no_mixed_value_and_stop_nothing(bench, tmp_path):
    """A second one writes another target, and starts transfers amid the first one's: each value is one of both."""
    drawn = random.Random(1)
    with master(bench, tmp_path) as (network, node):
        enable(node)
        for _ in range(300):
            target = drawn.choice((0x00FF00FF, 0x01000100))
            if drawn.random() < 0.5:
                bench.send(can.Message(arbitration_id=0x601, is_extended_id=False,
                                       data=bytes([0x23, 0xFF, 0x60, 0, *target.to_bytes(4, "little")])))
            else:
                bench.send(can.Message(arbitration_id=0x401, is_extended_id=False,
                                       data=bytes([15, 0, *target.to_bytes(4, "little")])))
            begun = drawn.choice(("21FF600004000000", "A4002F0014000000", "4008100000000000"))
            bench.send(can.Message(arbitration_id=0x601, is_extended_id=False, data=bytes.fromhex(begun)))
            bench.run_for(0.001)
        bench.run_for(0.01)
        network.run_for(1.1)
        assert node.sdo[0x60FF].raw in (0x00FF00FF, 0x01000100)
        assert state(node) == "enabled"


def test_lss_of_the_package_sets_the_node_and_stores_it(make_bench, tmp_path):
    memory = tmp_path / "memory"
    bench = make_bench(protocol="canopen", memory=memory)
    with master(bench, tmp_path) as (network, node):
        identity = [node.sdo[0x1018][i].raw for i in (1, 2, 3, 4)]
        network.lss.send_switch_state_selective(*identity)
        assert network.lss.inquire_node_id() == 1
        network.lss.configure_node_id(9)
        network.lss.store_configuration()
        network.run_for(0.1)
        node.nmt.state = "RESET COMMUNICATION"
        network.run_for(0.02)
        other = canopen.RemoteNode(9, str(tmp_path / "drive.eds"))
        network.add_node(other)
        assert other.sdo[0x1000].raw == 0x00020192
    bench.close()
    again = make_bench(memory=memory)
    with network_on(again) as network:
        other = canopen.RemoteNode(9, str(tmp_path / "drive.eds"))
        network.add_node(other)
        network.run_for(0.01)
        assert other.sdo[0x1014].raw == 0x89


def test_lss_fast_scan_of_the_package_gives_two_drives_their_nodes(make_bench, tmp_path):
    """Both lose their node-IDs; the scan finds one after the other by its serial number, and they are reached."""
    bench = make_bench(protocol="canopen", drives=2)
    with master(bench, tmp_path) as (network, node):
        identity = [node.sdo[0x1018][i].raw for i in (1, 2, 3)]
        network.lss.RESPONSE_TIMEOUT = 0.002  # of the wall clock: virtual time has passed when it begins
        assert network.lss.fast_scan() == (False, None), "both have one"
        network.lss.send_switch_state_global(network.lss.CONFIGURATION_STATE)
        network.lss.configure_node_id(255)
        network.lss.send_switch_state_global(network.lss.WAITING_STATE)
        network.nmt.state = "RESET COMMUNICATION"
        network.run_for(0.01)
        node.sdo.RESPONSE_TIMEOUT = 0.01
        with pytest.raises(canopen.SdoCommunicationError):
            node.sdo.upload(0x1000, 0)
        for serial in (1, 2):
            found, numbers = network.lss.fast_scan()
            assert found
            assert numbers == [*identity, serial]
            network.lss.configure_node_id(20 + serial)
            network.lss.send_switch_state_global(network.lss.WAITING_STATE)
            network.run_for(0.01)
            other = canopen.RemoteNode(20 + serial, str(tmp_path / "drive.eds"))
            network.add_node(other)
            assert other.sdo[0x1018][4].raw == serial
        assert network.lss.fast_scan() == (False, None)
        enable(other)


def test_the_other_protocol_is_there_without_the_option(make_bench):
    bench = make_bench()
    assert bench.drive.parameters["protocol"] == 0
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.3)
    assert bench.drive.state == "run"


def test_hostile_frames_beside_guarding_at_full_load(bench, tmp_path):
    """Random frames of every service on a full bus, and node guarding: the drive answers each guard, and a reset ends
    what the frames have begun."""
    drawn = random.Random(20261129)
    with master(bench, tmp_path) as (network, node):
        node.nmt.state = "OPERATIONAL"
        guards = 0
        for round_number in range(1500):
            identifier = drawn.choice((0x000, 0x080, 0x201, 0x301, 0x401, 0x501, 0x601, 0x601, 0x601, 0x77F, 0x7E5))
            data = bytes(drawn.randrange(256) for _ in range(drawn.choice((0, 1, 2, 6, 8, 8, 8))))
            if identifier == 0x000 and len(data) < 2:
                continue  # the package, which hears it, too, expects two bytes
            bench.send(can.Message(arbitration_id=identifier, is_extended_id=False, data=data))
            if round_number % 100 == 0:
                before = len(bench.log)
                network.send_message(0x701, b"", remote=True)
                guards += any(frame.arbitration_id == 0x701 and not frame.is_remote_frame
                              for _, frame in bench.log[before:])
            bench.run_for(0.0001)
        assert guards == 15
        node.nmt.state = "RESET"
        network.run_for(0.1)
        assert state(node) in ("switch on disabled", "fault")
        assert node.sdo[0x1008].raw == "Salient"


def test_the_start_up_of_the_page_is_that_of_the_drive():
    text = canopen_page.PAGE.read_text(encoding="utf-8")
    assert text == canopen_page.page(text), "run build/venv/bin/python -m salient.bench.canopen_page"
    assert text.count("TPDO1") >= 4
