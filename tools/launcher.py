"""First part of tools/salient: installs what is missing, builds, and hands over to the Python package.

Standard library only. All its files are in build/, all its messages go to standard error.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

TOOLS = Path(__file__).resolve().parent
ROOT = TOOLS.parent
BUILD = ROOT / "build"
VENV = BUILD / "venv"
LOCK = TOOLS / "requirements.lock"
STAMP = VENV / "salient.stamp"

sys.path.insert(0, str(TOOLS / "src"))

from salient.builder import run_commands  # noqa: E402  (needs the path above)
from salient.cli import make_parser  # noqa: E402


@dataclass(frozen=True)
class Need:
    """A Debian package, its purpose, and a test for its presence."""

    package: str
    purpose: str
    present: Callable[[], bool]


def _tool(name: str) -> Callable[[], bool]:
    return lambda: shutil.which(name) is not None


def _file(*paths: str) -> Callable[[], bool]:
    return lambda: any(Path(path).exists() for path in paths)


def _has_ensurepip() -> bool:
    # ensurepip of Debian has no wheels unless python3-venv is installed.
    code = "import ensurepip, sys, venv; ensurepip.version()"
    return subprocess.run([_base_python(), "-c", code], capture_output=True).returncode == 0


BUILD_NEEDS = (
    Need("gcc", "compiler", _tool("gcc")),
    Need("g++", "compiler of the unit tests", _tool("g++")),
    Need("cmake", "build", _tool("cmake")),
    Need("ninja-build", "build", _tool("ninja")),
    Need("libgtest-dev", "unit tests", _file("/usr/include/gtest/gtest.h", "/usr/local/include/gtest/gtest.h")),
    Need("python3-venv", "virtual environment", lambda: (VENV / "bin/python").exists() or _has_ensurepip()),
)
TARGET_NEEDS = {
    "host": (),
    "cortex-m4": (
        Need("gcc-arm-none-eabi", "compiler for Cortex-M4", _tool("arm-none-eabi-gcc")),
        Need("libnewlib-arm-none-eabi", "its C headers", _file("/usr/lib/arm-none-eabi/include/string.h")),
        Need("qemu-system-arm", "emulated Cortex-M4", _tool("qemu-system-arm")),
    ),
    "rv32": (
        Need("gcc-riscv64-unknown-elf", "compiler for RV32", _tool("riscv64-unknown-elf-gcc")),
        Need("qemu-system-misc", "emulated RV32", _tool("qemu-system-riscv32")),
    ),
}
TEST_NEEDS = (
    *(need for needs in TARGET_NEEDS.values() for need in needs),
    Need("qemu-system-x86", "VM with a kernel that has CAN", lambda: not _guest_packages()),
)
MEASUREMENT_NEEDS = (
    Need("ngspice", "reference solver for the emulated plant", _tool("ngspice")),
    Need("valgrind", "instruction counts", _tool("valgrind")),
)

WITHOUT_BUILD = ("log", "monitor", "machine")
"""Commands that require no build."""


def _guest_packages() -> list[str]:
    from salient.vm import run as guest

    return guest.missing_packages()


def _base_python() -> str:
    """The Python of the virtual environment: the present one."""
    # tools/salient has preferred it already; its real path, because a virtual environment of the caller may be active.
    return str(Path(sys.executable).resolve())


def fail(line: str) -> NoReturn:
    """One line, exit code 2."""
    print(f"salient: {line}", file=sys.stderr)
    sys.exit(2)


def say(line: str) -> None:
    """One line of progress."""
    print(f"salient: {line}", file=sys.stderr, flush=True)


# --- Debian packages ------------------------------------------------------------------------------------------------

def install_packages(needs: tuple[Need, ...], install: bool) -> None:
    """Installs missing packages, or names them and stops."""
    missing = [need for need in needs if not need.present()]
    if not missing:
        return
    packages = [need.package for need in missing]
    reasons = ", ".join(f"{need.package} ({need.purpose})" for need in missing)
    if not install:
        fail(f"missing: {reasons}; install the Debian packages {' '.join(packages)}, or leave out --no-install")
    if shutil.which("apt-get") is None:
        fail(f"missing: {reasons}; there is no apt-get to install them with")
    if os.geteuid() != 0 and not _sudo_works():
        fail(f"missing: {reasons}; installing them needs root or sudo without a password")
    say(f"installing Debian packages: {reasons}")
    log = BUILD / "apt.log"
    command = ["apt-get", "install", "-y", "--no-install-recommends", *packages]
    with log.open("ab") as output:
        have_lists = any(Path("/var/lib/apt/lists").glob("*_Packages*"))
        done = have_lists and _as_root(command, output)
        if not done:
            done = _as_root(["apt-get", "update"], output) and _as_root(command, output)
    if not done:
        fail(f"the Debian packages {' '.join(packages)} could not be installed: see {log.relative_to(ROOT)}")
    still = [need.package for need in missing if not need.present()]
    if still:
        fail(f"{' '.join(still)}: installed, but its files are not found")


def _sudo_works() -> bool:
    return bool(shutil.which("sudo")) and subprocess.run(["sudo", "-n", "true"], capture_output=True).returncode == 0


def _as_root(command: list[str], output) -> bool:
    prefix = [] if os.geteuid() == 0 else ["sudo", "-n"]
    command = [*prefix, "env", "DEBIAN_FRONTEND=noninteractive", *command]
    return subprocess.run(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output).returncode == 0


# --- Python packages ------------------------------------------------------------------------------------------------

def make_environment(install: bool) -> None:
    """Makes build/venv from the lock file, again when the lock file has changed."""
    packages = hashlib.sha256(LOCK.read_bytes() + str(ROOT).encode()).hexdigest()
    ours = hashlib.sha256((TOOLS / "pyproject.toml").read_bytes()).hexdigest()
    found = STAMP.read_text().split() if STAMP.exists() and (VENV / "bin/python").exists() else []
    if found == [packages, ours]:
        return
    pip = [str(VENV / "bin/python"), "-m", "pip", "--disable-pip-version-check", "--no-input", "install", "--no-deps"]
    steps = [[*pip, "--no-build-isolation", "--editable", str(TOOLS)]]
    if found[:1] != [packages]:
        where = f"{LOCK.relative_to(ROOT)} into {VENV.relative_to(ROOT)} (CAN, figures, tests)"
        if not install:
            fail(f"missing: the Python packages of {where}; leave out --no-install")
        say(f"installing Python packages of {where}")
        environment = [_base_python(), "-m", "venv", "--clear", str(VENV)]
        steps = [environment, [*pip, "--require-hashes", "-r", str(LOCK)], *steps]
    # setuptools would write its metadata next to the sources.
    notes, extra = BUILD / "package", BUILD / "setuptools.cfg"
    notes.mkdir(exist_ok=True)
    extra.write_text(f"[egg_info]\negg_base = {notes}\n")
    log = BUILD / "pip.log"
    with log.open("wb") as output:
        for step in steps:
            environment = {**os.environ, "DIST_EXTRA_CONFIG": str(extra)}
            if subprocess.run(step, env=environment, stdout=output, stderr=output, cwd=BUILD).returncode != 0:
                fail(f"the Python packages could not be installed: {_last_line(log)} (see {log.relative_to(ROOT)})")
    STAMP.write_text(f"{packages} {ours}\n")


def _last_line(log: Path) -> str:
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1].strip() if lines else "no output"


# --- build ----------------------------------------------------------------------------------------------------------

def build(preset: str, targets: list[str]) -> bool:
    """Brings the build of a preset up to date, True when it was not; exit code 1 with the messages of the compiler when
    it fails."""
    folder = BUILD / preset
    log = BUILD / "build.log"
    command = ["cmake", "--build", "--preset", preset]
    if targets:
        command += ["--target", *targets]
    steps = [command] if _is_configured(folder) else [
        ["cmake", "--preset", preset, "-DSALIENT_MACHINE_FILE="],
        command,
    ]
    notices: list[str] = []

    def notice() -> None:
        notices.append(f"building {folder.relative_to(ROOT)}")
        say(notices[-1])

    if not run_commands(steps, ROOT, log, notice):
        sys.stderr.write(_failures(log.read_text(errors="replace")))
        print(f"salient: the build failed: see {log.relative_to(ROOT)}", file=sys.stderr)
        sys.exit(1)
    return bool(notices)


def _is_configured(folder: Path) -> bool:
    """CMake has configured the folder, and without a machine file of the user, which may be gone."""
    try:
        cache = (folder / "CMakeCache.txt").read_text()
    except OSError:
        return False
    return (folder / "build.ninja").exists() and re.search(r"^SALIENT_MACHINE_FILE:FILEPATH=$", cache, re.M) is not None


def _failures(text: str) -> str:
    """The last lines of the output of a build, which have the reason."""
    return "\n".join(text.splitlines()[-40:]) + "\n"


def main() -> None:
    """Reads the command line, prepares the command and runs it in this process."""
    options = make_parser().parse_args()
    install = not options.no_install
    os.environ["PYTHONPYCACHEPREFIX"] = str(BUILD / "pycache")
    try:
        BUILD.mkdir(exist_ok=True)
        lock = (BUILD / "launcher.lock").open("w")
    except OSError as error:
        fail(f"{BUILD}: {error.strerror}; everything is built there")
    with lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # one build at a time
        needs = BUILD_NEEDS + (TEST_NEEDS if options.command == "test" else ())
        # benchmark counts the instructions of the control interrupt there; pil has a --target of other values
        target = "cortex-m4" if options.command == "benchmark" else getattr(options, "build", "host")
        target = getattr(options, "target", target)
        on_target = target != "host"
        needs += TARGET_NEEDS[target]
        if getattr(options, "figures", False):  # of every target
            needs += tuple(need for needs_of in TARGET_NEEDS.values() for need in needs_of)
        needs += MEASUREMENT_NEEDS if options.command in ("test", "benchmark") else ()
        if options.command in WITHOUT_BUILD:
            needs = tuple(need for need in BUILD_NEEDS if need.package == "python3-venv")
        install_packages(needs, install)
        make_environment(install)
        if options.command not in WITHOUT_BUILD:
            machines = sorted(path.stem for path in (TOOLS / "machines").glob("*.toml"))
            targets = [f"salient_{name}" for name in machines]
            targets += ["plant_benchmark_saturating"] if options.command == "benchmark" else []
            targets += [f"salient_target_{name}" for name in machines] if on_target else []
            was_built = build("host", [] if options.command == "test" else targets)
            if on_target:
                was_built |= build(target, [])
            # For a reader; a script waits for the JSON line.
            if options.command == "sim" and (was_built or sys.stderr.isatty()):
                say("starting the drive")
    python = str(VENV / "bin/python")
    os.execv(python, [python, "-m", "salient", *sys.argv[1:]])


if __name__ == "__main__":
    main()
