// The live page: joins a source of frames with plots, pictures and controls.

import { showTraffic } from "./bus.js";
import { Charts, csvOf } from "./charts.js";
import { ActiveFaults, element, makeFaults, makeParameters, makeRecord, makeRun, makeSignals, makeStimuli, makeTabs, showCursors }
    from "./controls.js";
import { textOf } from "./decoder.js";
import { FirstRun } from "./first_run.js";
import { drawLoops, drawMachine, MachineState } from "./machine.js";
import { PHASE_COLOURS, PHASE_NAMES } from "./palette.js";
import { makeScope } from "./scope.js";
import { Store } from "./store.js";
import { RotorTime, Timeline, Trigger } from "./timeline.js";

const KEPT_FRAMES = 65_536; // of a message: a minute at 1 kHz
const SIGNALS_AT_START = [
    "DRIVE_MOTION.speed_rpm", "DRIVE_MOTION.speed_reference_rpm",
    "DRIVE_TORQUE.torque_estimate_Nm", "DRIVE_TORQUE.torque_reference_Nm", "RIG_TRUTH_BENCH.load_torque_Nm",
    "DRIVE_CURRENTS.current_a_A", "DRIVE_CURRENTS.current_b_A", "DRIVE_CURRENTS.current_c_A",
];
const DRAWING_SHARE = 0.5; // of the time: plots that take long are drawn at every second display frame, or third
const HEALTH_PERIOD_MS = 500;

class Page {
    constructor(source, info) {
        this.source = source;
        this.info = info;
        this.isReplay = info.kind === "replay";
        this.store = new Store(info.databases, this.isReplay ? Infinity : KEPT_FRAMES);
        this.timeline = new Timeline(this.store, this.isReplay);
        this.trigger = new Trigger();
        this.state = new MachineState(this.store, info.machine);
        this.rotor = new RotorTime(this.state);
        this.charts = new Charts(element("charts"), {
            onZoom: (from_ns, to_ns) => this.zoom(from_ns, to_ns),
            onMark: (name, time_ns) => this.mark(name, time_ns),
        });
        this.lease = "free";
        this.pending = 0;
        this.shown_ns = 0;
        this.drawn = 0;
        this.lastMark = "A";
        this.status = this.store.watch("DRIVE_STATUS.state");
        this.fault = this.store.watch("DRIVE_STATUS.fault");
        this.inhibited = this.store.watch("DRIVE_STATUS.start_inhibited_by");
        const available = (name) => this.store.watch(`DRIVE_AVAILABLE_TORQUE.${name}`);
        this.available = [["forward", "+"], ["backward", "\u2212"]].map(([side, sign]) =>
            ({ sign, torque: available(`${side}_Nm`), limit: available(`${side}_limited_by`) }));
        this.exceeds = available("load_exceeds");
        this.load = this.store.watch("DRIVE_TORQUE.load_torque_estimate_Nm");
        this.hash = this.store.watch("DRIVE_IDENTITY.dbc_hash");
        this.health = { at_ms: performance.now(), frames: 0, drawn: 0 };
        this.free_ms = 0;
        this.last_ms = performance.now();
    }

