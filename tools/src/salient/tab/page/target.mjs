// The drive in Node, for the tools: frames from standard input, records to standard output, each with its size in front.
//
//     node target.mjs MODULE.wasm < requests
//
// The first request is JSON: { options, image, record, record_switches }, the last two the names of files. Those after it
// are frames, as on the local bus.

import { closeSync, openSync, readFileSync, readSync, writeSync } from "node:fs";
import { Refused, World } from "./world.js";

const head = new Uint8Array(4);

function readExactly(buffer) {
    for (let at = 0; at < buffer.length;) {
        const size = readSync(0, buffer, at, buffer.length - at, null);
        if (size === 0) {
            return false;
        }
        at += size;
    }
    return true;
}

/** The next request; null at the end. */
function request() {
    if (!readExactly(head)) {
        return null;
    }
    const bytes = new Uint8Array(new DataView(head.buffer).getUint32(0, true));
    return readExactly(bytes) ? bytes : null;
}

function write(file, bytes) {
    for (let at = 0; at < bytes.length;) {
        at += writeSync(file, bytes, at, bytes.length - at, null);
    }
}

/** One answer: all records since the last one. */
function answer(parts) {
    const size = parts.reduce((sum, part) => sum + part.length, 0);
    new DataView(head.buffer).setUint32(0, size, true);
    write(1, head);
    parts.forEach((part) => write(1, part));
}

const setting = JSON.parse(new TextDecoder().decode(request()));
const files = {};
for (const name of ["record", "record_switches"]) {
    if (setting[name]) {
        files[name] = openSync(setting[name], "w");
    }
}
let parts = [];
const world = new World((records) => parts.push(records.slice()), {
    rows: (bytes) => write(files.record, bytes),
    compareValues: (bytes) => write(files.record_switches, bytes),
});
try {
    const module = await WebAssembly.compile(readFileSync(process.argv[2]));
    await world.start(module, readFileSync(setting.image), setting.options);
} catch (error) {
    if (!(error instanceof Refused)) {
        throw error;
    }
    process.stderr.write(`salient: ${error.message}\n`);
    process.exit(2);
}
if (files.record) {
    write(files.record, new Uint8Array(1024)); // its header, at the end
}
answer([]);
for (let frame = request(); frame !== null; frame = request()) {
    parts = [];
    world.takeFrame(frame);
    answer(parts);
}
if (files.record) {
    const header = world.finish();
    for (let at = 0; at < header.length;) {
        at += writeSync(files.record, header, at, header.length - at, at);
    }
}
Object.values(files).forEach(closeSync);
