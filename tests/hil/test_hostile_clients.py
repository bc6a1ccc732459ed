"""Invalid frames from other nodes increment their counters and change nothing else: the motion is bit-identical.
[SR-32]
"""

from __future__ import annotations

import random

import can
import numpy as np
import pytest

from salient.bench.drive import command_frame
from salient.bus import e2e
from salient.bus.clock import open_bus
from salient.bus.signals import drive_database

pytestmark = pytest.mark.bench_options(controller="traditional")

COUNTERS = (
    "wrong_length", "wrong_checksum", "wrong_counter", "out_of_range", "unknown_frame", "receive_overflow",
    "telemetry_dropped",
)  # fmt: skip
COMMAND = drive_database().get_message_by_name("DRIVE_COMMAND")
COMMAND_ID = COMMAND.frame_id
REQUEST_ID = drive_database().get_message_by_name("PARAMETER_REQUEST").frame_id
KNOWN_IDS = frozenset(m.frame_id for m in drive_database().messages)


def command(speed_rpm: float = 600.0, counter: int = 200, request: str = "run") -> can.Message:
    """A command with a valid checksum and a counter out of sequence."""
    return command_frame(counter, request, speed_rpm)


def changed(message: can.Message, **changes) -> can.Message:
    fields = {"arbitration_id": message.arbitration_id, "is_extended_id": message.is_extended_id, "data": message.data}
    return can.Message(**(fields | changes))


GOOD = command()
BITS_CHANGED = [changed(GOOD, data=bytes(b ^ (1 << i % 8) if i == j else b for i, b in enumerate(GOOD.data)))
                for j in range(7)]
"""One bit in each byte."""

# At most three invalid commands: a fourth one is a fault.
ATTACKS = {
    "wrong_length too short": [changed(GOOD, data=bytes(GOOD.data[:n])) for n in (0, 3, 6)],
    "wrong_length too long": [changed(GOOD, data=bytes(GOOD.data) + b"\0")],
    "wrong_checksum in the header": BITS_CHANGED[:3],
    "wrong_checksum in the request": BITS_CHANGED[3:5],
    "wrong_checksum in the reference": BITS_CHANGED[5:],
    "wrong_counter": [command(3000.0), command(-3000.0, counter=100)],
    "unknown_frame": [
        can.Message(arbitration_id=0x001, is_extended_id=False, data=bytes(8)),
        can.Message(arbitration_id=COMMAND_ID, is_extended_id=True, data=GOOD.data),
        can.Message(arbitration_id=1 << 18 | COMMAND_ID, is_extended_id=True, data=GOOD.data),
        can.Message(arbitration_id=COMMAND_ID, is_extended_id=False, is_remote_frame=True, dlc=7),
        can.Message(arbitration_id=0x7FF, is_extended_id=False, data=b""),
    ],
}


def steady(make_bench, tmp_path, name, **options):
    """A paper drive at 600 r/min, its true state recorded from 0.1 s on."""
    bench = make_bench(controller="paper", record=tmp_path / f"{name}.npy", record_step_ns=10_000,
                       record_from_us=100_000, **options)
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.105)
    return bench


def finish(bench) -> tuple[np.ndarray, dict[str, float]]:
    """Ends the run at 0.25 s; returns the recording and the counters."""
    bench.advance_to(250_000_000)
    bench.close()
    return np.load(bench.options.record), {name: bench.telemetry[name].last for name in COUNTERS}


@pytest.fixture
def undisturbed(make_bench, tmp_path):
    recording, counters = finish(steady(make_bench, tmp_path, "undisturbed"))
    assert not any(counters.values())
    assert len(recording) == 15_001
    return recording


@pytest.mark.parametrize("attack", ATTACKS)
def test_invalid_frames_are_counted_and_change_nothing(make_bench, tmp_path, undisturbed, attack):
    bench = steady(make_bench, tmp_path, "disturbed")
    with open_bus(bench.address) as attacker:
        for frame in ATTACKS[attack]:
            attacker.send(frame)
    recording, counters = finish(bench)
    assert np.array_equal(recording, undisturbed)
    assert counters == dict.fromkeys(COUNTERS, 0.0) | {attack.split()[0]: len(ATTACKS[attack])}


