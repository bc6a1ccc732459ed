"""Fixtures of these tests."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from playwright.sync_api import Browser, sync_playwright


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    executable = shutil.which("chromium")
    assert executable, "chromium is missing: tools/salient test installs it"
    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=executable, args=["--no-sandbox"])  # tests run as root
        yield launched
        launched.close()


@dataclass(frozen=True)
class DaskCluster:
    """A scheduler and its worker processes."""

    address: str
    workers: list[subprocess.Popen[str]]


@pytest.fixture
def dask_cluster(tmp_path: Path) -> Iterator[DaskCluster]:
    """A Dask scheduler and two workers of one thread on the loopback, which import modules of this folder."""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    processes = []

    def start(module: str, *options: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", f"distributed.cli.{module}", *options, "--no-dashboard"]
        processes.append(subprocess.Popen(command, cwd=tmp_path, env=environment, text=True, stderr=subprocess.PIPE))
        return processes[-1]

    try:
        scheduler = start("dask_scheduler", "--host", "tcp://127.0.0.1", "--port", "0")
        assert scheduler.stderr is not None
        address = next(match[1] for line in scheduler.stderr if (match := re.search(r"Scheduler at: +(tcp:\S+)", line)))
        workers = [start("dask_worker", address, "--host", "127.0.0.1", "--no-nanny", "--nthreads", "1",
                         "--local-directory", str(tmp_path / f"worker{number}")) for number in range(2)]
        from distributed import Client

        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(2)
        yield DaskCluster(address, workers)
    finally:
        for process in processes:
            process.kill()
            process.communicate()


@pytest.fixture
def unreadable(browser: Browser) -> Callable[[Path, int], list[str]]:
    """What a person cannot read of a page at a width: text that is cut off, or the numbers of a table that its first
    column, which stays when the table is scrolled, covers."""

    def find(path: Path, width: int) -> list[str]:
        page = browser.new_page(viewport={"width": width, "height": 800})
        try:
            page.goto(path.as_uri())
            return page.evaluate("""() => [
                ...(document.documentElement.scrollWidth > innerWidth ? ["the page"] : []),
                ...[...document.querySelectorAll("h1, h2, h3, p, li, th, td, pre, figcaption, small, b")]
                    .filter((each) => each.scrollWidth > each.clientWidth + 1 && each.clientWidth > 0),
                ...[...document.querySelectorAll(".wide th:first-child:not([colspan])")]
                    .filter((each) => each.offsetWidth > 0.5 * each.closest(".wide").clientWidth),
            ].map((each) => each.textContent || each)""")
        finally:
            page.close()

    return find