    start() {
        const { info } = this;
        element("machine-name").textContent = info.machine.name;
        element("title").textContent = info.title.split("/").pop();
        element("title").title = info.title;
        document.title = `Salient: ${info.title}`;
        const acts = info.stimuli ?? [];
        makeTabs([...info.commands, ...(acts.length ? ["stimuli"] : []), ...(info.kind === "tab" ? [] : ["traffic"])]);
        makeStimuli(acts, (time_ns) => this.zoom(time_ns - 0.2 * this.timeline.window_ns,
                                                 time_ns + 0.8 * this.timeline.window_ns));
        this.charts.stimuli_s = acts.map((act) => act.time_s);
        const act = (name, args) => this.act(name, args);
        makeRun(act, info.machine);
        makeFaults(act, info.faults, info.machine.phases);
        this.activeFaults = new ActiveFaults(act, this.store, info.faults);
        makeParameters(act, info.parameter_choices);
        makeRecord(act);
        makeScope(act);
        makeSignals(info.databases, SIGNALS_AT_START, (names) => this.choose(names));
        this.choose(SIGNALS_AT_START);
        this.makeToolbar();
        const takes = info.commands.includes("take");
        element("take").hidden = !takes;
        element("stop").hidden = !takes;
        element("take").addEventListener("click", () => act(this.lease === "yours" ? "release" : "take", {}));
        this.showLease();
        this.firstRun = new FirstRun(this);
        document.addEventListener("keydown", (event) => this.takeKey(event));
        requestAnimationFrame((now_ms) => this.tick(now_ms));
    }

    /** Carries out a command and shows what is refused. */
    async act(name, args) {
        this.pending += 1;
        const answer = await this.source.command(name, args);
        this.pending -= 1;
        this.tell(answer.ok ? "" : `${name.replaceAll("_", " ")}: ${answer.message}`, true);
        return answer;
    }

    tell(text, isBad = false) {
        element("notice").textContent = text;
        element("notice").hidden = text === "";
        element("notice").classList.toggle("bad", isBad);
    }

    takeNotice(notice) {
        if (notice.lease) {
            this.lease = notice.lease;
            this.showLease();
        }
        if (notice.text && !this.isReplay) {
            this.tell(notice.text);
        }
        if (notice.traffic) {
            showTraffic(notice.traffic, (time_ns) => this.zoom(time_ns - 0.5 * this.timeline.window_ns,
                                                               time_ns + 0.5 * this.timeline.window_ns));
        }
        this.malformed = notice.malformed ?? this.malformed;
        this.ended = notice.ended ?? this.ended;
    }

    showLease() {
        const yours = this.lease === "yours";
        element("take").textContent = yours ? "Release command" : "Take command";
        element("take").setAttribute("aria-pressed", yours);
        element("take").title = this.lease === "other" ? "Another page commands" : "Only one page commands a drive";
        element("stop").disabled = !yours;
        for (const id of ["run-panel", "fault-panel", "parameter-panel", "record-panel", "scope-panel"]) {
            element(id).inert = !yours && this.info.commands.includes("take");
            element(id).style.opacity = element(id).inert ? 0.55 : 1;
        }
    }

    choose(names) {
        this.names = names;
        const list = names.map((name) => this.store.watch(name)).filter(Boolean);
        this.charts.show(list);
        element("trigger-signal").replaceChildren(...list.map((series) => new Option(series.name, series.name)));
        this.showTriggerLevel();
    }

    /** The level of the trigger: a number, or a named value that begins or ends. */
    showTriggerLevel() {
        const choices = this.store.watch(element("trigger-signal").value)?.signal.choices;
        element("trigger-level").hidden = Boolean(choices);
        element("trigger-choice").hidden = !choices;
        element("trigger-choice").replaceChildren(...Object.entries(choices ?? {}).map(
            ([number, name]) => new Option(name, number)));
        const texts = choices ? { rising: "begins", falling: "ends" } : { rising: "rising", falling: "falling" };
        for (const option of element("trigger-edge").options) {
            option.textContent = texts[option.value];
        }
    }

    zoom(from_ns, to_ns) {
        this.timeline.zoom(from_ns, to_ns);
        this.showHeld();
    }

    mark(name, time_ns) {
        this.charts.setMark(name, time_ns);
        this.lastMark = name;
        showCursors(this.charts.marks, this.charts.list);
    }

