"""The drive's triggered buffer: variables at the control rate, by XCP."""

from __future__ import annotations

import re
import sys
from importlib.util import find_spec

import numpy as np
import pytest
from asammdf import MDF

from salient.bench import failure
from salient.bench.sampler import ScopeError, parse_trigger
from salient.bench.variables import SIGNALS, Variables
from salient.errors import UsageError
from salient.paths import ROOT

PERIOD_S = 25e-6
CURRENT_LSB_A = 100.0 / 4096.0
COUNT_DEG = 360.0 / 2**17
PAGE = (ROOT / "docs" / "can" / "scope.md").read_text(encoding="utf-8")
EXAMPLES = dict(re.findall(r"```python\n(def (test_\w+)\(.*?)```", PAGE, re.DOTALL))
FOUR = ["encoder_angle_deg", "current_a_A", "current_b_A", "current_c_A"]


def running(bench, speed_rpm=300.0):
    bench.drive.speed_reference_rpm = speed_rpm
    bench.run_for(0.2)


def test_four_channels_are_the_recording_of_the_emulator_at_the_same_periods(make_bench, tmp_path):
    file = tmp_path / "truth.npy"
    bench = make_bench(record=file, record_step_ns=25_000)
    running(bench)
    scope = bench.scope(FOUR, trigger="torque_reference_Nm > 5")
    bench.run_for(0.01)
    bench.load_torque_Nm = 8
    recording = scope.read()
    assert len(recording.time_s) == 1024
    bench.close()
    truth = np.load(file)

    def deviation(shift):
        """Largest difference of the angles, in counts of the encoder, when the buffer begins at a record of the truth.
        """
        true_deg = truth["rotor_angle_deg"][shift:shift + len(recording.time_s)]
        difference = recording["encoder_angle_deg"] - true_deg
        return float(np.max(np.abs((difference + 180.0) % 360.0 - 180.0))) / COUNT_DEG

    candidates = [shift for shift in range(len(truth) - len(recording.time_s)) if deviation(shift) <= 1.0]
    assert len(candidates) == 1  # half a count and less is at one period only: the rotor turns by 16 counts in each
    at = slice(candidates[0], candidates[0] + len(recording.time_s))
    for phase in "abc":
        error_A = np.abs(recording[f"current_{phase}_A"] - truth[f"current_{phase}_A"][at])
        assert np.max(error_A) <= CURRENT_LSB_A


def test_trigger_is_at_the_first_period_at_which_the_condition_holds(bench):
    running(bench)
    scope = bench.scope(["torque_reference_Nm"], trigger="torque_reference_Nm > 5", before=0.5)
    bench.run_for(0.06)
    bench.load_torque_Nm = 8
    recording = scope.read()
    at = int(np.flatnonzero(recording.time_s == 0.0)[0])
    assert at == len(recording.time_s) // 2 == 2048
    torque_Nm = recording["torque_reference_Nm"]
    assert torque_Nm[at] > 5 and np.all(torque_Nm[:at] <= 5)
    assert np.diff(recording.time_s) == pytest.approx(PERIOD_S, abs=1e-9)


def test_trigger_that_comes_early_has_the_records_since_the_arming_before_it(bench):
    running(bench)
    scope = bench.scope(["torque_reference_Nm"], trigger="torque_reference_Nm rises to 5", before=0.5)
    bench.run_for(0.01)
    bench.load_torque_Nm = 8
    recording = scope.read()
    assert len(recording.time_s) == 4096 and recording.time_s[-1] > 0.08
    at = int(np.flatnonzero(recording.time_s == 0.0)[0])
    assert 0.01 < at * PERIOD_S < 0.03
    assert np.all(recording["torque_reference_Nm"][:at] < 5) and recording["torque_reference_Nm"][at] >= 5


