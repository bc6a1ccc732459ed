// A client of the bench in lock-step: commands of drive and rig as salient.bench has them. Every function returns when it
// is done; what needs an answer lets virtual time pass.

import { HEADER_BYTES, crc32 } from "./e2e.js";
import { either } from "../../view/page/decoder.js";
import { rounded } from "./messages.js";
import { eachFrame, movesTime } from "./world.js";

const COMMAND_PERIOD_NS = 10e6;
const RESPONSE_TIMEOUT_NS = 100e6;
const RESPONSE_ATTEMPTS = 20;
const POLL_NS = 500e3;
const CHALLENGE_TIMEOUT_NS = 12e6;
const SET_ATTEMPTS = 20;
const SET_REPEATED = ["no_challenge", "no_response", "not_armed", "incomplete"];
const SAVE_TIMEOUT_NS = 2e9;
const MEMORY_ITEMS = ["saving", "origin", "start", "newest_fault", "sets"];
const FAULT_ITEMS = ["fault", "state", "checks", "start", "time_us", "time_wraps", "speed_rpm", "bus_voltage_V",
                     "current_max_A", "torque_reference_Nm"];
const LOGGED_FAULTS = 16;
const TRACE_PERIODS = 64;
const TRACE_PARTS = 8;
const TRACE_PHASES = 4;
const TRACE_MORE_PARTS = 3; // of two phases more, two phases a part
const TEXT_PARTS_MAX = 64;
const ARMING_RETRY_NS = 500e6;
const ARMING_ATTEMPTS_MAX = 4;
const ARMING_FAST_POLL_NS = 50e3;
const ARMING_FAST_POLL_FOR_NS = 2e6;
const ARMING_SLOW_POLL_NS = 1e6;
const DISARMED_NS = 2e6;
const NEVER = Infinity;

/** A request that drive or bench refuse; the message is for the user. */
export class Rejected extends Error {}

const shown = (value) => String(Number(Number(value).toPrecision(6)));

export class Client {
    /** messages: of drive and bench; onFrame(timeNs, identifier, length, data): every frame of the bus. */
    constructor(messages, onFrame) {
        this.messages = messages;
        this.onFrame = onFrame;
        this.waiting = null; // a frame that is waited for
        /** Everything that this client knows; with a snapshot of the world it is a state to go back to. */
        this.state = {
            request: null, torqueMode: false, speed_rpm: 0, torque_Nm: 0, counter: 0, commandDueNs: NEVER,
            arming: null, armingCounter: 0, disarmedNs: null, setCounter: 0, faults: [], latest: new Map(),
            buffer: null, // what it is armed for
        };
        this.rows = null; // parameters, the same in every state
    }

    join(world) {
        this.world = world;
    }

    /** Takes the records of the world. */
    receive(records) {
        eachFrame(records, (timeNs, identifier, length, data) => {
            if (movesTime(identifier)) {
                return;
            }
            const last = this.state.latest.get(identifier);
            this.state.latest.set(identifier, { timeNs, data: data.slice(0, length), count: (last?.count ?? 0) + 1 });
            if (this.waiting && this.waiting.found === null && this.waiting.matches(identifier, data)) {
                this.waiting.found = data.slice(0, length);
            }
            this.onFrame(timeNs, identifier, length, data);
        });
    }

    // --- time ---

    get timeNs() {
        return this.world.timeNs;
    }

    /** Lets time pass; commands go out as they fall due, one due just then included. */
    advanceTo(timeNs) {
        for (;;) {
            const dueNs = Math.min(this.state.commandDueNs, this.state.arming?.dueNs ?? NEVER);
            this.world.advanceTo(Math.min(timeNs, dueNs));
            if (dueNs <= this.timeNs) {
                this.sendDue();
            }
            if (this.timeNs >= timeNs) {
                return;
            }
        }
    }