    makeToolbar() {
        const { timeline, trigger } = this;
        element("window").addEventListener("change", (event) => {
            timeline.window_ns = Number(event.target.value) * 1e9;
        });
        element("pause").addEventListener("click", () => this.togglePause());
        element("play-speed").hidden = !this.isReplay;
        element("speed").addEventListener("change", (event) => { timeline.speed = Number(event.target.value); });
        element("scrub").addEventListener("input", (event) => {
            const part = Number(event.target.value) / 1000;
            const first_ns = this.first_ns();
            timeline.end_ns = first_ns + part * (this.store.last_ns - first_ns);
            timeline.playing = false;
            timeline.held = true;
            this.showHeld();
        });
        const arm = () => {
            const series = this.store.watch(element("trigger-signal").value);
            const level = element(series?.signal.choices ? "trigger-choice" : "trigger-level").value;
            trigger.arm({ mode: element("trigger-mode").value, rising: element("trigger-edge").value === "rising", series,
                          level: Number(level) }, this.store.last_ns);
            timeline.held = this.isReplay;
            this.charts.setMark("T", undefined);
            this.showHeld();
        };
        element("trigger-signal").addEventListener("change", () => this.showTriggerLevel());
        for (const id of ["trigger-mode", "trigger-signal", "trigger-edge", "trigger-level", "trigger-choice"]) {
            element(id).addEventListener("change", arm);
        }
        element("export").addEventListener("click", () => this.export());
        element("rotor").addEventListener("change", (event) => { this.rotor.slowed = event.target.value === "slow"; });
        element("clear-cursors").addEventListener("click", () => {
            this.charts.setMark("A", undefined);
            this.charts.setMark("B", undefined);
            showCursors(this.charts.marks, this.charts.list);
        });
        element("world").hidden = !this.info.commands.includes("pause");
        const world = { pause: () => this.stopTime(), step: () => this.source.command("step", { s: 0.001 }) };
        document.querySelectorAll("[data-world]").forEach((button) => {
            button.addEventListener("click", world[button.dataset.world]);
        });
        showCursors(this.charts.marks, []);
        this.showHeld();
    }

    stopTime() {
        const button = document.querySelector("[data-world=pause]");
        this.stopped = !this.stopped;
        button.setAttribute("aria-pressed", this.stopped);
        this.source.command(this.stopped ? "pause" : "resume", {});
    }

    togglePause() {
        const { timeline } = this;
        if (this.isReplay) {
            timeline.playing = !timeline.playing;
            if (timeline.playing && timeline.end_ns >= this.store.last_ns) {
                timeline.end_ns = this.first_ns();
            }
        } else {
            timeline.hold(!timeline.held);
            if (!timeline.held) {
                timeline.window_ns = Number(element("window").value) * 1e9;
            }
        }
        this.showHeld();
    }

    showHeld() {
        const { timeline } = this;
        const stands = this.isReplay ? !timeline.playing : timeline.held;
        element("pause").textContent = this.isReplay ? (stands ? "Play" : "Pause") : (stands ? "Go on" : "Pause");
        element("pause").setAttribute("aria-pressed", stands && !this.isReplay);
        element("scrub").hidden = !(this.isReplay || stands);
    }

    /** The earliest time that can be shown. */
    first_ns() {
        const raw = this.store.status.raw;
        return raw.size ? raw.time[0] : this.store.first_ns;
    }

    export() {
        const text = csvOf(this.charts.list, this.timeline.start_ns, this.timeline.end_ns);
        const link = document.createElement("a");
        link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
        link.download = "salient.csv";
        link.click();
        URL.revokeObjectURL(link.href);
    }

    takeKey(event) {
        const typing = ["INPUT", "SELECT", "TEXTAREA"].includes(event.target.tagName);
        if (event.key === "Escape" && this.info.commands.includes("stop") && this.lease === "yours"
            && !element("record").open) {
            this.act("stop", {});
        } else if (typing || event.ctrlKey || event.altKey || event.metaKey) {
            return;
        } else if (event.key === "p") {
            this.togglePause();
        } else if (event.key === "a" || event.key === "b") {
            this.mark(event.key.toUpperCase(), this.timeline.end_ns);
        } else if (event.key === "ArrowLeft" || event.key === "ArrowRight") {
            const step_ns = this.timeline.window_ns / 500 * (event.shiftKey ? 10 : 1);
            const at_ns = this.charts.marks[this.lastMark];
            if (at_ns !== undefined) {
                this.mark(this.lastMark, at_ns + (event.key === "ArrowLeft" ? -step_ns : step_ns));
                event.preventDefault();
            }
        }
    }