def test_every_eighth_period_shows_the_same_course_with_the_trigger_between_records(bench):
    running(bench)
    scope = bench.scope(["torque_reference_Nm"], trigger="torque_reference_Nm rises to 5", divider=8)
    bench.run_for(0.05)
    bench.load_torque_Nm = 8
    recording = scope.read()
    before = recording.time_s < 0
    assert np.diff(recording.time_s) == pytest.approx(8 * PERIOD_S, abs=1e-9)
    assert np.all(recording["torque_reference_Nm"][before] < 5)
    first = float(recording.time_s[~before][0])
    assert 0.0 <= first < 8 * PERIOD_S


def test_first_fault_triggers_and_the_buffer_keeps_what_led_to_it(bench):
    running(bench)
    scope = bench.scope(["state", "fault", "current_a_A"], trigger="state == fault", before=0.9)
    bench.run_for(0.1)
    bench.fault("winding_open", phase="b")
    bench.run_until(lambda: bench.drive.state == "fault", timeout=0.5)
    recording = scope.read()
    at = int(np.flatnonzero(recording.time_s == 0.0)[0])
    assert recording.names["state"][recording["state"][at]] == "DRIVE_STATE_FAULT"
    assert recording.names["state"][recording["state"][at - 1]] == "DRIVE_STATE_RUN"
    assert recording.names["fault"][recording["fault"][at]] == "FAULT_PHASE_OPEN"
    assert np.ptp(recording["current_a_A"][:at]) > 1.0


def test_armed_buffer_does_not_move_the_drive(make_bench, tmp_path):
    """Reading costs bus time alone: the rotor's course is the same bit by bit until the buffer is read."""
    courses = []
    for armed in (False, True):
        file = tmp_path / f"{armed}.npy"
        bench = make_bench(record=file, record_step_ns=25_000)
        running(bench)
        begin_ns = bench.time_ns
        if armed:
            bench.scope(FOUR, trigger="torque_reference_Nm > 100")
        bench.advance_to(begin_ns + 100_000_000)
        bench.load_torque_Nm = 8
        bench.run_for(0.1)
        bench.close()
        courses.append(np.load(file))
    assert np.array_equal(*courses)


def test_trigger_that_does_not_come_is_told_and_can_be_given_by_hand(bench):
    running(bench)
    scope = bench.scope(["speed_rpm"], trigger="speed_rpm > 2000", divider=2)
    bench.run_for(0.3)
    with pytest.raises(ScopeError, match="the trigger has not come, or the buffer is not complete, within 0.1 s"):
        scope.read(timeout=0.1)
    scope.trigger()
    assert scope.read()["speed_rpm"] == pytest.approx(300, abs=3)


@pytest.mark.parametrize("target", ["cortex-m4", "rv32"])
def test_the_buffer_of_a_target_has_the_same_values_as_that_of_the_host(make_bench, target):
    found = []
    for build in ("host", target):
        bench = make_bench(build=build)
        running(bench, 150.0)
        scope = bench.scope([*FOUR, "torque_reference_Nm", "duty_a"], trigger="torque_reference_Nm rises to 3")
        bench.run_for(0.01)
        bench.load_torque_Nm = 8
        found.append(scope.read())
    host, other = found
    assert {name: values.tolist() for name, values in host.values.items()} == {
        name: values.tolist() for name, values in other.values.items()}


@pytest.mark.parametrize(("signals", "options", "error"), [
    ([], {}, "signals: must be 1 to 8 names"),
    ("speed_rpm", {}, "signals: must be 1 to 8 names"),
    (["speed_rpm"] * 9, {}, "signals: must be 1 to 8 names"),
    (["speed"], {}, "signal 'speed': no variable of the drive; the nearest of"),
    (["speed_rpm"], {"trigger": "speed_rpm"}, "trigger 'speed_rpm': must be 'SIGNAL > VALUE'"),
    (["speed_rpm"], {"trigger": "speed_rpm > fast"}, "trigger 'speed_rpm > fast': fast must be a number"),
    (["speed_rpm"], {"trigger": "state == fautl"}, "fautl must be a number or initialise, ready, run or fault"),
    (["speed_rpm"], {"trigger": "speed_rpm > 1e6"}, "trigger 'speed_rpm > 1e6': speed_rpm is from -4889.24 to"),
    (["speed_rpm"], {"divider": 0}, "divider 0: must be a whole number from 1 to 65535"),
    (["speed_rpm"], {"before": 1.0}, "before 1.0: must be from 0 to below 1"),
])
def test_a_wrong_request_is_named_and_arms_nothing(bench, signals, options, error):
    with pytest.raises(UsageError, match=error.replace("(", r"\(")):
        bench.scope(signals, **options)
    assert not bench.sent


