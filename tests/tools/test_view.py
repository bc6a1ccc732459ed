"""The live page in a real browser: a drive in lock-step, a server on its bus, and pages in Chromium.

Time is virtual: the drive waits until the page has shown what has come so far.
"""

from __future__ import annotations

import functools
import http.client
import http.server
import json
import math
import random
import subprocess
import sys
import threading
from collections import Counter
from contextlib import ExitStack, nullcontext
from itertools import pairwise
from types import SimpleNamespace

import can
import numpy as np
import pytest
from cantools.database.errors import DecodeError
from visitor import STEP_S, Visitor, nothing_is_cut_off, picture
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import connect

from salient.bench import failure
from salient.bench.drive import DriveError
from salient.bus.frame_bits import BitRates
from salient.bus.identity import Carrier
from salient.bus.log import write_logs
from salient.bus.signals import drive_database, rig_database
from salient.bus.traffic import Traffic
from salient.machine.parameter_table import CHOICES, value_name
from salient.paths import ROOT
from salient.view import link as view_link
from salient.view.command import LogFeed
from salient.view.commands import COMMANDS, Commander, Malformed, check_command
from salient.view.description import EXTENDED, description
from salient.view.frames import FrameStore
from salient.view.server import PAGES_MAX
from salient.view.traffic_feed import TrafficFeed

TWENTY = [
    *(f"DRIVE_STATUS.{name}" for name in ("time_us", "state", "fault", "voltage_saturated", "single_pulse", "cycle")),
    *(f"DRIVE_MOTION.{name}" for name in ("speed_rpm", "speed_reference_rpm", "rotor_angle_deg")),
    *(f"DRIVE_TORQUE.{name}" for name in ("torque_reference_Nm", "torque_estimate_Nm", "load_torque_estimate_Nm",
                                          "bus_voltage_V")),
    *(f"DRIVE_CURRENTS.current_{phase}_A" for phase in "abc"),
    "RIG_TRUTH_MOTION.speed_rpm", "RIG_TRUTH_MOTION.torque_Nm", "RIG_TRUTH_CURRENTS.current_a_A",
    "RIG_TRUTH_BENCH.load_torque_Nm",
]


@pytest.fixture
def live(browser, make_bench, serve):
    """A drive with 1 kHz telemetry, and a function that opens a page on it."""
    bench = make_bench()
    bench.run_for(0.02)
    link = serve("--can", bench.address)
    visitors = []

    def visit(**size):
        visitor = Visitor(browser, link, bench, **size)
        visitors.append(visitor)
        bench.run_for(0.01)
        visitor.catch_up()
        return visitor

    visit.bench, visit.link = bench, link
    yield visit
    for visitor in visitors:
        visitor.page.close()
        assert visitor.errors == []


@pytest.fixture
def no_feed(tmp_path):
    """The link of a server that has nothing to show, and a function that gives what it has written as errors."""
    log, program = tmp_path / "errors", (
        "from types import SimpleNamespace\n"
        "from salient.view.frames import FrameStore\n"
        "from salient.view.server import Server\n"
        "server = Server(SimpleNamespace(info={}, store=FrameStore(), link=None, ended='', first_number=lambda: 0))\n"
        "print(server.link, flush=True)\n"
        "server.run()\n")
    with log.open("wb") as errors, subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE,
                                                    stderr=errors, text=True) as process:
        yield process.stdout.readline().strip(), lambda: log.read_text(encoding="utf-8")
        process.terminate()


def frames_by_message(bench):
    names = {message.frame_id | (EXTENDED if message.is_extended_frame else 0): message.name
             for database in (drive_database(), rig_database()) for message in database.messages}
    return Counter(names[m.arbitration_id | (EXTENDED if m.is_extended_id else 0)] for _, m in bench.log
                   if not (m.is_remote_frame or m.is_error_frame or m.is_fd))


@pytest.mark.in_turns
def test_twenty_signals_at_1_kHz_for_ten_seconds_without_a_lost_frame(live):
    visitor, bench = live(), live.bench
    visitor.tab("Signals")
    for box in visitor.page.query_selector_all("#signals input:checked"):
        box.uncheck()
    for name in TWENTY:
        visitor.page.check(f"#signals input[value='{name}']")
    assert visitor.ask("salient.names.length") == 20
    before = {name: visitor.count(name) for name in frames_by_message(bench)}
    already = frames_by_message(bench)
    visitor.run(10.0, step_s=0.25)
    sent = frames_by_message(bench) - already
    assert {name: visitor.count(name) - before.get(name, 0) for name in sent} == dict(sent)
    assert 9990 <= sent["DRIVE_STATUS"] <= 10010 and 9990 <= sent["RIG_TRUTH_MOTION"] <= 10010
    assert visitor.ask("salient.store.lost") == 0 and visitor.ask("salient.store.unknown") == 0
    for name in TWENTY:
        table = bench.telemetry if name.startswith("DRIVE") else bench.truth
        shown = visitor.ask(f"(() => {{ const s = salient.store.watch('{name}'); "
                            "return Array.from(s.value.slice(s.size - 9000, s.size)); })()")
        assert np.array_equal(shown, table[name].value[-9000:]), name
    visitor.page.screenshot(path=picture("signals"))


