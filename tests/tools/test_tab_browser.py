"""The drive in a browser tab as a person has it: one file, opened from the disk in Chromium without a network."""

from __future__ import annotations

import re

import pytest

from salient.paths import BUILD
from salient.tab import file as tab_file
from salient.tab.build_id import build_id

pytestmark = pytest.mark.in_turns

PICTURES = BUILD / "view"
BITS = "events=0.02:speed_reference:rpm=300;0.1:load_torque:Nm=3"


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    path = tmp_path_factory.mktemp("tab") / "tab.html"
    assert tab_file.run(path, None) == 0
    return path.as_uri()


@pytest.fixture
def open_page(browser):
    """Opens an address without a network; no page may fail or ask for anything."""
    contexts, wrong = [], []

    def start(address, width=1280, height=800):
        context = browser.new_context(viewport={"width": width, "height": height}, offline=True)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(0)  # the run is in virtual time; a loaded computer is slow
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
        page.on("request", lambda request: None if request.url.split("#")[0] in (address.split("#")[0], "data:,")
                or request.url.startswith(("data:", "blob:")) else wrong.append(request.url))
        page.goto(address)
        page.wait_for_function("globalThis.salient || !document.getElementById('notice').hidden")
        return page

    yield start
    for context in contexts:
        context.close()
    assert wrong == []


def wait_until(page, time_s):
    page.wait_for_function(f"salient.source.run.timeNs >= {time_s * 1e9}")


def notice(page):
    return page.locator("#notice").inner_text()


def hash_at(page, time_s):
    """Bits of the run at a time, where it then stands still."""
    return page.evaluate(f"salient.stopped || salient.stopTime(), salient.source.run.advanceTo({time_s * 1e9}),"
                         " salient.source.run.world.hash")


def last(page, name):
    return page.evaluate(f"salient.store.watch('{name}').last")


def test_opened_from_the_disk_the_machine_turns_by_itself(tab, open_page):
    page = open_page(tab)
    wait_until(page, 0.5)
    assert page.locator("#state").inner_text() == "run"
    assert last(page, "RIG_TRUTH_MOTION.speed_rpm") == pytest.approx(300, abs=3)
    assert page.evaluate("salient.store.lost") == 0


def test_commands_act_on_the_drive_and_refusals_are_said(tab, open_page):
    page = open_page(tab)
    wait_until(page, 0.2)
    page.fill("#load-torque", "5")
    page.click("#load-form button")
    page.fill("#speed-reference", "450")
    page.click("#speed-form button")
    page.wait_for_function("salient.store.watch('DRIVE_MOTION.speed_rpm').last > 448")
    assert last(page, "RIG_TRUTH_BENCH.load_torque_Nm") == pytest.approx(5)
    page.fill("#speed-reference", "1e6")
    page.click("#speed-form button")
    page.wait_for_function("!document.getElementById('notice').hidden")
    assert re.match(r"speed reference: speed_reference_rpm 1000000: must be -?\d+", notice(page))
    page.get_by_role("tab", name="Parameters").click()
    page.click("#read-parameters")
    page.wait_for_function("document.querySelectorAll('#parameters tbody tr').length > 40")
    page.get_by_role("tab", name="Faults").click()
    page.select_option("#fault-kind", "winding_open")
    page.click("#fault-form button")
    page.wait_for_function("document.getElementById('state').textContent === 'fault'")
    assert page.locator("#fault").inner_text() == "phase open"
    page.get_by_role("tab", name="Record").click()
    page.click("#read-record")
    page.wait_for_function("document.querySelectorAll('#fault-log tbody tr').length === 1")


def test_scope_reads_the_buffer_of_the_drive_in_the_tab(tab, open_page):
    page = open_page(tab)
    wait_until(page, 0.3)
    page.get_by_role("tab", name="Scope").click()
    page.fill("#scope-signals", "torque_reference_Nm, state control.duty_q15[0]")
    page.fill("#scope-trigger", "torque_reference_Nm > x")
    page.click("#scope-form button")
    page.wait_for_function("!document.getElementById('notice').hidden")
    assert "must be a number" in notice(page)
    page.fill("#scope-trigger", "torque_reference_Nm rises to 3")
    page.click("#scope-form button")
    page.wait_for_function("document.getElementById('scope-state').textContent.startsWith('Waits')")
    assert "torque_reference_Nm" in page.locator("#scope-names").inner_text()
    page.evaluate("salient.act('load_torque', { Nm: 5 })")
    page.wait_for_function("document.getElementById('recording').open")
    assert page.locator("#recording-title").inner_text().endswith("torque_reference_Nm rises to 3")
    assert page.locator("#recording-plots canvas").count() == 3
    page.screenshot(path=PICTURES / "tab_scope.png")


