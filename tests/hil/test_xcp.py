"""XCP on CAN with pyXCP as the master, and the A2L file with pya2l as its reader."""

from __future__ import annotations

import struct

import can
import numpy as np
import pytest

from salient.bench import xcp
from salient.bench.a2l import a2l_of, write_a2l
from salient.bench.variables import Variables
from salient.bench.xcp import AREA_PARAMETERS, AREA_SCOPE, COMMAND_ID, RESPONSE_ID, XcpError, connected
from salient.drive_layout import Layout, layout_file
from salient.errors import UsageError
from salient.machine.parameter_table import CHOICES, read_table

pyxcp_types = pytest.importorskip("pyxcp.types")
pya2l = pytest.importorskip("pya2l")

EVENT = 0xFD
ERRORS = {"locked": 0x25, "protected": 0x23, "range": 0x22}


def write(master, index, raw):
    master.setMta(AREA_PARAMETERS + 4 * index)
    master.download(struct.pack("<i", raw))


def read(master, index):
    return struct.unpack("<i", bytes(master.shortUpload(4, AREA_PARAMETERS + 4 * index)))[0]


def raw_exchange(bench, *data):
    """The response to one command, with zeros behind it, without a master."""
    bench.send(can.Message(arbitration_id=COMMAND_ID, is_extended_id=False, data=bytes(data).ljust(8, b"\0")))
    seen = len(bench.log)
    bench.run_for(0.002)
    return [bytes(frame.data) for _, frame in bench.log[seen:] if frame.arbitration_id == RESPONSE_ID]


def test_every_parameter_is_read_and_written_as_the_drive_s_own_protocol_has_it(bench):
    rows = read_table()
    with connected(bench) as master:
        values = {row.name: read(master, row.index) for row in rows}
        for row in rows:
            write(master, row.index, values[row.name])
            assert read(master, row.index) == values[row.name]
        torque = next(row for row in rows if row.name == "torque_max_Nm")
        write(master, torque.index, 5 << torque.fraction_bits)
    assert bench.drive.parameters["torque_max_Nm"] == 5.0
    assert {name: bench.drive.parameters.row(name) and round(bench.drive.parameters[name] * 2.0**bits) for name, bits in
            ((row.name, bench.drive.parameters.row(row.name).fraction_bits) for row in rows)} == {
        **values, "torque_max_Nm": 5 << torque.fraction_bits}


def test_write_beyond_a_limit_and_of_what_is_no_parameter_changes_nothing(bench):
    torque = next(row for row in read_table() if row.name == "torque_max_Nm")
    with connected(bench):
        before = bench.drive.parameters["torque_max_Nm"]
        assert raw_exchange(bench, 0xF6, 0, 0, 0, *(AREA_PARAMETERS + 4 * torque.index).to_bytes(4, "little"))
        assert raw_exchange(bench, 0xF0, 4, *(torque.maximum + 1).to_bytes(4, "little")) == [
            bytes([0xFE, ERRORS["range"]])]
        assert raw_exchange(bench, 0xF6, 0, 0, 0, 0, 0, 0, 0)
        assert raw_exchange(bench, 0xF0, 4, 1, 2, 3, 4) == [bytes([0xFE, ERRORS["protected"]])]
        assert bench.drive.parameters["torque_max_Nm"] == before


def test_in_a_run_tunable_parameters_alone_are_written(bench):
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.1)
    with connected(bench) as master:
        for row in read_table():
            raw = read(master, row.index)
            assert raw_exchange(bench, 0xF6, 0, 0, 0, *(AREA_PARAMETERS + 4 * row.index).to_bytes(4, "little"))
            response = raw_exchange(bench, 0xF0, 4, *(raw & 0xFFFFFFFF).to_bytes(4, "little"))
            assert response == [bytes([0xFF]) if row.tunable else bytes([0xFE, ERRORS["protected"]])], row.name
    assert bench.drive.state == "run"