def torque_of_the_loops(visitor):
    """The torque that the work of the shown strokes makes, relative to the true one."""
    visitor.wait("true")
    work_J = visitor.ask("salient.workKey").split(",")[1:]
    torque_Nm = visitor.bench.truth["torque_Nm"].between(visitor.bench.time_s - 0.1, visitor.bench.time_s).value.mean()
    return sum(map(float, work_J)) * 4 / (2 * math.pi) / torque_Nm  # four rotor poles


@pytest.mark.in_turns
def test_a_person_starts_loads_breaks_clears_tunes_and_exports(live):  # noqa: PLR0915 - one visit, step by step
    visitor, bench, page = live(), live.bench, None
    page = visitor.page
    page.keyboard.press("Tab")
    assert visitor.ask("document.activeElement.id") == "take"
    page.keyboard.press("Enter")
    visitor.wait("salient.lease === 'yours'")

    visitor.tab("Parameters")
    visitor.press("#read-parameters")
    page.fill("#parameter-filter", "speed_ramp")
    shown = page.locator("#parameters tbody tr:visible th").all_inner_texts()
    assert shown and all("speed_ramp" in name for name in shown)

    visitor.tab("Run")
    page.fill("#speed-reference", "600")
    visitor.press("#speed-form button")
    visitor.run(0.4)
    assert bench.drive.state == "run" and page.inner_text("#state") == "run"
    assert 597 < bench.truth["speed_rpm"].last < 603

    page.fill("#load-torque", "8")
    visitor.press("#load-form button")
    visitor.run(0.3)
    assert bench.truth["load_torque_Nm"].last == pytest.approx(8, abs=0.05)
    assert 598 < bench.truth["speed_rpm"].last < 602
    page.select_option("#rotor", "step")
    assert 0.90 < torque_of_the_loops(visitor) < 0.98  # 25 samples a stroke cut its corners
    page.select_option("#truth-period", "100")
    visitor.finish()
    visitor.run(0.3)
    assert 0.99 < torque_of_the_loops(visitor) < 1.01
    assert nothing_is_cut_off(page) == []
    page.select_option("#rotor", "slow")
    page.select_option("#window", "0.1")
    visitor.run(0.08)
    page.screenshot(path=picture("live"))
    page.select_option("#window", "1")

    visitor.tab("Parameters")
    page.fill("#parameter-filter", "smc_k")
    page.fill("#parameters tbody tr:not([hidden]) input", "900")
    visitor.press("#apply-parameters")
    assert visitor.notice() == ""
    visitor.run(0.1)
    assert bench.drive.state == "run"  # a tunable one
    page.fill("#parameters tbody tr:not([hidden]) input", "1e6")
    visitor.press("#apply-parameters")
    assert "smc_k 1e+06: must be 0 to 10000 1/s" in visitor.notice()

    visitor.tab("Faults")
    page.select_option("#fault-kind", "current_sensor_high_rail")
    page.select_option("#fault-phase", "b")
    visitor.press("#fault-form button:text-is('Begin')")
    visitor.run(0.1)
    assert bench.drive.state == "fault" and page.inner_text("#state") == "fault"
    assert page.inner_text("#fault") == bench.drive.fault.replace("_", " ") != "none"
    bench.fault("winding_open", phase="a")  # by another client of the bench
    visitor.run(0.1)
    listed = page.locator("#active-faults li")
    assert listed.all_inner_texts() == ["current sensor high rail b End", "winding open a End"]
    visitor.press("#active-faults li:has-text('winding open') button")
    visitor.run(0.01)
    visitor.wait("document.querySelectorAll('#active-faults li').length === 1")
    assert listed.all_inner_texts() == ["current sensor high rail b End"]
    visitor.press("#end-faults")
    visitor.run(0.01)
    visitor.wait("document.querySelectorAll('#active-faults li').length === 0")
    assert page.is_visible("#no-active-faults")
    visitor.tab("Record")
    visitor.press("#read-record")
    assert visitor.ask("document.querySelectorAll('#record .uplot').length") == 4
    assert len(page.query_selector_all("#fault-log tbody tr")) == 1
    assert nothing_is_cut_off(page) == []
    page.screenshot(path=picture("record"))
    page.click("#record button")
    visitor.tab("Faults")
    visitor.press("#clear-fault-2")
    visitor.run(0.1)
    assert bench.drive.state == "ready" and page.inner_text("#state") == "ready"
    assert bench.drive.parameters["smc_k"] == 900

    visitor.tab("Run")
    page.fill("#load-torque", "0")
    visitor.press("#load-form button")
    page.fill("#torque-reference", "3")
    visitor.press("#torque-form button")
    visitor.run(0.1)
    assert bench.drive.state == "run" and bench.drive.mode == "torque"
    page.keyboard.press("Escape")
    visitor.finish()
    visitor.run(0.6)
    assert bench.drive.state == "ready"

    page.keyboard.press("p")
    assert visitor.ask("salient.timeline.held")
    with page.expect_download() as download:
        page.click("#export")
    lines = download.value.path().read_text().splitlines()
    head = lines[0].split(",")
    assert head[:2] == ["time_s", "DRIVE_MOTION.speed_rpm (r/min)"]
    exported = {float(line.split(",")[0]): line.split(",")[1] for line in lines[1:]}
    times = sorted(time for time, value in exported.items() if value)
    assert 990 <= len(times) <= 1001 and {round((b - a) * 1e3) for a, b in pairwise(times)} == {1}
    assert float(exported[times[-1]]) == pytest.approx(bench.telemetry["speed_rpm"].last, abs=1e-6)


