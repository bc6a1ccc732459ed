"""Preparation of a tools/salient command: installs missing packages, builds, and runs the Python package.

Standard library only. All results stay in the build folder (salient.paths.BUILD); messages go to standard error.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NoReturn

TOOLS = Path(__file__).resolve().parent

INTERRUPT = {signal.SIGINT}
if __name__ == "__main__":
    # One that comes while modules are loaded waits until exit_code can report it in a line.
    signal.pthread_sigmask(signal.SIG_BLOCK, INTERRUPT)

sys.path.insert(0, str(TOOLS / "src"))

from salient.builder import build_preset  # noqa: E402  (needs the path above)
from salient.cli import make_parser  # noqa: E402
from salient.errors import exit_code  # noqa: E402
from salient.guard import RUNS  # noqa: E402
from salient.paths import BUILD, ROOT, build_lock, from_root  # noqa: E402

VENV = BUILD / "venv"
LOCK = TOOLS / "requirements.lock"
STAMP = VENV / "salient.stamp"


@dataclass(frozen=True)
class Dependency:
    """A Debian package, its purpose, and a check of its presence."""

    package: str
    purpose: str
    present: Callable[[], bool]


def _tool(name: str) -> Callable[[], bool]:
    return lambda: shutil.which(name) is not None


def _file(*paths: str) -> Callable[[], bool]:
    return lambda: any(Path(path).exists() for path in paths)


def _has_ensurepip() -> bool:
    # Debian packages ensurepip without its wheels unless python3-venv is installed.
    code = "import ensurepip, sys, venv; ensurepip.version()"
    return subprocess.run([_base_python(), "-c", code], capture_output=True).returncode == 0


BUILD_DEPENDENCIES = (
    Dependency("gcc", "compiler", _tool("gcc")),
    Dependency("g++", "compiler of the unit tests", _tool("g++")),
    Dependency("cmake", "build", _tool("cmake")),
    Dependency("ninja-build", "build", _tool("ninja")),
    Dependency("libgtest-dev", "unit tests", _file("/usr/include/gtest/gtest.h", "/usr/local/include/gtest/gtest.h")),
    Dependency("python3-venv", "virtual environment", lambda: (VENV / "bin/python").exists() or _has_ensurepip()),
)
TARGET_DEPENDENCIES = {
    "host": (),
    "cortex-m4": (
        Dependency("gcc-arm-none-eabi", "compiler for Cortex-M4", _tool("arm-none-eabi-gcc")),
        Dependency("libnewlib-arm-none-eabi", "its C headers", _file("/usr/lib/arm-none-eabi/include/string.h")),
        Dependency("qemu-system-arm", "emulated Cortex-M4", _tool("qemu-system-arm")),
    ),
    "rv32": (
        Dependency("gcc-riscv64-unknown-elf", "compiler for RV32", _tool("riscv64-unknown-elf-gcc")),
        Dependency("qemu-system-misc", "emulated RV32", _tool("qemu-system-riscv32")),
    ),
}
TARGET_DEPENDENCIES["stm32g4"] = TARGET_DEPENDENCIES["cortex-m4"][:2]
WASM_DEPENDENCIES = (
    Dependency("clang-19", "compiler for WebAssembly", _tool("clang-19")),
    Dependency("lld-19", "its linker", _tool("wasm-ld-19")),
    Dependency("llvm-19", "its archiver", _tool("llvm-ar-19")),
    Dependency("wasi-libc", "its C library", _file("/usr/lib/wasm32-wasi/libc.a")),
    Dependency("libclang-rt-19-dev-wasm32", "its helpers",
               _file("/usr/lib/llvm-19/lib/clang/19/lib/wasi/libclang_rt.builtins-wasm32.a")),
)
COVERAGE = Dependency("libclang-rt-19-dev", "counters of what the unit tests cover",
                      _file("/usr/lib/llvm-19/lib/clang/19/lib/linux/libclang_rt.profile-x86_64.a"))
STATIC_ANALYSIS = Dependency("cppcheck", "static analysis by the rules of MISRA C:2012", _tool("cppcheck"))
BROWSER = Dependency("chromium", "browser in which the live page is tested and measured", _tool("chromium"))
TEST_DEPENDENCIES = (
    *WASM_DEPENDENCIES,
    Dependency("nodejs", "runs the drive in WebAssembly", _tool("node")),
    *(dependency for group in TARGET_DEPENDENCIES.values() for dependency in group),
    BROWSER,
    COVERAGE,
    STATIC_ANALYSIS,
    Dependency("qemu-system-x86", "VM with a kernel that has CAN", lambda: not _vm_packages()),
)
MEASUREMENT_DEPENDENCIES = (
    Dependency("ngspice", "reference solver for the emulated plant", _tool("ngspice")),
    Dependency("valgrind", "instruction counts", _tool("valgrind")),
)

WITHOUT_BUILD = ("log", "monitor", "command", "view", "scope", "machine", "docs", "evidence", "board")
"""Commands that need no drive of the host; `board build` builds by itself."""


def _vm_packages() -> list[str]:
    from salient.vm import run as vm

    return vm.missing_packages()


def _base_python() -> str:
    """The Python that makes the virtual environment: the one that tools/salient has chosen."""
    # Resolved, because a virtual environment of the caller may be active.
    return str(Path(sys.executable).resolve())


def fail(line: str) -> NoReturn:
    """Prints one line and ends with exit code 2."""
    print(f"salient: {line}", file=sys.stderr)
    sys.exit(2)


def print_status(line: str) -> None:
    """Prints one line to standard error."""
    print(f"salient: {line}", file=sys.stderr, flush=True)


# --- Debian packages ------------------------------------------------------------------------------------------------

def install_packages(dependencies: tuple[Dependency, ...], install: bool) -> None:
    """Installs missing Debian packages, or names them and ends."""
    by_package = {dependency.package: dependency for dependency in dependencies}
    missing = [dependency for dependency in by_package.values() if not dependency.present()]
    if not missing:
        return
    packages = [dependency.package for dependency in missing]
    reasons = ", ".join(f"{dependency.package} ({dependency.purpose})" for dependency in missing)
    if not install:
        fail(f"missing: {reasons}; install the Debian packages {' '.join(packages)}, or leave out --no-install")
    if shutil.which("apt-get") is None:
        fail(f"missing: {reasons}; there is no apt-get to install them with")
    if os.geteuid() != 0 and not _sudo_works():
        fail(f"missing: {reasons}; installing them needs root or sudo without a password")
    print_status(f"installing Debian packages: {reasons}")
    log = BUILD / "apt.log"
    command = ["apt-get", "install", "-y", "--no-install-recommends", *packages]
    with log.open("ab") as output:
        have_lists = any(Path("/var/lib/apt/lists").glob("*_Packages*"))
        done = have_lists and _as_root(command, output)
        if not done:
            done = _as_root(["apt-get", "update"], output) and _as_root(command, output)
    if not done:
        fail(f"the Debian packages {' '.join(packages)} could not be installed: see {from_root(log)}")
    still = [dependency.package for dependency in missing if not dependency.present()]
    if still:
        fail(f"{' '.join(still)}: installed, but the expected files are missing")


def _sudo_works() -> bool:
    return bool(shutil.which("sudo")) and subprocess.run(["sudo", "-n", "true"], capture_output=True).returncode == 0


def _as_root(command: list[str], output: BinaryIO) -> bool:
    prefix = [] if os.geteuid() == 0 else ["sudo", "-n"]
    # Packages that are installed in part would be a mess: what has begun goes on when this command is killed.
    command = [*prefix, "env", "-u", RUNS, "-u", "TMPDIR", "DEBIAN_FRONTEND=noninteractive", *command]
    return subprocess.run(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output).returncode == 0


# --- Python packages ------------------------------------------------------------------------------------------------

def make_environment(install: bool) -> None:
    """Makes the virtual environment from the lock file, again when the lock file has changed."""
    packages = hashlib.sha256(LOCK.read_bytes() + str(ROOT).encode()).hexdigest()
    ours = hashlib.sha256(b"".join((TOOLS / name).read_bytes() for name in ("pyproject.toml", "setup.py"))).hexdigest()
    found = STAMP.read_text().split() if STAMP.exists() and (VENV / "bin/python").exists() else []
    if found == [packages, ours]:
        return
    # --no-compile: most modules of the packages are never imported, and those that are get compiled then.
    pip = [str(VENV / "bin/python"), "-m", "pip", "--disable-pip-version-check", "--no-input", "install", "--no-deps",
           "--no-compile"]
    steps = [[*pip, "--no-build-isolation", "--editable", str(TOOLS)]]
    if found[:1] != [packages]:
        where = f"{from_root(LOCK)} into {from_root(VENV)} (CAN, plots, tests)"
        if not install:
            fail(f"missing: the Python packages of {where}; leave out --no-install")
        print_status(f"installing Python packages of {where}")
        environment = [_base_python(), "-m", "venv", "--clear", str(VENV)]
        steps = [environment, [*pip, "--require-hashes", "-r", str(LOCK)], *steps]
    # By default setuptools writes its metadata next to the sources.
    metadata, extra = BUILD / "package", BUILD / "setuptools.cfg"
    metadata.mkdir(exist_ok=True)
    extra.write_text(f"[egg_info]\negg_base = {metadata}\n")
    log = BUILD / "pip.log"
    with log.open("wb") as output:
        for step in steps:
            environment = {**os.environ, "DIST_EXTRA_CONFIG": str(extra)}
            if subprocess.run(step, env=environment, stdout=output, stderr=output, cwd=BUILD).returncode != 0:
                fail(f"the Python packages could not be installed: {_pip_failure(log)} (see {from_root(log)})")
    STAMP.write_text(f"{packages} {ours}\n")


def _pip_failure(log: Path) -> str:
    """The cause in pip's output. An index that cannot be reached shows as warnings about retries; the last line is
    then only that no version was found."""
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()]
    for line in lines:
        retry = re.search(r"Retry\(total=0,.* after connection broken by '\w+\((.*)\)': /\S*$", line)
        if retry:
            # '<connection object>: Failed to establish a new connection: [Errno -2] Name or service not known'
            cause = re.sub(r"^.*>: ", "", retry[1]).strip("'\")")
            return f"the package index cannot be reached: {cause}"
    errors = [line for line in lines if line.startswith("ERROR:")]
    return errors[0].removeprefix("ERROR: ") if errors else (lines or ["no output"])[-1]


# --- build ----------------------------------------------------------------------------------------------------------

def build(preset: str, targets: list[str]) -> bool:
    """Brings the build of a preset up to date, True when it was not; ends with exit code 1 and the compiler's output
    when it fails."""
    folder = BUILD / preset
    log = BUILD / "build.log"
    notices: list[str] = []

    def notice() -> None:
        notices.append(f"building {from_root(folder)}")
        print_status(notices[-1])

    if not build_preset(ROOT, folder, targets, log, notice):
        sys.stderr.write(_failures(log.read_text(errors="replace")))
        print(f"salient: the build failed: see {from_root(log)}", file=sys.stderr)
        sys.exit(1)
    return bool(notices)


def _failures(text: str) -> str:
    """The last lines of the build's output, which contain the reason."""
    return "\n".join(text.splitlines()[-40:]) + "\n"


