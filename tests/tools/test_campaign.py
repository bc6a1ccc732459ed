"""Worlds by seed: equal bits everywhere, results that merge, failures that shrink and replay."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from salient import paths
from salient.bench.programs import executable
from salient.cli import make_parser
from salient.errors import RunFailed, UsageError, exit_code
from salient.experiments import fault_table
from salient.experiments.campaign import command, names, report, same_bits
from salient.experiments.campaign.cluster import compare
from salient.experiments.campaign.command import run_campaign
from salient.experiments.campaign.failure import classes, replay
from salient.experiments.campaign.machines import files, pool_line
from salient.experiments.campaign.runner import Programs, branches, program, run_world, serve, world
from salient.experiments.tasks import read_results
from salient.paths import BUILD, ROOT


def salient(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "salient", *map(str, arguments)], capture_output=True, text=True,
                          check=False)


@pytest.mark.in_turns
def test_shards_merge_to_what_one_run_has_and_nothing_runs_twice(tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    common = ["campaign", "--first", "2", "--seeds", "6", "--no-shrink", "--jobs", "1", "--out"]

    def campaign(*arguments: object) -> int:
        return run_campaign(make_parser().parse_args([*common, *map(str, arguments)]))

    assert {campaign(whole), campaign(parts, "--shard", "1/2"), campaign(parts, "--shard", "2/2")} <= {0, 1}
    results = read_results(whole)
    assert len(results) == 6 and read_results(parts) == results
    assert len({result["hash"] for result in results.values()}) == 6
    before = {file.name: file.read_bytes() for file in parts.glob("runs*")}
    campaign(parts)
    after = {file.name: file.read_bytes() for file in parts.glob("runs*")}
    assert after.pop("runs.jsonl") == b"" and after == before
    note = json.loads((whole / "summary.json").read_text(encoding="utf-8"))
    assert (note["first"], note["seeds"], note["finished"]) == (2, 6, 6)
    assert 0 < note["cells_reached"] < note["cells"] == len(names.cells())
    assert len(note["cells_not_reached"]) == note["cells"] - note["cells_reached"]


@pytest.mark.in_turns
def test_worlds_of_machines_of_five_and_six_phases_break_no_rule(tmp_path: Path) -> None:
    pool = tmp_path / "machines.txt"
    machines = [ROOT / "tests" / "machines" / f"{name}.toml" for name in ("five_phases", "six_phases")]
    pool.write_text("".join(f"{pool_line(machine)}\n" for machine in machines), encoding="utf-8")
    done = subprocess.run([program(), "--machines", pool, "--first", "1", "--seeds", "12"], capture_output=True,
                          text=True, check=True)
    results = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(results) == 12 and [result["violations"] for result in results] == [[]] * 12


@pytest.mark.in_turns
def test_a_scheduler_whose_worker_is_killed_has_the_summary_of_one_computer_byte_for_byte(tmp_path: Path) -> None:
    note = compare(tmp_path, 50, 60)
    assert note["killed"] and note["equal"] and 20 <= note["killed_after"] < 60
    one, many = tmp_path / "one", tmp_path / "many"
    assert (many / "summary.json").read_bytes() == (one / "summary.json").read_bytes()
    assert read_results(many) == read_results(one) and len(read_results(one)) == 60
    rate = json.loads((one / "rate.json").read_text(encoding="utf-8"))
    assert rate["worlds"] == 60 and 0.1 < rate["processor_s"] < 60.0 and 10.0 < rate["virtual_s"] < 40.0


def test_a_seed_that_breaks_two_rules_leaves_a_folder_of_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                              capsys: pytest.CaptureFixture[str]) -> None:
    violations = [{"rule": "gate_on", "number": 1, "at_us": 5}, {"rule": "no_command", "number": 2, "at_us": 7}]
    saved = {}

    def save(seed: int, violation: str, folder: Path, kind: str) -> dict[str, object]:
        saved[folder.name] = violation
        return {"world": {"events": []}, "replay": f"tools/salient replay {folder}"}

    monkeypatch.setattr(command, "run", lambda tasks, *_: [(tasks[0], {"seed": 3, "violations": violations})])
    monkeypatch.setattr(command, "save", save)
    assert run_campaign(make_parser().parse_args(["campaign", "--first", "3", "--seeds", "1", "--out", str(tmp_path)])
                        ) == 1
    assert saved == {"3": "gate_on: outside of run", "3-no_command-after-off": "no_command: after off"}
    lines = capsys.readouterr().out.splitlines()[-2:]
    assert [line.split("; ")[-1] for line in lines] == [f"tools/salient replay {tmp_path}/failures/{name}"
                                                        for name in saved]


def test_a_worker_with_another_build_ends_the_campaign() -> None:
    with pytest.raises(RunFailed, match="a worker has another build of the drive than this computer"):
        serve((1, "faults", "digest of another build"))


def test_the_programs_are_the_same_bytes_wherever_the_clone_is() -> None:
    for path in (program(), executable()):
        assert b"emulator/rig" in path.read_bytes() and str(ROOT).encode() not in path.read_bytes()


def test_leaving_an_event_out_moves_no_other() -> None:
    events = world(3)["events"]
    assert len(events) >= 4
    kept = sum(1 << event["index"] for event in events if event["index"] != 2)
    assert world(3, kept)["events"] == [event for event in events if event["index"] != 2]
    assert run_world(3, kept)["hash"] != run_world(3)["hash"] == run_world(3)["hash"]


@pytest.mark.in_turns
def test_seeds_differ_in_machine_controller_and_events() -> None:
    worlds = [world(seed) for seed in range(1, 41)]
    assert len(files()) == 20
    assert 12 <= len({drawn["machine"] for drawn in worlds}) <= 20
    assert {drawn["controller"] for drawn in worlds} == {"traditional", "paper", "salient"}
    of_kinds = set(names.kinds().values())
    numbers = [sum(event["event"] in of_kinds for event in drawn["events"]) for drawn in worlds]
    assert min(numbers) <= 1 and 4 <= max(numbers) <= 6 and 2.0 < sum(numbers) / len(numbers) < 5.0


@pytest.mark.in_turns
@pytest.mark.parametrize("seed", [6, 43, 819])
def test_a_seed_has_the_same_bits_on_the_usual_bench(tmp_path: Path, seed: int) -> None:
    again = replay(seed, folder=tmp_path)
    assert again.equal and again.campaign["causes"]
    left = {file.name for file in tmp_path.iterdir()}
    assert {"can.blf", "can.log", "failure.html", "failure.png", "bench.json"} <= left
    assert json.loads((tmp_path / "bench.json").read_text())["replay"] == f"tools/salient replay {seed}"


@pytest.mark.in_turns
@pytest.mark.parametrize("seed", [13, 19, 39, 87, 1584])
def test_warm_windings_of_small_machines_are_no_false_alarm(seed: int) -> None:
    result = run_world(seed, kind="healthy")
    assert result["violations"] == [] and result["causes"] == []
    assert 300_000 < result["virtual_us"] < 4_000_000


@pytest.mark.in_turns
@pytest.mark.parametrize(("seed", "event", "cause"), [
    (8053769, "switch_shorted", 17),  # phase_shorted
    (8051023, "encoder_slip", 18),    # encoder_angle
    (129150, "encoder_lost_counts", 18),
    (717102, "encoder_lost_counts", 18),  # under load the first time since
    (8052178, "current_sensor_swapped", 17)])  # fmt: skip
def test_first_causes_are_those_of_the_faults(seed: int, event: str, cause: int) -> None:
    assert event in [drawn["event"] for drawn in world(seed)["events"]]
    result = run_world(seed)
    assert result["causes"][0] == cause and result["violations"] == []


@pytest.mark.parametrize("seed", [206286])
def test_a_rotor_that_swings_with_a_phase_lost_is_stalled(seed: int) -> None:
    assert "degraded_running" in [drawn["event"] for drawn in world(seed)["events"]]
    result = run_world(seed)
    assert result["causes"] == [14] and result["violations"] == []


@pytest.mark.in_turns
@pytest.mark.parametrize(("seed", "event"), [
    (10824, "static_friction"), (20918, "shaft_locked"), (72251, "shaft_locked"), (90244, "shaft_locked")])
def test_a_rotor_that_rests_between_coarse_counts_is_stalled_in_time(seed: int, event: str) -> None:
    drawn = world(seed)
    assert drawn["encoder_bits"] <= 12 and event in [each["event"] for each in drawn["events"]]
    result = run_world(seed)
    assert result["causes"][0] == 14 and result["violations"] == []


def test_a_current_that_the_other_phases_hold_at_zero_does_not_stop_time() -> None:
    assert "winding_to_earth" in [drawn["event"] for drawn in world(904850)["events"]]
    result = run_world(904850)
    assert result["violations"] == [] and 900_000 < result["virtual_us"] < 1_000_000


@pytest.mark.parametrize(("seed", "event"), [
    (137892, "load_ramp_Nm_s"), (252587, "shaft_locked"), (23025, "load_sine_amplitude_Nm")])  # fmt: skip
def test_a_load_soon_after_a_start_is_no_other_inertia_with_which_the_speed_hunts(seed: int, event: str) -> None:
    assert event in [drawn["event"] for drawn in world(seed)["events"]]
    result = run_world(seed)
    assert result["violations"] == [] and result["recovered"]


def test_two_phases_of_four_that_agree_with_the_angle_outweigh_one_whose_current_sensor_is_wrong() -> None:
    assert world(36295)["machine"] == "map86"  # the fourth phase has not conducted yet
    result = run_world(36295)
    assert result["violations"] == [] and 18 not in result["causes"] and result["causes"] != []


def test_a_light_rotor_that_restarts_at_speed_is_not_twice_as_heavy() -> None:
    result = run_world(366611)
    assert result["violations"] == [] and result["recovered"]


def test_a_torque_that_swings_at_the_start_of_a_light_rotor_is_no_fivefold_inertia() -> None:
    drawn = world(917278)
    assert (drawn["machine"], drawn["controller"], drawn["control_rate_hz"]) == ("random_01", "salient", 20_000)
    assert run_world(917278)["violations"] == []


@pytest.mark.parametrize(("seed", "event"), [(1033581, "interrupt_late"), (1040244, "encoder_stuck")])
def test_an_observer_that_slips_after_a_fault_does_not_keep_the_drive_from_clearing_it(seed: int, event: str) -> None:
    assert event in [drawn["event"] for drawn in world(seed)["events"]]
    result = run_world(seed)
    assert result["violations"] == [] and result["recovered"]


def test_an_encoder_that_jumps_before_the_first_stroke_is_no_short_circuit_of_a_phase() -> None:
    assert "encoder_jump" in [drawn["event"] for drawn in world(662347)["events"]]
    result = run_world(662347)
    assert result["violations"] == [] and 17 not in result["causes"]


def test_a_hung_gateway_does_not_withdraw_a_request_to_run_after_bus_off() -> None:
    assert {"hostile", "transmit_error_counter"} <= {drawn["event"] for drawn in world(860958)["events"]}
    assert run_world(860958)["violations"] == []


def test_a_recording_after_a_reset_is_not_armed_by_the_living_sender() -> None:
    assert {"drive_reset", "hostile"} <= {drawn["event"] for drawn in world(951921)["events"]}
    assert run_world(951921)["violations"] == []


def test_torque_of_a_drive_with_a_lost_phase_ends_with_its_reference() -> None:
    assert {"degraded_running", "silent"} <= {drawn["event"] for drawn in world(436414)["events"]}
    assert run_world(436414)["violations"] == []


def test_a_constant_in_a_faulty_memory_is_no_index_beyond_a_table() -> None:
    result = run_world(85011)
    assert result["violations"] == [] and result["causes"] == [23]  # memory


def test_torque_of_a_heavy_rotor_before_the_first_count_is_no_frozen_encoder() -> None:
    result = run_world(96986)  # pulses of a large machine at 40 kHz, shorter than its devices act on
    assert result["violations"] == [] and result["causes"] == [23]


def test_a_crash_is_replayed_as_one(tmp_path: Path) -> None:
    campaign, host = tmp_path / "salient_campaign", tmp_path / "salient_host"
    crash = json.dumps({"seed": 5, "violations": [{"rule": "crash", "number": 11, "at_us": 0, "value": 0}]})
    campaign.write_text(f"#!/bin/sh\n{program()} \"$@\" > {tmp_path}/result\necho '{crash}'\n", encoding="utf-8")
    host.write_text("#!/bin/sh\nkill -SEGV $$\n", encoding="utf-8")
    for script in (campaign, host):
        script.chmod(0o755)
    again = replay(5, programs=Programs(campaign, host))
    assert again.hash == "" and again.equal and classes(again.campaign) == ["crash"]
    only_there = replay(5, programs=Programs(campaign, BUILD / "host" / "bin" / "salient_host"))
    assert len(only_there.hash) == 16 and not only_there.equal


@pytest.mark.in_turns
def test_a_part_of_the_clients_commands_a_torque_for_some_time() -> None:
    torque_mode = [drawn for drawn in map(world, range(1, 31))
                   if any(event["event"] == "torque_reference" for event in drawn["events"])]
    assert 2 <= len(torque_mode) <= 10
    results = [run_world(drawn["seed"]) for drawn in torque_mode]
    assert all(result["violations"] == [] for result in results)
    without = [run_world(drawn["seed"], sum(1 << event["index"] for event in drawn["events"]
                                            if event["event"] != "torque_reference")) for drawn in torque_mode]
    assert sum(one["hash"] != other["hash"] for one, other in zip(results, without, strict=True)) > len(results) // 2


@pytest.mark.in_turns
def test_a_seed_has_the_same_bits_twice_on_the_bench_and_on_a_target(tmp_path: Path,
                                                                     capsys: pytest.CaptureFixture[str]) -> None:
    assert same_bits.main([str(tmp_path), "401", "2"]) == 0
    assert "2 of 2 with equal bits" in capsys.readouterr().out
    results = read_results(tmp_path)
    assert len({result["hash"] for result in results.values()}) == 2
    assert not same_bits.equal({**next(iter(results.values())), "on_target": "0"})
    note = json.loads((tmp_path / same_bits.SUMMARY).read_text(encoding="utf-8"))
    assert (note["first"], note["seeds"], note["target"], note["different"]) == (401, 2, "cortex-m4", [])


def test_a_measurement_names_the_command_that_builds_what_it_misses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                                    capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(paths, "BUILD", BUILD / "none")
    assert exit_code(lambda: same_bits.main([str(tmp_path), "1", "1"])) == 2
    assert capsys.readouterr().err == ("salient: build/none/host/bin/salient_host is not built; any tools/salient "
                                       "command builds it\n")
    for build in ("cortex-m4", "rv32"):
        with pytest.raises(UsageError, match=f"is not built; any .* command with --target {build} builds it"):
            executable(build)


NOT_FAULTY = {"load_dropped", "winding_temperature_sensor_offset", "inverter_temperature_sensor_offset"}
"""Faults that change nothing which a drive should answer."""


@pytest.mark.in_turns
@pytest.mark.parametrize(("setting", "places", "unanswered"), [
    ((2, 150, 8, 0, 2000, 200), 10, {"static_friction"}),  # a shaft that turns does not stick
    ((2, 1500, 6, 0, 200, 20), 10, {"static_friction"}),
    ((2, 0, 0, 0, 360, 36), 10, set()),
])  # fmt: skip
def test_every_fault_is_answered_wherever_it_begins(setting: tuple[int, ...], places: int,
                                                    unanswered: set[str]) -> None:
    found = branches(*setting)
    assert len(found) == 56
    assert not {"code_flipped", "stack_guard_flipped"} & {row["fault"] for row in found}  # unsupported on the host
    for row in found:
        name = row["fault"]
        fast = row["detected"] == row["branches"] and row["longest_us"] <= 100_000
        assert row["branches"] == places if fast else 1 <= row["branches"] <= places, name
        assert row["violations"] == 0, name
        assert row["detected"] == (0 if name in NOT_FAULTY | unanswered else row["branches"]), name
    longest_us = {(row["fault"], row["leg"]): row["longest_us"] for row in found}
    assert longest_us["encoder_jump", 0] == longest_us["current_sensor_high_rail", 0] == 25  # the same interrupt
    period_us = 60e6 / (setting[1] or 150) / 8  # of eight rotor poles
    assert 0.5 * period_us < longest_us["switch_open", 0] < 1.5 * period_us


@pytest.mark.in_turns
def test_a_branch_at_one_place_is_the_one_among_others() -> None:
    alone, first = ({row["fault"]: row for row in branches(2, 1500, 6, 60, ticks, 20)} for ticks in (1, 40))
    assert all(row["branches"] == 1 and row["detected"] <= 1 for row in alone.values())
    assert alone["winding_open"]["longest_tick"] == 60
    assert all(first[name]["longest_us"] >= row["longest_us"] for name, row in alone.items())


def test_the_pages_show_the_committed_results() -> None:
    results = read_results(report.RESULTS / "same_bits").values()
    note = json.loads((report.RESULTS / "same_bits" / same_bits.SUMMARY).read_text(encoding="utf-8"))
    assert note["seeds"] == len(results) == sum(map(same_bits.equal, results)) + len(note["different"])
    assert report.page() == report.PAGE.read_text(encoding="utf-8")
    page = fault_table.PAGE.read_text(encoding="utf-8")
    assert fault_table.with_branches(page) == page
    assert report.table().count("\n") == 9


@pytest.mark.parametrize(("arguments", "message"), [
    (("replay", "12x"), "replay 12x: must be a seed, a whole number from 0, or the folder of a failure"),
    (("campaign", "--shard", "3/2"), "--shard 3/2: must be I/N, whole numbers with I from 1 to N"),
    (("campaign", "--seeds", "0"), "--seeds 0: must be a whole number from 1 to 99999999"),
])  # fmt: skip
def test_a_mistake_is_one_line_that_names_it(arguments: tuple[str, ...], message: str) -> None:
    done = salient(*arguments)
    assert done.returncode == 2 and message in done.stderr and done.stderr.count("\n") == 1


def test_a_folder_without_a_failure_is_named(tmp_path: Path) -> None:
    done = salient("replay", tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (
        2, "", f"salient: {tmp_path}/failure.json: not the note of a failure (No such file or directory); give a seed "
        "or the folder of a failure that a campaign has left\n")


@pytest.mark.in_turns
@pytest.mark.parametrize(("seed", "client"), [
    (552, "canopen"),   # disable voltage beside a mode that the drive has not
    (625, "canopen"),   # a stop before the rotor has reached its demand
    (2393, "canopen"),  # what was prepared is withdrawn beside such a mode
    (3218, "position"),  # a rotor that is held between coarse counts is not stalled
    (8, "position")])  # fmt: skip
def test_worlds_of_positions_have_the_same_bits_on_the_usual_bench(seed: int, client: str) -> None:
    drawn = world(seed, kind="motion")
    assert drawn["client"] == client
    again = replay(seed, kind="motion")
    assert again.equal and again.campaign["violations"] == []


@pytest.mark.in_turns
def test_worlds_of_positions_differ_in_client_mode_and_events() -> None:
    worlds = [world(seed, kind="motion") for seed in range(1, 81)]
    assert {drawn["client"] for drawn in worlds} == {"position", "canopen"}
    assert {drawn["master"]["mode"] for drawn in worlds if drawn["client"] == "canopen"} == {1, 3, 4, 6, 8, 9, 10}
    events = {event["event"] for drawn in worlds for event in drawn["events"]}
    assert {"position_rev", "mode", "controlword", "nmt", "lost_master", "canopen_noise", "second_master"} <= events
