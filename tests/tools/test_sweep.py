"""salient sweep and compare --set: the table, on processes, shards and a Dask scheduler."""

from __future__ import annotations

import argparse
import csv
import io
import json
import os
import signal
from pathlib import Path

import pytest

from salient.bench.rig import bench_variables
from salient.cli import make_parser
from salient.errors import UsageError
from salient.experiments import sweep
from salient.experiments.compare.command import run as compare
from salient.experiments.tasks import read_results
from salient.machine.parameter_table import read_table
from salient.machine.path import machine_path

SCENARIO = """
machine = "saturating"
controllers = ["salient"]
duration_s = 0.1
[[speed]]
at_s = 0.0
value_rpm = 300.0
[[load]]
at_s = 0.09
torque_Nm = 2.0
[record]
step_us = 10.0
"""
SWEPT = ("--set", "torque_max_Nm=10:19:10", "--machine", "saturating", "--machine", "linear_cosine")


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "some.toml"
    path.write_text(SCENARIO)
    return path


def options(scenario: Path, out: Path, *arguments: str) -> argparse.Namespace:
    return make_parser().parse_args(["sweep", str(scenario), "--out", str(out), *arguments])


def rows(out: Path) -> list[dict[str, str]]:
    with (out / "sweep.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.in_turns
def test_sweep_gives_the_same_table_on_processes_shards_and_a_scheduler_whose_worker_is_killed(
        scenario, tmp_path, dask_cluster):
    assert sweep.run(options(scenario, tmp_path / "a", *SWEPT, "--jobs", "2"), io.StringIO()) == 0
    table = (tmp_path / "a" / "sweep.csv").read_bytes()
    found = rows(tmp_path / "a")
    assert len(found) == 20
    assert [row["torque_max_Nm"] for row in found[:10]] == [f"{value:.1f}" for value in range(10, 20)]
    assert {row["machine"] for row in found} == {"saturating", "linear_cosine"}
    settling_s = [float(row["settling_time_s"]) for row in found[:10]]
    assert settling_s == sorted(settling_s, reverse=True)  # more torque, earlier
    assert 0.02 < settling_s[-1] < settling_s[0] < 0.09
    assert (tmp_path / "a" / "sweep.png").read_bytes().startswith(b"\x89PNG")

    for shard in ("2/2", "1/2"):
        out = io.StringIO()
        assert sweep.run(options(scenario, tmp_path / "b", *SWEPT, "--shard", shard), out) == 0
        assert ("10 of 20 runs" in out.getvalue()) == (shard == "2/2")
    assert (tmp_path / "b" / "sweep.csv").read_bytes() == table

    class KillsAWorker(io.StringIO):
        """Standard error of the sweep: the first progress on it kills."""

        def write(self, text: str) -> int:
            if dask_cluster.workers[0].poll() is None:
                os.kill(dask_cluster.workers[0].pid, signal.SIGKILL)
            return super().write(text)

    monkeypatch = pytest.MonkeyPatch()
    with monkeypatch.context() as patch:
        patch.setattr("sys.stderr", KillsAWorker())
        assert sweep.run(options(scenario, tmp_path / "c", *SWEPT, "--scheduler", dask_cluster.address),
                         io.StringIO()) == 0
    assert dask_cluster.workers[0].wait() == -signal.SIGKILL
    assert (tmp_path / "c" / "sweep.csv").read_bytes() == table
    assert len(read_results(tmp_path / "c")) == 20


@pytest.mark.in_turns
def test_finished_runs_are_kept_for_the_same_scenario_only(scenario, tmp_path, monkeypatch):
    out = tmp_path / "out"
    arguments = (scenario, out, "--set", "torque_max_Nm=10,12", "--resume", "--jobs", "1")
    sweep.run(options(*arguments), io.StringIO())
    before = (out / "sweep.csv").read_bytes()
    assert len(read_results(out)) == 2
    sweep.run(options(*arguments), io.StringIO())
    assert (len(read_results(out)), (out / "sweep.csv").read_bytes()) == (2, before)
    scenario.write_text(SCENARIO.replace("= 0.1", "= 0.101"))
    sweep.run(options(*arguments), io.StringIO())
    assert len(read_results(out)) == 4


@pytest.mark.in_turns
def test_without_resume_the_runs_of_other_shards_stay(scenario, tmp_path):
    arguments = (scenario, tmp_path / "out", "--set", "torque_max_Nm=10,12", "--jobs", "1")
    sweep.run(options(*arguments, "--shard", "1/2"), io.StringIO())
    shard = tmp_path / "out" / "runs-1-of-2.jsonl"
    before = shard.read_bytes()
    sweep.run(options(*arguments), io.StringIO())
    assert shard.read_bytes() == before and len(rows(tmp_path / "out")) == 2
    assert (tmp_path / "out" / "runs.jsonl").read_text().count("\n") == 1


def test_the_first_seed_may_be_0(scenario, tmp_path):
    found = sweep.runs_of(options(scenario, tmp_path, "--seed", "0", "--seeds", "2"))
    assert [of.columns["seed"] for of in found] == [0, 1] == [of.scenario.seed for of in found]


@pytest.mark.in_turns
def test_loads_profiles_and_seeds_are_columns(scenario, tmp_path):
    sweep.run(options(scenario, tmp_path, "--load-Nm", "1,3", "--load-profile", "compressor_one_cylinder", "--seeds",
                      "2", "--set", "current_noise_A=0.05", "--controller", "paper"), io.StringIO())
    found = rows(tmp_path)
    assert [(row["load_Nm"], row["seed"]) for row in found] == [("1.0", "1"), ("1.0", "2"), ("3.0", "1"), ("3.0", "2")]
    assert {row["controller"] for row in found} == {"paper"}
    assert len({row["mean_torque_Nm"] for row in found}) == 4  # noise by seed, torque by load


@pytest.mark.in_turns
def test_failed_run_is_a_row_and_the_exit_code(scenario, tmp_path, capsys):
    code = sweep.run(options(scenario, tmp_path, "--set", "encoder_fault=0,1"), io.StringIO())
    assert code == 1
    good, bad = rows(tmp_path)
    assert good["error"] == "" and "encoder" in bad["error"]
    assert "1 of 2 runs failed, the first with" in capsys.readouterr().err


def test_no_column_of_metrics_is_the_name_of_a_setting():
    assert not set(sweep.METRICS) & ({row.name for row in read_table()} | set(bench_variables()))


@pytest.mark.parametrize(("arguments", "error"), [
    (("--set", "torque_max=3"), "--set torque_max=3: torque_max: neither a parameter of the drive nor a "
     "variable of the test bench; the nearest of"),
    (("--set", "torque_max_Nm"), r"must be NAME=VALUE\[,VALUE...\] or NAME=FIRST:LAST:COUNT"),
    (("--set", "torque_max_Nm=1:2:1"), "must be NAME=VALUE"),
    (("--set", "torque_max_Nm=5,5"), "finite and different"),
    (("--set", "torque_max_Nm=500"), "parameters.torque_max_Nm: 500: must be a number from"),
    (("--set", "load_torque_Nm=1e9"), "load_torque_Nm=1e9: 1e.09: must be a number from"),
    (("--load-Nm", "1,20000"), "--load-Nm 20000: must be a number from -10000 to 10000"),
    (("--machine", "nonesuch"), "nonesuch"),
    (("--load-profile", "nonesuch"), "load_profile 'nonesuch': no such file"),
    (("--machine", "saturating", "--machine", "saturating"), "--machine saturating: given twice"),
    (("--controller", "paper", "--controller", "paper"), "--controller paper: given twice"),
    (("--load-Nm", "1,2,1.0"), "--load-Nm 1.0: given twice"),
])
def test_invalid_sweep_is_refused_before_the_first_run(scenario, tmp_path, arguments, error):
    with pytest.raises(UsageError, match=error):
        sweep.run(options(scenario, tmp_path / "out", *arguments), io.StringIO())
    assert not (tmp_path / "out").exists()


def test_machine_files_of_one_name_have_columns_that_tell_them_apart(scenario, tmp_path):
    files = [tmp_path / folder / "motor.toml" for folder in ("one", "two")]
    for file in files:
        file.parent.mkdir()
        file.write_text(machine_path("saturating").read_text().replace('"saturating"', '"motor"', 1))
    machines = [option for file in (*files, "linear_cosine") for option in ("--machine", str(file))]
    found = sweep.runs_of(options(scenario, tmp_path, *machines))
    assert [of.columns["machine"] for of in found] == [*map(str, files), "linear_cosine"]
    with pytest.raises(UsageError, match="two/../one/motor.toml: given twice"):
        sweep.runs_of(options(scenario, tmp_path, *machines, "--machine", f"{tmp_path}/two/../one/motor.toml"))


def compared(out: Path, *arguments: str) -> dict[str, object]:
    stream = io.StringIO()
    compare(make_parser().parse_args(["compare", "inertia", "--quick", "--samples", "1", "--out", str(out),
                                      *arguments]), stream)
    return json.loads((out / "compare.json").read_text())


@pytest.mark.in_turns
def test_compare_runs_with_a_setting_and_on_a_scheduler(tmp_path, dask_cluster):
    plain = compared(tmp_path / "plain", "--jobs", "2")
    assert compared(tmp_path / "dask", "--scheduler", dask_cluster.address)["rows"] == plain["rows"]
    assert compared(tmp_path / "set", "--set", "torque_max_Nm=9")["rows"] != plain["rows"]
    with pytest.raises(UsageError, match="--set torque_max_Nm=9,10: must be one value"):
        compared(tmp_path / "two", "--set", "torque_max_Nm=9,10")
