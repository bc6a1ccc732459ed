"""The package for other people's suites: a wheel without a clone, and firmware of another repository."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from salient.__main__ import main
from salient.cli import CLONE_ONLY
from salient.paths import BUILD, ROOT

pytestmark = pytest.mark.in_turns

FOREIGN = ROOT / "tests" / "tools" / "foreign"
SYSTEM = "/usr/local/bin:/usr/bin:/bin"


@dataclass(frozen=True)
class Installed:
    """A virtual environment with the wheel."""

    folder: Path
    wheel: Path
    constraints: Path
    first_output: str
    """Output of the quick start's steps."""

    def run(self, *command: str | Path, cwd: Path, path: str = "") -> subprocess.CompletedProcess[str]:
        """Runs a command of the environment; path: where other programs are found."""
        environment = {"PATH": f"{self.folder}/bin:{path}".rstrip(":"), **environment_of(self.constraints)}
        return subprocess.run([str(part) for part in command], cwd=cwd, env=environment, capture_output=True, text=True,
                              stdin=subprocess.DEVNULL)


def environment_of(constraints: Path) -> dict[str, str]:
    """Variables of a stranger, the versions of the lock file, and pip's own settings."""
    settings = {name: value for name, value in os.environ.items() if name.startswith("PIP_C")}
    return {"HOME": str(constraints.parent), "LANG": "C.UTF-8", "PIP_NO_COMPILE": "1", **settings,
            "PIP_CONSTRAINT": str(constraints)}