def test_rewound_and_replayed_the_run_has_the_same_bits_and_another_branch_is_beside_it(tab, open_page):
    page = open_page(f"{tab}#{BITS}&until=0.35")
    page.wait_for_function("salient.stopped")
    first = hash_at(page, 1.2)
    page.get_by_role("button", name="−1 s").click()
    assert page.evaluate("salient.source.run.timeNs") == pytest.approx(0.2e9, abs=1e6)
    page.get_by_role("button", name="Freeze").click()  # it goes on
    wait_until(page, 1.2)
    page.wait_for_function("document.getElementById('notice').textContent.includes('The same bits at 1.200 s')")
    assert hash_at(page, 1.5) != first
    page.get_by_role("button", name="−1 s").click()
    page.fill("#load-torque", "9")
    page.click("#load-form button")
    assert hash_at(page, 1.2) != first
    page.evaluate("salient.source.flush()")
    assert last(page, "RIG_TRUTH_BENCH.load_torque_Nm") == pytest.approx(9)
    page.screenshot(path=PICTURES / "tab.png")
    drawn = page.evaluate("""() => {
        const other = [];
        const { charts } = salient;
        const before = charts.onDraw;
        const stroke = CanvasRenderingContext2D.prototype.lineTo;
        charts.onDraw = (plot, list) => {
            let points = 0;
            CanvasRenderingContext2D.prototype.lineTo = function (x, y) { points += 1; stroke.call(this, x, y); };
            before(plot, list);
            CanvasRenderingContext2D.prototype.lineTo = stroke;
            other.push(points);
        };
        salient.draw(0);
        charts.plots.forEach(({ plot }) => plot.redraw(false));
        return new Promise((resolve) => setTimeout(() => resolve(other), 0));
    }""")
    assert max(drawn) > 500  # the branch that was left, a second at 1 kHz


def test_link_repeats_a_run_to_the_bit_in_another_tab_and_another_build_says_so(tab, open_page):
    page = open_page(f"{tab}#machine=linear_cosine&seed=4&{BITS}")
    wait_until(page, 0.2)
    page.evaluate("salient.act('load_torque', { Nm: 1.5 })")
    page.click("[data-world=pause]")
    page.get_by_role("button", name="Copy link").click()
    page.wait_for_function("location.hash.includes('&hash=')")
    link = page.evaluate("location.hash")
    assert f"build={build_id()}&machine=linear_cosine&seed=4&" in link
    assert link.count("load_torque") == 2
    again = open_page(tab + link)
    again.wait_for_function("document.getElementById('notice').textContent.includes('same bits')")
    assert "as when the link was made" in notice(again)
    assert again.evaluate("salient.stopped") is True
    other = open_page(tab + link.replace(build_id(), "0123456789ab").replace("seed=4", "seed=5"))
    other.wait_for_function("document.getElementById('notice').textContent.includes('ther bits at')")
    assert notice(other).endswith(f"the link is of build 0123456789ab, this is {build_id()}.")


def test_link_that_cannot_be_used_is_said_in_one_line(tab, open_page):
    assert "no machine 'none'" in notice(open_page(f"{tab}#machine=none"))
    assert notice(open_page(f"{tab}#sede=1")).startswith("The link has 'sede'; there are build, machine, events")
    assert "has no command 'jump'" in notice(open_page(f"{tab}#events=0.1:jump"))
    assert "--seed x: must be" in notice(open_page(f"{tab}#seed=x"))


def test_nothing_is_cut_off_on_a_desk_and_on_a_phone(tab, open_page):
    PICTURES.mkdir(parents=True, exist_ok=True)
    for name, width, height in (("tab_desk", 1280, 800), ("tab_phone", 390, 844)):
        page = open_page(f"{tab}#{BITS}", width, height)
        wait_until(page, 0.6)
        page.screenshot(path=PICTURES / f"{name}.png", full_page=True)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        controls = "button, select, input, output, label, canvas"
        outside = page.evaluate(f"""() => [...document.querySelectorAll("{controls}")]
            .filter((each) => each.checkVisibility() && each.getBoundingClientRect().right > innerWidth + 1)
            .map((each) => each.id || each.textContent)""")
        assert outside == []