def needs_build(options: argparse.Namespace) -> bool:
    """False for commands that need no drive."""
    return options.command not in WITHOUT_BUILD and not getattr(options, "list", False)


def _needs_wasm(options: argparse.Namespace) -> bool:
    return options.command == "tab" or bool(getattr(options, "tab", False))


def dependencies(options: argparse.Namespace, target: str) -> tuple[Dependency, ...]:
    """Debian packages that a command needs."""
    if options.command == "board" and options.action == "build":
        return BUILD_DEPENDENCIES + TARGET_DEPENDENCIES["cortex-m4"][:2]
    if not needs_build(options):
        return tuple(dependency for dependency in BUILD_DEPENDENCIES if dependency.package == "python3-venv")
    found = BUILD_DEPENDENCIES + TARGET_DEPENDENCIES[target]
    if options.command == "test":
        found += TEST_DEPENDENCIES
    if getattr(options, "figures", False):  # measured on every target
        found += tuple(dependency for group in TARGET_DEPENDENCIES.values() for dependency in group)
    if _needs_wasm(options):
        found += WASM_DEPENDENCIES
    if getattr(options, "page", None) is not None or getattr(options, "tab", False):
        found += (BROWSER,)
    if options.command in ("test", "benchmark"):
        found += MEASUREMENT_DEPENDENCIES
    return found


