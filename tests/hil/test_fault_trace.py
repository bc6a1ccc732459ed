"""The last control periods before a fault, as the drive keeps them, against the true state at the same instants."""

from __future__ import annotations

import csv
import re
import threading

import numpy as np
import pytest
from can import Message

from salient.bench import scope
from salient.bench.bench import Bench
from salient.bench.drive import DriveError
from salient.bench.emulator import EmulatorProcess
from salient.bench.session import Session
from salient.cli import make_parser
from salient.config import BenchConfig
from salient.errors import RunFailed


def fault_at(bench: Bench, after_s: float = 0.1) -> float:
    """Runs at 600 r/min into a jump of the encoder; the time of the fault, on the clock of the drive."""
    bench.drive.speed_reference_rpm = 600
    bench.load_torque_Nm = 4
    bench.run_for(after_s)
    bench.fault("encoder_jump", angle_deg=3)
    bench.run_for(0.02)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "encoder")
    return float(bench.telemetry["DRIVE_FAULT_CAUSE.time_us"].last) * 1e-6


def at(bench: Bench, name: str, times_s: np.ndarray) -> np.ndarray:
    """True values at these times."""
    signal = bench.truth[name]
    rows = np.searchsorted(np.asarray(signal.time_s), times_s - 1e-7)
    assert np.allclose(np.asarray(signal.time_s)[rows], times_s, atol=1e-6)
    return np.asarray(signal.value)[rows]


@pytest.mark.in_turns
@pytest.mark.parametrize("controller", ["traditional", "paper", "salient"])
@pytest.mark.parametrize("control_rate_hz", [20000, 40000])
def test_every_row_is_the_true_state_at_the_start_of_its_period(make_bench, controller, control_rate_hz):
    bench = make_bench(controller=controller, control_rate_hz=control_rate_hz)
    bench.rig.truth_period_us = 25
    fault_s = fault_at(bench)
    trace = bench.drive.fault_trace()
    times_s = fault_s + trace.time_s
    assert len(times_s) == 64
    assert np.diff(trace.time_s) == pytest.approx(1 / control_rate_hz)
    assert trace.time_s[-1] == 0
    for phase, name in enumerate("abc"):
        true_A = at(bench, f"RIG_TRUTH_CURRENTS.current_{name}_A", times_s)
        assert np.abs(trace.current_A[:, phase] - true_A).max() <= 0.012  # half a count, and the LSB of the frame
    assert trace.current_A.shape == (64, 3)
    assert trace.current_A.max() > 3
    assert np.abs(trace.bus_voltage_V - 240).max() < 0.2
    assert np.abs(trace.speed_rpm[:-2] - 600).max() < 30
    true_deg = at(bench, "rotor_angle_deg", times_s)
    wrapped = (trace.rotor_angle_deg - true_deg + 180) % 360 - 180
    assert np.abs(wrapped[:-1]).max() < 0.02
    assert wrapped[-1] == pytest.approx(3, abs=0.02), "the jump is the cause"


@pytest.mark.parametrize("controller", ["traditional", "salient"])
def test_the_duties_are_those_that_the_switches_follow_until_the_fault_opens_them(make_bench, controller):
    bench = make_bench(controller=controller)
    fault_at(bench)
    trace = bench.drive.fault_trace()
    assert trace.upper_duty.min() == 0
    assert 0.1 < trace.upper_duty.max() <= 1.0001
    assert 0.1 < trace.lower_duty.max() <= 1.0001
    assert trace.upper_duty[-2].max() + trace.lower_duty[-2].max() > 0
    assert not trace.upper_duty[-1].any()
    assert not trace.lower_duty[-1].any()
    assert trace.torque_reference_Nm[-2] > 1
    rising = np.diff(trace.current_A, axis=0)[1:] > 0.1
    both_on = (trace.upper_duty[:-2] > 0) & (trace.lower_duty[:-2] > 0)
    assert rising.sum() > 5
    assert both_on[rising].mean() > 0.95, "a current rises in the period after both duties were written"


def test_the_trace_is_kept_until_the_drive_runs_again(bench):
    with pytest.raises(DriveError, match="no_such_entry"):
        bench.drive.fault_trace()
    fault_at(bench)
    first = bench.drive.fault_trace()
    bench.clear_fault("encoder_jump")
    bench.run_for(0.05)
    bench.drive.clear_fault()
    bench.run_for(0.05)
    assert bench.drive.state == "ready"
    again = bench.drive.fault_trace()
    assert np.array_equal(first.current_A, again.current_A)
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.05)
    assert bench.drive.state == "run"
    with pytest.raises(DriveError, match="no_such_entry"):
        bench.drive.fault_trace()


