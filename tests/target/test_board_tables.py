"""The image of the board takes tables of another machine over CAN as the host executable does, and has the same bits
after. [SR-61]"""

from __future__ import annotations

import pytest
from test_same_bits import load_step_150

from salient.bench import programs, tables
from salient.experiments.board_same_bits import pair

OTHER = "linear_cosine"


@pytest.mark.in_turns
def test_image_with_tables_from_its_memory_and_host_agree_in_frames_and_true_state(make_bench, tmp_path):
    wanted, made = tables.tables_of(OTHER), []
    for number, own in enumerate(pair(programs.BOARD_CLOCK_MHZ)):
        recording = tmp_path / f"{number}.npy"
        options = own | {"can": f"unix:{tmp_path}/{number}.sock", "memory": tmp_path / f"{number}.bin",
                             "telemetry_period_ms": 4, "true_machine": OTHER, "controller": "salient"}
        writer = make_bench(**options)
        tables.write(writer, wanted)
        writer.rig.drive_reset = 1
        writer.run_for(0.3)
        assert tables.read(writer) == wanted
        writer.close()
        bench = make_bench(record=recording, record_step_ns=10_000, seed=3, **options)
        load_step_150(bench)
        frames = [(time, message.arbitration_id, bytes(message.data)) for time, message in bench.log]
        assert bench.truth["speed_rpm"].last > 100.0
        bench.close()
        made.append((frames, recording.read_bytes()))
    host, image = made
    assert image[1] == host[1], "true state"
    assert len(host[0]) > 2000
    assert [pair for pair in zip(image[0], host[0], strict=True) if pair[0] != pair[1]] == []
