// The drive and its bench in WebAssembly (emulator/wasm/reactor.c): frames in, time forward, frames out, snapshots.
// For a page and for Node.

const CAN_MTU = 16; // bytes of a classic frame in Linux's layout
const RUN_UNTIL = 0x9f000001; // RIG_RUN_UNTIL
const CLOCK = 0x9f000002; // RIG_CLOCK
const NO_SYSTEM = 52; // ENOSYS of WASI

/** The bench refuses its options; the message is its line. */
export class Refused extends Error {}

/** A bench with its drive. Its linear memory is its whole state. */
export class World {
    #exports;
    #slot; // address where a frame is handed over
    #errors = "";

    /** receive(records): a part of the frames that the bench sends, as bytes, valid during the call: 64-bit time and
     *  frame, as on the local bus. recording: where rows and compareValues go, when the arguments ask for them. */
    constructor(receive, recording = {}) {
        this.receive = receive;
        this.recording = recording;
    }

    /** options: of the host executable, by name. */
    async start(module, machineImage, options) {
        const part = (address, bytes) => new Uint8Array(this.#exports.memory.buffer, address, bytes);
        const refuse = () => NO_SYSTEM;
        const instance = await WebAssembly.instantiate(module, {
            bench: {
                frames: (address, bytes) => this.receive(part(address, bytes)),
                compare_values: (address, bytes) => this.recording.compareValues?.(part(address, bytes)),
                rows: (address, bytes) => this.recording.rows?.(part(address, bytes)),
            },
            wasi_snapshot_preview1: {
                clock_time_get: refuse,
                fd_close: refuse,
                fd_fdstat_get: refuse,
                fd_seek: refuse,
                fd_write: (file, vectors, count, written) => this.#print(vectors, count, written),
                poll_oneoff: refuse,
            },
        });
        this.#exports = instance.exports;
        this.#exports._initialize();
        const line = ["salient", "--can", "unix:tab", "--machine-image", "machine"];
        for (const [name, value] of Object.entries(options)) {
            line.push(`--${name.replaceAll("_", "-")}`, ...(value === true ? [] : [String(value)]));
        }
        const list = this.#place(new TextEncoder().encode(line.map((word) => `${word}\0`).join("")));
        const image = this.#place(machineImage);
        if (!this.#exports.start(...list, ...image)) {
            throw new Refused(this.#errors.trim().replace(/^salient: /, "") || "the drive rejects its options");
        }
        this.#slot = this.#exports.slot();
    }

    /** Virtual time; a whole number. */
    get timeNs() {
        return this.#exports.time_ns();
    }

    /** 16 hexadecimal digits over the true state at every control interrupt and every frame with its time: equal for
     *  equal runs, however time was divided into steps. */
    get hash() {
        const word = (value) => (value >>> 0).toString(16).padStart(8, "0");
        return word(this.#exports.hash_high()) + word(this.#exports.hash_low());
    }

    /** Bytes of the linear memory. */
    get memoryBytes() {
        return this.#exports.memory.buffer.byteLength;
    }

    /** Hands over a frame in Linux's layout; false when the bench does not take it. */
    takeFrame(bytes) {
        new Uint8Array(this.#exports.memory.buffer, this.#slot, bytes.length).set(bytes);
        return this.#exports.take(bytes.length) !== 0;
    }

    /** Sends a classic frame; identifier as can_id of Linux. */
    send(identifier, data) {
        const view = new DataView(this.#exports.memory.buffer, this.#slot, CAN_MTU);
        view.setUint32(0, identifier, true);
        view.setUint32(4, data.length, true);
        for (let i = 0; i < 8; i++) {
            view.setUint8(8 + i, i < data.length ? data[i] : 0);
        }
        return this.#exports.take(CAN_MTU) !== 0;
    }

    /** Lets time pass until timeNs, a whole number. */
    advanceTo(timeNs) {
        if (timeNs <= this.timeNs) {
            return;
        }
        const data = new Uint8Array(7); // 48 bits of time, a sequence number
        for (let i = 0, rest = timeNs; i < 6; i++, rest = Math.floor(rest / 256)) {
            data[i] = rest % 256;
        }
        this.send(RUN_UNTIL, data);
    }

    /** The state: a copy of the memory, of half a megabyte. */
    snapshot() {
        return new Uint8Array(this.#exports.memory.buffer).slice();
    }

    /** Puts a state of this world back, to the bit. */
    restore(snapshot) {
        const memory = new Uint8Array(this.#exports.memory.buffer);
        memory.set(snapshot);
        memory.fill(0, snapshot.length); // it may have grown since
    }

    /** Ends a recording; returns the header of the file of its rows. */
    finish() {
        return new Uint8Array(this.#exports.memory.buffer, this.#exports.finish(), 1024).slice();
    }

    #place(bytes) {
        const address = this.#exports.allocate(bytes.length);
        new Uint8Array(this.#exports.memory.buffer, address, bytes.length).set(bytes);
        return [address, bytes.length];
    }

    #print(vectors, count, written) {
        const view = new DataView(this.#exports.memory.buffer);
        let total = 0;
        for (let i = 0; i < count; i++) {
            const [address, bytes] = [view.getUint32(vectors + 8 * i, true), view.getUint32(vectors + 8 * i + 4, true)];
            this.#errors += new TextDecoder().decode(new Uint8Array(view.buffer, address, bytes));
            total += bytes;
        }
        view.setUint32(written, total, true);
        return 0;
    }
}

/** Calls take(timeNs, identifier, length, data) for each classic frame of the records; data is valid during the call. */
export function eachFrame(records, take) {
    const view = new DataView(records.buffer, records.byteOffset, records.byteLength);
    for (let at = 0; at + 24 <= records.length; at += 24) {
        const timeNs = view.getUint32(at, true) + view.getUint32(at + 4, true) * 2 ** 32;
        take(timeNs, view.getUint32(at + 8, true), view.getUint8(at + 12), records.subarray(at + 16, at + 24));
    }
}

/** True for the frames by which this module moves time: no part of what is on the bus. */
export function movesTime(identifier) {
    return identifier === RUN_UNTIL || identifier === CLOCK;
}
