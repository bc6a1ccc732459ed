"""The image of the board in the model of its part is bit-identical with the host executable of the same clock.

Compared are the recorded true state (currents, flux linkages, speed and torque) and the CAN frames with their times,
but for the first one of each message: the image's background runs once before the first control period, the host's
after it. DRIVE_THERMAL is left out, whose heating by the background begins then.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from test_same_bits import load_step_150, start_600

from salient.bench.programs import BOARD_CLOCK_MHZ
from salient.bus.signals import drive_database
from salient.config import BOARD_BUILD, CONTROLLERS
from salient.paths import BUILD, ROOT


@pytest.fixture(scope="session")
def host_of_the_clock() -> Path:
    """The host executable whose PWM timer has the clock of the image."""
    folder = BUILD / f"host-{BOARD_CLOCK_MHZ}"
    for command in (["cmake", "--preset", "host", "-B", str(folder), f"-DSALIENT_PWM_CLOCK_MHZ={BOARD_CLOCK_MHZ}",
                     f"-DSALIENT_PYTHON={sys.executable}"],
                    ["cmake", "--build", str(folder), "--target", "salient_host"]):
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    return folder / "bin" / "salient_host"


def after_the_first(frames: list[tuple[int, int, bytes]]) -> list[tuple[int, int, bytes]]:
    """The frames but for the first one of each identifier, and DRIVE_THERMAL."""
    known: set[int] = set()
    thermal = drive_database().get_message_by_name("DRIVE_THERMAL").frame_id
    frames = [frame for frame in frames if frame[1] != thermal]
    return [frame for frame in frames if frame[1] in known or known.add(frame[1])]  # type: ignore[func-returns-value]


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("run", [start_600, load_step_150])
def test_image_and_host_agree_in_frames_and_true_state(make_bench, host_of_the_clock, tmp_path, run, controller):
    made = []
    for number, options in enumerate(({"program": host_of_the_clock}, {"build": BOARD_BUILD})):
        recording = tmp_path / f"{number}.npy"
        bench = make_bench(can=f"unix:{tmp_path}/{number}.sock", record=recording, record_step_ns=10_000,
                           controller=controller, telemetry_period_ms=4, seed=3, initial_angle_deg=12.0, **options)
        run(bench)
        frames = [(time, message.arbitration_id, bytes(message.data)) for time, message in bench.log]
        speed_rpm = bench.truth["speed_rpm"].last
        bench.close()
        made.append((frames, recording.read_bytes(), speed_rpm))
    host, image = made
    expected, got = (after_the_first(frames) for frames, *_ in made)
    assert host[2] > 100.0
    assert image[1] == host[1], "true state"
    assert len(expected) > 2000
    assert [pair for pair in zip(got, expected, strict=True) if pair[0] != pair[1]] == []