    takeFrames(batch) {
        const first = this.store.frames === 0;
        this.store.add(batch);
        if (first && this.isReplay) {
            this.timeline.end_ns = this.store.first_ns + this.timeline.window_ns;
        }
    }

    tick(now_ms) {
        requestAnimationFrame((next_ms) => this.tick(next_ms));
        if (now_ms < this.free_ms) {
            return;
        }
        const begin_ms = performance.now();
        const elapsed_ms = Math.min(200, now_ms - this.last_ms);
        this.last_ms = now_ms;
        this.draw(elapsed_ms);
        this.shown_ns = this.store.last_ns || 0;
        this.source.shown(this.shown_ns);
        this.drawn += 1;
        const spent_ms = performance.now() - begin_ms;
        this.free_ms = now_ms + spent_ms / DRAWING_SHARE - 4;
    }

    draw(elapsed_ms) {
        const { timeline, store, trigger } = this;
        const wasPlaying = timeline.playing;
        timeline.advance(elapsed_ms);
        element("trigger-state").textContent = trigger.run(timeline, store.last_ns);
        if (trigger.mode !== "off" || trigger.shown_ns) {
            this.charts.marks.T = trigger.shown_ns;
        }
        if (wasPlaying !== timeline.playing) {
            this.showHeld();
        }
        const end_ns = timeline.end_ns;
        const plots = [store.frames, timeline.start_ns, end_ns, this.charts.version, trigger.shown_ns].join();
        if (plots !== this.drawnPlots) { // what has not changed is not drawn again
            this.drawnPlots = plots;
            this.charts.draw(timeline.start_ns, end_ns, timeline.held || timeline.playing ? end_ns : Infinity);
        }
        const machine_ns = this.rotor.advance(elapsed_ms, timeline);
        const pictures = [machine_ns, this.charts.version, this.state.isTrue].join();
        if (pictures !== this.drawnPictures) {
            this.drawnPictures = pictures;
            this.drawPictures(machine_ns);
        }
        if (!element("scrub").hidden && document.activeElement !== element("scrub")) {
            const first_ns = this.first_ns();
            element("scrub").value = 1000 * (end_ns - first_ns) / (store.last_ns - first_ns);
        }
        this.showState();
        const now_ms = performance.now();
        if (now_ms - this.health.at_ms > HEALTH_PERIOD_MS) {
            this.showHealth(now_ms);
        }
    }

    drawPictures(time_ns) {
        if (element("cut").clientWidth === 0) {
            return; // the page has no size, as in a window that is being made
        }
        drawMachine(element("cut"), this.state, time_ns);
        this.showWork(drawLoops(element("loops"), this.state, time_ns));
        const angle = this.state.angleAt(time_ns);
        element("angle").textContent = Number.isFinite(angle) ? `${((angle % 360 + 360) % 360).toFixed(1)}°` : "";
    }

    showWork({ work, samples }) {
        const total = work.reduce((sum, each) => sum + each, 0);
        const key = [samples, ...work.map((each) => each.toFixed(2))].join();
        if (key === this.workKey) {
            return;
        }
        this.workKey = key;
        const parts = work.map((each, phase) => {
            const part = document.createElement("b");
            part.style.color = PHASE_COLOURS[phase];
            part.textContent = `${PHASE_NAMES[phase]} ${Number.isFinite(each) ? each.toFixed(2) : "–"}`;
            return part;
        });
        const torque = total * this.info.machine.rotor_poles / (2 * Math.PI);
        element("work").replaceChildren("Energy per stroke, J: ", ...parts,
                                        Number.isFinite(torque) ? ` mean torque ${torque.toFixed(2)} N m, ${samples} samples` : "");
    }