def test_every_short_name_is_a_variable_with_the_unit_that_it_has():
    variables = Variables(machine="saturating")
    for name in SIGNALS:
        unit = {"rpm": "r/min", "Nm": "N m", "V": "V", "A": "A", "deg": "deg", "ticks": "ticks"}.get(
            name.rsplit("_", 1)[-1], "")
        assert variables.quantity(name).unit == unit, name


@pytest.mark.parametrize(("text", "level"), [
    ("current_a_A > 1", 513), ("current_a_A >= 1", 512), ("current_a_A < 1", 511), ("current_a_A <= 1", 512),
    ("current_a_A rises to 1", 512), ("current_a_A falls to 1", 512), ("state == run", 2),
    ("state == DRIVE_STATE_RUN", 2), ("angle_deg >= 270", 3 << 30),
])
def test_level_of_a_trigger_is_the_raw_value_that_the_comparison_means(text, level):
    assert parse_trigger(text, Variables(machine="saturating")).level == level


@pytest.mark.parametrize("example", EXAMPLES, ids=EXAMPLES.values())
def test_example_of_the_page_passes(bench, example):
    namespace = {"np": np}
    exec(example, namespace)
    namespace[EXAMPLES[example]](bench)


def deviations(bench, phases, speed_rpm):
    """Current at equal flux linkage and angle by phase, less the median of the phases: the example of the page."""
    parts = 32
    flux, current = np.zeros((2, phases, parts))
    for phase in range(phases):
        of = f"flux.residual.phase[{phase}]"
        signals = ["flux.residual.sample.electrical", f"{of}.voltage_q29", f"{of}.current_q9"]
        divider = int(2 * 60 / speed_rpm / PERIOD_S / 1366)
        angle, psi, i = bench.scope(signals, divider=divider).read(timeout=4).values.values()
        part = np.int64(np.mod(angle / 2**32 - phase / phases, 1) * parts)
        flux[phase], current[phase] = (np.bincount(part, each, parts) for each in (psi, i))
    used = np.all(flux > flux.max() / 4, axis=0)
    ratio = current[:, used] / flux[:, used]
    return np.median(ratio / np.median(ratio, axis=0), axis=1) - 1


@pytest.mark.in_turns
@pytest.mark.parametrize("machine", ["finite_element", "linear_cosine", "linear_trapezoid", "saturating"])
@pytest.mark.parametrize(("speed_rpm", "phase", "gain"), [(100, "b", 1.02), (300, "a", 0.98), (900, "c", 1.02)])
def test_current_at_equal_flux_linkage_names_a_sensor_that_is_off(make_bench, machine, speed_rpm, phase, gain):
    bench = make_bench(machine=machine)
    phases = 4 if machine == "finite_element" else 3
    running(bench, speed_rpm)
    bench.load_torque_Nm = 5
    bench.run_for(0.5)
    assert np.max(np.abs(deviations(bench, phases, speed_rpm))) < 0.004
    bench.fault("current_sensor_gain", phase=phase, gain=gain)
    bench.run_for(0.5)
    deviation = deviations(bench, phases, speed_rpm)
    at = "abcd".index(phase)
    assert 0.012 < deviation[at] * np.sign(gain - 1.0) < 0.026
    assert np.max(np.abs(np.delete(deviation, at))) < 0.6 * abs(deviation[at])


