// A run of the drive in the tab: a world, its client, and the events that make it what it is. Equal build, machine,
// options and events give equal bits, so that going back is restoring a snapshot and letting time pass again.

import { Client, Rejected } from "./client.js";
import { World } from "./world.js";
import { armBuffer, readBuffer, triggerBuffer } from "./xcp.js";

const SNAPSHOT_STEP_NS = 250e6;
/** How far back one can go. */
export const KEPT_NS = 10e9;
const AGAIN_NS = 2e6; // of frames before the time gone back to are given once more

/** What changes the run; times of the others pass, and are undone. */
const ACTIONS = {
    speed_reference: (client, { rpm }) => client.speedReference(rpm),
    torque_reference: (client, { Nm }) => client.torqueReference(Nm),
    stop: (client) => client.ask("stop"),
    off: (client) => client.ask("off"),
    clear_fault: (client) => client.clearFault(),
    load_torque: (client, { Nm }) => client.set("load_torque_Nm", Nm),
    truth_period: (client, { us }) => client.set("truth_period_us", us),
    fault: (client, args, { faults }) => client.fault(faults, args),
    end_fault: (client, args, { faults }) => client.endFault(faults, args),
    end_faults: (client) => client.endFaults(),
    set_parameters: (client, { values }, { choices }) => client.setParameters(choices, values),
    save_parameters: (client) => client.saveParameters(),
    scope_arm: (client, args, { variables }) => armBuffer(client, variables, args),
    scope_trigger: (client) => triggerBuffer(client),
    frame: (client, { id, data }) => client.frame(id, data),
};
const QUERIES = {
    parameters: (client) => client.parameters(),
    fault_trace: (client) => client.faultTrace(),
    fault_log: (client) => client.faultLog(),
    scope_names: (client, { variables }) => variables.short,
    scope_read: (client, { variables }) => readBuffer(client, variables),
};

/** Commands of which a link can consist, and all that a run carries out. */
export const EVENTS = Object.keys(ACTIONS).filter((name) => name !== "frame");
export const RUN_COMMANDS = [...EVENTS, ...Object.keys(QUERIES)];

export class Run {
    /** faults, choices: of an Info; variables: Variables. onFrame: as of the client, for frames that are new.
     *  onSame(timeNs, same): a hash that was known for this time has been compared. */
    constructor({ messages, faults, choices, variables, onFrame = () => {}, onSame = () => {} }) {
        this.silent = false;
        this.known = { faults, choices, variables };
        this.onSame = onSame;
        this.client = new Client(messages, (...frame) => this.silent || onFrame(...frame));
        this.world = new World((records) => this.client.receive(records));
        this.client.join(this.world);
        this.done = []; // events: { timeNs, name, args }
        this.ahead = []; // those to come, of a link or of an abandoned branch; and { timeNs, hash }
        this.snapshots = [];
    }

    /** ahead: events with their times, in order. */
    async start(module, image, options, ahead = []) {
        await this.world.start(module, image, { seed: 1, telemetry_period_ms: 1, ...options });
        this.ahead = ahead;
        this.#keep();
    }

    get timeNs() {
        return this.world.timeNs;
    }

    /** Lets time pass; events that lie ahead happen at their times. */
    advanceTo(timeNs) {
        while (this.timeNs < timeNs) {
            const next = Math.min(timeNs, this.ahead[0]?.timeNs ?? Infinity,
                                  this.snapshots.at(-1).timeNs + SNAPSHOT_STEP_NS);
            this.client.advanceTo(next);
            if (this.timeNs >= this.snapshots.at(-1).timeNs + SNAPSHOT_STEP_NS) {
                this.#keep();
            }
            while (this.ahead.length > 0 && this.ahead[0].timeNs <= this.timeNs
                   && (this.ahead[0].timeNs < timeNs || this.ahead[0].hash !== undefined)) {
                this.#happen(this.ahead.shift());
            }
        }
    }

    /** Carries out a command now; what lay ahead of an action is another branch, and is left. { ok, message, value } */
    command(name, args) {
        try {
            if (name in QUERIES) {
                return { ok: true, message: "", value: this.#aside(() => QUERIES[name](this.client, this.known)) };
            }
            this.#prepare(name);
            this.ahead = [];
            const event = { timeNs: this.timeNs, name, args };
            this.done.push(event);
            ACTIONS[name](this.client, args, this.known);
            return { ok: true, message: "" };
        } catch (error) {
            if (!(error instanceof Rejected)) {
                throw error;
            }
            return { ok: false, message: error.message };
        }
    }

    /** Earliest time to go back to. */
    get oldestNs() {
        return this.snapshots[0].timeNs;
    }

    /** Goes back to a time: what happened from there on lies ahead again, and happens to the bit unless a command takes
     *  another branch. Returns the time reached, which is later where a command took time just then. */
    rewindTo(timeNs) {
        const endNs = this.timeNs;
        const target = Math.max(timeNs, this.oldestNs);
        if (target < endNs) {
            const before = this.done.filter((event) => event.timeNs < target).length;
            this.ahead.unshift(...this.done.splice(before), { timeNs: endNs, hash: this.world.hash });
            const at = this.snapshots.findLastIndex((each) => each.timeNs <= target - AGAIN_NS
                                                              && each.events <= this.done.length);
            const snapshot = this.snapshots[Math.max(0, at)];
            this.snapshots.length = Math.max(0, at) + 1;
            this.world.restore(snapshot.memory);
            this.client.state = structuredClone(snapshot.state);
            this.ahead.unshift(...this.done.splice(snapshot.events));
            this.silent = true;
            this.advanceTo(target - AGAIN_NS);
            this.silent = false;
            this.advanceTo(target);
        }
        return this.timeNs;
    }

    /** Events and the hash that they led to. */
    record() {
        return { events: this.done, untilNs: this.timeNs, hash: this.world.hash };
    }

    #happen(event) {
        if (event.hash !== undefined) {
            this.onSame(event.timeNs, event.hash === this.world.hash);
            return;
        }
        this.#prepare(event.name);
        this.done.push(event);
        try {
            ACTIONS[event.name](this.client, event.args, this.known);
        } catch (error) {
            if (!(error instanceof Rejected)) {
                throw error;
            }
        }
    }

    /** What an action needs to know, and whose reading must not be a part of the run. */
    #prepare(name) {
        if (name === "set_parameters" && this.client.rows === null) {
            this.#aside(() => this.client.readRows());
        }
    }

    /** The value of a query, and everything as if it had not been. */
    #aside(query) {
        const [memory, state, silent] = [this.world.snapshot(), structuredClone(this.client.state), this.silent];
        this.silent = true;
        try {
            return query();
        } finally {
            this.silent = silent;
            this.world.restore(memory);
            this.client.state = state;
        }
    }

    #keep() {
        this.snapshots.push({ timeNs: this.timeNs, memory: this.world.snapshot(),
                              state: structuredClone(this.client.state), events: this.done.length });
        while (this.snapshots.length > 1 && this.snapshots[1].timeNs <= this.timeNs - KEPT_NS) {
            this.snapshots.shift();
        }
    }
}
