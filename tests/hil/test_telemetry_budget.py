"""Telemetry on the bus: periods, load, and what gives way when the bus is too slow."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from salient.bench.bench import TELEMETRY_PERIOD_MS
from salient.bench.emulator import EmulatorProcess
from salient.bench.session import Session
from salient.bus.signals import drive_database
from salient.config import BenchConfig
from salient.dbc import attributes

MESSAGES = [m for m in drive_database().messages if "DRIVE" in m.senders and m.cycle_time]
ALWAYS = [m for m in MESSAGES if m.send_type != "cyclicIfActive"]
IN_FAULT = [m for m in MESSAGES if m.send_type == "cyclicIfActive" and m.name != "DRIVE_POSITION"]
RATE_PARAMETERS = {1: "telemetry_period_ms", 2: "telemetry_slow_period_ms"}
IDS = {m.frame_id for m in drive_database().messages if "DRIVE" in m.senders}
WINDOW_S = (0.3, 2.3)


@pytest.fixture
def default_drive(tmp_path) -> Iterator[Session]:
    """A drive whose start configuration states no period, as on a board."""
    can = f"unix:{tmp_path}/can.sock"
    with EmulatorProcess(BenchConfig(pace="lockstep"), can) as process, Session(
            can, is_alive=lambda: process.is_alive) as session:
        yield session


def times_s(session: Session, message) -> np.ndarray:
    signal = session.telemetry[f"{message.name}.{message.signals[0].name}"].between(*WINDOW_S)
    return signal.time_s


def stuffed_bits(message) -> int:
    """Length of a classic data frame with 11-bit identifier on the wire, interframe space included: counted bit by bit,
    without code of the emulator."""
    data = bytes(message.data)
    bits = [0, *(message.arbitration_id >> i & 1 for i in range(10, -1, -1)), 0, 0, 0]
    bits += [len(data) >> i & 1 for i in range(3, -1, -1)]
    bits += [byte >> i & 1 for byte in data for i in range(7, -1, -1)]
    crc = 0
    for bit in bits:
        crc = (crc << 1 ^ (0x4599 if bit ^ crc >> 14 & 1 else 0)) & 0x7FFF
    bits += [crc >> i & 1 for i in range(14, -1, -1)]
    length, last, run = 0, -1, 0
    for bit in bits:
        length += 1
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            length, last, run = length + 1, 1 - bit, 1
    return length + 10 + 3  # CRC delimiter, acknowledgement, end of frame; interframe space


def load(session: Session, bit_rate: int = 1_000_000) -> float:
    """Share of the bus that the drive's frames take."""
    frames = [m for time_ns, m in session.log if WINDOW_S[0] <= time_ns * 1e-9 < WINDOW_S[1]
              and m.arbitration_id in IDS and not m.is_extended_id]
    return sum(map(stuffed_bits, frames)) / bit_rate / (WINDOW_S[1] - WINDOW_S[0])


def run_at_600_rpm(session: Session) -> None:
    session.drive.speed_reference_rpm = 600.0
    session.at(0.5).load_torque_Nm = 8.0
    session.run_for(WINDOW_S[1])
    assert session.drive.state == "run"


def check_periods(session: Session, messages, periods_ms=None) -> None:
    for message in messages:
        period_s = (periods_ms or {}).get(message.name, message.cycle_time) * 1e-3
        times = times_s(session, message)
        assert len(times) == pytest.approx((WINDOW_S[1] - WINDOW_S[0]) / period_s, abs=1), message.name
        assert np.mean(np.diff(times)) == pytest.approx(period_s, rel=0.01), message.name


def test_telemetry_takes_less_than_a_fifth_of_1_mbit_s_by_default_at_the_periods_of_the_dbc(default_drive):
    run_at_600_rpm(default_drive)
    check_periods(default_drive, ALWAYS)
    share = load(default_drive)
    print(f"telemetry: {100 * share:.1f} % of 1 Mbit/s")
    assert 0.12 < share < 0.18
    assert default_drive.telemetry["telemetry_dropped"].last == 0
    assert default_drive.drive.parameters["telemetry_period_ms"] == 4.0