    /** Data of the next frame that matches; null after the timeout. */
    advanceUntilFrame(matches, timeoutNs) {
        this.waiting = { matches, found: null };
        for (const endNs = this.timeNs + timeoutNs; this.waiting.found === null && this.timeNs < endNs;) {
            this.advanceTo(Math.min(endNs, this.timeNs + POLL_NS));
        }
        const { found } = this.waiting;
        this.waiting = null;
        return found;
    }

    send(messageName, data) {
        this.world.send(this.messages.message(messageName).id, data);
    }

    latest(messageName) {
        return this.state.latest.get(this.messages.message(messageName).id);
    }

    /** A frame of another client, as a log has it; this client's counters continue from it. */
    frame(identifier, data) {
        const counter = (data[2] + 1) % 256;
        const name = this.messages.list.find((message) => message.id === identifier)?.name;
        if (name === "DRIVE_COMMAND" || name === "DRIVE_TORQUE_COMMAND") {
            this.state.counter = counter;
        } else if (name === "DRIVE_ARM") {
            this.state.armingCounter = this.state.setCounter = counter;
        }
        this.world.send(identifier, data);
    }

    // --- drive ---

    get armed() {
        const report = this.latest("DRIVE_ARMING");
        const { disarmedNs } = this.state;
        return report !== undefined && (disarmedNs === null || report.timeNs > disarmedNs + DISARMED_NS)
            && this.messages.decode("DRIVE_ARMING", report.data).armed === "yes";
    }

    speedReference(rpm) {
        this.#checkRange("DRIVE_COMMAND", "speed_reference_rpm", rpm);
        Object.assign(this.state, { speed_rpm: rpm, torqueMode: false });
        this.ask("run");
    }

    torqueReference(Nm) {
        this.#checkRange("DRIVE_TORQUE_COMMAND", "torque_reference_Nm", Nm);
        Object.assign(this.state, { torque_Nm: Nm, torqueMode: true });
        this.ask("run");
    }

    clearFault() {
        this.ask("off");
        this.ask("clear_fault");
    }

    /** off, run, stop or clear_fault, now and then periodically. A request to run arms a drive that is not armed. */
    ask(request) {
        const { state } = this;
        state.request = request;
        if (request === "run") {
            if (state.arming === null && !this.armed) {
                this.#arm();
            }
        } else {
            state.arming = null;
            if (request !== "stop") {
                state.disarmedNs = this.timeNs;
            }
        }
        this.sendCommand();
    }

    sendCommand() {
        const { state } = this;
        const [name, reference] = state.torqueMode
            ? ["DRIVE_TORQUE_COMMAND", { torque_reference_Nm: state.torque_Nm }]
            : ["DRIVE_COMMAND", { speed_reference_rpm: state.speed_rpm }];
        this.send(name, this.messages.encodeProtected(name, state.counter, { request: state.request, ...reference }));
        state.counter = (state.counter + 1) % 256;
        state.commandDueNs = this.timeNs + COMMAND_PERIOD_NS;
    }

    sendDue() {
        if (this.state.commandDueNs <= this.timeNs) {
            this.sendCommand();
        }
        if (this.state.arming !== null && this.state.arming.dueNs <= this.timeNs) {
            this.#stepArming();
        }
    }

    // --- arming: request, challenge, response ---

