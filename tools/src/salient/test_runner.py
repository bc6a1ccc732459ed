"""salient test: every test there is, in steps, and one line in the end: N passed, N failed."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

from salient.bench.emulator import TARGET_BUILDS
from salient.paths import BUILD, ROOT, SCENARIOS

RESULTS = BUILD / "results"
TESTS = ROOT / "tests"
HIL = TESTS / "hil"
GUEST_TIMEOUT_S = 1800


@dataclass
class Count:
    """Of tests."""

    passed: int = 0
    failed: int = 0

    def __iadd__(self, other: Count) -> Count:
        self.passed += other.passed
        self.failed += other.failed
        return self

    def __str__(self) -> str:
        return f"{self.passed} passed, {self.failed} failed"


def run(only: list[str] | None) -> int:
    """Runs the steps (all, or those named); returns 0 when everything passed, else 1."""
    total = Count()
    for name, step in STEPS.items():
        if only and name not in only:
            continue
        _say(f"--- {name}: {(step.__doc__ or '').splitlines()[0]}")
        started_s = time.monotonic()
        RESULTS.mkdir(parents=True, exist_ok=True)
        count = step()
        _say(f"--- {name}: {count} ({time.monotonic() - started_s:.0f} s)")
        total += count
    _say(str(total))
    return 1 if total.failed or not total.passed else 0


def _say(line: str) -> None:
    print(line, flush=True)


def _command(*command: str | Path, quiet: bool = True, **environment: str) -> bool:
    """Runs a command in the repository; its output is shown when it fails, or as it comes. True when it ends with 0."""
    done = subprocess.run(
        [str(part) for part in command],
        cwd=ROOT,
        env={**os.environ, **environment},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE if quiet else None,
        stderr=subprocess.STDOUT if quiet else None,
    )
    if quiet and done.returncode != 0:
        sys.stdout.write(done.stdout.decode(errors="replace"))
        sys.stdout.flush()
    return done.returncode == 0


def _one(passed: bool) -> Count:
    return Count(int(passed), int(not passed))


# --- steps ----------------------------------------------------------------------------------------------------------

def _style() -> Count:
    """ruff over the Python sources, clang-format over C and C++."""
    config = ROOT / "tools" / "pyproject.toml"
    count = _one(_command(sys.executable, "-m", "ruff", "check", "--no-cache", "--config", config,
                          ROOT / "tools", ROOT / "tests"))
    folders = [ROOT / name for name in ("firmware", "hal", "emulator", "tests")]
    sources = sorted(path for folder in folders for path in folder.rglob("*") if path.suffix in (".c", ".h", ".cpp"))
    clang_format = Path(sys.executable).with_name("clang-format")
    count += _one(_command(clang_format, "--dry-run", "-Werror", *sources))
    return count


def _unit() -> Count:
    """GoogleTest programs of the host build."""
    return _ctest("host")


def _sanitize() -> Count:
    """the same with AddressSanitizer and UndefinedBehaviorSanitizer, and the paper's experiments."""
    built = _one(build_preset("sanitize"))
    if built.failed:
        return built
    count = _ctest("sanitize")
    count += _experiments("sanitize")
    return count


def _target() -> Count:
    """the firmware for Cortex-M4 (compiled in three ways) and RV32: its symbols and size checked, run in QEMU."""
    count = Count()
    for preset in TARGET_BUILDS:
        count += _one(build_preset(preset))
    if not count.failed:
        count += _pytest(RESULTS / "target.xml", [TESTS / "target"], [])
    return count


def _hil() -> Count:
    """the drive through CAN on local buses, the plant against other solvers, the tools."""
    return _pytest(RESULTS / "hil.xml", [HIL, TESTS / "plant", TESTS / "tools"], [])


def _socketcan() -> Count:
    """the drive through a real SocketCAN interface, here or in a guest."""
    mark = re.compile(r"mark\.(both_transports|socketcan)\b")
    files = [path for path in sorted(HIL.glob("test_*.py")) if mark.search(path.read_text(encoding="utf-8"))]
    guest = [sys.executable, "-m", "salient.vm.run", "--timeout-s", str(GUEST_TIMEOUT_S), "--"]
    return _pytest(RESULTS / "socketcan.xml", files, ["--salient-can=socketcan:vcan0"], guest)


STEPS = {
    "style": _style,
    "unit": _unit,
    "sanitize": _sanitize,
    "target": _target,
    "hil": _hil,
    "socketcan": _socketcan,
}


# --- how ------------------------------------------------------------------------------------------------------------

def build_preset(preset: str) -> bool:
    """Configures and builds a preset; what it wrote is shown when it fails."""
    machine = ["-DSALIENT_MACHINE_FILE="]
    return _command("cmake", "--preset", preset, *machine) and _command("cmake", "--build", "--preset", preset)


def _ctest(preset: str) -> Count:
    """Each test case counts; a program that dies without a report counts as one failure."""
    results = RESULTS / f"unit-{preset}"
    shutil.rmtree(results, ignore_errors=True)
    results.mkdir(parents=True)
    overview = results / "ctest-overview"
    _command("ctest", "--test-dir", BUILD / preset, "--output-on-failure", "--parallel", str(os.cpu_count() or 1),
             "--output-junit", overview, GTEST_OUTPUT=f"xml:{results}/", UBSAN_OPTIONS="print_stacktrace=1")
    count = Count()
    if not overview.exists():
        return Count(failed=1)
    for program in ElementTree.parse(overview).getroot().iter("testcase"):
        good = program.get("status") == "run"
        report = results / f"{program.get('name')}.xml"
        cases = _read_report(report) if report.exists() else Count()
        if good and not report.exists():
            cases = Count(passed=1)
        if not good and cases.failed == 0:
            cases += Count(failed=1)
        count += cases
    return count if count.passed or count.failed else Count(failed=1)


def _read_report(path: Path) -> Count:
    """A JUnit file of GoogleTest or pytest. What was skipped counts as failed: nothing is left out silently."""
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError):
        return Count(failed=1)
    count = Count()
    for case in root.iter("testcase"):
        bad = any(case.find(tag) is not None for tag in ("failure", "error", "skipped"))
        count += _one(not bad and case.get("status", "run") == "run")
    return count


def _experiments(build: str) -> Count:
    from salient.experiments.scenario import load_scenarios, run_scenario

    count = Count()
    for path in sorted(SCENARIOS.glob("*.toml")):
        for scenario in load_scenarios(path):
            with tempfile.TemporaryDirectory(prefix="salient-") as folder:
                try:
                    fault = run_scenario(scenario, Path(folder), build=build).fault
                except Exception as error:
                    fault = str(error)
            if fault != "none":
                _say(f"{path.stem} by {scenario.controller}: {fault}")
            count += _one(fault == "none")
    return count


def _pytest(report: Path, files: list[Path], options: list[str], prefix: list[str] | None = None) -> Count:
    report.unlink(missing_ok=True)
    good = _command(*(prefix or []), sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", ROOT,
                    f"--junitxml={report}", *options, *files, quiet=False)
    count = _read_report(report)
    # Something went wrong around the tests: a crash, an error at the end of the session.
    if not good and not count.failed:
        count += Count(failed=1)
    return count