@pytest.mark.in_turns
def test_values_with_names_are_shown_chosen_triggered_and_exported_by_them(live):
    visitor, bench, page = live(), live.bench, None
    page = visitor.page
    visitor.take_command()
    visitor.tab("Parameters")
    visitor.press("#read-parameters")
    for name, names in CHOICES.items():
        field = page.locator(f"#parameters select[aria-label='{name}']")
        assert field.locator("option").all_inner_texts() == list(names)
        assert field.input_value() == value_name(name, bench.drive.parameters[name])
    assert page.locator("#parameters select").count() == len(CHOICES)
    page.select_option("#parameters [aria-label=controller]", "paper")
    page.select_option("#parameters [aria-label=bp_mode]", "fixed_gains")
    assert page.locator("#parameters tr.changed").count() == 2
    visitor.press("#apply-parameters")
    assert visitor.notice() == "" and page.is_disabled("#apply-parameters")
    assert (bench.drive.parameters["controller"], bench.drive.parameters["bp_mode"]) == (1, 1)
    visitor.tab("Run")
    visitor.press("#speed-form button")
    visitor.run(0.1)
    visitor.tab("Parameters")
    page.select_option("#parameters [aria-label=controller]", "traditional")
    visitor.press("#apply-parameters")
    assert visitor.notice() == "set parameters: controller traditional: not_while_running"
    with pytest.raises(DriveError, match="^controller 7: must be traditional, paper or salient$"):
        bench.drive.parameters["controller"] = 7

    # A drive of a later version may have a value that is not in the table.
    page.evaluate("""() => { const { command } = salient.source;
        salient.source.command = async (name, args) => name !== "parameters" ? command.call(salient.source, name, args)
            : { ok: true, message: "", value: [{ name: "bp_mode", unit: "", minimum: 0, maximum: 9, value: 7 }] }; }""")
    page.click("#read-parameters")
    visitor.wait("document.querySelectorAll('#parameters tbody tr').length === 1")
    assert page.locator("#parameters select").input_value() == "7" and page.is_disabled("#apply-parameters")

    page.evaluate("() => salient.choose(['DRIVE_STATUS.state', 'DRIVE_STATUS.controller'])")
    page.click("#trigger summary")
    assert page.is_hidden("#trigger-level")
    page.select_option("#trigger-choice", "ready")
    page.select_option("#trigger-mode", "single")
    page.click("#trigger summary")
    visitor.tab("Run")
    visitor.press("#off")
    visitor.run(1.0)
    assert bench.drive.state == "ready"
    states = bench.telemetry["DRIVE_STATUS.state"]
    stopped_s = states.time_s[np.flatnonzero(states.value == 2)[-1] + 1]
    assert 0 <= stopped_s - visitor.ask("salient.trigger.shown_ns") / 1e9 < 0.002
    assert page.locator(".legend output").all_inner_texts() == ["ready", "paper"]
    assert visitor.ask("salient.charts.plots[0].stateName(1)") == "ready"
    assert visitor.ask("salient.charts.plots[0].stateName(9)") == ""
    with page.expect_download() as download:
        page.click("#export")
    rows = [line.split(",")[1:] for line in download.value.path().read_text().splitlines()[1:]]
    assert {("run", "paper"), ("ready", "paper")} <= {tuple(row) for row in rows}
    assert {value for row in rows for value in row} <= {"run", "ready", "paper", "salient"}


