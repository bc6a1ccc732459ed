// Variables of the drive's memory by name, as salient.bench.variables has them, and conditions on them.

import { Rejected } from "./client.js";

const NEAREST = 3;
const EXPRESSION = /^\s*([\w.[\]]+)\s*(>=|<=|==|>|<|rises to|falls to|changes)\s*([\w.+-]*)\s*$/;
/** sampler_condition_t. */
const [AT_ONCE, AT_LEAST, AT_MOST, RISING, FALLING, EQUAL, CHANGED] = [0, 1, 2, 3, 4, 5, 6];
/** Condition and level of a raw value. */
const CONDITIONS = {
    ">": (raw) => [AT_LEAST, Math.floor(raw) + 1], ">=": (raw) => [AT_LEAST, Math.ceil(raw)],
    "rises to": (raw) => [RISING, Math.ceil(raw)], "<": (raw) => [AT_MOST, Math.ceil(raw) - 1],
    "<=": (raw) => [AT_MOST, Math.floor(raw)], "falls to": (raw) => [FALLING, Math.floor(raw)],
    "==": (raw) => [EQUAL, Math.round(raw)],
};

/** Pairs of neighbouring letters that two names share. */
function likeness(a, b) {
    const pairs = new Set(Array.from(a, (_, i) => a.slice(i, i + 2)));
    return Array.from(b, (_, i) => b.slice(i, i + 2)).filter((pair) => pairs.has(pair)).length / (a.length + b.length);
}

export class Variables {
    /** data: of salient.tab.variables; factors: of its kinds, for a machine. */
    constructor(data, factors) {
        this.short = Object.keys(data.short);
        this.ring = { address: data.ring[0], words: data.ring[1] };
        this.byName = new Map();
        let [path, address] = ["", 0];
        data.rest.split("\n").forEach((rest, i) => {
            path = path.slice(0, data.shared[i]) + rest;
            address += data.step[i];
            const [bytes, signed, unit, choices] = data.kinds[data.kind[i]];
            this.byName.set(path, { name: path, address, bytes, signed, unit, choices, factor: factors[data.kind[i]] });
        });
        for (const [name, of] of Object.entries(data.short)) {
            this.byName.set(name, { ...this.byName.get(of), name });
        }
    }

    /** { name, address, bytes, signed, unit, choices, factor } of a short name or a path; value = raw * factor. */
    variable(name) {
        const found = this.byName.get(name);
        if (found === undefined) {
            const nearest = [...this.byName.keys()].sort((a, b) => likeness(name, b) - likeness(name, a)).slice(0, NEAREST);
            throw new Rejected(`signal '${name}': no variable of the drive; the nearest are ${nearest.join(", ")}`);
        }
        return found;
    }

    /** { variable, condition, level } of 'NAME > VALUE' and the like; without a text the first period. */
    trigger(text) {
        if (text === "") {
            return { variable: null, condition: AT_ONCE, level: 0 };
        }
        const [, name, operator, value] = EXPRESSION.exec(text) ?? [];
        if (name === undefined || (value !== "") === (operator === "changes")) {
            throw new Rejected(`trigger '${text}': must be 'SIGNAL > VALUE', with >, >=, <, <=, ==, 'rises to' or `
                               + "'falls to', or 'SIGNAL changes'");
        }
        const variable = this.variable(name);
        if (operator === "changes") {
            return { variable, condition: CHANGED, level: 0 };
        }
        const { bytes, signed, choices, factor, unit } = variable;
        const named = Object.keys(choices ?? {}).find((number) => choices[number] === value);
        const raw = Number(named ?? value) / factor;
        if (!Number.isFinite(raw)) {
            throw new Rejected(`trigger '${text}': ${value} must be a number`
                               + `${choices ? ` or one of ${Object.values(choices).join(", ")}` : ""}`);
        }
        const [condition, level] = CONDITIONS[operator](raw);
        const [least, most] = signed ? [-(2 ** (8 * bytes - 1)), 2 ** (8 * bytes - 1) - 1] : [0, 2 ** (8 * bytes) - 1];
        if (level < least || level > most) {
            throw new Rejected(`trigger '${text}': ${variable.name} is from ${least * factor} to ${most * factor} `
                               + `${unit}`.trimEnd());
        }
        return { variable, condition, level };
    }
}