def steps_of_the_quick_start() -> str:
    """The commands from an empty folder to the first test, as the quick start has them."""
    text = (ROOT / "docs" / "start" / "ci.md").read_text()
    found = re.search(r"## 2\. A first test in a repository of your own\n.*?\n```\n(.*?)```\n", text, re.DOTALL)
    assert found is not None
    return found[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The wheel, built, and used as the quick start says: in an empty folder, with Python and cp in PATH alone."""
    folder = tmp_path_factory.mktemp("kit")
    started_s = time.monotonic()
    sys_argv, sys.argv = sys.argv, ["salient", "wheel", "--out", str(folder / "wheel")]
    try:
        assert main() == 0
    finally:
        sys.argv = sys_argv
    built_s = time.monotonic()
    (wheel,) = (folder / "wheel").iterdir()
    constraints = folder / "constraints.txt"
    lock = (ROOT / "tools" / "requirements.lock").read_text().splitlines()
    constraints.write_text("".join(f"{line.split()[0]}\n" for line in lock if "==" in line and line[0].isalpha()))
    (folder / "bin").mkdir()
    for program in ("python3", "cp"):
        (folder / "bin" / program).symlink_to(shutil.which(program, path=SYSTEM))
    (folder / "mine").mkdir()
    steps = steps_of_the_quick_start().replace("CLONE/out/wheel", str(wheel.parent)).replace("CLONE", str(ROOT))
    done = subprocess.run(["/bin/bash", "-euc", steps], cwd=folder / "mine", capture_output=True, text=True,
                          env={"PATH": str(folder / "bin"), **environment_of(constraints)}, stdin=subprocess.DEVNULL)
    assert done.returncode == 0, f"{steps}\n{done.stdout}\n{done.stderr}"
    print(f"wheel built in {built_s - started_s:.1f} s, installed and first test in {time.monotonic() - built_s:.1f} s")
    return Installed(folder / "mine" / "venv", wheel, constraints, done.stdout)


@pytest.fixture(scope="module")
def foreign(installed: Installed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the example repository after the steps of its workflow."""
    root = tmp_path_factory.mktemp("foreign") / "back_calculation"
    shutil.copytree(FOREIGN, root)
    for step in steps(root):
        given = f"export SALIENT_WHEEL={installed.wheel.as_uri()}\n{step}"
        done = installed.run("bash", "-euo", "pipefail", "-c", given, cwd=root, path=SYSTEM)
        assert done.returncode == 0, f"{step}\n{done.stdout}\n{done.stderr}"
    assert "7 passed" in done.stdout
    return root


def steps(root: Path) -> list[str]:
    workflow = yaml.safe_load((root / ".github/workflows/ci.yml").read_text())
    return [step["run"] for step in workflow["jobs"]["test"]["steps"] if "run" in step]


def test_steps_of_the_readme_end_with_the_first_passing_test(installed):
    assert len(steps_of_the_quick_start().splitlines()) == 3
    assert re.fullmatch(r"=+ 1 passed in .*", installed.first_output.splitlines()[-1]), installed.first_output


def test_wheel_runs_on_any_linux(installed):
    shown = subprocess.run([sys.executable, "-m", "auditwheel", "show", installed.wheel], capture_output=True,
                           text=True)
    assert "requires no external shared libraries" in " ".join(shown.stdout.split()), shown
    assert 'following platform tag: "manylinux_2_5_x86_64"' in " ".join(shown.stdout.split())
    assert "manylinux_2_17_x86_64" in installed.wheel.name


def test_suite_passes_without_clone_compiler_and_cmake(installed, tmp_path):
    shutil.copy(FOREIGN / "tests" / "test_drive.py", tmp_path)
    started_s = time.monotonic()
    done = installed.run("python", "-m", "pytest", "-n", "2", "-p", "no:cacheprovider", ".", cwd=tmp_path)
    print(f"example suite: {time.monotonic() - started_s:.1f} s")
    assert (done.returncode, "6 passed" in done.stdout) == (0, True), done.stdout


def test_commands_work_without_clone(installed, tmp_path):
    done = installed.run("salient", "run", "start_600", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    runs = json.loads((tmp_path / "out/start_600/results.json").read_text())["controllers"]
    assert set(runs) == {"traditional", "paper", "salient"}
    assert all(run["fault"] == "none" and 598 < run["final_speed_rpm"] < 602 for run in runs.values())
    for arguments in (("machine", "saturating"), ("compare", "--list"),
                      ("sweep", "start_600", "--set", "smc_k=900", "--controller", "salient")):
        done = installed.run("salient", *arguments, cwd=tmp_path)
        assert (done.returncode, done.stdout != "") == (0, True), done.stderr


def test_what_only_a_clone_has_is_refused_in_one_line(installed, tmp_path):
    for arguments, error in (*(((name,), f"salient: unknown command '{name}': the nearest of ")
                               for name in CLONE_ONLY),
                             (("sim", "--target", "rv32"), "salient: --target rv32: only in a clone")):
        done = installed.run("salient", *arguments, cwd=tmp_path)
        assert (done.returncode, done.stderr.startswith(error), done.stderr.count("\n")) == (2, True, 1), done.stderr


def test_program_in_the_wheel_has_the_bits_of_the_build(installed, tmp_path):
    code = ("from pathlib import Path\nfrom dataclasses import replace\n"
            "from salient.experiments.scenario import *\nfrom salient.paths import SCENARIOS\n"
            "scenario = replace(load_scenarios(SCENARIOS / 'start_600.toml')[2], duration_s=0.05)\n"
            "run_scenario(scenario, Path('out'))\n")
    (tmp_path / "clone").mkdir()
    (tmp_path / "wheel").mkdir()
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path / "clone", check=True)
    done = installed.run("python", "-c", code, cwd=tmp_path / "wheel")
    assert done.returncode == 0, done.stderr
    for name in ("recording.npy", "can.log"):
        contents = [(tmp_path / place / "out" / name).read_bytes() for place in ("clone", "wheel")]
        assert contents[0] == contents[1] and len(contents[0]) > 10_000


def test_drive_of_another_repository_passes_its_workflow(foreign):
    assert (foreign / "build" / "report.xml").exists()


def test_readme_of_the_other_repository_passes_from_its_folder_alone(installed, tmp_path):
    root = tmp_path / "copied"
    shutil.copytree(FOREIGN, root)
    (tmp_path / "salient" / "out").mkdir(parents=True)
    shutil.copytree(installed.wheel.parent, tmp_path / "salient" / "out" / "wheel")
    (block,) = re.findall(r"```\n(.*?)```", (root / "README.md").read_text(), re.DOTALL)
    done = subprocess.run(["/bin/bash", "-euc", block], cwd=root, capture_output=True, text=True,
                          env={"PATH": SYSTEM, **environment_of(installed.constraints), "HOME": str(tmp_path)},
                          stdin=subprocess.DEVNULL)
    assert (done.returncode, "7 passed" in done.stdout) == (0, True), f"{done.stdout}\n{done.stderr}"


def test_nothing_installs_the_package_by_a_name_that_anybody_could_claim():
    """It is on no registry; pip prefers the highest version of any index to one in a folder."""
    texts = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *FOREIGN.rglob("*.md"),
             *FOREIGN.rglob("*.yml"), *(ROOT / "tools" / "src").rglob("*.py")]
    named = re.compile(r"pip install[^\n]*salient-drive(?![^\n]*@ )")
    assert [path.name for path in texts if named.search(path.read_text(encoding="utf-8"))] == []