@pytest.mark.in_turns
def test_cursors_trigger_and_the_part_that_is_dragged(live):
    visitor = live()
    visitor.take_command()
    visitor.page.click("#trigger summary")
    visitor.page.select_option("#trigger-signal", "DRIVE_MOTION.speed_rpm")
    visitor.page.fill("#trigger-level", "100")
    visitor.page.select_option("#trigger-mode", "single")
    visitor.page.click("#trigger summary")
    visitor.page.select_option("#window", "0.1")
    visitor.press("#speed-form button")
    visitor.run(0.4)
    crossing = visitor.ask("salient.trigger.shown_ns")
    speed = live.bench.telemetry["speed_rpm"]
    expected_s = speed.time_s[np.argmax(speed.value >= 100)]
    assert 0 <= expected_s - crossing / 1e9 < 0.002  # the telemetry is sent after its values were read
    assert visitor.ask("salient.timeline.start_ns") == pytest.approx(crossing - 0.02e9, abs=10)
    visitor.tab("Cursors")
    box = visitor.page.locator("#charts .u-over").first.bounding_box()
    middle = box["y"] + box["height"] / 2
    for part in (0.25, 0.8, 0.75):  # A, B, and the nearer one again
        visitor.page.mouse.click(box["x"] + box["width"] * part, middle)
    difference = visitor.page.inner_text("#cursors tbody tr:first-child td:last-child")
    assert float(difference.removesuffix(" ms")) == pytest.approx(50, abs=0.5)
    visitor.page.mouse.move(box["x"] + box["width"] * 0.4, middle)
    visitor.page.mouse.down()
    visitor.page.mouse.move(box["x"] + box["width"] * 0.6, middle)
    visitor.page.mouse.up()
    assert visitor.ask("salient.timeline.window_ns") == pytest.approx(0.02e9, rel=0.03)


@pytest.mark.in_turns
def test_a_second_commanding_page_is_refused_with_a_message(live):
    first, second = live(), live()
    first.take_command()
    second.press("#take")
    assert "another page commands this drive" in second.notice()
    assert second.ask("salient.act('speed_reference', {rpm: 600})") == {
        "ok": False, "message": "this page does not command: take command first"}
    first.run(0.1)
    assert live.bench.drive.state == "ready"
    first.press("#take")  # releases
    second.take_command()


@pytest.mark.in_turns
def test_a_page_that_falls_asleep_lets_the_command_time_out_and_the_drive_stops(live):
    sleeper, watcher, bench = live(), live(), live.bench
    sleeper.take_command()
    sleeper.press("#speed-form button")
    for _ in range(20):
        bench.run_for(STEP_S)
        sleeper.catch_up()
        watcher.catch_up()
    assert bench.drive.state == "run" and bench.truth["speed_rpm"].last > 500
    sleeper.page.evaluate("() => { globalThis.requestAnimationFrame = () => 0; }")  # as a hidden page
    watcher.run(1.7)  # the server follows
    assert bench.drive.state == "fault" and bench.drive.fault == "command_timeout"
    assert watcher.ask("salient.lease") == "free"
    assert "this page slept" in sleeper.notice()


@pytest.mark.in_turns
def test_a_page_that_is_closed_lets_the_command_time_out(live):
    closed, watcher, bench = live(), live(), live.bench
    closed.take_command()
    closed.press("#speed-form button")
    closed.run(0.4)
    assert bench.drive.state == "run"
    closed.page.close()
    watcher.wait("salient.lease === 'free'")
    watcher.run(0.7)
    assert bench.drive.fault == "command_timeout"


def _address(link):
    return link.replace("http:", "ws:").replace("/?", "/frames?")


def _origin(link):
    return link.split("/?")[0]


@pytest.mark.in_turns
@pytest.mark.parametrize("wrong", ["origin", "no origin", "token", "no token"])
def test_neither_a_foreign_origin_nor_a_page_without_the_token_is_served(live, wrong):
    address, origin = _address(live.link), _origin(live.link)
    if wrong == "token":
        address += "x"
    elif wrong == "no token":
        address = address.split("?")[0]
    foreign = {"origin": "http://127.0.0.1:1", "no origin": None}.get(wrong, origin)
    with pytest.raises(InvalidStatus) as refused:
        connect(address, origin=foreign, proxy=None)
    assert refused.value.response.status_code == 403
    with connect(_address(live.link), origin=origin, proxy=None) as accepted:
        assert "info" in json.loads(accepted.recv())


@pytest.mark.in_turns
def test_a_page_of_another_origin_can_neither_command_nor_read_even_with_the_token(browser, live):
    class Foreign(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Foreign) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{server.server_address[1]}/")
        result = page.evaluate("""async ([link, address]) => {
            const socket = await new Promise((done) => {
                const tried = new WebSocket(address);
                tried.onopen = () => done("open");
                tried.onmessage = () => done("read");
                tried.onerror = () => done("refused");
            });
            const read = await fetch(link).then(() => "read", () => "refused");
            return [socket, read];
        }""", [live.link, _address(live.link)])
        page.close()
        server.shutdown()
    assert result == ["refused", "refused"]


