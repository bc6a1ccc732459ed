// Messages of a source's Info by name, written and read; decoder.js reads columns of them.

import { decoderOf, presenceOf } from "../../view/page/decoder.js";
import { protect } from "./e2e.js";

/** To the nearest whole number, halves to the even one. */
export function rounded(value) {
    const floor = Math.floor(value);
    if (value - floor !== 0.5) {
        return Math.round(value);
    }
    return floor % 2 === 0 ? floor : floor + 1;
}

export class Messages {
    /** list: Info.databases; dataIds: of the protected messages, by name. */
    constructor(list, dataIds) {
        this.list = list;
        this.dataIds = dataIds;
        this.byName = new Map(list.map((message) => [message.name, message]));
    }

    message(name) {
        return this.byName.get(name);
    }

    signal(messageName, name) {
        return this.message(messageName).signals.find((signal) => signal.name === name);
    }

    /** Raw value of a named one. */
    number(messageName, signalName, name) {
        const { choices } = this.signal(messageName, signalName);
        return Number(Object.keys(choices).find((number) => choices[number] === name));
    }

    /** Data of a frame: physical values by signal, or names; other signals are zero. */
    encode(messageName, values) {
        const message = this.message(messageName);
        let bits = 0n;
        for (const [name, value] of Object.entries(values)) {
            const signal = this.signal(messageName, name);
            const raw = typeof value === "string" ? this.number(messageName, name, value)
                : rounded((value - signal.offset) / signal.factor);
            bits |= BigInt.asUintN(signal.length, BigInt(raw)) << BigInt(signal.start);
        }
        const data = new Uint8Array(message.length);
        for (let i = 0; i < data.length; i++) {
            data[i] = Number((bits >> BigInt(8 * i)) & 0xffn);
        }
        return data;
    }

    /** The same of a message with checksum and counter. */
    encodeProtected(messageName, counter, values) {
        const data = this.encode(messageName, values);
        protect(this.dataIds[messageName], counter, data);
        return data;
    }

    /** Physical values of the signals that a frame has, by name; named ones by their name. */
    decode(messageName, data) {
        const message = this.message(messageName);
        const padded = new Uint8Array(8);
        padded.set(data.subarray(0, 8));
        const [low, high] = new Uint32Array(padded.buffer);
        const values = {};
        for (const signal of message.signals.filter((each) => presenceOf(message, each)(low, high))) {
            const value = decoderOf(signal)(low, high);
            values[signal.name] = signal.choices?.[value] ?? value;
        }
        return values;
    }
}
