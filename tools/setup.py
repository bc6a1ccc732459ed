"""Build of the package salient-drive; what it is, is in pyproject.toml.

A wheel has, in salient/data, the files of the repository that its commands need, in their places there, and in
salient/data/bin the programs of the host build, linked statically: they run on any Linux of their processor, and have
the same C library, so the same bits, everywhere. salient/data/install is the CMake package (cmake/install.cmake).
An editable installation uses the repository.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parents[1]
FILES = ("CMakeLists.txt", "LICENSE", "firmware/comms/drive.dbc", "firmware/storage/parameters.def",
         "emulator/rig/rig.dbc")
FOLDERS = ("tools/machines", "tools/loads", "tools/scenarios", "tools/examples")
PROGRAMS = ("salient_host", "salient_reference")

sys.path.insert(0, str(ROOT / "tools" / "src"))
from salient.paths import BUILD  # noqa: E402  (needs the path above)
from salient.version import VERSION  # noqa: E402


def build_programs() -> Path:
    """Builds the programs, in the host build where there is one; returns its folder."""
    folder = BUILD / "host"
    if not (folder / "CMakeCache.txt").exists():
        folder = BUILD / "wheel"
        subprocess.run(["cmake", "-S", ROOT, "-B", folder, "-G", "Ninja", "-DCMAKE_BUILD_TYPE=Release",
                        f"-DSALIENT_PYTHON={sys.executable}"], check=True)
    subprocess.run(["cmake", "--build", folder, "--target", *(f"{name}_static" for name in PROGRAMS)], check=True)
    return folder


class BuildPackage(build_py):
    """Adds the data of a wheel."""

    def run(self) -> None:
        super().run()
        if self.editable_mode:
            return
        data = Path(self.build_lib) / "salient" / "data"
        shutil.rmtree(data, ignore_errors=True)  # of an earlier build
        for name in FILES:
            (data / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, data / name)
        for name in FOLDERS:
            shutil.copytree(ROOT / name, data / name, ignore=shutil.ignore_patterns("__pycache__"))
        (data / "bin").mkdir()
        built = build_programs()
        for name in PROGRAMS:
            subprocess.run(["strip", "-o", data / "bin" / name, built / "bin" / f"{name}_static"], check=True)
        subprocess.run(["cmake", "--install", built, "--prefix", data / "install"], check=True)
        for library in (data / "install" / "lib" / "salient").glob("*.a"):
            # Without its intermediate code, which only the same version of the compiler reads.
            subprocess.run(["objcopy", "--strip-debug", "--wildcard", "--remove-section=.gnu.lto_*",
                            "--remove-section=.gnu.debuglto_*", library], check=True)


class Wheel(bdist_wheel):
    """Its programs are of one processor; any Python 3 runs it."""

    def get_tag(self) -> tuple[str, str, str]:
        processor = platform.machine()
        return "py3", "none", f"manylinux_2_17_{processor}.manylinux2014_{processor}"


class PlatformDistribution(Distribution):
    """Not for every processor."""

    def has_ext_modules(self) -> bool:
        return True


def links() -> dict[str, str]:
    """The project's pages, of the repository whose workflow builds the wheel; none elsewhere."""
    repository = os.environ.get("GITHUB_REPOSITORY")
    if not repository:
        return {}
    source = f"{os.environ['GITHUB_SERVER_URL']}/{repository}"
    return {"Source": source, "Changelog": f"{source}/blob/v{VERSION}/CHANGELOG.md", "Issues": f"{source}/issues"}


setup(version=VERSION, project_urls=links(), distclass=PlatformDistribution,
      cmdclass={"build_py": BuildPackage, "bdist_wheel": Wheel})