@pytest.mark.parametrize(("path", "status"), [
    ("/main.js", 200), ("/look.css", 200), ("/%00", 404), ("/main.js%00", 404), ("/..%2fserver.py", 404),
    ("//etc/passwd", 404), ("/vendor", 404), (f"/{'x' * 300}", 404), (f"/{'x' * 5000}", 404), (f"/{'a/' * 3000}b", 404),
    ("/%ff%fe", 404)])
def test_a_path_that_is_no_file_of_the_page_is_not_found_and_leaves_no_traceback(no_feed, path, status):
    link, errors = no_feed
    connection = http.client.HTTPConnection(_origin(link).removeprefix("http://"))
    connection.request("GET", path)
    assert connection.getresponse().status == status
    connection.close()
    assert errors() == ""


def test_more_pages_than_are_served_at_once_are_refused_with_the_reason_until_one_is_closed(no_feed):
    link, errors = no_feed
    open_page = functools.partial(connect, _address(link), origin=_origin(link), proxy=None)
    with ExitStack() as stack:
        pages = [stack.enter_context(open_page()) for _ in range(PAGES_MAX)]
        for page in pages:
            assert "info" in json.loads(page.recv())
        for _ in range(2):
            with open_page() as refused, pytest.raises(ConnectionClosedError) as closed:
                refused.recv()
            told = closed.value.rcvd
            assert (told.code, told.reason) == (1013, f"{PAGES_MAX} pages are open, and there are no more than that: "
                                                      "close one")
        pages.pop().close()
        with open_page() as accepted:
            assert "info" in json.loads(accepted.recv())
    assert errors() == ""


MALFORMED = [
    "", "{", "[]", "null", "7", "[" * 100_000 + "]", '{"shown": "x"}', '{"shown": NaN}', '{"shown": -1}',
    '{"shown": 1, "more": 2}', '{"n": 1, "name": "speed_reference", "args": {}}',
    '{"n": 1, "name": "speed_reference", "args": {"rpm": "600"}}',
    '{"n": 1, "name": "speed_reference", "args": {"rpm": 1e999}}',
    '{"n": 1, "name": "speed_reference", "args": {"rpm": true}}',
    f'{{"n": 1, "name": "speed_reference", "args": {{"rpm": 1{"0" * 400}}}}}', f'{{"shown": 1{"0" * 400}}}',
    '{"n": 1, "name": "speed_reference", "args": {"rpm": 600, "more": 1}}',
    '{"n": 1, "name": "__init__", "args": {}}', '{"n": "1", "name": "stop", "args": {}}',
    '{"n": 1, "name": ["stop"], "args": {}}', '{"n": 1, "name": "stop", "args": []}',
    '{"n": 1, "name": "set_parameters", "args": {"values": {"torque_max_Nm": "9"}}}', b"\0\1\2",
]


@pytest.mark.parametrize("number", [10**400, -(10**400), float("nan"), float("inf")])
def test_a_number_that_no_float_has_is_malformed(number):
    with pytest.raises(Malformed):
        check_command("speed_reference", {"rpm": number})


@pytest.mark.in_turns
def test_malformed_messages_are_counted_and_dropped(live):
    visitor = live()
    visitor.take_command()
    messages = [message for message in MALFORMED if len(message) < 60_000]
    with connect(_address(live.link), origin=_origin(live.link), proxy=None) as rude:
        for message in messages:
            rude.send(message)
        visitor.wait(f"salient.malformed === {len(messages)}")
    visitor.press("#speed-form button")
    visitor.run(0.2)
    assert live.bench.drive.state == "run"


@pytest.mark.in_turns
def test_a_failure_folder_is_replayed_with_its_machine_and_its_values(browser, make_bench, serve, tmp_path):
    bench = make_bench(machine="linear_trapezoid")
    bench.drive.speed_reference_rpm = 600
    bench.at(0.3).load_torque_Nm = 6
    bench.run_for(0.5)
    failure.save(bench, tmp_path / "0", {"replay": "pytest"}, bench.options)
    visitor = Visitor(browser, serve("--replay", tmp_path))
    visitor.wait(f"salient.store.frames >= {len(bench.log)}")
    page = visitor.page
    assert page.inner_text("#machine-name") == "linear_trapezoid"
    assert page.locator("#take").is_hidden() and page.locator("[role=tab]").all_inner_texts() == ["Stimulus", "Signals",
                                                                                                   "Bus", "Cursors"]
    assert page.locator("#stimuli tbody tr").all_inner_texts() == [
        "1\t0.000000 s\trun in speed mode, speed_reference_rpm = 600 r/min",
        "2\t0.300000 s\tload_torque_Nm = 6 N m (scheduled at 0.000000 s)"]
    page.click("#stimuli tbody tr:nth-child(2) button")
    visitor.wait("salient.timeline.start_ns < 3e8 && salient.timeline.end_ns > 3e8")
    page.focus("#scrub")
    page.keyboard.press("Home")
    visitor.wait("salient.timeline.end_ns === salient.first_ns()")
    page.keyboard.press("End")
    visitor.wait("salient.timeline.end_ns === salient.store.last_ns")
    speed = page.inner_text(".legend li:first-child output")
    assert float(speed.split()[0]) == pytest.approx(bench.telemetry["speed_rpm"].last, abs=1e-9)
    page.click("#pause")  # plays it from its beginning
    visitor.wait("salient.timeline.end_ns < salient.store.last_ns")
    visitor.wait("!salient.timeline.playing")  # at its end
    assert visitor.ask("salient.store.watch('DRIVE_TORQUE.torque_estimate_Nm').size") == (
        bench.telemetry.count("DRIVE_TORQUE"))
    assert nothing_is_cut_off(page) == []
    page.screenshot(path=picture("replay"))
    page.close()
    assert visitor.errors == []


