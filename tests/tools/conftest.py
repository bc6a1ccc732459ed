"""Fixtures of these tests."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, sync_playwright

from salient.experiments.local_cluster import Cluster, cluster


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    executable = shutil.which("chromium")
    assert executable, "chromium is missing: tools/salient test installs it"
    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=executable, args=["--no-sandbox"])  # tests run as root
        yield launched
        launched.close()


@pytest.fixture
def serve() -> Iterator[Callable[..., str]]:
    """Starts `view` with options and returns its link; ends it by an interrupt."""
    processes = []

    def start(*options: object) -> str:
        line = [sys.executable, "-m", "salient", "view", *map(str, options)]
        process = subprocess.Popen(line, stdout=subprocess.PIPE, text=True)
        processes.append(process)
        return process.stdout.readline().removeprefix("live page: ").strip()

    yield start
    for process in processes:
        process.terminate()
        process.communicate()


@pytest.fixture
def dask_cluster(tmp_path: Path) -> Iterator[Cluster]:
    """A Dask scheduler and two workers of one thread on the loopback, which import modules of this folder."""
    with cluster(tmp_path, {"PYTHONPATH": str(Path(__file__).parent)}) as started:
        yield started


@pytest.fixture
def unreadable(browser: Browser) -> Callable[[Path, int], list[str]]:
    """Parts of a page that cannot be read at a width: text that is cut off, or the numbers of a table that its first
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
