"""A person with the live page in Chromium. Time is virtual: the drive waits until the page has shown what has come."""

from __future__ import annotations

import math

from salient.paths import BUILD

STEP_S = 0.04
"""Less than the time after which the drive misses the commands that the server repeats."""
PICTURES = BUILD / "view"
_SETTLING_FRAMES = 30
PATIENCE = 2000
"""Display frames in which a page does what it is asked."""


class Visitor:
    """A person with a page, and the bench whose drive the page shows."""

    def __init__(self, browser, link, bench=None, width=1280, height=800, init=""):
        # Playwright's own functions are evaluated from text, which the page's policy forbids.
        self.page = browser.new_page(bypass_csp=True, viewport={"width": width, "height": height},
                                     accept_downloads=True)
        self.bench = bench
        self.errors = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.add_init_script(init)
        self.page.goto(link)
        self.wait("globalThis.salient !== undefined")

    def ask(self, expression):
        return self.page.evaluate(f"() => {expression}")

    def wait(self, condition):
        for _ in range(PATIENCE):
            if self.page.evaluate(f"() => new Promise((done) => requestAnimationFrame(() => done({condition})))"):
                return
        raise AssertionError(f"not within {PATIENCE} display frames: {condition}")

    def catch_up(self):
        self.wait(f"salient.shown_ns >= {self.bench.log[-1][0]}")

    def run(self, duration_s, step_s=STEP_S):
        """Lets time pass in steps that the page sees one by one."""
        steps = math.ceil(duration_s / step_s - 1e-9)
        for _ in range(steps):
            self.bench.run_for(duration_s / steps)
            self.catch_up()

    def finish(self):
        """Lets time pass until the page has the answers to what it has sent."""
        for count in range(PATIENCE * 10):
            if not self.ask("salient.pending"):
                return
            self.bench.run_for(0.001)
            if count % 100 == 99:
                self.catch_up()
        raise AssertionError("no answer to a command")

    def press(self, selector):
        self.page.click(selector)
        self.finish()

    def take_command(self):
        self.press("#take")
        self.wait("salient.lease === 'yours'")

    def tab(self, name):
        self.page.click(f"[role=tab]:text-is('{name}')")

    def notice(self):
        return self.page.inner_text("#notice")

    def count(self, message):
        return self.ask(f"salient.store.count('{message}')")


def nothing_is_cut_off(page):
    """Names of visible elements that are beyond the width of the page, or whose text is beyond themselves, once the
    page has had display frames to follow a change of its size: plots that take long skip some."""
    return page.evaluate("""async (frames) => {
        const found = () => [...document.querySelectorAll("body *")].filter((each) => {
            if (each.closest(".uplot, option, .list, canvas, datalist") || !each.checkVisibility()) { return false; }
            const box = each.getBoundingClientRect();
            const beyond = box.right > innerWidth + 0.5 || box.left < -0.5;
            const cut = each.scrollWidth > each.clientWidth + 1 && each.clientWidth > 0
                && getComputedStyle(each).display !== "inline" && !["SELECT", "INPUT"].includes(each.tagName);
            return beyond || cut;
        }).map((each) => `${each.tagName} ${each.id} ${each.className}`);
        for (let frame = 0; frame < frames && found().length > 0; frame++) {
            await new Promise(requestAnimationFrame);
        }
        return found();
    }""", _SETTLING_FRAMES)


def picture(name):
    PICTURES.mkdir(parents=True, exist_ok=True)
    return PICTURES / f"{name}.png"