def host_targets(command: str, target: str) -> list[str]:
    """The programs of the host build that a command runs; empty: all."""
    if command == "test":
        return []
    targets = ["salient_host"]
    targets += ["plant_benchmarks"] if command == "benchmark" else []
    targets += ["salient_campaign"] if command in ("campaign", "replay") else []
    targets += ["salient_reference"] if command == "compare" else []
    if target != "host":
        targets += ["salient_stm32g4" if target == "stm32g4" else "salient_target"]
    return targets


def main() -> int:
    """Reads the command line, prepares, and executes the command in place of this process."""
    options = make_parser().parse_args()
    install = not options.no_install
    os.environ["PYTHONPYCACHEPREFIX"] = str(BUILD / "pycache")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # compiling NumPy and pydantic at each start takes half a second
    with build_lock():
        # The benchmark counts the instructions of the control interrupt on the Cortex-M4.
        target = "cortex-m4" if options.command == "benchmark" else getattr(options, "build", "host")
        target = getattr(options, "target", target)  # pil
        install_packages(dependencies(options, target), install)
        make_environment(install)
        if needs_build(options):
            was_built = build("host", host_targets(options.command, target))
            if target != "host":
                was_built |= build(target, [])
            if _needs_wasm(options):
                build("wasm", [])
            # For a reader; a script waits for the JSON line.
            if options.command == "sim" and (was_built or sys.stderr.isatty()):
                print_status("starting the drive")
    python = str(VENV / "bin/python")
    signal.pthread_sigmask(signal.SIG_BLOCK, INTERRUPT)
    os.execv(python, [python, "-m", "salient", *sys.argv[1:]])


if __name__ == "__main__":
    sys.exit(exit_code(main))