def test_bug_in_its_law_fails_a_test_that_shows_where(installed, foreign, tmp_path):
    root = tmp_path / "back_calculation"
    shutil.copytree(FOREIGN, root)
    law = root / "src" / "speed_pi.c"
    text = law.read_text()
    wrong = text.replace("fixed_accumulate(pi->integral_q54 + excess_q54,", "fixed_accumulate(excess_q54,")
    assert wrong != text  # the integral forgets
    law.write_text(wrong)
    _, build, test = steps(root)
    done = installed.run("bash", "-euc", build, cwd=root, path=SYSTEM)
    assert done.returncode == 0, done.stderr
    done = installed.run("bash", "-euc", test, cwd=root, path=SYSTEM)
    assert done.returncode == 1 and "test_load_is_compensated" in done.stdout, done.stdout
    folder = root / "build/failures/tests_test_drive.py_test_load_is_compensated/0"
    names = {path.name for path in folder.iterdir()}
    assert {"can.blf", "can.log", "failure.html", "last_second.png", "truth.npy", "bench.json"} <= names
    code = ("import numpy, sys\ntruth = numpy.load(sys.argv[1])\n"
            "speed_rpm = [truth['speed_rpm'][numpy.searchsorted(truth['time_s'], t)] for t in (0.12, 0.39)]\n"
            "print(*speed_rpm)\n")
    shown = installed.run("python", "-c", code, folder / "truth.npy", cwd=root)
    before_rpm, after_rpm = map(float, shown.stdout.split())
    assert before_rpm - after_rpm > 3  # the speed is lost at the load, which is what the integral is for


def test_floating_point_in_a_law_does_not_compile(installed, foreign, tmp_path):
    root = tmp_path / "back_calculation"
    shutil.copytree(FOREIGN, root)
    law = root / "src" / "speed_pi.c"
    law.write_text(law.read_text().replace("    return torque_q24;", "    return (int32_t)((double)torque_q24 * 0.5);"))
    done = installed.run("bash", "-euc", steps(root)[1], cwd=root, path=SYSTEM)
    assert done.returncode != 0 and "SSE register" in done.stdout + done.stderr


def test_installed_package_of_a_clone_is_found_by_cmake(tmp_path):
    subprocess.run(["cmake", "--install", BUILD / "host", "--prefix", tmp_path / "prefix"], check=True,
                   stdout=subprocess.DEVNULL)
    done = subprocess.run(["cmake", "-S", FOREIGN, "-B", tmp_path / "build", f"-DCMAKE_PREFIX_PATH={tmp_path}/prefix",
                           "-DCMAKE_BUILD_TYPE=Release"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert subprocess.run(["cmake", "--build", tmp_path / "build"], stdout=subprocess.DEVNULL).returncode == 0
    program = tmp_path / "build" / "back_calculation"
    assert "--controller" in subprocess.run([program, "--help"], capture_output=True, text=True).stdout
