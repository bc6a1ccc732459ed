// The frames that have come, by message, and the signals that somebody looks at, decoded as they come.

import { decoderOf, presenceOf } from "./decoder.js";

/** Messages whose values the drive has read at the time that its last DRIVE_STATUS states. */
const STAMPED = new Set(["DRIVE_STATUS", "DRIVE_MOTION", "DRIVE_TORQUE", "DRIVE_CURRENTS", "DRIVE_PHASES_E_F"]);
const STAMP_AGE_MAX_NS = 20e6;

/** Times and values that grow at their end; with a limit the oldest go. */
class Series {
    constructor(width, keep) {
        this.width = width; // values per time
        this.keep = keep;
        this.time = new Float64Array(1024);
        this.value = width === 1 ? new Float64Array(1024) : new Uint32Array(2048);
        this.size = 0;
    }

    makeRoom() {
        if (this.size < this.time.length) {
            return;
        }
        if (this.size >= 2 * this.keep) {
            const from = this.size - this.keep;
            this.time.copyWithin(0, from, this.size);
            this.value.copyWithin(0, from * this.width, this.size * this.width);
            this.size = this.keep;
            return;
        }
        const room = Math.min(2 * this.time.length, 2 * this.keep);
        const time = new Float64Array(room);
        const value = new this.value.constructor(room * this.width);
        time.set(this.time);
        value.set(this.value);
        this.time = time;
        this.value = value;
    }

    /** Index of the first entry at or after a time. */
    indexAt(time_ns) {
        let low = 0;
        let high = this.size;
        while (low < high) {
            const middle = (low + high) >> 1;
            if (this.time[middle] < time_ns) {
                low = middle + 1;
            } else {
                high = middle;
            }
        }
        return low;
    }

    cutFrom(time_ns) {
        this.size = this.indexAt(time_ns);
    }
}

/** One signal over time: `time[i]` in ns, `value[i]`, for i below `size`. */
export class SignalSeries extends Series {
    constructor(message, signal, keep) {
        super(1, keep);
        this.message = message;
        this.signal = signal;
        this.name = `${message.name}.${signal.name}`;
        this.decode = decoderOf(signal);
        this.isPresent = presenceOf(message, signal);
    }

    take(time_ns, low, high) {
        if (this.isPresent(low, high)) {
            this.makeRoom();
            this.time[this.size] = time_ns;
            this.value[this.size] = this.decode(low, high);
            this.size += 1;
        }
    }

    get last() {
        return this.size ? this.value[this.size - 1] : NaN;
    }

    /** The latest value at a time; NaN before the first. */
    at(time_ns) {
        const after = this.indexAt(time_ns + 1);
        return after ? this.value[after - 1] : NaN;
    }

    /** The value at a time on the line between its neighbours. */
    between(time_ns) {
        const after = this.indexAt(time_ns);
        if (after === 0 || after === this.size) {
            return this.at(time_ns);
        }
        const [before, next] = [this.time[after - 1], this.time[after]];
        const part = next > before ? (time_ns - before) / (next - before) : 1;
        return this.value[after - 1] + part * (this.value[after] - this.value[after - 1]);
    }
}

export class Store {
    /** messages: of the source's Info; keep: frames of a message that are kept at least, the older ones may go. */
    constructor(messages, keep) {
        this.keep = keep;
        this.messages = messages;
        this.frames = 0;
        this.unknown = 0;
        this.lost = 0;
        this.first_ns = NaN;
        this.last_ns = NaN;
        this.byId = new Map(messages.map((message) => [message.id, { message, raw: new Series(2, keep), count: 0,
                                                                     watched: [] }]));
        this.byGroup = new Map(messages.filter((message) => message.group !== undefined)
            .map((message) => [message.group, this.byId.get(message.id)]));
        this.byName = new Map([...this.byId.values()].map((entry) => [entry.message.name, entry]));
        this.series = new Map();
        this.status = this.byName.get("DRIVE_STATUS");
        this.cycle = { last: -1, step: 0, candidate: 0, doubt: 0 };
        this.stampOffset_ns = 0;
        this.stamp_ns = NaN;
    }

