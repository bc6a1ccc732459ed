"""The first run of the live page: its steps by what the telemetry shows, in Node; in Chromium at a desk and on a phone,
with two drives on a bus, and in the tab."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest
from visitor import Visitor, nothing_is_cut_off, picture

from salient.bench import failure
from salient.tab import file as tab_file

SEEN = {"state": "ready", "check": "none", "lease": "yours", "reached": False, "loaded": False, "injected": False,
        "present": False, "degraded": False, "standsStill": False, "hasBench": True}
READY, RUN, FAULT = SEEN, {**SEEN, "state": "run"}, {**SEEN, "state": "fault"}
REACHED = {**RUN, "reached": True}
LOADED = {**REACHED, "loaded": True}
BROKEN = {**FAULT, "loaded": True, "injected": True, "present": True}
TEXT = "#first-run-text"


def steps(*visits: list[dict[str, Any]]) -> list[list[list[Any]]]:
    program = Path(__file__).with_name("first_run_steps.mjs")
    done = subprocess.run(["node", program], input=json.dumps(visits), capture_output=True, text=True, check=True)
    found: list[list[list[Any]]] = json.loads(done.stdout)
    return found


def test_steps_follow_the_telemetry_and_nothing_else():
    names = {
        "all in order": ([READY, RUN, REACHED, LOADED, BROKEN, {**BROKEN, "loaded": False}, {**FAULT, "injected": True},
                          READY, FAULT],
                         ["arm", "speed", "load", "fault", "clear", "clear", "clear", "", ""]),
        "time stands still": ([READY, READY, READY], ["arm", "arm", "arm"]),
        "runs already": ([REACHED], ["load"]),
        "runs under load already": ([LOADED], ["fault"]),
        "is in a fault already": ([{**BROKEN, "injected": False}, READY, RUN, REACHED, LOADED],
                                  ["clear", "arm", "speed", "load", "fault"]),
        "trips by itself": ([READY, RUN, FAULT, READY, RUN, REACHED],
                            ["arm", "speed", "clear", "arm", "speed", "load"]),
        "is stopped before the load": ([REACHED, READY, REACHED], ["load", "arm", "load"]),
        "another order": ([READY, BROKEN, {**READY, "injected": True}, REACHED, LOADED],
                          ["arm", "clear", "arm", "load", ""]),
        "no bench": ([{**READY, "hasBench": False}, {**RUN, "hasBench": False}, {**REACHED, "hasBench": False}],
                     ["arm", "speed", ""]),
        "no telemetry yet": ([{**SEEN, "state": ""}, READY], ["arm", "arm"]),
    }
    found = steps(*(seen for seen, _ in names.values()))
    for (name, (_, wanted)), visit in zip(names.items(), found, strict=True):
        assert [step for step, *_ in visit] == wanted, name


def test_each_line_is_short_and_says_what_stands_in_the_way():
    lines = [line for visit in steps(
        [{**SEEN, "state": ""}], [{**READY, "lease": "free"}], [{**READY, "lease": "other"}], [READY],
        [{**SEEN, "state": "initialise", "check": "under voltage"}], [{**SEEN, "state": "initialise"}],
        [{**RUN, "standsStill": True}], [RUN], [REACHED], [LOADED], [{**LOADED, "degraded": True}], [BROKEN],
        [{**BROKEN, "loaded": False}], [FAULT]) for _, _, line in visit]
    assert len(set(lines)) == len(lines) and max(map(len, lines)) <= 60
    assert lines[4] == "The drive does not start: under voltage."


@pytest.fixture
def visit(browser, make_bench, serve):
    """Opens a page on a bench, in a browser of its own that remembers; visit(bench, init=script, **size)."""
    visitors = []

    def start(bench, *options, init="", **size):
        bench.run_for(0.02)
        visitor = Visitor(browser, serve("--can", bench.address, *options), bench, init=init, **size)
        visitors.append(visitor)
        bench.run_for(0.12)
        visitor.catch_up()
        visitor.wait("true")
        return visitor

    yield start
    for visitor in visitors:
        visitor.page.close()
        assert visitor.errors == []


def line(visitor):
    visitor.wait("true")
    return visitor.page.inner_text(TEXT)


def target(visitor):
    """The text of the control that is marked; it is described by the line."""
    visitor.wait("true")
    return visitor.page.evaluate("""() => [...document.querySelectorAll(".next")].map((each) =>
        (each.getAttribute("aria-describedby") === "first-run-text" ? each.textContent : "not described")).join()""")


def covered(page):
    """Controls of which the line covers a part."""
    return page.evaluate("""() => [...document.querySelectorAll("button, select, input")].filter((each) => {
        if (!each.checkVisibility() || each.closest("#first-run")) { return false; }
        const { left, right, top, bottom } = each.getBoundingClientRect();
        return [0.1, 0.5, 0.9].some((x) => [0.1, 0.5, 0.9].some((y) => document.elementFromPoint(
            left + x * (right - left), top + y * (bottom - top))?.closest("#first-run")));
    }).map((each) => each.id || each.textContent)""")


@pytest.mark.in_turns
@pytest.mark.parametrize(("width", "height", "name"), [(1280, 800, "desk"), (390, 844, "phone")])
def test_a_person_follows_the_marked_controls_with_the_keyboard(visit, make_bench, width, height, name):
    bench = make_bench()
    visitor = visit(bench, width=width, height=height)
    page = visitor.page
    assert line(visitor) == "Step 1 of 5. Press Take command: one page commands a drive."
    assert page.get_attribute(TEXT, "aria-live") == "polite"

    def follow():
        """Goes to the control by the button of the line, and presses it."""
        assert covered(page) == [] and nothing_is_cut_off(page) == []
        page.focus("#first-run-go")
        page.keyboard.press("Enter")
        marked = target(visitor)
        assert page.evaluate("document.activeElement.classList.contains('next')"), marked
        page.keyboard.press("Enter")
        visitor.finish()
        visitor.run(0.06)  # the drive is armed by the response to its challenge
        return marked

    assert follow() == "Take command"
    assert line(visitor).startswith("Step 1 of 5. Press Run")
    assert follow() == "Run"
    assert line(visitor).startswith("Step 2 of 5.")
    page.screenshot(path=picture(f"first_run_{name}"))
    visitor.run(0.4)
    assert line(visitor).startswith("Step 3 of 5.") and follow() == "Apply"
    assert line(visitor).startswith("Step 4 of 5.") and target(visitor) == "Faults"
    assert follow() == "Begin"
    visitor.run(0.05)
    assert bench.drive.state == "fault"
    assert line(visitor) == "Step 5 of 5. Apply a load of 0: nothing holds the rotor against it."
    assert target(visitor) == "Run"
    page.click("#first-run-go")
    page.fill("#load-torque", "0")
    assert follow() == "Apply"
    assert line(visitor).startswith("Step 5 of 5. On Faults, press End") and follow() == "End"
    assert line(visitor).startswith("Step 5 of 5. Press Clear fault") and follow() == "Clear fault"
    visitor.run(0.05)
    assert bench.drive.state == "ready"
    assert line(visitor).startswith("Done.") and target(visitor) == "" and page.is_hidden("#first-run-go")
    page.reload()
    visitor.wait("globalThis.salient !== undefined")
    assert page.is_hidden("#first-run")
    page.click("#first-run-start")
    visitor.run(0.02)
    assert line(visitor).startswith("Step 1 of 5.")


@pytest.mark.in_turns
def test_closed_it_stays_closed_on_the_next_server_whose_port_is_another_one(visit, make_bench, serve):
    bench = make_bench()
    visitor = visit(bench)
    page = visitor.page
    page.click("#first-run-close")
    assert visitor.ask("document.activeElement.id") == "first-run-start" and target(visitor) == ""
    assert page.get_attribute("#first-run-start", "aria-expanded") == "false"
    page.goto(serve("--can", bench.address))
    visitor.wait("globalThis.salient !== undefined")
    assert page.is_hidden("#first-run")


@pytest.mark.in_turns
def test_without_any_storage_it_begins_at_each_visit_and_closes(visit, make_bench):
    visitor = visit(make_bench(), init="""
        const refuse = () => { throw new DOMException("refused", "SecurityError"); };
        Object.defineProperty(globalThis, "localStorage", { get: refuse });
        Object.defineProperty(document, "cookie", { get: refuse, set: refuse });""")
    assert line(visitor).startswith("Step 1 of 5.")
    visitor.page.click("#first-run-close")
    assert visitor.page.is_hidden("#first-run")
    visitor.page.reload()
    visitor.wait("globalThis.salient !== undefined")
    assert visitor.page.is_visible("#first-run")


@pytest.mark.in_turns
def test_of_two_drives_on_a_bus_the_page_follows_its_own(visit, make_bench):
    bench = make_bench(drives=2)
    bench.drives[1].speed_reference_rpm = 300
    bench.run_for(0.3)
    bench.rigs[1].load_torque_Nm = 3
    first, second = visit(bench, "--node", "0"), visit(bench, "--node", "1")
    assert line(first).startswith("Step 1 of 5.")
    assert line(second) == "Step 4 of 5. Press Take command: one page commands a drive."


@pytest.mark.in_turns
def test_a_drive_in_a_fault_is_cleared_first_and_a_log_has_no_first_run(visit, make_bench, serve, browser, tmp_path):
    bench = make_bench()
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.2)
    bench.fault("winding_open", phase="b")
    bench.run_for(0.1)
    assert bench.drive.state == "fault"
    visitor = visit(bench)
    visitor.take_command()
    assert line(visitor).startswith("Step 5 of 5.")
    failure.save(bench, tmp_path / "0", {"replay": "pytest"}, bench.options)
    log = Visitor(browser, serve("--replay", tmp_path))
    log.wait("salient.store.frames > 100")
    assert log.page.is_hidden("#first-run") and log.page.is_hidden("#first-run-start")
    log.page.close()
    assert log.errors == []


def test_in_the_tab_a_drive_that_turns_by_itself_is_loaded_next(browser, tmp_path):
    tab_file.run(tmp_path / "tab.html", None)
    page = browser.new_page(viewport={"width": 390, "height": 844})
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.set_default_timeout(0)  # the run is in virtual time; a loaded computer is slow

    def wait(text):
        page.wait_for_function(f"document.querySelector('{TEXT}').textContent.startsWith('{text}')")

    page.goto((tmp_path / "tab.html").as_uri())
    wait("Step 3 of 5. Press Apply")
    assert covered(page) == []
    page.click("#load-form .next")
    wait("Step 4 of 5.")
    page.click("#fault-panel-tab.next")
    page.click("#fault-form .next")
    wait("Step 5 of 5. Apply a load of 0")
    page.click("#run-panel-tab.next")
    page.fill("#load-torque", "0")
    page.click("#load-form .next")
    wait("Step 5 of 5. On Faults, press End")
    page.click("#fault-panel-tab.next")
    page.click("#active-faults .next")
    wait("Step 5 of 5. Press Clear fault")
    page.click("#clear-fault-2.next")
    wait("Done.")
    page.reload()
    page.wait_for_function("globalThis.salient && salient.drawn > 2")
    assert page.is_hidden("#first-run")
    page.close()
    assert errors == []