def test_a_fault_right_after_the_start_has_rows_of_zeros_before_the_start(bench):
    bench.rig.drive_reset = 1
    bench.rig.at(bench.time_s + 0.001_3).sto_1 = 1
    bench.run_for(0.02)
    assert bench.drive.fault == "sto"
    trace = bench.drive.fault_trace()
    known = trace.bus_voltage_V > 0
    assert known.sum() == pytest.approx(52, abs=1), "1.3 ms"
    assert known[12:].sum() == known.sum()
    assert not trace.upper_duty.any()


@pytest.mark.in_turns
def test_scope_writes_the_buffer_as_table_and_plot_and_says_when_there_is_none(tmp_path, capsys):
    can, out = f"unix:{tmp_path}/bus.sock", tmp_path / "out"
    arguments = make_parser().parse_args(["scope", "--can", can, "--out", str(out)])
    with EmulatorProcess(BenchConfig(pace="x0.2"), can):
        with pytest.raises(RunFailed, match="keeps no record"):
            scope.run(arguments)
        assert not list(out.iterdir())
        with Session(can, lockstep=False) as session:
            session.drive.speed_reference_rpm = 300
            session.run_for(0.05)
            session.rig.sto_1 = 1
            session.run_for(0.01)
            trace = session.drive.fault_trace()
        assert scope.run(arguments) == 0
    assert capsys.readouterr().out.startswith("sto in state run: 64 control periods: ")
    table = np.genfromtxt(out / scope.TABLE, delimiter=",", names=True)
    assert table.dtype.names == tuple(scope.columns(trace))
    assert {"time_s", "current_a_A", "rotor_angle_deg", "upper_duty_c"} <= set(table.dtype.names)
    for name, values in scope.columns(trace).items():
        assert table[name] == pytest.approx(values)
    assert np.max(table["current_a_A"]) > 1 or np.max(table["current_b_A"]) > 1
    assert (out / scope.PLOT).stat().st_size > 10_000


DATABASE = """VERSION ""
BU_: ABS BMS
BO_ 300 WHEELS: 8 ABS
 SG_ front_left : 7|16@0+ (0.01,0) [0|655.35] "km/h" BMS
BO_ 310 CHARGE: 2 BMS
 SG_ part : 0|10@1+ (0.1,0) [0|100] "%" ABS
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 300 10;
BA_ "GenMsgCycleTime" BO_ 310 100;
"""


def test_scope_has_the_signals_and_the_traffic_of_other_nodes_while_it_reads(tmp_path, capsys):
    """ABS sends throughout, BMS never: 100 ms of it are three cycles in the time of the buffer."""
    can, out, database = f"unix:{tmp_path}/bus.sock", tmp_path / "out", tmp_path / "brake.dbc"
    database.write_text(DATABASE, encoding="utf-8")
    arguments = make_parser().parse_args(["scope", "--can", can, "--out", str(out), "--dbc", str(database)])
    with EmulatorProcess(BenchConfig(pace="x0.2"), can), Session(can, lockstep=False) as session:
        session.rig.sto_1 = 1
        session.run_for(0.03)
        ends = threading.Event()

        def send() -> None:
            while not ends.is_set():
                session.send(Message(arbitration_id=300, is_extended_id=False, data=b"\x30\x39" + bytes(6)))
                session.run_for(0.01)

        sender = threading.Thread(target=send)
        sender.start()
        assert scope.run(arguments) == 0
        ends.set()
        sender.join()
    printed = capsys.readouterr().out
    with (out / scope.SIGNALS).open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["message"] == "WHEELS"]
    times_s = [float(row["time_s"]) for row in rows]
    assert len(rows) > 20 and {(row["value"], row["unit"]) for row in rows} == {("123.45", "km/h")}
    assert np.mean(np.diff(times_s)) == pytest.approx(0.010, rel=0.05) and times_s[-1] - times_s[0] > 0.25
    assert re.search(r"^ +12C WHEELS .*expected +10 ms", printed, re.MULTILINE)
    assert re.search(r"^ +136 CHARGE .*expected +100 ms +never$", printed, re.MULTILINE)
