"""salient wheel: builds the package for other people's suites, with the programs, for any Linux of this processor, and
checks it: that its programs run on that Linux, and that a registry takes its metadata."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from salient.errors import RunFailed, UsageError
from salient.paths import BUILD, ROOT, from_root, make_folder
from salient.version import VERSION


def check_tag(tag: str) -> None:
    """UsageError when the tag of a release is not the version's."""
    if tag != f"v{VERSION}":
        raise UsageError(f"--tag {tag}: must be v{VERSION}, the version in CMakeLists.txt")


def check_metadata(wheel: Path) -> None:
    """RunFailed when a registry would refuse the wheel's metadata, or show a page without a text."""
    from packaging.metadata import Metadata

    with zipfile.ZipFile(wheel) as archive:
        [name] = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        text = archive.read(name)
    try:
        metadata = Metadata.from_email(text, validate=True)
    except ExceptionGroup as group:
        raise RunFailed(f"{wheel.name}: metadata: {'; '.join(map(str, group.exceptions))}") from None
    missing = [name for name, value in (("summary", metadata.summary), ("description", metadata.description),
                                        ("licence", metadata.license_expression), ("classifiers", metadata.classifiers),
                                        ("Python versions", metadata.requires_python)) if not value]
    if missing:
        raise RunFailed(f"{wheel.name}: metadata: no {', no '.join(missing)}")
    if str(metadata.version) != VERSION or metadata.description_content_type != "text/markdown":
        raise RunFailed(f"{wheel.name}: metadata: version {metadata.version} and a description in "
                        f"{metadata.description_content_type}; must be {VERSION} and text/markdown")


def check_platform(wheel: Path) -> None:
    """RunFailed when a program of the wheel needs a library, or a newer C library than the wheel's name says."""
    shown = subprocess.run([sys.executable, "-m", "auditwheel", "show", wheel], capture_output=True, text=True,
                           stdin=subprocess.DEVNULL)
    if "requires no external shared libraries" not in " ".join(shown.stdout.split()):
        raise RunFailed(f"{wheel.name}: its programs do not run on every Linux: "
                        f"{(shown.stdout + shown.stderr).strip()}")


def build(out: Path, tag: str | None = None) -> int:
    """Writes the wheel to a folder, once it has passed the checks, and prints its path. tag: of a release."""
    if tag is not None:
        check_tag(tag)
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
            raise RunFailed(f"the wheel could not be built: see {from_root(log)}")
        [made] = (folder / "wheel").iterdir()
        check_metadata(made)
        check_platform(made)
        shutil.copy(made, out)
    print(out / made.name)
    return 0
