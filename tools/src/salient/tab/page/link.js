// Links that reproduce a run: build, machine, options, events, and what they lead to.
//
//     #build=0123456789ab&machine=saturating&seed=1&events=0.05:speed_reference:rpm=600;0.2:load_torque:Nm=8
//
// events: time in seconds, command of COMMANDS, its arguments; a set of parameters has their names as arguments.
// frames: instead or before them, all frames of another client, packed (salient.tab.link). until, hash: time at which the
// link was made, where time stops, and the bits that there were.

import { EVENTS } from "./run.js";

const OPTIONS = ["controller", "control_rate_hz", "encoder_bits", "encoder_edges", "adc_bits", "immediate_pwm", "seed",
                 "initial_angle_deg", "bit_rate", "telemetry_period_ms"];
const DEFAULT_MACHINE = "saturating";

const seconds = (timeNs) => (timeNs / 1e9).toFixed(9).replace(/\.?0+$/, "");
const nanoseconds = (text) => {
    const time = Math.round(Number(text) * 1e9);
    if (!Number.isFinite(time) || time < 0 || text === "") {
        throw new Error(`The link has a time '${text}'; it must be in seconds.`);
    }
    return time;
};
const valueOf = (text) => (text !== "" && Number.isFinite(Number(text)) ? Number(text) : text);

function eventText({ timeNs, name, args }) {
    const list = Object.entries(name === "set_parameters" ? args.values : args).filter(([, value]) => value !== undefined)
        .map(([key, value]) => `${key}=${encodeURIComponent(value)}`);
    return [seconds(timeNs), name, ...(list.length ? [list.join(",")] : [])].join(":");
}

function eventOf(text) {
    const [time, name, list = ""] = text.split(":");
    const args = Object.fromEntries(list.split(",").filter(Boolean).map((pair) => {
        const [key, value = ""] = pair.split("=");
        return [key, valueOf(decodeURIComponent(value))];
    }));
    if (!EVENTS.includes(name)) {
        throw new Error(`The link has no command '${name}'; there are ${EVENTS.join(", ")}.`);
    }
    return { timeNs: nanoseconds(time), name, args: name === "set_parameters" ? { values: args } : args };
}

async function inflated(text) {
    const bytes = Uint8Array.from(atob(text.replaceAll("-", "+").replaceAll("_", "/")), (each) => each.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
}

async function deflated(bytes) {
    const stream = new Blob([bytes]).stream().pipeThrough(new CompressionStream("deflate"));
    const packed = new Uint8Array(await new Response(stream).arrayBuffer());
    return btoa(String.fromCharCode(...packed)).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}

/** Frames: for each the time since the last one in ns (64 bits), identifier (32 bits), length and data. */
function framesOf(bytes) {
    const view = new DataView(bytes.buffer);
    const frames = [];
    for (let at = 0, timeNs = 0; at < bytes.length;) {
        timeNs += view.getUint32(at, true) + view.getUint32(at + 4, true) * 2 ** 32;
        const length = view.getUint8(at + 12);
        frames.push({ timeNs, name: "frame",
                      args: { id: view.getUint32(at + 8, true), data: bytes.slice(at + 13, at + 13 + length) } });
        at += 13 + length;
    }
    return frames;
}

function packed(frames) {
    const bytes = new Uint8Array(frames.reduce((sum, { args }) => sum + 13 + args.data.length, 0));
    const view = new DataView(bytes.buffer);
    let [at, before] = [0, 0];
    for (const { timeNs, args } of frames) {
        view.setUint32(at, (timeNs - before) % 2 ** 32, true);
        view.setUint32(at + 4, Math.floor((timeNs - before) / 2 ** 32), true);
        view.setUint32(at + 8, args.id, true);
        view.setUint8(at + 12, args.data.length);
        bytes.set(args.data, at + 13);
        [at, before] = [at + 13 + args.data.length, timeNs];
    }
    return bytes;
}

/** Part of a link from its # on; events as of a Run, done or ahead. */
export async function writeLink({ build, machine, options, events, untilNs, hash }) {
    const parts = [`build=${build}`, `machine=${encodeURIComponent(machine)}`];
    for (const name of OPTIONS.filter((each) => options[each] !== undefined)) {
        parts.push(`${name}=${encodeURIComponent(options[name])}`);
    }
    const frames = events.filter(({ name }) => name === "frame");
    if (frames.length > 0) {
        parts.push(`frames=${await deflated(packed(frames))}`);
    }
    parts.push(`events=${events.filter(({ name }) => name !== "frame").map(eventText).join(";")}`);
    if (hash !== undefined) {
        parts.push(`until=${seconds(untilNs)}`, `hash=${hash}`);
    }
    return `#${parts.join("&")}`;
}

/** { build, machine, options, events, untilNs, hash } of a link; absent ones undefined. Error for the user. */
export async function readLink(text) {
    const values = Object.fromEntries(text.replace(/^#/, "").split("&").filter(Boolean).map((part) => {
        const at = part.indexOf("=");
        return [part.slice(0, at), part.slice(at + 1)];
    }));
    const options = {};
    for (const [name, value] of Object.entries(values)) {
        if (OPTIONS.includes(name)) {
            options[name] = value === "true" ? true : decodeURIComponent(value);
        } else if (!["build", "machine", "events", "frames", "until", "hash"].includes(name)) {
            throw new Error(`The link has '${name}'; there are build, machine, events, frames, until, hash, `
                            + `${OPTIONS.join(", ")}.`);
        }
    }
    const frames = values.frames ? framesOf(await inflated(values.frames)) : [];
    const events = (values.events ?? "").split(";").filter(Boolean).map(eventOf);
    return {
        build: values.build, machine: decodeURIComponent(values.machine ?? DEFAULT_MACHINE), options,
        events: [...frames, ...events].sort((a, b) => a.timeNs - b.timeNs),
        untilNs: values.until === undefined ? undefined : nanoseconds(values.until), hash: values.hash,
        empty: Object.keys(values).length === 0,
    };
}
