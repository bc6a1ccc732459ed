// What part of time the page shows: the latest, a part that is held, or a log that is played.

const EDGE_BEFORE = 0.2; // part of the window before a trigger
const AGE_MAX_NS = 1e9; // of the slowed rotor
const SLOW = 100;

export class Timeline {
    constructor(store, isReplay) {
        this.store = store;
        this.isReplay = isReplay;
        this.window_ns = 1e9;
        this.end_ns = 0;
        this.held = isReplay;
        this.speed = 1;
        this.playing = false;
    }

    get start_ns() {
        return this.end_ns - this.window_ns;
    }

    hold(held) {
        this.held = held;
    }

    /** Shows from one time to another, held. */
    zoom(from_ns, to_ns) {
        this.window_ns = Math.max(1e5, to_ns - from_ns);
        this.end_ns = to_ns;
        this.held = true;
        this.playing = false;
    }

    /** Wall time has passed. */
    advance(elapsed_ms) {
        if (this.playing) {
            this.end_ns = Math.min(this.end_ns + elapsed_ms * 1e6 * this.speed, this.store.last_ns);
            this.playing = this.end_ns < this.store.last_ns;
        } else if (!this.held && Number.isFinite(this.store.last_ns)) {
            this.end_ns = this.store.last_ns;
        }
        if (this.isReplay && this.end_ns > this.store.last_ns) {
            this.end_ns = this.store.last_ns;
        }
    }
}

/** Finds the edge of a signal that the user waits for. */
export class Trigger {
    constructor() {
        this.mode = "off";
        this.series = undefined;
        this.rising = true;
        this.level = 0;
        this.found_ns = NaN;
        this.seen_ns = 0;
    }

    arm(settings, now_ns) {
        Object.assign(this, settings);
        this.found_ns = NaN;
        this.seen_ns = now_ns;
    }

    /** The text of its state; moves the timeline when the window around an edge is complete. */
    run(timeline, last_ns) {
        if (this.mode === "off" || !this.series) {
            return "off";
        }
        if (Number.isNaN(this.found_ns)) {
            this.found_ns = this.search(last_ns);
            if (Number.isNaN(this.found_ns)) {
                return "waits";
            }
        }
        const end_ns = this.found_ns + (1 - EDGE_BEFORE) * timeline.window_ns;
        if (last_ns < end_ns) {
            return "edge";
        }
        timeline.end_ns = end_ns;
        timeline.held = true;
        if (this.mode === "single") {
            this.mode = "off";
            return "done";
        }
        this.seen_ns = Math.max(this.seen_ns, end_ns);
        this.shown_ns = this.found_ns;
        this.found_ns = NaN;
        return "shown";
    }

    search(last_ns) {
        const { series, level } = this;
        const isNamed = Boolean(series.signal.choices); // whose order has no meaning: the value begins or ends
        for (let i = Math.max(1, series.indexAt(this.seen_ns)); i < series.size; i++) {
            const [before, now] = [series.value[i - 1], series.value[i]];
            const begins = isNamed ? before !== level && now === level : before < level && now >= level;
            const ends = isNamed ? before === level && now !== level : before > level && now <= level;
            if (this.rising ? begins : ends) {
                this.shown_ns = series.time[i];
                return series.time[i];
            }
        }
        this.seen_ns = last_ns;
        return NaN;
    }
}

/** The time at which the machine is drawn: the end of the plots, or behind it and slowed. */
export class RotorTime {
    constructor(state) {
        this.state = state;
        this.slowed = true;
        this.time_ns = NaN;
    }

    advance(elapsed_ms, timeline) {
        const end_ns = timeline.end_ns;
        const late = !(Math.abs(end_ns - this.time_ns) <= AGE_MAX_NS) || this.time_ns > end_ns;
        if (!this.slowed || timeline.held) {
            this.time_ns = end_ns;
        } else if (late) {
            this.time_ns = this.sameAngleBefore(end_ns);
        } else {
            this.time_ns += elapsed_ms * 1e6 / SLOW;
        }
        return this.time_ns;
    }

    /** The latest time at which the rotor is as far from a pole as it is drawn now, so that it goes on without a jump. */
    sameAngleBefore(end_ns) {
        const { state } = this;
        const drawn = state.phaseAngle(0, state.angleAt(this.time_ns));
        const series = state.angle;
        let last = NaN;
        for (let i = series.indexAt(end_ns) - 1; i > 0 && series.time[i] > end_ns - AGE_MAX_NS / 2; i--) {
            const distance = ((state.phaseAngle(0, series.value[i]) - drawn + 1.5 * state.pitch_deg)
                % state.pitch_deg) - state.pitch_deg / 2;
            if (last * distance <= 0 && Math.abs(last - distance) < state.pitch_deg / 2) {
                const part = last === distance ? 0 : distance / (distance - last);
                return series.time[i] + part * (series.time[i + 1] - series.time[i]);
            }
            last = distance;
        }
        return end_ns;
    }
}
