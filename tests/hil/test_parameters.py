"""Parameters over CAN, in their units."""

from __future__ import annotations

import can
import pytest

from salient.bench.drive import DriveError, read_parameter_table
from salient.bus.signals import drive_database
from salient.generate.parameters import read_table


def test_table_is_complete_and_drive_has_its_defaults(make_bench):
    bench = make_bench()
    rows = read_parameter_table(bench)
    assert [row.index for row in rows] == list(range(len(rows)))
    assert len({row.name for row in rows}) == len(rows) > 20
    for row in rows:
        assert row.name.isidentifier()
        assert row.minimum <= row.default <= row.maximum, row
        assert bench.drive.parameters[row.name] == row.default
    torque = bench.drive.parameters.row("torque_max_Nm")
    assert (torque.unit, torque.minimum) == ("N m", 0.0)
    assert torque.default == pytest.approx(19.1, abs=1e-6)


@pytest.mark.both_transports
def test_written_value_is_read_back(bench):
    parameters = bench.drive.parameters
    for name in ("torque_max_Nm", "speed_ramp_rpm_s", "over_speed_rpm"):
        row = parameters.row(name)
        lsb = 2.0**-row.fraction_bits
        for value in (row.minimum, row.maximum, (row.minimum + row.maximum) / 3):
            parameters[name] = value
            assert parameters[name] == pytest.approx(value, abs=lsb / 2)


def test_drive_has_the_table_of_the_reference_page(bench):
    machine_defined = {"controller", "inertia_kg_m2", "friction_Nm_s", "resistance_ohm"}
    table = read_table()
    rows = list(bench.drive.parameters.rows.values())
    assert [(r.index, r.name, r.unit, r.fraction_bits) for r in rows] == [
        (r.index, r.name, r.unit, r.fraction_bits) for r in table
    ]
    for row, definition in zip(rows, table, strict=True):
        lsb = 2.0**-row.fraction_bits
        assert (row.minimum, row.maximum) == (definition.minimum * lsb, definition.maximum * lsb), row.name
        assert row.default == definition.default * lsb or row.name in machine_defined, row.name


def test_value_out_of_range_is_rejected_and_changes_nothing(bench):
    parameters = bench.drive.parameters
    for name, row in parameters.rows.items():
        lsb = 2.0**-row.fraction_bits
        for value in (row.minimum - lsb, row.maximum + lsb):
            with pytest.raises(DriveError, match=f"^{name} .*: must be "):
                parameters[name] = value
        assert parameters[name] == row.default


def test_value_beyond_32_bits_is_rejected(bench):
    with pytest.raises(DriveError, match="torque_max_Nm 1e.06: must be 0 to 100 N m"):
        bench.drive.parameters["torque_max_Nm"] = 1e6


def test_unknown_parameter_is_named(bench):
    with pytest.raises(KeyError, match="no parameter 'torque_max'; the parameters are .*torque_max_Nm"):
        bench.drive.parameters["torque_max"] = 1


def test_write_while_running_is_rejected(bench):
    bench.drive.speed_reference_rpm = 150
    bench.run_for(0.02)
    with pytest.raises(DriveError, match="torque_max_Nm 10: not_while_running"):
        bench.drive.parameters["torque_max_Nm"] = 10
    assert bench.drive.parameters["torque_max_Nm"] == pytest.approx(19.1, abs=1e-6)


def test_parameter_takes_effect(make_bench):
    """Half the torque limit gives half the acceleration."""
    speeds = []
    for torque_Nm in (16.0, 8.0):
        bench = make_bench(controller="paper")
        bench.drive.parameters["torque_max_Nm"] = torque_Nm
        bench.drive.speed_reference_rpm = 3000
        bench.run_for(0.03)
        speeds.append(bench.truth["speed_rpm"].last)
    assert speeds[0] / speeds[1] == pytest.approx(2.0, abs=0.3)


def test_unknown_operation_is_answered(bench):
    request = can.Message(arbitration_id=0x600, is_extended_id=False, data=bytes([12, 0, 0, 0, 0, 0, 0, 0]))
    bench.send(request)
    answer = bench.advance_until_frame(lambda m: m.arbitration_id == 0x580, 0.01)
    status = drive_database().decode_message("PARAMETER_RESPONSE", bytes(answer.data))["status"]
    counted = bench.telemetry["out_of_range"]
    bench.run_for(0.2)
    assert status == "unknown_operation" or counted.last == 1
