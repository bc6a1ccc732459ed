// The source of a page that has the drive inside: the world is in the tab, and its time is moved by the display.

import { databasesOf } from "./data.js";
import { Messages } from "./messages.js";
import { RUN_COMMANDS, Run } from "./run.js";
import { writeLink } from "./link.js";
import { Variables } from "./variables.js";

const SLICE_NS = 1e6;
const BUDGET_MS = 12; // of computation for one display frame: time goes slower where the computer is slow
const ELAPSED_MAX_MS = 100; // a page that has slept goes on where it was

/** Frames of a batch, as they come. */
class Columns {
    constructor() {
        this.clear();
    }

    clear() {
        Object.assign(this, { time: [], id: [], length: [], data: [] });
    }

    add(timeNs, identifier, length, data) {
        this.time.push(timeNs);
        this.id.push(identifier >>> 0);
        this.length.push(length);
        for (let i = 0; i < 8; i++) {
            this.data.push(data[i]);
        }
    }

    batch() {
        return {
            count: this.time.length, lost: 0, time_ns: Float64Array.from(this.time), id: Uint32Array.from(this.id),
            length: Uint8Array.from(this.length), data: Uint8Array.from(this.data),
        };
    }
}

export class TabSource {
    /** data: of the tab; setting: { machine, options, events, untilNs, hash, build } of a link. */
    constructor(data, setting) {
        this.data = data;
        this.setting = setting;
        this.columns = new Columns();
        this.stopped = false;
        this.pace = 1; // virtual time over wall time
        this.takeFrames = () => {};
        this.takeNotice = () => {};
        /** Called when a run begins again at an earlier time, when a compared hash is known, and at the end of a link. */
        this.onRewound = () => {};
        this.onSame = () => {};
        this.onEnd = () => {};
        this.endNs = setting.untilNs ?? Infinity;
    }

    onFrames(callback) {
        this.takeFrames = callback;
    }

    onNotice(callback) {
        this.takeNotice = callback;
    }

    async open() {
        const { data, setting } = this;
        if (!(setting.machine in data.machines)) {
            throw new Error(`This file has no machine '${setting.machine}'; it has ${Object.keys(data.machines).join(", ")}.`);
        }
        const { machine, database_hash: hash } = data.machines[setting.machine];
        this.run = new Run({
            messages: new Messages(databasesOf(data, setting.machine), data.data_ids), faults: data.faults,
            choices: data.parameter_choices, variables: new Variables(data.variables, data.machines[setting.machine].factors),
            onFrame: (...frame) => this.columns.add(...frame),
            onSame: (timeNs, same) => this.takeSame(timeNs, same),
        });
        const ahead = [...setting.events];
        if (setting.hash !== undefined) {
            ahead.push({ timeNs: setting.untilNs, hash: setting.hash });
        }
        await this.run.start(await WebAssembly.compile(data.module), data.images[setting.machine], setting.options, ahead);
        this.takeNotice({ lease: "yours" });
        this.lastMs = performance.now();
        return {
            kind: "tab", title: "the drive in this tab", databases: this.run.client.messages.list,
            database_hash: hash, machine, faults: data.faults, parameter_choices: data.parameter_choices,
            commands: [...RUN_COMMANDS, "pause", "resume", "step", "rewind"],
            build: `salient ${data.version}, build ${data.build}`, period_ms: 1,
        };
    }

    /** The display has drawn a frame: time goes on until the next. */
    shown() {
        const nowMs = performance.now();
        const elapsedMs = Math.min(ELAPSED_MAX_MS, nowMs - this.lastMs);
        this.lastMs = nowMs;
        if (!this.stopped) {
            this.advance(Math.round(elapsedMs * 1e3 * this.pace) * 1e3, nowMs + BUDGET_MS);
        }
        this.flush();
    }

    /** Lets time pass by some nanoseconds, or until the wall time is over. */
    advance(durationNs, endMs = Infinity) {
        const untilNs = Math.min(this.run.timeNs + durationNs, this.endNs);
        while (this.run.timeNs < untilNs && performance.now() < endMs && !this.stopped) {
            this.run.advanceTo(Math.min(untilNs, this.run.timeNs + SLICE_NS));
        }
        if (this.run.timeNs >= this.endNs) {
            this.endNs = Infinity;
            this.onEnd();
        }
    }

    async command(name, args) {
        if (name === "pause" || name === "resume") {
            this.stopped = name === "pause";
        } else if (name === "step") {
            this.run.advanceTo(this.run.timeNs + Math.round(args.s * 1e9));
        } else if (name === "rewind") {
            this.rewind(args.time_ns);
        } else {
            return this.run.command(name, args);
        }
        return { ok: true, message: "" };
    }

    rewind(timeNs) {
        this.flush();
        this.run.rewindTo(Math.round(timeNs)); // the last frames before that time come again
        if (this.columns.time.length > 0) {
            this.onRewound(this.columns.time[0]);
            this.takeFrames({ ...this.columns.batch(), rewound: true });
            this.columns.clear();
        }
    }

    flush() {
        if (this.columns.time.length > 0) {
            this.takeFrames(this.columns.batch());
            this.columns.clear();
        }
    }

    takeSame(timeNs, same) {
        const at = `${(timeNs / 1e9).toFixed(3)} s`;
        const fromLink = timeNs === this.setting.untilNs;
        const otherBuild = fromLink && this.setting.build !== undefined && this.setting.build !== this.data.build;
        this.onSame(timeNs, same, !same && otherBuild
            ? `Other bits at ${at}: the link is of build ${this.setting.build}, this is ${this.data.build}.`
            : `${same ? "The same bits" : "OTHER BITS"} at ${at} as ${fromLink ? "when the link was made" : "before"}.`);
    }

    /** The link to this run up to now, from its # on. */
    link() {
        const { events, untilNs, hash } = this.run.record();
        const { machine, options } = this.setting;
        return writeLink({ build: this.data.build, machine, options, events, untilNs, hash });
    }
}
