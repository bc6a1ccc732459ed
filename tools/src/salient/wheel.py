"""salient wheel: builds the package for other people's suites, with the programs, for any Linux of this processor."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from salient.errors import RunFailed
from salient.paths import BUILD, ROOT, make_folder


def build(out: Path) -> int:
    """Writes the wheel to a folder and prints its path."""
    log = BUILD / "wheel.log"
    make_folder(out)
    with tempfile.TemporaryDirectory(prefix="salient-") as name, log.open("wb") as output:
        folder = Path(name)
        extra = folder / "setuptools.cfg"  # by default setuptools writes next to the sources
        extra.write_text(f"[build]\nbuild_base = {folder}/build\n[egg_info]\negg_base = {folder}\n", encoding="utf-8")
        command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--no-deps",
                   "--no-build-isolation", "--wheel-dir", str(folder / "wheel"), str(ROOT / "tools")]
        done = subprocess.run(command, env={**os.environ, "DIST_EXTRA_CONFIG": str(extra)}, stdin=subprocess.DEVNULL,
                              stdout=output, stderr=subprocess.STDOUT)
        if done.returncode != 0:
            raise RunFailed(f"the wheel could not be built: see {log.relative_to(ROOT)}")
        [made] = (folder / "wheel").iterdir()
        shutil.copy(made, out)
    print(out / made.name)
    return 0