    showState() {
        const at_ns = this.timeline.held || this.timeline.playing ? this.timeline.end_ns : Infinity;
        const name = (series) => {
            const value = series.at(at_ns);
            return Number.isFinite(value) ? textOf(series.signal, value) : "";
        };
        const [state, fault, check] = [this.status, this.fault, this.inhibited].map(name);
        this.activeFaults.show(at_ns);
        const badge = element("state");
        badge.textContent = state || "no data";
        badge.className = `badge ${state === "run" ? "run" : state === "fault" ? "bad" : ""}`;
        const sides = this.available.map(({ sign, torque, limit }) =>
            ({ torque: Math.abs(torque.at(at_ns)), limit: name(limit), sign }));
        const against = sides[this.load.at(at_ns) > 0 ? 0 : 1]; // the direction of the torque that would hold the load
        const beyond = state === "run" && name(this.exceeds) === "yes" ? `load exceeds torque, ${against.limit}` : "";
        const because = state === "fault" ? fault : state === "initialise" && check !== "none" ? check : beyond;
        element("available").textContent = sides.every((side) => Number.isFinite(side.torque))
            ? `Available torque: ${sides.map(({ sign, torque, limit }) =>
                `${sign}${torque.toFixed(1)} N m (${limit.replaceAll("_", " ")})`).join(", ")}.` : "";
        element("fault").textContent = because.replaceAll("_", " ");
        element("fault").hidden = because === "";
        this.firstRun.update();
    }

    showHealth(now_ms) {
        const seconds = (now_ms - this.health.at_ms) / 1000;
        const frames = (this.store.frames - this.health.frames) / seconds;
        const drawn = (this.drawn - this.health.drawn) / seconds;
        this.health = { at_ms: now_ms, frames: this.store.frames, drawn: this.drawn };
        const bus = this.isReplay ? `${this.store.frames} frames` : `${Math.round(frames)} frames/s`;
        const end_s = (this.timeline.end_ns / 1e9).toFixed(2);
        element("health").textContent =
            `${end_s} s · ${bus} · ${this.store.lost} lost · ${Math.round(drawn)} fps`;
        const picture = this.state.isTrue ? "True angle and currents of the test bench"
            : "Angle and currents as the drive measures them";
        element("picture-source").textContent = `${picture}. Flux linkage is not on the bus: it comes from the machine `
            + "file's map. + both switches on, 0 one on, − both off: mean between two samples, from the winding's voltage.";
        const reported = this.hash.last;
        if (Number.isFinite(reported) && reported !== this.info.database_hash && !this.toldHash) {
            this.toldHash = true;
            const hex = (hash) => hash.toString(16).padStart(8, "0");
            this.tell(`The drive carries another machine than ${this.info.machine.name} (database ${hex(reported)}, here `
                + `${hex(this.info.database_hash)}): signals may be decoded wrongly. Start the page again.`, true);
        }
    }
}

/** Opens a source and shows it; the page is returned for a browser's console and for tests. */
export async function startPage(source) {
    let page = null;
    const early = [];
    source.onFrames((batch) => (page ? page.takeFrames(batch) : early.push(batch)));
    source.onNotice((notice) => {
        if (page) {
            page.takeNotice(notice);
        } else if (notice.text) {
            element("notice").textContent = notice.text;
            element("notice").hidden = false;
        }
    });
    try {
        page = new Page(source, await source.open());
    } catch (error) {
        element("notice").textContent = error.message;
        element("notice").hidden = false;
        return null;
    }
    globalThis.salient = page;
    page.start();
    early.forEach((batch) => page.takeFrames(batch));
    return page;
}
