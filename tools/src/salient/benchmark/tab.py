"""The drive in a browser tab, in Chromium: size of the file, time to the first motion, multiple of real time."""

from __future__ import annotations

import os
import shutil
import statistics
import tempfile
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, sync_playwright

from salient.errors import UsageError
from salient.tab.file import packed_bytes, tab_html

_RUN_S = 2.0
_FIRST_MOTION = """() => new Promise((resolve) => {
    const look = () => globalThis.salient && salient.store.watch("RIG_TRUTH_MOTION.speed_rpm").last > 1
        ? resolve(performance.now()) : requestAnimationFrame(look);
    look();
})"""
_TIMES_REAL = f"""() => {{
    const {{ run }} = salient.source;
    salient.stopTime();
    const begin_ms = performance.now();
    run.advanceTo(run.timeNs + {_RUN_S * 1e9});
    return {_RUN_S * 1e3} / (performance.now() - begin_ms);
}}"""
"""The drive holds 300 r/min at 40 kHz, and the page draws nothing meanwhile."""


def measure(runs: int) -> dict[str, Any]:
    """Measures `runs` times, prints and returns the figures."""
    chromium = shutil.which("chromium")
    if chromium is None:
        raise UsageError("benchmark --tab: chromium is missing")
    text = tab_html().encode()
    with tempfile.TemporaryDirectory(prefix="salient-") as folder, sync_playwright() as playwright:
        path = Path(folder) / "tab.html"
        path.write_bytes(text)
        browser = playwright.chromium.launch(executable_path=chromium,
                                             args=["--no-sandbox"] if os.geteuid() == 0 else [])
        try:
            measured = [_once(browser, path.as_uri()) for _ in range(runs)]
        finally:
            browser.close()
    motion_s, times_real = ([each[at] for each in measured] for at in (0, 1))
    figures = {"bytes": len(text), "packed_bytes": packed_bytes(text), "first_motion_s": statistics.median(motion_s),
               "times_real_time": statistics.median(times_real)}
    print(f"the drive in a tab, in Chromium, median of {runs}")
    print(f"  {figures['bytes']:,} bytes, {figures['packed_bytes']:,} after gzip -9")
    print(f"  from the opening of the file to the first motion {figures['first_motion_s']:.2f} s")
    print(f"  {figures['times_real_time']:.1f} times real time (best {max(times_real):.1f})")
    return figures


def _once(browser: Browser, address: str) -> tuple[float, float]:
    """Seconds to the first motion, times real time."""
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.goto(address)
    motion_ms = page.evaluate(_FIRST_MOTION)
    page.wait_for_function("salient.source.run.timeNs > 2e8")
    times_real = page.evaluate(_TIMES_REAL)
    page.close()
    return motion_ms / 1e3, times_real
