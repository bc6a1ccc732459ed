"""salient docs: the documents of docs/ as a site, and the reference pages that follow from the sources."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from salient.errors import RunFailed
from salient.paths import ROOT, make_folder

CONFIGURATION = ROOT / "mkdocs.yml"


def write_reference() -> None:
    """Writes the reference pages that need no measurement. A measured page names its command."""
    from salient.bench import faults
    from salient.board import pins
    from salient.experiments.campaign import report
    from salient.generate import (
        checkers,
        commands,
        diagnostic_coverage,
        objects,
        parameters,
        requirements,
        resolution,
        signals,
    )

    for page in (faults, checkers, commands, objects, parameters, resolution, signals):
        page.main()
    report.write_pages()
    requirements.write()
    diagnostic_coverage.write()
    pins.write_documents()


def run(out: Path, *, generate: bool = False) -> int:
    """Builds the site in a folder and prints the path of its first page; RunFailed with each warning of MkDocs."""
    if generate:
        write_reference()
    make_folder(out)
    done = subprocess.run([sys.executable, "-m", "mkdocs", "build", "--strict", "--config-file", CONFIGURATION,
                           "--site-dir", out.resolve()], cwd=ROOT, stdin=subprocess.DEVNULL,
                          capture_output=True, text=True)
    if done.returncode != 0:
        raise RunFailed(f"the site has warnings:\n{(done.stdout + done.stderr).strip()}")
    print(out / "index.html")
    return 0