def test_telemetry_in_fault_takes_less_than_a_fifth_of_1_mbit_s_by_default(default_drive):
    default_drive.drive.speed_reference_rpm = 600.0
    default_drive.run_for(0.1)
    default_drive.drive.silence()
    default_drive.at(0.2).load_torque_Nm = 1.0
    default_drive.fault("supply_lost")
    default_drive.run_for(WINDOW_S[1] - 0.1)
    assert default_drive.drive.state == "fault"
    check_periods(default_drive, ALWAYS + IN_FAULT)
    share = load(default_drive)
    print(f"telemetry in fault: {100 * share:.1f} % of 1 Mbit/s")
    assert 0.12 < share < 0.19


@pytest.mark.bench_options(bit_rate=500_000, telemetry_period_ms=4)
def test_default_telemetry_fits_500_kbit_s(bench):
    run_at_600_rpm(bench)
    check_periods(bench, ALWAYS)
    share = load(bench, 500_000)
    print(f"telemetry: {100 * share:.1f} % of 500 kbit/s")
    assert 0.24 < share < 0.36
    dropped = bench.telemetry["telemetry_dropped"]
    assert dropped.between(*WINDOW_S).value.max() <= 1, "at the start, when every message is due, a DRIVE_IDENTITY"


@pytest.mark.bench_options(telemetry_period_ms=20)
@pytest.mark.parametrize(("fast_ms", "slow_ms"), [(1, 10), (7, 3), (100, 1000)])
def test_periods_are_those_of_the_parameters(bench, fast_ms, slow_ms):
    parameters = bench.drive.parameters
    parameters["telemetry_period_ms"], parameters["telemetry_slow_period_ms"] = fast_ms, slow_ms
    bench.run_for(WINDOW_S[1] - bench.time_s)
    of_rate = {1: fast_ms, 2: slow_ms}
    periods = {m.name: of_rate[rate] for m in ALWAYS if (rate := attributes(m).get("TelemetryRate")) in of_rate}
    assert len(periods) == 6
    check_periods(bench, ALWAYS, periods)
    assert (parameters["telemetry_period_ms"], parameters["telemetry_slow_period_ms"]) == (fast_ms, slow_ms)


def test_periods_change_in_a_run_without_an_effect_on_it(make_bench):
    speeds, counts = [], []
    for period_ms in (None, 5):
        bench = make_bench()
        bench.drive.speed_reference_rpm = 600.0
        bench.run_for(0.15)
        if period_ms:
            bench.drive.parameters["telemetry_period_ms"] = period_ms
        bench.advance_to(200_000_000)
        counts.append(bench.telemetry.count("DRIVE_STATUS"))
        bench.rig.load_torque_Nm = 8.0
        bench.advance_to(400_000_000)
        counts[-1] = bench.telemetry.count("DRIVE_STATUS") - counts[-1]
        assert bench.drive.state == "run"
        speeds.append(bench.truth["speed_rpm"].value)
    assert np.array_equal(*speeds)
    assert counts == [200, 40]


def test_bench_has_a_telemetry_of_1_ms_from_the_start_and_after_a_reset(bench):
    assert bench.telemetry.count("DRIVE_STATUS") == 0 and bench.time_s == 0.0
    bench.run_for(0.1)
    assert bench.telemetry.count("DRIVE_STATUS") == 100 / TELEMETRY_PERIOD_MS
    bench.rig.drive_reset = 1
    bench.run_for(0.1)
    assert bench.telemetry.count("DRIVE_STATUS") == pytest.approx(200, abs=1)
    assert bench.drive.parameters["telemetry_period_ms"] == TELEMETRY_PERIOD_MS == 1


@pytest.mark.bench_options(bit_rate=250_000)
def test_telemetry_that_the_bus_does_not_take_gives_way_to_commands_and_heartbeat(bench):
    """1 ms at 250 kbit/s is twice what the bus takes."""
    run_at_600_rpm(bench)
    heartbeat, status = (drive_database().get_message_by_name(name) for name in ("DRIVE_HEARTBEAT", "DRIVE_STATUS"))
    assert len(times_s(bench, heartbeat)) == pytest.approx(20, abs=1)
    assert 0.08 < np.diff(times_s(bench, heartbeat)).min() <= np.diff(times_s(bench, heartbeat)).max() < 0.12
    assert 600 < len(times_s(bench, status)) < 1400
    assert 0.9 < load(bench, 250_000) < 1.0
    # The drive runs, so that commands pass; the group of the counters rarely finds room.
    cycle = bench.telemetry["DRIVE_STATUS.cycle"].value
    assert np.diff(cycle).max() > 1, "a gap shows what was dropped"