def test_a_log_alone_has_what_was_done(bench, tmp_path):
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.05)
    bench.fault("winding_open", phase="b")
    bench.run_for(0.02)
    write_logs(bench.log, tmp_path / "can.blf")
    found = LogFeed(tmp_path / "can.blf", Carrier("can.blf", str(bench.options.machine)), 0).info["stimuli"]
    assert [act["text"] for act in found] == ["run in speed mode, speed_reference_rpm = 300 r/min",
                                              "fault winding_open begins, phase b"]
    assert [act["time_s"] for act in found] == pytest.approx([0.0, 0.05], abs=1e-3)


@pytest.mark.in_turns
def test_every_tab_is_readable_on_a_phone(live):
    visitor = live(width=390, height=844)
    visitor.take_command()
    visitor.press("#speed-form button")
    visitor.page.select_option("#rotor", "step")
    visitor.run(0.4)
    assert nothing_is_cut_off(visitor.page) == []
    visitor.page.evaluate("() => scrollTo(0, 0)")
    visitor.page.screenshot(path=picture("phone"), full_page=True)
    for name in visitor.page.locator("[role=tab]").all_inner_texts():
        visitor.tab(name)
        assert nothing_is_cut_off(visitor.page) == [], name


@pytest.mark.in_turns
def test_the_end_of_the_drive_is_said(live):
    visitor = live()
    live.bench.simulator.close()
    visitor.wait("document.getElementById('notice').textContent.includes('the drive has ended')")


@pytest.mark.in_turns
def test_another_dbc_than_that_of_the_drive_is_said_and_no_reference_sent(browser, live, serve):
    visitor = Visitor(browser, serve("--can", live.bench.address, "--machine",
                                     ROOT / "tools/examples/machines/fan12.toml"), live.bench)
    live.bench.run_for(0.2)
    visitor.catch_up()
    visitor.wait("document.getElementById('notice').textContent.includes('another machine than fan12')")
    visitor.take_command()
    visitor.press("#speed-form button")
    assert "the drive carries saturating" in visitor.notice()
    assert "a reference would be another one" in visitor.notice()
    visitor.run(0.1)
    assert live.bench.drive.state == "ready"
    visitor.page.close()


@pytest.mark.in_turns
def test_the_page_decodes_every_signal_as_cantools_does(live):
    visitor = live()
    random_ = random.Random(5)
    frames, expected = [], []
    for database in (drive_database(), rig_database()):
        for message in database.messages:
            for _ in range(20):
                data = random_.randbytes(message.length)
                try:
                    decoded = message.decode(data, decode_choices=False, scaling=True)
                except DecodeError:  # the multiplexer has a value that selects nothing
                    continue
                identifier = message.frame_id | (EXTENDED if message.is_extended_frame else 0)
                frames.append([identifier, list(data.ljust(8, b"\0"))])
                expected.append({name: float(value) for name, value in decoded.items()})
    decoded = visitor.page.evaluate("""async (frames) => {
        const { decoderOf, presenceOf } = await import("/decoder.js");
        const messages = new Map(salient.info.databases.map((message) => [message.id, message]));
        return frames.map(([id, data]) => {
            const [low, high] = new Uint32Array(new Uint8Array(data).buffer);
            const message = messages.get(id);
            return Object.fromEntries(message.signals.filter((signal) => presenceOf(message, signal)(low, high))
                .map((signal) => [signal.name, decoderOf(signal)(low, high)]));
        });
    }""", frames)
    assert len(frames) > 500
    for found, wanted in zip(decoded, expected, strict=True):
        assert found.keys() == wanted.keys()
        for name, value in wanted.items():
            assert found[name] == pytest.approx(value, rel=1e-12, nan_ok=True), name


