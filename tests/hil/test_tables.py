"""Machine tables written over CAN: from its next start on the drive has the tables of another machine file. [SR-61]"""

from __future__ import annotations

import numpy as np
import pytest

from salient.bench import tables
from salient.bench.xcp import AREA_TABLES, XcpError, connected
from salient.bus.identity import OtherDatabase
from salient.errors import RunFailed, UsageError

OTHER = "linear_cosine"


@pytest.fixture
def own(make_bench, tmp_path):
    """A drive of `saturating` with a memory."""
    return make_bench(memory=tmp_path / "memory.bin")


def reset(bench) -> None:
    """Also until the drive has said again which machine it carries."""
    bench.rig.drive_reset = 1
    bench.run_for(0.3)


def ripple(bench) -> float:
    """K_t of the motor's torque at 150 r/min with a load."""
    bench.drive.speed_reference_rpm = 150
    bench.run_for(0.3)
    bench.load_torque_Nm = 5
    bench.run_for(0.3)
    begin_s = bench.time_s
    bench.run_for(0.2)
    torque_Nm = bench.truth["torque_Nm"].between(begin_s, bench.time_s).value
    bench.load_torque_Nm = 0
    bench.drive.off()
    bench.run_for(0.5)
    return float(np.ptp(torque_Nm) / np.mean(torque_Nm))


def test_tables_of_another_machine_act_from_the_next_start_on(own):
    before, wanted = tables.read(own), tables.tables_of(OTHER)
    assert before == tables.tables_of("saturating") != wanted
    tables.write(own, wanted)
    assert tables.read(own) == before
    for _ in range(2):
        reset(own)
        assert tables.read(own) == wanted
    assert own.drive.state == "ready"
    with pytest.raises(OtherDatabase, match="has become one of another machine"):
        own.drive.speed_reference_rpm = 300


def test_a_drive_with_the_tables_of_its_motor_ripples_less_than_a_quarter_of_what_it_did_with_others(
        make_bench, tmp_path):
    options = {"memory": tmp_path / "memory.bin", "true_machine": OTHER}
    first = make_bench(**options)
    wrong = ripple(first)
    first.close()
    writer = make_bench(**options)
    tables.write(writer, tables.tables_of(OTHER))
    writer.close()
    right = ripple(make_bench(**options))
    assert right < 0.25 * wrong, f"{right} after {wrong}"


def test_only_a_drive_that_is_alone_and_has_a_memory_takes_tables(make_bench, tmp_path):
    for options in ({}, {"memory": tmp_path / "memory.bin", "drives": 2}):
        bench = make_bench(**options)
        with pytest.raises(XcpError, match="the drive has tables of its own alone"):
            tables.write(bench, tables.tables_of(OTHER))
        bench.close()


def test_a_drive_that_runs_takes_none_and_goes_on(own):
    own.drive.speed_reference_rpm = 300
    own.run_for(0.3)
    with pytest.raises(XcpError, match="the drive runs: it takes tables at rest"):
        tables.write(own, tables.tables_of(OTHER))
    own.run_for(0.1)
    assert own.drive.state == "run" and own.telemetry["speed_rpm"].last == pytest.approx(300, abs=5)


# [SR-58]
def test_parameters_stored_for_other_tables_are_not_used_and_the_drive_waits_for_new_ones(own):
    own.drive.parameters["over_speed_rpm"] = 1234
    own.drive.parameters.save()
    tables.write(own, tables.tables_of(OTHER))
    reset(own)
    assert own.drive.state == "initialise" and own.drive.start_inhibited_by == "parameter_memory"
    own.drive.parameters.save()
    own.run_for(0.02)
    assert own.drive.state == "ready"
    tables.write(own, tables.tables_of("saturating"))
    reset(own)
    assert own.drive.start_inhibited_by == "parameter_memory", "nor those of the tables before"


@pytest.mark.in_turns
@pytest.mark.parametrize("operation", [1, 5, 6, 7, 300, 1229, 1230, 1231])
def test_a_power_cut_while_they_are_written_leaves_the_tables_of_before_or_the_new_ones(own, operation: int):
    first, second = tables.tables_of(OTHER), tables.tables_of("linear_trapezoid")
    tables.write(own, first)
    own.rig.memory_cut_kind = operation % 3
    own.rig.memory_cut_operation = operation  # five erasures, header, identity, 1,222 words, checksum, commit
    try:
        tables.write(own, second)
    except (XcpError, RunFailed):
        own.run_for(0.5)
    own.rig.memory_cut_operation = 0
    reset(own)
    assert tables.read(own) in ((first,) if operation < 1231 else (first, second))
    tables.write(own, second)
    reset(own)
    assert tables.read(own) == second


@pytest.mark.parametrize("offset", [0, 1, 28])  # phases, poles, the first row
def test_tables_that_no_drive_can_use_leave_the_drive_with_those_of_the_program(own, offset: int):
    wrong = bytearray(tables.tables_of(OTHER))
    wrong[offset] = 0 if offset < 2 else 255
    tables.write(own, bytes(wrong))
    reset(own)
    assert tables.read(own) == tables.tables_of("saturating")
    assert own.drive.state == "ready"


def program_uncleared(bench, wanted: bytes) -> None:
    """The first bytes without PROGRAM_CLEAR."""
    with connected(bench) as master:
        master.programStart()
        master.setMta(AREA_TABLES)
        master.program(wanted[:6], 6, last=True)


def test_a_transfer_that_is_given_up_can_be_begun_again_and_one_out_of_order_is_refused(own):
    wanted = tables.tables_of(OTHER)
    with connected(own) as master:
        master.programStart()
        master.setMta(AREA_TABLES)
        master.programClear(0, len(wanted))
        for at in range(0, 600, 6):
            master.program(wanted[at:at + 6], 6, last=True)
    with pytest.raises(XcpError):
        program_uncleared(own, wanted)
    tables.write(own, wanted)
    reset(own)
    assert tables.read(own) == wanted


def test_a_file_of_another_board_is_refused_with_both_values():
    with pytest.raises(UsageError, match="fan12.*: current range of the sensors .*: 80 in the drive, whose machine is "
                       "saturating: tables change the motor, not the board"):
        tables.check_board("saturating", "fan12")
    tables.check_board("saturating", OTHER)
