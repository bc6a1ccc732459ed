"""salient test: runs the tests in steps and ends with a line of totals: N passed, N failed."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

from salient import builder
from salient.paths import BUILD, ROOT, SCENARIOS
from salient.turns import TURNS, turn_of_commit

RESULTS = BUILD / "results"
TESTS = ROOT / "tests"
CONFIGURATION = ROOT / "tools" / "pyproject.toml"
SOURCE_FOLDERS = ("firmware", "hal", "emulator", "tests")
CHECKED_FOR_SPELLING = ("docs", "firmware", "hal", "emulator", "tools", "tests", "cmake", "CMakeLists.txt", ".ci",
                        ".github")
VM_TIMEOUT_S = 1800
CORES = len(os.sched_getaffinity(0))
SILENT_S = 1200
"""Duration of a Python test from which on its stack is printed: no limit, but a test that hangs is known by name."""


@dataclass
class Count:
    """Passed and failed tests."""

    passed: int = 0
    failed: int = 0

    def __iadd__(self, other: Count) -> Count:
        self.passed += other.passed
        self.failed += other.failed
        return self

    def __str__(self) -> str:
        return f"{self.passed} passed, {self.failed} failed"


def run(only: list[str] | None, *, thorough: bool = False) -> int:
    """Runs all steps, or only the named ones; returns 0 when everything passed, else 1. thorough: every turn of the
    tests that take long, not the commit's alone (salient.turns).

    The VM of `socketcan` uses one core: it runs beside the first steps. The folders of Python tests are one run of
    pytest, in which no process waits for the last test of a folder.
    """
    names = [name for name in (*STEPS, *PYTHON_TESTS, "socketcan") if not only or name in only]
    RESULTS.mkdir(parents=True, exist_ok=True)
    total = Count()
    turn = None if thorough else turn_of_commit()
    with ThreadPoolExecutor(1) as background:
        socketcan = background.submit(_timed, partial(_socketcan, turn)) if "socketcan" in names else None
        for name in names:
            if name in STEPS:
                _print(f"--- {name}: {(STEPS[name].__doc__ or '').splitlines()[0]}")
                count, duration_s = _timed(STEPS[name])
                _print(f"--- {name}: {count} ({duration_s:.0f} s)")
                total += count
        if socketcan is not None:
            _print(f"--- socketcan: {(_socketcan.__doc__ or '').splitlines()[0]}")
            count, duration_s = socketcan.result()
            _print(f"--- socketcan: {count} ({duration_s:.0f} s)")
            total += count
    total += _python_tests([name for name in names if name in PYTHON_TESTS], turn)
    _print(str(total))
    return 1 if total.failed or not total.passed else 0


def _timed(step: Callable[[], Count]) -> tuple[Count, float]:
    started_s = time.monotonic()
    return step(), time.monotonic() - started_s


def _print(line: str) -> None:
    print(line, flush=True)


def _succeeds(*command: str | Path, quiet: bool = True, environment: Mapping[str, str] | None = None) -> bool:
    """Runs a command in the repository's root; quiet: its output is shown only when it fails."""
    done = subprocess.run(
        [str(part) for part in command],
        cwd=ROOT,
        env={**os.environ, **(environment or {})},
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
    """ruff, mypy, clang-format, clang-tidy, limits of C functions, language, requirements, British spelling."""
    count = _one(_succeeds(_tool("ruff"), "check", "--no-cache", "--config", CONFIGURATION, "tools", "tests"))
    count += _one(_succeeds(_tool("mypy"), "--config-file", CONFIGURATION, "--cache-dir", BUILD / "mypy",
                            "--no-error-summary"))
    sources = _sources(*SOURCE_FOLDERS, suffixes=(".c", ".h", ".cpp"))
    count += _one(_succeeds(_tool("clang-format"), "--dry-run", "-Werror", *sources))
    count += _one(_clang_tidy())
    count += _one(_within_limits())
    count += _one(_keeps_the_language())
    count += _one(_traces_its_requirements())
    documents = sorted(ROOT.glob("*.md"))
    count += _one(_succeeds(_tool("codespell"), "--toml", CONFIGURATION, *documents,
                            *(name for name in CHECKED_FOR_SPELLING if (ROOT / name).exists())))
    return count


def _unit() -> Count:
    """GoogleTest programs of the host build."""
    return _ctest("host")


def _sanitize() -> Count:
    """the same with AddressSanitizer and UndefinedBehaviorSanitizer, and the experiments of the paper."""
    built = _one(build_preset("sanitize"))
    if built.failed:
        return built
    count = _ctest("sanitize")
    count += _experiments("sanitize")
    return count


def _python_tests(names: list[str], turn: int | None) -> Count:
    """One run of pytest for the folders of these names, with a line of each. turn: None for all of them."""
    for name in names:
        _print(f"--- {name}: {PYTHON_TESTS[name]}")
    folders = [TESTS / name for name in names]
    if not folders:
        return Count()
    if turn is not None:
        _print(f"--- turn {turn} of 0 to {TURNS - 1}: the other tests that take long are run by `tools/salient test "
               "--thorough`")
    count = _pytest("python", *folders, turn=turn)
    for folder in folders:
        _print(f"--- {folder.name}: {_read_report(RESULTS / 'python.xml', f'tests.{folder.name}.')}")
    return count


def _socketcan(turn: int | None) -> Count:
    """the drive through a real SocketCAN interface, here or in a VM."""
    mark = re.compile(r"mark\.(both_transports|socketcan)\b")
    files = [path for path in sorted((TESTS / "hil").glob("test_*.py"))
             if mark.search(path.read_text(encoding="utf-8"))]
    vm = [sys.executable, "-m", "salient.vm.run", "--timeout-s", str(VM_TIMEOUT_S), "--"]
    # One after the other: there is one interface. Quiet: it runs beside other steps.
    return _pytest("socketcan", *files, options=["--salient-can=socketcan:vcan0", "-m", "both_transports or socketcan"],
                   turn=turn, prefix=vm, processes=0, quiet=True)


STEPS = {"style": _style, "unit": _unit, "sanitize": _sanitize}
PYTHON_TESTS = {
    "hil": "the drive through CAN on local buses.",
    "tools": "launcher, commands, reports and the commands of the documentation.",
    "plant": "the emulated plant compared with reference solvers.",
    "target": "the firmware for Cortex-M4 (compiled in three ways) and RV32: symbols and size checked, run in QEMU.",
}
"""Folder of tests: its claim. Last the folder with the longest file, whose tests use every core themselves."""


# --- parts of steps -------------------------------------------------------------------------------------------------

def build_preset(preset: str) -> bool:
    """Brings a preset up to date; the output is shown when it fails."""
    log = BUILD / "build.log"
    good = builder.build_preset(ROOT, BUILD / preset, (), log, lambda: None)
    if not good:
        _print(log.read_text(encoding="utf-8", errors="replace"))
    return good


def _tool(name: str) -> Path:
    """Program of the virtual environment."""
    return Path(sys.executable).with_name(name)


def _sources(*folders: str, suffixes: tuple[str, ...]) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*") if path.suffix in suffixes)


def _clang_tidy() -> bool:
    """The C sources that the host build compiles, with the compiler's own headers: the wheel brings none."""
    headers = subprocess.run(["gcc", "-print-file-name=include"], capture_output=True, text=True).stdout.strip()
    command: list[str | Path] = [_tool("clang-tidy"), "-p", BUILD / "host", "--quiet", f"--extra-arg=-isystem{headers}",
               "--extra-arg=-Wno-ignored-optimization-argument"]
    compiled = (BUILD / "host" / "compile_commands.json").read_text(encoding="utf-8")
    sources = [path for path in _sources("firmware", "hal", "emulator", suffixes=(".c",))
               if f'"file": "{path}"' in compiled]
    with ThreadPoolExecutor(CORES) as pool:
        passed = list(pool.map(lambda part: _succeeds(*command, *part), (sources[at::CORES] for at in range(CORES))))
    return bool(sources) and all(passed)


def _within_limits() -> bool:
    """Sizes of C functions and files."""
    from salient import c_limits

    return _all_explained(c_limits.EXCEPTIONS, c_limits.violations)


def _keeps_the_language() -> bool:
    """Rules of comments and documents."""
    from salient import language

    return _all_explained(language.EXCEPTIONS, language.violations)


def _traces_its_requirements() -> bool:
    """Marks of requirements in functions and tests."""
    from salient import traceability

    lines = traceability.violations()
    for line in lines:
        _print(line)
    return not lines


def _all_explained(exceptions: Path, violations: Callable[[Mapping[str, str]], list[str]]) -> bool:
    from salient.exceptions import read_exceptions

    lines = violations(read_exceptions(exceptions))
    for line in lines:
        _print(line)
    return not lines


def _ctest(preset: str) -> Count:
    """Each test case counts; a program that dies without a report counts as one failure."""
    results = RESULTS / f"unit-{preset}"
    shutil.rmtree(results, ignore_errors=True)
    results.mkdir(parents=True)
    overview = results / "ctest-overview"
    options, environment = _test_preset(preset)
    _succeeds("ctest", "--test-dir", BUILD / preset, *options, "--parallel", str(CORES), "--output-junit", overview,
              environment={**environment, "GTEST_OUTPUT": f"xml:{results}/"})
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


def _test_preset(name: str) -> tuple[list[str], dict[str, str]]:
    """Options and environment of a test preset, which ctest itself applies in the clone's own build/ alone."""
    presets = json.loads((ROOT / "CMakePresets.json").read_text(encoding="utf-8"))["testPresets"]
    [preset] = (each for each in presets if each["name"] == name)
    excluded = preset.get("filter", {}).get("exclude", {}).get("name")
    options = ["--output-on-failure", *([f"--exclude-regex={excluded}"] if excluded else [])]
    return options, preset.get("environment", {})


def _read_report(path: Path, prefix: str = "") -> Count:
    """Reads the cases of a JUnit file of GoogleTest or pytest whose class name starts with a prefix. A skipped test
    counts as failed: nothing is left out silently."""
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError):
        return Count(failed=1)
    count = Count()
    for case in root.iter("testcase"):
        if not case.get("classname", "").startswith(prefix):
            continue
        bad = any(case.find(tag) is not None for tag in ("failure", "error", "skipped"))
        count += _one(not bad and case.get("status", "run") == "run")
    return count