@pytest.mark.in_turns
def test_buffer_of_the_drive_is_armed_read_and_shown_with_cursors_and_spectrum(live):
    visitor = live()
    page, bench = visitor.page, visitor.bench
    visitor.take_command()
    page.fill("#speed-reference", "300")
    visitor.press("#speed-form button")
    visitor.run(0.3)
    visitor.tab("Scope")
    page.fill("#scope-signals", "torque_reference_Nm, state current_a_A")
    assert "dc_link_voltage_V" in (visitor.finish() or page.inner_text("#scope-names"))
    page.fill("#scope-trigger", "torque_reference_Nm >> 5")
    visitor.press("#scope-form button")
    assert "trigger 'torque_reference_Nm >> 5': must be" in visitor.notice()
    page.fill("#scope-trigger", "torque_reference_Nm > 5")
    visitor.press("#scope-form button")
    visitor.run(0.1)
    assert "Waits" in page.inner_text("#scope-state") and not page.is_visible("#recording")
    assert nothing_is_cut_off(page) == []
    bench.load_torque_Nm = 8
    for _ in range(2000):
        bench.run_for(0.005)
        visitor.catch_up()
        if page.is_visible("#recording"):
            break
    assert page.inner_text("#recording-title") == "The drive's buffer: torque_reference_Nm > 5"
    assert visitor.ask("document.querySelectorAll('#recording .uplot').length") == 3
    assert page.is_enabled("#stop")
    plots = page.query_selector_all("#recording .u-over")
    for part in (0.2, 0.8):
        box = plots[0].bounding_box()
        page.mouse.click(box["x"] + part * box["width"], box["y"] + box["height"] / 2)
    rows = [[cell.inner_text() for cell in row.query_selector_all("th, td")]
            for row in page.query_selector_all("#recording-cursors tbody tr")]
    assert [row[0] for row in rows] == ["time, ms", "torque_reference_Nm, N m", "state", "current_a_A, A"]
    at_ms = [float(text.replace("−", "-")) for text in rows[0][1:]]
    assert at_ms[0] < 0 < at_ms[1] and at_ms[2] == pytest.approx(at_ms[1] - at_ms[0], abs=1e-3)
    torque_Nm = [float(text.replace("−", "-")) for text in rows[1][1:]]
    assert torque_Nm[0] <= 5 < torque_Nm[1] and rows[2][1:] == ["run", "run", "–"]
    assert nothing_is_cut_off(page) == []
    page.screenshot(path=picture("scope"))
    page.click("#recording-spectrum")
    assert visitor.ask("document.querySelectorAll('#recording .uplot').length") == 2
    page.screenshot(path=picture("spectrum"))
    page.keyboard.press("Escape")
    visitor.run(0.3)
    assert bench.drive.state == "ready"
    page.click("#recording-close")
    assert not page.is_visible("#recording") and visitor.errors == []


def test_reading_of_the_buffer_begins_anew_after_an_error(monkeypatch):
    class Buffer:
        calls = 0

        def is_complete(self):
            return True

        def parts(self, _):
            Buffer.calls += 1
            yield None
            raise DriveError("the drive has restarted")

    link = SimpleNamespace(kept_log=nullcontext)
    commander = Commander(link)
    monkeypatch.setattr(commander, "_scope", Buffer())
    for call in (1, 2):
        assert commander.execute("scope_read", {})["value"] == {"state": "reads"}
        assert commander.execute("scope_read", {}) == {"ok": False, "message": "the drive has restarted"}
        assert Buffer.calls == call


def test_spectrum_has_the_amplitudes_of_sines(live):
    visitor = live()
    random_ = np.random.default_rng(5)
    for size in (2, 3, 64, 585, 1024):
        values = random_.normal(size=size)
        found = visitor.page.evaluate("async ([values, step]) => (await import('/scope.js')).spectrum(values, step)",
                                      [values.tolist(), 1e-4])
        used = 2 ** int(math.log2(size))
        part = values[:used] - np.mean(values[:used])
        lines = np.abs(np.fft.rfft(part * (1 - np.cos(2 * np.pi * np.arange(used) / used)))) / used
        lines[1:-1] *= 2
        assert found["amplitude"] == pytest.approx(lines, abs=1e-12)
        assert found["frequency_Hz"] == pytest.approx(np.fft.rfftfreq(used, 1e-4))
    time_s = np.arange(1024) * 1e-4
    sine = 3 + 2 * np.sin(2 * np.pi * 16 / 0.1024 * time_s)
    found = visitor.page.evaluate("async (values) => (await import('/scope.js')).spectrum(values, 1e-4)", sine.tolist())
    assert max(found["amplitude"]) == pytest.approx(2, rel=1e-9)


@pytest.mark.in_turns
def test_the_commands_of_the_server_are_those_of_the_interface(live):
    visitor = live()
    names = visitor.page.evaluate("async () => Object.keys((await import('/source.js')).COMMANDS)")
    assert {"take", "release", *COMMANDS} <= set(names)
    assert visitor.ask("salient.info.commands") == ["take", "release", *COMMANDS]


