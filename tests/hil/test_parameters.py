"""Parameters over CAN, in their units."""

from __future__ import annotations

import can
import pytest

from salient.bench.arming import arm_frame, response_to
from salient.bench.drive import DriveError, raw_value, read_parameter_table
from salient.bench.parameter_set import control_frame, set_frames, write_frame
from salient.bus.signals import drive_database
from salient.generate.parameters import read_table


def test_table_is_complete_and_drive_has_its_defaults(make_bench):
    bench = make_bench(telemetry_period_ms=4)
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
    machine_defined = {"controller", "inertia_kg_m2", "friction_Nm_s", "resistance_ohm", "winding_current_A",
                       "winding_time_constant_s", "switch_current_A", "bp_error_scale_Nm"}
    table = read_table()
    rows = list(bench.drive.parameters.rows.values())
    assert [(r.index, r.name, r.unit, r.fraction_bits) for r in rows] == [
        (r.index, r.name, r.unit, r.fraction_bits) for r in table
    ]
    for row, definition in zip(rows, table, strict=True):
        lsb = 2.0**-row.fraction_bits
        assert (row.minimum, row.maximum) == (definition.minimum * lsb, definition.maximum * lsb), row.name
        assert row.default == definition.default * lsb or row.name in machine_defined, row.name


@pytest.mark.bench_options(telemetry_period_ms=4)
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
    with pytest.raises(KeyError, match="no parameter 'torque_max'; the nearest of .* are torque_max_Nm, "):
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
    request = can.Message(arbitration_id=0x600, is_extended_id=False, data=bytes([14, 0, 0, 0, 0, 0, 0, 0]))
    bench.send(request)
    answer = bench.advance_until_frame(lambda m: m.arbitration_id == 0x580, 0.01)
    assert response(answer)["status"] == "unknown_operation"


# --- sets -----------------------------------------------------------------------------------------------------------

ARM_IDS = (0x082, 0x083, 0x084)
"""DRIVE_ARM, PARAMETER_WRITE, PARAMETER_SET_CONTROL."""
TRIPS = {"current_trip_A": 79.0, "over_voltage_V": 510.0, "under_voltage_V": 0.0, "command_timeout_ms": 400.0,
         "over_speed_rpm": 4800.0}


def response(message: can.Message) -> dict[str, object]:
    return drive_database().decode_message("PARAMETER_RESPONSE", bytes(message.data))


def responses(bench, from_s: float = 0.0) -> list[dict[str, object]]:
    return [response(m) for time_ns, m in bench.log if m.arbitration_id == 0x580 and time_ns >= from_s * 1e9]


def values(bench) -> dict[str, float]:
    return {name: bench.drive.parameters[name] for name in bench.drive.parameters}


def raw(bench, wanted: dict[str, float]) -> dict[int, int]:
    rows = bench.drive.parameters.rows
    return {rows[name].index: raw_value(rows[name], value) for name, value in wanted.items()}


def arm_for_configuration(bench, counter: int) -> None:
    """Both steps in raw frames."""
    bench.send(arm_frame(counter, "request_configuration"))
    bench.run_for(0.005)
    assert bench.telemetry["DRIVE_ARMING.attempt"].last_name == "configuration"
    challenge = int(bench.telemetry["DRIVE_ARMING.challenge"].last)
    bench.send(arm_frame(counter + 1, "confirm_configuration", response_to(challenge)))


def send_set(bench, frames: list[can.Message]) -> dict[str, object]:
    """The response to the last frame of a set."""
    begin_s = bench.time_s
    for frame in frames:
        bench.send(frame)
    bench.run_for(0.02)
    return responses(bench, begin_s)[-1]


