"""The pages of compare and pil, and of a failed test, at a desk's and a phone's width in Chromium. Content is made up,
with names as long as they become."""

from __future__ import annotations

import pytest

from salient.pages import Plot, write_page
from salient.paths import ROOT

PLOT = Plot("Largest torque over the speed", "Mean torque at the current limit over the speed, with its bound",
            (ROOT / "docs" / "images" / "dip.png").read_bytes())
CONTROLLERS = ["traditional", "paper", "salient"]
ROWS = [("control interrupts", ["20000", "20000", "20000"]),
        ("firmware/control/observer_bandwidth.c: 319", ["100 %, 100 %", "86 %, 61 %", "100 %, 93 %"])]
PAGES = {
    "pil.html": {
        "controllers": CONTROLLERS, "scenario": "load_step_150", "duration_s": 0.5, "machine": "saturating",
        "control_rate_khz": 40, "target": "cortex-m4", "plot": PLOT,
        **dict.fromkeys(("profile", "estimate", "modules", "stack", "coverage"), ROWS)},
    "compare.html": {
        "summary": "437 of 438 targets reached", "missed": ["saturating, 40 kHz: torque ripple 0.012, target 0.010"],
        "changes": None, "changes_plot": None, "command": "tools/salient compare --quick --out out/compare",
        "groups": [{"name": "machines", "title": "Machines of all sizes: start to 0.4 of the base speed, half of the "
                    "rated torque at a quarter of it, reversal; largest torque over the speed", "plots": [PLOT],
                    "controllers": CONTROLLERS, "conditions": [
                        {"title": "random_00 at 20 kHz", "failed": [("paper", "over_current at 0.123 s")], "rows": [
                            {"label": "latest beyond 1.1 times the bound or 2 ms, ms", "published": "0.043 / 0.0197",
                             "cells": ["257.42", "never", "0.00", "0.010", "0.0049"], "state": "missed",
                             "status": "missed: 0.012"}]}]}]},
    "failure.html": {
        "test": "tests/drive/test_kinds.py::test_timeout[linear_cosine-paper]", "phase": "call",
        "replay_in": "/home/user", "error": ">       bench.run_until(lambda: False, timeout=0.06)",
        "machine": "linear_cosine", "seed": 1, "virtual_time_s": 0.09, "plots": [PLOT], "stderr": "",
        "drive": "tripped: encoder, reported at 0.201552 s, 1.552 ms after fault encoder_stuck begins",
        "last_stimulus": "0.250000 s run in speed mode, speed_reference_rpm = 0 r/min, 1.316 ms before the failure",
        "stimuli": ["0.250000 s run in speed mode, speed_reference_rpm = 0 r/min"],
        "changes_before_the_failure": ["0.251316 s DRIVE_MOTION.speed_reference_rpm: 300 r/min -> 0 r/min"],
        "view": "salient view --replay build/failures/tests_drive_test_kinds.py_test_timeout_linear_cosine-paper_/0",
        "replay": "venv/bin/python -m pytest 'tests/drive/test_kinds.py::test_timeout[linear_cosine-paper]'",
        "simulator": "/home/user/venv/lib/python3.11/site-packages/salient/data/bin/salient_host --controller paper"},
}


@pytest.mark.in_turns
@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("name", PAGES)
def test_nothing_is_cut_off_or_covered(unreadable, tmp_path, name, width):
    write_page(tmp_path / name, name, PAGES[name])
    assert unreadable(tmp_path / name, width) == []


def test_a_column_that_covers_its_table_is_noticed(unreadable, tmp_path):
    write_page(tmp_path / "page.html", "pil.html", PAGES["pil.html"])
    text = (tmp_path / "page.html").read_text()
    (tmp_path / "page.html").write_text(text.replace("max-width: 45vw; white-space: normal", "white-space: nowrap"))
    assert unreadable(tmp_path / "page.html", 390) != []