@pytest.mark.parametrize("ending", [".csv", ".mf4", *([".parquet"] if find_spec("pyarrow") else [])])
def test_recording_is_written_for_other_tools(bench, tmp_path, ending):
    running(bench)
    scope = bench.scope(["state", "torque_reference_Nm"], trigger="torque_reference_Nm > 5", before=0.5)
    bench.load_torque_Nm = 8
    recording = scope.read()
    path = tmp_path / f"recording{ending}"
    recording.write(path)
    if ending == ".csv":
        table = np.genfromtxt(path, delimiter=",", names=True)
        columns = {name: table[name] for name in table.dtype.names}
    elif ending == ".parquet":
        from pyarrow import parquet

        table = parquet.read_table(path)
        assert table.schema.field("torque_reference_Nm").metadata == {b"unit": b"N m"}
        columns = {name: table[name].to_numpy() for name in table.column_names}
    else:
        with MDF(path) as file:
            assert file.get("torque_reference_Nm").unit == "N m"
            assert set(file.get("state").samples) == {b"DRIVE_STATE_RUN"}
            columns = {name: file.get(name, raw=True).samples for name in recording}
            columns["time_s"] = file.get("state").timestamps
    for name, values in recording.columns.items():
        assert columns[name] == pytest.approx(values, rel=1e-8, abs=1e-12), name


def test_parquet_names_the_package_that_it_requires(bench, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UsageError, match=r"x\.parquet: Parquet requires the Python package pyarrow"):
        bench.scope(["state"]).read().write(tmp_path / "x.parquet")
    assert not (tmp_path / "x.parquet").exists()


def test_recording_of_another_ending_is_refused(bench, tmp_path):
    recording = bench.scope(["state"]).read()
    with pytest.raises(UsageError, match=r"x\.xlsx: must end with \.csv, \.mf4 or \.parquet"):
        recording.write(tmp_path / "x.xlsx")
    assert not (tmp_path / "x.xlsx").exists()


def test_buffer_that_was_armed_anew_is_not_read_as_the_earlier_one(bench, tmp_path):
    running(bench)
    earlier = bench.scope(["speed_rpm"], trigger="speed_rpm > 2000")
    later = bench.scope(["current_a_A", "state"])
    bench.run_for(0.2)
    with pytest.raises(ScopeError, match="the buffer of the trigger 'speed_rpm > 2000' has been armed anew since"):
        earlier.read()
    failure.save(bench, tmp_path, {"replay": ""}, None)
    assert {path.name for path in tmp_path.glob("scope_*")} == {"scope_1.csv", "scope_1.png"}
    assert later.recording is not None and earlier.recording is None


def test_failure_report_has_what_the_buffer_has_and_leaves_out_what_is_not_complete(bench, tmp_path):
    running(bench)
    read = bench.scope(["torque_reference_Nm"], trigger="torque_reference_Nm > 5")
    bench.load_torque_Nm = 8
    recording = read.read()
    bench.scope(["state", "current_a_A"], trigger="state == fault", divider=4)
    failure.save(bench, tmp_path / "waits", {"replay": ""}, None)
    names = {path.name for path in (tmp_path / "waits").glob("scope_*")}
    assert names == {"scope_0.csv", "scope_0.png"}
    table = np.genfromtxt(tmp_path / "waits" / "scope_0.csv", delimiter=",", names=True)
    assert len(table) == len(recording.time_s)
    bench.run_for(0.3)
    bench.fault("winding_open", phase="b")
    bench.run_until(lambda: bench.drive.state == "fault", timeout=0.5)
    bench.run_for(0.4)
    failure.save(bench, tmp_path / "complete", {"replay": ""}, None)
    names = {path.name for path in (tmp_path / "complete").glob("scope_*")}
    assert names == {"scope_0.csv", "scope_0.png", "scope_1.csv", "scope_1.png"}
    page = (tmp_path / "complete" / "failure.html").read_text(encoding="utf-8")
    assert "triggered by: state == fault" in page
    failure.clear(tmp_path / "complete")
    assert not list((tmp_path / "complete").iterdir())