def _experiments(build: str) -> Count:
    from salient.experiments.scenario import Scenario, load_scenarios, run_scenario

    def fault_of(scenario: Scenario) -> str:
        with tempfile.TemporaryDirectory(prefix="salient-") as folder:
            try:
                return run_scenario(scenario, Path(folder), build=build).fault
            except Exception as error:
                return str(error)

    scenarios = [(path, scenario) for path in sorted(SCENARIOS.glob("*.toml")) for scenario in load_scenarios(path)]
    count = Count()
    with ThreadPoolExecutor(CORES) as pool:
        faults = pool.map(lambda each: fault_of(each[1]), scenarios)
        for (path, scenario), fault in zip(scenarios, faults, strict=True):
            if fault != "none":
                _print(f"{path.stem} by {scenario.controller}: {fault}")
            count += _one(fault == "none")
    return count


def _pytest(name: str, *files: Path, turn: int | None, options: Sequence[str] = (), prefix: Sequence[str] = (),
            processes: int = CORES, quiet: bool = False) -> Count:
    """Runs pytest in parallel processes; turn: None for every turn. The tests of a file share a process, which makes
    the file's fixtures once; the files start in their order."""
    report = RESULTS / f"{name}.xml"
    report.unlink(missing_ok=True)
    if turn is not None:
        options = [f"--turn={turn}", *options]
    if processes:
        options = ["-n", str(processes), "--dist", "loadfile", "--no-loadscope-reorder", *options]
    good = _succeeds(*prefix, sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", ROOT,
                     "-o", f"faulthandler_timeout={SILENT_S}", f"--junitxml={report}", *options, *files, quiet=quiet)
    count = _read_report(report)
    # Failures outside of the tests: a crash, an error at the end of the session.
    if not good and not count.failed:
        count += Count(failed=1)
    return count