    /** The series of "MESSAGE.signal", from the frames that are kept on; undefined when there is none of that name. */
    watch(name) {
        if (!this.series.has(name)) {
            const [messageName, signalName] = name.split(".");
            const entry = this.byName.get(messageName);
            const signal = entry && entry.message.signals.find((candidate) => candidate.name === signalName);
            if (!signal) {
                return undefined;
            }
            const series = new SignalSeries(entry.message, signal, this.keep);
            for (let i = 0; i < entry.raw.size; i++) {
                series.take(entry.raw.time[i], entry.raw.value[2 * i], entry.raw.value[2 * i + 1]);
            }
            entry.watched.push(series);
            this.series.set(name, series);
        }
        return this.series.get(name);
    }

    /** Number of frames of a message that have come. */
    count(messageName) {
        const entry = this.byName.get(messageName);
        return entry ? entry.count : 0;
    }

    /** The entry of a J1939 message by its parameter group, as FrameKeys of salient.bus.signals. */
    ofGroup(id) {
        return this.byGroup.size === 0 || id < 0x80000000 ? undefined
            : this.byGroup.get(id & ((id >>> 16 & 0xff) >= 240 ? 0x03ffff00 : 0x03ff0000));
    }

    /** Takes a batch of a source. */
    add(batch) {
        if (batch.rewound && batch.count) {
            this.forgetFrom(batch.time_ns[0]);
        }
        const words = batch.data.byteOffset % 4 === 0
            ? new Uint32Array(batch.data.buffer, batch.data.byteOffset, 2 * batch.count)
            : new Uint32Array(batch.data.slice().buffer);
        this.lost += batch.lost;
        this.frames += batch.count;
        for (let i = 0; i < batch.count; i++) {
            const entry = this.byId.get(batch.id[i]) ?? this.ofGroup(batch.id[i]);
            const low = words[2 * i];
            const high = words[2 * i + 1];
            const arrived_ns = batch.time_ns[i];
            this.last_ns = arrived_ns;
            if (entry === undefined || (batch.length[i] !== entry.message.length
                && !(entry.message.may_be_longer && batch.length[i] > entry.message.length))) {
                this.unknown += 1;
                continue;
            }
            if (entry === this.status) {
                this.takeStatus(arrived_ns, low, high);
            }
            const stamped = STAMPED.has(entry.message.name) && arrived_ns - this.stamp_ns < STAMP_AGE_MAX_NS;
            const time_ns = stamped ? this.stamp_ns : arrived_ns;
            entry.count += 1;
            entry.raw.makeRoom();
            entry.raw.time[entry.raw.size] = time_ns;
            entry.raw.value[2 * entry.raw.size] = low;
            entry.raw.value[2 * entry.raw.size + 1] = high;
            entry.raw.size += 1;
            for (const series of entry.watched) {
                series.take(time_ns, low, high);
            }
        }
        if (batch.count && Number.isNaN(this.first_ns)) {
            this.first_ns = batch.time_ns[0];
        }
    }

    /** The time at which the values of the cycle were read, and cycles that are missing. */
    takeStatus(arrived_ns, low, high) {
        const stamp_ns = low * 1000;
        const age_ns = arrived_ns - stamp_ns - this.stampOffset_ns;
        if (age_ns < 0 || age_ns > STAMP_AGE_MAX_NS) {
            this.stampOffset_ns = arrived_ns - stamp_ns; // another start of the drive, or its counter has wrapped
        }
        this.stamp_ns = stamp_ns + this.stampOffset_ns;
        const cycle = high >>> 24;
        const known = this.cycle;
        if (known.last >= 0) {
            const step = (cycle - known.last + 256) % 256;
            if (known.step === 0 || step < known.step || step === known.candidate) {
                known.step = step; // the period has changed
                this.lost -= known.doubt;
                known.candidate = known.doubt = 0;
            } else if (step !== known.step) {
                known.candidate = step;
                known.doubt = Math.round(step / known.step) - 1;
                this.lost += known.doubt;
            } else {
                known.candidate = known.doubt = 0;
            }
        }
        known.last = cycle;
    }

    forgetFrom(time_ns) {
        for (const entry of this.byId.values()) {
            entry.raw.cutFrom(time_ns);
            entry.watched.forEach((series) => series.cutFrom(time_ns));
        }
        this.cycle = { last: -1, step: 0, candidate: 0, doubt: 0 };
        this.stamp_ns = NaN;
    }
}
