// The first run of who opens the page for the first time: what to do next, one line a step, by what the telemetry shows.

import { element } from "./controls.js";
import { textOf } from "./decoder.js";

const NAME = "salient_first_run";
const REMEMBERED_S = 365 * 86_400;
const STEADY_NS = 0.1e9; // of the speed reference: a ramp has ended
const REACHED_PART = 0.02; // of the speed reference
const LOADED_PART = 0.01; // of the rated torque
const BENCH_WITHIN_NS = 1e9; // of telemetry in which a test bench sends its true state

/** Steps, and those that a drive without a test bench has. */
const STEPS = ["arm", "speed", "load", "fault", "clear"];
const STEPS_WITHOUT_BENCH = ["arm", "speed"];

/** What has been done so far, and what is next. */
export class Progress {
    constructor() {
        this.done = new Set();
        this.wasSound = false; // before a fault
        this.finished = false;
        this.steps = STEPS;
    }

    /** The next step, or "" when all are done. seen: { state, reached, loaded, injected, hasBench } of the drive now. */
    take({ state, reached, loaded, injected, hasBench }) {
        this.steps = hasBench ? STEPS : STEPS_WITHOUT_BENCH;
        const { done } = this;
        if (state === "run") {
            done.add("arm");
            if (reached) {
                done.add("speed");
            }
            if (loaded) {
                done.add("load");
            }
        }
        if (state === "fault" && this.wasSound && injected) {
            done.add("fault");
        }
        if (state === "run" || state === "ready") {
            this.wasSound = true;
            if (done.has("fault")) {
                done.add("clear");
            }
        }
        const next = this.steps.find((step) => !done.has(step));
        this.finished = this.finished || next === undefined;
        if (this.finished) {
            return "";
        }
        if (state === "fault") {
            return "clear"; // nothing else is possible, whatever the fault came from
        }
        return next !== "clear" && state !== "run" ? "arm" : next;
    }
}

/** The line of a step. seen: as above, with { lease, check, present, degraded }. */
export function lineOf(step, { state, lease, check, loaded, present, degraded, standsStill }) {
    if (step === "") {
        return "Done. The button First run begins again.";
    }
    if (state === "") {
        return "Wait for the telemetry of the drive.";
    }
    if (lease === "other") {
        return "Another page commands this drive: release it there.";
    }
    if (lease === "free") {
        return "Press Take command: one page commands a drive.";
    }
    if (step === "clear" && loaded) {
        return "Apply a load of 0: nothing holds the rotor against it.";
    }
    if (step === "clear" && present) {
        return "On Faults, press End: the cause of the fault goes.";
    }
    if (state === "initialise") {
        return check === "none" ? "Wait until the drive has checked itself." : `The drive does not start: ${check}.`;
    }
    return {
        arm: "Press Run beside Speed: it arms and starts the drive.",
        speed: standsStill ? "Enter a speed other than 0 and press Run beside it."
            : "Wait until the speed is reached, or run another one.",
        load: "Press Apply beside Load: the speed drops and recovers.",
        fault: degraded ? "The drive runs on without a phase: begin another fault."
            : "On Faults, begin “winding open”: the drive switches off.",
        clear: "Press Clear fault: the drive is ready again.",
    }[step];
}

/** Where it is remembered that a person has seen the first run. The port of a server is another one at each start, and
 *  with it the local storage, but not the cookies; a file has no cookies. Each may be forbidden. */
const MEMORIES = [
    { read: () => localStorage.getItem(NAME) !== null, write: () => localStorage.setItem(NAME, "seen") },
    { read: () => document.cookie.split("; ").includes(`${NAME}=seen`),
      write: () => { document.cookie = `${NAME}=seen; max-age=${REMEMBERED_S}; path=/; SameSite=Strict`; } },
];

function attempt(action) {
    try {
        return action();
    } catch {
        return false;
    }
}

export class FirstRun {
    /** page: of app.js, with its controls. */
    constructor(page) {
        this.page = page;
        this.target = null;
        this.isPossible = !page.isReplay && page.info.commands.includes("speed_reference");
        const { store } = page;
        this.series = Object.fromEntries(Object.entries({
            speed: "DRIVE_MOTION.speed_rpm", reference: "DRIVE_MOTION.speed_reference_rpm",
            load: "RIG_TRUTH_BENCH.load_torque_Nm", degraded: "DRIVE_DEGRADED.degraded",
        }).map(([key, name]) => [key, store.watch(name)]));
        this.ofBench = page.info.databases.filter((message) => message.node === "RIG").map((message) => message.name);
        element("first-run-start").hidden = !this.isPossible;
        element("first-run-start").addEventListener("click", () => (this.progress ? this.close() : this.start()));
        element("first-run-close").addEventListener("click", () => this.close());
        element("first-run-go").addEventListener("click", () => this.go());
        if (this.isPossible && !MEMORIES.some(({ read }) => attempt(read))) {
            this.start();
        }
    }