def test_nothing_is_written_or_measured_without_the_key(bench):
    assert raw_exchange(bench, 0xFD) == []  # silent before CONNECT
    assert len(raw_exchange(bench, 0xFF)) == 1
    raw_exchange(bench, 0xF6, 0, 0, 0, *AREA_PARAMETERS.to_bytes(4, "little"))
    assert raw_exchange(bench, 0xF0, 4, 1, 0, 0, 0) == [bytes([0xFE, ERRORS["locked"]])]
    raw_exchange(bench, 0xF6, 0, 0, 0, *AREA_SCOPE.to_bytes(4, "little"))
    assert raw_exchange(bench, 0xF0, 4, 1, 0, 0, 0) == [bytes([0xFE, ERRORS["locked"]])]
    assert raw_exchange(bench, 0xD5, 0, 1, 0) == [bytes([0xFE, ERRORS["locked"]])]
    (seed,) = raw_exchange(bench, 0xF8, 0, 1)
    wrong = bytes(255 - byte for byte in seed[2:5]) + bytes([seed[5]])
    assert raw_exchange(bench, 0xF7, 4, *wrong) == [bytes([0xFE, ERRORS["locked"]])]
    assert raw_exchange(bench, 0xFD) == []  # a wrong key ends the session


def measured(bench, master, names, divider, duration_s):
    """Records (time in us modulo 2^16, values) of a DAQ list at the control rate / divider, an entry in each frame."""
    variables = Variables(machine=bench.machine)
    of = [variables.quantity(name).variable for name in names]
    master.freeDaq()
    master.allocDaq(1)
    master.allocOdt(0, len(of))
    for odt in range(len(of)):
        master.allocOdtEntry(0, odt, 1)
    for odt, variable in enumerate(of):
        master.setDaqPtr(0, odt, 0)
        master.writeDaq(0xFF, variable.bytes, 0, variable.address)
    master.setDaqListMode(0x10, 0, 0, divider, 0)
    master.startStopDaqList(2, 0)
    seen = len(bench.log)
    master.startStopSynch(1)
    bench.run_for(duration_s)
    master.startStopSynch(0)
    frames = [bytes(frame.data) for _, frame in bench.log[seen:]
              if frame.arbitration_id == RESPONSE_ID and frame.data[0] < len(of)]
    whole = len(frames) // len(of) * len(of)
    assert [frame[0] for frame in frames[:whole]] == list(range(len(of))) * (whole // len(of))
    return [(int.from_bytes(frames[at][1:3], "little"),
             [int.from_bytes(frames[at + odt][3 if odt == 0 else 1:][:each.bytes], "little", signed=each.is_signed)
              for odt, each in enumerate(of)]) for at in range(0, whole, len(of))]


def test_eight_signals_at_10_kHz_fill_the_bus_and_what_is_lost_is_counted_on_both_sides(make_bench):
    bench = make_bench(telemetry_period_ms=10)
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.3)
    names = ["speed_rpm", "torque_reference_Nm", "angle_deg", "state", "current_a_A", "current_b_A", "current_c_A",
             "dc_link_voltage_V"]
    duration_s = 0.8
    with connected(bench) as master:
        handled = []
        handle = master.transport.process_event_packet
        master.transport.process_event_packet = lambda packet: handled.append(bytes(packet)) or handle(packet)
        records = measured(bench, master, names, 4, duration_s)
        lost, written, overloads = (
            int.from_bytes(bytes(master.shortUpload(4, Layout(layout_file()).bits(name).start // 8)), "little")
            for name in ("sampler.lost", "sampler.written", "comms.xcp.daq.overloads"))
    events = [bytes(frame.data) for _, frame in bench.log
              if frame.arbitration_id == RESPONSE_ID and frame.data[0] == EVENT]
    assert set(events) == {bytes([EVENT, pyxcp_types.Event.EV_DAQ_OVERLOAD])}
    assert len(handled) == len(events) == overloads and len(records) // 64 - 1 <= overloads <= len(records) // 64 + 1
    gaps = np.diff([time_us for time_us, _ in records]) % 65_536
    assert np.all(gaps % 100 == 0)
    assert lost + written == pytest.approx(10_000 * duration_s, abs=20)
    seen_lost = int(np.sum(gaps // 100 - 1))  # those in front of a record that has come
    assert 1_000 < seen_lost <= lost
    assert len(records) > 1_000 * duration_s  # of eight frames, on a bus of 8,000 to 10,000 frames a second
    assert {values[3] for _, values in records} == {2}
    speeds_rpm = np.array([values[0] for _, values in records]) * 2.0**-22 * 30 / np.pi
    assert speeds_rpm == pytest.approx(300, abs=3)


def test_one_signal_at_4_kHz_is_measured_without_a_gap_and_telemetry_stays(make_bench):
    bench = make_bench(telemetry_period_ms=10)
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.3)
    before = bench.telemetry.count("DRIVE_MOTION")
    bench.run_for(0.2)
    usual = bench.telemetry.count("DRIVE_MOTION") - before
    with connected(bench) as master:
        before = bench.telemetry.count("DRIVE_MOTION")
        records = measured(bench, master, ["current_a_A"], 10, 0.2)
        with_daq = bench.telemetry.count("DRIVE_MOTION") - before
    assert len(records) >= 790
    assert set(np.diff([time_us for time_us, _ in records]) % 65_536) == {250}
    assert usual <= with_daq <= usual + 1
    assert bench.drive.state == "run"


@pytest.fixture(scope="module")
def a2l(tmp_path_factory):
    """Measurements and characteristics by name, as pya2l reads them."""
    folder = tmp_path_factory.mktemp("a2l")
    write_a2l(folder / "drive.a2l", "saturating")
    session = pya2l.import_a2l(str(folder / "drive.a2l"), in_memory=True)
    from pya2l import model

    return ({each.name: each for each in session.query(model.Measurement)},
            {each.name: each for each in session.query(model.Characteristic)}, session)


def test_every_measurement_has_the_address_and_type_of_the_layout(a2l):
    measurements, _, _ = a2l
    variables = Variables(machine="saturating")
    types = {(1, False): "UBYTE", (1, True): "SBYTE", (2, False): "UWORD", (2, True): "SWORD", (4, False): "ULONG",
             (4, True): "SLONG"}
    assert len(measurements) > 2_000
    for name, measurement in measurements.items():
        variable = variables.quantity(name).variable
        assert measurement.ecu_address.address == variable.address, name
        assert measurement.datatype == types[variable.bytes, variable.is_signed], name


def test_every_parameter_has_its_address_and_limits(a2l, bench):
    _, characteristics, _ = a2l
    assert list(characteristics) == [row.name for row in read_table()]
    for row in read_table():
        of_drive = bench.drive.parameters.row(row.name)
        characteristic = characteristics[row.name]
        assert characteristic.address == AREA_PARAMETERS + 4 * row.index
        assert characteristic.lowerLimit == pytest.approx(of_drive.minimum, rel=1e-9, abs=1e-9), row.name
        assert characteristic.upperLimit == pytest.approx(of_drive.maximum, rel=1e-9, abs=1e-9), row.name
        assert (row.name in CHOICES) == characteristic.conversion.startswith("NAMES_")


def test_identification_of_the_drive_is_the_epk_of_the_file(bench):
    text = a2l_of("saturating")
    with connected(bench) as master:
        length = master.getId(0).length
        epk = bytes(master.upload(length)).decode()
    assert f'EPK "{epk}"' in text
    assert f'EPK "{epk}"' not in a2l_of("fan12")


def test_file_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(UsageError, match=f"--a2l {tmp_path}/none/x.a2l: No such file or directory"):
        write_a2l(tmp_path / "none" / "x.a2l", "saturating")


def test_drive_that_does_not_answer_is_told(bench, monkeypatch):
    monkeypatch.setattr(xcp, "RESPONSE_TIMEOUT_S", 0.01)
    bench.drive_database.get_message_by_name("XCP_COMMAND")
    interface = xcp.SessionInterface(bench)
    with pytest.raises(XcpError, match="no response to the XCP command fd; does the firmware of the drive have XCP"):
        interface.send(can.Message(arbitration_id=COMMAND_ID, is_extended_id=False, data=[0xFD]))