# [SR-33]
@pytest.mark.parametrize("frames", [BITS_CHANGED[:4], [changed(GOOD, data=b"")] * 4,
                                    [command(3000.0), command(3000.0), command(-3000.0, 9), command(100.0, 120)]],
                         ids=["wrong_checksum", "wrong_length", "wrong_counter"])
def test_four_invalid_commands_in_succession_are_a_fault(bench, frames):
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.1001)
    bench.drive.silence()  # none of its commands between them
    for number, frame in enumerate(frames):
        assert bench.drive.state == "run", number
        bench.send(frame)
        bench.run_for(0.002)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "command_error")
    bench.run_for(0.101)
    assert bench.telemetry["DRIVE_FAULT_MASK.command_error"].last == 1
    assert bench.telemetry["DRIVE_FAULT_CAUSE.state"].last_name == "run"
    assert bench.truth["current_a_A"].last == bench.truth["current_b_A"].last == 0


@pytest.mark.parametrize("raw_speed", [3_000_001, -3_000_001, 2**23 - 1, -(2**23)])
def test_commands_out_of_range_are_counted_and_change_nothing(make_bench, tmp_path, undisturbed, raw_speed):
    """Checksum and counter are valid: only the range is wrong."""
    bench = steady(make_bench, tmp_path, "disturbed")
    sent = [m.data[2] for _, m in bench.log if m.arbitration_id == COMMAND_ID]
    payload = b"\1" + raw_speed.to_bytes(3, "little", signed=True)
    data = e2e.protect(e2e.data_id(COMMAND), sent[-1] + 1, payload)
    with open_bus(bench.address) as attacker:
        attacker.send(changed(GOOD, data=data))
    recording, counters = finish(bench)
    assert np.array_equal(recording, undisturbed)
    assert counters["out_of_range"] == 1


def of_another_node(identifier: int) -> bool:
    """Traffic of a drive with another node number, of which this one takes no notice."""
    return identifier >> 7 in (1, 3, 5, 11, 12, 14) and identifier & 0x70 != 0


def test_flood_delays_telemetry_but_not_the_drive(make_bench, tmp_path, undisturbed):
    """Ten clients that send 40 frames each and leave. Not with identifiers of the drive's own, which are a fault
    (test_bus_faults.py), nor twice the same at once, which would be bit errors."""
    bench = steady(make_bench, tmp_path, "disturbed")
    generator = random.Random(1)
    sent = generator.sample([i for i in range(0x800) if i not in KNOWN_IDS], 400)
    identifiers = sent.copy()
    for _ in range(10):
        with open_bus(bench.address) as attacker:
            for _ in range(40):
                identifier = identifiers.pop()
                data = generator.randbytes(generator.randrange(9))
                attacker.send(can.Message(arbitration_id=identifier, is_extended_id=False, data=data))
    recording, counters = finish(bench)
    assert np.array_equal(recording, undisturbed)
    # Low identifiers delay the telemetry, which is dropped by rule and counted.
    assert counters["unknown_frame"] == len([i for i in sent if not of_another_node(i)]) < 400
    assert {name for name, count in counters.items() if count} <= {"unknown_frame", "telemetry_dropped"}


def test_records_that_are_not_frames_are_discarded(make_bench, tmp_path, undisturbed):
    bench = steady(make_bench, tmp_path, "disturbed")
    with open_bus(bench.address) as attacker:
        for size in (1, 7, 8, 23, 25, 79, 81, 5000):
            attacker._socket.send(bytes(size))
        attacker._socket.send(bytes(8) + bytes(4) + b"\xff" * 12)  # a length of 255
    recording, counters = finish(bench)
    assert np.array_equal(recording, undisturbed)
    assert not any(counters.values())


@pytest.mark.both_transports
def test_flexible_data_rate_and_error_frames_do_not_reach_the_drive(bench):
    bench.drive.speed_reference_rpm = 150
    bench.run_for(0.01)
    bench.send(can.Message(arbitration_id=COMMAND_ID, is_extended_id=False, is_fd=True, data=bytes(64)))
    bench.run_for(0.2)
    assert not any(bench.telemetry[name].last for name in COUNTERS)
    assert bench.drive.state == "run"