    start() {
        this.progress = new Progress();
        this.injected = false;
        this.reported = this.page.activeFaults.reported;
        this.present = this.page.activeFaults.presentAfter(this.reported).size > 0;
        this.show(true);
    }

    /** Ends it, for the next visits, too. */
    close() {
        this.remember();
        this.hide();
        element("first-run-start").focus();
    }

    hide() {
        this.progress = null;
        this.highlight(null);
        this.show(false);
    }

    remember() {
        MEMORIES.forEach(({ write }) => attempt(write));
    }

    show(shown) {
        element("first-run").hidden = !shown;
        element("first-run-start").setAttribute("aria-expanded", shown);
        element("first-run-text").textContent = ""; // so that the first line is a change, which is read aloud
    }

    /** Shows the step that the latest telemetry asks for. */
    update() {
        if (!this.progress) {
            return;
        }
        if (this.page.ended) {
            this.hide();
            return;
        }
        const seen = this.seen();
        const step = this.progress.take(seen);
        const { steps } = this.progress;
        const number = steps.indexOf(step) + 1;
        const line = `${number ? `Step ${number} of ${steps.length}. ` : ""}${lineOf(step, seen)}`;
        if (line !== element("first-run-text").textContent) {
            element("first-run-text").textContent = line;
            if (step === "") {
                this.remember();
            }
        }
        this.highlight(this.targetOf(step, seen));
    }

    seen() {
        const { page } = this;
        const { speed, reference, load, degraded } = this.series;
        const name = (series) => (series.size ? textOf(series.signal, series.last).replaceAll("_", " ") : "");
        const faults = page.activeFaults;
        if (faults.reported !== this.reported) {
            this.injected = this.injected || faults.reported > this.reported; // fewer: gone back in time
            this.reported = faults.reported;
            this.present = faults.presentAfter(faults.reported).size > 0;
        }
        const wanted_rpm = reference.last;
        const steady = reference.at(page.store.last_ns - STEADY_NS) === wanted_rpm;
        const known_ns = page.store.last_ns - page.store.first_ns;
        return {
            state: name(page.status), check: name(page.inhibited), degraded: name(degraded) === "yes",
            lease: page.info.commands.includes("take") ? page.lease : "yours",
            standsStill: wanted_rpm === 0,
            reached: steady && wanted_rpm !== 0 && Math.abs(speed.last - wanted_rpm) <= REACHED_PART * Math.abs(wanted_rpm),
            loaded: Math.abs(load.last) > LOADED_PART * page.info.machine.torque_rated_Nm,
            injected: this.injected, present: this.present,
            hasBench: known_ns < BENCH_WITHIN_NS || this.ofBench.some((message) => page.store.count(message) > 0),
        };
    }

    /** The control to use, or the tab that leads to it; null when there is nothing to press. */
    targetOf(step, { state, lease, loaded, present }) {
        if (step === "" || state === "") {
            return null;
        }
        if (lease !== "yours") {
            return element("take");
        }
        if (state === "initialise" && !(step === "clear" && (loaded || present))) {
            return null;
        }
        const control = {
            arm: "#speed-form button", speed: "#speed-form button", load: "#load-form button", fault: "#fault-form button",
            clear: loaded ? "#load-form button" : present ? "#active-faults button"
                : element("run-panel").hidden ? "#clear-fault-2" : "#clear-fault",
        }[step];
        const wanted = document.querySelector(control);
        if (wanted === null) {
            return null; // the list of faults belongs to a held time
        }
        const panel = wanted.closest("[role=tabpanel]");
        return panel.hidden ? element(`${panel.id}-tab`) : wanted;
    }

    highlight(target) {
        if (target === this.target) {
            return;
        }
        this.target?.classList.remove("next");
        this.target?.removeAttribute("aria-describedby");
        target?.classList.add("next");
        target?.setAttribute("aria-describedby", "first-run-text");
        this.target = target;
        element("first-run-go").hidden = target === null;
    }

    /** To the control, by keyboard or where it is outside of the screen. */
    go() {
        if (this.target?.getAttribute("role") === "tab") {
            this.target.click();
            this.update();
        }
        this.target?.scrollIntoView({ block: "nearest" });
        this.target?.focus();
    }
}