# [SR-56]
@pytest.mark.both_transports
def test_sequence_in_raw_frames_applies_a_set(bench):
    """The sequence of the CAN page."""
    arm_for_configuration(bench, 7)
    result = send_set(bench, set_frames(9, raw(bench, {"current_limit_A": 40.0, "current_trip_A": 60.0})))
    assert (result["operation"], result["status"], result["value"]) == ("set_control", "done", 12 << 8 | 2)
    assert bench.telemetry["DRIVE_ARMING.configuring"].last_name == "no"
    parameters = bench.drive.parameters
    assert (parameters["current_limit_A"], parameters["current_trip_A"]) == (40.0, 60.0)


# [SR-56]
def test_unprotected_frames_change_nothing(bench):
    before = values(bench)
    statuses = set()
    for name, value in TRIPS.items():
        [(index, bits)] = raw(bench, {name: value}).items()
        data = bytes([1, index, 0, 0]) + bits.to_bytes(4, "little", signed=True)
        bench.send(can.Message(arbitration_id=0x600, is_extended_id=False, data=data))
        statuses.add(str(response(bench.advance_until_frame(lambda m: m.arbitration_id == 0x580, 0.01))["status"]))
    for operation in (8, 9):  # save, restore_defaults
        bench.send(can.Message(arbitration_id=0x600, is_extended_id=False, data=bytes([operation, *bytes(7)])))
        statuses.add(str(response(bench.advance_until_frame(lambda m: m.arbitration_id == 0x580, 0.01))["status"]))
    assert statuses == {"unprotected"}
    assert values(bench) == before
    bench.rig.drive_reset = 1
    bench.run_for(0.02)
    assert bench.drive.parameters.origin == "defaults"


# [SR-56]
def test_protected_frames_without_being_armed_change_nothing(bench):
    before = values(bench)
    bench.run_for(0.2)
    refused = bench.telemetry["DRIVE_ARMING.refused"].last
    result = send_set(bench, set_frames(9, raw(bench, TRIPS)))
    assert result["status"] == "not_armed"
    assert values(bench) == before
    bench.run_for(0.2)
    assert bench.telemetry["DRIVE_ARMING.refused"].last == refused + len(TRIPS) + 2


# [SR-56]
@pytest.mark.bench_options(telemetry_period_ms=4)
def test_recording_of_a_set_does_not_apply_again(bench, make_bench):
    bench.drive.parameters.update(TRIPS)
    bench.run_for(0.01)
    recording = [m for _, m in bench.log if m.arbitration_id in ARM_IDS]
    assert len(recording) == 2 + len(TRIPS) + 2
    bench.drive.parameters.restore_defaults()
    before = values(bench)
    other = make_bench(seed=2, telemetry_period_ms=4)
    other.run_for(0.0112)
    for at, distance_s in ((bench, 0.0), (bench, 0.001), (bench, 0.02), (other, 0.0), (other, 0.001)):
        begin_s = at.time_s
        for message in recording:
            at.send(message)
            at.run_for(distance_s)
        at.run_for(0.02)
        assert {str(r["status"]) for r in responses(at, begin_s)} == {"not_armed"}
        at.run_for(0.02)
    assert values(bench) == before == values(other)


CONTRADICTIONS = {
    "limit above trip": ({"current_limit_A": 60.0, "current_trip_A": 50.0},
                         "current_limit_A 60: contradicts current_trip_A, 50 A"),
    "limit above the present trip": ({"current_limit_A": 76.0}, "current_limit_A 76: contradicts current_trip_A, 75 A"),
    "under above over voltage": ({"under_voltage_V": 230.0, "over_voltage_V": 220.0},
                                 "under_voltage_V 230: contradicts over_voltage_V, 220 V"),
    "over voltage below the supply": ({"over_voltage_V": 200.0},
                                      r"over_voltage_V 200: excludes the present DC-link voltage, 2(39|40).* V"),
    "under voltage above the supply": ({"under_voltage_V": 250.0},
                                       r"under_voltage_V 250: excludes the present DC-link voltage, 2(39|40).* V"),
    "turn-off before turn-on": ({"turn_on_angle_deg": 301.0}, "turn_on_angle_deg 301: contradicts turn_off_angle_deg"),
    "hysteresis bands": ({"torque_band_inner_Nm": 2.0}, "torque_band_inner_Nm 2: contradicts torque_band_outer_Nm, 1 "),
    "out of range": ({"current_trip_A": 80.0}, "current_trip_A 80: must be 1 to 79 A"),
}