    #arm() {
        this.state.arming = { attempts: 0, answered: null, seen: this.latest("DRIVE_ARMING")?.count ?? 0 };
        this.#requestArming();
    }

    #requestArming() {
        const { arming } = this.state;
        Object.assign(arming, { attempts: arming.attempts + 1, answered: null, sentNs: this.timeNs });
        this.#sendArm("request_run", 0);
        arming.dueNs = arming.sentNs + ARMING_FAST_POLL_NS;
    }

    #stepArming() {
        const { state } = this;
        const { arming } = state;
        const report = this.latest("DRIVE_ARMING");
        if (report !== undefined && report.count > arming.seen) {
            arming.seen = report.count;
            const { attempt, armed, challenge } = this.messages.decode("DRIVE_ARMING", report.data);
            if (armed === "yes" && arming.answered !== null) {
                Object.assign(state, { arming: null, disarmedNs: null });
                return;
            }
            if (attempt === "run" && challenge !== arming.answered) {
                arming.answered = challenge;
                this.#sendArm("confirm_run", ~challenge >>> 0);
            } else if (attempt !== "run" && arming.answered !== null) {
                arming.sentNs -= ARMING_RETRY_NS; // the response was refused
            }
        }
        let elapsedNs = this.timeNs - arming.sentNs;
        if (elapsedNs >= ARMING_RETRY_NS) {
            if (arming.attempts === ARMING_ATTEMPTS_MAX) {
                state.arming = null;
                return;
            }
            this.#requestArming();
            elapsedNs = 0;
        }
        arming.dueNs = this.timeNs + (elapsedNs < ARMING_FAST_POLL_FOR_NS ? ARMING_FAST_POLL_NS : ARMING_SLOW_POLL_NS);
    }

    #sendArm(step, response) {
        const { state } = this;
        this.send("DRIVE_ARM", this.messages.encodeProtected("DRIVE_ARM", state.armingCounter, { step, response }));
        state.armingCounter = (state.armingCounter + 1) % 256;
    }

    // --- parameters and memory ---

    /** Reads the descriptions of all parameters, in the drive's order. */
    readRows() {
        const rows = [];
        for (;;) {
            const index = rows.length;
            const [status, bits] = this.#access("fraction_bits", index);
            if (status !== "done") {
                this.rows = rows;
                return;
            }
            const [minimum, maximum, byDefault] = ["minimum", "maximum", "default"].map(
                (what) => this.#access(what, index)[1] / 2 ** bits);
            const [name, unit] = [this.#text("name", index), this.#text("unit", index)];
            rows.push({ index, name, unit, fraction_bits: bits, minimum, maximum, default: byDefault });
        }
    }

    parameters() {
        if (this.rows === null) {
            this.readRows();
        }
        return this.rows.map((row) => ({ ...row, value: this.#access("read", row.index)[1] / 2 ** row.fraction_bits }));
    }

    /** Sets parameters by name, all or none; their descriptions have been read. choices: names of values, by parameter. */
    setParameters(choices, values) {
        const named = (row, value) => choices[row.name]?.[value] ?? (typeof value === "string" ? value : shown(value));
        const mustBe = (row, value) => `${row.name} ${named(row, value)}: must be ${either(choices[row.name])
            ?? `${shown(row.minimum)} to ${shown(row.maximum)} ${row.unit}`}`.trimEnd();
        const writes = Object.entries(values).map(([name, value]) => {
            const row = this.rows.find((each) => each.name === name);
            if (row === undefined) {
                throw new Rejected(`no parameter '${name}'`);
            }
            const number = typeof value === "string" ? choices[name]?.indexOf(value) ?? -1 : value;
            const raw = rounded(number * 2 ** row.fraction_bits);
            if (!(raw >= -(2 ** 31) && raw < 2 ** 31) || (number < 0 && typeof value === "string")) {
                throw new Rejected(mustBe(row, value));
            }
            return { row, value, raw };
        });
        if (writes.length === 0) {
            return;
        }
        const { status, index, other } = this.#sendSet((counter) => this.#setFrames(counter, writes));
        const [row, second] = [this.rows[index], this.rows[other]];
        const value = writes.find((write) => write.row === row)?.value;
        if (status === "out_of_range") {
            throw new Rejected(mustBe(row, value));
        } else if (status === "contradiction") {
            throw new Rejected(`${row.name} ${named(row, value ?? row.default)}: contradicts ${second.name}`);
        } else if (status !== "done") {
            throw new Rejected(`${value === undefined ? Object.keys(values).join(", ") : `${row.name} ${named(row, value)}`}: ${status}`);
        }
    }

    saveParameters() {
        const { status } = this.#sendSet((counter) => [this.#control(counter, "save", 0)]);
        if (status !== "done") {
            throw new Rejected(`save: ${status}`);
        }
        const endNs = this.timeNs + SAVE_TIMEOUT_NS;
        let saving = this.#memory("saving");
        while (saving === 1 && this.timeNs < endNs) {
            saving = this.#memory("saving"); // each request takes time
        }
        if (saving !== 2) {
            throw new Rejected(saving === 1 ? "save: not stored in time" : "save: the memory does not accept the parameters");
        }
    }

    faultTrace() {
        const { phases, control_rate_hz: rate } = this.messages.decode("DRIVE_HEARTBEAT",
                                                                       this.latest("DRIVE_HEARTBEAT").data);
        const parts = TRACE_PARTS + (phases > TRACE_PHASES ? TRACE_MORE_PARTS : 0);
        const raw = [];
        for (let period = 0; period < TRACE_PERIODS; period++) {
            const row = [];
            for (let part = 0; part < parts; part++) {
                const [status, value] = this.#access("fault_trace", period, part);
                if (status !== "done") {
                    throw new Rejected(`fault trace: ${status}`);
                }
                row.push((value << 16) >> 16, value >> 16);
            }
            raw.push(row);
        }
        const factor = (name) => this.messages.signal("DRIVE_FAULT_SNAPSHOT", name).factor;
        const columns = (first, more, scale) => raw.map((row) =>
            [...row.slice(first, first + TRACE_PHASES), row[more], row[more + 1]].slice(0, phases)
                .map((value) => (value & 0xffff) * scale));
        return {
            time_s: raw.map((_, period) => (period + 1 - TRACE_PERIODS) / rate),
            current_A: columns(0, 16, factor("current_max_A")),
            bus_voltage_V: raw.map((row) => (row[4] & 0xffff) * factor("bus_voltage_V")),
            rotor_angle_deg: raw.map((row) => (row[5] & 0xffff) * 360 / 65536),
            speed_rpm: raw.map((row) => row[6] * factor("speed_rpm")),
            torque_reference_Nm: raw.map((row) => row[7] * factor("torque_reference_Nm")),
            upper_duty: columns(8, 18, 1 / 32768),
            lower_duty: columns(8 + TRACE_PHASES, 20, 1 / 32768),
        };
    }

    faultLog() {
        const newest = this.#memory("newest_fault");
        const found = [];
        for (let number = Math.max(1, newest - LOGGED_FAULTS + 1); number <= newest; number++) {
            const items = FAULT_ITEMS.map((_, part) => this.#access("fault_log", 0, part, number));
            if (items.every(([status]) => status === "done")) {
                found.push(this.#loggedFault(number, items.map(([, value]) => value)));
            }
        }
        return found;
    }

    #loggedFault(number, [fault, state, checks, start, timeUs, wraps, ...snapshot]) {
        const names = this.messages.signal("DRIVE_STATUS", "fault").choices;
        const physical = FAULT_ITEMS.slice(6).map((name, i) => [
            name, snapshot[i] * this.messages.signal("DRIVE_FAULT_SNAPSHOT", name).factor]);
        return {
            number, start, time_s: (wraps * 2 ** 32 + (timeUs >>> 0)) / 1e6, fault: names[fault] ?? String(fault),
            checks: Object.keys(names).filter((value) => value > 0 && (checks >>> value) & 1).map((value) => names[value]),
            state: this.messages.signal("DRIVE_STATUS", "state").choices[state] ?? String(state),
            ...Object.fromEntries(physical),
        };
    }

    #memory(item) {
        return this.#access("memory", 0, MEMORY_ITEMS.indexOf(item))[1];
    }

    #text(what, index) {
        let text = "";
        for (let part = 0; part < TEXT_PARTS_MAX; part++) {
            const word = this.#access(what, index, part)[1];
            const bytes = [word, word >> 8, word >> 16, word >> 24].map((byte) => byte & 0xff);
            text += String.fromCharCode(...bytes.filter((byte) => byte !== 0));
            if (bytes[3] === 0) {
                break;
            }
        }
        return text;
    }

    /** [status, value] of the drive's response. */
    #access(operation, index, part = 0, value = 0) {
        const code = this.messages.number("PARAMETER_REQUEST", "operation", operation);
        const { id } = this.messages.message("PARAMETER_RESPONSE");
        for (let attempt = 0; attempt < RESPONSE_ATTEMPTS; attempt++) {
            this.send("PARAMETER_REQUEST", this.messages.encode("PARAMETER_REQUEST", { operation, index, part, value }));
            const data = this.advanceUntilFrame((identifier, bytes) => identifier === id && bytes[0] === code
                && bytes[1] === index && bytes[2] === part, RESPONSE_TIMEOUT_NS);
            if (data !== null) {
                const response = this.messages.decode("PARAMETER_RESPONSE", data);
                return [response.status, response.value];
            }
        }
        throw new Rejected("the drive does not respond");
    }

    #control(counter, step, check) {
        return ["PARAMETER_SET_CONTROL", this.messages.encodeProtected("PARAMETER_SET_CONTROL", counter, { step, check })];
    }

    #setFrames(counter, writes) {
        const frames = [this.#control(counter, "begin", 0)];
        let check = 0;
        for (const { row, raw } of writes) {
            const data = this.messages.encodeProtected("PARAMETER_WRITE", counter + frames.length,
                                                       { index: row.index, value: raw });
            check = crc32(data.subarray(HEADER_BYTES), check);
            frames.push(["PARAMETER_WRITE", data]);
        }
        return [...frames, this.#control(counter + frames.length, "apply", check)];
    }

    #sendSet(framesFrom) {
        let result = { status: "no_challenge" };
        for (let attempt = 0; attempt < SET_ATTEMPTS && SET_REPEATED.includes(result.status); attempt++) {
            result = this.#trySet(framesFrom);
        }
        return result;
    }

    #trySet(framesFrom) {
        const counter = this.state.setCounter;
        const arm = (at, values) => this.send("DRIVE_ARM", this.messages.encodeProtected("DRIVE_ARM", at, values));
        arm(counter, { step: "request_configuration", response: 0 });
        const report = this.#messageWith("DRIVE_ARMING", (values) => values.attempt === "configuration",
                                         CHALLENGE_TIMEOUT_NS);
        if (report === null) {
            return { status: "no_challenge" };
        }
        arm(counter + 1, { step: "confirm_configuration", response: ~report.challenge >>> 0 });
        const frames = framesFrom(counter + 2);
        this.state.setCounter = (counter + 2 + frames.length) % 256;
        frames.forEach(([name, data]) => this.send(name, data));
        const last = frames.at(-1)[1];
        const response = this.#messageWith("PARAMETER_RESPONSE", (values) => values.operation === "set_control"
            && values.value === ((last[2] << 8) | last[3]), RESPONSE_TIMEOUT_NS, (data) => ({ index: data[1], other: data[2] }));
        return response === null ? { status: "no_response" } : response;
    }

    #messageWith(name, matches, timeoutNs, more = () => ({})) {
        const { id } = this.messages.message(name);
        const data = this.advanceUntilFrame((identifier, bytes) => identifier === id
            && matches(this.messages.decode(name, bytes)), timeoutNs);
        return data === null ? null : { ...this.messages.decode(name, data), ...more(data) };
    }

    // --- bench ---

    /** Sets a variable of the bench, now. */
    set(name, value) {
        this.#checkRange("RIG_SET", this.#signal(name, true).name, value, name);
        const signal = this.#signal(name, !this.#inRange(this.#signal(name, false), value));
        const [quantity] = signal.multiplexed;
        this.#request("RIG_SET", { quantity, [signal.name]: value }, `${name} ${shown(value)}`);
    }

    /** The signal of a variable, or the one that carries it beyond the range of that. */
    #signal(name, coarse) {
        const wide = this.messages.signal("RIG_SET", name.replace("_Nm", "_coarse_Nm"));
        return (coarse && wide) || this.messages.signal("RIG_SET", name);
    }

    /** What ends a fault: values of RIG_FAULT, and the definition of its kind. */
    #endingOf(kinds, { kind, phase, leg }) {
        const definition = kinds.find((each) => each.name === kind);
        if (definition === undefined) {
            throw new Rejected(`no fault '${kind}'`);
        }
        const places = {};
        for (const [name, given] of Object.entries({ phase, leg })) {
            if (definition[name] && given === undefined) {
                throw new Rejected(`${kind}: ${name} missing`);
            }
            if (definition[name]) {
                places[`${kind}_${name}`] = given;
            }
        }
        const ending = { kind, ...places };
        if (definition.attribute !== null) {
            const { name, minimum } = definition.attribute;
            ending[`${kind}_${name}`] = Math.max(0, minimum); // without a meaning at the end
        }
        return { definition, ending };
    }

    /** Begins a fault; value: of its attribute. Without a duration it ends by endFault or endFaults. */
    fault(kinds, { kind, phase, leg, value, duration_s: durationS }) {
        const { definition, ending } = this.#endingOf(kinds, { kind, phase, leg });
        const { attribute } = definition;
        if (attribute !== null) {
            const good = attribute.choices ? attribute.choices.includes(value)
                : typeof value === "number" && value >= attribute.minimum && value <= attribute.maximum;
            if (!good) {
                throw new Rejected(`${kind}: ${attribute.name} must be ${attribute.choices?.join(", ")
                    ?? `${shown(attribute.minimum)} to ${shown(attribute.maximum)} ${attribute.unit}`}`);
            }
        }
        const beginning = attribute === null ? ending : { ...ending, [`${kind}_${attribute.name}`]: value };
        const startUs = Math.ceil(this.timeNs / 1000);
        this.#request("RIG_FAULT", { ...beginning, [kind]: "begins" }, kind);
        if (durationS === undefined) {
            this.state.faults.push(ending);
        } else {
            this.#request("RIG_FAULT", { ...ending, [kind]: "ends", at_us: startUs + durationS * 1e6 }, kind);
        }
    }

    /** Ends a fault at its places, also one that another client has begun. */
    endFault(kinds, args) {
        const { ending } = this.#endingOf(kinds, args);
        this.#request("RIG_FAULT", { ...ending, [ending.kind]: "ends" }, ending.kind);
    }

    endFaults() {
        for (const ending of this.state.faults.splice(0)) {
            this.#request("RIG_FAULT", { ...ending, [ending.kind]: "ends" }, ending.kind);
        }
    }

    /** Sends a request to the bench, which answers at once. */
    #request(name, values, text) {
        this.waiting = { matches: (identifier) => identifier === this.messages.message(`${name}_REPLY`).id, found: null };
        this.send(name, this.messages.encode(name, values));
        const { found } = this.waiting;
        this.waiting = null;
        const status = found === null ? "no answer" : this.messages.decode(`${name}_REPLY`, found).status;
        if (status !== "done") {
            throw new Rejected(`${text}: ${status}`);
        }
    }

    #inRange(signal, value) {
        return value >= signal.minimum && value <= signal.maximum;
    }

    #checkRange(messageName, signalName, value, name = signalName) {
        const signal = this.messages.signal(messageName, signalName);
        if (!this.#inRange(signal, value)) {
            throw new Rejected(`${name} ${shown(value)}: must be ${shown(signal.minimum)} to ${shown(signal.maximum)} ${signal.unit}`);
        }
    }
}
