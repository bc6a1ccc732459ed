"""Every fault of the emulated bus is answered with done and acts, or is refused; none is without an effect."""

from __future__ import annotations

import numpy as np
import pytest

from salient.bench.rig import RigError, bench_variables

pytestmark = pytest.mark.bench_options(telemetry_period_ms=4)
BUS_FAULTS = {"frame_fault", "frame_fault_per_mille", "frame_fault_sender", "frame_delay_us", "bus_connection",
              "transmit_error_counter", "babble_load_percent", "babble_identifier", "babble_length"}
OF_ALL, OF_DRIVE, OF_OTHERS = 0, 1, 2
LOST, CORRUPTED, DELAYED, DUPLICATED = 1, 2, 3, 4


def status_frames(bench) -> int:
    return len(bench.telemetry["DRIVE_STATUS.cycle"].between(bench.time_s - 0.04, bench.time_s))


def latest_delay_s(bench) -> float:
    status = bench.telemetry["DRIVE_STATUS.time_us"]
    return float(status.last_time_s - status.last * 1e-6)


def accepted(bench) -> float:
    bench.drive.off()
    bench.run_for(0.14)
    return bench.telemetry["command_accepted"].last


def babbled(bench) -> list[int]:
    return [len(m.data) for _, m in bench.log if m.arbitration_id == 0x123 and not m.is_extended_id]


# Settings, virtual time that they act, what they are seen by. Without a fault there are 10 DRIVE_STATUS in 40 ms.
CASES = {
    "lost": ({"frame_fault_sender": OF_DRIVE, "frame_fault": LOST}, 0.05, lambda b: status_frames(b) == 0),
    "share": ({"frame_fault_per_mille": 500, "frame_fault_sender": OF_DRIVE, "frame_fault": LOST}, 0.05,
              lambda b: 1 <= status_frames(b) <= 9),
    "sender": ({"frame_fault_sender": OF_OTHERS, "frame_fault": LOST}, 0.05,
               lambda b: status_frames(b) == 10 and accepted(b) == 0),
    "corrupted": ({"frame_fault_per_mille": 200, "frame_fault": CORRUPTED}, 0.22,
                  lambda b: b.telemetry["transmit_error_counter"].value.max() > 0 and status_frames(b) == 10),
    "delayed": ({"frame_delay_us": 2000, "frame_fault_sender": OF_DRIVE, "frame_fault": DELAYED}, 0.05,
                lambda b: 0.002 < latest_delay_s(b) < 0.004),
    "duplicated": ({"frame_fault_per_mille": 500, "frame_fault_sender": OF_DRIVE, "frame_fault": DUPLICATED}, 0.05,
                   lambda b: 11 <= status_frames(b) <= 19),
    "disconnected": ({"bus_connection": 0}, 0.05, lambda b: status_frames(b) == 0),
    "bus_off": ({"transmit_error_counter": 256}, 0.21, lambda b: b.telemetry["bus_off_count"].last == 1),
    "babble": ({"babble_identifier": 0x123, "babble_length": 3, "babble_load_percent": 50}, 0.05,
               lambda b: len(babbled(b)) > 200 and set(babbled(b)) == {3}),
}


def test_every_bus_fault_has_a_case():
    numbers = {name for name, signal in bench_variables().items() if 40 <= signal.multiplexer_ids[0] < 50}
    assert numbers == BUS_FAULTS == {name for settings, _, _ in CASES.values() for name in settings}


@pytest.mark.parametrize("case", CASES)
def test_bus_fault_is_done_and_acts(bench, case):
    settings, duration_s, acts = CASES[case]
    bench.run_for(0.05)
    assert status_frames(bench) == 10 and latest_delay_s(bench) < 0.001 and not babbled(bench)
    for name, value in settings.items():
        setattr(bench.rig, name, value)  # RigError unless it is answered with done
    bench.run_for(duration_s)
    assert acts(bench)


def test_value_that_a_bus_fault_does_not_have_is_refused(bench):
    for name in BUS_FAULTS:
        with pytest.raises(RigError, match=f"^{name} .*: must be "):
            setattr(bench.rig, name, 1e7)
    bench.run_for(0.05)
    assert status_frames(bench) == 10 and np.all(bench.truth["speed_rpm"].value == 0.0)