def test_flux_linkage_of_the_page_is_that_of_the_machine():
    machine = description("saturating", 0)["machine"]
    rows = np.array(machine["flux_map"]["flux_linkage_Wb"])
    assert rows.shape == (len(machine["flux_map"]["current_A"]), len(machine["flux_map"]["angle_deg"]))
    assert rows[0] == pytest.approx(0, abs=1e-12) and rows[:, 0] == pytest.approx(rows[:, -1])
    aligned, unaligned = rows[1, 0], rows[1, len(rows[0]) // 2]
    current_A = machine["flux_map"]["current_A"][1]
    assert unaligned / current_A == pytest.approx(0.67e-3, rel=1e-4)
    assert 0.9 < aligned / current_A / 23.6e-3 < 1.0


@pytest.mark.parametrize(("options", "text"), [
    (["--replay", "nothing.blf"], "--replay nothing.blf: No such file or directory"),
    (["--replay", "."], "--replay .: a folder must have can.blf, as that of a failed test has"),
    (["--replay", "x.pcap"], "--replay x.pcap: the suffix must be .asc, .blf, .csv, .db, .log, .mf4, .trc or .txt"),
    (["--can", "unix:nowhere"], "unix:nowhere: no drive answers there (No such file or directory)"),
    (["--can", "unix:nowhere", "--machine", "nothing"], "machine 'nothing': no such file"),
])
def test_a_wrong_option_is_one_line_and_exit_code_2(salient_without_build, options, text):
    done = salient_without_build("view", *options)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert done.stderr.startswith(f"salient: {text}")


def test_frames_of_a_bus_without_virtual_time_get_that_of_the_drive():
    from salient.view.link import DriveTime

    clock = DriveTime(drive_database())
    other = can.Message(arbitration_id=0x181, is_extended_id=False, data=bytes(8))

    def status(time_us):
        return can.Message(arbitration_id=0x180, is_extended_id=False,
                           data=(time_us % 2**32).to_bytes(4, "little") + bytes(4))

    assert clock.time_ns(7_000, other) is None  # nothing is known yet
    before_us = 2**32 - 1_000
    assert clock.time_ns(10**18, status(before_us)) == before_us * 1000
    assert clock.time_ns(10**18 + 40_000, other) == before_us * 1000 + 40_000
    assert clock.time_ns(10**18 + 2 * 10**6, status(2**32 + 1_000)) == (2**32 + 1_000) * 1000  # a wrap
    assert clock.starts == 0
    assert clock.time_ns(10**18 + 10**9, status(500)) == (2**32 + 500) * 1000  # another start of the drive
    assert clock.starts == 1


def test_time_of_a_link_without_virtual_time_is_that_of_the_drive_also_after_a_reset(monkeypatch):
    class Bus:
        """A SocketCAN interface, of which all frames have come at Unix times."""

        def __init__(self):
            self.frames, self.sent = [], []

        def recv(self, timeout):
            return self.frames.pop(0) if self.frames else None

        def send(self, message, timeout=None):
            self.sent.append(message)

    bus = Bus()
    monkeypatch.setattr(view_link, "open_bus", lambda address: bus)
    link = view_link.Link("socketcan:can0", "saturating", 0, FrameStore(), TrafficFeed(Traffic(BitRates(1_000_000))))

    def receive(time_us, unix_s):
        """A frame without a time of the drive, and one with it."""
        data = time_us.to_bytes(4, "little") + bytes(4)
        bus.frames += [can.Message(timestamp=unix_s, arbitration_id=0x181, is_extended_id=False, data=bytes(8)),
                       can.Message(timestamp=unix_s, arbitration_id=0x180, is_extended_id=False, data=data)]
        while link._receive(0.0) is not None:
            pass

    bus.frames += [can.Message(timestamp=1.6e9, arbitration_id=0x181, is_extended_id=False, data=bytes(8))] * 3
    while link._receive(0.0) is not None:
        pass
    assert link.time_ns == 0 and link.telemetry.count("DRIVE_MOTION") == 0  # not Unix time
    receive(5_000_000, 1.6e9)
    assert link.time_ns == 5_000_000_000
    link.take_shown(link.time_ns)
    link.drive.stop()
    receive(5_020_000, 1.6e9 + 0.02)
    assert len(bus.sent) == 2 and link.time_ns == 5_020_000_000
    receive(1_000, 1.6e9 + 0.1)  # after a reset
    assert link.time_ns == link.shown_ns == 1_000_000
    receive(21_000, 1.6e9 + 0.12)
    assert len(bus.sent) >= 4  # commands go on at once, not when the drive's time is what it was
    link.take_shown(5_000_000_000)  # a page that has not seen the reset yet
    receive(1_500_000, 1.6e9 + 1.6)
    assert link.drive.command_due_ns is None  # and that sleeps from here on
    starts = [can.Message(timestamp=1.6e9 + 2, arbitration_id=0x180, is_extended_id=False, data=bytes(8))]
    bus.frames += starts
    with pytest.raises(DriveError, match="the drive has restarted"):
        link.advance_to(10**12)
