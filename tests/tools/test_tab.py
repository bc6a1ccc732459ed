"""The drive in a browser tab: one file, its client against the tools', rewinding, links. In Node; in a browser:
test_tab_browser.py."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path
from typing import Any

import can
import pytest

from salient.bench.a2l import is_short
from salient.bench.drive import command_frame
from salient.bench.variables import SIGNALS, Variables, short_names
from salient.bus.clock import open_bus
from salient.bus.signals import rig_database
from salient.machine.path import machine_path
from salient.tab import file as tab_file
from salient.tab.build_id import build_id
from salient.tab.link import link_of

EXTENDED = 1 << 31
OF_TIME = {rig_database().get_message_by_name(name).frame_id for name in ("RIG_RUN_UNTIL", "RIG_CLOCK")}
MS = 1_000_000


@pytest.fixture(scope="module")
def tab(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("tab") / "tab.html"
    assert tab_file.run(path, None) == 0
    return path


def run_in_tab(tab: Path, *runs: dict[str, Any]) -> list[dict[str, Any]]:
    program = Path(__file__).with_name("tab_run.mjs")
    done = subprocess.run(["node", program, tab], input=json.dumps(runs), capture_output=True, text=True, check=True)
    results: list[dict[str, Any]] = json.loads(done.stdout)
    return results


def frames_of(bench) -> list[list[Any]]:
    return [[time_ns, message.arbitration_id | (EXTENDED if message.is_extended_id else 0), bytes(message.data).hex()]
            for time_ns, message in bench.log if message.arbitration_id not in OF_TIME]


def to(time_ms: int) -> dict[str, int]:
    return {"to_ns": time_ms * MS}


def command(name: str, **args: Any) -> dict[str, Any]:
    return {"name": name, "args": args}


def test_one_file_of_at_most_350_kB_packed_that_refers_to_nothing_outside(tab):
    text = tab.read_text(encoding="utf-8")
    assert 150_000 < tab_file.packed_bytes(text.encode()) <= 350_000
    assert not re.search(r'\b(src|href)="(?!data:)', text)
    assert not re.search(r"\b(fetch|WebSocket|XMLHttpRequest|importScripts)\(", text)


@pytest.mark.in_turns
@pytest.mark.parametrize("machine", ["saturating", "finite_element"])
def test_client_of_the_page_sends_and_receives_the_frames_of_the_tools(tab, make_bench, machine):
    """Arming, checksums, counters, sets of parameters, variables of the bench and faults, refused ones included: every
    frame of the bus with its time, and what is then read from the drive."""
    bench = make_bench(machine=machine, seed=5, controller="salient")
    rows = bench.drive.parameters.rows
    bench.run_for(0.05)
    bench.drive.parameters.update({"speed_ramp_rpm_s": 5000.5})
    changed_ns = bench.time_ns
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.1)
    bench.rig.load_torque_Nm = 2.5
    bench.run_for(0.02)
    bench.drive.torque_reference_Nm = 1.25
    bench.run_for(0.03)
    bench.drive.off()
    bench.run_for(0.02)
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.05)
    bench.drive.stop()
    bench.run_for(0.005)
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.02)
    bench.fault("winding_open", phase="b", duration_s=0.04)
    bench.run_for(0.05)
    assert bench.drive.state == "fault"
    bench.drive.clear_fault()
    bench.run_for(0.03)
    ended_ns = bench.time_ns
    live = frames_of(bench)
    at = changed_ns
    steps = [to(50), command("set_parameters", values={"speed_ramp_rpm_s": 5000.5}),
             command("speed_reference", rpm=600), {"to_ns": (at := at + 100 * MS)},
             command("load_torque", Nm=2.5), {"to_ns": (at := at + 20 * MS)},
             command("torque_reference", Nm=1.25), {"to_ns": (at := at + 30 * MS)},
             command("off"), {"to_ns": (at := at + 20 * MS)},
             command("speed_reference", rpm=300), {"to_ns": (at := at + 50 * MS)},
             command("stop"), {"to_ns": (at := at + 5 * MS)},
             command("speed_reference", rpm=300), {"to_ns": (at := at + 20 * MS)},
             command("fault", kind="winding_open", phase="b", duration_s=0.04), {"to_ns": (at := at + 50 * MS)},
             command("clear_fault"), {"to_ns": at + 30 * MS}, command("fault_trace"), command("fault_log"),
             command("parameters")]
    made, = run_in_tab(tab, {"machine": machine, "options": {"seed": 5}, "steps": steps})
    assert made["time_ns"] == ended_ns
    assert [answer["message"] for answer in made["answers"] if not answer["ok"]] == []
    assert len(live) > 2000
    assert made["frames"] == live
    trace, faults, parameters = (answer["value"] for answer in made["answers"][-3:])
    expected = bench.drive.fault_trace()
    assert trace["speed_rpm"] == pytest.approx(expected.speed_rpm.tolist())
    assert trace["upper_duty"] == [pytest.approx(row) for row in expected.upper_duty.tolist()]
    assert [fault["fault"] for fault in faults] == [fault.fault for fault in bench.drive.fault_log]
    assert {row["name"]: row["default"] for row in parameters} == {row.name: row.default for row in rows.values()}
    assert {row["name"]: row["value"] for row in parameters}["speed_ramp_rpm_s"] == 5000


def test_refused_command_names_what_is_allowed_and_sends_nothing(tab):
    made, = run_in_tab(tab, {"steps": [
        to(20), command("speed_reference", rpm=1e6), command("load_torque", Nm=1e6), command("fault", kind="none_such"),
        command("fault", kind="winding_open"), command("set_parameters", values={"torque_max_Nm": 1e6})]})
    speed, load, kind, place, parameter = (answer["message"] for answer in made["answers"])
    assert re.fullmatch(r"speed_reference_rpm 1000000: must be -\d+(\.\d+)? to \d+(\.\d+)? r/min", speed)
    assert load == "load_torque_Nm 1000000: must be -10000 to 10000 N m"
    assert kind.startswith("no fault 'none_such'") and place == "winding_open: phase missing"
    assert re.fullmatch(r"torque_max_Nm 1000000: must be 0 to \d+ N m", parameter)
    assert len(set(made["hashes"][:5])) == 1


def test_values_of_parameters_are_set_linked_and_refused_by_their_names(tab):
    made, = run_in_tab(tab, {"steps": [
        to(20), command("set_parameters", values={"controller": "paper", "bp_mode": 1}), command("parameters"),
        command("set_parameters", values={"controller": "papers"}), command("set_parameters", values={"controller": 7}),
        command("set_parameters", values={"torque_max_Nm": "paper"}), command("speed_reference", rpm=300), to(100),
        command("set_parameters", values={"load_source": 1})]})
    done, read, unknown, beyond, other, _, running = made["answers"]
    assert done["ok"] and {row["name"]: row["value"] for row in read["value"]}["controller"] == 1
    assert unknown["message"] == "controller papers: must be traditional, paper or salient"
    assert beyond["message"] == "controller 7: must be traditional, paper or salient"
    assert re.fullmatch(r"torque_max_Nm paper: must be 0 to [\d.]+ N m", other["message"])
    assert running["message"] == "load_source torque_transducer: not_while_running"
    assert "set_parameters:controller=paper,bp_mode=1;" in made["link"]
    again, = run_in_tab(tab, {"link": made["link"], "steps": [to(200)]})
    assert again["same"] == [[made["time_ns"], True]]


@pytest.mark.in_turns
def test_rewound_run_repeats_to_the_bit_and_another_branch_differs(tab):
    begin = [to(20), command("speed_reference", rpm=300), to(400), command("load_torque", Nm=4), to(700),
             command("fault", kind="current_sensor_gain", phase="a", value=1.1), to(800)]
    plain, rewound, branch = run_in_tab(
        tab, {"steps": [*begin, to(900)]},
        {"steps": [*begin, to(900), {"back_ns": 390 * MS}, to(577), {"back_ns": 450 * MS}, command("parameters"),
                   to(600), to(900)]},
        {"steps": [*begin, to(900), {"back_ns": 390 * MS}, command("load_torque", Nm=5), to(900)]})
    assert rewound["hashes"][-1] == plain["hashes"][-1] == rewound["hashes"][len(begin)]
    assert rewound["same"] == [[577 * MS, True], [900 * MS, True]]
    assert branch["hashes"][-1] != plain["hashes"][-1]
    assert branch["same"] == []
    again = [frame for frame in rewound["frames"] if frame[0] > 600 * MS]
    once = [frame for frame in plain["frames"] if frame[0] > 600 * MS]
    assert again == once * 2


@pytest.mark.in_turns
def test_rewinding_reaches_ten_seconds_back_and_no_further(tab):
    made, = run_in_tab(tab, {"options": {"telemetry_period_ms": 10}, "steps": [
        to(20), command("truth_period", us=100_000), to(12_000), {"back_ns": 0}, to(12_000)]})
    assert made["same"] == [[12_000 * MS, True]]
    back = made["frames"].index(next(frame for before, frame in zip(made["frames"], made["frames"][1:], strict=False)
                                     if frame[0] < before[0]))
    assert 1_700 * MS <= made["frames"][back][0] <= 2_100 * MS
    assert 300_000 < made["memory_bytes"] < 2_000_000


@pytest.mark.in_turns
def test_link_repeats_the_run_to_the_bit_and_the_hash_notices_another(tab):
    made, = run_in_tab(tab, {"machine": "linear_cosine", "options": {"seed": 7, "controller": "paper"}, "steps": [
        to(20), command("set_parameters", values={"speed_ramp_rpm_s": 9000, "torque_max_Nm": 12}),
        command("speed_reference", rpm=450), to(300), command("load_torque", Nm=1.5),
        command("fault", kind="winding_open", phase="c", duration_s=0.001), to(500)]})
    link = made["link"]
    assert link.startswith(f"#build={build_id()}&machine=linear_cosine&controller=paper&seed=7&"
                           "events=0.02:set_parameters:")
    same, other = run_in_tab(tab, {"link": link, "steps": [to(137), to(600)]},
                             {"link": link.replace("Nm=1.5", "Nm=1.6"), "steps": [to(600)]})
    assert same["same"] == [[500 * MS, True]]
    assert other["same"] == [[500 * MS, False]]


@pytest.mark.in_turns
@pytest.mark.parametrize("options", [{}, {"machine": "linear_trapezoid", "controller": "traditional", "seed": 9,
                                          "initial_angle_deg": 12.25, "adc_bits": 14, "encoder_edges": True}])
def test_link_of_a_failed_test_repeats_every_frame_of_its_bench(tab, make_bench, options):
    bench = make_bench(**options)
    bench.at(0.13).load_torque_Nm = 1
    bench.drive.parameters["speed_ramp_rpm_s"] = 8000
    bench.drive.speed_reference_rpm = 200
    bench.run_for(0.2)
    bench.at(0.21).fault("winding_open", phase="a", duration_s=0.01)
    bench.run_for(0.05)
    file, _, link = str(link_of(bench)).partition("#")
    assert file == "out/tab.html"
    assert 200 < len(link) < 3000
    made, = run_in_tab(tab, {"link": link, "steps": [{"to_ns": bench.time_ns}]})
    assert made["frames"] == frames_of(bench)


def test_no_link_where_a_tab_cannot_repeat_the_run(make_bench, tmp_path, monkeypatch):
    bench = make_bench(memory=tmp_path / "memory")
    bench.run_for(0.01)
    assert link_of(bench) is None
    own = tmp_path / "own.toml"
    own.write_text(machine_path("linear_cosine").read_text(encoding="utf-8"), encoding="utf-8")
    bench = make_bench(machine=str(own))
    assert link_of(bench) is None
    bench = make_bench()
    bench.drive.speed_reference_rpm = 100
    bench.run_for(0.5)
    link = link_of(bench)
    assert link is not None
    assert len(link) < 1000
    monkeypatch.setattr("salient.tab.link.LENGTH_MAX", len(link) - 1)
    assert link_of(bench) is None


def test_another_client_on_the_bus_leaves_no_link(make_bench):
    bench = make_bench()
    with open_bus(bench.address) as other:
        other.send(can.Message(arbitration_id=0x7FF, is_extended_id=False, data=b""))
        other.send(command_frame(0, "off", 0.0))
        bench.run_for(0.01)
    assert link_of(bench) is None


SCOPE = ["torque_reference_Nm", "speed_rpm", "state", "control.measurement.current_q9[1]"]


@pytest.mark.in_turns
@pytest.mark.parametrize("machine", ["saturating", "finite_element"])
def test_triggered_buffer_read_in_the_tab_has_the_records_of_the_tools(tab, make_bench, machine):
    bench = make_bench(machine=machine)
    bench.run_for(0.12)
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.2)
    scope = bench.scope(SCOPE, trigger="torque_reference_Nm rises to 3", before=0.4)
    bench.advance_to(450 * MS)
    bench.load_torque_Nm = 4
    bench.advance_to(650 * MS)
    expected = scope.read()
    made, = run_in_tab(tab, {"machine": machine, "steps": [
        to(120), command("speed_reference", rpm=300), to(320), command("scope_read"),
        command("scope_arm", signals=SCOPE, trigger="torque_reference_Nm rises to 3", before=0.4),
        command("scope_read"), to(450), command("load_torque", Nm=4), to(650), command("scope_read")]})
    _, early, armed, waits, _, read = made["answers"]
    assert early["message"] == "the buffer is not armed"
    assert armed["ok"], armed["message"]
    assert waits["value"] == {"state": "waits"}
    assert made["time_ns"] == 650 * MS  # reading takes no time of the run
    recording = read["value"]
    assert recording["title"] == "torque_reference_Nm rises to 3"
    assert len(recording["time_s"]) == len(expected.time_s) > 1000
    assert recording["time_s"] == pytest.approx(expected.time_s.tolist(), abs=1e-9)
    for signal in recording["signals"]:
        assert signal["values"] == pytest.approx(expected[signal["name"]].tolist(), rel=1e-12)
    assert [signal["unit"] for signal in recording["signals"]] == [expected.units[name] for name in SCOPE]
    assert "run" in recording["signals"][2]["choices"].values()


def test_triggered_buffer_of_a_link_is_armed_again_and_triggered_by_hand(tab):
    made, = run_in_tab(tab, {"steps": [
        to(150), command("scope_arm", signals=SCOPE[:2], trigger="state == fault"), to(300), command("scope_trigger"),
        to(500), command("scope_read")]})
    assert [answer["message"] for answer in made["answers"] if not answer["ok"]] == []
    again, = run_in_tab(tab, {"link": made["link"], "steps": [to(500), command("scope_read")]})
    assert again["same"] == [[500 * MS, True]]
    assert again["answers"][0]["value"] == made["answers"][-1]["value"]
    assert made["answers"][-1]["value"]["state"] == "complete"


def test_scope_names_the_wrong_signal_trigger_or_divider_and_arms_nothing(tab):
    wrong = [{"signals": ["curent_a_A"]}, {"signals": []}, {"signals": ["speed_rpm"] * 9},
             *({"signals": ["speed_rpm"], "trigger": trigger} for trigger in (
                 "speed_rpm is 5", "speed_rpm > x", "state == broken", "state > 9e9")),
             {"signals": ["speed_rpm"], "divider": 0}, {"signals": ["speed_rpm"], "before": 1}]
    arming = [command("scope_arm", **each) for each in wrong]
    made, = run_in_tab(tab, {"steps": [to(150), *arming, command("scope_read")]})
    messages = [answer["message"] for answer in made["answers"]]
    assert messages[0] == ("signal 'curent_a_A': no variable of the drive; the nearest are current_a_A, "
                           "current_b_A, current_c_A")
    assert messages[1] == messages[2] == "signals: must be 1 to 8 names"
    assert "must be 'SIGNAL > VALUE'" in messages[3] and "x must be a number" in messages[4]
    assert "broken must be a number or one of" in messages[5] and "state is from 0 to " in messages[6]
    assert messages[7:] == ["divider 0: must be a whole number from 1 to 65535",
                            "before 1: must be from 0 to below 1, the part before the trigger",
                            "the buffer is not armed"]


@pytest.mark.parametrize("machine", ["saturating", "linear_cosine"])
def test_variables_of_the_tab_are_those_of_the_tools_in_the_memory_of_its_module(tab, machine):
    made, = run_in_tab(tab, {"machine": machine, "variables": True, "steps": []})
    variables = Variables("wasm", machine)
    short = [each for each in variables.quantities() if is_short(each.variable.path)]
    named = [variables.quantity(name) for name, path in SIGNALS.items() if path in variables.paths and path != name]
    assert len(short) > 1000 and len(named) > 10
    assert made["variables"] == [
        {"name": each.name, "address": each.variable.address, "bytes": each.variable.bytes,
         "signed": each.variable.is_signed, "unit": each.unit, "factor": each.factor,
         "choices": {str(value): name for value, name in short_names(each.variable.names).items()} or None}
        for each in [*short, *named]]


@pytest.mark.in_turns
def test_scope_of_the_tools_reads_the_module_as_it_reads_the_host(make_bench):
    """The drive compares the layout, so that the module has the one of which the names are."""
    recordings = []
    for build in ("host", "wasm"):
        bench = make_bench(build=build)
        bench.drive.speed_reference_rpm = 300
        bench.run_for(0.2)
        recordings.append(bench.scope(SCOPE, trigger="speed_rpm >= 250").read())
    host, module = recordings
    assert module.time_s.tolist() == host.time_s.tolist()
    assert all(module[name].tolist() == host[name].tolist() for name in SCOPE)