# [SR-56]
@pytest.mark.parametrize("case", CONTRADICTIONS)
def test_contradiction_is_refused_with_both_names_and_nothing_of_the_set_is_applied(bench, case):
    wanted, message = CONTRADICTIONS[case]
    bench.run_for(0.01)
    before = values(bench)
    with pytest.raises(DriveError, match=f"^{message}"):
        bench.drive.parameters.update({"over_speed_rpm": 1234.0, **wanted})
    assert values(bench) == before


def test_contradicting_values_in_one_set_that_agrees_are_applied_in_any_order(bench):
    parameters = bench.drive.parameters
    parameters.update({"current_limit_A": 20.0, "current_trip_A": 30.0})
    parameters.update({"current_limit_A": 70.0, "current_trip_A": 75.0})
    assert (parameters["current_limit_A"], parameters["current_trip_A"]) == (70.0, 75.0)
    parameters["current_trip_A"] = 20  # lowering the trip alone is how it is tested
    assert parameters["current_trip_A"] == 20


# [SR-56]
@pytest.mark.parametrize("kind", ["missing", "damaged", "repeated", "out of sequence", "index"])
def test_set_with_a_bad_frame_is_refused_and_the_frame_counted(bench, kind: str):
    before = values(bench)
    frames = set_frames(9, raw(bench, TRIPS))
    counter, status = {"missing": (None, "incomplete"), "damaged": ("wrong_checksum", "incomplete"),
                       "repeated": ("wrong_counter", "done"), "out of sequence": ("wrong_counter", "incomplete"),
                       "index": ("out_of_range", "incomplete")}[kind]
    match kind:
        case "missing":
            del frames[2]
        case "damaged":
            frames[2].data[6] ^= 0x10
        case "repeated":
            frames.insert(2, frames[1])
        case "out of sequence":
            frames[2], frames[3] = frames[3], frames[2]
        case "index":
            frames[2] = write_frame(11, len(before), 0)
    arm_for_configuration(bench, 7)
    bench.run_for(0.11)
    names = ("wrong_checksum", "wrong_counter", "out_of_range", "wrong_length", "unknown_frame")
    counted = {name: bench.telemetry[name].last for name in names}
    result = send_set(bench, frames)
    assert result["status"] == status
    bench.run_for(0.11)
    assert {name: bench.telemetry[name].last for name in names} == counted | (
        {counter: counted[counter] + 1} if counter else {})
    assert values(bench) == (before | TRIPS if status == "done" else before)


# [SR-56]
def test_abandoned_set_and_one_without_frames_for_two_seconds_are_not_applied(bench):
    before = values(bench)
    *staged, apply = set_frames(9, raw(bench, TRIPS))
    arm_for_configuration(bench, 7)
    assert send_set(bench, [*staged, control_frame(9 + len(staged), "abandon")])["status"] == "done"
    assert send_set(bench, [apply])["status"] == "not_armed"
    arm_for_configuration(bench, 7)
    send_set(bench, staged)
    bench.run_for(1.9)
    assert bench.telemetry["DRIVE_ARMING.configuring"].last_name == "yes"
    bench.run_for(0.2)
    assert bench.telemetry["DRIVE_ARMING.configuring"].last_name == "no"
    assert send_set(bench, [apply])["status"] == "not_armed"
    assert values(bench) == before


# [SR-56]
def test_set_that_was_staged_before_a_run_is_not_applied_in_it(bench):
    before = values(bench)
    *staged, apply = set_frames(9, raw(bench, {"smc_k": 500.0}))
    arm_for_configuration(bench, 7)
    send_set(bench, staged)
    bench.drive.speed_reference_rpm = 150
    bench.run_for(0.05)
    assert bench.drive.state == "run"
    assert send_set(bench, [apply])["status"] == "not_armed"
    assert values(bench) == before


