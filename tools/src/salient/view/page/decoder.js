// Values of signals from the bytes of frames, by the databases that a source describes.

const POWER_32 = 4294967296;
const float32 = new Float32Array(1);
const float32Bits = new Uint32Array(float32.buffer);

/** Raw bits of a little-endian signal from the two words of a frame's 8 bytes; up to 53 bits are exact. */
export function rawBits(low, high, start, length) {
    let bits;
    if (start >= 32) {
        bits = high >>> (start - 32);
    } else {
        bits = start === 0 ? low : ((low >>> start) | (high << (32 - start))) >>> 0;
    }
    if (length < 32) {
        return bits & (2 ** length - 1);
    }
    if (length === 32) {
        return bits >>> 0;
    }
    const above = start === 0 ? high : high >>> start;
    return (above % 2 ** (length - 32)) * POWER_32 + (bits >>> 0);
}

/** The function (low word, high word) -> physical value of a signal of a source's Info. */
export function decoderOf(signal) {
    const { start, length, factor, offset } = signal;
    if (signal.float) {
        return (low, high) => {
            float32Bits[0] = rawBits(low, high, start, length);
            return float32[0] * factor + offset;
        };
    }
    if (signal.signed) {
        const half = 2 ** (length - 1);
        const range = 2 ** length;
        return (low, high) => {
            const raw = rawBits(low, high, start, length);
            return (raw >= half ? raw - range : raw) * factor + offset;
        };
    }
    return (low, high) => rawBits(low, high, start, length) * factor + offset;
}

/** The function (low word, high word) -> whether a frame carries a multiplexed signal of a message. */
export function presenceOf(message, signal) {
    const selector = message.signals.find((candidate) => candidate.multiplexer);
    if (signal.multiplexed === null || selector === undefined) {
        return () => true;
    }
    return (low, high) => signal.multiplexed.includes(rawBits(low, high, selector.start, selector.length));
}

/** Decimals that the least significant bit of a signal deserves. */
export function decimalsOf(signal) {
    if (signal.float) {
        return 3;
    }
    return Math.min(4, Math.max(0, Math.ceil(-Math.log10(Math.abs(signal.factor)) - 1e-9)));
}

/** A value as text: by its name where it has one. */
export function textOf(signal, value) {
    if (!Number.isFinite(value)) {
        return "–";
    }
    return nameOf(signal, value) ?? value.toFixed(decimalsOf(signal)).replace("-", "−");
}

/** The name of a value of a signal; undefined where it has none. */
export function nameOf(signal, value) {
    return signal.choices?.[String(value)];
}

/** "a, b or c"; undefined without a list. */
export function either(list) {
    return list && [list.slice(0, -1).join(", "), ...list.slice(-1)].filter(Boolean).join(" or ");
}
