// The drive's triggered buffer by XCP on CAN (firmware/comms/xcp.h), as salient.bench.sampler has it.

import { Rejected } from "./client.js";

const RESPONSE = 0xff;
const ERROR = 0xfe;
const [CONNECT, DISCONNECT, GET_SEED, UNLOCK, SET_MTA, UPLOAD, SHORT_UPLOAD, DOWNLOAD]
    = [0xff, 0xfe, 0xf8, 0xf7, 0xf6, 0xf5, 0xf4, 0xf0];
const DATA_BYTES = 7; // of a response
const UPLOAD_BYTES_MAX = 252; // whole responses
const RESOURCE_DAQ = 4;
const TIMEOUT_NS = 100e6;
const AREA_SCOPE = 0x20000000;
const AT_CONTROL = 1; // sampler_event_t
const [ARM, TRIGGER] = [1, 2];
const CHANNELS_MAX = 8;
const DIVIDER_MAX = 65535;
const WORD_BYTES = 4;
const WORD_BITS = 32;

const word = (value) => [value, value >> 8, value >> 16, value >> 24].map((byte) => byte & 0xff);

/** The data of all responses to a command, of which there are `count`. */
function command(client, bytes, count = 1) {
    const { id } = client.messages.message("XCP_RESPONSE");
    const responses = [];
    client.send("XCP_COMMAND", Uint8Array.from([...bytes, ...new Array(8 - bytes.length).fill(0)]));
    const last = client.advanceUntilFrame((identifier, data) => {
        if (identifier !== id || data[0] < ERROR) {
            return false;
        }
        responses.push(data.slice(1, 8));
        return data[0] === ERROR || responses.length === count;
    }, TIMEOUT_NS);
    if (last === null || last[0] !== RESPONSE) {
        throw new Rejected(last === null ? "XCP: the drive does not respond" : `XCP: error 0x${last[1].toString(16)}`);
    }
    return responses;
}

/** Does something in a session of its own, with resource DAQ. */
function connected(client, action) {
    command(client, [CONNECT]);
    const [[bytes, ...rest]] = command(client, [GET_SEED, 0, RESOURCE_DAQ]);
    command(client, [UNLOCK, bytes, ...rest.slice(0, bytes).map((byte) => ~byte)]);
    const result = action();
    command(client, [DISCONNECT]);
    return result;
}

function write(client, first, values) {
    command(client, [SET_MTA, 0, 0, 0, ...word(AREA_SCOPE + WORD_BYTES * first)]);
    values.forEach((value) => command(client, [DOWNLOAD, WORD_BYTES, ...word(value)]));
}

function member(client, variables, name) {
    const { address, bytes } = variables.variable(`sampler.${name}`);
    const [data] = command(client, [SHORT_UPLOAD, bytes, 0, 0, ...word(address)]);
    return data.slice(0, bytes).reduceRight((sum, byte) => sum * 256 + byte, 0);
}

/** Arms the buffer. args: of scope_arm (view/page/source.js); signals also as one text with commas. */
export function armBuffer(client, variables, { signals, trigger = "", before = 0.25, divider = 1 }) {
    const channels = String(signals).split(",").filter(Boolean).map((name) => variables.variable(name));
    const { variable, condition, level } = variables.trigger(String(trigger));
    if (channels.length < 1 || channels.length > CHANNELS_MAX) {
        throw new Rejected(`signals: must be 1 to ${CHANNELS_MAX} names`);
    } else if (!Number.isInteger(divider) || divider < 1 || divider > DIVIDER_MAX) {
        throw new Rejected(`divider ${divider}: must be a whole number from 1 to ${DIVIDER_MAX}`);
    } else if (!(before >= 0 && before < 1)) {
        throw new Rejected(`before ${before}: must be from 0 to below 1, the part before the trigger`);
    }
    const { control_rate_hz: rate } = client.messages.decode("DRIVE_HEARTBEAT", client.latest("DRIVE_HEARTBEAT")?.data
        ?? new Uint8Array(8));
    if (rate === 0) {
        throw new Rejected("no heartbeat of the drive yet: its control rate is not known");
    }
    const capacity = Math.ceil(variables.ring.words / channels.length);
    const of = variable ?? channels[0];
    const setup = [AT_CONTROL, divider, Math.min(Math.trunc(before * capacity), capacity - 2), condition, level, of.address,
                   WORD_BITS - 8 * (of.address % WORD_BYTES + of.bytes), WORD_BITS - 8 * of.bytes, Number(of.signed),
                   channels.length, ...channels.map(({ address }) => address - address % WORD_BYTES)];
    connected(client, () => {
        write(client, 1, setup);
        write(client, 0, [ARM]);
    });
    client.state.buffer = { title: trigger || "at once", names: channels.map(({ name }) => name), step_s: divider / rate,
                            period_s: 1 / rate };
}

function armed(client) {
    if (client.state.buffer === null) {
        throw new Rejected("the buffer is not armed");
    }
    return client.state.buffer;
}

/** Triggers now, whatever the condition. */
export function triggerBuffer(client) {
    armed(client);
    connected(client, () => write(client, 0, [TRIGGER]));
}

/** The contents as the answer to scope_read has them. */
export function readBuffer(client, variables) {
    const { title, names, step_s: stepS, period_s: periodS } = armed(client);
    command(client, [CONNECT]);
    if (variables.variable("sampler.state").choices[member(client, variables, "state")] !== "complete") {
        return { state: "waits" };
    }
    const members = ["record_words", "capacity", "place", "trigger_left", "trigger_events"];
    const [recordWords, capacity, place, left, late] = members.map((name) => member(client, variables, name));
    const bytes = uploaded(client, variables.ring.address, WORD_BYTES * recordWords * capacity);
    const view = new DataView(bytes.buffer);
    const signals = names.map((name, column) => {
        const { address, bytes: size, signed, unit, choices, factor } = variables.variable(name);
        const read = view[`get${signed ? "Int" : "Uint"}${8 * size}`].bind(view);
        const values = Array.from({ length: capacity }, (_, record) => {
            const at = (place + record * recordWords + column) % (recordWords * capacity);
            return read(WORD_BYTES * at + address % WORD_BYTES, true) * factor;
        });
        return { name, unit, values, choices };
    });
    const time_s = Array.from({ length: capacity }, (_, record) => (record - (capacity - left)) * stepS + late * periodS);
    return { state: "complete", title, time_s, signals };
}

function uploaded(client, address, size) {
    const read = new Uint8Array(size);
    command(client, [SET_MTA, 0, 0, 0, ...word(address)]);
    for (let at = 0; at < size; at += UPLOAD_BYTES_MAX) {
        const part = Math.min(UPLOAD_BYTES_MAX, size - at);
        const responses = command(client, [UPLOAD, part], Math.ceil(part / DATA_BYTES));
        read.set(responses.flatMap((data) => [...data]).slice(0, part), at);
    }
    return read;
}
