"""The live page in Chromium: time to the first curve, from a signal to the screen, load of the server, lost frames."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from playwright.sync_api import Page, sync_playwright

from salient.bench.emulator import EmulatorProcess
from salient.config import BenchConfig
from salient.errors import RunFailed, UsageError

SIGNALS = [
    *(f"DRIVE_MOTION.{name}" for name in ("speed_rpm", "speed_reference_rpm", "rotor_angle_deg")),
    *(f"DRIVE_TORQUE.{name}" for name in ("torque_reference_Nm", "torque_estimate_Nm", "load_torque_estimate_Nm",
                                          "bus_voltage_V")),
    *(f"DRIVE_CURRENTS.current_{phase}_A" for phase in "abcd"),
    *(f"RIG_TRUTH_CURRENTS.current_{phase}_A" for phase in "abcd"),
    *(f"RIG_TRUTH_MOTION.{name}" for name in ("speed_rpm", "torque_Nm")),
    *(f"RIG_TRUTH_BENCH.{name}" for name in ("rotor_angle_deg", "load_torque_Nm", "bus_voltage_V")),
]
"""Twenty signals at 1 kHz."""
_SETTLE_S = 2.0


def measure(duration_s: float) -> dict[str, Any]:
    """Measures one page on a drive in real time for some seconds of the wall clock, prints and returns the figures."""
    chromium = shutil.which("chromium")
    if chromium is None:
        raise UsageError("benchmark --page: chromium is missing")
    with tempfile.TemporaryDirectory(prefix="salient-") as folder, sync_playwright() as playwright:
        can = f"unix:{folder}/can.sock"
        with EmulatorProcess(BenchConfig(pace="realtime", telemetry_period_ms=1), can), _server(can) as (link, pid):
            browser = playwright.chromium.launch(executable_path=chromium,
                                                 args=["--no-sandbox"] if os.geteuid() == 0 else [])
            try:
                # Playwright's functions are evaluated from text, which the page's policy forbids.
                page = browser.new_page(bypass_csp=True, viewport={"width": 1280, "height": 800})
                begin_s = time.monotonic()
                page.goto(link)
                page.wait_for_function("globalThis.salient && salient.drawn > 0 && salient.store.frames > 100")
                first_s = time.monotonic() - begin_s
                figures = {"first_curve_s": round(first_s, 2), **_run(page, pid, duration_s)}
            finally:
                browser.close()
    print(f"the live page in Chromium: {len(SIGNALS)} signals at 1 kHz, a drive at 600 r/min in real time, "
          f"{duration_s:g} s")
    print(f"  from the link to the first curve {figures['first_curve_s']:.2f} s")
    print(f"  from the server's reception of a frame to its display: median {figures['median_ms']:.0f} ms, "
          f"p99 {figures['p99_ms']:.0f} ms")
    print(f"  server {figures['server_percent']:.1f} % of a core, {figures['frames_per_s']:.0f} frames/s, "
          f"{figures['pictures_per_s']:.0f} fps, {figures['lost']} frames lost")
    return figures


def _run(page: Page, pid: int, duration_s: float) -> dict[str, Any]:
    page.evaluate("(names) => salient.choose(names)", SIGNALS)
    page.evaluate("async () => { await salient.act('take', {}); await salient.act('speed_reference', {rpm: 600}); }")
    page.wait_for_timeout(_SETTLE_S * 1e3)
    counts = "[salient.store.frames, salient.drawn, performance.now()]"
    frames, drawn, at_ms = page.evaluate(counts)
    page.evaluate("() => { salient.source.latencies_ms.length = 0; }")
    before_s = _processor_s(pid)
    page.wait_for_timeout(duration_s * 1e3)
    used_s = _processor_s(pid) - before_s
    frames_end, drawn_end, end_ms = page.evaluate(counts)
    latencies_ms = sorted(page.evaluate("salient.source.latencies_ms"))
    passed_s = (end_ms - at_ms) / 1e3
    if page.evaluate("salient.lease") != "yours":
        raise RunFailed("the page fell so far behind the drive that the server took its command away")
    return {
        "duration_s": duration_s,
        "median_ms": round(latencies_ms[len(latencies_ms) // 2], 1),
        "p99_ms": round(latencies_ms[int(len(latencies_ms) * 0.99)], 1),
        "server_percent": round(100.0 * used_s / passed_s, 1),
        "frames_per_s": round((frames_end - frames) / passed_s),
        "pictures_per_s": round((drawn_end - drawn) / passed_s, 1),
        "lost": page.evaluate("salient.store.lost"),
    }


@contextmanager
def _server(can: str) -> Iterator[tuple[str, int]]:
    """Link and process number of a running `view`."""
    line = [sys.executable, "-m", "salient", "view", "--can", can]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None  # a pipe
        try:
            yield process.stdout.readline().removeprefix("live page: ").strip(), process.pid
        finally:
            process.terminate()


def _processor_s(pid: int) -> float:
    """Processor time of a process, from the clock of clock_getcpuclockid(3) on Linux."""
    return time.clock_gettime((~pid << 3) | 2)