TUNED = {
    "traditional": {"speed_kp": 4.0, "speed_ki": 800.0, "observer_bandwidth_rad_s": 600.0},
    "paper": {"smc_k": 500.0, "smc_epsilon": 0.75, "smc_delta": 0.5, "observer_bandwidth_rad_s": 600.0,
              "bp_kp_max": 0.25, "bp_ki_max": 0.1875, "bp_kd_max": 0.125},
    "salient": {"smc_k": 500.0, "smc_epsilon": 0.75, "smc_delta": 0.5, "observer_steady_rad_s": 400.0,
                "observer_transient_rad_s": 6000.0, "flux_observer_gain": 0.375},
}


@pytest.mark.in_turns
@pytest.mark.parametrize("controller", TUNED)
def test_gains_change_in_a_run_without_a_bump(make_bench, controller: str):
    bench = make_bench(controller=controller)
    bench.rig.truth_period_us = 25
    bench.load_torque_Nm = 6
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.6)
    begin_s = bench.time_s
    bench.drive.parameters.update(TUNED[controller])
    assert bench.time_s - begin_s < 0.02
    bench.run_for(0.1)
    assert bench.drive.state == "run"
    assert {name: bench.drive.parameters[name] for name in TUNED[controller]} == TUNED[controller]
    # As before the change, within its first 10 ms: mean and extremes of the torque, speed.
    ripple_Nm, mean_Nm, speed_rpm = {"traditional": (0.5, 0.15, 0.5), "paper": (0.6, 0.05, 0.25),
                                     "salient": (0.03, 0.005, 0.01)}[controller]
    torque, speed = bench.truth["torque_Nm"], bench.truth["speed_rpm"]
    before, soon = torque.between(begin_s - 0.1, begin_s).value, torque.between(begin_s, begin_s + 0.01).value
    assert before.min() - ripple_Nm < soon.min() < soon.max() < before.max() + ripple_Nm
    assert soon.mean() == pytest.approx(before.mean(), abs=mean_Nm)
    assert abs(speed.between(begin_s, begin_s + 0.1).value - 600).max() < speed_rpm


def test_tuned_gain_acts_in_the_same_run(make_bench):
    """The speed drop of a load step is larger with a tenth of the gains."""
    drops = []
    for tuned in ({}, {"speed_kp": 0.8, "speed_ki": 40.0}):
        bench = make_bench(controller="traditional")
        bench.drive.speed_reference_rpm = 300
        bench.run_for(0.2)
        bench.drive.parameters.update(tuned)
        bench.run_for(0.1)
        begin_s = bench.time_s
        bench.load_torque_Nm = 4
        bench.run_for(0.1)
        drops.append(300 - bench.truth["speed_rpm"].between(begin_s, bench.time_s).value.min())
    assert 2 < drops[0] < 10
    assert 4 * drops[0] < drops[1] < 100


# [SR-56]
def test_set_with_one_parameter_that_cannot_change_in_a_run_changes_none_there(bench):
    bench.drive.speed_reference_rpm = 150
    bench.run_for(0.05)
    before = values(bench)
    with pytest.raises(DriveError, match=r"^current_trip_A 60: not_while_running$"):
        bench.drive.parameters.update({"speed_kp": 4.0, "current_trip_A": 60.0})
    assert values(bench) == before
    bench.drive.parameters["speed_kp"] = 4.0
    assert values(bench) == before | {"speed_kp": 4.0}
    assert bench.drive.state == "run"


def test_whole_table_is_one_set(bench):
    parameters = bench.drive.parameters
    wanted = values(bench) | {"over_speed_rpm": 1234.0, "smc_delta": 0.5}
    begin_s = bench.time_s
    parameters.update(wanted)
    assert bench.time_s - begin_s < 0.03
    assert values(bench) == wanted
