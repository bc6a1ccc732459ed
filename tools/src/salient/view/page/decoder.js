// Values of signals from the bytes of frames, by the databases that a source describes.

const POWER_32 = 4294967296;
const words = new DataView(new ArrayBuffer(8));

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

/** The bytes of a word in the opposite order. */
function swapped(word) {
    return ((word << 24) | ((word & 0xff00) << 8) | ((word >>> 8) & 0xff00) | (word >>> 24)) >>> 0;
}

/** Raw bits of a signal of either byte order; up to 53 bits are exact. */
function fieldOf({ start, length, reversed }) {
    return reversed ? (low, high) => rawBits(swapped(high), swapped(low), start, length)
        : (low, high) => rawBits(low, high, start, length);
}

/** The function (raw bits) -> value of an IEEE 754 number of 16 or 32 bits. */
function floatOf(length) {
    if (length === 32) {
        return (bits) => {
            words.setUint32(0, bits);
            return words.getFloat32(0);
        };
    }
    return (bits) => {
        const [exponent, fraction] = [(bits >>> 10) & 31, bits & 1023];
        const size = exponent === 31 ? (fraction ? NaN : Infinity)
            : exponent ? (1 + fraction / 1024) * 2 ** (exponent - 15) : fraction / 1024 * 2 ** -14;
        return bits & 0x8000 ? -size : size;
    };
}

/** The function (low word, high word) -> physical value of a signal of a source's Info. */
export function decoderOf(signal) {
    const { length, factor, offset } = signal;
    const field = fieldOf(signal);
    if (signal.float && length === 64) {
        return (low, high) => {
            words.setUint32(0, signal.reversed ? swapped(low) : high);
            words.setUint32(4, signal.reversed ? swapped(high) : low);
            return words.getFloat64(0) * factor + offset;
        };
    }
    if (signal.float) {
        const number = floatOf(length);
        return (low, high) => number(field(low, high)) * factor + offset;
    }
    if (signal.signed) {
        const half = 2 ** (length - 1);
        const range = 2 ** length;
        return (low, high) => {
            const raw = field(low, high);
            return (raw >= half ? raw - range : raw) * factor + offset;
        };
    }
    return (low, high) => field(low, high) * factor + offset;
}

/** The function (low word, high word) -> whether a frame carries a multiplexed signal of a message. */
export function presenceOf(message, signal) {
    const selector = message.signals.find((candidate) => candidate.name === signal.selector);
    if (selector === undefined) {
        return () => true;
    }
    const [field, isSelected] = [fieldOf(selector), presenceOf(message, selector)]; // one may select another
    return (low, high) => isSelected(low, high) && signal.multiplexed.includes(field(low, high));
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
